#pragma once

#include <algorithm>
#include <fstream>
#include <map>
#include <numeric>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "gp2/inference/evaluation.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "reference_data.hpp"
#include "test_models.hpp"

// Fits of whole data sets and what they score.
namespace gp2::test {

/// One of the systems of Geist & Trimpe 2020.
struct PublishedSystem {
  std::vector<std::string> parameters_with_mean, parameters_without_mean;  // those the paper estimates
  double constraint_error;  // of any prediction with known parameters: the level of the analytic equation itself
};

inline const PublishedSystem& published_system(const std::string& name) {
  static const std::vector<std::string> surface = {"p1", "p2", "p3", "p4", "p5", "p6", "p7"};
  static const std::map<std::string, PublishedSystem> systems = {
      {"surface", {surface, surface, 5e-15}},
      {"unicycle", {{"R", "Ic"}, {"R", "Ic"}, 1e-15}},
      {"duffing", {{"k1", "k2", "c1", "c2", "A0", "alpha", "omega"}, {"A0", "alpha", "omega"}, 1e-13}}};
  return systems.at(name);
}

inline std::string model_of(const std::string& system) { return "experiments/" + system + "_published.toml"; }

/// A fit of a log, and how its predictions compare with another log.
struct Score {
  FitReport report;
  Evaluation evaluation;
  Eigen::VectorXd training_spread;  // population formula

  /// As the paper writes it: of outputs divided by their spread.
  [[nodiscard]] double normalised_likelihood(int n_data) const {
    return report.negative_log_likelihood - n_data * training_spread.array().log().sum();
  }
};

inline Score score(const Model& model, const std::filesystem::path& train, const std::filesystem::path& test,
                   const FitProblemOptions& problem_options, int n_restarts) {
  const FitProblem problem = make_fit_problem(model, CsvTable::read(train), problem_options);
  FitOptions options;
  options.n_restarts = n_restarts;
  options.seed = problem_options.seed;
  options.n_threads = 2;
  const Fit result = fit(problem.prior, problem.observations, problem.hyperparameters, options);
  const Observations& observed = problem.observations.front();
  const LogStates grid =
      read_log_states(problem.prior, observed.view(), model, CsvTable::read(test), {}, observed.view().names(*model.system));
  return {result.report, evaluate_predictions(result.posterior, grid.states, observed.view().rows, grid.accelerations),
          row_stddev(observed.values())};
}

inline double mean(const std::vector<double>& values) {
  return std::accumulate(values.begin(), values.end(), 0.0) / static_cast<double>(values.size());
}
inline double worst(const std::vector<double>& values) { return *std::max_element(values.begin(), values.end()); }
inline double median(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  const std::size_t half = values.size() / 2;
  return values.size() % 2 == 1 ? values[half] : (values[half - 1] + values[half]) / 2;
}

inline nlohmann::json reference_json(const std::string& name) {
  return nlohmann::json::parse(std::ifstream(reference_file(name)));
}

}  // namespace gp2::test
