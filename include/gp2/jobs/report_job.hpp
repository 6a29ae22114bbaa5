#pragma once

#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/mechanics/check.hpp"

namespace gp2 GP2_API {

/// How much a feature of a latent matters: in the factor of its kernel, and the direction, where it does most.
struct Relevance {
  std::string latent, feature;
  double lengthscale = 0;
  double spread = 0;     // standard deviation over the training data
  double relevance = 0;  // spread / lengthscale; 1 / lengthscale of a periodic kernel, whose lengthscale has no unit
  /// Largest over the latent's columns of s · relevance / the column's default scale: what the latent changes by over one spread,
  /// in spreads of the acceleration. An effect that is nearly linear has a long lengthscale and a large s: this sees it, the
  /// relevance does not. Nothing where directions are learned.
  std::optional<double> effect = std::nullopt;
};

/// The force that a latent adds to F along one entry of the state, mean and standard deviation. All other entries are as in one row
/// of the training data, the nearest to their medians. Or what it is along one direction that knows the load: a coefficient.
///
/// It goes as far as the training data do, in the entry and in every feature of the latent, or nearly. Where features such as q1 - q2
/// leave it less than a fifth of the entry's range, it is along the one feature that the entry changes.
struct LearnedForce {
  std::string latent, along;       // the second: an entry of the state, or a feature
  std::vector<std::string> names;  // force_NAME, or `coefficient`; with @LATENT behind where there are several (d)
  Eigen::VectorXd at;              // ascending; of an entry evenly (n)
  Eigen::MatrixXd mean, stddev;    // (d × n)
  Eigen::VectorXd data;            // where the training data are (N)
  bool are_all_rows = true;        // or some, of many that a fit does not keep
};

/// What each latent has learned, along the entries of the state that it reads and that change it most.
/// @param notes  receives along which entries nothing is drawn, and why; may be null
std::vector<LearnedForce> learned_forces(const Posterior& posterior, std::vector<std::string>* notes = nullptr);

/// The motion of the fit beside a measured one, from the same start: N rows of the log where it goes on longest without a break.
struct Rollout {
  std::string reason;              // why there is none; empty: there is one
  Eigen::VectorXd times;           // (N) [s]
  Eigen::MatrixXd measured;        // q, angles without jumps (nq × N)
  Eigen::MatrixXd simulated;       // q of the mean motion; NaN beyond what it reached (nq × N)
  Eigen::MatrixXd stddev;          // of sample motions about it; NaN beyond what the first of them to end reached (nq × N)
  std::string ended;               // why the mean motion ended early; empty: it did not
  std::optional<double> leaves;    // first time at which they are apart by more than 2 stddev and 5 % of the measured range
  int leaving = 0;                 // the coordinate that is
  std::optional<double> far_from;  // first time at which the mean motion is far from the training data
  Eigen::MatrixXd multipliers, multipliers_stddev;    // λ at the measured states (nc × N)
  Eigen::MatrixXd simulated_multipliers;              // λ of the mean motion (nc × N)
  Eigen::VectorXd energy, simulated_energy;           // kinetic + potential, learned ones too (N) [J]; empty: no potential
  std::vector<std::string> potentials;                // latents that are one (p)
  Eigen::MatrixXd potential, potential_stddev;        // of each less that at the start, at the measured states (p × N) [J]
  std::vector<std::string> points;                    // of the mechanism, as [drawing] of the model has them, or a robot's
  std::vector<std::vector<int>> lines;                // through points
  Eigen::MatrixXd measured_points, simulated_points;  // two coordinates of each point after the other, or three (· × N) [m]
};

/// Measured accelerations at N states, d outputs of them, and what the fit says there. Standard deviations are without noise.
struct ReportData {
  std::string name;    // "training", "training 2", "test"
  std::string source;  // where it came from, for people
  bool is_test = false;
  bool is_of_other_system = false;
  Evaluation evaluation;
  std::vector<std::string> outputs;      // d
  std::vector<int> rows;                 // of ddq, d
  Eigen::MatrixXd states;                // (layout size × N), NaN where not kept
  Eigen::MatrixXd measured;              // (d × N)
  Eigen::MatrixXd noise_stddev;          // of each measurement (d × N); NaN where neither the log nor training knows it
  Eigen::MatrixXd predicted, stddev;     // ddq  (nq × N)
  Eigen::MatrixXd unconstrained;         // ā    (nq × N), empty where M is singular
  Eigen::MatrixXd unconstrained_stddev;  //      (nq × N)
  Eigen::MatrixXd constraint_error;      // |A ddq − b| of the predicted mean, fitted parameters (nc × N)
  Eigen::VectorXd distance;              // from the data, as Posterior::distance_from_data (N)
  Eigen::MatrixXd truth_inputs;          // what acts by the delays and lags of the truth (nu × N); empty: as in `states`
  Eigen::MatrixXd truth;                 // the true ddq (nq × N), NaN where unknown; empty where it is not asked for
  std::vector<std::pair<std::string, Eigen::VectorXd>> features;  // φ by name (N each)
  std::optional<ConstraintViolation> violation;
  std::vector<ConstraintResidual> constraint_residuals;  // of the measured accelerations
  LowerRank lower_rank;                                  // states at which constraints let go, or follow from each other
  std::vector<std::string> independent;  // accelerations to observe instead, where the outputs follow from each other
  Rollout rollout;
  std::vector<std::string> notes;  // on the log of a test: columns that are not the rates of others

