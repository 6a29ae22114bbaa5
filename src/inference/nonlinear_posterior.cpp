#include <algorithm>
#include <atomic>
#include <cmath>
#include <exception>
#include <functional>
#include <limits>
#include <optional>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "base/parallel.hpp"
#include "gp2/error.hpp"
#include "inference/inducing_latents.hpp"
#include "inference/latent_sums.hpp"
#include "inference/nonlinear_motion.hpp"
#include "inference/posterior_implementation.hpp"
#include "inference/reduction.hpp"

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

/// What observations say of the latents of a nonlinear prior, exactly: `self` is conditioned under the linear one.
class ExactFit {
 public:
  using Point = LatentValues;

  explicit ExactFit(Posterior::Implementation& self) : self_(self), noise_stddev_(self.values.noise_stddev) {
    for (const Observations& group : self.observations) {
      OfGroup& of = groups_.emplace_back();
      const Prior& there = prior_of(self.prior, group.view());
      const VectorXd parameters = parameters_of(group.view(), self.values.parameters);
      of.mechanics = std::make_unique<MechanicsBatch>(require_mechanics(there, group.view(), group.states(), parameters));
      of.motion = std::make_unique<NonlinearMotion>(there, group.states(), parameters, *of.mechanics,
                                                    require_prior_values(there, group.states(), parameters, *of.mechanics));
      of.view = evaluate_view(group.view(), *of.mechanics, group.states());
      linear_.emplace_back().balance = balance_of(*of.mechanics);
    }
  }

  /// Of the values that are given.
  void scale_noise(double factor) {
    noise_stddev_ = self_.values.noise_stddev;
    for (VectorXd& stddev : noise_stddev_) stddev *= factor;
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

  // ½ |f|² + ½ Σ |S^{-1/2}(y − v(f))|², v linear about `about`: of a linearisation about f itself the nonlinear one
  [[nodiscard]] double objective(const LatentValues& at, const Linearisation& about) {
    for (std::size_t g = 0; g < groups_.size(); ++g) {
      ObservationModel::Values& values = linear_[g].values;
      values.view = groups_[g].view;
      groups_[g].motion->linearise(self_.observations[g].view(), about.groups[g], values.view, values.prior);
      if (values.prior.fault) return std::numeric_limits<double>::infinity();
    }
    reduce(self_.prior, self_.observations, linear_, noise_stddev_, reduction_);
    VectorXd missing = VectorXd::Zero(reduction_.size());
    if (!reduction_.sums) missing = reduction_.y;
    double sum = at.squared_distance(zero());
    for (Index s = 0; s < reduction_.n_samples(); ++s) {
      const Reduction::Sample& sample = reduction_.samples[static_cast<std::size_t>(s)];
      const std::vector<Index> rows = rows_of_samples(reduction_, {s});
      for (std::size_t a = 0; a < self_.C.size(); ++a) {
        const VectorXd signal = self_.C[a] * at.f[static_cast<std::size_t>(sample.group)][a].col(sample.index);
        for (const Index row : rows) missing[row] -= reduction_.directions[a].row(row).dot(signal);
      }
      sum += sample.e_out.squaredNorm();
    }
    if (reduction_.sums) {
      missing = (reduction_.sums->D * missing).eval();
      reduction_.sums->whiten(missing);
      missing += reduction_.y;
    }
    return 0.5 * (sum + missing.squaredNorm());
  }

  // The posterior mean of the linear prior that condition() was given.
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
    self_.add_samples(self_.observations, noise_stddev_, 0);
    first_of_.assign(1, 0);
    for (const Observations& group : self_.observations) first_of_.push_back(first_of_.back() + group.n_data());
  }

 private:
  struct OfGroup {
    std::unique_ptr<MechanicsBatch> mechanics;
    std::unique_ptr<NonlinearMotion> motion;
    ViewValues view;
  };

