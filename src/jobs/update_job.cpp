#include "gp2/jobs/update_job.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include <fmt/format.h>

#include "base/not_a_number.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::VectorXd;

std::vector<Option> options(UpdateRequest& request) {
  return {{"observe", &request.observe, "ddq3,ddq6", "accelerations to learn from", "those that the fit observed"},
          {"noise_std", &request.noise_stddev, "S", "noise standard deviation of each", "as in the fit"},
          {"map", &request.columns, "LOGNAME=NAME,…", "columns by other names", "", "columns"},
          {"forget", &request.forget, "W",
           "first of all let what was learned count as a share W of it, 0 < W ≤ 1; of fits through inducing points", "1"},
          {"window", &request.window, "N", "leave the newest N rows; of exact fits", "all"}};
}

Observations more_observations(const FitFile& fit, const Posterior& posterior, const CsvTable& log, const UpdateRequest& request,
                               std::vector<std::string>& notes) {
  if (request.noise_stddev && !(*request.noise_stddev > 0 && std::isfinite(*request.noise_stddev))) {
    throw InputError(fmt::format("`noise_std`: must be positive and finite, got {}", *request.noise_stddev));
  }
  const System& system = *posterior.prior().system;
  const std::vector<Observations>& groups = posterior.observations();
  const auto at_home = std::find_if(groups.begin(), groups.end(), [](const Observations& group) {
    return group.view().is_of_ddq() && group.view().other_system == nullptr;
  });
  View view = View::constrained_acceleration(system);
  std::vector<std::string> names = request.observe;
  if (names.empty() && at_home != groups.end()) names = at_home->view().names(system);
  view.rows = acceleration_rows(system, names, "`observe`");
  if (names.empty()) names = view.names(system);
  LogStates read = read_log_states(posterior.prior(), view, fit.model, log, request.columns, names);

  // the noise that the fit has for these rows, unless told otherwise; where it is a factor of stated ones, the log states them
  VectorXd stddev = VectorXd::Constant(view.size(), request.noise_stddev.value_or(not_a_number));
  MatrixXd scale;
  if (!request.noise_stddev) {
    if (at_home == groups.end() || at_home->view().rows != view.rows) {
      throw InputError("`noise_std`: these accelerations were not observed in the fit; give their noise standard deviation");
    }
    stddev = posterior.noise_stddev(static_cast<std::size_t>(at_home - groups.begin()));
    bool states_noise = false;
    for (int k = 0; k < view.size(); ++k) states_noise = states_noise || at_home->states_noise(k);
    if (states_noise) {
      LogReader reader = open_log(fit.model, log, request.columns);
      for (const std::string& name : names) {
        if (!reader.stddev_column(name).empty()) continue;
        throw InputError(
            fmt::format("`noise_std`: in the fit each value of {} has a noise of its own; give that of these in a column "
                        "{}_std, or one for all",
                        name, name));
      }
      scale = reader.stddevs(names);
    }
  }
  notes.insert(notes.end(), read.notes.begin(), read.notes.end());
  if (log.file() && fit.has_learned(*log.file())) {
    notes.push_back(fmt::format("warning: {} was learned from already: its rows count twice", log.name()));
  }
  return {std::move(read.states), std::move(view), std::move(read.accelerations), std::move(stddev), false, std::move(scale)};
}

void keep_newest(Posterior& posterior, const UpdateRequest& request) {
  if (!request.window) return;
  if (*request.window < 1) throw InputError(fmt::format("`window`: must be positive, got {}", *request.window));
  const std::int64_t n_old = posterior.n_states() - *request.window;
  if (n_old > 0) posterior = remove_oldest(std::move(posterior), static_cast<int>(n_old));
}

UpdateOutcome update(FitFile fit, const std::vector<CsvTable>& logs, const UpdateRequest& request) {
  UpdateOutcome outcome;
  Posterior posterior = fit.posterior();
  if (request.forget) posterior = forget(std::move(posterior), *request.forget);
  for (const CsvTable& log : logs) {
    Observations more = more_observations(fit, posterior, log, request, outcome.notes);
    outcome.n_added += more.n_data();
    if (log.file()) fit.logs.push_back(*log.file());
    posterior = update(std::move(posterior), std::move(more));
  }
  keep_newest(posterior, request);
  fit.take_data(posterior);
  outcome.n_states = posterior.n_states();
  outcome.fit = std::move(fit);
  return outcome;
}

}  // namespace gp2
