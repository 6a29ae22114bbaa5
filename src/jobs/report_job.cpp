#include "gp2/jobs/report_job.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <filesystem>
#include <limits>
#include <numeric>

#include <fmt/chrono.h>
#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/base/version.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/simulation/generate.hpp"
#include "jobs/fit_notes.hpp"
#include "jobs/read_observations.hpp"
#include "jobs/rollout.hpp"
#include "prior/code_function.hpp"
#include "prior/load_function.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::RowVectorXd;
using Eigen::VectorXd;

namespace {

// the day a file was written, in UTC
std::string date_of(const std::filesystem::path& path) {
  const auto written = std::chrono::file_clock::to_sys(std::filesystem::last_write_time(path));
  const auto seconds = std::chrono::time_point_cast<std::chrono::seconds>(written);
  return fmt::format("{:%Y-%m-%d}", fmt::gmtime(std::chrono::system_clock::to_time_t(seconds)));
}

// predictions and figures at states with measured accelerations, their noise as in EvaluationOptions
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
  data.outputs = View{View::Quantity::constrained_acceleration, rows}.names(reference);
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
  View measured_view = View::constrained_acceleration(reference);
  measured_view.rows = rows;
  measured_view.other_system = other_system;
  data.noise_stddev = with_slip(posterior, measured_view, states, std::move(data.noise_stddev));

  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    if (latent.kernel_is_fixed) continue;
    const MatrixXd features = evaluate_features(prior, a, states);
    for (int d = 0; d < latent.n_features(); ++d) {
      const std::string& name = latent.feature_names[static_cast<std::size_t>(d)];
      const bool known =
          std::any_of(data.features.begin(), data.features.end(), [&](const auto& one) { return one.first == name; });
      if (!known) data.features.emplace_back(name, features.col(d));
    }
  }
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

void add_truth(const ReportRequest& request, Report& report) {
  const Model& truth = *request.truth;
  const System& fitted = *report.fit.model.system;
  if (truth.truth.empty()) {
    throw InputError(
        fmt::format("`truth={}`: has no [truth]; give a model file that says what the true acceleration is", truth.name));
  }
  if (truth.system->state_names() != fitted.state_names()) {
    throw InputError(fmt::format("`truth={}`: its state is {}, that of the fit is {}; coordinates and inputs must be the same",
                                 truth.name, fmt::join(truth.system->state_names(), " "), fmt::join(fitted.state_names(), " ")));
  }
  const ModelMotion motion(truth);
  bool any = false;
  for (ReportData& data : report.data) {
    if (request.system ? !data.is_test : data.is_of_other_system) continue;  // it is the truth of one system
    data.truth = motion.acceleration(data.states);
    for (Index i = 0; i < data.truth.cols(); ++i) {
      if (data.truth.col(i).allFinite()) {
        any = true;
      } else {
        data.truth.col(i).setConstant(not_a_number);
      }
    }
  }
  if (!any) {
    throw InputError(
        fmt::format("`truth={}`: not finite at any state of the data; the fit keeps only the columns its model reads, "
                    "so give a `data` with all that the truth reads",
                    truth.name));
  }
  report.truth_source = truth.system->name();
}

std::vector<Relevance> relevance_of(const Posterior& posterior) {
  std::vector<Relevance> all;
  const Prior& prior = posterior.prior();
  const ModelValues& values = posterior.values();
  const Scales scales = default_scales(prior, posterior.observations());
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    if (latent.kernel_is_fixed) continue;
    double largest_signal = 0;
    for (Index j = 0; j < values.signal_stddev[a].size(); ++j) {
      largest_signal = std::max(largest_signal, values.signal_stddev[a][j] / scales.signal_stddev[a][j]);
    }
    for (std::size_t p = 0; p < latent.kernel.parameters().size(); ++p) {
      const Kernel::Parameter& parameter = latent.kernel.parameters()[p];
      const bool periodic = parameter.kind == Kernel::ParameterKind::periodic_lengthscale;
      if (parameter.kind != Kernel::ParameterKind::lengthscale && !periodic) continue;
      Relevance one{latent.name, latent.feature_names[static_cast<std::size_t>(parameter.feature)]};
      one.lengthscale = values.kernel[a][static_cast<Index>(p)];
      one.spread = scales.feature_stddev[a][parameter.feature];
      one.relevance = (periodic ? 1 : one.spread) / one.lengthscale;
      if (!values.has_free_loading(a)) one.effect = largest_signal * one.relevance;
      const auto known = std::find_if(all.begin(), all.end(), [&](const Relevance& other) {
        return other.latent == one.latent && other.feature == one.feature;
      });
      if (known == all.end()) {
        all.push_back(std::move(one));
      } else if (std::pair(one.effect.value_or(0), one.relevance) > std::pair(known->effect.value_or(0), known->relevance)) {
        *known = std::move(one);
      }
    }
  }
  return all;
}

