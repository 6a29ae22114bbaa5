#pragma once

#include <string>

#include "gp2/posterior.hpp"

namespace gp2 {

// A prior, and the parameters of its system.
struct PriorAt {
  const Prior& prior;
  Eigen::VectorXd parameters;
};

// What differs between two priors, in what they say of themselves and at the states of observations; empty: nothing.
std::string difference_at(const Observations& group, const PriorAt& made, const PriorAt& fitted);

// Whether they are the same to the bit.
bool are_same(const ModelValues& a, const ModelValues& b);

}  // namespace gp2
