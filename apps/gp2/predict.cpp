#include <memory>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/fit_problem.hpp"

namespace gp2::command {

namespace {

struct Arguments {
  std::string fit, states, view = "constrained", covariance = "none", output, map;
};

// names of the new columns, and their values, one row per state
struct NewColumns {
  std::vector<std::string> names;
  Eigen::MatrixXd values;  // (columns × N)
};

NewColumns predict(const Posterior& posterior, const View& view, const Eigen::MatrixXd& states, const std::string& covariance) {
  const std::vector<std::string> names = view.names(*posterior.prior().system);
  const Eigen::Index d = view.size();
  NewColumns out{names, {}};
  if (covariance == "none") {
    out.values = posterior.mean(view, states);
    return out;
  }
  const Posterior::Marginal prediction = posterior.marginal(view, states);
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

// the input as it was, then the new columns; an input column of a new name is kept as NAME_input
std::string joined(const CsvTable& input, const NewColumns& added) {
  std::string csv;
  for (const std::string& name : input.header()) {
    const bool taken = std::find(added.names.begin(), added.names.end(), name) != added.names.end();
    csv += name + (taken ? "_input," : ",");
  }
  for (std::size_t k = 0; k < added.names.size(); ++k) csv += (k == 0 ? "" : ",") + added.names[k];
  csv += "\n";
  for (int i = 0; i < input.n_rows(); ++i) {
    for (int column = 0; column < input.n_columns(); ++column) csv += input.cell(i, column) + ",";
    for (Eigen::Index k = 0; k < added.values.rows(); ++k) csv += (k == 0 ? "" : ",") + shortest(added.values(k, i));
    csv += "\n";
  }
  return csv;
}

void run(const Arguments& arguments) {
  const FitFile fit = FitFile::read(arguments.fit);
  const CsvTable table = CsvTable::read(arguments.states);
  const LogStates log = read_log_states(fit.prior(), fit.model, table, parse_map(arguments.map));
  talk(log.notes);
  const Posterior posterior = fit.posterior();
  const View view = View::all(arguments.view == "constrained" ? View::Quantity::constrained_acceleration
                                                              : View::Quantity::unconstrained_acceleration,
                              *fit.model.system);
  write_file(arguments.output, joined(table, predict(posterior, view, log.states, arguments.covariance)));
  talk({fmt::format("{}: {} predictions of the {} acceleration", arguments.output, table.n_rows(), arguments.view)});
}

}  // namespace

void add_predict(CLI::App& app) {
  CLI::App* command = app.add_subcommand("predict", "Predict accelerations at given states, with their uncertainty");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("FIT.json", arguments->fit, "file written by gp2 fit")->required();
  command->add_option("--states", arguments->states, "CSV with the states; one output row per input row")->required();
  command->add_option("--view", arguments->view, "constrained: ddq1 …; unconstrained: abar_q1 …")
      ->check(CLI::IsMember({"constrained", "unconstrained"}))
      ->capture_default_str();
  command->add_option("--cov", arguments->covariance, "none; std: NAME_std; full: also cov_NAME1_NAME2. Without measurement noise")
      ->check(CLI::IsMember({"none", "std", "full"}))
      ->capture_default_str();
  command->add_option("--map", arguments->map, "columns by other names, LOGNAME=MODELNAME,…");
  command->add_option("-o,--output", arguments->output, "CSV file to write")->required();
  command->footer("Example:\n  gp2 predict fit.json --states states.csv --cov std -o prediction.csv");
  command->callback([arguments] { run(*arguments); });
}

}  // namespace gp2::command
