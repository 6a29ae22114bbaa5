#include "gp2/inference/evaluation.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <numbers>
#include <set>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "base/shape.hpp"
#include "base/stop.hpp"
#include "data/evenly.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/leave_one_out.hpp"
#include "inference/cross_validation.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// Counts of standardised errors z within central intervals, and of Φ(z) in equal parts of [0, 1]; NaN is none.
struct ErrorCounts {
  VectorXd levels;
  int n_bins = 1;
  VectorXd n_within = VectorXd::Zero(levels.size()), n_in_bin = VectorXd::Zero(n_bins);
  double n = 0;

  void add(double z) {
    if (std::isnan(z)) return;
    ++n;
    // the central interval that just holds it
    const double probability = std::erf(std::abs(z) / std::numbers::sqrt2);
    for (Index l = 0; l < levels.size(); ++l) n_within[l] += probability <= levels[l] ? 1 : 0;
    const double pit = 0.5 * std::erfc(-z / std::numbers::sqrt2);
    n_in_bin[std::min(static_cast<Index>(pit * n_bins), n_in_bin.size() - 1)] += 1;
  }
  [[nodiscard]] VectorXd coverage() const { return n_within / n; }
  [[nodiscard]] VectorXd pit() const { return n_in_bin / n; }
};

// Standardised errors under Gaussian marginals, and their mean negative log density.
struct StandardisedErrors {
  double sum = 0;
  int n = 0;
  ErrorCounts counts{Eigen::Vector3d(0.5, 0.8, 0.95), Calibration::n_bins};

  void add(double error, double stddev) {
    const double z = error / stddev;
    sum += 0.5 * z * z + std::log(stddev) + 0.5 * std::log(2 * std::numbers::pi);
    ++n;
    counts.add(z);
  }
  [[nodiscard]] double nlpd() const { return n == 0 ? not_a_number : sum / n; }
};

// What errors of some points come to.
struct Scores {
  StandardisedErrors measured, latent;
  VectorXd squares, counts;  // per output
  int n = 0;                 // points

  explicit Scores(Index n_outputs) : squares(VectorXd::Zero(n_outputs)), counts(squares) {}

  void add(Index output, double error, double stddev, double noise, bool has_variance) {
    squares[output] += error * error;
    counts[output] += 1;
    if (std::isfinite(noise)) measured.add(error, std::hypot(stddev, noise));
    if (has_variance) latent.add(error, stddev);
  }
  [[nodiscard]] VectorXd rmse() const { return (squares.array() / counts.array()).sqrt(); }
  [[nodiscard]] Calibration calibration() const {
    const VectorXd of_measured = measured.counts.coverage(), of_latent = latent.counts.coverage();
    return {of_measured[0], of_measured[1], of_measured[2], of_latent[0], of_latent[1], of_latent[2], measured.counts.pit()};
  }
  [[nodiscard]] Evaluation::Part part(double spread) const {
    const VectorXd of_observed = (counts.array() > 0).select(rmse(), 0);
    return {calibration(), n, counts.sum() > 0 ? of_observed.norm() / spread : not_a_number};
  }
};

// Of the latent that is viewed alone; empty where all are.
std::string latent_name(const Prior& prior, const View& view) {
  return view.latent ? prior.latents[static_cast<std::size_t>(view.latent->first)].name : "";
}

// A quantity, or what one latent adds to it, under whatever system it is observed.
struct Observed {
  View::Quantity quantity = View::Quantity::constrained_acceleration;
  std::optional<LatentRange> latent = {};

  [[nodiscard]] bool has(const View& view) const { return view.quantity == quantity && view.latent == latent; }
};

// Calls visit(group number, row of its view) for all observations of row `row`.
template <typename Visit>
void for_each_observed(const std::vector<Observations>& observations, const Observed& of, int row, const Visit& visit) {
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const View& view = observations[g].view();
    if (!of.has(view)) continue;
    const auto found = std::find(view.rows.begin(), view.rows.end(), row);
    if (found != view.rows.end()) visit(g, found - view.rows.begin());
  }
}

// The rows that any observation has, in order.
std::vector<int> rows_of(const std::vector<Observations>& observations, const Observed& of) {
  std::set<int> rows;
  for (const Observations& group : observations) {
    if (of.has(group.view())) rows.insert(group.view().rows.begin(), group.view().rows.end());
  }
  return {rows.begin(), rows.end()};
}

