#include "gp2/baselines/baseline.hpp"

#include <algorithm>
#include <array>
#include <iterator>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/parallel.hpp"
#include "gp2/error.hpp"
#include "inference/requirements.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Kind = Hyperparameter::Kind;

namespace {

// a measured quantity over all observations, one column per sample
template <typename Part>
MatrixXd pooled(const std::vector<Observations>& observations, const Part& part) {
  MatrixXd all;
  for (const Observations& group : observations) {
    const MatrixXd more = part(group);
    all.conservativeResize(more.rows(), all.cols() + more.cols());
    all.rightCols(more.cols()) = more;
  }
  return all;
}

MatrixXd pooled_values(const std::vector<Observations>& observations) {
  return pooled(observations, [](const Observations& group) { return group.values(); });
}

MatrixXd pooled_features(const std::vector<Observations>& observations, const Prior& prior, std::size_t latent) {
  return pooled(observations, [&](const Observations& group) -> MatrixXd {
    return evaluate_features(prior, latent, group.states()).transpose();
  });
}

// of each row; 1 where it is constant, to rounding
VectorXd usable_stddev(const MatrixXd& values) {
  const VectorXd stddev = row_spread(values);
  return (stddev.array() > 0).select(stddev, VectorXd::Ones(stddev.size()));
}

struct Range {
  double initial, lower, upper;
};

// in standard deviations of feature and output: the published code's
constexpr Range lengthscale_range = {1, 0.5, 20}, signal_range = {0.5, 0.1, 1};
// no more than limits of what double precision can hold
constexpr Range mixing_range = {0.5, -1e4, 1e4}, sqrt_kappa_range = {0.5, 1e-8, 1e4};

void set_range(Hyperparameter& h, const Range& range, double scale) {
  h.value = range.initial * scale;
  h.lower = range.lower * scale;
  h.upper = range.upper * scale;
}

// W of the first latent starts as a multiple of the identity, outputs that know nothing of each other but columns that differ;
// the others at zero, as in the published code, which holds them there
void add_loading(const Latent& latent, std::size_t owner, const std::string& prefix, const VectorXd& scale,
                 std::vector<Hyperparameter>& out) {
  for (const LoadingEntry& entry : loading_entries(latent)) {
    const bool is_kappa = entry.kind == LoadingEntry::Kind::sqrt_kappa;
    const std::string& output = latent.column_names[static_cast<std::size_t>(entry.row)];
    Hyperparameter h = Hyperparameter::of(Kind::loading, owner, static_cast<std::size_t>(entry.index_in_loading));
    h.name =
        is_kappa ? fmt::format("{}sqrt_kappa({})", prefix, output) : fmt::format("{}W({},{})", prefix, output, entry.column + 1);
    h.unit = "unit of " + output;
    h.positive = is_kappa;
    h.size = scale[entry.row];
    Range range = is_kappa ? sqrt_kappa_range : mixing_range;
    if (!is_kappa && (entry.row != entry.column || owner > 0)) range.initial = 0;
    set_range(h, range, h.size);
    out.push_back(std::move(h));
  }
}

// the k-th best of one output, added to that of the others
void add(const RestartReport& restart, RestartReport& sum) {
  sum.objective += restart.objective;
  sum.negative_log_likelihood += restart.negative_log_likelihood;
  sum.iterations += restart.iterations;
  sum.evaluations += restart.evaluations;
  sum.failed_evaluations += restart.failed_evaluations;
  sum.converged = sum.converged && restart.converged;
  if (!restart.converged || sum.termination.empty()) sum.termination = restart.termination;
}

// one output of a prior whose latent j acts on output j alone
Fit fit_output(int output, const Prior& prior, const std::vector<Observations>& observations,
               const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options) {
  Prior alone = prior;
  alone.latents = {prior.latents[static_cast<std::size_t>(output)]};
  std::vector<Observations> observed = observations;
  for (Observations& group : observed) {
    View view = group.view();
    view.rows = {output};
    const Noise& noise = group.noise();
    group = {group.states(), std::move(view), group.values().row(output),
             Noise(noise.stddev().segment(output, 1), noise.is_estimated(),
                   noise.has_scale() ? MatrixXd(noise.scale().row(output)) : MatrixXd())};
  }
  std::vector<Hyperparameter> own;
  for (const Hyperparameter& h : hyperparameters) {
    if (h.owner == output) own.push_back(h);
  }
  for (Hyperparameter& h : own) h.owner = 0;
  Fit fitted = fit(alone, observed, own, options);
  for (Hyperparameter& h : fitted.report.hyperparameters) h.owner = output;
  return fitted;
}

// An output after the first that is stopped before it has anything stands where it starts.
FitReport report_of_output(int output, const Prior& prior, const std::vector<Observations>& observations,
                           const std::vector<Hyperparameter>& hyperparameters, FitOptions options) {
  try {
    return fit_output(output, prior, observations, hyperparameters, options).report;
  } catch (const NumericalError&) {
    if (output == 0 || !is_set(options.stop)) throw;
  }
  options.stop = nullptr;
  options.max_iterations = 0;
  return fit_output(output, prior, observations, hyperparameters, options).report;
}

Fit fit_outputs(const Prior& prior, const std::vector<Observations>& observations,
                const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options) {
  const int n_outputs = prior.system->nq();
  FitReport all;
  all.converged = true;
  double best_so_far = 0;
  for (int output = 0; output < n_outputs; ++output) {
    FitOptions own = options;
    own.improved = {};
    if (options.progress) {
      own.progress = [&, output](Progress p) {
        p.best += best_so_far;
        p.seconds += all.seconds;
        p.fraction = (output + p.fraction) / n_outputs;
        options.progress(p);
      };
    }
    FitReport report = report_of_output(output, prior, observations, hyperparameters, own);
    std::stable_sort(report.restarts.begin(), report.restarts.end(),
                     [](const auto& a, const auto& b) { return a.objective < b.objective; });
    RestartReport none;
    none.converged = true;
    all.restarts.resize(report.restarts.size(), none);
    for (std::size_t k = 0; k < report.restarts.size(); ++k) add(report.restarts[k], all.restarts[k]);
    all.hyperparameters.insert(all.hyperparameters.end(), report.hyperparameters.begin(), report.hyperparameters.end());
    all.n_escapes += report.n_escapes;
    all.seconds += report.seconds;
    best_so_far += report.objective;
    if (!options.improved) continue;
    // the outputs that follow stand where they start
    FitReport so_far = all;
    std::copy_if(hyperparameters.begin(), hyperparameters.end(), std::back_inserter(so_far.hyperparameters),
                 [output](const Hyperparameter& h) { return h.owner > output; });
    so_far.objective = so_far.negative_log_likelihood = best_so_far;
    so_far.converged = false;
    so_far.termination = FitReport::interrupted;
    options.improved(so_far, observations);
  }
  const RestartReport& best = all.restarts.front();
  all.negative_log_likelihood = best.negative_log_likelihood;
  all.objective = best.objective;
  const bool interrupted = is_set(options.stop);
  all.converged = best.converged && !interrupted;
  all.termination = interrupted ? FitReport::interrupted : best.termination;
  all.iterations = best.iterations;
  ModelValues values = model_values(prior, observations, all.hyperparameters);
  return {
      interrupted ? Posterior::lazy(prior, observations, std::move(values)) : Posterior(prior, observations, std::move(values)),
      std::move(all)};
}

// a baseline learns every acceleration
void require_accelerations(const Prior& prior, const std::vector<Observations>& observations, const char* function) {
  require_observations(prior, observations);
  require_measured(observations, function);
  const std::vector<int> all = View::constrained_acceleration(*prior.system).rows;
  for (const Observations& group : observations) {
    if (group.view().is_of_ddq() && group.view().rows == all && !group.has_sums()) continue;
    throw InputError(fmt::format(
        "{}: a baseline learns from all {} accelerations in their order, got observations of {} '{}'{}", function, all.size(),
        group.view().rows == all ? "all rows of" : fmt::format("rows {} of", fmt::join(group.view().rows, ", ")),
        group.view().quantity->word(), group.has_sums() ? " with sums" : ""));
  }
}

}  // namespace

