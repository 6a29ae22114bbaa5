// Faults put into sound logs of every model on purpose: the share that check, fit or report names, and false alarms on sound logs.
#include <cstdlib>
#include <functional>
#include <iostream>
#include <map>
#include <memory>
#include <numbers>
#include <regex>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/jobs/check_job.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/report_job.hpp"
#include "io_testing.hpp"
#include "jobs/data_of_model.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::RowVectorXd;
using Eigen::VectorXd;
using test::LogData;

bool is_alarm(const std::string& text) {
  // what a sound log may be told too
  for (const char* known :
       {"dependent columns", "not in the log", "rank", "are off the constraint", "a row of A vanishes", "states off",
        "did not converge", "at its bound", "restart", "standard errors", "do not determine", "known force"}) {
    if (text.find(known) != std::string::npos) return false;
  }
  return true;
}

// The page that gp2 report would write of a fit.
std::vector<Advice> advice_on(const FitOutcome& fit) {
  const test::TemporaryFolder folder;
  fit.file.write(folder / "fit.json");
  std::vector<std::string> notes;
  return learning_advice(collect_report(std::filesystem::path(folder / "fit.json"), ReportRequest(), notes));
}

// what check, fit and report say against a log: warnings, errors, refusals
std::vector<std::string> alarms_of(const LogData& data) {
  std::vector<std::string> alarms;
  const auto add = [&](const std::string& text) {
    if (is_alarm(text)) alarms.push_back(text);
  };
  const CsvTable log = data.table();
  try {
    for (const Finding& finding : check(*data.model, &log)) {
      if (finding.level != Finding::Level::good) add(finding.text);
    }
    FitRequest request = test::fit_request(*data.model, {log});
    if (data.model->noise.stddev.empty()) request.problem.noise_stddev = test::noise_of(*data.model)[0];
    request.problem.estimate = std::vector<std::string>{};
    request.max_iterations = 40;
    request.max_escapes = 0;
    FitJob job = prepare_fit(std::move(request));
    for (const std::string& note : job.notes) {
      if (note.starts_with("warning")) add(note);
    }
    const FitOutcome fit = run_fit(job);
    for (const std::string& note : fit.notes) {
      if (note.starts_with("warning")) add(note);
    }
    for (const Advice& advice : advice_on(fit)) {
      if (advice.level == Advice::Level::warning) add("report: " + advice.text);
    }
  } catch (const InputError& error) {
    alarms.push_back(error.what());
  } catch (const NumericalError& error) {
    alarms.push_back(error.what());
  }
  return alarms;
}

struct Fault {
  std::string name;
  /// Puts the fault into a log; false where the model has no place for it.
  std::function<bool(LogData&, int)> put;
  bool in_time = false;  // the log is a motion
};

StateLayout layout_of(const LogData& data) { return data.model->system->layout(); }

// a coordinate that a constraint acts on, another one for each seed
int constrained_coordinate(const LogData& data, int seed) {
  const System& system = *data.model->system;
  const SystemValues values = system.evaluate(data.states, system.parameter_values());
  std::vector<int> found;
  for (int j = 0; j < system.nq(); ++j) {
    double size = 0;
    for (int i = 0; i < values.n_states(); ++i) size = std::max(size, values.A(i).col(j).lpNorm<Eigen::Infinity>());
    if (size > 1e-3) found.push_back(j);
  }
  return found.empty() ? -1 : found[static_cast<std::size_t>(seed) % found.size()];
}

// Another model in the place of the one that made the log; kept as long as the program runs.
void believe(LogData& data, const std::string& text) {
  static std::vector<std::unique_ptr<const Model>> believed;
  believed.push_back(std::make_unique<const Model>(Model::parse(text, data.model->name)));
  data.model = believed.back().get();
}

// The text of a model with one of its [parameters] larger by a tenth, or smaller where bounds forbid it; empty where it has none of
// that name as a number.
std::string with_wrong_constant(const Model& model, const std::string& parameter) {
  const std::regex line("\n" + parameter + R"(( *= *(?:\{ *value *= *)?)([0-9.eE+-]+))");
  std::smatch match;
  if (!std::regex_search(model.text, match, line)) return "";
  for (const double factor : {1.1, 0.9}) {
    const std::string text = fmt::format("{}\n{}{}{}{}", match.prefix().str(), parameter, match[1].str(),
                                         factor * std::stod(match[2].str()), match.suffix().str());
    try {
      static_cast<void>(Model::parse(text, model.name));
      return text;
    } catch (const InputError&) {
      continue;
    }
  }
  return "";
}

