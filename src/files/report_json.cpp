#include <algorithm>
#include <cmath>
#include <limits>
#include <map>

#include "files/fit_json.hpp"
#include "inference/inducing_summary.hpp"

namespace gp2::fit_json {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

Json restart_json(const RestartReport& r) {
  return {{"objective", r.objective},     {"nll", r.negative_log_likelihood},           {"iterations", r.iterations},
          {"evaluations", r.evaluations}, {"failed_evaluations", r.failed_evaluations}, {"converged", r.converged},
          {"termination", r.termination}};
}

RestartReport restart_from(const ParsedJson& json) {
  return {number_or_infinity(json.at("objective")), number_or_infinity(json.at("nll")),     integer(json.at("iterations")),
          integer(json.at("evaluations")),          integer(json.at("failed_evaluations")), json.at("converged").get<bool>(),
          json.at("termination").get<std::string>()};
}

// A matrix of correlations, of which there is a column for each hyperparameter.
template <class Column>
MatrixXd correlation_from(const ParsedJson& json, std::size_t n, const Column& column) {
  MatrixXd out = columns_from(json, n, column);
  if (out.cols() != out.rows()) throw InputError("correlations that are not square");
  return out;
}

Json uncertainty_json(const LaplaceUncertainty& uncertainty) {
  return {{"stddev", vector_json(uncertainty.stddev)},
          {"held", uncertainty.held},
          {"correlation", columns_json(uncertainty.correlation)},
          {"undetermined", columns_json(uncertainty.undetermined)},
          {"distance_from_optimum", uncertainty.distance_from_optimum}};
}

/// @param n  hyperparameters
LaplaceUncertainty uncertainty_from(const ParsedJson& json, std::size_t n) {
  const auto stddevs = [n](const ParsedJson& values, ReadNumber entry) {
    if (array(values).size() != n) throw InputError(fmt::format("standard errors of {} of {} hyperparameters", values.size(), n));
    return vector_from(values, entry);
  };
  const auto column = [&](const ParsedJson& values) { return stddevs(values, number_or_missing); };
  LaplaceUncertainty out;
  out.stddev = stddevs(json.at("stddev"), number_or_infinity);
  for (const ParsedJson& k : array(json.at("held"))) {
    const int index = integer(k);
    if (index < 0 || index >= static_cast<int>(n)) throw InputError(fmt::format("{} is no hyperparameter", index));
    out.held.push_back(index);
  }
  out.correlation = correlation_from(json.at("correlation"), n, column);
  out.undetermined = columns_from(json.at("undetermined"), n, column);
  out.distance_from_optimum = number_or_infinity(json.at("distance_from_optimum"));
  return out;
}

// what is told of the draws of each hyperparameter
constexpr std::array<Named<VectorXd HyperparameterDraws::*>, 6> draw_statistics = {
    {{&HyperparameterDraws::mean, "mean"},
     {&HyperparameterDraws::stddev, "stddev"},
     {&HyperparameterDraws::lower, "lower"},
     {&HyperparameterDraws::upper, "upper"},
     {&HyperparameterDraws::r_hat, "r_hat"},
     {&HyperparameterDraws::effective_size, "effective_size"}}};

Json draws_json(const HyperparameterDraws& draws) {
  Json json = {{"values", columns_json(draws.values)}};
  for (const auto& [statistic, name] : draw_statistics) json[name] = vector_json(draws.*statistic);
  json.update({{"correlation", columns_json(draws.correlation)},
               {"n_chains", draws.n_chains},
               {"evaluations", draws.evaluations},
               {"acceptance", draws.acceptance}});
  return json;
}

HyperparameterDraws draws_from(const ParsedJson& json, const std::vector<Hyperparameter>& hyperparameters) {
  const std::size_t n = hyperparameters.size();
  const auto column = [n](const ParsedJson& values) {
    if (array(values).size() != n) throw InputError(fmt::format("draws of {} of {} hyperparameters", values.size(), n));
    VectorXd out = vector_from(values);
    if (!(out.cwiseAbs().array() <= largest_number).all()) throw InputError("draws hold a number that is too large");
    return out;
  };
  // each is a matrix to factor
  constexpr std::size_t most = 1000;
  if (array(json.at("values")).empty() || json.at("values").size() > most) {
    throw InputError(fmt::format("{} draws of hyperparameters, expected 1 … {}", json.at("values").size(), most));
  }
  HyperparameterDraws out;
  out.values = columns_from(json.at("values"), n, column);
  for (Index k = 0; k < out.values.rows(); ++k) {
    const Hyperparameter& h = hyperparameters[static_cast<std::size_t>(k)];
    if (!h.positive || out.values.row(k).minCoeff() >= smallest_scale) continue;
    throw InputError(
        fmt::format("a draw of hyperparameter '{}' has the impossible value {}", h.name, out.values.row(k).minCoeff()));
  }
  for (const auto& [statistic, name] : draw_statistics) out.*statistic = column(json.at(name));
  out.correlation = correlation_from(json.at("correlation"), n, column);
  out.n_chains = integer(json.at("n_chains"));
  out.evaluations = integer(json.at("evaluations"));
  out.acceptance = number(json.at("acceptance"));
  return out;
}

DistrustedValue distrusted_from(const ParsedJson& json, const std::vector<Observations>& observations, int step) {
  const DistrustedValue one{integer(json.at("log")), integer(json.at("row")), integer(json.at("state")),
                            number(json.at("distance")), number(json.at("noise_factor"))};
  const auto is_below = [](int i, std::ptrdiff_t n) { return i >= 0 && i < n; };
  if (!is_below(one.group, std::ssize(observations)) ||
      !is_below(one.row, observations[static_cast<std::size_t>(one.group)].view().size()) ||
      !is_below(one.state / step, observations[static_cast<std::size_t>(one.group)].n_data()) || one.state < 0) {
    throw InputError(fmt::format("value {} of state {} of log {} is not among the data", one.row, one.state, one.group));
  }
  return one;
}

}  // namespace