// Standard deviation of row `row` over all observations of it; NaN where there are none.
double training_spread(const std::vector<Observations>& observations, const Observed& of, int row) {
  std::vector<double> values;
  for_each_observed(observations, of, row, [&](std::size_t g, Index k) {
    const auto observed = observations[g].values().row(k);
    values.insert(values.end(), observed.begin(), observed.end());
  });
  if (values.empty()) return not_a_number;
  return row_spread(Eigen::Map<Eigen::RowVectorXd>(values.data(), std::ssize(values)))[0];
}

// Where A ddq = b alone decides an entry of ddq (nq × N): its row of T, in the metric of M, is what rounding leaves of it.
Eigen::Array<bool, Eigen::Dynamic, Eigen::Dynamic> decided_entries(const System& system, const Ref<const MatrixXd>& states,
                                                                   const Ref<const VectorXd>& parameters, int n_threads) {
  constexpr double rounding = 1e-10;
  Eigen::Array<bool, Eigen::Dynamic, Eigen::Dynamic> decided(system.nq(), states.cols());
  const auto look = [&](Index first, const MechanicsBatch& mechanics) {
    for (std::size_t i = 0; i < mechanics.projections.size(); ++i) {
      const UdwadiaKalaba& projection = mechanics.projections[i];
      const VectorXd unit = projection.mass().diagonal().cwiseSqrt().cwiseInverse();
      const VectorXd size = (projection.T() * unit.asDiagonal()).rowwise().norm();
      decided.col(first + static_cast<Index>(i)) = size.array() <= rounding * unit.array();
    }
  };
  static_cast<void>(for_each_mechanics(system, states, parameters, n_threads, look));
  return decided;
}

}  // namespace

double max_constraint_error(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                            const Ref<const MatrixXd>& accelerations) {
  if (accelerations.rows() != system.nq() || accelerations.cols() != states.cols()) {
    throw InputError(fmt::format("max_constraint_error: accelerations must be {} × {}, got {} × {}", system.nq(), states.cols(),
                                 accelerations.rows(), accelerations.cols()));
  }
  const SystemValues values = system.evaluate(states, parameters);
  double worst = 0;
  for (int i = 0; i < values.n_states() && system.nc() > 0; ++i) {
    const VectorXd error = values.A(i) * accelerations.col(i) - values.b(i);
    if (error.hasNaN()) return not_a_number;  // a baseline needs no measurement of what only the constraint reads
    worst = std::max(worst, error.cwiseAbs().maxCoeff());
  }
  return worst;
}

VectorXd central_coverage(const Ref<const VectorXd>& z, const Ref<const VectorXd>& levels) {
  ErrorCounts counts{levels};
  for (const double one : z) counts.add(one);
  return counts.coverage();
}

VectorXd pit_histogram(const Ref<const VectorXd>& z, int n_bins) {
  if (n_bins < 1) throw InputError(fmt::format("pit_histogram: n_bins must be 1 or more, got {}", n_bins));
  ErrorCounts counts{{}, n_bins};
  for (const double one : z) counts.add(one);
  return counts.pit();
}

std::vector<int> observed_rows(const Posterior& posterior) { return rows_of(posterior.observations(), {}); }

namespace {

/// Of numbers that stand for so many each.
struct MeanSquare {
  double n = 0, square = 0;

  void add(double number, double weight) {
    square = n > 0 ? (n * square + weight * number * number) / (n + weight) : number * number;
    n += weight;
  }
  [[nodiscard]] double root() const { return n > 0 ? std::sqrt(square) : not_a_number; }
};

}  // namespace

MatrixXd measurement_noise(const Posterior& posterior, const std::vector<int>& rows, Index n_states, const MatrixXd& stated) {
  MatrixXd noise(std::ssize(rows), n_states);
  for (Index r = 0; r < noise.rows(); ++r) {
    MeanSquare usual, factor;
    for_each_observed(posterior.observations(), {}, rows[static_cast<std::size_t>(r)], [&](std::size_t g, Index k) {
      const Observations& group = posterior.observations()[g];
      const VectorXd sigma = posterior.noise_stddev(g);
      const auto n = static_cast<double>((!group.values().row(k).array().isNaN()).count());
      usual.add(group.usual_noise(sigma)[k], n);
      if (group.states_noise(k)) factor.add(sigma[k], n);
    });
    noise.row(r).setConstant(usual.root());
    for (Index i = 0; i < n_states && stated.size() > 0; ++i) {
      if (!std::isnan(stated(r, i))) noise(r, i) = (factor.n > 0 ? factor.root() : 1) * stated(r, i);
    }
  }
  return noise;
}