  /// Root mean square of truth − predicted per output (d); NaN where the truth is not known.
  [[nodiscard]] Eigen::VectorXd rmse_to_truth() const;
};

/// (measured − predicted) / √(stddev² + noise²)  (d × N); NaN where one is not known.
Eigen::MatrixXd standardised_errors(const ReportData& data);

/// Share of measurements within the central interval of nominal probability p, measurement noise included.
///
/// @param levels  p (K)
/// @returns (K × d + 1): each output, then all of them; NaN columns where the noise is not known
Eigen::MatrixXd coverage(const ReportData& data, const Eigen::Ref<const Eigen::VectorXd>& levels);

/// pit_histogram of the same errors, of the points near the data or of those far from them, as counts.
/// @returns (Calibration::n_bins × d + 1) as coverage
Eigen::MatrixXd pit_counts(const ReportData& data, bool far);

/// The points of a position constraint c(q) = 0 in three coordinates, as sheets over a grid in two of them.
struct ConstraintSurface {
  int first = 0, second = 1, solved = 2;    // coordinates: grid directions, and the one solved for
  Eigen::VectorXd first_grid, second_grid;  // (n), (m)
  std::vector<Eigen::MatrixXd> sheets;      // (n × m), NaN where there is no point
};

/// @returns nothing unless there are three coordinates and one position-level constraint that no time enters
std::optional<ConstraintSurface> constraint_surface(const SymbolicSystem& system,
                                                    const Eigen::Ref<const Eigen::VectorXd>& parameters,
                                                    const Eigen::Ref<const Eigen::MatrixXd>& states);

/// A thing to know or to do, in plain words.
struct Advice {
  enum class Level { good, note, warning };
  Level level = Level::note;
  std::string text;  // what was found
  std::string mend;  // what to do
};

/// Everything on the page.
struct Report {
  std::string label;  // what it is called beside others: its file, or its system
  FitFile fit;
  std::string library;    // the version that fitted
  std::string file_date;  // of the fit file, YYYY-MM-DD; empty: it is in no file
  std::vector<ReportData> data;
  std::vector<std::string> notes;    // what the fit says of itself and its data
  CrossValidation cross_validation;  // of the training data
  std::vector<Relevance> relevance;
  std::vector<LearnedForce> learned;
  std::optional<ConstraintSurface> surface;
  std::string truth_source;  // the model that tells the truth
};

struct ReportOptions {
  std::vector<std::string> fits;               // FIT.json
  std::string data;                            // CSV of a test; empty: none
  std::string truth;                           // model file that tells the true acceleration; empty: none
  std::map<std::string, std::string> columns;  // model's name -> log's name, of `data`
  std::string system = {};  // model file of the other system that `data` and `truth` are of; empty: the fit's own
};

/// data, system, truth, map.
std::vector<Option> options(ReportOptions& options);

/// The same as what was read.
struct ReportRequest {
  std::optional<CsvTable> data;
  std::shared_ptr<const Model> truth, system;
  std::map<std::string, std::string> columns;
};

/// The test of a request, which it has, and what the fit says there.
/// @param fit, notes  as collect_report
ReportData compare(const FitFile& fit, const Posterior& posterior, const ReportRequest& request, std::vector<std::string>& notes);

/// Predicts, evaluates and collects.
/// @param fit    with the data of the posterior (FitFile::take_data)
/// @param notes  receives what a person should know
/// @throws InputError for data and models that do not fit the fit.
Report collect_report(FitFile fit, const Posterior& posterior, const ReportRequest& request, std::vector<std::string>& notes);
/// The same of a FIT.json.
Report collect_report(const std::filesystem::path& fit, const ReportRequest& request, std::vector<std::string>& notes);
/// The same from files, one for each fit. @throws InputError also for files that cannot be read.
std::vector<Report> collect_reports(const ReportOptions& options, std::vector<std::string>& notes);

/// What the figures say about how to go on, most pressing first.
std::vector<Advice> learning_advice(const Report& report);

}  // namespace gp2