  Posterior::Implementation& self_;
  std::vector<VectorXd> noise_stddev_;
  std::vector<OfGroup> groups_;
  std::vector<ObservationModel> linear_;  // of the last objective, and its rows
  Reduction reduction_;
  std::vector<std::int64_t> first_of_;
};

/// Whitened inducing variables m.
struct InducingValues {
  VectorXd m;

  [[nodiscard]] InducingValues towards(const InducingValues& to, double t) const { return {m + t * (to.m - m)}; }
  [[nodiscard]] double squared_distance(const InducingValues& other) const { return (m - other.m).squaredNorm(); }
};

/// What observations say of the inducing variables of a nonlinear prior. Rows about m are those of a linear prior, exact at m, so that
/// one pass over them has the objective there and all that the step from there needs.
class FitThroughPoints {
 public:
  using Point = InducingValues;

  FitThroughPoints(const Prior& prior, const std::vector<Observations>& observations, const ModelValues& values,
                   const InducingLatents& latents, const Workers& workers)
      : prior_(prior), observations_(observations), given_(values), values_(values), latents_(latents), workers_(workers) {}

  void scale_noise(double factor) {
    values_.noise_stddev = given_.noise_stddev;
    for (VectorXd& stddev : values_.noise_stddev) stddev *= factor;
  }

  [[nodiscard]] InducingValues zero() const { return {VectorXd::Zero(latents_.size())}; }

  // Nothing where some state has no motion.
  [[nodiscard]] std::shared_ptr<const Linearisation> about(const InducingValues& at) const {
    return linearise_through_points(prior_, observations_, values_, latents_, at.m, workers_);
  }

  // ½ |m|² + ½ Σ |S^{-1/2}(y − v(m))|², v as in ExactFit, S enlarged by what points leave of local latents
  [[nodiscard]] double objective(const InducingValues& at, const Linearisation& about) {
    struct Sum {
      InducingStatistics of_blocks;
      double misfit = 0;
      void add(const Sum& other) {
        of_blocks.add(other.of_blocks);
        misfit += other.misfit;
      }
      void for_each(const std::function<void(double*, Index)>& take) {
        of_blocks.for_each(take);
        take(&misfit, 1);
      }
    };
    std::optional<Sum> sum = sum_over_blocks(latents_, BlocksOfStates(prior_, observations_, values_, &about), false, workers_,
                                             nullptr, Sum{InducingStatistics(latents_)},
                                             [&](Sum& of_piece, int, const RowBlock& rows, const InducingBlock& block) {
                                               of_piece.of_blocks.add(latents_, block);
                                               of_piece.misfit += block.misfit(at.m).squaredNorm();
                                               for (const Reduction::Sample& sample : rows.rows.reduction->samples)
                                                 of_piece.misfit += sample.e_out.squaredNorm();
                                             });
    if (!sum) return std::numeric_limits<double>::infinity();
    linear_ = std::move(sum->of_blocks);
    return 0.5 * (at.m.squaredNorm() + sum->misfit);
  }

  [[nodiscard]] InducingValues mean() const { return {mean_}; }

  // of the linear prior whose objective was the last
  void condition(const std::shared_ptr<const Linearisation>& /*about*/) {
    linear_.B.diagonal().array() += 1;
    if (!lapack::factorise(linear_.B)) throw_not_definite();
    mean_ = std::move(linear_.c);
    lapack::solve_factored(linear_.B, mean_);
  }

 private:
  const Prior& prior_;
  const std::vector<Observations>& observations_;
  const ModelValues& given_;
  ModelValues values_;
  const InducingLatents& latents_;
  const Workers& workers_;
  InducingStatistics linear_;
  VectorXd mean_;
};

// `at` with the noise of soft constraints about another.
Linearisation with_noise_about(Linearisation at, const Linearisation& other) {
  for (std::size_t g = 0; g < at.groups.size(); ++g) {
    at.groups[g].noise_about = std::make_shared<const Linearisation::OfGroup>(other.groups[g]);
  }
  return at;
}