MatrixXd with_slip(const Posterior& posterior, const View& view, const Ref<const MatrixXd>& states, MatrixXd noise_stddev) {
  const Prior& prior = prior_of(posterior.prior(), view);
  require_shape("with_slip: noise_stddev", noise_stddev, view.size(), states.cols());
  if (!prior.system->has_constraint_noise()) return noise_stddev;
  const VectorXd parameters = parameters_of(view, posterior.values().parameters);
  const auto fault = for_each_mechanics(*prior.system, states, parameters, 1, [&](Index first, const MechanicsBatch& mechanics) {
    const Index n = mechanics.values.n_states();
    const ViewValues values = evaluate_view(view, mechanics, states.middleCols(first, n));
    for (Index i = 0; i < n; ++i) {
      auto column = noise_stddev.col(first + i);
      column = (column.array().square() + values.N(static_cast<int>(i)).rowwise().squaredNorm().array()).sqrt();
    }
  });
  if (fault) static_cast<void>(require_mechanics(prior, view, states, parameters));
  return noise_stddev;
}

bool TrainingResidual::is_too_large() const {
  // fitted hyperparameters of few rows are too sure of themselves: they make rms of 1.8 with 89 % inside
  const bool is_far = n >= 10 && rms > 2 && coverage95 < 0.85 && rms * rms > 1 + 6 * std::sqrt(2.0 / n);
  return is_far || is_coverage_low(coverage95, n);
}

bool TrainingResidual::is_too_small() const { return is_of_ddq && n >= 20 && rms_in_noise < 0.5; }

bool TrainingResidual::is_correlated() const {
  return n_serial >= 30 && serial_correlation > 0.5 && serial_correlation > 4 / std::sqrt(n_serial);
}

namespace {

// What residuals of consecutive states say of how they go on.
struct SerialSums {
  double products = 0, squares = 0;
  int n = 0, n_pairs = 0;

