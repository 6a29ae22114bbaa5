#include "gp2/inference/evaluation.hpp"

#include <cmath>
#include <memory>
#include <utility>

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

void add_to(Json& json, const Calibration& calibration) {
  json["coverage50"] = calibration.coverage50;
  json["coverage80"] = calibration.coverage80;
  json["coverage95"] = calibration.coverage95;
  json["coverage50_latent"] = calibration.coverage50_latent;
  json["coverage80_latent"] = calibration.coverage80_latent;
  json["coverage95_latent"] = calibration.coverage95_latent;
  json["pit"] = Json::array();
  for (const double share : calibration.pit) json["pit"].push_back(share);
}

Json to_json(const Evaluation::Part& part) {
  Json json = {{"n", part.n}, {"nrmse", part.nrmse}};
  add_to(json, part);
  return json;
}

Json to_json(const Evaluation& e) {
  Json rmse = Json::object();
  for (std::size_t k = 0; k < e.outputs.size(); ++k) rmse[e.outputs[k]] = e.rmse[static_cast<Eigen::Index>(k)];
  Json json = {{"rmse", rmse},
               {"rmse_normalised", e.rmse_normalised},
               {"nrmse", e.nrmse},
               {"max_constraint_error", e.max_constraint_error},
               {"max_constraint_error_fitted", e.max_constraint_error_fitted},
               {"nlpd", e.nlpd},
               {"nlpd_latent", e.nlpd_latent}};
  add_to(json, e);
  json["n_zero_variance"] = e.n_zero_variance;
  json["near"] = to_json(e.near);
  json["far"] = to_json(e.far);
  json["n"] = e.n;
  json["n_missing"] = e.n_missing;
  return json;
}

// to so many digits
std::string figure(double value, int digits) {
  return std::isfinite(value) ? fmt::format("{:.{}g}", value, digits) : "not defined";
}

std::string coverages(double of50, double of80, double of95) {
  if (!std::isfinite(of95)) return "not defined";
  return fmt::format("{:.3g}, {:.3g}, {:.3g}", of50, of80, of95);
}

void print_text(const Evaluation& e) {
  for (std::size_t k = 0; k < e.outputs.size(); ++k)
    print_result("rmse {:<22} {}\n", e.outputs[k], figure(e.rmse[static_cast<Eigen::Index>(k)], 6));
  print_result("rmse / training std         {}   (mean over outputs)\n", figure(e.rmse_normalised, 6));
  print_result("nrmse                       {}   (rms error / rms of the test spreads{})\n", figure(e.nrmse, 6),
               std::isfinite(e.nrmse) && e.nrmse > 1 ? "; above 1 their mean predicts better" : "");
  print_result("max |A ddq - b|             {}   (fitted parameters; those of the model file: {})\n",
               figure(e.max_constraint_error_fitted, 3), figure(e.max_constraint_error, 3));
  print_result("nlpd; 50, 80, 95 % coverage {}; {}   (with measurement noise)\n", figure(e.nlpd, 4),
               coverages(e.coverage50, e.coverage80, e.coverage95));
  if (std::isfinite(e.nlpd_latent)) {
    print_result("the same without noise      {}; {}   (right only for targets without noise{})\n", figure(e.nlpd_latent, 4),
                 coverages(e.coverage50_latent, e.coverage80_latent, e.coverage95_latent),
                 e.n_zero_variance > 0 ? fmt::format("; {} marginals without variance left out", e.n_zero_variance) : "");
  }
  for (const auto& [name, part] : {std::pair("near the data  ", &e.near), std::pair("far from them  ", &e.far)}) {
    if (e.far.n == 0 || part->n == 0) continue;
    print_result("{}             {:.3g} % of the points: nrmse {}; coverage {}\n", name, 100.0 * part->n / e.n,
                 figure(part->nrmse, 4), coverages(part->coverage50, part->coverage80, part->coverage95));
  }
  print_result("points                      {}{}\n", e.n,
               e.n_missing > 0 ? fmt::format("   ({} values not measured or left out)", e.n_missing) : "");
}

void run(EvaluateArguments& arguments) {
  const FitFile fit = FitFile::read(arguments.fit);
  CsvTable table = CsvTable::read(arguments.data, CsvTable::Keep::numbers);
  arguments.request.system = read_other_system(arguments.system);
  const auto [evaluation, notes] = evaluate(fit, fit.posterior(), std::move(table), arguments.request);
  print_notes(notes);
  if (arguments.json) {
    print_json(to_json(evaluation));
  } else {
    print_text(evaluation);
  }
}

}  // namespace

Command evaluate_command() {
  const auto a = std::make_shared<EvaluateArguments>();
  return {"evaluate", "Compare predictions of the constrained acceleration with measured or true values",
          "gp2 evaluate fit.json --data test.csv --json",
          joined({{argument("FIT.json", a->fit, "file written by gp2 fit"),
                   required({"data", &a->data, "CSV", "CSV with states and accelerations"}),
                   {"system", &a->system, "OTHER.toml", system_help}},
                  options(a->request),
                  {{"json", &a->json, "", "print the scores as JSON"}}}),
          [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