// A posterior mean of a nonlinear prior.
struct NonlinearMean {
  std::shared_ptr<const Linearisation> about;
  double left = 0;  // of the data, in spreads of a value, the prior's share among it: about one at most where the prior is right
};

// Gauss–Newton steps to a posterior mean, each to the one of the linear prior about where the last has led.
// @param from  where they begin: at the mean of the linear prior there; null: where no latent acts
template <typename NonlinearFit>
NonlinearMean step_to_mean(NonlinearFit& fit, const Prior& prior, const std::vector<Observations>& observations,
                           const ModelValues& values, const std::shared_ptr<const Linearisation>& from) {
  constexpr int most = 100;
  constexpr double enough = 1e-7;  // of the size of the latents, as the prior measures it, which knows hardly more digits
  typename NonlinearFit::Point at = fit.zero();
  std::shared_ptr<const Linearisation> linearisation;
  if (from) {
    static_cast<void>(fit.objective(at, *from));
    fit.condition(from);
    if (typename NonlinearFit::Point mean = fit.mean(); (linearisation = fit.about(mean))) at = std::move(mean);
  }
  if (!linearisation) linearisation = fit.about(at);
  if (!linearisation) static_cast<void>(require_models(prior, observations, values.parameters, nullptr));  // names the state
  double objective = fit.objective(at, *linearisation);
  Index n_values = 0;
  for (const Observations& group : observations) {
    n_values += group.has_sums() ? std::ssize(group.sums()) : (!group.values().array().isNaN()).count();
  }
  const auto found = [&] {
    return NonlinearMean{linearisation, std::sqrt(2 * objective / static_cast<double>(std::max<Index>(1, n_values)))};
  };
  const bool is_soft = std::ranges::any_of(
      observations, [&](const Observations& group) { return prior_of(prior, group.view()).system->has_constraint_noise(); });
  bool is_in_kink = false;
  for (int step = 0; step < most; ++step) {
    try {
      fit.condition(linearisation);
    } catch (const NumericalError&) {
      if (step == 0) throw;
      break;  // next to a jam slopes have no bound
    }
    const typename NonlinearFit::Point target = fit.mean();
    const double distance = std::sqrt(target.squared_distance(at) / (1 + target.squared_distance(fit.zero())));
    if (distance <= enough) return found();
    // as far towards the optimum of the linear one as the nonlinear one gets better
    double t = 1;
    for (; t > 1e-10; t /= 2) {
      typename NonlinearFit::Point next = at.towards(target, t);
      const auto there = fit.about(next);
      if (!there) continue;
      // the noise of soft constraints follows f, but within a step it stays
      const std::optional<Linearisation> held = is_soft ? std::optional(with_noise_about(*there, *linearisation)) : std::nullopt;
      const double lower = fit.objective(next, held ? *held : *there);
      if (!(lower < objective)) continue;
      at = std::move(next);
      linearisation = there;
      objective = is_soft ? fit.objective(at, *linearisation) : lower;
      break;
    }
    if (t > 1e-10) continue;
    // rounding of the objective, or a kink, where a load changes its sign at an observed state: right to a fifth of a deviation
    constexpr double little = 0.02;  // nats
    if (distance <= 1e-4 || std::abs(objective - fit.objective(target, *linearisation)) <= little) return found();
    is_in_kink = true;
    break;
  }
  const double left = found().left;
  if (is_in_kink && left < 2) {
    throw NumericalError(
        fmt::format("the posterior of latents that enter nonlinearly was not found: Gauss–Newton steps explain the data, but for "
                    "{:.3g} times the noise, and go back and forth: where a load changes its sign write directions without a "
                    "kink, sqrt(lambda(1)^2 + 0.01) in place of abs(lambda(1)), say",
                    left));
  }
  throw NumericalError(fmt::format(
      "the posterior of latents that enter nonlinearly was not found: Gauss–Newton steps leave {:.3g} times the "
      "noise unexplained: do the signs of the directions, and what is known, fit the machine (known forces count with `mean` "
      "force)? Else write the directions so "
      "that the coefficients are small, or start from smaller signal standard deviations",
      left));
}