  void add(double z, double before) {
    squares += z * z;
    ++n;
    if (std::isnan(before)) return;
    products += z * before;
    ++n_pairs;
  }
  void add(const SerialSums& more) {
    products += more.products, squares += more.squares;
    n += more.n, n_pairs += more.n_pairs;
  }
};

// The serial correlation of each residual. Logs that are too short to tell by themselves tell together, each output by itself.
void correlate(const std::vector<SerialSums>& sums, std::vector<TrainingResidual>& residuals) {
  constexpr int enough = 64;  // values, of which TrainingResidual::is_correlated asks for no more than 0.5
  std::map<std::string, SerialSums> of_short_logs;
  for (std::size_t r = 0; r < residuals.size(); ++r) {
    if (sums[r].n < enough) of_short_logs[residuals[r].output].add(sums[r]);
  }
  for (std::size_t r = 0; r < residuals.size(); ++r) {
    TrainingResidual& one = residuals[r];
    if (sums[r].n == 0) continue;
    const bool is_short = sums[r].n < enough;
    const SerialSums& of = is_short ? of_short_logs[one.output] : sums[r];
    // each log has one pair less than it has values
    const double share = is_short && of.n_pairs > 0 ? static_cast<double>(of.n) / of.n_pairs : 1;
    one.serial_correlation = of.squares > 0 ? share * of.products / of.squares : 0;
    one.n_serial = is_short ? of.n_pairs + 1 : of.n;
  }
}

std::vector<TrainingResidual> training_residuals(const Posterior& posterior, const std::vector<Observations>& trusted,
                                                 const std::vector<LeaveOneOut>& left_out) {
  // of many states some are left, which do not follow each other
  const bool are_all = posterior.n_states() == n_states(posterior.observations());
  std::vector<TrainingResidual> residuals;
  std::vector<SerialSums> serial;  // nothing where states do not follow each other
  for (std::size_t g = 0; g < left_out.size(); ++g) {
    const Observations& group = trusted[g];
    const Prior& prior = prior_of(posterior.prior(), group.view());
    const std::vector<std::string> names = group.view().names(*prior.system, latent_name(prior, group.view()));
    const VectorXd noise = posterior.noise_stddev(g);
    for (Index k = 0; k < group.values().rows(); ++k) {
      TrainingResidual& one = residuals.emplace_back();
      one.group = g;
      one.is_of_ddq = group.view().is_of_ddq();
      one.output = names[static_cast<std::size_t>(k)];
      double before = not_a_number;
      SerialSums in_order;
      std::vector<double> distances;
      StandardisedErrors errors;
      for (Index i = 0; i < group.n_data(); ++i) {
        const double error = group.values()(k, i) - left_out[g].mean(k, i);
        if (std::isnan(error)) continue;
        const double of_noise = group.noise_at(noise, i)[k], stddev = std::hypot(std::sqrt(left_out[g].variance(k, i)), of_noise);
        const double z = error / stddev;
        errors.add(error, stddev);
        one.rms += z * z;
        one.rms_in_noise += std::pow(error / of_noise, 2);
        in_order.add(z, before);
        before = z;
        distances.push_back(std::abs(z));
        if (!(std::abs(z) > one.farthest)) continue;
        one.farthest = std::abs(z);
        one.farthest_state = are_all ? static_cast<int>(i) : -1;
      }
      one.n = errors.n;
      if (one.n > 0) {
        constexpr double far = 6;  // deviations; of normal values one in 10⁹ is farther
        const double distance = far * std::max(1.0, median(distances) / median_of_normal);
        one.n_far = static_cast<int>(std::ranges::count_if(distances, [&](double z) { return z > distance; }));
      }
      one.coverage95 = errors.counts.coverage()[2];
      // values that sums stand for are smoothed, and so their errors; what is known of other views need not be of a motion
      const bool is_motion = are_all && !group.has_sums() && one.is_of_ddq;
      serial.push_back(is_motion ? in_order : SerialSums());
      for (double* const square : {&one.rms, &one.rms_in_noise}) *square = std::sqrt(*square / std::max(1, one.n));
    }
  }
  correlate(serial, residuals);
  return residuals;
}

// Of the measured values, row by row over all observations: add(scores, row, group number, row of its view, state).
template <typename Add>
Evaluation::Part scores_of(const std::vector<Observations>& trusted, const Observed& of, const Add& add) {
  const std::vector<int> rows = rows_of(trusted, of);
  Scores scores(std::ssize(rows));
  VectorXd spread(std::ssize(rows));
  for (Index r = 0; r < spread.size(); ++r) {
    spread[r] = training_spread(trusted, of, rows[static_cast<std::size_t>(r)]);
    for_each_observed(trusted, of, rows[static_cast<std::size_t>(r)], [&](std::size_t g, Index k) {
      for (Index i = 0; i < trusted[g].n_data(); ++i) {
        if (!std::isnan(trusted[g].values()(k, i))) add(scores, r, g, k, i);
      }
    });
  }
  for (const Observations& group : trusted) scores.n += of.has(group.view()) ? group.n_data() : 0;
  return scores.part(spread.norm());
}

// As measured, without slip: of each group (d × N).
std::vector<MatrixXd> noise_of_groups(const Posterior& posterior) {
  std::vector<MatrixXd> noise;
  for (std::size_t g = 0; g < posterior.observations().size(); ++g) {
    noise.push_back(posterior.observations()[g].noise_of_values(posterior.noise_stddev(g)));
  }
  return noise;
}

LeftOutScores scores_of(const Posterior& posterior, const std::vector<Observations>& trusted, const LeftOut& left_out,
                        const Observed& of) {
  std::vector<MatrixXd> noise = noise_of_groups(posterior);
  const auto part_of = [&](const std::vector<LeaveOneOut>& predicted) {
    return scores_of(trusted, of, [&](Scores& scores, Index r, std::size_t g, Index k, Index i) {
      if (std::isnan(predicted[g].mean(k, i))) return;  // double precision cannot tell
      scores.add(r, trusted[g].values()(k, i) - predicted[g].mean(k, i), std::sqrt(predicted[g].variance(k, i)), noise[g](k, i),
                 /*has_variance=*/false);
    });
  };
  LeftOutScores out{"", part_of(left_out.rows), std::nullopt, part_of(left_out.values), 0};
  if (!left_out.stretches.empty()) out.stretches = part_of(left_out.stretches);
  const Prior& prior = posterior.prior();
  for (std::size_t g = 0; g < noise.size(); ++g) {  // slip among it
    const Observations& group = posterior.observations()[g];
    const View& view = group.view();
    if (!of.has(view)) continue;
    noise[g] = with_slip(posterior, view, group.states(), std::move(noise[g]));
    if (!view.is_of_ddq()) out.view = view.quantity->word() + (view.latent ? "@" + latent_name(prior_of(prior, view), view) : "");
  }
  const auto add_noise = [&](Scores& scores, Index r, std::size_t g, Index k, Index i) {
    scores.add(r, noise[g](k, i), 0, not_a_number, /*has_variance=*/false);
  };
  out.nrmse_of_noise = scores_of(trusted, of, add_noise).nrmse;
  return out;
}

// What is observed: ddq first, where it is, and all else in the order of the observations.
std::vector<Observed> observed_views(const std::vector<Observations>& observations) {
  std::vector<Observed> all;
  for (const Observations& group : observations) {
    const View& view = group.view();
    if (std::ranges::any_of(all, [&](const Observed& one) { return one.has(view); })) continue;
    all.insert(view.is_of_ddq() ? all.begin() : all.end(), {view.quantity, view.latent});
  }
  return all;
}

// Whether stretches of the observations, of ddq where it is observed, are stretches of time.
bool has_stretches(const Posterior& posterior, bool has_time_order) {
  const int t = posterior.prior().system->layout().t();
  const bool has_ddq = !observed_rows(posterior).empty();
  const auto is_in_order = [&](const Observations& group) {
    return has_time_order || (has_ddq && !group.view().is_of_ddq()) || group.states().row(t).allFinite();
  };
  return std::ranges::all_of(posterior.observations(), is_in_order) && posterior.n_states() >= 2 * CrossValidation::n_stretches;
}

}  // namespace

