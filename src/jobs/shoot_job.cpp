#include "gp2/jobs/shoot_job.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <optional>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/decompositions.hpp"
#include "base/not_a_number.hpp"
#include "base/parallel.hpp"
#include "data/evenly.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/pathwise.hpp"
#include "gp2/training/laplace.hpp"
#include "jobs/shooting_log.hpp"
#include "jobs/shooting_motion.hpp"

namespace gp2 {

namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr int least_stretches = 4;  // for standard errors

std::vector<std::size_t> estimated_in_system(const FitFile& fit) {
  const std::vector<Hyperparameter>& all = fit.report.hyperparameters;
  std::vector<std::size_t> estimated;
  for (std::size_t k = 0; k < all.size(); ++k) {
    if (all[k].is_system_parameter() && !all[k].is_fixed()) estimated.push_back(k);
  }
  if (estimated.empty()) {
    throw InputError(
        fmt::format("the fit of '{}' estimates no parameter of the system; mark one by `estimate`, or by estimate = "
                    "true in the model, and fit again",
                    fit.model.system->name()));
  }
  return estimated;
}

void note_rows_that_are_gone(const FitFile& fit, std::vector<std::string>& notes) {
  const std::vector<std::int64_t> n = fit.n_states();
  const std::int64_t n_all = std::accumulate(n.begin(), n.end(), std::int64_t{0});
  if (n_all == n_states(fit.observations)) return;
  notes.push_back(fmt::format("warning: the file of the fit holds {} of its {} rows, and latents are learned from these alone",
                              n_states(fit.observations), n_all));
}

// Weights of the coordinates as weights of residuals, row after row.
VectorXd row_weights(const VectorXd& weights, Index size) { return weights.replicate(size / weights.size(), 1); }

// What an orthonormal basis does not explain.
MatrixXd unexplained(const MatrixXd& basis, const MatrixXd& values) { return values - basis * (basis.transpose() * values); }

// A Gauss-Newton step, and what it says of the errors of θ.
struct Step {
  std::vector<MatrixXd> starts;  // per stretch: orthonormal, what its start explains, weighed
  std::vector<MatrixXd> J;       // per stretch: weighed derivatives by θ, without that
  MatrixXd inverse;              // A⁻¹, A = Σ JᵀJ
  VectorXd variance;             // by errors that stretches do not share
  VectorXd of_theta;
  std::vector<VectorXd> of_starts;  // per stretch (2 nq)
};

// @param names  of the parameters θ
Step gauss_newton(const std::vector<LinearisedMotion>& all, const VectorXd& weights, const std::vector<std::string>& names) {
  const Index p = std::ssize(names);
  Step step;
  std::vector<Eigen::ColPivHouseholderQR<MatrixXd>> by_starts;
  MatrixXd A = MatrixXd::Zero(p, p), gradients(p, std::ssize(all));
  for (const LinearisedMotion& one : all) {
    const VectorXd w = row_weights(weights, one.residual.size());
    step.starts.push_back(basis_of_range(by_starts.emplace_back(MatrixXd(w.asDiagonal() * one.by_start))));
    MatrixXd J = unexplained(step.starts.back(), w.asDiagonal() * one.by_theta);
    A += J.transpose() * J;
    gradients.col(std::ssize(step.J)) = J.transpose() * w.cwiseProduct(one.residual);
    step.J.push_back(std::move(J));
  }
  const VectorXd unit = A.diagonal().cwiseSqrt();
  const auto scaled = unit.cwiseInverse().asDiagonal();
  const MatrixXd correlation = scaled * A * scaled;
  constexpr double determined = 1e-10;
  if (!(unit.minCoeff() > 0) || !(Eigen::SelfAdjointEigenSolver<MatrixXd>(correlation).eigenvalues()[0] > determined))
    throw NumericalError(fmt::format("the motions do not determine separately: {}", fmt::join(names, ", ")));
  step.inverse = scaled * inverse_of(correlation) * scaled;
  // the jackknife; of what one stretch alone says it knows nothing
  VectorXd scatter = VectorXd::Zero(p);
  for (std::size_t k = 0; k < step.J.size(); ++k) {
    const MatrixXd others = A - step.J[k].transpose() * step.J[k];
    scatter += least_squares(others, gradients.col(static_cast<Index>(k))).cwiseAbs2();
  }
  const auto K = static_cast<double>(all.size());
  step.variance = ((K - 1) / K * scatter).cwiseMax(step.inverse.diagonal());
  step.of_theta = step.inverse * gradients.rowwise().sum();
  for (std::size_t k = 0; k < all.size(); ++k) {
    const VectorXd left = all[k].residual - all[k].by_theta * step.of_theta;
    const VectorXd w = row_weights(weights, left.size());
    step.of_starts.emplace_back(all[k].basis * least_squares(by_starts[k], w.asDiagonal() * left));
  }
  return step;
}

// Where the search is.
struct Shot {
  std::vector<Hyperparameter> hyperparameters;
  std::vector<Stretch> stretches;
  std::vector<VectorXd> residuals;  // of each stretch; empty where a motion cannot be followed
};

// Root mean squares of each coordinate.
VectorXd rms_of(const ShootingLog& log, const std::vector<VectorXd>& residuals) {
  VectorXd sum = VectorXd::Zero(std::ssize(log.compared));
  Index n = 0;
  for (const VectorXd& one : residuals) {
    const Index n_here = one.size() / sum.size();
    sum += one.reshaped(sum.size(), n_here).rowwise().squaredNorm();
    n += n_here;
  }
  constexpr double rounding = 1e-12;
  return (sum / static_cast<double>(n)).cwiseSqrt().cwiseMax(rounding * log.spread(log.compared));
}

double objective_at(const ShootingLog& log, const Shot& shot) {
  const bool all_followed = std::ranges::all_of(shot.residuals, [](const VectorXd& one) { return one.size() > 0; });
  return all_followed ? rms_of(log, shot.residuals).array().log().sum() : std::numeric_limits<double>::infinity();
}

// At the parameters of the fit, without stretches whose end no motion reaches.
Shot first_shot(const ShootingMotion& motion, const ShootingLog& log, const std::vector<Hyperparameter>& hyperparameters,
                std::vector<std::string>& notes) {
  Shot out{hyperparameters, {}, motion.residuals(motion.posterior_at(hyperparameters), log.stretches)};
  for (std::size_t k = 0; k < log.stretches.size(); ++k) {
    if (out.residuals[k].size() > 0) out.stretches.push_back(log.stretches[k]);
  }
  std::erase_if(out.residuals, [](const VectorXd& one) { return one.size() == 0; });
  if (out.stretches.empty()) throw NumericalError("no stretch of the log can be followed by the motion of the fit");
  if (out.stretches.size() < log.stretches.size()) {
    notes.push_back(fmt::format("warning: {} of {} stretches are left out: the motion of the fit does not reach their end",
                                log.stretches.size() - out.stretches.size(), log.stretches.size()));
  }
  return out;
}

// Goes along a step as far as that brings the motions nearer; nothing where none does.
std::optional<Shot> nearer_shot(const ShootingMotion& motion, const ShootingLog& log, const Shot& from,
                                const std::vector<std::size_t>& estimated, const Step& step) {
  constexpr int most_halvings = 8;
  const double objective = objective_at(log, from);
  double length = 1;
  for (int halving = 0; halving < most_halvings; ++halving, length /= 2) {
    Shot there{from.hyperparameters, from.stretches, {}};
    for (std::size_t a = 0; a < estimated.size(); ++a) {
      Hyperparameter& h = there.hyperparameters[estimated[a]];
      h.value = h.value_at(h.coordinate() + length * step.of_theta[static_cast<Index>(a)]);
    }
    for (std::size_t k = 0; k < there.stretches.size(); ++k) {
      there.stretches[k].start.head(log.spread.size()) += length * step.of_starts[k];
    }
    there.residuals = motion.residuals(motion.posterior_at(there.hyperparameters), there.stretches);
    if (objective_at(log, there) < objective) return there;
  }
  return std::nullopt;
}

// What is not known of the latents bends the motions of all stretches alike.
struct LatentScatter {
  VectorXd variance;  // of the steps that motions of functions drawn from the posterior would ask for
  VectorXd rms;       // of these motions about that of the mean, per coordinate, without what starts explain
};

LatentScatter scatter_by_latents(const ShootingMotion& motion, const Posterior& posterior, const Shot& shot, const Step& step,
                                 const VectorXd& weights, int n_threads) {
  constexpr int n_samples = 16;
  const PathwiseSamples samples = sample_paths(posterior, n_samples, {.seed = 1});
  const std::size_t n_stretches = shot.stretches.size();
  std::vector<MatrixXd> asked(n_stretches, MatrixXd::Zero(step.inverse.rows(), n_samples));
  std::vector<VectorXd> squares(n_stretches, VectorXd::Zero(weights.size()));
  parallel_for(static_cast<int>(n_stretches), n_threads, [&](int k, int) {
    const auto at = static_cast<std::size_t>(k);
    const VectorXd w = row_weights(weights, shot.residuals[at].size());
    for (int s = 0; s < n_samples; ++s) {
      const auto drawn = [&](const View& view, const Eigen::Ref<const MatrixXd>& x) { return samples.evaluate(s, view, x); };
      const VectorXd there = motion.residual(drawn, posterior.values().parameters, shot.stretches[at]);
      if (there.size() == 0) continue;
      const VectorXd change = unexplained(step.starts[at], w.cwiseProduct(there - shot.residuals[at]));
      asked[at].col(s) = step.J[at].transpose() * change;
      squares[at] += change.cwiseQuotient(w).reshaped(weights.size(), w.size() / weights.size()).rowwise().squaredNorm();
    }
  });
  MatrixXd sum = MatrixXd::Zero(step.inverse.rows(), n_samples);
  VectorXd square = VectorXd::Zero(weights.size());
  Index n_rows = 0;
  for (std::size_t k = 0; k < n_stretches; ++k) {
    sum += asked[k];
    square += squares[k];
    n_rows += shot.residuals[k].size() / weights.size();
  }
  return {(step.inverse * sum).rowwise().squaredNorm() / n_samples,
          (square / static_cast<double>(n_samples * n_rows)).cwiseSqrt()};
}

// What speaks against the parameters: few stretches, motions farther off than errors of the log and of latents let them be, and a fit
// that disagrees.
void note_doubts(const ShootingLog& log, const VectorXd& rms_by_latents, ShootOutcome& out) {
  constexpr double far = 3;  // deviations
  std::vector<std::string> off, apart;
  for (std::size_t c = 0; c < log.stated.size(); ++c) {
    const auto row = static_cast<Index>(c);
    const double relative = out.rms_after[row] / std::hypot(log.stated[c], rms_by_latents[row]);
    if (relative > far) off.push_back(fmt::format("{}, {:.2g} times that", out.coordinates[c], relative));
  }
  for (const ShotParameter& one : out.parameters) {
    const double difference = std::abs(one.value - one.one_step) / std::hypot(one.stddev, one.one_step_stddev);
    if (difference > far) apart.push_back(fmt::format("{}, {:.2g} joint standard errors", one.name, difference));
  }
  if (out.n_stretches < least_stretches) {
    out.notes.push_back(
        fmt::format("warning: no standard errors: they need {} stretches or more. Use a shorter `duration` or a longer log",
                    least_stretches));
  }
  if (!off.empty()) {
    out.notes.push_back(
        fmt::format("warning: the motion is farther off than errors of the log and of the latents explain: {}: an input, a "
                    "column or a force is wrong, or stretches are too long",
                    fmt::join(off, "; ")));
  }
  if (!apart.empty()) {
    out.notes.push_back(
        fmt::format("warning: the motion gives other values than the accelerations: {}: the log is not of the machine that was "
                    "fitted, smoothing changed its accelerations, or the model lacks something",
                    fmt::join(apart, "; ")));
  }
}

// The fit at the parameters of a posterior.
FitFile moved_fit(const FitFile& fit, const Posterior& posterior, std::vector<Hyperparameter> hyperparameters) {
  FitFile out = fit;
  out.report.hyperparameters = std::move(hyperparameters);
  out.report.draws.reset();
  out.report.uncertainty.reset();
  out.notes.reset();
  out.report.negative_log_likelihood = posterior.negative_log_likelihood();
  out.take_data(posterior);
  if (out.report.inducing) out.report.inducing->stretches.reset();  // which were of the parameters before
  const std::string& before = fit.report.termination;
  if (!before.starts_with("parameters by multiple shooting"))
    out.report.termination = fmt::format("parameters by multiple shooting, of a fit that ended so: {}", before);
  return out;
}

}  // namespace