// The row of the training data that is nearest to the medians of what the prior reads, in spreads.
VectorXd usual_state(const Prior& prior, const MatrixXd& states) {
  const std::vector<bool> reads = prior.reads();
  VectorXd distance = VectorXd::Zero(states.cols());
  for (Index k = 0; k < states.rows(); ++k) {
    if (!reads[static_cast<std::size_t>(k)]) continue;
    const auto row = states.row(k).array();
    const double middle = median({row.begin(), row.end()});
    const double spread = (row - middle).abs().mean();
    if (spread > 0) distance.array() += ((row - middle) / spread).square().transpose();
  }
  Index nearest = 0;
  distance.minCoeff(&nearest);
  return states.col(nearest);
}

// A view of what multiplies the one direction of a latent on forces: its force where this direction is 1 on the first coordinate and
// those of other latents that read a load are 0. The load, which changes with it, has no part in it.
View multiplier_of_direction(const Prior& prior, std::size_t of) {
  OtherSystem plain{prior, std::vector<int>(prior.system->parameters().size())};
  std::iota(plain.shared.begin(), plain.shared.end(), 0);
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    std::shared_ptr<const StateFunction>& directions = plain.prior.latents[a].directions;
    if (a != of && !prior.latents[a].reads_multipliers()) continue;
    const VectorXd constant = VectorXd::Unit(directions->size(), 0) * (a == of ? 1 : 0);
    StateCode code;
    code.evaluate = [constant](const StateCode::States& states, const StateCode::Parameters&) {
      return MatrixXd(constant.replicate(1, states.cols()));
    };
    code.reads = std::vector<std::string>();
    directions =
        std::make_shared<CodeFunction>(std::move(code), "the direction of a coefficient", directions->size(), prior.system);
  }
  View view = View::learned_force(*prior.system);
  view.rows = {0};
  view.latent = static_cast<int>(of);
  view.other_system = std::make_shared<const OtherSystem>(std::move(plain));
  return view;
}

// What a latent is along its one direction that knows the load, as a friction coefficient. Nothing where there is hardly a load.
std::optional<LearnedForce> coefficient_of(const Posterior& posterior, std::size_t of, const MatrixXd& states,
                                           const LearnedForce& force) {
  const Latent& latent = posterior.prior().latents[of];
  const auto* const load = dynamic_cast<const LoadFunction*>(latent.directions.get());
  if (load == nullptr || latent.size() != 1 || latent.base != Latent::Base::force) return std::nullopt;
  const VectorXd& parameters = posterior.values().parameters;
  MatrixXd directions;
  if (const StateFunction* const of_multipliers = load->of_multipliers()) {
    const MatrixXd multipliers = posterior.mean(View::multipliers(*posterior.prior().system), states);
    MatrixXd with_load(states.rows() + multipliers.rows(), states.cols());
    with_load << states, multipliers;
    directions = of_multipliers->evaluate(with_load, parameters);
  } else {
    directions = load->evaluate(states, parameters);
  }
  Index row = 0;
  directions.rowwise().norm().maxCoeff(&row);
  const VectorXd direction = directions.row(row).transpose();
  std::vector<Index> loaded;
  for (Index i = 0; i < direction.size(); ++i) {
    if (std::abs(direction[i]) > 1e-3 * direction.cwiseAbs().maxCoeff()) loaded.push_back(i);
  }
  if (2 * std::ssize(loaded) < direction.size()) return std::nullopt;
  LearnedForce out = force;
  out.names = {"coefficient" + (force.names[0].find('@') == std::string::npos ? "" : "@" + latent.name)};
  out.at = force.at(loaded);
  const Posterior::Marginal coefficient =
      posterior.marginal(multiplier_of_direction(posterior.prior(), of), states(Eigen::all, loaded));
  out.mean = coefficient.mean;
  out.stddev = coefficient.stddev();
  return out;
}

