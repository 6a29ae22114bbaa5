#include <algorithm>
#include <chrono>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/resample.hpp"
#include "gp2/simulation/generate.hpp"
#include "reproduce/experiment.hpp"
#include "reproduce/table.hpp"
#include "streams.hpp"

// The benchmark of Rath, Geist & Trimpe 2021: an arm that slides on a plane.
namespace gp2::command {

namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Samples of a motion, measured with noise.
struct ArmMotion {
  GeneratedData measured;
  MatrixXd truth;  // (nq × N)

  [[nodiscard]] ArmMotion only(const std::vector<int>& samples) const {
    return {{measured.states(Eigen::all, samples), measured.accelerations(Eigen::all, samples), measured.known},
            truth(Eigen::all, samples)};
  }
};

ArmMotion motion_of(const Model& model, const Section& section) {
  GenerateOptions options;
  options.n = section.integer("samples");
  options.seed = static_cast<std::uint64_t>(section.integer("seed"));
  options.noise_stddev = Eigen::Map<const VectorXd>(model.noise.stddev.data(), model.system->nq());
  ArmMotion motion{generate(model, options), {}};
  motion.truth = true_acceleration(model, motion.measured.states);
  return motion;
}

/// Which samples are learned from, and which tested on.
struct Split {
  std::vector<int> training, blocks;
};

// without the first and the last of a motion
std::vector<int> samples_of(const Section& section) {
  const int n = section.integer("samples"), leave = section.integer("leave");
  const int every = section.has("every") ? std::max(1, section.integer("every")) : 1;
  std::vector<int> samples;
  for (int i = leave; i < n - leave; i += every) samples.push_back(i);
  return samples;
}

Split split_of(const Section& training, const Section& blocks) {
  const int n = training.integer("samples");
  const int length = blocks.integer("samples"), every = blocks.integer("every");
  if (every < 1) throw InputError(fmt::format("blocks: every must be positive, got {}", every));
  Split split;
  std::vector<bool> kept(static_cast<std::size_t>(n), false);
  for (const double first : blocks.numbers("starts")) {
    const auto start = static_cast<int>(first);
    if (start < 0 || length < 1 || start + length > n) {
      throw InputError(
          fmt::format("blocks: the samples {} … {} are not all of the {} of the training motion", start, start + length - 1, n));
    }
    std::fill_n(kept.begin() + start, length, true);
    for (int i = 0; i < length; i += every) split.blocks.push_back(start + i);
  }
  for (const int i : samples_of(training)) {
    if (!kept[static_cast<std::size_t>(i)]) split.training.push_back(i);
  }
  return split;
}

/// n samples that cover a motion best, each n's among the next one's.
std::vector<int> informative(const Model& model, const ArmMotion& motion, int n) {
  ResampleOptions options;
  options.n = n;
  return resample(model, as_table(motion.measured, *model.system, model.name), options).rows;
}

struct Errors {
  double noisy = 0, exact = 0;                                 // mean absolute, over coordinates and samples
  double mean_constraint_error = 0, max_constraint_error = 0;  // of |A ddq − b|
};

Errors errors_of(const Posterior& posterior, const System& system, const ArmMotion& motion) {
  const MatrixXd& states = motion.measured.states;
  const MatrixXd prediction = posterior.mean(View::constrained_acceleration(system), states);
  Errors errors;
  errors.noisy = (prediction - motion.measured.accelerations).cwiseAbs().mean();
  errors.exact = (prediction - motion.truth).cwiseAbs().mean();
  const SystemValues values = system.evaluate(states, system.parameter_values());
  for (Index i = 0; i < states.cols(); ++i) {
    const VectorXd residual = (values.A(static_cast<int>(i)) * prediction.col(i) - values.b(static_cast<int>(i))).cwiseAbs();
    errors.mean_constraint_error += residual.mean() / static_cast<double>(states.cols());
    errors.max_constraint_error = std::max(errors.max_constraint_error, residual.maxCoeff());
  }
  return errors;
}

double seconds_since(std::chrono::steady_clock::time_point start) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

/// What a method learns: the model of its own, or the one that moved.
std::vector<Model> models_of(const Section& definition, const std::filesystem::path& experiments) {
  std::vector<Model> models;
  for (const Section& section : definition.sections("method")) {
    models.push_back(Model::read(experiments / section.text("model", definition.text("model"))));
  }
  return models;
}

/// The methods as they are trained on the k-th number of points.
std::vector<Method> methods_at(const Section& definition, std::size_t k) {
  const Section restarts = definition.section("restarts"), stop = definition.section("stop");
  std::vector<Method> methods;
  for (const Section& section : definition.sections("method")) {
    Method& method = methods.emplace_back(method_of(section));
    const std::vector<double> n_restarts = restarts.numbers(method.baseline ? "baseline" : "default");
    const std::vector<double> escapes = restarts.numbers("escapes");
    const auto at = [&](const std::vector<double>& list) { return static_cast<int>(list[std::min(k, list.size() - 1)]); };
    method.n_restarts[Protocol::Name::standard] = at(n_restarts);
    method.max_escapes = at(escapes);
    method.max_iterations = stop.integer("max_iterations");
    method.reduction_tolerance = stop.number("reduction_tolerance");
    if (!method.baseline) method.n_inducing = at(definition.numbers("inducing"));
  }
  return methods;
}

// what stands of a method for the k-th number of points in [published]
std::optional<double> published(const Section& definition, const std::string& method, std::size_t k) {
  if (!definition.has("published") || !definition.section("published").has(method)) return std::nullopt;
  const std::vector<double> errors = definition.section("published").numbers(method);
  return k < errors.size() ? std::optional(errors[k]) : std::nullopt;
}

// each error beside that of the first method that knows no mechanics, and the same of the published ones
void add_ratios(const Section& definition, std::size_t k, const std::vector<Method>& methods, Table& table,
                std::size_t first_row) {
  const auto plain = static_cast<std::size_t>(
      std::find_if(methods.begin(), methods.end(), [](const Method& method) { return method.baseline.has_value(); }) -
      methods.begin());
  if (plain == methods.size()) return;
  const std::optional<double> published_plain = published(definition, methods[plain].name, k);
  const Table::Row reference = table.row(first_row + plain);
  for (std::size_t m = 0; m < methods.size(); ++m) {
    Table::Row& row = table.row(first_row + m);
    for (const std::string place : {"blocks", "independent"}) {
      row["ratio_" + place] = number_or_null(row["mae_" + place].get<double>() / reference["mae_" + place].get<double>());
    }
    const std::optional<double> theirs = published(definition, methods[m].name, k);
    if (!theirs) continue;
    row["published_mae"] = *theirs;
    if (published_plain) row["published_ratio"] = *theirs / *published_plain;
  }
}

std::string shown(const Table::Row& value) { return value.is_null() ? "-" : fmt::format("{:.3f}", value.get<double>()); }

void print(const std::vector<Table::Row>& rows) {
  print_result("{:>5} {:<16} {:>9} {:>9} {:>9} {:>7} {:>7} {:>9} {:>10} {:>10} {:>8}\n", "n", "method", "blocks", "indep.",
               "published", "ratio", "indep.", "published", "|Addq−b|", "largest", "seconds");
  for (const Table::Row& row : rows) {
    print_result("{:>5} {:<16} {:>9} {:>9} {:>9} {:>7} {:>7} {:>9} {:>10.1e} {:>10.1e} {:>8.0f}\n", row["n"].get<int>(),
                 row["method"].get<std::string>(), shown(row["mae_blocks"]), shown(row["mae_independent"]),
                 shown(row["published_mae"]), shown(row["ratio_blocks"]), shown(row["ratio_independent"]),
                 shown(row["published_ratio"]), row["mean_constraint_error"].get<double>(),
                 row["max_constraint_error"].get<double>(), row["seconds"].get<double>());
  }
}

}  // namespace

