#include <algorithm>
#include <cstdint>
#include <memory>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"

namespace gp2::command {

namespace {

struct Arguments {
  std::string fit, states, view = "constrained", covariance = "none", output, map, system;
  std::optional<std::string> latent;
  std::optional<double> time_step;
  std::optional<int> n_samples;
  std::uint64_t seed = 0;
  bool unconditioned = false;
};

// what the arguments ask to see
View view_of(const Arguments& arguments, const PredictedSystem& system, const Prior& home) {
  const Prior& prior = system.prior;
  View view = system.view(*View::Quantity::of_word(arguments.view));
  if (view.size() == 0) throw InputError(fmt::format("--view {}: '{}' has no constraints", arguments.view, prior.system->name()));
  const bool needs_step = view.quantity->needs_time_step();
  if (needs_step != arguments.time_step.has_value()) {
    throw InputError(needs_step ? "--view next-velocity needs the time step: --dt SECONDS"
                                : "--dt goes with --view next-velocity");
  }
  if (needs_step) {
    view.time_step = arguments.time_step;
    if (!(*view.time_step > 0)) throw InputError(fmt::format("--dt: must be positive, got {}", *view.time_step));
  }
  if (arguments.latent) view.latent = latent_index(home, *arguments.latent, "--latent");
  return view;
}

// names of the new columns, and their values, one row per state
struct NewColumns {
  std::vector<std::string> names;
  Eigen::MatrixXd values;  // (columns × N)
};

NewColumns predict(const Posterior& posterior, const View& view, const Eigen::MatrixXd& states, const std::string& covariance) {
  const Prior& prior = posterior.prior();
  const std::string latent = !view.latent ? "" : prior.latents[static_cast<std::size_t>(*view.latent)].name;
  const std::vector<std::string> names = view.names(*prior_of(prior, view).system, latent);
  const Eigen::Index d = view.size();
  NewColumns out{names, {}};
  if (covariance == "none") {
    out.values = posterior.mean(view, states, /*n_threads=*/0);
    return out;
  }
  const Posterior::Marginal prediction = posterior.marginal(view, states, /*n_threads=*/0);
  if (prediction.n_clipped > 0) {
    talk({fmt::format("{} variances were negative by rounding and set to 0", prediction.n_clipped)});
  }
  for (const std::string& name : names) out.names.push_back(name + "_std");
  const bool full = covariance == "full";
  out.values.resize(2 * d + (full ? d * (d + 1) / 2 : 0), states.cols());
  out.values.topRows(d) = prediction.mean;
  out.values.middleRows(d, d) = prediction.stddev();
  Eigen::Index row = 2 * d;
  for (Eigen::Index j = 0; full && j < d; ++j) {
    for (Eigen::Index k = j; k < d; ++k) {
      out.names.push_back(fmt::format("cov_{}_{}", names[static_cast<std::size_t>(j)], names[static_cast<std::size_t>(k)]));
      out.values.row(row++) = prediction.covariance.row(k * d + j);
    }
  }
  return out;
}

// NAME_sample1 … of every name, then NAME_sample2 …: draws of the view at all states together
void add_samples(NewColumns& columns, const Posterior& posterior, const View& view, const Eigen::MatrixXd& states, int n_samples,
                 std::uint64_t seed) {
  const Eigen::MatrixXd samples = posterior.sample({{view, states}}, n_samples, seed);
  const Eigen::Index d = view.size(), first = columns.values.rows();
  const std::vector<std::string> names(columns.names.begin(), columns.names.begin() + d);
  columns.values.conservativeResize(first + d * n_samples, Eigen::NoChange);
  for (int s = 0; s < n_samples; ++s) {
    for (const std::string& name : names) columns.names.push_back(fmt::format("{}_sample{}", name, s + 1));
    columns.values.middleRows(first + d * s, d) = samples.col(s).reshaped(d, states.cols());
  }
}

// Input columns of the names of new ones become NAME_input; NAME_input_input where the input is itself such an output.
std::vector<std::string> kept_names(const std::vector<std::string>& input, const std::vector<std::string>& added) {
  const auto holds = [](const std::vector<std::string>& names, const std::string& name) {
    return std::find(names.begin(), names.end(), name) != names.end();
  };
  std::vector<std::string> kept = input;
  for (std::string& name : kept) {
    if (!holds(added, name)) continue;
    std::string other = name + "_input";
    while (holds(kept, other) || holds(added, other)) other += "_input";
    name = other;
  }
  return kept;
}

// the input as it was, then the new columns
std::string joined(const CsvTable& input, const NewColumns& added) {
  std::string csv;
  std::vector<std::string> line;
  const auto end_line = [&] {
    csv += fmt::format("{}\n", fmt::join(line, ","));
    line.clear();
  };
  for (const std::string& name : kept_names(input.header(), added.names)) line.push_back(csv_cell(name));
  line.insert(line.end(), added.names.begin(), added.names.end());
  end_line();
  for (int i = 0; i < input.n_rows(); ++i) {
    for (int column = 0; column < input.n_columns(); ++column) line.push_back(csv_cell(input.cell(i, column)));
    for (const double value : added.values.col(i)) line.push_back(shortest(value));
    end_line();
  }
  return csv;
}

void run(const Arguments& arguments) {
  if (arguments.n_samples && *arguments.n_samples < 1) {
    throw InputError(fmt::format("--samples: must be at least 1, got {}", *arguments.n_samples));
  }
  require_output(arguments.output, {arguments.fit, arguments.states, arguments.system});
  const FitFile fit = FitFile::read(arguments.fit);
  const CsvTable table = CsvTable::read(arguments.states);
  const Posterior posterior = arguments.unconditioned ? fit.posterior().without_data() : fit.posterior();
  const PredictedSystem system = predicted_system(fit, arguments.system);
  const View view = view_of(arguments, system, posterior.prior());
  const LogStates log = read_log_states(system.prior, view, system.model, table, parse_map(arguments.map));
  talk(log.notes);
  NewColumns predictions = at_states_of(table, [&] { return predict(posterior, view, log.states, arguments.covariance); });
  if (arguments.n_samples) add_samples(predictions, posterior, view, log.states, *arguments.n_samples, arguments.seed);
  write_file(arguments.output, joined(table, predictions));
  talk({fmt::format("{}: {} predictions, view {}", arguments.output, table.n_rows(), arguments.view)});
}

}  // namespace

void add_predict(CLI::App& app) {
  CLI::App* command = app.add_subcommand("predict", "Predict accelerations at given states, with their uncertainty");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("FIT.json", arguments->fit, "file written by gp2 fit")->required();
  command->add_option("--states", arguments->states, "CSV with the states; one output row per input row")->required();
  command
      ->add_option("--view", arguments->view,
                   "constrained: ddq1 …; unconstrained: abar_q1 …; constraint-force: fc_q1 …; multipliers: lambda1 …; "
                   "next-velocity: dq1_next …, with --dt")
      ->check(CLI::IsMember(View::Quantity::words()))
      ->capture_default_str();
  command->add_option("--dt", arguments->time_step, "time step of next-velocity [s]");
  command->add_option("--latent", arguments->latent, "only what this latent adds to the view, by its name: NAME@LATENT");
  command
      ->add_option("--cov", arguments->covariance, "none; std: NAME_std; full: also cov_NAME1_NAME2. Without measurement noise")
      ->check(CLI::IsMember({"none", "std", "full"}))
      ->capture_default_str();
  CLI::Option* samples =
      command->add_option("--samples", arguments->n_samples, "draws of all rows together: NAME_sample1 … NAME_sampleS");
  command->add_option("--seed", arguments->seed, "of the samples; same seed, same samples")
      ->check(not_negative())
      ->needs(samples)
      ->capture_default_str();
  command->add_flag("--unconditioned", arguments->unconditioned, "predict from the prior, as if there had been no data");
  command->add_option("--system", arguments->system, system_help);
  command->add_option("--map", arguments->map, "columns by other names, LOGNAME=MODELNAME,…");
  command->add_option("-o,--output", arguments->output, "CSV file to write")->required();
  command->footer("Example:\n  gp2 predict fit.json --states states.csv --cov std -o prediction.csv");
  command->callback([arguments] { run(*arguments); });
}

}  // namespace gp2::command