Baseline standardised_by(const std::vector<Observations>& observations, const Prior& prior, Baseline::Kind kind) {
  require_accelerations(prior, observations, "standardised_by");
  const MatrixXd features = pooled_features(observations, prior, 0);
  return {kind, row_mean(pooled_values(observations)), features.rowwise().mean(), usable_stddev(features)};
}

std::vector<Hyperparameter> baseline_hyperparameters(const Prior& prior, const std::vector<Observations>& observations) {
  require_accelerations(prior, observations, "baseline_hyperparameters");
  const VectorXd output_stddev = usable_stddev(pooled_values(observations));
  std::vector<Hyperparameter> out;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    const std::string prefix = prior.latents.size() == 1 ? "" : latent.name + ".";
    if (!latent.kernel_is_fixed && !latent.kernel.parameters().empty()) {
      const VectorXd feature_stddev = usable_stddev(pooled_features(observations, prior, a));
      for (std::size_t p = 0; p < latent.kernel.parameters().size(); ++p) {
        const Kernel::Parameter& parameter = latent.kernel.parameters()[p];
        Hyperparameter& h = out.emplace_back(Hyperparameter::of(Kind::kernel, a, p));
        h.name = prefix + parameter.name;
        h.unit = "unit of " + latent.feature_names[static_cast<std::size_t>(parameter.feature)];
        set_range(h, lengthscale_range, feature_stddev[parameter.feature]);
      }
    }
    if (latent.free_loading) {
      add_loading(latent, a, prefix, output_stddev, out);
    } else {
      Hyperparameter& h = out.emplace_back(Hyperparameter::of(Kind::signal_stddev, a, 0));
      h.name = prefix + "signal_stddev";
      h.unit = "unit of " + latent.column_names.front();
      set_range(h, signal_range, output_stddev[static_cast<Index>(a)]);
    }
  }
  return out;
}

FitOptions baseline_fit_options() {
  FitOptions options;
  options.n_restarts = 30;
  options.reduction_tolerance = 1e-9;
  return options;
}

Fit fit_baseline(Baseline::Kind kind, const Prior& prior, const std::vector<Observations>& observations,
                 const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options) {
  require_accelerations(prior, observations, "fit_baseline");
  return kind == Baseline::Kind::se ? fit_outputs(prior, observations, hyperparameters, options)
                                    : fit(prior, observations, hyperparameters, options);
}

}  // namespace gp2
