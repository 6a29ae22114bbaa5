#pragma once

#include <cstddef>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "gp2/inference/model_values.hpp"
#include "gp2/observations.hpp"
#include "gp2/prior.hpp"

namespace gp2 {

/// What the parameters θ decide about one Observations: G, d of its view and μ, E of the prior, with their derivatives in the
/// parameters asked for.
struct ObservationModel {
  struct Values {
    ViewValues view;
    PriorValues prior;
  };
  Values values;
  std::vector<Values> derivatives;  // one per gradient parameter
  MechanicsBatch mechanics;         // that they come from
  Eigen::MatrixXd balance;          // balance_of these
};

/// What brings the columns of G at each state to one size, so that their rank does not depend on the units of coordinates: 1/√M_jj, to
/// the nearest power of 1024, which changes no bit where units are usual ones (nq × N).
Eigen::MatrixXd balance_of(const MechanicsBatch& mechanics);

/// Of some states of each Observations, [group][state].
Linearisation take(const Linearisation& of, const std::vector<std::vector<int>>& states);
/// Of one group, states first … first + n − 1.
Linearisation::OfGroup slice(const Linearisation::OfGroup& of, Eigen::Index first, Eigen::Index n);

/// The first fault of the mechanics or the prior, and the Observations that has it.
struct ModelFault {
  std::size_t group = 0;
  MechanicsBatch::Fault fault;
};

/// @param about   where a nonlinear prior is linearised; null: where no latent acts
/// @param models  receives one per Observations; what it held is memory to be used again
/// @returns nothing where there is no fault at any state.
std::optional<ModelFault> model_observations(const Prior& prior, const std::vector<Observations>& observations,
                                             const Eigen::VectorXd& parameters, const std::vector<int>& gradient_parameters,
                                             const Linearisation* about, std::vector<ObservationModel>& models);

/// The same, where a fault is an error.
/// @throws InputError as require_mechanics of the prior.
std::vector<ObservationModel> require_models(const Prior& prior, const std::vector<Observations>& observations,
                                             const Eigen::VectorXd& parameters, const Linearisation* about);

}  // namespace gp2