void reproduce_arm_on_surface(const ReproduceOptions& options) {
  const Section definition = Section::read(options.experiments / "arm_on_surface.toml");
  const Model model = Model::read(options.experiments / definition.text("model"));
  const System& system = *model.system;
  const std::vector<Model> models = models_of(definition, options.experiments);
  const std::vector<double> sizes = definition.numbers("n");
  const Section training = definition.section("training"), elsewhere = definition.section("independent");

  const ArmMotion whole = motion_of(model, training);
  const Split split = split_of(training, definition.section("blocks"));
  const ArmMotion candidates = whole.only(split.training), blocks = whole.only(split.blocks);
  const auto largest = static_cast<int>(*std::max_element(sizes.begin(), sizes.end()));
  const ArmMotion chosen = candidates.only(informative(model, candidates, largest));
  const CsvTable log = as_table(chosen.measured, system, model.name);

  const ArmMotion other = motion_of(model, elsewhere);
  const ArmMotion independent = other.only(samples_of(elsewhere));

  Table table;
  std::map<std::string, std::vector<Hyperparameter>> fitted;  // to fewer points, by method
  for (std::size_t k = 0; k < sizes.size(); ++k) {
    const auto n = static_cast<int>(sizes[k]);
    const std::vector<Method> methods = methods_at(definition, k);
    const std::size_t first_row = table.rows().size();
    for (std::size_t m = 0; m < methods.size(); ++m) {
      const Method& method = methods[m];
      if (progress_is_due()) print_progress(fmt::format("arm-on-surface: n = {}: {}", n, method.name));
      const auto start = std::chrono::steady_clock::now();
      const Trained trained = train(models[m], {}, method, Protocol::Name::standard, log.first_rows(n), 0, options.threads,
                                    method.baseline ? fitted[method.name] : std::vector<Hyperparameter>{});
      const double seconds = seconds_since(start);
      fitted[method.name] = trained.fit.report.hyperparameters;
      const Errors on_blocks = errors_of(trained.fit.posterior, system, blocks);
      const Errors on_independent = errors_of(trained.fit.posterior, system, independent);
      table.add({{"n", n},
                 {"method", method.name},
                 {"mae_blocks", on_blocks.noisy},
                 {"mae_independent", on_independent.noisy},
                 {"published_mae", nullptr},
                 {"ratio_blocks", nullptr},
                 {"ratio_independent", nullptr},
                 {"published_ratio", nullptr},
                 {"truth_mae_blocks", on_blocks.exact},
                 {"truth_mae_independent", on_independent.exact},
                 {"mean_constraint_error", (on_blocks.mean_constraint_error + on_independent.mean_constraint_error) / 2},
                 {"max_constraint_error", std::max(on_blocks.max_constraint_error, on_independent.max_constraint_error)},
                 {"nll", trained.fit.report.negative_log_likelihood},
                 {"iterations", trained.fit.report.iterations},
                 {"seconds", seconds}});
    }
    add_ratios(definition, k, methods, table, first_row);
    table.write(options.output / "arm_on_surface");  // an hour's work is kept
  }
  end_progress();
  print(table.rows());
  plot(options, "arm_on_surface");
}

