#include "gp2/predictor.hpp"

#include <cmath>
#include <utility>
#include <vector>

#include "base/not_a_number.hpp"
#include "gp2/error.hpp"
#include "inference/predictor_component.hpp"
#include "inference/requirements.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Status = Predictor::Status;

Predictor::Predictor(const Posterior& posterior)
    : Predictor(posterior, View::constrained_acceleration(*posterior.prior().system)) {}
Predictor::Predictor(const Posterior& posterior, View view) : Predictor(posterior, std::move(view), Options()) {}
Predictor::Predictor(const Posterior& posterior, View view, Options options) {
  require_view(posterior.prior(), view);
  for (const auto& component : posterior.conditioned()) {
    const auto own = std::make_shared<Implementation>(*component, view, options);
    if (components_.empty()) own->distance = DataDistance(*component, view);
    components_.push_back(own);
  }
}

Predictor::Workspace::Workspace(const Predictor& predictor) {
  static_cast<void>(predictor.implementation());  // it was not moved away
  for (const auto& component : predictor.components_) components_.push_back(std::make_unique<Implementation>(component));
}
Predictor::Workspace::~Workspace() = default;
Predictor::Workspace::Workspace(Workspace&&) noexcept = default;
Predictor::Workspace& Predictor::Workspace::operator=(Workspace&&) noexcept = default;

const Predictor::Implementation& Predictor::implementation() const {
  if (components_.empty()) throw_moved("Predictor");
  return *components_.front();
}
const View& Predictor::view() const { return implementation().view; }
const Predictor::Options& Predictor::options() const { return implementation().options; }

namespace {

using WorkspaceParts = std::vector<std::unique_ptr<Predictor::Workspace::Implementation>>;

void check_arguments(const Predictor::Implementation& predictor, const Ref<const VectorXd>& state,
                     const WorkspaceParts& workspace) {
  if (workspace.empty() || workspace.front()->predictor.get() != &predictor) {
    throw InputError("Predictor: the workspace is of another predictor; use make_workspace() of this one");
  }
  require_size("Predictor", "a state", state.size(), predictor.prior.system->layout().size());
}
void check_arguments(const Predictor::Implementation& predictor, const Ref<const VectorXd>& state, const Ref<VectorXd>& mean,
                     const WorkspaceParts& workspace) {
  check_arguments(predictor, state, workspace);
  require_size("Predictor", "the mean", mean.size(), predictor.view.size());
}

// of rows r and s ≤ r of the view: of one component, or of their mixture, whose mean is given
double covariance_of(const WorkspaceParts& components, const Ref<VectorXd>& mean, Index r, Index s) {
  double sum = 0;
  for (const auto& w : components) {
    sum += w->covariance(r, s);
    if (components.size() > 1) sum += (w->mean[r] - mean[r]) * (w->mean[s] - mean[s]);
  }
  return r == s && sum < 0 ? 0 : sum / static_cast<double>(components.size());
}

// NaN in the place of numbers of which one overflowed
Status finite_or_none(Ref<VectorXd> mean, Ref<MatrixXd> uncertainty) {
  if (is_finite(mean) && is_finite(uncertainty)) return Status::ok;
  mean.setConstant(not_a_number);
  uncertainty.setConstant(not_a_number);
  return Status::not_finite;
}

}  // namespace

// evaluate(component, its memory, its mean) of each, and the mean of their means; NaN where one has none
template <typename Evaluate>
Status Predictor::for_each_component(Workspace& workspace, Ref<VectorXd>& mean, const Evaluate& evaluate) const {
  if (components_.size() == 1) return evaluate(*components_.front(), *workspace.components_.front(), mean);
  mean.setZero();
  for (std::size_t k = 0; k < components_.size(); ++k) {
    Workspace::Implementation& w = *workspace.components_[k];
    const Status status = evaluate(*components_[k], w, w.mean);
    if (status != Status::ok) {
      mean.setConstant(not_a_number);
      return status;
    }
    mean += w.mean;
  }
  mean /= static_cast<double>(components_.size());
  if (is_finite(mean)) return Status::ok;  // else the sum overflows
  mean.setConstant(not_a_number);
  return Status::not_finite;
}