// Whether a parameter is one of the constraint: c, A or b change with it.
bool is_of_constraint(const LogData& data, int parameter) {
  const System& system = *data.model->system;
  VectorXd changed = system.parameter_values();
  changed[parameter] *= 1.1;
  const SystemValues here = system.evaluate(data.states, system.parameter_values()),
                     there = system.evaluate(data.states, changed);
  const MatrixXd c = system.residuals(data.states, system.parameter_values()), moved = system.residuals(data.states, changed);
  return !here.constraint_matrix.isApprox(there.constraint_matrix, 1e-9) ||
         !here.constraint_vector.isApprox(there.constraint_vector, 1e-9) || (c - moved).cwiseAbs().maxCoeff() > 1e-9;
}

bool spoil_constraint_constant(LogData& data, int seed) {
  std::vector<std::string> wrong;
  const std::vector<Parameter>& parameters = data.model->system->parameters();
  for (int k = 0; k < static_cast<int>(parameters.size()); ++k) {
    if (!is_of_constraint(data, k)) continue;
    const std::string text = with_wrong_constant(*data.model, parameters[static_cast<std::size_t>(k)].name);
    if (!text.empty()) wrong.push_back(text);
  }
  if (wrong.empty()) return false;
  believe(data, wrong[static_cast<std::size_t>(seed) % wrong.size()]);
  return true;
}

// The Coriolis and centrifugal parts of forces, as the models write them.
bool leave_out_coriolis(LogData& data, int) {
  static const std::vector<std::string> parts = {" + beta*sin(elbow)*(2*dshoulder*delbow + delbow^2)",
                                                 " - beta*sin(elbow)*dshoulder^2", " + m*R*dq3^2*cos(q3)",
                                                 " + m*R*dq3^2*sin(q3)"};
  std::string text = data.model->text;
  for (const std::string& part : parts) {
    if (const std::size_t at = text.find(part); at != std::string::npos) text.erase(at, part.size());
  }
  if (text == data.model->text) return false;
  believe(data, text);
  return true;
}

// An input that the log's force reads and no latent, which would take it up; another one for each seed, times a factor.
bool scale_input(LogData& data, int seed, double factor) {
  const StateLayout layout = layout_of(data);
  const std::vector<bool> read = data.model->system->reads(SystemPart::force);
  std::vector<int> inputs;
  const std::vector<Latent> latents = make_prior(*data.model).latents;
  for (int j = 0; j < layout.nu; ++j) {
    const bool is_learned =
        std::any_of(latents.begin(), latents.end(), [&](const Latent& one) { return one.features->reads(layout.u(j)); });
    if (read[static_cast<std::size_t>(layout.u(j))] && !is_learned) inputs.push_back(layout.u(j));
  }
  if (inputs.empty()) return false;
  data.states.row(inputs[static_cast<std::size_t>(seed) % inputs.size()]) *= factor;
  return true;
}

template <typename Row>
void roll(Row&& row, int by) {
  const RowVectorXd before = row;
  for (Index i = 0; i < before.size(); ++i) row[i] = before[std::max<Index>(0, i - by)];
}

