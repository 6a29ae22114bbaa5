#pragma once

#include <functional>
#include <string>
#include <vector>

#include "gp2/posterior.hpp"

// Whether other data than those given would be likelier: an input that acts otherwise, logs that contradict each other.
namespace gp2 {

// Fits the hyperparameters to some of the data.
using FittedValues = std::function<ModelValues(const std::vector<Observations>&)>;

// Inputs that never move, inputs that act otherwise than the model says, in all logs or in one, and logs that contradict each other.
// @param has_row_order  whether the states of an observation follow each other as they were measured
void add_doubts(const Posterior& posterior, bool has_row_order, const FittedValues& fitted_values,
                std::vector<std::string>& notes);

}  // namespace gp2