std::vector<Option> options(ShootRequest& request) {
  return {{"duration", &request.duration, "S", "duration of a stretch [s]",
           "twice the time in which velocities change by their own size; at least 8 rows, at most half of the longest part of "
           "the log"},
          {"stretches", &request.most_stretches, "K", "maximum number of stretches, evenly spaced"},
          columns_option(request.columns),
          threads_option(request.threads)};
}

ShootOutcome shoot(const FitFile& fit, const CsvTable& table, const ShootRequest& request, const std::atomic<bool>* stop) {
  require_threads(request.threads);
  const int n_threads = thread_count(request.threads);
  const std::vector<Hyperparameter>& before = fit.report.hyperparameters;
  const std::vector<std::size_t> estimated = estimated_in_system(fit);
  std::vector<std::string> names;
  for (const std::size_t k : estimated) names.push_back(before[k].name);
  ShootOutcome out;
  note_rows_that_are_gone(fit, out.notes);
  const ShootingLog log = read_shooting_log(fit.model, table, request, out.notes);
  const ShootingMotion motion(fit, log, n_threads, stop);
  Shot shot = first_shot(motion, log, before, out.notes);
  for (const int j : log.compared) out.coordinates.push_back(fit.model.system->coordinates()[static_cast<std::size_t>(j)].name);
  out.duration = log.duration;
  out.n_stretches = static_cast<int>(shot.stretches.size());
  out.rms_before = rms_of(log, shot.residuals);

  constexpr int most_iterations = 20;
  Step step;
  VectorXd weights;
  while (true) {
    weights = rms_of(log, shot.residuals).cwiseInverse();
    step = gauss_newton(motion.linearise(shot.hyperparameters, estimated, shot.stretches, shot.residuals), weights, names);
    // an iteration that would change θ by a hundredth of its deviation is none
    out.converged = step.of_theta.cwiseAbs2().cwiseQuotient(step.inverse.diagonal()).maxCoeff() < 1e-4;
    if (out.converged || out.iterations == most_iterations) break;
    std::optional<Shot> next = nearer_shot(motion, log, shot, estimated, step);
    if (!next) break;
    shot = *std::move(next);
    ++out.iterations;
  }
  out.rms_after = rms_of(log, shot.residuals);

  const Posterior posterior = motion.posterior_at(shot.hyperparameters);
  const LatentScatter by_latents = scatter_by_latents(motion, posterior, shot, step, weights, n_threads);
  VectorXd variance = step.variance + by_latents.variance;
  if (out.n_stretches < least_stretches) variance.setConstant(not_a_number);
  for (std::size_t a = 0; a < estimated.size(); ++a) {
    const std::size_t k = estimated[a];
    const Hyperparameter& after = shot.hyperparameters[k];
    out.parameters.push_back({after.name, after.unit, before[k].value, parameter_uncertainty(fit.report, k).stddev, after.value,
                              std::sqrt(variance[static_cast<Index>(a)]) * std::abs(after.map().value_slope(after.value))});
    if (after.at_bound()) out.notes.push_back(fmt::format("warning: {} ended at a bound", after.name));
  }
  if (!out.converged) out.notes.emplace_back("warning: the last step still changed the parameters: shorter stretches may help");
  note_doubts(log, by_latents.rms, out);
  out.fit = moved_fit(fit, posterior, std::move(shot.hyperparameters));
  return out;
}

}  // namespace gp2