const std::vector<Fault>& faults() {
  static const std::vector<Fault> all = {
      {"gravity in a sensor",
       [](LogData& data, int seed) {
         const int j = constrained_coordinate(data, seed);
         if (j < 0 || data.model->system->coordinates()[static_cast<std::size_t>(j)].angle) return false;
         data.accelerations.row(j).array() += 9.81;
         return true;
       }},
      {"sign of an acceleration",
       [](LogData& data, int seed) {
         const int j = constrained_coordinate(data, seed);
         if (j >= 0) data.accelerations.row(j) *= -1;
         return j >= 0;
       }},
      {"millimetres",
       [](LogData& data, int seed) {
         const int j = constrained_coordinate(data, seed);
         if (j < 0 || data.model->system->coordinates()[static_cast<std::size_t>(j)].angle) return false;
         const StateLayout layout = layout_of(data);
         data.states.row(layout.q(j)) *= 1000;
         data.states.row(layout.dq(j)) *= 1000;
         data.accelerations.row(j) *= 1000;
         return true;
       }},
      {"degrees",
       [](LogData& data, int seed) {
         const auto& coordinates = data.model->system->coordinates();
         const int j = constrained_coordinate(data, seed);
         if (j < 0 || !coordinates[static_cast<std::size_t>(j)].angle) return false;
         const StateLayout layout = layout_of(data);
         constexpr double degrees = 180 / std::numbers::pi;
         data.states.row(layout.q(j)) *= degrees;
         data.states.row(layout.dq(j)) *= degrees;
         data.accelerations.row(j) *= degrees;
         return true;
       }},
      {"swapped columns",
       [](LogData& data, int seed) {
         const int j = constrained_coordinate(data, seed), nq = data.model->system->nq();
         if (j < 0 || nq < 2) return false;
         data.accelerations.row(j).swap(data.accelerations.row((j + 1) % nq));
         return true;
       }},
      {"lagged column",
       [](LogData& data, int seed) {
         const int j = constrained_coordinate(data, seed);
         if (j >= 0) roll(data.accelerations.row(j), 1 + seed % 3);
         return j >= 0;
       },
       true},
      {"doubled rows",
       [](LogData& data, int) {
         const Index n = data.states.cols() / 2;
         data.states.rightCols(n) = MatrixXd(data.states.leftCols(n));
         data.accelerations.rightCols(n) = MatrixXd(data.accelerations.leftCols(n));
         return true;
       }},
      {"heading from north",
       [](LogData& data, int seed) {
         const auto& coordinates = data.model->system->coordinates();
         const int j = constrained_coordinate(data, seed);
         if (j < 0 || !coordinates[static_cast<std::size_t>(j)].angle) return false;
         const StateLayout layout = layout_of(data);
         data.states.row(layout.q(j)) = std::numbers::pi / 2 - data.states.row(layout.q(j)).array();
         data.states.row(layout.dq(j)) *= -1;
         data.accelerations.row(j) *= -1;
         return true;
       }},
      {"clock in milliseconds",
       [](LogData& data, int) {
         data.states.row(layout_of(data).t()) *= 1000;
         return true;
       },
       true},
      {"wrong constraint constant", spoil_constraint_constant},
      {"missing Coriolis", leave_out_coriolis},
      {"sign of an input", [](LogData& data, int seed) { return scale_input(data, seed, -1); }},
      {"input in milli-units", [](LogData& data, int seed) { return scale_input(data, seed, 1000); }},
      {"stuck channel",
       [](LogData& data, int seed) {
         const int j = constrained_coordinate(data, seed);
         if (j >= 0) data.accelerations.row(j).setConstant(data.accelerations(j, 0));
         return j >= 0;
       }},
  };
  return all;
}

LogData generated_log_of(const std::string& file, bool in_time, std::uint64_t seed) {
  return in_time ? test::moving_log(file, 60, 0.02, seed) : test::drawn_log(file, 40, seed);
}

TEST(FaultSweep, FaultsAreNamedAndSoundLogsAreNot) {
  const char* const first_seed = std::getenv("GP2_SWEEP_FIRST_SEED");
  const char* const number_of_seeds = std::getenv("GP2_SWEEP_SEEDS");
  const int first = first_seed == nullptr ? 1 : std::atoi(first_seed);
  const int n_seeds = number_of_seeds == nullptr ? 2 : std::atoi(number_of_seeds);
  int n_named = 0, n_faults = 0, n_false = 0, n_sound = 0;
  std::map<std::string, std::pair<int, int>> by_fault;
  for (const std::string& file : test::library_models()) {
    for (int seed = first; seed < first + n_seeds; ++seed) {
      for (const bool in_time : {false, true}) {
        const std::vector<std::string> alarms = alarms_of(generated_log_of(file, in_time, static_cast<std::uint64_t>(seed)));
        ++n_sound;
        if (!alarms.empty()) ++n_false;
        for (const std::string& alarm : alarms) std::cout << file << ", seed " << seed << ", sound: " << alarm << '\n';
      }
      for (const Fault& fault : faults()) {
        LogData data = generated_log_of(file, fault.in_time, static_cast<std::uint64_t>(seed));
        if (!fault.put(data, seed)) continue;
        const bool is_named = !alarms_of(data).empty();
        auto& [named, n] = by_fault[fault.name];
        ++n;
        ++n_faults;
        named += is_named ? 1 : 0;
        n_named += is_named ? 1 : 0;
        if (!is_named) std::cout << file << ", seed " << seed << ", not named: " << fault.name << '\n';
      }
    }
  }
  for (const auto& [name, share] : by_fault) std::cout << name << ": " << share.first << " of " << share.second << '\n';
  std::cout << n_named << " of " << n_faults << " faults named, " << n_false << " of " << n_sound << " sound logs alarmed\n";
  EXPECT_GE(n_named, 0.9 * n_faults);
  EXPECT_LE(n_false, 0.01 * n_sound);
}

}  // namespace
}  // namespace gp2