// The features of a latent, of which nothing was learned outside their ranges in the training data.
class FeaturesOfData {
 public:
  FeaturesOfData(const Prior& prior, std::size_t latent, const MatrixXd& states)
      : prior_(prior), latent_(latent), of_data_(evaluate_features(prior, latent, states)) {
    constexpr double margin = 0.05;  // of the range: a curve may go a little beyond
    const RowVectorXd low = of_data_.colwise().minCoeff(), high = of_data_.colwise().maxCoeff();
    const RowVectorXd pad = margin * (high - low) + 1e-9 * low.cwiseAbs().cwiseMax(high.cwiseAbs());
    low_ = low - pad, high_ = high + pad;
  }

  // Ends of the stretch about a state along its entry k, of those from `low` to `high`, on which all features stay within.
  [[nodiscard]] std::pair<double, double> stretch(VectorXd state, Index k, double low, double high) const {
    const double start = state[k];
    const auto is_within = [&](double value) {
      state[k] = value;
      return holds(state);
    };
    const auto end = [&](double to) {
      constexpr int n_steps = 100, n_halvings = 30;
      double inside = start;
      for (int i = 1; i <= n_steps; ++i) {
        double outside = i == n_steps ? to : start + (to - start) * i / n_steps;
        if (is_within(outside)) {
          inside = outside;
          continue;
        }
        for (int half = 0; half < n_halvings; ++half) {
          const double middle = 0.5 * (inside + outside);
          (is_within(middle) ? inside : outside) = middle;
        }
        break;
      }
      return inside;
    };
    return {end(low), end(high)};
  }

  // The one that changes from state to state, always to the same side; none where others change too.
  [[nodiscard]] std::optional<Index> only_one_along(const MatrixXd& states, VectorXd& values) const {
    const MatrixXd features = evaluate_features(prior_, latent_, states);
    std::optional<Index> changing;
    for (Index d = 0; d < features.cols(); ++d) {
      if (!(features.col(d).maxCoeff() - features.col(d).minCoeff() > 1e-6 * (high_[d] - low_[d]))) continue;
      if (changing) return std::nullopt;
      changing = d;
    }
    if (!changing) return std::nullopt;
    values = features.col(*changing);
    const VectorXd steps = values.tail(values.size() - 1) - values.head(values.size() - 1);
    if (!(steps.array() > 0).all() && !(steps.array() < 0).all()) return std::nullopt;
    return changing;
  }

  [[nodiscard]] VectorXd of_data(Index feature) const { return of_data_.col(feature); }

 private:
  [[nodiscard]] bool holds(const VectorXd& state) const {
    try {
      const auto here = evaluate_features(prior_, latent_, state).row(0).array().eval();
      return (here >= low_.array() && here <= high_.array()).all();
    } catch (const InputError&) {  // where no data are a feature may have no value
      return false;
    }
  }

  const Prior& prior_;
  std::size_t latent_;
  MatrixXd of_data_;  // (N × D)
  RowVectorXd low_, high_;
};

// States along one entry of a usual one, where the features of a latent stay within those of the data. Where that is a small part of
// the entry's range, they are told by the one feature that changes there, if it is one.
struct StatesAlong {
  std::string along;
  VectorXd at, data;
  MatrixXd states;
};
std::optional<StatesAlong> states_along(const FeaturesOfData& features, const Latent& latent, const VectorXd& usual, Index k,
                                        const std::string& entry, const VectorXd& data) {
  constexpr Index n_points = 101;
  constexpr double small_part = 0.2;
  const auto [low, high] = features.stretch(usual, k, data.minCoeff(), data.maxCoeff());
  StatesAlong out{entry, VectorXd::LinSpaced(n_points, low, high), data, usual.replicate(1, n_points)};
  out.states.row(k) = out.at.transpose();
  if (high - low >= small_part * (data.maxCoeff() - data.minCoeff())) return out;
  const std::optional<Index> feature = features.only_one_along(out.states, out.at);
  if (!feature) return std::nullopt;
  out.along = latent.feature_names[static_cast<std::size_t>(*feature)];
  out.data = features.of_data(*feature);
  if (out.at[0] > out.at[n_points - 1]) {
    out.at.reverseInPlace();
    out.states = out.states.rowwise().reverse().eval();
  }
  return out;
}

