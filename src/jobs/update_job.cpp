#include "gp2/jobs/update_job.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "data/evenly.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "inference/inducing_summary.hpp"
#include "jobs/observation_noise.hpp"
#include "jobs/read_observations.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

std::vector<Option> options(UpdateRequest& request) {
  return {
      {"observe", &request.observe, "ddq3,ddq6", "accelerations to learn from", "those that the fit observed"},
      {"noise_std", &request.noise_stddev, "S", "noise standard deviation of each", "as the log states it, else as in the fit"},
      {"map", &request.columns, "LOGNAME=NAME,…", "columns by other names", "", "columns"},
      {"forget", &request.forget, "W",
       "first of all let what was learned count as a share W of it, 0 < W ≤ 1; of fits through inducing points", "1"},
      {"window", &request.window, "N", "leave the newest N rows; of exact fits", "all"}};
}

namespace {

// The noise of more rows: what the log states, as the fit does, times its factor where it has one; else that of the fit. Of several
// logs with a noise each the largest. A value that should have a deviation in the log and has none counts as not measured.
Noise noise_of_more(const FitFile& fit, const Posterior& posterior, const View& view, const std::vector<std::string>& names,
                    LogStates& read, const UpdateRequest& request, const CsvTable& log, std::vector<std::string>& notes) {
  const std::vector<std::string> stated = stated_accelerations(names, open_log(fit.model, log, request.columns));
  if (request.noise_stddev) {
    if (!stated.empty()) {
      notes.push_back(fmt::format("{}: `noise_std={}` stands for the deviations in {}", log.name(), *request.noise_stddev,
                                  fmt::join(stated, ", ")));
    }
    return Noise(VectorXd::Constant(view.size(), *request.noise_stddev));
  }
  VectorXd stddev(view.size());
  MatrixXd scale = MatrixXd::Ones(view.size(), read.states.cols());
  const std::vector<Observations>& groups = posterior.observations();
  for (Index k = 0; k < stddev.size(); ++k) {
    const std::string& name = names[static_cast<std::size_t>(k)];
    const bool states_noise = std::ranges::find(stated, name) != stated.end();
    double least = std::numeric_limits<double>::infinity(), most = 0;
    bool is_observed = false;
    for (std::size_t g = 0; g < groups.size(); ++g) {
      const View& there = groups[g].view();
      const auto row = std::ranges::find(there.rows, view.rows[static_cast<std::size_t>(k)]);
      if (!there.is_of_ddq() || there.other_system != nullptr || row == there.rows.end()) continue;
      is_observed = true;
      const Index at = row - there.rows.begin();
      if (groups[g].states_noise(at) != states_noise) continue;
      const double sigma = posterior.noise_stddev(g)[at];
      least = std::min(least, sigma);
      most = std::max(most, sigma);
    }
    if (states_noise) {
      scale.row(k) = read.stated_stddev.row(k);
      for (Index i = 0; i < scale.cols(); ++i) {
        if (std::isnan(scale(k, i))) read.accelerations(k, i) = not_a_number;
      }
    } else if (!is_observed) {
      throw InputError(fmt::format("`noise_std`: {} was not observed in the fit; give its noise standard deviation", name));
    } else if (most == 0) {
      throw InputError(
          fmt::format("`noise_std`: in the fit each value of {} has a noise of its own; give that of these in a column "
                      "{}_std, or one for all",
                      name, name));
    }
    stddev[k] = most > 0 ? most : 1;
    constexpr double alike = 1.2;
    if (most > alike * least) {
      notes.push_back(
          fmt::format("warning: {}: the logs of the fit have noises of their own, {} {} {:.3g} to {:.3g}: the largest "
                      "is taken for these rows; `noise_std` gives another",
                      log.name(), name, states_noise ? "stated deviations times" : "from", least, most));
    }
  }
  if (!stated.empty()) {
    notes.push_back(fmt::format("{}: the noise of each value of {} is the stated one{}", log.name(), fmt::join(stated, ", "),
                                fit.model.noise.floor.empty() ? "" : " and the floor of [noise]"));
  }
  return Noise(std::move(stddev), false, stated.empty() ? MatrixXd() : std::move(scale));
}

// Nats by which inducing points may miss what the observations say (theory.md, T37): of a mixture, of its first component, since what
// a summary holds is copied.
double left_out(const Posterior& posterior) {
  const std::shared_ptr<const InducingSummary> summary = posterior.component(0).summary();
  return summary ? 0.5 * summary->components.front().all.trace : 0;
}

// Values that the fit, at states near its own data, is sure to be others: a sign, a unit, a column of something else.
void note_unexpected(const Posterior& posterior, const Observations& more, const CsvTable& log, std::vector<std::string>& notes) {
  constexpr int most_states = 200, fewest_values = 10;  // of each column
  constexpr std::int64_t fewest_learned = 30;           // fits of fewer states are sure of too much
  constexpr double far = 6, sound_share = 0.2;
  if (posterior.n_states() < fewest_learned || more.n_data() < fewest_values) return;
  const Observations some = evenly({more}, most_states).front();
  const VectorXd distance = posterior.distance_from_data(some.view(), some.states(), /*n_threads=*/0);
  const Posterior::Marginal predicted = posterior.marginal(some.view(), some.states(), /*n_threads=*/0);
  MatrixXd noise(some.values().rows(), some.n_data());
  for (Index i = 0; i < noise.cols(); ++i) noise.col(i) = some.noise_at(some.noise().stddev(), i);
  noise = with_slip(posterior, some.view(), some.states(), std::move(noise));
  const MatrixXd variance = predicted.stddev().cwiseAbs2() + noise.cwiseAbs2();
  const MatrixXd z = (some.values() - predicted.mean).cwiseAbs().cwiseQuotient(variance.cwiseSqrt());
  const std::vector<std::string> names = some.view().names(*posterior.prior().system);
  std::vector<std::string> others;
  for (Index k = 0; k < z.rows(); ++k) {
    int n = 0, n_far = 0;
    for (Index i = 0; i < z.cols(); ++i) {
      if (distance[i] > Posterior::far_from_data || !(z(k, i) >= 0)) continue;  // not of those that were not measured
      ++n;
      n_far += z(k, i) > far ? 1 : 0;
    }
    if (n < fewest_values || n_far <= sound_share * n) continue;
    others.push_back(fmt::format("{} of {} of {}", n_far, n, names[static_cast<std::size_t>(k)]));
  }
  if (others.empty()) return;
  notes.push_back(fmt::format(
      "warning: {}: {} near the fit's data lie more than six deviations from what it predicts there: is a sign, a unit "
      "or a column other than in its own logs? Else it predicts poorly; see gp2 evaluate",
      log.name(), fmt::join(others, ", ")));
}

}  // namespace

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
  const bool projects = !fit.options.empty() && request_of(fit).problem.project;
  LogStates read = read_log_states(posterior.prior(), view, fit.model, log, request.columns, names, {}, projects);

  Noise noise = noise_of_more(fit, posterior, view, names, read, request, log, notes);
  notes.insert(notes.end(), read.notes.begin(), read.notes.end());
  std::vector<int> rows;  // that measure something
  for (int i = 0; i < static_cast<int>(read.accelerations.cols()); ++i) {
    if (!read.accelerations.col(i).array().isNaN().all()) rows.push_back(i);
  }
  if (rows.empty()) {
    notes.push_back(
        fmt::format("warning: {}: nothing is learned from it: no row measures anything where what acts is known", log.name()));
  }
  noise = noise.take(rows);
  Observations more{read.states(Eigen::all, rows),
                    std::move(view),
                    read.accelerations(Eigen::all, rows),
                    noise.stddev(),
                    false,
                    noise.has_scale() ? noise.scale() : MatrixXd()};
  if (log.file() && fit.has_learned(*log.file())) {
    notes.push_back(fmt::format("warning: {} was learned from already: its rows count twice", log.name()));
  } else {
    note_shared_rows(groups, {more}, notes);
  }
  try {
    note_unexpected(posterior, more, log, notes);
  } catch (const Error&) {
    // where the old mean of latents that are not linear has no motion, the new one may have
  }
  return more;
}

Posterior with_more(Posterior&& posterior, Observations more, const CsvTable& log, std::vector<std::string>& notes) {
  const double before = left_out(posterior);
  const auto n_before = static_cast<double>(posterior.n_states());
  const int n_more = more.n_data();
  Posterior all = update(std::move(posterior), std::move(more));
  const double of_more = left_out(all) - before;
  constexpr double much = 1, usual = 3;  // nats; times as much as of as many rows before
  if (of_more > much && of_more > usual * before * n_more / n_before) {
    notes.push_back(fmt::format(
        "warning: {}: what the fit's inducing points leave out of its rows is worth about {:.2g} nats: they lie where "
        "none or few were learned from; a fit of all logs chooses points there too",
        log.name(), of_more));
  }
  return all;
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
    posterior = with_more(std::move(posterior), std::move(more), log, outcome.notes);
  }
  keep_newest(posterior, request);
  fit.take_data(posterior);
  outcome.n_states = posterior.n_states();
  outcome.fit = std::move(fit);
  return outcome;
}

}  // namespace gp2
