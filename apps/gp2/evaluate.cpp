#include "gp2/inference/evaluation.hpp"

#include <cmath>
#include <memory>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

using Json = nlohmann::ordered_json;

struct EvaluateArguments {
  std::string fit, data, system;
  EvaluateRequest request;
  bool json = false;
};

Json number(double value) { return std::isfinite(value) ? Json(value) : Json(); }

Json to_json(const Evaluation::Part& part) {
  return {{"n", part.n},
          {"nrmse", number(part.nrmse)},
          {"coverage95", number(part.coverage95)},
          {"coverage95_latent", number(part.coverage95_latent)}};
}

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
          {"near", to_json(e.near)},
          {"far", to_json(e.far)},
          {"n", e.n},
          {"n_missing", e.n_missing}};
}

void print_text(const Evaluation& e) {
  for (std::size_t k = 0; k < e.outputs.size(); ++k)
    print_result("rmse {:<22} {:.6g}\n", e.outputs[k], e.rmse[static_cast<Eigen::Index>(k)]);
  print_result("rmse / training std         {:.6g}   (mean over outputs)\n", e.rmse_normalised);
  print_result("nrmse                       {:.6g}   (rms error / rms of the test spreads)\n", e.nrmse);
  print_result("max |A ddq - b|             {:.3g}   (fitted parameters; those of the model file: {:.3g})\n",
               e.max_constraint_error_fitted, e.max_constraint_error);
  print_result("nlpd, 95 % coverage         {:.4g}, {:.3g}   (with measurement noise)\n", e.nlpd, e.coverage95);
  print_result("the same, noise-free        {:.4g}, {:.3g}   ({} marginals without variance left out)\n", e.nlpd_latent,
               e.coverage95_latent, e.n_zero_variance);
  if (e.far.n > 0) {
    print_result("near the data               {:.3g} % of the points: nrmse {:.4g}, coverage {:.3g}\n", 100.0 * e.near.n / e.n,
                 e.near.nrmse, e.near.coverage95);
    print_result("far from them               {:.3g} % of the points: nrmse {:.4g}, coverage {:.3g}\n", 100.0 * e.far.n / e.n,
                 e.far.nrmse, e.far.coverage95);
  }
  print_result("points                      {}{}\n", e.n,
               e.n_missing > 0 ? fmt::format("   ({} values not measured)", e.n_missing) : "");
}

void run(EvaluateArguments& arguments) {
  const FitFile fit = FitFile::read(arguments.fit);
  const CsvTable table = CsvTable::read(arguments.data, CsvTable::Keep::numbers);
  arguments.request.system = read_other_system(arguments.system);
  const auto [evaluation, notes] = evaluate(fit, fit.posterior(), table, arguments.request);
  print_notes(notes);
  if (arguments.json) {
    print_result("{}\n", to_json(evaluation).dump(2));
  } else {
    print_text(evaluation);
  }
}

}  // namespace

Command evaluate_command() {
  const auto a = std::make_shared<EvaluateArguments>();
  Command command{"evaluate",
                  "Compare predictions of the constrained acceleration with measured or true values",
                  "gp2 evaluate fit.json --data test.csv --json",
                  {},
                  {}};
  command.options = {argument("FIT.json", a->fit, "file written by gp2 fit"),
                     required({"data", &a->data, "CSV", "CSV with states and accelerations"}),
                     {"system", &a->system, "OTHER.toml", system_help}};
  for (Option& option : options(a->request)) command.options.push_back(std::move(option));
  command.options.push_back({"json", &a->json, "", "figures as JSON on stdout"});
  command.run = [a](const std::set<std::string>&) { run(*a); };
  return command;
}

}  // namespace gp2::command
