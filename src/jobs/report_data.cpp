#include "jobs/report_data.hpp"
#include "jobs/acting_inputs.hpp"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "base/not_a_number.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "jobs/log_columns.hpp"
#include "jobs/reading_notes.hpp"
#include "jobs/rollout.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// Values at N states of each feature that learned latents read, by its name (N each).
std::vector<std::pair<std::string, VectorXd>> named_features(const Prior& prior, const MatrixXd& states) {
  std::vector<std::pair<std::string, VectorXd>> all;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    if (latent.kernel_is_fixed) continue;
    const MatrixXd features = evaluate_features(prior, a, states);
    for (int d = 0; d < latent.n_features(); ++d) {
      const std::string& name = latent.feature_names[static_cast<std::size_t>(d)];
      if (std::ranges::none_of(all, [&](const auto& one) { return one.first == name; })) all.emplace_back(name, features.col(d));
    }
  }
  return all;
}

// Predictions and figures at states with measured accelerations, their noise as in EvaluationOptions
ReportData data_at(const Posterior& posterior, const MatrixXd& states, const std::vector<int>& rows, const MatrixXd& measured,
                   MatrixXd noise_stddev, const std::shared_ptr<const OtherSystem>& other_system) {
  ReportData data;
  data.rows = rows;
  data.states = states;
  data.measured = measured;
  View view = View::constrained_acceleration(*posterior.prior().system);
  view.other_system = other_system;
  const Prior& prior = prior_of(posterior.prior(), view);
  const System& reference = prior.reference_system();
  const VectorXd parameters = parameters_of(view, posterior.values().parameters);
  View measured_view = view;
  measured_view.rows = rows;
  data.outputs = measured_view.names(reference);
  data.noise_stddev = std::move(noise_stddev);

  data.evaluation = evaluate_predictions(posterior, states, rows, measured, {other_system, data.noise_stddev, /*n_threads=*/0});
  Posterior::Marginal prediction = posterior.marginal(view, states, /*n_threads=*/0);
  data.predicted = prediction.mean;
  data.stddev = prediction.stddev();
  data.distance = posterior.distance_from_data(view, states, /*n_threads=*/0);
  view.quantity = View::Quantity::unconstrained_acceleration;
  MechanicsBatch mechanics;
  evaluate_mechanics(prior, view, states, parameters, mechanics);
  if (!mechanics.fault) {
    prediction = posterior.marginal(view, states, /*n_threads=*/0);
    data.unconstrained = prediction.mean;
    data.unconstrained_stddev = prediction.stddev();
  }

  const SystemValues values = reference.evaluate(states, parameters);
  data.constraint_error.resize(reference.nc(), states.cols());
  for (int i = 0; i < values.n_states() && reference.nc() > 0; ++i) {
    data.constraint_error.col(i) = (values.A(i) * data.predicted.col(i) - values.b(i)).cwiseAbs();
  }
  data.constraint_residuals = constraint_residuals(posterior, other_system, states, rows, measured, data.noise_stddev);
  data.lower_rank = states_of_lower_rank(reference, states, parameters);
  if (reference.nc() > 0) data.violation = largest_violation(reference, states, parameters);
  data.noise_stddev = with_slip(posterior, measured_view, states, std::move(data.noise_stddev));
  data.features = named_features(prior, states);
  return data;
}

// Where all accelerations are outputs and A ddq = b holds for them to rounding: those to observe instead.
std::vector<std::string> independent_outputs(const System& system, const VectorXd& parameters, const ReportData& data) {
  if (std::ssize(data.rows) != system.nq() || system.nc() == 0 || data.evaluation.n == 0) return {};
  MatrixXd accelerations(system.nq(), data.measured.cols());
  for (std::size_t k = 0; k < data.rows.size(); ++k) accelerations.row(data.rows[k]) = data.measured.row(static_cast<Index>(k));
  const SystemValues values = system.evaluate(data.states, parameters);
  if (values.constraint_matrix.hasNaN() || values.constraint_vector.hasNaN()) return {};
  const std::optional<std::vector<int>> rows = dependent_columns(system, data.states, parameters, accelerations);
  if (!rows) return {};
  return View{View::Quantity::constrained_acceleration, *rows}.names(system);
}

