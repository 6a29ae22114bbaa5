#pragma once

#include <string>

#include "gp2/fit.hpp"

namespace gp2::test {

inline Hyperparameter hyperparameter(Hyperparameter::Kind kind, const std::string& name, double value, double lower,
                                     double upper) {
  Hyperparameter h = Hyperparameter::of(kind, 0, 0);
  h.name = name;
  h.value = value;
  h.lower = lower;
  h.upper = upper;
  return h;
}

}  // namespace gp2::test
