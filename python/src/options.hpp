#pragma once

#include <limits>
#include <string>
#include <type_traits>
#include <vector>

#include <fmt/format.h>
#include <pybind11/pybind11.h>

#include "gp2/jobs/option.hpp"

namespace gp2::python {

namespace py = pybind11;

/// Whether it is Python's truth value, or NumPy's.
bool is_truth_value(py::handle given);

/// @throws py::type_error for a whole number from 2^bits on.
void require_bits(int bits, py::handle given, const std::string& name);

/// A value as a T. Python's own conversions take True for the number 1, and any number for true; as an argument each is a slip.
/// @throws py::type_error saying what is expected.
template <typename T>
T argument(py::handle given, const std::string& name, const std::string& expected) {
  try {
    if (std::is_arithmetic_v<T> && std::is_same_v<T, bool> != is_truth_value(given)) throw py::cast_error();
    return given.cast<T>();
  } catch (const py::cast_error&) {
    if constexpr (std::is_integral_v<T> && !std::is_same_v<T, bool>) require_bits(std::numeric_limits<T>::digits, given, name);
    throw py::type_error(fmt::format("{}: expected {}, got {}", name, expected, std::string(py::repr(given))));
  }
}

/// Takes a keyword that is no option of a job out of `keywords`.
template <typename T>
T take(py::dict& keywords, const char* name, T otherwise) {
  if (!keywords.contains(name)) return otherwise;
  return keywords.attr("pop")(name).cast<T>();
}

/// Whether some command has an option of this name in Python.
bool is_keyword(const std::string& name);

/// The one of `known` that is nearest to a name; "" where none is near.
std::string nearest(const std::string& name, const py::list& known);

/// @throws py::type_error of an unknown keyword of `function`, with the nearest there is
[[noreturn]] void refuse_keyword(const std::string& function, const std::string& name, const py::list& known);

/// Reads what is left of the keywords of a call into the options of a job.
/// @param function  for messages: fit
/// @param others    its parameters that are no options, which an unknown keyword may be meant to be
/// @throws py::type_error for an unknown keyword, with the nearest there is, or a value of the wrong type; InputError for a
///   word that an option does not have.
void read_keywords(const std::string& function, const py::dict& keywords, const std::vector<Option>& options,
                   const std::vector<std::string>& others);

/// The first line of a docstring: fit(system: System, *, mean: Literal["zero", "force"] = "zero", …) -> Posterior
/// @param first, last  parameters before and after the options, ending and beginning with a comma
std::string signature(const std::string& function, const std::string& first, const std::vector<Option>& options,
                      const std::string& last, const std::string& returned);

/// A line of a docstring for each option: its name and sentence.
std::string documentation(const std::vector<Option>& options);

/// The keywords of an option list as lines of the stub.
std::string stub_lines(const std::vector<Option>& options);

/// A message of the library with its options as Python has them: `noise_std=estimate` -> noise_std='estimate'.
std::string with_keywords(const std::string& message);
std::vector<std::string> with_keywords(std::vector<std::string> messages);

/// The name of an option in Python.
const std::string& keyword_of(const Option& option);

}  // namespace gp2::python