// Those along the entries of the state that do most.
void move_largest(std::vector<LearnedForce>& some, std::vector<LearnedForce>& all) {
  constexpr std::ptrdiff_t most = 6;
  constexpr double worth_a_look = 0.02;  // of what the entry does that does most
  const auto effect = [](const LearnedForce& one) {
    return (one.mean.rowwise().maxCoeff() - one.mean.rowwise().minCoeff()).norm();
  };
  std::ranges::stable_sort(some, std::greater(), effect);
  const auto is_small = [&](const LearnedForce& one) { return !(effect(one) > worth_a_look * effect(some.front())); };
  const std::ptrdiff_t n = std::min(most, std::ranges::find_if(some, is_small) - some.begin());
  std::move(some.begin(), some.begin() + n, std::back_inserter(all));
}

}  // namespace

namespace {

// Where the fitted system was observed: by its accelerations, or else by what else is known.
MatrixXd own_states(const Posterior& posterior) {
  MatrixXd states(posterior.prior().system->layout().size(), 0);
  for (const bool of_ddq : {true, false}) {
    if (states.cols() > 0) break;
    for (const Observations& group : posterior.observations()) {
      if (group.view().other_system || group.view().is_of_ddq() != of_ddq) continue;
      states.conservativeResize(Eigen::NoChange, states.cols() + group.n_data());
      states.rightCols(group.n_data()) = group.states();
    }
  }
  return states;
}

}  // namespace

