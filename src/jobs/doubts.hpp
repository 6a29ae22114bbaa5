#pragma once

#include <functional>
#include <string>
#include <vector>

#include "gp2/posterior.hpp"

// Whether other data than those given would be likelier: an input that acts otherwise, logs that contradict each other.
namespace gp2 {

// Fits the hyperparameters to some of the data.
using FittedValues = std::function<ModelValues(const std::vector<Observations>&)>;

// Of what add_doubts notes: that an input acts at another time than logged, and which inputs the model does not explain.
struct Doubts {
  std::vector<std::string> delays;
  std::string unexplained;  // empty: none
};

// Inputs that never move, inputs that act otherwise than the model says, in all logs or in one, a known force that does, and logs that
// contradict each other.
// @param lines          per observations: the line in its log of each state; empty where it is not known
// @param held           names of parameters that a bound or a prior holds against the data: if wrong, inputs seem wrong
// @param has_wrong_rate  a column is known to be no rate of another, which makes sound inputs look wrong: only the inputs' own values
//                        are looked at
Doubts add_doubts(const Posterior& posterior, const std::vector<std::vector<int>>& lines, const std::vector<std::string>& held,
                  const FittedValues& fitted_values, bool has_wrong_rate, std::vector<std::string>& notes);

}  // namespace gp2