void reproduce_arm_mass(const ReproduceOptions& options) {
  const Section definition = Section::read(options.experiments / "arm_mass.toml");
  const Model moving = Model::read(options.experiments / definition.text("truth"));
  const Model model = Model::read(options.experiments / definition.text("model"));
  const Section truth = definition.section("true"), stop = definition.section("stop");
  const ArmMotion whole = motion_of(moving, definition.section("training"));
  const ArmMotion candidates = whole.only(samples_of(definition.section("training")));
  const ArmMotion chosen = candidates.only(informative(moving, candidates, definition.integer("n")));
  const CsvTable log = as_table(chosen.measured, *moving.system, moving.name);

  Table table, correlations;
  for (const Section& section : definition.sections("method")) {
    Method method = method_of(section);
    method.n_restarts[Protocol::Name::standard] = definition.section("restarts").integer("default");
    method.max_iterations = stop.integer("max_iterations");
    method.reduction_tolerance = stop.number("reduction_tolerance");
    method.max_escapes = 0;
    method.standard_errors = true;
    if (progress_is_due()) print_progress(fmt::format("arm-mass: {}", method.name));
    const auto start = std::chrono::steady_clock::now();
    const Trained trained = train(model, truth.keys(), method, Protocol::Name::standard, log, 0, options.threads);
    const double seconds = seconds_since(start);
    end_progress();
    const std::vector<Hyperparameter>& fitted = trained.fit.report.hyperparameters;
    const LaplaceUncertainty& uncertainty = trained.fit.report.uncertainty.value();
    for (std::size_t k = 0; k < fitted.size(); ++k) {
      const Hyperparameter& h = fitted[k];
      if (h.kind != Hyperparameter::Kind::parameter) continue;
      const auto column = static_cast<Index>(k);
      const double error = h.value - truth.number(h.name);
      table.add({{"method", method.name},
                 {"parameter", h.name},
                 {"start", trained.problem.hyperparameters[k].value},
                 {"truth", truth.number(h.name)},
                 {"estimate", h.value},
                 {"stddev", number_or_null(uncertainty.stddev[column])},
                 {"error", error},
                 {"error_in_stddevs", number_or_null(error / uncertainty.stddev[column])},
                 {"converged", trained.fit.report.converged},
                 {"distance_from_optimum", number_or_null(uncertainty.distance_from_optimum)},
                 {"seconds", seconds}});
      Table::Row row = {{"method", method.name}, {"parameter", h.name}};
      for (std::size_t l = 0; l < fitted.size(); ++l) {
        if (fitted[l].kind != Hyperparameter::Kind::parameter) continue;
        row[fitted[l].name] = number_or_null(uncertainty.correlation(column, static_cast<Index>(l)));
      }
      correlations.add(std::move(row));
      print_result("{:<18} {:<5} true {:>7.4f}   estimated {:>9.5f} ± {:.5f}\n", method.name, h.name, truth.number(h.name),
                   h.value, uncertainty.stddev[column]);
    }
  }
  table.write(options.output / "arm_mass");
  correlations.write(options.output / "arm_mass_correlation");
}

}  // namespace gp2::command
