#include <algorithm>
#include <limits>
#include <utility>

#include "base/parallel.hpp"
#include "data/evenly.hpp"
#include "gp2/error.hpp"
#include "gp2/training/default_hyperparameters.hpp"
#include "inference/inducing_latents.hpp"
#include "inference/posterior_implementation.hpp"
#include "training/optimum.hpp"

namespace gp2 {

using Eigen::VectorXd;

namespace {

// Hyperparameters from few states, exactly, then through inducing points from more and more. The points stay while the optimiser
// runs, are chosen anew where it has ended, and kept where the bound rises. What few states cannot see they turn off, and from
// there no slope leads back: so the first run through points starts from the first values as well, and from what it has ended
// at with that turned on again which it has turned off.
class TrainingThroughPoints {
 public:
  TrainingThroughPoints(const Prior& prior, const std::vector<Observations>& observations, const FitOptions& options)
      : prior_(prior), observations_(observations), options_(options) {}

  FitReport run(std::vector<Hyperparameter> hyperparameters) const {
    const int n_all = n_states(observations_);
    const int n_train = options_.n_train > 0 ? std::min(options_.n_train, n_all) : n_all;
    const bool optimises = options_.max_iterations > 0 && !hyperparameters.empty();
    for (Hyperparameter& h : hyperparameters) {
      const bool is_of_latent = h.kind == Hyperparameter::Kind::shared_signal_stddev;
      if (is_of_latent && h.hyperprior.form != HyperPrior::Form::none &&
          is_local(prior_.latents[static_cast<std::size_t>(h.owner)]))
        h.hyperprior.stddev = Protocol::Standard::discrepancy_log_stddev_of_many;
    }
    const int n_exact = states_of_exact(hyperparameters);
    const std::vector<Hyperparameter> first = hyperparameters;
    std::vector<int> stages;
    for (int n = n_exact; optimises && n < n_train && (n == n_exact || n <= n_train / 4); n *= 25) stages.push_back(n);
    stages.push_back(n_train);
    const bool draws = options_.n_draws > 0 && optimises;
    const std::size_t n_stages = stages.size() + (draws ? 1 : 0);
    std::optional<FitReport> report;
    for (std::size_t stage = 0; stage < stages.size() && !(report && is_set(options_.stop)); ++stage) {
      const bool is_last = stage + 1 == stages.size(), is_exact = stages[stage] <= n_exact && stages[stage] < n_all;
      FitOptions options = of_stage(stage, n_stages, stages[stage]);
      options.standard_errors = options.standard_errors && is_last;
      const std::vector<Observations> some =
          stages[stage] < n_all ? evenly(observations_, stages[stage]) : std::vector<Observations>();
      const std::vector<Observations>& of_stage = stages[stage] < n_all ? some : observations_;
      std::optional<FitReport> best;
      const auto try_from = [&](const std::vector<Hyperparameter>& start, bool may_fail) {
        if (best && is_set(options_.stop)) return;
        try {
          FitReport found = unless_stopped(best ? best : report, [&] {
            return is_exact ? trained_exactly(prior_, of_stage, start, options) : through_points(of_stage, start, options);
          });
          if (!best || found.objective < best->objective) best = std::move(found);
        } catch (const NumericalError&) {
          if (!may_fail) throw;
        }
      };
      const bool has_alternative = stage == 1;
      try_from(hyperparameters, has_alternative);
      if (has_alternative) {
        try_from(first, best.has_value());
        if (const auto start = turned_on(best->hyperparameters, first)) try_from(*start, true);
      }
      report = std::move(best);
      hyperparameters = report->hyperparameters;
    }
    if (!report->inducing || n_train < n_all) report->inducing = points_of(chosen(observations_, hyperparameters));
    report->inducing->left_out =
        is_set(options_.stop) ? left_out_as_some_tell(*report) : left_out(observations_, *report, all_workers());
    report->inducing->n_start = stages.size() > 1 ? n_exact : 0;
    if (draws && !is_set(options_.stop))
      report->draws = drawn(evenly(observations_, n_exact), report->hyperparameters, of_stage(stages.size(), n_stages, n_exact));
    if (is_set(options_.stop)) {
      report->termination = FitReport::interrupted;
      report->converged = false;
    }
    return *std::move(report);
  }

