#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "inference/dense_gram.hpp"
#include "inference/latent_sums.hpp"
#include "inference/nonlinear_motion.hpp"
#include "inference/posterior_implementation.hpp"

// The posterior of a prior that is nonlinear in its latents, by Laplace's approximation.
namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// Latents at the observed states, [group][latent], with f = K w.
struct LatentValues {
  std::vector<std::vector<MatrixXd>> f, w;  // (functions × N)

  // f + t (to − f)
  [[nodiscard]] LatentValues towards(const LatentValues& to, double t) const {
    LatentValues between = *this;
    for (std::size_t g = 0; g < f.size(); ++g) {
      for (std::size_t a = 0; a < f[g].size(); ++a) {
        between.f[g][a] += t * (to.f[g][a] - f[g][a]);
        between.w[g][a] += t * (to.w[g][a] - w[g][a]);
      }
    }
    return between;
  }
  // |f − other|², as the prior measures functions: (f − other)ᵀK⁻¹(f − other)
  [[nodiscard]] double squared_distance(const LatentValues& other) const {
    double sum = 0;
    for (std::size_t g = 0; g < f.size(); ++g) {
      for (std::size_t a = 0; a < f[g].size(); ++a) {
        sum += (f[g][a] - other.f[g][a]).cwiseProduct(w[g][a] - other.w[g][a]).sum();
      }
    }
    return std::max(sum, 0.0);  // but for rounding
  }
};

/// What observations say of the latents of a nonlinear prior.
class NonlinearFit {
 public:
  explicit NonlinearFit(Posterior::Implementation& self) : self_(self) {
    for (const Observations& group : self.observations) {
      OfGroup& of = groups_.emplace_back();
      const Prior& there = prior_of(self.prior, group.view());
      of.parameters = parameters_of(group.view(), self.values.parameters);
      of.mechanics = std::make_unique<MechanicsBatch>(require_mechanics(there, group.view(), group.states(), of.parameters));
      of.motion = std::make_unique<NonlinearMotion>(there, group.states(), of.parameters, *of.mechanics,
                                                    require_prior_values(there, group.states(), of.parameters, *of.mechanics));
      of.view = evaluate_view(group.view(), *of.mechanics, group.states());
    }
  }

  [[nodiscard]] LatentValues zero() const {
    LatentValues zero;
    for (const Observations& group : self_.observations) {
      auto& f = zero.f.emplace_back();
      for (const MatrixXd& C : self_.C) f.emplace_back(MatrixXd::Zero(C.cols(), group.n_data()));
      zero.w.push_back(f);
    }
    return zero;
  }

  // Nothing where some state has no motion.
  [[nodiscard]] std::shared_ptr<const Linearisation> about(const LatentValues& at) const {
    auto linearisation = std::make_shared<Linearisation>();
    for (std::size_t g = 0; g < groups_.size(); ++g) {
      Linearisation::OfGroup& of = linearisation->groups.emplace_back();
      for (std::size_t a = 0; a < self_.C.size(); ++a) of.signals.push_back(self_.C[a] * at.f[g][a]);
      if (groups_[g].motion->solve(of)) return nullptr;
    }
    return linearisation;
  }

  // ½ |f|² + ½ Σ |S^{-1/2}(y − v(f))|²
  [[nodiscard]] double objective(const LatentValues& at, const Linearisation& about) const {
    double sum = at.squared_distance(zero());
    for (std::size_t g = 0; g < groups_.size(); ++g) {
      const Observations& group = self_.observations[g];
      ViewValues view = groups_[g].view;
      PriorValues prior;
      groups_[g].motion->linearise(group.view(), about.groups[g], view, prior);
      if (prior.fault) return std::numeric_limits<double>::infinity();
      for (int i = 0; i < group.n_data(); ++i) {
        VectorXd a_bar = prior.mean.col(i);
        for (std::size_t a = 0; a < self_.C.size(); ++a) a_bar += prior.E(a, i) * about.groups[g].signals[a].col(i);
        const VectorXd missing = group.values().col(i) - view.G(i) * a_bar - view.offset.col(i);
        const VectorXd noise = group.noise_at(self_.values.noise_stddev[g], i);
        for (Index k = 0; k < noise.size(); ++k) {
          if (std::isfinite(noise[k]) && !std::isnan(missing[k])) sum += std::pow(missing[k] / noise[k], 2);
        }
      }
    }
    return 0.5 * sum;
  }

