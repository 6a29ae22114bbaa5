#pragma once

#include <string>
#include <vector>

#include "gp2/posterior.hpp"

namespace gp2 {

// A prior, and the parameters of its system.
struct PriorAt {
  const Prior& prior;
  Eigen::VectorXd parameters;
};

// What a prior says at states, of which the posterior is made: M, A, b, the mean, directions and features of its latents.
struct PriorPart {
  std::string what;
  Eigen::MatrixXd values;  // a column per state
};
std::vector<PriorPart> parts_at(const PriorAt& at, const Eigen::Ref<const Eigen::MatrixXd>& states);

// What differs between two priors, in what they say of themselves and at the states of observations; empty: nothing.
std::string difference_at(const Observations& group, const PriorAt& made, const PriorAt& fitted);

// Whether they are the same to the bit.
bool are_same(const ModelValues& a, const ModelValues& b);

}  // namespace gp2
