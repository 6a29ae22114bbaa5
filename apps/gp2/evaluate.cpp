#include "gp2/inference/evaluation.hpp"

#include <cmath>
#include <memory>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/jobs/fit_problem.hpp"

namespace gp2::command {

namespace {

using Json = nlohmann::ordered_json;

struct Arguments {
  std::string fit, data, outputs, map, system;
  bool json = false;
};

Json number(double value) { return std::isfinite(value) ? Json(value) : Json(); }

Json to_json(const Evaluation& e) {
  Json rmse = Json::object();
  for (std::size_t k = 0; k < e.outputs.size(); ++k) rmse[e.outputs[k]] = e.rmse[static_cast<Eigen::Index>(k)];
  return {{"rmse", rmse},
          {"rmse_normalised", number(e.rmse_normalised)},
          {"nrmse", number(e.nrmse)},
          {"max_constraint_error", e.max_constraint_error},
          {"max_constraint_error_fitted", e.max_constraint_error_fitted},
          {"nlpd", number(e.nlpd)},
          {"coverage95", number(e.coverage95)},
          {"nlpd_latent", number(e.nlpd_latent)},
          {"coverage95_latent", number(e.coverage95_latent)},
          {"n_zero_variance", e.n_zero_variance},
          {"n", e.n},
          {"n_missing", e.n_missing}};
}

void print_text(const Evaluation& e) {
  for (std::size_t k = 0; k < e.outputs.size(); ++k)
    fmt::print("rmse {:<22} {:.6g}\n", e.outputs[k], e.rmse[static_cast<Eigen::Index>(k)]);
  fmt::print("rmse / training std         {:.6g}   (mean over outputs)\n", e.rmse_normalised);
  fmt::print("nrmse                       {:.6g}   (rms error / rms of the test spreads)\n", e.nrmse);
  fmt::print("max |A ddq - b|             {:.3g}   (model's parameters; fitted ones: {:.3g})\n", e.max_constraint_error,
             e.max_constraint_error_fitted);
  fmt::print("nlpd, 95 % coverage         {:.4g}, {:.3g}   (with measurement noise)\n", e.nlpd, e.coverage95);
  fmt::print("the same, noise-free        {:.4g}, {:.3g}   ({} marginals without variance left out)\n", e.nlpd_latent,
             e.coverage95_latent, e.n_zero_variance);
  fmt::print("points                      {}{}\n", e.n,
             e.n_missing > 0 ? fmt::format("   ({} values not measured)", e.n_missing) : "");
}

// the accelerations that training observed
std::vector<std::string> observed_outputs(const FitFile& fit) {
  for (const Observations& group : fit.observations) {
    if (group.view().is_of_ddq()) return group.view().names(*fit.model.system);
  }
  return {};
}

void run(const Arguments& arguments) {
  const FitFile fit = FitFile::read(arguments.fit);
  const CsvTable table = CsvTable::read(arguments.data, CsvTable::Keep::numbers);
  std::vector<std::string> outputs = parse_list(arguments.outputs);
  if (outputs.empty()) outputs = observed_outputs(fit);
  const std::vector<int> rows = acceleration_rows(*fit.model.system, outputs, "--outputs");
  const PredictedSystem system = predicted_system(fit, arguments.system);
  const View view = system.view(View::Quantity::constrained_acceleration);
  const LogStates log = read_log_states(system.prior, view, system.model, table, parse_map(arguments.map), outputs);
  talk(log.notes);
  const Posterior posterior = fit.posterior();
  const Evaluation evaluation = at_states_of(table, [&] {
    return evaluate_predictions(posterior, log.states, rows, log.accelerations, system.other_system, /*n_threads=*/0);
  });
  if (arguments.json) {
    fmt::print("{}\n", to_json(evaluation).dump(2));
  } else {
    print_text(evaluation);
  }
}

}  // namespace

void add_evaluate(CLI::App& app) {
  CLI::App* command =
      app.add_subcommand("evaluate", "Compare predictions of the constrained acceleration with measured or true values");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("FIT.json", arguments->fit, "file written by gp2 fit")->required();
  command->add_option("--data", arguments->data, "CSV with states and accelerations")->required();
  command->add_option("--outputs", arguments->outputs,
                      "accelerations to compare, ddq3,ddq6 (default: those observed in training)");
  command->add_option("--system", arguments->system, system_help);
  command->add_option("--map", arguments->map, "columns by other names, LOGNAME=MODELNAME,…");
  command->add_flag("--json", arguments->json, "figures as JSON on stdout");
  command->footer("Example:\n  gp2 evaluate fit.json --data test.csv --json");
  command->callback([arguments] { run(*arguments); });
}

}  // namespace gp2::command
