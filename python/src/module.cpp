// The extension module gp2._gp2. The logic is the library's; here arrays, names and exceptions change sides.

#include <algorithm>
#include <array>
#include <string>
#include <utility>
#include <vector>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "bindings.hpp"
#include "gp2/base/blas.hpp"
#include "gp2/base/version.hpp"
#include "gp2/error.hpp"
#include "options.hpp"

namespace {

namespace py = pybind11;

PyCFunctionWithKeywords dispatch = nullptr;  // pybind's own way into all of its functions

// Of arguments that fit no signature pybind tells the signatures; "" where it is not that.
std::string signatures_in(const std::string& text) {
  const std::size_t first = text.find(" 1. "), end = text.find("\nInvoked with:");
  if (text.find("The following argument types are supported:") == std::string::npos || first >= end) return "";
  return text.substr(first, end - first);
}

// What was called, by what pybind says of it: of a constructor the class.
std::string called(const std::string& text, const std::string& signatures) {
  const py::object of_class = py::module_::import("re").attr("search")(R"(1\. [\w.]*\.(\w+)\()", signatures);
  return of_class.is_none() ? text.substr(0, text.find('(')) : of_class.attr("group")(1).cast<std::string>();
}

// The parameters of one signature as they stand in it: "view: str = 'constrained'", "*", "**kwargs". Of several there are none.
std::vector<std::string> parameters_in(const std::string& signatures) {
  const std::size_t first = signatures.find('(') + 1, end = std::min(signatures.rfind(") ->"), signatures.rfind(')'));
  if (signatures.find(" 2. ") != std::string::npos || first == 0 || end == std::string::npos || end <= first) return {};
  const py::object split = py::module_::import("re").attr("split")(R"(, (?=\w+: |\*))", signatures.substr(first, end - first));
  return split.cast<std::vector<std::string>>();
}

std::string name_in(const std::string& parameter) { return parameter.substr(0, parameter.find(':')); }

// A keyword that no signature has. One that ends in **kwargs has others too: there a keyword that is near a parameter is taken for it.
void refuse_unknown_keyword(const std::string& text, const std::string& signatures, const py::dict& keywords) {
  const bool has_others = signatures.find("**") != std::string::npos;
  const py::module_ re = py::module_::import("re");
  const py::list known = re.attr("findall")(R"((\w+): )", signatures);
  py::dict of_system;  // the keywords of System, which from_callables has too
  if (text.starts_with("from_callables(")) {
    of_system = py::module_::import("gp2._model_text").attr("model_text").attr("__kwdefaults__");
  }
  for (const auto& [keyword, value] : keywords) {
    if (known.contains(keyword) || of_system.contains(keyword)) continue;
    const auto given = keyword.cast<std::string>();
    if (has_others && (gp2::python::is_keyword(given) || gp2::python::nearest(given, known).empty())) continue;
    gp2::python::refuse_keyword(called(text, signatures), given, known);
  }
}

// More arguments by position than there may be, or one by position and by name too.
void refuse_by_position(const std::string& text, const std::string& signatures, const py::tuple& arguments,
                        const py::dict& keywords) {
  if (signatures.find(" 2. ") != std::string::npos) return;
  const std::string function = called(text, signatures);
  bool has_object = text.starts_with("__init__()");  // among the arguments; in the signature of a method it is `self`
  std::vector<std::string> by_position, by_name;
  bool are_by_name = false;
  for (const std::string& parameter : parameters_in(signatures)) {
    const std::string name = name_in(parameter);
    if (name == "self") {
      has_object = true;
    } else if (parameter == "*") {
      are_by_name = true;
    } else if (parameter.starts_with("**")) {
      by_name.emplace_back("help() lists them");
    } else if (are_by_name) {
      by_name.push_back(name + "=…");
    } else {
      by_position.push_back(name);
    }
  }
  const std::size_t n_given = arguments.size() - std::min<std::size_t>(arguments.size(), has_object ? 1 : 0);
  for (std::size_t k = 0; k < std::min(n_given, by_position.size()); ++k) {
    if (!keywords.contains(by_position[k])) continue;
    throw py::type_error(fmt::format("{}() got the argument '{}' twice: by position and by name", function, by_position[k]));
  }
  if (n_given <= by_position.size()) return;
  if (function == "System") throw py::type_error("System() takes keywords; gp2.System.load reads a model file");
  if (!by_name.empty()) {
    throw py::type_error(fmt::format("{}() takes {} by position; write what follows with its name: {}", function,
                                     fmt::join(by_position, ", "), fmt::join(by_name, ", ")));
  }
  const std::string most = by_position.empty() ? "arguments" : fmt::format("more than {}", fmt::join(by_position, ", "));
  throw py::type_error(fmt::format("{}() takes no {}", function, most));
}

/// What a parameter of a type takes, and whether a value is one; nothing of types whose values tell of themselves.
struct Takes {
  const char* type;
  const char* words;
  bool (*fits)(py::handle value);
};
bool is_index(py::handle value) { return PyIndex_Check(value.ptr()) != 0; }
bool is_number(py::handle value) {
  if (PyFloat_AsDouble(value.ptr()) != -1 || PyErr_Occurred() == nullptr) return true;
  PyErr_Clear();
  return false;
}
bool is_text(py::handle value) { return py::isinstance<py::str>(value); }
bool is_list_of_text(py::handle value) {
  if (is_text(value) || !py::isinstance<py::sequence>(value)) return false;
  const auto items = py::reinterpret_borrow<py::sequence>(value);
  return std::all_of(items.begin(), items.end(), [](py::handle item) { return is_text(item); });
}
constexpr std::array takes = {
    Takes{"int", "a whole number", &is_index},
    Takes{"float", "a number", &is_number},
    Takes{"bool", "True or False", [](py::handle value) { return py::isinstance<py::bool_>(value) || is_index(value); }},
    Takes{"str", "a str", &is_text},
    Takes{"List[str]", "a list of names", &is_list_of_text},
    Takes{"gp2._gp2.System", "a gp2.System (gp2.System.load reads one from a file)",
          [](py::handle value) { return py::isinstance<gp2::python::PySystem>(value); }},
    Takes{"gp2._gp2.Posterior", "a gp2.Posterior (gp2.load reads one from a file)",
          [](py::handle value) { return py::isinstance<gp2::python::PyPosterior>(value); }},
};

// A value of another type than its parameter's, where there is one signature.
void refuse_wrong_type(const std::string& text, const std::string& signatures, const py::tuple& arguments,
                       const py::dict& keywords) {
  if (signatures.find(" 2. ") != std::string::npos) return;
  const py::object re = py::module_::import("re");
  std::size_t position = text.find("__init__()") == 0 ? 1 : 0;  // whose signature does not have the object
  // a whole number below 0, or one that is too large: what is wrong where nothing else is
  std::string negative;
  std::vector<std::pair<std::string, py::object>> whole_numbers;
  for (const py::handle parameter : re.attr("findall")(R"((\w+): (Optional\[)?([\w.]+(?:\[\w+\])?))", signatures)) {
    const auto parts = parameter.cast<std::array<std::string, 3>>();
    const std::string &name = parts[0], &optional = parts[1], &type = parts[2];
    py::object value;
    if (keywords.contains(name)) {
      value = keywords[name.c_str()];
    } else if (position < arguments.size()) {
      value = arguments[position];
    }
    ++position;
    const auto* const known = std::find_if(takes.begin(), takes.end(), [&](const Takes& one) { return one.type == type; });
    if (!value || known == takes.end()) continue;
    const auto got = [&](const char* expected) {
      return fmt::format("{}: expected {}, got {}", name, expected, py::repr(value).cast<std::string>());
    };
    const bool may_be_none = !optional.empty() || signatures.find(fmt::format("{}: {} = None", name, type)) != std::string::npos;
    const bool is_left_out = value.is_none() && may_be_none;
    if (!is_left_out && !known->fits(value)) throw py::type_error(got(known->words));
    if (type != "int" || is_left_out) continue;
    const auto number = py::reinterpret_steal<py::object>(PyNumber_Index(value.ptr()));
    if (!number) throw py::type_error((PyErr_Clear(), got(known->words)));  // an array may only seem to be one
    if (number < py::int_(0)) negative = got("a whole number that is not negative");
    whole_numbers.emplace_back(name, value);
  }
  if (!negative.empty()) throw py::type_error(negative);
  for (const int bits : {64, 31}) {
    for (const auto& [name, number] : whole_numbers) gp2::python::require_bits(bits, number, name);
  }
}

// An argument without a default that is not given, where there is one signature.
void refuse_missing_argument(const std::string& text, const std::string& signatures, const py::tuple& arguments,
                             const py::dict& keywords) {
  std::size_t position = text.find("__init__()") == 0 ? 1 : 0;  // whose signature does not have the object
  for (const std::string& parameter : parameters_in(signatures)) {
    if (parameter.starts_with('*')) return;
    const std::string name = name_in(parameter);
    const bool is_optional = parameter.find(" = ") != std::string::npos;
    if (position++ < arguments.size() || is_optional || keywords.contains(name)) continue;
    throw py::type_error(fmt::format("{}() is missing the argument '{}'", called(text, signatures), name));
  }
}

PyObject* dispatch_or_say_why(PyObject* self, PyObject* arguments, PyObject* keywords) {
  PyObject* const result = dispatch(self, arguments, keywords);
  if (result != nullptr || PyErr_ExceptionMatches(PyExc_TypeError) == 0) return result;
  py::error_already_set error;
  try {
    const std::string text = py::str(error.value()), signatures = signatures_in(text);
    const auto given = keywords == nullptr ? py::dict() : py::reinterpret_borrow<py::dict>(keywords);
    const auto positional = py::reinterpret_borrow<py::tuple>(arguments);
    if (text.starts_with("fit(") && positional.size() > 2) {
      throw py::type_error("fit() takes a system and data, then keywords; of arrays write fit(system, (X, y))");
    }
    if (!signatures.empty()) {
      refuse_unknown_keyword(text, signatures, given);
      refuse_by_position(text, signatures, positional, given);
      refuse_wrong_type(text, signatures, positional, given);
      refuse_missing_argument(text, signatures, positional, given);
    }
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

// For all functions of a module and its classes.
void say_why_arguments_do_not_fit(const py::handle& scope) {
  const py::dict members(scope.attr("__dict__"));
  for (const auto& [name, member] : members) {
    if (py::isinstance<py::type>(member)) say_why_arguments_do_not_fit(member);
    const py::object held = py::getattr(member, "__func__", member);  // of a static method
    const py::handle function = py::detail::get_function(held);
    if (PyCFunction_Check(function.ptr()) == 0) continue;
    PyMethodDef& method = *reinterpret_cast<PyCFunctionObject*>(function.ptr())->m_ml;
    if (dispatch_of(method) == dispatch) method.ml_meth = as_plain(&dispatch_or_say_why);
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
    } catch (gp2::python::Interruption& interruption) {
      interruption.error.restore();
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
  say_why_arguments_do_not_fit(module);
}