 private:
  // States that tell where hyperparameters stand, in seconds: of a reduced size of about 800.
  [[nodiscard]] int states_of_exact(const std::vector<Hyperparameter>& hyperparameters) const {
    constexpr int reduced_size = 800, most = 400;
    const std::vector<Observations> some = evenly(observations_, most);
    const int size = Likelihood(prior_, some, model_values(prior_, some, hyperparameters), {}).reduced_size();
    return std::max(1, n_states(some) * reduced_size / std::max(size, reduced_size));
  }

  // Of hyperparameters, given few states, exactly. What all states together tell far better than few, the noise and the parameters
  // of the system, stays as it was found.
  [[nodiscard]] std::optional<HyperparameterDraws> drawn(const std::vector<Observations>& some,
                                                         std::vector<Hyperparameter> hyperparameters, FitOptions options) const {
    options.n_draws = options_.n_draws;
    options.standard_errors = false;
    options.improved = nullptr;
    for (Hyperparameter& h : hyperparameters) {
      if (!h.is_system_parameter() && h.kind != Hyperparameter::Kind::noise_stddev) continue;
      if (!h.positive && h.size == 0) h.size = h.upper - h.lower;  // its unit, which a box without width has none of
      h.lower = h.upper = h.value;
    }
    try {
      return trained_exactly(prior_, some, hyperparameters, options).draws;
    } catch (const NumericalError&) {  // or stopped: the fit stands, without draws
      return std::nullopt;
    }
  }

  static constexpr int n_rounds = 3;
  static constexpr double enough = 0.5;  // nats, below which other points are not worth another run

  [[nodiscard]] FitOptions of_stage(std::size_t stage, std::size_t n_stages, int n) const {
    FitOptions options = options_;
    options.n_draws = options.n_inducing = 0;
    if (!options_.progress) return options;
    options.progress = [this, stage, n_stages, n](Progress progress) {
      if (n_stages > 1) progress.n_states = n;
      progress.fraction = (static_cast<double>(stage) + progress.fraction) / static_cast<double>(n_stages);
      options_.progress(progress);
    };
    return options;
  }

  [[nodiscard]] static InducingReport points_of(const InducingChoice& choice) {
    InducingReport report;
    report.points = choice.points;
    report.n_variables = choice.n_variables;
    return report;
  }

  // What `work` gives; where it is stopped before it has anything, what there was before.
  template <typename Work>
  [[nodiscard]] FitReport unless_stopped(std::optional<FitReport> before, const Work& work) const {
    try {
      return work();
    } catch (const NumericalError&) {
      if (!before || !is_set(options_.stop)) throw;
      return *std::move(before);
    }
  }

  [[nodiscard]] InducingChoice chosen(const std::vector<Observations>& observations,
                                      const std::vector<Hyperparameter>& hyperparameters) const {
    ModelValues values = model_values(prior_, observations, hyperparameters);
    const InducingOptions options{.most = options_.n_inducing};
    const InducingChoice choice = choose_inducing_points(prior_, observations, values, options, all_workers());
    // how strongly a latent acts that is not linear is known through points alone, and decides where they should be
    values.about = linearised(observations, hyperparameters, choice.points, all_workers());
    return values.about ? choose_inducing_points(prior_, observations, values, options, all_workers()) : choice;
  }