Json report_json(const FitReport& report) {
  Json json = {{"nll", report.negative_log_likelihood},
               {"objective", report.objective},
               {"converged", report.converged},
               {"termination", report.termination},
               {"iterations", report.iterations},
               {"best_restart", report.best_restart},
               {"restarts", Json::array()}};
  for (const RestartReport& restart : report.restarts) json["restarts"].push_back(restart_json(restart));
  if (report.uncertainty) json["uncertainty"] = uncertainty_json(*report.uncertainty);
  if (report.draws) json["draws"] = draws_json(*report.draws);
  if (report.inducing) json["inducing"] = inducing_json(*report.inducing);
  for (const DistrustedValue& one : report.distrusted) {
    json["distrusted"].push_back({{"log", one.group},
                                  {"row", one.row},
                                  {"state", one.state},
                                  {"distance", one.distance},
                                  {"noise_factor", one.noise_factor}});
  }
  return json;
}

void read_report(const ParsedJson& json, const Prior& prior, const std::vector<Observations>& observations, FitReport& report) {
  report.negative_log_likelihood = number(json.at("nll"));
  report.objective = number(json.at("objective"));
  json.at("converged").get_to(report.converged);
  json.at("termination").get_to(report.termination);
  report.iterations = integer(json.at("iterations"));
  report.best_restart = integer(json.at("best_restart"));
  for (const ParsedJson& restart : array(json.at("restarts"))) report.restarts.push_back(restart_from(restart));
  if (json.contains("uncertainty")) {
    report.uncertainty = uncertainty_from(json.at("uncertainty"), report.hyperparameters.size());
  }
  if (json.contains("draws")) report.draws = draws_from(json.at("draws"), report.hyperparameters);
  if (json.contains("inducing")) {
    const ParsedJson& inducing = json.at("inducing");
    report.inducing = inducing_from(inducing, prior);
    if (inducing.contains("summary")) {
      report.inducing->summary = summary_from(inducing.at("summary"), prior, observations, report);
    }
  }
  const int step = report.inducing && report.inducing->summary ? report.inducing->summary->kept.step : 1;
  if (!json.contains("distrusted")) return;
  for (const ParsedJson& one : array(json.at("distrusted"))) {
    report.distrusted.push_back(distrusted_from(one, observations, step));
  }
}

Json actuators_json(const std::vector<ActuatorEstimate>& estimates) {
  Json json = Json::array();
  for (const ActuatorEstimate& one : estimates) {
    json.push_back(
        {{"name", one.name}, {"value", one.value}, {"stddev", one.stddev}, {"lower", one.lower}, {"upper", one.upper}});
    if (std::isinf(one.stddev)) json.back()["undetermined"] = true;  // stddev is null, as where it is NaN
    if (!one.moves.empty()) json.back()["moves"] = one.moves;
  }
  return json;
}

std::vector<ActuatorEstimate> actuators_from(const ParsedJson& json, std::vector<Actuator>& actuators) {
  std::vector<ActuatorEstimate> estimates;
  std::map<std::string, double> values;
  for (const ParsedJson& one : array(json)) {
    ActuatorEstimate& estimate = estimates.emplace_back();
    one.at("name").get_to(estimate.name);
    estimate.value = number(one.at("value"));
    if (!(estimate.value >= 0)) throw InputError(fmt::format("{} must not be negative, got {}", estimate.name, estimate.value));
    const bool is_known = std::ranges::any_of(actuators, [&](const Actuator& actuator) {
      return actuator.delay.name == estimate.name || actuator.lag.name == estimate.name;
    });
    if (!is_known) throw InputError(fmt::format("'{}' is not of this model", estimate.name));
    values.emplace(estimate.name, estimate.value);
    estimate.lower = number(one.at("lower"));
    estimate.upper = number(one.at("upper"));
    const bool is_open = one.value("undetermined", false);
    estimate.stddev = is_open ? std::numeric_limits<double>::infinity() : number_or_missing(one.at("stddev"));
    if (!one.contains("moves")) continue;
    for (const auto& [parameter, move] : one.at("moves").items()) estimate.moves.emplace(parameter, number(move));
  }
  set_values(values, actuators);
  return estimates;
}

}  // namespace gp2::fit_json
