// The extension module gp2._gp2. The logic is the library's; here arrays, names and exceptions change sides.

#include <pybind11/pybind11.h>

#include "bindings.hpp"
#include "gp2/base/blas.hpp"
#include "gp2/base/version.hpp"
#include "gp2/error.hpp"

PYBIND11_MODULE(_gp2, module) {
  namespace py = pybind11;
  py::register_exception<gp2::InputError>(module, "InputError", PyExc_ValueError).doc() =
      "The user's input breaks a rule. The text says where, which rule, the value got, and the mend.";
  py::register_exception<gp2::NumericalError>(module, "NumericalError", PyExc_ArithmeticError).doc() =
      "The input is well-formed but the numbers cannot be computed.";
  gp2::python::add_table(module);
  gp2::python::add_system(module);
  gp2::python::add_posterior(module);
  gp2::python::add_fit(module);
  gp2::python::add_predictor(module);
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
