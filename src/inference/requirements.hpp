#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/inference/model_values.hpp"
#include "gp2/observations.hpp"
#include "gp2/prior.hpp"

// What public functions demand of their arguments beyond require_prior, require_view and System::require_states. Each throws
// InputError naming the rule and what was got.
namespace gp2 {

/// Observations are of a view of the prior, at states of the system viewed.
void require_observations(const Prior& prior, const Observations& observations);
void require_observations(const Prior& prior, const std::vector<Observations>& observations);

/// A value is measured somewhere.
/// @param function  for the message
void require_measured(const std::vector<Observations>& observations, const char* function);

/// There are as many values as the prior and its observations have places for, finite and, where they are positive by nature, so.
void require_values(const Prior& prior, const std::vector<Observations>& observations, const ModelValues& values);

/// A nonlinear prior is learned from values of ddq, or of what else has the whole motion in it.
void require_learnable(const Prior& prior, const std::vector<Observations>& observations);

/// A vector or a side of a matrix has this size.
/// @param type  of the object that takes it, for the message
void require_size(const char* type, const char* what, Eigen::Index got, Eigen::Index wanted);

/// @param type  of what was moved away
[[noreturn]] void throw_moved(const char* type);

/// What a pointer points to; one of an object that was moved away is null.
/// @param type  of the object, for the message
template <typename Pointer>
auto& require_held(const Pointer& pointer, const char* type) {
  if (!pointer) throw_moved(type);
  return *pointer;
}

}  // namespace gp2