  // The posterior mean of the linear prior that `self` is conditioned under.
  [[nodiscard]] LatentValues mean() const {
    LatentValues mean = zero();
    std::vector<MatrixXd> features;
    for (const LatentPosterior::Basis& basis : self_.latents->latents()) features.push_back(basis.kernel.features());
    LatentSums sums(*self_.latents);
    sums.evaluate(features, std::nullopt);
    for (std::size_t s = 0; s < self_.samples.size(); ++s) {
      const Posterior::Implementation::Sample& sample = self_.samples[s];
      const auto g = static_cast<std::size_t>(sample.group);
      const auto i = static_cast<Index>(sample.number - first_of_[g]), j = static_cast<Index>(s);
      for (std::size_t a = 0; a < self_.C.size(); ++a) {
        mean.f[g][a].col(i) = sums.mean()[a].col(j);
        mean.w[g][a].col(i) = self_.latents->latents()[a].beta.row(j).transpose();
      }
    }
    return mean;
  }

  // conditions `self` under the linear prior
  void condition(std::shared_ptr<const Linearisation> about) {
    self_.about = std::move(about);
    self_.latents = nullptr;
    self_.samples.clear();
    self_.next_number = 0;
    self_.add_samples(self_.observations, self_.values.noise_stddev, 0);
    first_of_.assign(1, 0);
    for (const Observations& group : self_.observations) first_of_.push_back(first_of_.back() + group.n_data());
  }

 private:
  struct OfGroup {
    VectorXd parameters;
    std::unique_ptr<MechanicsBatch> mechanics;
    std::unique_ptr<NonlinearMotion> motion;
    ViewValues view;
  };

  Posterior::Implementation& self_;
  std::vector<OfGroup> groups_;
  std::vector<std::int64_t> first_of_;
};

}  // namespace

void Posterior::Implementation::condition_nonlinear() {
  constexpr int most = 100;
  constexpr double enough = 1e-7;  // of the size of the latents, as the prior measures it, which knows hardly more digits
  NonlinearFit fit(*this);
  LatentValues at = fit.zero();
  std::shared_ptr<const Linearisation> linearisation = fit.about(at);
  if (!linearisation) static_cast<void>(require_models(prior, observations, values.parameters, nullptr));  // names the state
  double objective = fit.objective(at, *linearisation);
  for (int step = 0; step < most; ++step) {
    try {
      fit.condition(linearisation);
    } catch (const NumericalError&) {
      if (step == 0) throw;
      break;  // next to a jam slopes have no bound
    }
    const LatentValues target = fit.mean();
    const double distance = std::sqrt(target.squared_distance(at) / (1 + target.squared_distance(fit.zero())));
    if (distance <= enough) return;
    // as far towards the optimum of the linear one as the nonlinear one gets better
    double t = 1;
    for (; t > 1e-10; t /= 2) {
      LatentValues next = at.towards(target, t);
      const auto there = fit.about(next);
      if (!there) continue;
      const double lower = fit.objective(next, *there);
      if (!(lower < objective)) continue;
      at = std::move(next);
      linearisation = there;
      objective = lower;
      break;
    }
    if (t > 1e-10) continue;
    if (distance <= 1e-4) return;  // rounding of the objective
    break;
  }
  Index n_values = 0;
  for (const Observations& group : observations) n_values += group.values().size();
  throw NumericalError(fmt::format(
      "the posterior of latents that enter nonlinearly was not found: Gauss–Newton steps leave {:.3g} times the "
      "noise unexplained: do the signs of the directions, and what is known, fit the machine? Else write the directions so "
      "that the coefficients are small, or start from smaller signal standard deviations",
      std::sqrt(2 * objective / static_cast<double>(n_values))));
}

std::shared_ptr<const Linearisation> linearisation_of(const Prior& prior, const std::vector<Observations>& observations,
                                                      const ModelValues& values) {
  Posterior::Implementation self(prior, observations, values);
  self.condition(1);
  return self.about;
}

}  // namespace gp2