// The entries of the state that a log has though the fit does not read them: they may still be drawn, and be read by the truth.
void add_entries_not_read(const System& system, LogReader& reader, MatrixXd& states) {
  const std::vector<std::string> names = system.state_names();
  for (std::size_t k = 0; k < names.size(); ++k) {
    const auto row = static_cast<Index>(k);
    if (!states.row(row).hasNaN() || !reader.has(names[k])) continue;
    std::vector<bool> only(names.size(), false);
    only[k] = true;
    try {
      states.row(row) = reader.states(only).row(row);
    } catch (const InputError&) {
      // not numbers: then it is not drawn
    }
  }
}

// What acts by the delays and lags of the truth, of all inputs that the log has; NaN where that depends on commands before the log.
MatrixXd inputs_of_truth(const Model& truth, const CsvTable& log, LogReader& reader, MatrixXd states) {
  const System& system = *truth.system;
  const StateLayout layout = system.layout();
  auto inputs = states.bottomRows(layout.nu);
  inputs.setConstant(not_a_number);
  add_entries_not_read(system, reader, states);
  std::vector<std::string> notes;
  const auto commanded = take_commands(system, without_estimates(truth.actuators), reader, std::nullopt, {}, states, notes);
  MatrixXd known = MatrixXd::Zero(1, states.cols());
  if (commanded) clear_unknown(*commanded, log, known, notes);
  for (Index i = 0; i < known.cols(); ++i) {
    if (std::isnan(known(0, i))) inputs.col(i).setConstant(not_a_number);
  }
  return inputs;
}

}  // namespace

std::vector<ReportData> training_data(const FitFile& fit, const Posterior& posterior) {
  std::vector<ReportData> all;
  for (std::size_t g = 0; g < fit.observations.size(); ++g) {
    const Observations& group = fit.observations[g];
    if (!group.view().is_of_ddq() || group.n_data() == 0) continue;
    ReportData data = data_at(posterior, group.states(), group.view().rows, group.values(),
                              group.noise().of_values(posterior.noise_stddev(g), group.n_data()), group.view().other_system);
    data.name = all.empty() ? "training" : fmt::format("training {}", all.size() + 1);
    const bool elsewhere = g < fit.systems.size() && fit.systems[g];
    data.is_of_other_system = elsewhere;
    data.source = elsewhere ? fmt::format("measured on '{}'", fit.systems[g]->system->name()) : fit.data_source;
    // the accelerations of windows are derived under the constraints
    if (!group.has_sums()) {
      data.independent = independent_outputs(prior_of(posterior.prior(), group.view()).reference_system(),
                                             parameters_of(group.view(), posterior.values().parameters), data);
    }
    const Model& model = elsewhere ? *fit.systems[g] : fit.model;
    data.rollout =
        roll_out({&model, {}, group.view().other_system, prior_of(posterior.prior(), group.view())}, posterior, data.states, {});
    if (data.rollout.reason.starts_with("the data lack")) {
      data.rollout.reason += ", which the model does not read and the fit does not keep; the log as `data` has them";
    }
    all.push_back(std::move(data));
  }
  return all;
}

VectorXd ReportData::rmse_to_truth() const {
  VectorXd rmse = VectorXd::Constant(std::ssize(rows), not_a_number);
  for (std::size_t k = 0; k < rows.size() && truth.cols() > 0; ++k) {
    double sum = 0;
    int n = 0;
    for (Index i = 0; i < truth.cols(); ++i) {
      const double error = truth(rows[k], i) - predicted(rows[k], i);
      if (!std::isfinite(error)) continue;
      sum += error * error;
      ++n;
    }
    if (n > 0) rmse[static_cast<Index>(k)] = std::sqrt(sum / n);
  }
  return rmse;
}

MatrixXd standardised_errors(const ReportData& data) {
  MatrixXd z(data.measured.rows(), data.measured.cols());
  for (Index k = 0; k < z.rows(); ++k) {
    const int row = data.rows[static_cast<std::size_t>(k)];
    z.row(k) = (data.measured.row(k) - data.predicted.row(row)).array() /
               (data.stddev.row(row).array().square() + data.noise_stddev.row(k).array().square()).sqrt();
  }
  return z;
}

MatrixXd coverage(const ReportData& data, const Ref<const VectorXd>& levels) {
  const MatrixXd z = standardised_errors(data);
  MatrixXd share(levels.size(), z.rows() + 1);
  for (Index k = 0; k < z.rows(); ++k) share.col(k) = central_coverage(z.row(k).transpose(), levels);
  share.rightCols<1>() = central_coverage(z.reshaped(), levels);
  return share;
}

