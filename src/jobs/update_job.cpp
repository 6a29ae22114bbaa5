#include "gp2/jobs/update_job.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "base/number_range.hpp"
#include "data/evenly.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/fit_memory.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "inference/inducing_summary.hpp"
#include "jobs/acting_inputs.hpp"
#include "jobs/chosen_rows.hpp"
#include "jobs/fit_notes.hpp"
#include "jobs/log_columns.hpp"
#include "jobs/observation_noise.hpp"
#include "jobs/read_states.hpp"
#include "jobs/reading_notes.hpp"
#include "jobs/repeated_rows.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

std::vector<Option> options(UpdateRequest& request) {
  return {{"observe", &request.observe, "ddq3,ddq6", "accelerations to learn from", "those that the fit observed"},
          {"noise_std", &request.noise_stddev, "S", "noise standard deviation of each acceleration",
           "as the log states it, else as in the fit"},
          columns_option(request.columns),
          {"forget", &request.forget, "W",
           "first multiply the log likelihood of all earlier data by W, 0 < W ≤ 1; for fits with inducing points", "1"},
          {"window", &request.window, "N", "keep only the N rows added last; for exact fits", "all"}};
}

namespace {

// The noise of more rows: what the log states, as the fit does, times its factor where it has one; else that of the fit. Of several
// logs with a noise each the largest.
// @param stated  the names whose standard deviations the log states
Noise noise_of_more(const FitFile& fit, const Posterior& posterior, const Readings& readings,
                    const std::vector<std::string>& names, const std::vector<std::string>& stated, const UpdateRequest& request,
                    const CsvTable& log, std::vector<std::string>& notes) {
  const View& view = readings.view;
  if (request.noise_stddev) {
    if (!stated.empty()) {
      notes.push_back(fmt::format("{}: `noise_std={}` replaces the standard deviations in {}", log.name(), *request.noise_stddev,
                                  fmt::join(stated, ", ")));
    }
    return Noise(VectorXd::Constant(view.size(), *request.noise_stddev));
  }
  VectorXd stddev(view.size());
  MatrixXd scale = MatrixXd::Ones(view.size(), readings.states.cols());
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
      scale.row(k) = readings.stated_stddev.row(k);
    } else if (!is_observed) {
      throw InputError(fmt::format("`noise_std`: {} was not observed in the fit; give its noise standard deviation", name));
    } else if (most == 0) {
      throw InputError(
          fmt::format("`noise_std`: each value of {} in the fit has its own noise; give that of the new ones in a column {}_std, "
                      "or one for all",
                      name, name));
    }
    stddev[k] = most > 0 ? most : 1;
    constexpr double alike = 1.2;
    if (most > alike * least) {
      notes.push_back(
          fmt::format("warning: {}: the logs of the fit differ in noise, {} {} {:.3g} to {:.3g}: the largest is used for these "
                      "rows; `noise_std` sets another",
                      log.name(), name, states_noise ? "stated standard deviations times" : "from", least, most));
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

// Why points that were chosen for other rows lose much of these.
std::string reason_of_loss(const Posterior& posterior, const Observations& more) {
  constexpr int fewest = 10;    // of fewer rows it takes too long to learn how far they are
  constexpr double many = 0.1;  // of the rows
  if (more.n_data() >= fewest) {
    const VectorXd distance = posterior.distance_from_data(more.view(), more.states(), /*n_threads=*/0);
    const auto n_far = static_cast<double>((distance.array() > Posterior::far_from_data).count());
    if (n_far > many * more.n_data()) return "which lie far from those learned before";
  }
  constexpr double much_smaller = 0.5;
  const VectorXd usual = more.usual_noise(more.noise().stddev());
  const VectorXd before = measurement_noise(posterior, more.view().rows, 1, {});
  if ((usual.array() < much_smaller * before.array()).any())
    return "since their noise is much smaller than that of the fit, for which the points were chosen";
  return "at states for which the points are too few";
}

// Noise that is given or stated must be usable, as that of a fit, whose accelerations tell how far they spread.
void require_usable_noise(const Posterior& posterior, const Observations& more, const CsvTable& log, const std::vector<int>& rows,
                          bool is_given) {
  if (more.n_data() == 0) return;
  const std::vector<std::string> names = more.view().names(*posterior.prior().system);
  const MatrixXd noise = more.noise_of_values(more.noise().stddev());
  for (const Observations& group : posterior.observations()) {
    if (!(group.view() == more.view()) || group.has_sums() || group.n_data() < 2) continue;
    const VectorXd spread = row_stddev(group.values());
    for (Index k = 0; k < noise.rows(); ++k) {
      if (!is_given && !more.states_noise(k)) continue;
      require_noise(is_given ? "`noise_std`" : log.name(), names[static_cast<std::size_t>(k)], spread[k], noise.row(k),
                    is_given ? std::vector<int>() : rows);
    }
  }
}

// Some states, evenly taken, and those of the least and the greatest value of each row.
std::vector<int> evenly_and_extreme(const Observations& observations, int n) {
  std::vector<int> taken = evenly_taken({observations}, n).front();
  const MatrixXd& values = observations.values();
  for (Index k = 0; k < values.rows(); ++k) {
    const auto is_measured = !values.row(k).array().isNaN();
    if (!is_measured.any()) continue;
    const double middle = median(measured_entries(values, k));
    Index least = 0, greatest = 0;
    is_measured.select(values.row(k), middle).minCoeff(&least);
    is_measured.select(values.row(k), middle).maxCoeff(&greatest);
    taken.insert(taken.end(), {static_cast<int>(least), static_cast<int>(greatest)});
  }
  std::ranges::sort(taken);
  taken.erase(std::unique(taken.begin(), taken.end()), taken.end());
  return taken;
}

// Rows of whose values the fit cannot tell, most of a log.
void note_far_rows(const VectorXd& distance, const CsvTable& log, std::vector<std::string>& notes) {
  constexpr double another_unit = 5;  // times as far as the observed states are from each other
  const auto n_outside = (distance.array() > Posterior::far_from_data).count();
  if (2 * n_outside <= distance.size()) return;
  const double typical = median({distance.begin(), distance.end()});
  const bool is_other = typical > another_unit;
  notes.push_back((is_other ? "warning: " : "") +
                  fmt::format("{}: {} of {} rows are far from the fit's data, half of them {:.2g} or more times as far as those "
                              "are from each other: whether they agree with it is not known{}",
                              log.name(), n_outside, distance.size(), typical,
                              is_other ? ". Does a column have another unit?" : ""));
}

// How values deviate that are not what the fit predicts; empty where they are.
// @param z  deviations from what it predicts, in units of the standard deviations, which are those of rows it has not seen
std::string offset_text(const std::vector<double>& z) {
  // of sound logs the rms was 1.8 at most, where friction is steep
  constexpr double far_rms = 2, far_mean = 1, surely = 6;
  TrainingResidual of;
  of.n = static_cast<int>(z.size());
  double mean = 0;
  for (const double one : z) {
    mean += one / of.n;
    of.rms += one * one / of.n;
    of.coverage95 += std::abs(one) <= 1.96 ? 1.0 / of.n : 0;
  }
  of.rms = std::sqrt(of.rms);
  const bool is_offset = std::abs(mean) > far_mean && std::abs(mean) * std::sqrt(of.n) > surely;
  const bool is_far = of.rms > far_rms && of.is_too_large();
  return is_offset || is_far ? fmt::format("mean {:.2g}, rms {:.2g} standard deviations", mean, of.rms) : "";
}

// Values that the fit is sure to be others: many of a column near its data (a sign, a unit, a column of something else) or single ones.
// @param rows  of the log, of each state
void note_unexpected(const Posterior& posterior, const Observations& more, const std::vector<int>& rows, const CsvTable& log,
                     std::vector<std::string>& notes) {
  constexpr int most_states = 1000, fewest_values = 10;  // of each column
  constexpr std::int64_t fewest_learned = 30;            // fits of fewer states are sure of too much
  constexpr double few = 0.2;                            // of a column's values
  constexpr double wrong = 30, wrong_far = 100;  // also by a fit that is too sure of itself, near its data and far from them
  if (posterior.n_states() < fewest_learned || more.n_data() == 0) return;
  const std::vector<int> taken = evenly_and_extreme(more, most_states);
  const Observations some = more.take(taken);
  const Posterior::Marginal predicted = posterior.marginal(some.view(), some.states(), /*n_threads=*/0);
  const MatrixXd noise = with_slip(posterior, some.view(), some.states(), some.noise_of_values(some.noise().stddev()));
  const MatrixXd variance = predicted.stddev().cwiseAbs2() + noise.cwiseAbs2();
  const MatrixXd z = (some.values() - predicted.mean).cwiseQuotient(variance.cwiseSqrt());
  // what follows a machine row by row does not wait for distances without a cause
  if (some.n_data() < fewest_values && !(z.array().abs() > wrong).any()) return;
  const VectorXd distance = posterior.distance_from_data(some.view(), some.states(), /*n_threads=*/0);
  const std::vector<std::string> names = some.view().names(*posterior.prior().system);
  std::vector<std::string> others;
  int n_wrong = 0;
  double worst = 0;
  std::string where;
  for (Index k = 0; k < z.rows(); ++k) {
    std::vector<double> near, all;
    for (Index i = 0; i < z.cols(); ++i) {
      if (std::isnan(z(k, i))) continue;  // not measured
      all.push_back(std::abs(z(k, i)));
      if (distance[i] <= Posterior::far_from_data) near.push_back(z(k, i));
    }
    // single values that are wrong are told below
    const auto is_wrong = [](double one) { return std::abs(one) > wrong; };
    if (static_cast<double>(std::ranges::count_if(near, is_wrong)) <= few * static_cast<double>(near.size()))
      std::erase_if(near, is_wrong);
    if (const std::string off = offset_text(near); std::ssize(near) >= fewest_values && !off.empty()) {
      others.push_back(fmt::format("{} ({})", names[static_cast<std::size_t>(k)], off));
      continue;
    }
    // where the fit is off everywhere, single values are not told from the others
    const double usual = std::ssize(all) < fewest_values ? 1 : std::max(1.0, median(all) / median_of_normal);
    for (Index i = 0; i < z.cols(); ++i) {
      const double size = std::abs(z(k, i));
      if (!(size > usual * (distance[i] <= Posterior::far_from_data ? wrong : wrong_far))) continue;
      ++n_wrong;
      if (size <= worst) continue;
      worst = size;
      where = fmt::format("{}, at row {}", names[static_cast<std::size_t>(k)],
                          rows[static_cast<std::size_t>(taken[static_cast<std::size_t>(i)])] + 1);
    }
  }
  if (!others.empty()) {
    notes.push_back(fmt::format(
        "warning: {}: near the fit's data, values lie farther from its predictions than its standard deviations explain: {}: "
        "does a sign, a unit, an offset or a column differ from its own logs, or has the machine changed? Learned from both, "
        "standard deviations are too small: `window` or `forget` discounts the old rows; see gp2 evaluate",
        log.name(), fmt::join(others, ", ")));
  }
  if (n_wrong > 0) {
    notes.push_back(
        fmt::format("warning: {}: {} of the values contradict the fit, up to {:.2g} standard deviations away ({}): outliers of "
                    "the log, or something acts that is not in the model. They are learned from like all others: leave them out, "
                    "or fit all logs with `robust`",
                    log.name(), n_wrong, worst, where));
  }
  if (distance.size() >= fewest_values) note_far_rows(distance, log, notes);
}

// Of draws of the hyperparameters those under which there is no posterior of all are left out, as by a fit.
Posterior update_where_possible(Posterior&& posterior, FitReport& report, const Observations& more) {
  try {
    return update(std::move(posterior), more);
  } catch (const NumericalError&) {
    if (!report.draws || posterior.summary()) throw;
    std::vector<Index> possible;
    std::vector<ModelValues> values;
    std::vector<Observations> all;
    for (int k = 0; k < posterior.n_components(); ++k) {
      try {
        const Posterior one = update(Posterior(posterior.component(k)), more);
        values.push_back(one.values());
        all = one.observations();
        possible.push_back(k);
      } catch (const NumericalError&) {  // one more that is impossible
      }
    }
    if (possible.empty()) throw;
    Posterior rest = Posterior::mixture(posterior.prior(), all, values);
    report.draws->values = MatrixXd(report.draws->values(Eigen::all, possible));
    return rest;
  }
}

// The discrepancy grows outside the data (T23), where from now on there are some: its range becomes that of all rows. At those before
// nothing changes, so that nothing is conditioned anew. Discrepancies of other systems keep their range, and here it does too then.
void extend_range(Posterior& posterior, FitFile& fit, const Observations& more) {
  const std::vector<Observations>& groups = posterior.observations();
  const bool has_other_systems =
      std::ranges::any_of(groups, [](const Observations& group) { return group.view().other_system != nullptr; });
  if (!fit.prior_options.discrepancy || fit.prior_options.discrepancy->half_range.size() == 0 || has_other_systems) return;
  Discrepancy extended = *fit.prior_options.discrepancy;
  const MatrixXd scaled = posterior.prior().latents.back().features->evaluate(more.states(), VectorXd());
  const MatrixXd features = extended.lengthscale.asDiagonal() * scaled.topRows(extended.lengthscale.size());
  const VectorXd lowest = features.rowwise().minCoeff().cwiseMin(extended.centre - extended.half_range);
  const VectorXd highest = features.rowwise().maxCoeff().cwiseMax(extended.centre + extended.half_range);
  constexpr double but_for_rounding = 1 + 1e-9;
  const bool is_within = ((highest - lowest) / 2 - but_for_rounding * extended.half_range).maxCoeff() <= 0;
  if (is_within) return;
  extended.centre = (highest + lowest) / 2;
  extended.half_range = (highest - lowest) / 2;
  fit.prior_options.discrepancy = std::move(extended);
  set_prior(posterior, fit.prior());
}

// Rows of some of the names as rows of all: what is not among them is not measured.
MatrixXd among(const std::vector<std::string>& all, const std::vector<std::string>& some, const MatrixXd& of_some) {
  MatrixXd values = MatrixXd::Constant(std::ssize(all), of_some.cols(), not_a_number);
  for (Index k = 0; k < of_some.rows(); ++k) {
    values.row(std::ranges::find(all, some[static_cast<std::size_t>(k)]) - all.begin()) = of_some.row(k);
  }
  return values;
}

// Reads what a log measures of these names, as a fit does.
// @param readings  receives it; its view is given
// @return the rows of the log that measure something at known acting inputs
std::vector<int> read_more(const FitFile& fit, const Posterior& posterior, const std::vector<std::string>& names,
                           const UpdateRequest& request, LogReader& reader, Readings& readings, std::vector<std::string>& notes) {
  const Prior& prior = posterior.prior();
  const VectorXd& parameters = posterior.values().parameters;
  const CsvTable& log = reader.table();
  const bool projects = !fit.options.empty() && request_of(fit).problem.project;
  const bool reads_stddevs = !request.noise_stddev && !stated_accelerations(names, reader).empty();
  // a block of few rows may have no value of a column, and a single row no deviation of one, which the reader takes for a mistake
  const auto lacks_stddev = [&](const std::string& name) {
    const int at = log.find(reader.stddev_column(name));
    return reads_stddevs && log.n_rows() == 1 && at >= 0 && log.is_empty(at);
  };
  std::vector<std::string> measured = names;
  std::erase_if(measured,
                [&](const std::string& name) { return reader.has(name) && (!reader.measures(name) || lacks_stddev(name)); });
  readings.states = read_states(prior, readings.view, reader, projects);
  readings.values = among(names, measured, reader.measurements(measured));
  if (reads_stddevs) readings.stated_stddev = among(names, measured, stated_stddevs(fit.model, measured, reader, log.n_rows()));
  const std::optional<CommandedRows> commanded =
      take_commands(*prior.system, without_estimates(fit.model.actuators), reader, std::nullopt, {}, readings.states, notes);
  if (commanded) {
    note_late_inputs(prior, log, checked_columns(fit.model, {&log}, request.columns), without_estimates(fit.model.actuators),
                     notes);
  }
  const MatrixXd state_stddevs = projects ? stated_state_deviations(*prior.system, reader) : MatrixXd();
  note_reading(reader, notes);
  if (projects) move_onto_constraints(*prior.system, parameters, log, state_stddevs, readings.states, notes);
  note_violation(*prior.system, readings.states, parameters, log.name(), notes);
  if (measured.empty()) return {};
  note_rest(fit.model, parameters, readings.states, readings.values, log.name(), notes);
  std::vector<int> rows = measured_rows(readings, names, log.name(), notes);
  if (commanded) {
    clear_unknown(*commanded, log, readings.values, notes);
    std::erase_if(rows, [&](int row) { return readings.values.col(row).array().isNaN().all(); });
  }
  return rows;
}

void require_window(const Posterior& posterior, const UpdateRequest& request) {
  if (!request.window) return;
  if (*request.window < 1) throw InputError(fmt::format("`window`: must be positive, got {}", *request.window));
  if (posterior.summary()) {
    throw InputError(
        "`window`: what was learned through inducing points cannot be taken away, since the observations themselves are not "
        "kept; `forget` discounts it");
  }
  if (std::ranges::any_of(posterior.observations(), &Observations::has_sums)) {
    throw InputError(
        "`window`: the fit learned from windows of a raw log, of which single rows cannot be taken away; fit the newest logs "
        "again, or this one with `windows=none`");
  }
}

// The newest n of the states of some groups.
std::vector<Observations> newest_of(const std::vector<Observations>& groups, std::int64_t n) {
  std::vector<Observations> newest;
  for (auto group = groups.rbegin(); group != groups.rend() && n > 0; ++group) {
    const auto n_here = static_cast<int>(std::min<std::int64_t>(n, group->n_data()));
    const bool is_whole = n_here == group->n_data() || group->has_sums();  // which are not cut
    newest.insert(newest.begin(), is_whole ? *group : group->slice(group->n_data() - n_here, n_here));
    n -= n_here;
  }
  return newest;
}

// The logs of a fit with the number of their rows that it learned. A fit to which nothing was added has a group of observations for each.
std::vector<LogFile> counted_logs(const FitFile& fit, const Posterior& posterior) {
  const std::vector<Observations>& groups = posterior.observations();
  std::vector<LogFile> logs = fit.logs;
  if (!fit.notes || posterior.summary()) return logs;
  const bool has_group_of_each = groups.size() == logs.size();
  for (std::size_t k = 0; k < logs.size(); ++k)
    logs[k].n_learned = has_group_of_each ? std::optional<std::int64_t>(groups[k].n_data()) : std::nullopt;
  return logs;
}

// Strikes the logs of which none of the newest n states is. One whose number of rows is not known stays until later ones have as many.
void keep_logs_of_newest(FitFile& fit, std::int64_t n) {
  auto oldest = fit.logs.end();
  while (oldest != fit.logs.begin() && n > 0) {
    std::optional<std::int64_t>& n_here = (--oldest)->n_learned;
    if (n_here) n_here = std::min(*n_here, n);
    n -= n_here.value_or(0);
  }
  if (oldest == fit.logs.begin()) return;
  fit.logs.erase(fit.logs.begin(), oldest);
  fit.data_source.clear();
  for (const LogFile& log : fit.logs) fit.data_source += (fit.data_source.empty() ? "" : ", ") + log.name;
}

// Removes all but the newest n states.
void leave_newest(Posterior& posterior, FitFile& fit, std::int64_t n) {
  const std::int64_t n_old = posterior.n_states() - n;
  if (n_old > 0) posterior = remove_oldest(std::move(posterior), fit, static_cast<int>(n_old));
}

// Whether one of the logs that the newest n states are of has the content of this one.
bool has_among_newest(const std::vector<LogFile>& logs, const LogFile& log, std::int64_t n) {
  for (auto known = logs.rbegin(); known != logs.rend() && n > 0; ++known) {
    if (known->checksum == log.checksum && known->bytes == log.bytes) return true;
    n -= known->n_learned.value_or(known->rows);
  }
  return false;
}

}  // namespace

Observations more_observations(const FitFile& fit, const Posterior& posterior, const CsvTable& log, const UpdateRequest& request,
                               std::vector<std::string>& notes) {
  if (request.noise_stddev && !(*request.noise_stddev > 0 && *request.noise_stddev <= largest_number)) {
    throw InputError(
        fmt::format("`noise_std`: must be positive and at most {:.0e}, got {}", largest_number, *request.noise_stddev));
  }
  const System& system = *posterior.prior().system;
  const std::vector<Observations>& groups = posterior.observations();
  const auto own = std::find_if(groups.begin(), groups.end(), [](const Observations& group) {
    return group.view().is_of_ddq() && group.view().other_system == nullptr;
  });
  View view = View::constrained_acceleration(system);
  std::vector<std::string> names = request.observe;
  if (names.empty() && own != groups.end()) names = own->view().names(system);
  view.rows = acceleration_rows(system, names, "`observe`");
  if (names.empty()) names = view.names(system);
  LogReader reader = open_log(fit.model, log, request.columns);
  const std::vector<std::string> stated = stated_accelerations(names, reader);
  Readings readings{std::move(view), {}, {}, {}};
  const std::vector<int> rows = read_more(fit, posterior, names, request, reader, readings, notes);
  Noise noise = noise_of_more(fit, posterior, readings, names, stated, request, log, notes);
  if (rows.empty()) {
    notes.push_back(
        fmt::format("warning: {}: nothing is learned from it: no row has a measured value and known acting inputs", log.name()));
  }
  const Observations all{std::move(readings.states), std::move(readings.view), std::move(readings.values), std::move(noise)};
  Observations more = all.take(rows);
  require_mechanics_at({fit.model, nullptr, nullptr, posterior.prior(), posterior.values().parameters, {}}, more.view(),
                       more.states(), rows, log.name(), notes);
  require_usable_noise(posterior, more, log, rows, request.noise_stddev.has_value());
  // rows that the window leaves behind do not count twice
  const std::int64_t n_left = request.window ? *request.window - more.n_data() : posterior.n_states();
  if (log.file() &&
      (request.window ? has_among_newest(counted_logs(fit, posterior), *log.file(), n_left) : fit.has_learned(*log.file()))) {
    notes.push_back(fmt::format("warning: {} is already in the fit: its rows count twice", log.name()));
  } else {
    note_shared_rows(request.window ? newest_of(groups, n_left) : groups, {more}, notes);
  }
  try {
    for (std::string& text : constraint_warnings(posterior, nullptr, log.name(), all.states(), all.view().rows, all.values(),
                                                 all.noise_of_values(all.noise().stddev()))) {
      notes.push_back(std::move(text));
    }
    note_unexpected(posterior, more, rows, log, notes);
  } catch (const Error&) {
    // where the old mean of latents that are not linear has no motion, the new one may have
  }
  return more;
}

void require_memory_of_more(const Posterior& posterior, const Observations& more, const std::string& log,
                            const std::function<std::optional<double>()>& free, const std::function<bool(double, int)>& given) {
  constexpr double number = sizeof(double), gigabyte = 1e9, share = 0.9, small = 1e8;
  if (posterior.summary() || more.n_data() == 0) return;
  const auto n_old = static_cast<double>(posterior.n_states()), n_more = static_cast<double>(more.n_data());
  const double rank = n_old > 0 ? posterior.reduced_size() / n_old : static_cast<double>(more.view().size());
  // a factor has room for some more rows; then it moves to twice that, of which the lower triangle is touched
  struct Need {
    double bytes, in_one_piece;
  };
  const auto need_of = [&](double old_rows, double more_rows) -> Need {
    const double r_old = rank * old_rows, r_more = rank * more_rows, r = r_old + r_more;
    const bool moves = r > r_old + std::max(64., r_old / 8);
    const double factors = moves || posterior.n_components() > 1 ? posterior.n_components() * r * r / 2 : 0;
    const double beside = r_old > 0 ? 2 * r_old * r_more + r_more * r_more : 0;
    return {number * (factors + beside), moves ? number * std::pow(std::max(r, 1.7 * r_old), 2) : 0};
  };
  const Need need = need_of(n_old, n_more);
  if (std::max(need.bytes, need.in_one_piece) <= small) return;
  const std::optional<double> is_free = free();
  const double usable = is_free ? std::max(share * *is_free, small) : std::numeric_limits<double>::infinity();
  const auto fits = [&](const Need& one) { return one.bytes <= usable && (one.in_one_piece == 0 || given(one.in_one_piece, 1)); };
  if (fits(need)) return;
  // of the newest rows
  int most = 0;
  for (auto too_many = static_cast<int>(n_old + n_more); too_many - most > 1;) {
    const int middle = most + (too_many - most) / 2;
    const double new_rows = std::min<double>(middle, n_more);
    (fits(need_of(middle - new_rows, new_rows)) ? most : too_many) = middle;
  }
  const std::string lack =
      need.bytes > usable
          ? fmt::format("{:.1f} GB more memory, of which {:.1f} GB are free", need.bytes / gigabyte, *is_free / gigabyte)
          : fmt::format("{:.1f} GB more memory in one piece, which the system does not give", need.in_one_piece / gigabyte);
  const std::string window =
      most > 0 ? fmt::format("the newest {} rows would fit: keep these with `window={}`, or ", most, most) : "";
  throw InputError(fmt::format("{}: an exact fit of {:.0f} rows takes {}; {}fit all logs, through inducing points", log,
                               n_old + n_more, lack, window));
}

Posterior with_more(Posterior&& posterior, FitFile& fit, Observations more, const CsvTable& log,
                    std::vector<std::string>& notes) {
  const double before = left_out(posterior);
  const auto n_before = static_cast<double>(posterior.n_states());
  const int n_more = more.n_data(), n_draws = posterior.n_components();
  std::vector<LogFile> logs = counted_logs(fit, posterior);
  require_memory_of_more(posterior, more, log.name(), [] { return free_memory(); });
  const std::string reason = n_more > 0 && posterior.summary() ? reason_of_loss(posterior, more) : "";
  const FitPriorOptions before_range = fit.prior_options;
  if (n_more > 0) extend_range(posterior, fit, more);
  Posterior all = [&] {
    try {
      return update_where_possible(std::move(posterior), fit.report, more);
    } catch (...) {
      fit.prior_options = before_range;
      set_prior(posterior, fit.prior());
      throw;
    }
  }();
  add_impossible_note(n_draws - all.n_components(), n_draws, notes);
  if (n_more > 0) fit.notes.reset();
  if (n_more > 0 && fit.report.inducing) fit.report.inducing->stretches.reset();  // they were of the data before
  if (n_more > 0) {
    // rows of arrays, which have no file, count as one log with those just before
    const bool goes_on = !log.file() && !logs.empty() && logs.back().checksum.empty();
    if (!goes_on) logs.push_back(log.file().value_or(LogFile{log.name()}));
    logs.back().n_learned = logs.back().n_learned.value_or(0) + n_more;
    fit.logs = std::move(logs);
  }
  const bool is_last = (", " + fit.data_source).ends_with(", " + log.name());
  if (n_more > 0 && !is_last) fit.data_source += (fit.data_source.empty() ? "" : ", ") + log.name();
  const double of_more = left_out(all) - before;
  constexpr double much = 1, usual = 3;  // nats; times as much as of as many rows before
  if (of_more > much && of_more > usual * before * n_more / n_before) {
    notes.push_back(
        fmt::format("warning: {}: the fit's inducing points lose about {:.2g} nats of its rows, {}; a fit of all logs chooses "
                    "points for these too",
                    log.name(), of_more, reason));
  }
  return all;
}

Posterior remove_oldest(Posterior&& posterior, FitFile& fit, int n) {
  std::vector<int> n_before;
  for (const Observations& group : posterior.observations()) n_before.push_back(group.n_data());
  std::vector<LogFile> logs = counted_logs(fit, posterior);
  Posterior left = remove_oldest(std::move(posterior), n);
  fit.logs = std::move(logs);
  keep_logs_of_newest(fit, left.n_states());
  if (n > 0) fit.notes.reset();
  std::vector<DistrustedValue>& distrusted = fit.report.distrusted;
  if (left.observations().size() != n_before.size()) {
    distrusted.clear();  // groups that are gone have given others their numbers
    return left;
  }
  for (DistrustedValue& one : distrusted) {
    const auto group = static_cast<std::size_t>(one.group);
    one.state -= n_before[group] - left.observations()[group].n_data();
  }
  std::erase_if(distrusted, [](const DistrustedValue& one) { return one.state < 0; });
  return left;
}

void make_room(Posterior& posterior, FitFile& fit, Observations& more, const UpdateRequest& request) {
  require_window(posterior, request);
  if (!request.window) return;
  if (more.n_data() > *request.window) more = more.slice(more.n_data() - *request.window, *request.window);
  leave_newest(posterior, fit, *request.window - more.n_data());
}

void keep_newest(Posterior& posterior, FitFile& fit, const UpdateRequest& request) {
  require_window(posterior, request);
  if (request.window) leave_newest(posterior, fit, *request.window);
}

UpdateOutcome update(FitFile fit, const std::vector<CsvTable>& logs, const UpdateRequest& request) {
  UpdateOutcome outcome;
  Posterior posterior = fit.posterior();
  require_window(posterior, request);
  if (request.forget) {
    posterior = forget(std::move(posterior), *request.forget);
    fit.notes.reset();
  }
  UpdateRequest of_log = request;
  for (const CsvTable& log : logs) {
    if (of_log.window) *of_log.window -= log.n_rows();  // which come later
  }
  for (const CsvTable& log : logs) {
    if (of_log.window) *of_log.window += log.n_rows();
    Observations more = more_observations(fit, posterior, log, of_log, outcome.notes);
    outcome.n_added += more.n_data();
    make_room(posterior, fit, more, request);
    posterior = with_more(std::move(posterior), fit, std::move(more), log, outcome.notes);
  }
  keep_newest(posterior, fit, request);
  fit.take_data(posterior);
  outcome.n_states = posterior.n_states();
  if (request.window) outcome.n_added = std::min(outcome.n_added, outcome.n_states);  // they are the newest
  outcome.fit = std::move(fit);
  return outcome;
}

}  // namespace gp2