CrossValidation cross_validate(const Posterior& posterior, const std::vector<Observations>& trusted, bool has_time_order) {
  if (trusted.empty()) throw InputError("cross_validate: the posterior has no observations to leave out");
  const LeftOut left_out = leave_out(posterior, has_stretches(posterior, has_time_order) ? CrossValidation::n_stretches : 0);
  std::vector<LeftOutScores> of_views;
  for (const Observed& of : observed_views(trusted)) of_views.push_back(scores_of(posterior, trusted, left_out, of));
  CrossValidation out;
  if (!of_views.empty()) static_cast<LeftOutScores&>(out) = of_views.front();
  out.other_views.assign(of_views.begin() + (of_views.empty() ? 0 : 1), of_views.end());
  out.residuals = training_residuals(posterior, trusted, left_out.values);
  return out;
}

CrossValidation cross_validate(const Posterior& posterior, bool has_time_order) {
  return cross_validate(posterior, posterior.observations(), has_time_order);
}

std::string CrossValidation::text() const {
  // values that do not vary have no spread to compare errors with
  const auto of_part = [](const Evaluation::Part& part, const char* nrmse, const char* coverage) {
    std::vector<std::string> figures;
    if (std::isfinite(part.nrmse)) figures.push_back(fmt::format("{}{:.3g}", nrmse, part.nrmse));
    if (std::isfinite(part.coverage95)) figures.push_back(fmt::format("{}{:.3g}", coverage, part.coverage95));
    return figures.empty() ? "none" : fmt::format("{}", fmt::join(figures, ", "));
  };
  const auto of_view = [&](const LeftOutScores& of) {
    std::string text = (of.view.empty() ? "" : of.view + ": ") + of_part(of.one_by_one, "nrmse ", "95 % coverage ");
    if (of.stretches) text += fmt::format("; in {} stretches of the log: {}", n_stretches, of_part(*of.stretches, "", ""));
    return text;
  };
  std::string text = "left out row by row: " + of_view(*this);
  for (const LeftOutScores& of : other_views) text += "; " + of_view(of);
  return text;
}

bool CrossValidation::predicts_little() const { return stretches && is_little_predicted(*stretches, nrmse_of_noise); }