// The posterior mean, that `fit` is conditioned at in the end. There may be several; steps from where no latent acts end at one that leaves
// much of the data to noise where a load is far from that of known forces. Under more noise there are fewer, and the one of less noise lies
// near that of more.
template <typename NonlinearFit>
std::shared_ptr<const Linearisation> find_mean(NonlinearFit& fit, const Prior& prior,
                                               const std::vector<Observations>& observations, const ModelValues& values) {
  constexpr double much = 1.5;
  const auto steps = [&](const std::shared_ptr<const Linearisation>& from) {
    return step_to_mean(fit, prior, observations, values, from);
  };
  std::optional<NonlinearMean> direct;
  std::exception_ptr failure;
  try {
    direct = steps(nullptr);
  } catch (const NumericalError&) {
    failure = std::current_exception();
  }
  if (direct && direct->left <= much) return direct->about;
  try {
    NonlinearMean along;
    for (const double more : {30, 10, 3, 1}) {
      fit.scale_noise(more);
      along = steps(along.about);
    }
    if (!direct || along.left < direct->left) return along.about;
  } catch (const NumericalError&) {
    fit.scale_noise(1);
    if (!direct) std::rethrow_exception(failure);
  }
  return steps(direct->about).about;
}

}  // namespace

void Posterior::Implementation::condition_nonlinear() {
  ExactFit fit(*this);
  static_cast<void>(find_mean(fit, prior, observations, values));
}

std::shared_ptr<const Linearisation> linearise_through_points(const Prior& prior, const std::vector<Observations>& observations,
                                                              const ModelValues& values, const InducingLatents& latents,
                                                              const VectorXd& m, const Workers& workers) {
  auto linearisation = std::make_shared<Linearisation>();
  for (const Observations& group : observations) {
    const Prior& there = prior_of(prior, group.view());
    Linearisation::OfGroup& of_group = linearisation->groups.emplace_back();
    for (const Latent& latent : there.latents) of_group.signals.emplace_back(latent.size(), group.n_data());
    of_group.multipliers.resize(there.system->nc(), group.n_data());
  }
  const BlocksOfStates blocks(prior, observations, values, nullptr);
  std::atomic<bool> is_sound = true;
  parallel_for(static_cast<int>(blocks.n_blocks()), workers.n_threads, [&](int b, int) {
    if (!is_sound) return;
    const auto& [g, first, n] = blocks.states(b);
    const Prior& there = prior_of(prior, observations[g].view());
    const auto states = observations[g].states().middleCols(first, n);
    std::vector<MatrixXd> features;
    for (std::size_t a = 0; a < there.latents.size(); ++a) features.push_back(evaluate_features(there, a, states));
    const std::vector<MatrixXd> f = latents.at(features, m);
    for (std::size_t a = 0; a < f.size(); ++a) {
      linearisation->groups[g].signals[a].middleCols(first, n).noalias() = values.loading(a) * f[a];
    }
    if (!blocks.solve_multipliers(b, *linearisation)) is_sound = false;
  });
  return is_sound ? linearisation : nullptr;
}

std::shared_ptr<const Linearisation> linearisation_of(const Prior& prior, const std::vector<Observations>& observations,
                                                      const ModelValues& values, const Workers& workers) {
  const lapack::SingleThread single_thread;
  if (values.inducing) {
    const InducingLatents latents(prior, values);
    FitThroughPoints fit(prior, observations, values, latents, workers);
    return find_mean(fit, prior, observations, values);
  }
  Posterior::Implementation self(prior, observations, values);
  self.condition(1);
  return self.about;
}

}  // namespace gp2
