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
      const std::vector<Observations> of_stage = stages[stage] < n_all ? evenly(observations_, stages[stage]) : observations_;
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
      if (is_last && !is_exact) best = discrepancy_too(of_stage, *std::move(best), options);
      report = std::move(best);
      hyperparameters = report->hyperparameters;
    }
    if (!report->inducing || n_train < n_all) report->inducing = points_of_all(*report);
    report->inducing->left_out =
        is_set(options_.stop) ? left_out_as_some_tell(*report) : left_out(observations_, *report, all_workers());
    report->inducing->n_start = stages.size() > 1 ? n_exact : 0;
    report->inducing->n_starts = stages.size() > 1 ? std::max(1, options_.n_restarts) : 1;
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
      if (h.is_system_parameter() || h.kind == Hyperparameter::Kind::noise_stddev) h.hold();
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
                                      const std::vector<Hyperparameter>& hyperparameters, int of_discrepancy = 0) const {
    ModelValues values = model_values(prior_, observations, hyperparameters);
    const InducingOptions options{.most = options_.n_inducing, .of_discrepancy = of_discrepancy};
    const InducingChoice choice = choose_inducing_points(prior_, observations, values, options, all_workers());
    // how strongly a latent acts that is not linear is known through points alone, and decides where they should be
    values.about = values_through(choice.points, observations, hyperparameters, all_workers()).about;
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

  // An optimum; where it is stopped before there is one, `best`, which is what was found so far.
  [[nodiscard]] FitReport trained_through_choice(const InducingChoice& choice, const std::vector<Observations>& observations,
                                                 const std::vector<Hyperparameter>& from, FitOptions options,
                                                 const std::optional<FitReport>& best) const {
    // a gain of a thousandth of a nat is none
    options.reduction_tolerance = std::max(options.reduction_tolerance, 1e-3 / n_states(observations));
    options.n_restarts = 1;
    options.max_escapes = 0;
    if (options_.improved) {
      options.improved = [&](FitReport so_far, const std::vector<Observations>& of_stage) {
        if (best && !(so_far.objective < best->objective)) return;
        so_far.inducing = points_of(choice);
        so_far.inducing->left_out = left_out_as_some_tell(so_far);
        options_.improved(so_far, of_stage);
      };
    }
    return unless_stopped(best, [&] {
      FitReport report =
          prior_.is_nonlinear()
              ? trained_nonlinear(prior_, observations, from, options,
                                  {choice.points, values_through(choice.points, observations, from, all_workers()).about})
              : trained(prior_, observations, from, options, {choice.points, nullptr});
      report.inducing = points_of(choice);
      return report;
    });
  }

  // With points of its own for a discrepancy, from which hyperparameters are learned anew, where these tell more than that it is
  // there. Else they would take time, and the deviations shrink more than the errors.
  [[nodiscard]] FitReport discrepancy_too(const std::vector<Observations>& observations, FitReport found,
                                          const FitOptions& options) const {
    constexpr int most = 200;
    constexpr double worth = 10;  // nats
    if (std::ranges::none_of(prior_.latents, is_local) || is_set(options.stop)) return found;
    try {
      const InducingChoice choice = chosen(observations, found.hyperparameters, most);
      const FitReport as_it_is = conditioned(choice, observations, found, options);
      if (!(found.objective - as_it_is.objective > worth)) return found;
      FitReport trained = trained_through_choice(choice, observations, found.hyperparameters, options, as_it_is);
      return trained.objective < found.objective ? std::move(trained) : found;
    } catch (const NumericalError&) {  // or stopped
      return found;
    }
  }

  [[nodiscard]] FitReport conditioned(const InducingChoice& choice, const std::vector<Observations>& observations,
                                      const FitReport& found, FitOptions options) const {
    options.max_iterations = 0;
    options.standard_errors = false;
    options.progress = nullptr;
    return trained_through_choice(choice, observations, found.hyperparameters, options, found);
  }

  // Among all states, where hyperparameters come from some.
  [[nodiscard]] InducingReport points_of_all(const FitReport& of_some) const {
    const InducingChoice choice = chosen(observations_, of_some.hyperparameters);
    if (std::ranges::none_of(prior_.latents, is_local)) return points_of(choice);
    FitOptions options = of_stage(0, 1, n_states(observations_));
    options.max_iterations = 0;
    options.standard_errors = false;
    options.improved = nullptr;  // checkpoints are of what is trained
    const FitReport found = conditioned(choice, observations_, of_some, options);
    return *discrepancy_too(observations_, found, options).inducing;
  }

  [[nodiscard]] FitReport through_points(const std::vector<Observations>& observations, std::vector<Hyperparameter> from,
                                         const FitOptions& options) const {
    std::optional<FitReport> best;
    for (int round = 0; round < n_rounds && !(best && is_set(options.stop)); ++round) {
      const InducingChoice choice = chosen(observations, from);
      FitReport next = trained_through_choice(choice, observations, from, options, best);
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
    return left_out_by_points(prior_, observations,
                              values_through(report.inducing->points, observations, report.hyperparameters, workers), workers);
  }

  [[nodiscard]] Workers all_workers() const { return {thread_count(options_.n_threads), options_.ranks}; }

  // With these points, and about the mean of a nonlinear prior under them; where it is not found about where no latent acts.
  [[nodiscard]] ModelValues values_through(const std::shared_ptr<const InducingPoints>& points,
                                           const std::vector<Observations>& observations,
                                           const std::vector<Hyperparameter>& hyperparameters, const Workers& workers) const {
    ModelValues values = model_values(prior_, observations, hyperparameters);
    values.inducing = points;
    if (!prior_.is_nonlinear()) return values;
    try {
      values.about = linearisation_of(prior_, observations, values, workers);
    } catch (const NumericalError&) {  // about is null
    }
    return values;
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
