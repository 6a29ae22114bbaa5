// The extension module gp2._gp2. The logic is the library's; here arrays, names and exceptions change sides.

#include <pybind11/pybind11.h>

#include "bindings.hpp"
#include "gp2/base/blas.hpp"
#include "gp2/base/version.hpp"
#include "gp2/error.hpp"
#include "options.hpp"

namespace {

namespace py = pybind11;

PyCFunctionWithKeywords dispatch = nullptr;  // pybind's own way into all of its functions

// Of arguments that fit no signature pybind tells the signatures, from which a keyword that none of them has is found. One that ends in
// **kwargs has others too: there a keyword that is near a parameter is taken for it.
void refuse_unknown_keyword(const std::string& text, const py::dict& keywords) {
  const std::size_t first = text.find(" 1. "), end = text.find("\nInvoked with:");
  if (text.find("The following argument types are supported:") == std::string::npos || first >= end) return;
  const std::string signatures = text.substr(first, end - first);
  const bool has_others = signatures.find("**") != std::string::npos;
  const py::module_ re = py::module_::import("re");
  const py::list known = re.attr("findall")(R"((\w+): )", signatures);
  const py::object of_class = re.attr("search")(R"(1\. [\w.]*\.(\w+)\()", signatures);
  const std::string name = of_class.is_none() ? text.substr(0, text.find('(')) : of_class.attr("group")(1).cast<std::string>();
  for (const auto& [keyword, value] : keywords) {
    if (known.contains(keyword)) continue;
    if (has_others && gp2::python::nearest(keyword.cast<std::string>(), known).empty()) continue;
    gp2::python::refuse_keyword(name, keyword.cast<std::string>(), known);
  }
}

PyObject* dispatch_with_known_keywords(PyObject* self, PyObject* arguments, PyObject* keywords) {
  PyObject* const result = dispatch(self, arguments, keywords);
  if (result != nullptr || keywords == nullptr || PyErr_ExceptionMatches(PyExc_TypeError) == 0) return result;
  py::error_already_set error;
  try {
    refuse_unknown_keyword(py::str(error.value()), py::reinterpret_borrow<py::dict>(keywords));
    error.restore();
  } catch (const py::builtin_exception& refusal) {
    refusal.set_error();
  } catch (py::error_already_set& other) {
    other.restore();
  }
  return nullptr;
}

// The two types that Python knows a function with keywords by.
PyCFunction as_plain(PyCFunctionWithKeywords function) {
  return reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(function));
}
PyCFunctionWithKeywords dispatch_of(const PyMethodDef& method) {
  return reinterpret_cast<PyCFunctionWithKeywords>(reinterpret_cast<void (*)()>(method.ml_meth));
}

// Of all functions of a module and its classes.
void refuse_unknown_keywords(const py::handle& scope) {
  const py::dict members(scope.attr("__dict__"));
  for (const auto& [name, member] : members) {
    if (py::isinstance<py::type>(member)) refuse_unknown_keywords(member);
    const py::object held = py::getattr(member, "__func__", member);  // of a static method
    const py::handle function = py::detail::get_function(held);
    if (PyCFunction_Check(function.ptr()) == 0) continue;
    PyMethodDef& method = *reinterpret_cast<PyCFunctionObject*>(function.ptr())->m_ml;
    if (dispatch_of(method) == dispatch) method.ml_meth = as_plain(&dispatch_with_known_keywords);
  }
}

}  // namespace

PYBIND11_MODULE(_gp2, module) {
  static py::exception<gp2::InputError> input_error(module, "InputError", PyExc_ValueError);
  input_error.doc() = "The user's input breaks a rule. The text says where, which rule, the value got, and the mend.";
  static py::exception<gp2::NumericalError> numerical_error(module, "NumericalError", PyExc_ArithmeticError);
  numerical_error.doc() = "The input is well-formed but the numbers cannot be computed.";
  py::register_exception_translator([](std::exception_ptr thrown) {
    try {
      if (thrown) std::rethrow_exception(thrown);
    } catch (const gp2::InputError& error) {
      input_error(gp2::python::with_keywords(error.what()).c_str());
    } catch (const gp2::NumericalError& error) {
      numerical_error(gp2::python::with_keywords(error.what()).c_str());
    }
  });
  gp2::python::add_table(module);
  gp2::python::add_system(module);
  gp2::python::add_posterior(module);
  gp2::python::add_fit(module);
  gp2::python::add_predictor(module);
  gp2::python::add_report(module);
  module.def(
      "blas_report",
      [] {
        const gp2::BlasReport report = gp2::blas_report();
        py::dict out;
        out["library"] = report.library;
        out["kernel"] = report.kernel;
        out["threads"] = report.n_threads;
        out["fastest_kernel"] = report.fastest_kernel;
        out["advice"] = report.advice;
        return out;
      },
      "The BLAS library in use, its kernel, and in 'advice' what to set in the environment where another one is faster.\n"
      "gp2 itself changes no setting of the process.");
  module.attr("__version__") = gp2::version();
  const py::object fit = module.attr("fit");
  dispatch = dispatch_of(*reinterpret_cast<PyCFunctionObject*>(fit.ptr())->m_ml);
  refuse_unknown_keywords(module);
}