MatrixXd pit_counts(const ReportData& data, bool far) {
  MatrixXd z = standardised_errors(data);
  for (Index i = 0; i < z.cols(); ++i) {
    if ((data.distance[i] > Posterior::far_from_data) != far) z.col(i).setConstant(not_a_number);
  }
  MatrixXd counts = MatrixXd::Zero(Calibration::n_bins, z.rows() + 1);
  for (Index k = 0; k < z.rows(); ++k) {
    const auto n = static_cast<double>(z.cols() - z.row(k).array().isNaN().count());
    if (n > 0) counts.col(k) = n * pit_histogram(z.row(k).transpose(), Calibration::n_bins);
    counts.rightCols<1>() += counts.col(k);
  }
  return counts;
}

bool act_alike(const std::vector<Actuator>& a, const std::vector<Actuator>& b) {
  return std::ranges::equal(a, b, [](const Actuator& one, const Actuator& other) {
    return one.delay.value == other.delay.value && one.lag.value == other.lag.value;
  });
}

ReportData compare(const FitFile& fit, const Posterior& posterior, const ReportRequest& request,
                   std::vector<std::string>& notes) {
  const CsvTable& table = *request.data;
  ViewRequest constrained;
  constrained.system = request.system;
  const PredictedView at = predicted_view(fit, posterior.prior(), constrained);
  const System& system = *at.model->system;
  notes.insert(notes.end(), at.notes.begin(), at.notes.end());
  const std::vector<int> rows =
      acceleration_rows(system, outputs_to_compare(posterior, *at.model, table, request.columns, notes), "`data`");
  const std::vector<std::string> outputs = View{View::Quantity::constrained_acceleration, rows}.names(system);
  const LogStates log = read_log_states(at.prior, at.view, *at.model, table, request.columns, outputs, at.actuators,
                                        parameters_of(at.view, posterior.values().parameters));
  notes.insert(notes.end(), log.notes.begin(), log.notes.end());
  ReportData data = at_states_of(table.name(), [&] {
    MatrixXd noise = measurement_noise(posterior, rows, log.states.cols(), log.stated_stddev);
    return data_at(posterior, log.states, rows, log.accelerations, std::move(noise), at.other_system);
  });
  data.name = "test";
  data.source = at.other_system ? fmt::format("{}, of '{}'", table.name(), system.name()) : table.name();
  data.is_test = true;
  data.is_of_other_system = at.other_system != nullptr;
  LogReader reader = open_log(*at.model, table, request.columns);
  add_entries_not_read(system, reader, data.states);
  if (request.truth && request.truth->system->state_names() == system.state_names())
    data.truth_inputs = inputs_of_truth(*request.truth, table, reader, data.states);
  double unit_of_time = 1;
  const std::vector<std::string> wrong = note_late_inputs(at.prior, table, checked_columns(*at.model, {&table}, request.columns),
                                                          without_estimates(at.actuators), data.notes, &unit_of_time);
  for (const std::string& text : wrong) data.notes.push_back(fmt::format("warning: {}: {}", table.name(), text));
  if (unit_of_time != 1) {
    data.states.row(system.layout().t()) *= unit_of_time;
    data.notes.push_back(
        fmt::format("{}: the rates of the coordinates say that t counts {:g} s, not seconds: its motion is compared "
                    "over t in seconds",
                    table.name(), unit_of_time));
  }
  notes.insert(notes.end(), data.notes.begin(), data.notes.end());
  std::vector<std::string> episodes;
  if (const int column = reader.episode_column(); column >= 0) {
    for (int row = 0; row < table.n_rows(); ++row) episodes.push_back(table.cell(row, column));
  }
  data.rollout = roll_out(at, posterior, data.states, episodes);
  // a motion that starts with a wrong velocity is another one
  for (const Coordinate& one : system.coordinates()) {
    const auto of_velocity =
        std::ranges::find_if(wrong, [&](const std::string& text) { return text.starts_with(one.velocity() + " is not"); });
    if (!data.rollout.reason.empty() || of_velocity == wrong.end()) continue;
    data.rollout = {};
    data.rollout.reason = *of_velocity;
  }
  return data;
}

}  // namespace gp2
