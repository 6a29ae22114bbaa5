#include "inference/observation_model.hpp"

#include <algorithm>
#include <cmath>
#include <optional>

#include "gp2/error.hpp"
#include "inference/nonlinear_motion.hpp"
#include "mechanics/describe_fault.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// which parameter of the viewed system the fitted system's is, −1: none
int index_there(const View& view, int parameter) {
  if (!view.other_system) return parameter;
  const std::vector<int>& shared = view.other_system->shared;
  const auto found = std::find(shared.begin(), shared.end(), parameter);
  return found == shared.end() ? -1 : static_cast<int>(found - shared.begin());
}

template <typename Which>
Linearisation::OfGroup columns(const Linearisation::OfGroup& of, const Which& which) {
  Linearisation::OfGroup out;
  for (const MatrixXd& s : of.signals) out.signals.emplace_back(s(Eigen::all, which));
  out.multipliers = of.multipliers(Eigen::all, which);
  if (of.noise_about) out.noise_about = std::make_shared<const Linearisation::OfGroup>(columns(*of.noise_about, which));
  return out;
}

ObservationModel::Values zero_like(ObservationModel::Values values) {
  for (MatrixXd* of_view : {&values.view.matrix, &values.view.offset, &values.view.slip}) of_view->setZero();
  values.prior.mean.setZero();
  for (MatrixXd& E : values.prior.directions) E.setZero();
  return values;
}

}  // namespace

Linearisation take(const Linearisation& of, const std::vector<std::vector<int>>& states) {
  Linearisation taken;
  for (std::size_t g = 0; g < of.groups.size(); ++g) taken.groups.push_back(columns(of.groups[g], states[g]));
  return taken;
}

Linearisation::OfGroup slice(const Linearisation::OfGroup& of, Index first, Index n) {
  return columns(of, Eigen::seqN(first, n));
}

MatrixXd balance_of(const MechanicsBatch& mechanics) {
  const auto of_mass = [](double m) { return std::ldexp(1, -10 * static_cast<int>(std::lround(std::ilogb(m) / 20.0))); };
  MatrixXd balance(mechanics.values.force.rows(), mechanics.values.n_states());
  for (Index i = 0; i < balance.cols(); ++i) {
    balance.col(i) = mechanics.projections[static_cast<std::size_t>(i)].mass().diagonal().unaryExpr(of_mass);
  }
  return balance;
}

std::optional<ModelFault> model_observations(const Prior& prior, const std::vector<Observations>& observations,
                                             const VectorXd& parameters, const std::vector<int>& gradient_parameters,
                                             const Linearisation* about, std::vector<ObservationModel>& models) {
  models.resize(observations.size());
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const Observations& group = observations[g];
    ObservationModel& model = models[g];
    const Prior& there = prior_of(prior, group.view());
    const VectorXd theta = parameters_of(group.view(), parameters);
    evaluate_mechanics(there, group.view(), group.states(), theta, model.mechanics);
    if (model.mechanics.fault) return ModelFault{g, *model.mechanics.fault};
    model.values = {evaluate_view(group.view(), model.mechanics, group.states()),
                    evaluate_prior(there, group.states(), theta, model.mechanics)};
    if (model.values.prior.fault) return ModelFault{g, *model.values.prior.fault};
    const ViewValues unchanged = there.is_nonlinear() ? model.values.view : ViewValues();
    std::optional<NonlinearMotion> nonlinear;
    Linearisation::OfGroup at;
    if (there.is_nonlinear()) {
      nonlinear.emplace(there, group.states(), theta, model.mechanics, model.values.prior);
      at = about != nullptr ? about->groups[g] : nonlinear->without_signals();
      if (about == nullptr) {
        if (const auto fault = nonlinear->solve(at)) return ModelFault{g, *fault};
      }
      nonlinear->linearise(group.view(), at, model.values.view, model.values.prior);
      if (model.values.prior.fault) return ModelFault{g, *model.values.prior.fault};
    }
    model.derivatives.clear();
    for (int parameter : gradient_parameters) {
      const int index = index_there(group.view(), parameter);
      if (index < 0) {
        model.derivatives.push_back(zero_like(model.values));
        continue;
      }
      const SystemValues d = there.system->differentiate(group.states(), theta, index);
      ObservationModel::Values& of_parameter = model.derivatives.emplace_back();
      of_parameter.view = differentiate_view(group.view(), model.mechanics, d);
      if (nonlinear) {
        nonlinear->differentiate(at, d, index, unchanged, of_parameter.view, of_parameter.prior);
      } else {
        of_parameter.prior = differentiate_prior(there, group.states(), theta, model.mechanics, model.values.prior, d, index);
      }
    }
    model.balance = balance_of(model.mechanics);
    keep_viewed(group.view(), model.values.prior);
    for (ObservationModel::Values& d : model.derivatives) keep_viewed(group.view(), d.prior);
  }
  return std::nullopt;
}

std::vector<ObservationModel> require_models(const Prior& prior, const std::vector<Observations>& observations,
                                             const VectorXd& parameters, const Linearisation* about) {
  std::vector<ObservationModel> models;
  if (const auto found = model_observations(prior, observations, parameters, {}, about, models)) {
    const Observations& group = observations[found->group];
    throw InputError(internal::describe_fault(*prior_of(prior, group.view()).system, group.states(), found->fault));
  }
  return models;
}

}  // namespace gp2