std::vector<ConstraintResidual> constraint_residuals(const Posterior& posterior,
                                                     const std::shared_ptr<const OtherSystem>& other_system,
                                                     const Ref<const MatrixXd>& states, const std::vector<int>& rows,
                                                     const Ref<const MatrixXd>& measured,
                                                     const Ref<const MatrixXd>& noise_stddev) {
  View view = View::constrained_acceleration(*posterior.prior().system);
  view.other_system = other_system;
  const System& system = prior_of(posterior.prior(), view).reference_system();
  MatrixXd accelerations = MatrixXd::Constant(system.nq(), states.cols(), not_a_number), stddev = accelerations;
  accelerations(rows, Eigen::all) = measured;
  stddev(rows, Eigen::all) = noise_stddev;
  return constraint_residuals(system, states, parameters_of(view, posterior.values().parameters), accelerations, stddev);
}

Evaluation evaluate_predictions(const Posterior& posterior, const Ref<const MatrixXd>& states, const std::vector<int>& rows,
                                const Ref<const MatrixXd>& targets, const EvaluationOptions& options) {
  View all = View::constrained_acceleration(*posterior.prior().system);
  all.other_system = options.other_system;
  View compared = all;
  compared.rows = rows;
  require_view(posterior.prior(), compared);
  const MatrixXd& given_noise = options.noise_stddev;
  require_shape("evaluate_predictions: targets", targets, std::ssize(rows), states.cols());
  if (given_noise.size() > 0) {
    require_shape("evaluate_predictions: noise_stddev", given_noise, std::ssize(rows), states.cols());
  }
  const Prior& prior = prior_of(posterior.prior(), all);
  const System& system = prior.reference_system();
  const VectorXd parameters = parameters_of(all, posterior.values().parameters);
  const auto decided = decided_entries(*prior.system, states, parameters, options.n_threads);
  const MatrixXd noise = with_slip(posterior, compared, states,
                                   given_noise.size() > 0 ? given_noise : measurement_noise(posterior, rows, states.cols()));

  Evaluation e;
  e.n = static_cast<int>(states.cols());
  e.outputs = View{View::Quantity::constrained_acceleration, rows}.names(system);
  e.rmse.resize(std::ssize(rows));
  const VectorXd distance = posterior.distance_from_data(all, states, options.n_threads);
  Scores whole(e.rmse.size()), near(e.rmse.size()), far(e.rmse.size());
  constexpr double rounding = 1e-12;
  const VectorXd spreads = row_spread(targets);
  const double spread = spreads.norm();
  posterior.for_each_marginal(all, states, options.n_threads, [&](Index first, const Posterior::Marginal& prediction) {
    require_not_stopped(options.stop);
    const MatrixXd stddev = prediction.stddev();
    for (Index i = 0; i < stddev.cols(); ++i) {
      const Index state = first + i;
      Scores& part = distance[state] > Posterior::far_from_data ? far : near;
      for (Scores* scores : {&whole, &part}) ++scores->n;
      for (Index k = 0; k < e.rmse.size(); ++k) {
        const Index row = rows[static_cast<std::size_t>(k)];
        const double error = targets(k, state) - prediction.mean(row, i);
        if (std::isnan(targets(k, state))) {
          ++e.n_missing;
          continue;
        }
        // where the data say all, or forces cancel, a deviation is what rounding leaves of it
        const bool has_variance = !decided(row, state) && stddev(row, i) > rounding * std::max(spreads[k], noise(k, state));
        if (!has_variance) ++e.n_zero_variance;
        for (Scores* scores : {&whole, &part}) scores->add(k, error, stddev(row, i), noise(k, state), has_variance);
      }
    }
    const auto states_here = states.middleCols(first, stddev.cols());
    const auto add_largest = [](double one, double& largest) {
      if (!std::isnan(largest) && !(one <= largest)) largest = one;  // NaN stays
    };
    add_largest(max_constraint_error(system, states_here, system.parameter_values(), prediction.mean), e.max_constraint_error);
    add_largest(max_constraint_error(system, states_here, parameters, prediction.mean), e.max_constraint_error_fitted);
  });
  static_cast<Calibration&>(e) = whole.calibration();
  e.rmse = whole.rmse();
  double normalised = 0;
  for (Index k = 0; k < e.rmse.size(); ++k) {
    normalised += e.rmse[k] / training_spread(posterior.observations(), {}, rows[static_cast<std::size_t>(k)]);
  }
  e.rmse_normalised = normalised / static_cast<double>(rows.size());
  e.nrmse = e.rmse.norm() / spread;
  e.near = near.part(spread);
  e.far = far.part(spread);
  e.nlpd = whole.measured.nlpd();
  e.nlpd_latent = whole.latent.nlpd();
  return e;
}

}  // namespace gp2