Status Predictor::mean(const Ref<const VectorXd>& state, Ref<VectorXd> mean, Workspace& workspace) const {
  check_arguments(implementation(), state, mean, workspace.components_);
  return for_each_component(workspace, mean, [&](const Implementation& self, Workspace::Implementation& w, Ref<VectorXd> mean_k) {
    return self.write_mean(state, *w.values, w, mean_k);
  });
}

Status Predictor::evaluate_covariance(const Ref<const VectorXd>& state, Ref<VectorXd>& mean, Workspace& workspace) const {
  if (!options().stddev) throw InputError("Predictor: it was made without standard deviations");
  check_arguments(implementation(), state, mean, workspace.components_);
  return for_each_component(workspace, mean, [&](const Implementation& self, Workspace::Implementation& w, Ref<VectorXd> mean_k) {
    const Status status = self.write_mean(state, *w.values, w, mean_k);
    if (status == Status::ok) self.write_covariance(*w.values, w);
    return status;
  });
}

Status Predictor::mean_and_stddev(const Ref<const VectorXd>& state, Ref<VectorXd> mean, Ref<VectorXd> stddev,
                                  Workspace& workspace) const {
  require_size("Predictor", "the standard deviation", stddev.size(), view().size());
  const Status status = evaluate_covariance(state, mean, workspace);
  if (status != Status::ok) {
    stddev.setConstant(not_a_number);
    return status;
  }
  for (Index r = 0; r < stddev.size(); ++r) stddev[r] = std::sqrt(covariance_of(workspace.components_, mean, r, r));
  return finite_or_none(mean, stddev);
}

Status Predictor::mean_and_covariance(const Ref<const VectorXd>& state, Ref<VectorXd> mean, Ref<MatrixXd> covariance,
                                      Workspace& workspace) const {
  require_size("Predictor", "a column of the covariance", covariance.rows(), view().size());
  require_size("Predictor", "a row of the covariance", covariance.cols(), view().size());
  const Status status = evaluate_covariance(state, mean, workspace);
  if (status != Status::ok) {
    covariance.setConstant(not_a_number);
    return status;
  }
  for (Index r = 0; r < covariance.rows(); ++r) {
    for (Index s = 0; s <= r; ++s) covariance(r, s) = covariance(s, r) = covariance_of(workspace.components_, mean, r, s);
  }
  return finite_or_none(mean, covariance);
}

Status Predictor::mean_and_jacobian(const Ref<const VectorXd>& state, Ref<VectorXd> mean, Ref<MatrixXd> jacobian,
                                    Workspace& workspace) const {
  if (!options().jacobian) throw InputError("Predictor: it was made without its Jacobian");
  check_arguments(implementation(), state, mean, workspace.components_);
  require_size("Predictor", "a column of the Jacobian", jacobian.rows(), view().size());
  require_size("Predictor", "a row of the Jacobian", jacobian.cols(), state.size());
  const bool is_mixture = components_.size() > 1;
  if (is_mixture) jacobian.setZero();
  Status status =
      for_each_component(workspace, mean, [&](const Implementation& self, Workspace::Implementation& w, Ref<VectorXd> mean_k) {
        StateEvaluator& at = *w.values_and_derivatives;
        const Status of_one = self.write_mean(state, at, w, mean_k);
        if (of_one != Status::ok) return of_one;
        self.write_jacobian(state, at, w, is_mixture ? Ref<MatrixXd>(w.jacobian) : jacobian);
        if (is_mixture) jacobian += w.jacobian / static_cast<double>(components_.size());
        return is_finite(jacobian) ? Status::ok : Status::not_finite;
      });
  if (status == Status::ok) return status;
  mean.setConstant(not_a_number);
  jacobian.setConstant(not_a_number);
  return status;
}

double Predictor::distance_from_data(const Ref<const VectorXd>& state, Workspace& workspace) const {
  check_arguments(implementation(), state, workspace.components_);
  return implementation().distance_at(state, *workspace.components_.front());
}

}  // namespace gp2
