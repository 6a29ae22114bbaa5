#pragma once

#include <filesystem>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/fit.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/model.hpp"
#include "model/toml_value.hpp"

namespace gp2::command {

/// What the person asked for.
struct ReproduceOptions {
  std::filesystem::path experiments;          // folder of the definitions
  std::optional<std::filesystem::path> data;  // folder of published observations
  std::filesystem::path output;
  std::vector<Protocol::Name> protocols;
  std::optional<int> runs;
  int threads = 0;
};

std::string word(Protocol::Name protocol);  // "paper", "default"

/// A definition in experiments/*.toml, or one of its tables, read with errors that name file, line and key.
class Section {
 public:
  static Section read(const std::filesystem::path& path);

  [[nodiscard]] bool has(const std::string& key) const;
  [[nodiscard]] bool is_list(const std::string& key) const;
  [[nodiscard]] std::string text(const std::string& key) const;  // or of a number
  [[nodiscard]] std::string text(const std::string& key, const std::string& otherwise) const;
  [[nodiscard]] std::string mean() const;  // the prior mean: "zero" where it is not given, or "force"
  [[nodiscard]] double number(const std::string& key) const;
  [[nodiscard]] int integer(const std::string& key) const;
  [[nodiscard]] bool flag(const std::string& key) const;  // false where it is not given
  [[nodiscard]] std::vector<double> numbers(const std::string& key, std::optional<std::size_t> how_many = std::nullopt) const;
  [[nodiscard]] std::vector<bool> flags(const std::string& key) const;
  [[nodiscard]] std::vector<std::string> texts(const std::string& key) const;
  [[nodiscard]] Section section(const std::string& key) const;
  [[nodiscard]] std::vector<Section> sections(const std::string& key) const;  // [[key]]
  [[nodiscard]] std::vector<std::string> keys() const;                        // by name

 private:
  struct Document;
  Section(std::shared_ptr<const Document> document, TomlValue table) : document_(std::move(document)), table_(std::move(table)) {}
  [[nodiscard]] TomlValue value(const std::string& key) const;  // that must be there

  std::shared_ptr<const Document> document_;  // that the table stands in
  TomlValue table_;
};

/// A way to predict accelerations, as a [[method]] defines it.
struct Method {
  std::string name;
  bool is_truth = false;                   // the analytic equation itself
  std::optional<Baseline::Kind> baseline;  // otherwise GP²
  std::string mean = "zero";
  bool estimate = false;  // the system's parameters
  std::map<Protocol::Name, int> n_restarts;
  double reduction_tolerance = FitOptions().reduction_tolerance;  // where the optimiser stops
  int max_iterations = FitOptions().max_iterations;
  int max_escapes = FitOptions().max_escapes;
  int n_inducing = 0;            // variables at most, through which it learns; 0: exactly
  bool standard_errors = false;  // of the system's parameters
  bool wide = false;             // of a baseline: bounds that do not matter instead of the published ones

  /// Whether its training differs between the protocols.
  [[nodiscard]] bool has_protocol() const { return !is_truth && !baseline; }
};

/// One system of an experiment: its model, and the grid that predictions are tested on.
struct ExperimentSystem {
  std::string name;
  Model model;
  std::map<std::string, std::vector<std::string>> parameters;  // to estimate, per mean: "zero", "force"
  Eigen::MatrixXd grid_states, grid_truth;                     // (layout size × points), (nq × points), noise-free

  /// @param section  name, model, grid, parameters
  /// @param methods  for which `parameters` must say what to estimate
  ExperimentSystem(const Section& section, const std::filesystem::path& experiments, const std::vector<Method>& methods);
};

/// Noisy observations of a run as a log: the published file, or drawn from the same distributions by the number of the run.
/// @param pattern  of the published files, "{}" standing for the run
CsvTable observations_of(const Model& model, const std::string& pattern, const std::optional<std::filesystem::path>& data,
                         int run, int n);

/// States along a line, and the true accelerations there. `line` has one range from left to right, or several, numbers and
/// expressions for the other entries of [sampling], and `points`; what it does not name is 0, or follows from the constraints.
struct Line {
  std::string name;  // of the entry that runs
  Eigen::MatrixXd states, truth;
};
Line line_of(const Section& line, const Model& model);

/// How many runs to do: those asked for, at most those that are published.
/// @throws InputError when more are asked for than there are.
int number_of_runs(const std::string& pattern, const std::optional<std::filesystem::path>& data, std::optional<int> asked,
                   int defined);

Method method_of(const Section& section);  // restarts are not set
Method method_of(const Section& section, const Section& restarts);
std::vector<Method> methods_of(const Section& definition);

/// A method trained on a log.
struct Trained {
  FitProblem problem;
  Fit fit;
};
/// @param estimate  parameters, where the method estimates any
/// @param start     where the first restart begins, of hyperparameters by the same names; empty: at their own values
Trained train(const Model& model, const std::vector<std::string>& estimate, const Method& method, Protocol::Name protocol,
              const CsvTable& log, int run, int n_threads, const std::vector<Hyperparameter>& start = {});

/// How well a method predicts on the grid.
struct Score {
  double rmse_normalised = std::numeric_limits<double>::quiet_NaN();  // mean over outputs, in training standard deviations
  double max_constraint_error = 0;                                    // with the true parameters
  double negative_log_likelihood = std::numeric_limits<double>::quiet_NaN();
  double seconds = 0;
};
/// @param train_at_most  rows for the hyperparameters, the first of the log; all rows are conditioned on
Score score_of(const ExperimentSystem& system, const Method& method, Protocol::Name protocol, const CsvTable& log, int run,
               int n_threads, std::optional<int> train_at_most = std::nullopt);

/// A picture that is not drawn, of numbers that are written.
class PictureError : public InputError {
 public:
  using InputError::InputError;
};

/// Draws DIR/name.svg and DIR/name.png with gnuplot, by the script name.gp beside the definitions; it reads DIR/name….csv.
/// @throws PictureError when there is no gnuplot, or it fails.
void plot(const ReproduceOptions& options, const std::string& name);

// One function per experiment.
void reproduce_table1(const ReproduceOptions& options);
void reproduce_learning_curve(const ReproduceOptions& options);
void reproduce_fig3a(const ReproduceOptions& options);
void reproduce_fig3b(const ReproduceOptions& options);
void reproduce_fig3c(const ReproduceOptions& options);
void reproduce_figS7(const ReproduceOptions& options);
void reproduce_arm_on_surface(const ReproduceOptions& options);
void reproduce_arm_mass(const ReproduceOptions& options);

}  // namespace gp2::command