  // With the signals as they were at first that have all but vanished; none: there are no such.
  [[nodiscard]] static std::optional<std::vector<Hyperparameter>> turned_on(std::vector<Hyperparameter> found,
                                                                            const std::vector<Hyperparameter>& first) {
    constexpr double vanished = 0.01;
    bool is_any = false;
    for (std::size_t k = 0; k < found.size(); ++k) {
      if (found[k].kind != Hyperparameter::Kind::signal_stddev || found[k].value > vanished * first[k].value) continue;
      found[k].value = first[k].value;
      is_any = true;
    }
    return is_any ? std::optional(std::move(found)) : std::nullopt;
  }

  [[nodiscard]] FitReport through_points(const std::vector<Observations>& observations, std::vector<Hyperparameter> from,
                                         FitOptions options) const {
    // a gain of a thousandth of a nat is none
    options.reduction_tolerance = std::max(options.reduction_tolerance, 1e-3 / n_states(observations));
    options.n_restarts = 1;
    options.max_escapes = 0;
    std::optional<FitReport> best;
    for (int round = 0; round < n_rounds && !(best && is_set(options.stop)); ++round) {
      const InducingChoice choice = chosen(observations, from);
      if (options_.improved) {
        options.improved = [&](FitReport so_far, const std::vector<Observations>& of_stage) {
          if (best && !(so_far.objective < best->objective)) return;
          so_far.inducing = points_of(choice);
          so_far.inducing->left_out = left_out_as_some_tell(so_far);
          options_.improved(so_far, of_stage);
        };
      }
      FitReport next = unless_stopped(best, [&] {
        FitReport report = prior_.is_nonlinear()
                               ? trained_nonlinear(prior_, observations, from, options,
                                                   {choice.points, linearised(observations, from, choice.points, all_workers())})
                               : trained(prior_, observations, from, options, {choice.points, nullptr});
        report.inducing = points_of(choice);
        return report;
      });
      const double gain = best ? best->objective - next.objective : std::numeric_limits<double>::infinity();
      const bool are_fewer = best && choice.n_variables < best->inducing->n_variables;
      if (!(gain > (are_fewer ? -enough : 0))) break;
      from = next.hyperparameters;
      best = std::move(next);
      if (gain < enough || options.max_iterations == 0) break;
    }
    return *std::move(best);
  }

  [[nodiscard]] VectorXd left_out(const std::vector<Observations>& observations, const FitReport& report,
                                  const Workers& workers) const {
    ModelValues values = model_values(prior_, observations, report.hyperparameters);
    values.inducing = report.inducing->points;
    values.about = linearised(observations, report.hyperparameters, report.inducing->points, workers);
    return left_out_by_points(prior_, observations, values, workers);
  }

  [[nodiscard]] Workers all_workers() const { return {thread_count(options_.n_threads), options_.ranks}; }

  // Where a nonlinear prior is linear under these points; null, where no latent acts, as long as the mean is not found.
  [[nodiscard]] std::shared_ptr<const Linearisation> linearised(const std::vector<Observations>& observations,
                                                                const std::vector<Hyperparameter>& hyperparameters,
                                                                const std::shared_ptr<const InducingPoints>& points,
                                                                const Workers& workers) const {
    if (!prior_.is_nonlinear()) return nullptr;
    ModelValues values = model_values(prior_, observations, hyperparameters);
    values.inducing = points;
    try {
      return linearisation_of(prior_, observations, values, workers);
    } catch (const NumericalError&) {
      return nullptr;
    }
  }

  // Of all states, while nothing else is under way on other processes.
  [[nodiscard]] VectorXd left_out_as_some_tell(const FitReport& report) const {
    constexpr int few = 5000;
    const std::vector<Observations> some = evenly(observations_, few);
    return static_cast<double>(n_states(observations_)) / n_states(some) *
           left_out(some, report, thread_count(options_.n_threads));
  }

  const Prior& prior_;
  const std::vector<Observations>& observations_;
  const FitOptions& options_;
};

}  // namespace

FitReport trained_through_points(const Prior& prior, const std::vector<Observations>& observations,
                                 const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options) {
  return TrainingThroughPoints(prior, observations, options).run(hyperparameters);
}

}  // namespace gp2