std::vector<LearnedForce> learned_forces(const Posterior& posterior, std::vector<std::string>* notes) {
  const Prior& prior = posterior.prior();
  const MatrixXd states = own_states(posterior);
  if (prior.reference || states.cols() == 0) return {};
  const VectorXd usual = usual_state(prior, states);
  const std::vector<std::string> entries = prior.system->state_names();
  const bool has_several = std::ranges::any_of(
      prior.latents, [&](const Latent& latent) { return !latent.kernel_is_fixed && latent.name != prior.latents[0].name; });
  std::vector<LearnedForce> all;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    if (latent.kernel_is_fixed || (a > 0 && prior.latents[a - 1].name == latent.name)) continue;  // one for each direction
    View view = View::learned_force(*prior.system);
    const std::vector<std::string> whole_names = view.names(*prior.system);
    view.latent = latents_called(prior, latent.name, "latent");
    const std::vector<std::string> names = has_several ? view.names(*prior.system, latent.name) : whole_names;
    const FeaturesOfData features(prior, a, states);
    std::vector<LearnedForce> of_latent, coefficients;
    std::vector<std::string> left_out;
    for (std::size_t k = 0; k < entries.size(); ++k) {
      const auto row = states.row(static_cast<Index>(k));
      if (!latent.features->reads(static_cast<int>(k)) || !(row.maxCoeff() > row.minCoeff())) continue;
      const std::optional<StatesAlong> path =
          states_along(features, latent, usual, static_cast<Index>(k), entries[k], row.transpose());
      if (!path) {
        left_out.push_back(entries[k]);
        continue;
      }
      const auto is_drawn = [&](const LearnedForce& one) { return one.along == path->along; };
      if (std::ranges::any_of(of_latent, is_drawn)) continue;  // by another entry that the feature reads
      try {
        const Posterior::Marginal marginal = posterior.marginal(view, path->states);
        of_latent.push_back({latent.name, path->along, names, path->at, marginal.mean, marginal.stddev(), path->data});
        if (auto one = coefficient_of(posterior, a, path->states, of_latent.back())) coefficients.push_back(*std::move(one));
      } catch (const InputError&) {  // where no data are a direction may have no value
      }
    }
    if (notes != nullptr && !left_out.empty()) {
      notes->push_back(
          fmt::format("what '{}' has learned is not drawn along {}: moved alone, {} features of the latent away from the data",
                      latent.name, fmt::join(left_out, ", "), left_out.size() == 1 ? "it takes" : "they take"));
    }
    move_largest(of_latent, all);
    move_largest(coefficients, all);
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

namespace {

// of the only position constraint, where it does not move with time; none: the constraints are no surface
std::optional<int> surface_row(const SymbolicSystem& system) {
  int row = -1;
  const std::vector<ConstraintRow>& constraints = system.definition().constraints;
  for (std::size_t k = 0; k < constraints.size(); ++k) {
    if (constraints[k].level != ConstraintRow::Level::position) continue;
    if (row >= 0) return std::nullopt;  // a curve or a point
    row = static_cast<int>(k);
  }
  if (row < 0) return std::nullopt;
  const Expression c = constraints[static_cast<std::size_t>(row)].residuals.front();
  const std::vector<std::string> read = c.graph().variables_of(c);
  if (std::find(read.begin(), read.end(), "t") != read.end()) return std::nullopt;
  return row;
}

// the coordinate in which c is never flat over the data: A's row is ∂c/∂q
int steepest_coordinate(const SystemValues& values, int row) {
  Eigen::Vector3d steepness = Eigen::Vector3d::Constant(std::numeric_limits<double>::infinity());
  for (int i = 0; i < values.n_states(); ++i) {
    const Eigen::Vector3d slope = values.A(i).row(row).cwiseAbs().transpose();
    steepness = steepness.cwiseMin(slope / std::max(slope.maxCoeff(), std::numeric_limits<double>::min()));
  }
  int steepest = 0;
  steepness.maxCoeff(&steepest);
  return steepest;
}

// n values from below the data to above
VectorXd range_of(const Ref<const MatrixXd>& states, int coordinate, double margin, Index n) {
  const double low = states.row(coordinate).minCoeff(), high = states.row(coordinate).maxCoeff();
  const double pad = margin * std::max(high - low, 1e-9 * std::abs(high) + 1e-300);
  return VectorXd::LinSpaced(n, low - pad, high + pad);
}

// states at each point of the grid, one after another along `scan`
MatrixXd probe_states(const ConstraintSurface& surface, const VectorXd& scan, Index n_entries) {
  MatrixXd probes = MatrixXd::Zero(n_entries, surface.first_grid.size() * surface.second_grid.size() * scan.size());
  Index column = 0;
  for (const double first : surface.first_grid) {
    for (const double second : surface.second_grid) {
      for (const double solved : scan) {
        probes(surface.first, column) = first;
        probes(surface.second, column) = second;
        probes(surface.solved, column++) = solved;
      }
    }
  }
  return probes;
}

// every change of sign is a point of the surface; the straight line between its ends is exact where c is linear in the
// coordinate
void add_sheets(const Eigen::RowVectorXd& residual, const VectorXd& scan, ConstraintSurface& surface) {
  const Index n_first = surface.first_grid.size(), n_second = surface.second_grid.size(), n_scan = scan.size();
  for (Index i = 0; i < n_first; ++i) {
    for (Index j = 0; j < n_second; ++j) {
      std::size_t sheet = 0;
      const Index first = (i * n_second + j) * n_scan;
      for (Index s = 0; s + 1 < n_scan; ++s) {
        const double here = residual[first + s], next = residual[first + s + 1];
        if (!(here * next < 0 || here == 0)) continue;
        if (sheet == surface.sheets.size()) surface.sheets.emplace_back(MatrixXd::Constant(n_first, n_second, not_a_number));
        surface.sheets[sheet++](i, j) = here == 0 ? scan[s] : scan[s] + (scan[s + 1] - scan[s]) * here / (here - next);
      }
    }
  }
}

}  // namespace

std::optional<ConstraintSurface> constraint_surface(const SymbolicSystem& system, const Ref<const VectorXd>& parameters,
                                                    const Ref<const MatrixXd>& states) {
  if (system.nq() != 3 || states.cols() < 2 || states.topRows(3).hasNaN()) return std::nullopt;
  const std::optional<int> row = surface_row(system);
  if (!row) return std::nullopt;
  const std::vector<System::Residual>& labels = system.residual_labels();
  const auto label =
      std::find_if(labels.begin(), labels.end(), [&](const auto& one) { return one.row == *row && !one.velocity; });

  ConstraintSurface surface;
  surface.solved = steepest_coordinate(system.evaluate(states, parameters), *row);
  surface.first = surface.solved == 0 ? 1 : 0;
  surface.second = surface.solved == 2 ? 1 : 2;

  constexpr Index n_grid = 25, n_scan = 41;
  surface.first_grid = range_of(states, surface.first, 0.08, n_grid);
  surface.second_grid = range_of(states, surface.second, 0.08, n_grid);
  const VectorXd scan = range_of(states, surface.solved, 0.6, n_scan);
  const MatrixXd probes = probe_states(surface, scan, system.layout().size());
  const Eigen::RowVectorXd residual = system.residuals(probes, parameters).row(label - labels.begin());
  add_sheets(residual, scan, surface);
  if (surface.sheets.empty()) return std::nullopt;
  return surface;
}

std::vector<Option> options(ReportOptions& options) {
  return {
      {"data", &options.data, "CSV", "test log: CSV with states and accelerations that the fit has not seen"},
      {"system", &options.system, "OTHER.toml",
       "model file of the system of `data` and `truth`, if it is another one with the same coordinates, inputs and latents", "",
       "", "", "data"},
      {"truth", &options.truth, "MODEL", "model file whose [truth] is the true acceleration, shown beside the prediction"},
      columns_option(options.columns, "columns of `data` by other names"),
  };
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
  // what the fit does not read may still be drawn, and be read by the truth
  LogReader reader = open_log(*at.model, table, request.columns);
  const std::vector<std::string> names = system.state_names();
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (!data.states.row(static_cast<Index>(k)).hasNaN() || !reader.has(names[k])) continue;
    std::vector<bool> only(names.size(), false);
    only[k] = true;
    try {
      data.states.row(static_cast<Index>(k)) = reader.states(only).row(static_cast<Index>(k));
    } catch (const InputError&) {
      // not numbers: then it is not drawn
    }
  }
  double unit_of_time = 1;
  const std::vector<std::string> wrong =
      wrong_rates_of(system, at.prior, table, checked_columns(*at.model, {&table}, request.columns), &unit_of_time);
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

namespace {

// What the fit said when it ended; of a file that does not hold it, what its data tell without fitting again.
std::vector<std::string> notes_of_fit(const FitFile& fit, const Posterior& posterior, const CrossValidation& cross_validation) {
  if (fit.notes) return *fit.notes;
  std::vector<std::string> notes = notes_of(fit.report, posterior);
  if (fit.report.inducing) add_inducing_note(*fit.report.inducing, notes);
  add_residual_notes(posterior, {posterior.observations()}, cross_validation.residuals, notes);
  add_stretch_note(cross_validation, notes, posterior.prior());
  const std::string correlated = correlated_text(cross_validation.residuals);
  if (!correlated.empty()) notes.push_back(correlated);
  return notes;
}

}  // namespace

Report collect_report(FitFile fit, const Posterior& posterior, const ReportRequest& request, std::vector<std::string>& notes) {
  if (!request.data && !request.columns.empty()) {
    throw InputError("`map` names columns of `data`, which is not given; the fit has its own data");
  }
  if (!request.data && request.system) throw InputError("`system` is that of `data`, which is not given");
  Report report;
  report.label = fit.model.system->name();
  report.library = fit.library.empty() ? version() : fit.library;
  report.fit = std::move(fit);
  report.data = training_data(report.fit, posterior);
  report.cross_validation = cross_validate(report.fit, posterior);
  report.notes = notes_of_fit(report.fit, posterior, report.cross_validation);
  report.relevance = relevance_of(posterior);
  report.learned = learned_forces(posterior, &report.notes);
  if (request.data) {
    report.data.push_back(compare(report.fit, posterior, request, notes));
    add_learned_note(report.fit, *request.data, notes);
  }
  if (request.truth) add_truth(request, report);
  if (const SymbolicSystem* system = report.fit.model.symbolic_system(); system != nullptr && !report.data.empty()) {
    MatrixXd q(system->layout().size(), 0);
    for (const ReportData& data : report.data) {
      if (data.is_of_other_system) continue;  // which has another surface
      q.conservativeResize(Eigen::NoChange, q.cols() + data.states.cols());
      q.rightCols(data.states.cols()) = data.states;
    }
    report.surface = constraint_surface(*system, posterior.values().parameters, q);
  }
  return report;
}

Report collect_report(const std::filesystem::path& fit, const ReportRequest& request, std::vector<std::string>& notes) {
  FitFile file = FitFile::read(fit);
  const Posterior posterior = file.posterior();
  Report report = collect_report(std::move(file), posterior, request, notes);
  report.label = fit.string();
  report.file_date = date_of(fit);
  return report;
}

std::vector<Report> collect_reports(const ReportOptions& options, std::vector<std::string>& notes) {
  const auto model = [](const std::string& path) {
    return path.empty() ? nullptr : std::make_shared<const Model>(Model::read(path));
  };
  ReportRequest request;
  if (!options.data.empty()) request.data = CsvTable::read(options.data, CsvTable::Keep::numbers);
  request.truth = model(options.truth);
  request.system = model(options.system);
  request.columns = options.columns;
  std::vector<Report> reports;
  for (const std::string& fit : options.fits) {
    std::vector<std::string> of_this;
    reports.push_back(collect_report(std::filesystem::path(fit), request, of_this));
    // the log is read for each fit, but what is said of it is said once
    for (std::string& note : of_this) {
      if (std::ranges::find(notes, note) == notes.end()) notes.push_back(std::move(note));
    }
  }
  return reports;
}

}  // namespace gp2
