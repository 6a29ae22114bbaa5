// The extension module gp2._gp2. The logic is the library's; here arrays, names and exceptions change sides.

#include <pybind11/pybind11.h>

#include "bindings.hpp"
#include "gp2/base/blas.hpp"
#include "gp2/base/version.hpp"
#include "gp2/error.hpp"
#include "options.hpp"

PYBIND11_MODULE(_gp2, module) {
  namespace py = pybind11;
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
}
