#pragma once

#include <stdexcept>
#include <string>

#include "gp2/export.hpp"

namespace gp2 GP2_API {

/// Base of everything gp2 throws.
class Error : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// The user's input breaks a rule. The text says where, which rule, the value got, and the mend. The command exits with 2.
class InputError : public Error {
 public:
  using Error::Error;
};

/// The input is well-formed but the numbers cannot be computed (say no restart reached a finite likelihood). The command exits
/// with 1.
class NumericalError : public Error {
 public:
  using Error::Error;
};

}  // namespace gp2
