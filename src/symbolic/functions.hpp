#pragma once

#include <algorithm>
#include <array>
#include <string_view>

#include "gp2/symbolic/expression.hpp"

namespace gp2::internal {

/// A function as users write it, and as it is printed.
struct Function {
  Operation operation;
  std::string_view text;
  std::string_view latex;
  std::string_view c;
};

// clang-format off
inline constexpr std::array functions{
    Function{Operation::sin,   "sin",   "\\sin",                 "sin"},
    Function{Operation::cos,   "cos",   "\\cos",                 "cos"},
    Function{Operation::tan,   "tan",   "\\tan",                 "tan"},
    Function{Operation::asin,  "asin",  "\\arcsin",              "asin"},
    Function{Operation::acos,  "acos",  "\\arccos",              "acos"},
    Function{Operation::atan,  "atan",  "\\arctan",              "atan"},
    Function{Operation::atan2, "atan2", "\\operatorname{atan2}", "atan2"},
    Function{Operation::sinh,  "sinh",  "\\sinh",                "sinh"},
    Function{Operation::cosh,  "cosh",  "\\cosh",                "cosh"},
    Function{Operation::tanh,  "tanh",  "\\tanh",                "tanh"},
    Function{Operation::exp,   "exp",   "\\exp",                 "exp"},
    Function{Operation::log,   "log",   "\\log",                 "log"},
    Function{Operation::sqrt,  "sqrt",  "\\sqrt",                "sqrt"},
    Function{Operation::abs,   "abs",   "\\operatorname{abs}",   "fabs"},
    Function{Operation::sign,  "sign",  "\\operatorname{sign}",  "sign"},
    Function{Operation::min,   "min",   "\\min",                 "fmin"},
    Function{Operation::max,   "max",   "\\max",                 "fmax"}};
// clang-format on

/// The entry of the table named `text`, or null.
inline const Function* find_function(std::string_view text) {
  const auto* const found = std::find_if(functions.begin(), functions.end(), [&](const Function& f) { return f.text == text; });
  return found == functions.end() ? nullptr : found;
}

/// The entry of the table that computes `operation`, or null.
inline const Function* find_function(Operation operation) {
  const auto* const found =
      std::find_if(functions.begin(), functions.end(), [&](const Function& f) { return f.operation == operation; });
  return found == functions.end() ? nullptr : found;
}

}  // namespace gp2::internal
