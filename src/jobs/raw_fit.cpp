#include "gp2/jobs/raw_fit.hpp"

#include <algorithm>
#include <array>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"
#include "gp2/jobs/resample.hpp"
#include "jobs/read_observations.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;

namespace {

// Every fifth piece of a log belongs to one part, so that each part has seen all of the motion.
constexpr int n_parts = 5, n_pieces = 30;

int part_of(Index row, Index n_rows) { return static_cast<int>(row * n_pieces / n_rows) % n_parts; }

// Accelerations at all states, each by what the other parts tell.
// @param lines  of the observed states, in the table of all states
LearnedAccelerations left_out_accelerations(const Posterior& posterior, const std::vector<int>& lines, const MatrixXd& states) {
  const View view = View::constrained_acceleration(*posterior.prior().system);
  const int nq = posterior.prior().system->nq();
  LearnedAccelerations out{MatrixXd(nq, states.cols()), MatrixXd(nq, states.cols())};
  for (int part = 0; part < n_parts; ++part) {
    constexpr int first_line = 2;
    std::vector<int> others;
    std::vector<Index> here;
    for (std::size_t i = 0; i < lines.size(); ++i) {
      if (part_of(lines[i] - first_line, states.cols()) != part) others.push_back(static_cast<int>(i));
    }
    for (Index i = 0; i < states.cols(); ++i) {
      if (part_of(i, states.cols()) == part) here.push_back(i);
    }
    std::vector<Observations> seen = posterior.observations();
    seen.front() = seen.front().take(others);
    const Posterior::Marginal seen_from_there =
        Posterior(posterior.prior(), std::move(seen), posterior.values()).marginal(view, states(Eigen::all, here), 0);
    out.mean(Eigen::all, here) = seen_from_there.mean;
    out.stddev(Eigen::all, here) = seen_from_there.stddev();
  }
  return out;
}

// The states of a smoothed log, with what acts for its commands.
MatrixXd acting_states(const Model& model, const DerivedData& data, const CsvTable& table) {
  LogReader reader(table, *model.system);
  MatrixXd states = data.states;
  std::vector<std::string> notes;
  static_cast<void>(take_commands(*model.system, model.actuators, reader, std::nullopt, {}, states, notes));
  return states;
}

double total_gain(const DerivedData& data) {
  double gain = 0;
  for (const DerivedSeries& one : data.series) gain += one.gain;
  return gain;
}

}  // namespace

std::vector<Option> options(RawFitOptions& options) {
  std::vector<Option> table = {{"passes", &options.most_passes, "K",
                                "smooth the raw log anew by what was learned from it, at most so often, and as long as positions "
                                "that the fit has not seen get likelier; 0: smooth, then learn"}};
  static constexpr std::array left_out = {"rate", "every", "hold_constraints", "keep", "map"};
  for (Option& option : gp2::options(options.derive)) {
    if (std::find(left_out.begin(), left_out.end(), option.name) == left_out.end()) table.push_back(std::move(option));
  }
  for (Option& option : table) option.needs = "raw";
  return table;
}

std::vector<Option> options(FitRequest& request, RawFitOptions& raw) {
  std::vector<Option> table = options(request);
  for (Option& option : options(raw)) table.push_back(std::move(option));
  return table;
}

CsvTable LearnedLog::table(const System& system, std::string name) const {
  return as_table(data, system, std::move(name)).take(rows);
}

LearnedLog learn_and_smooth(const FitRequest& request, const CsvTable& log, const RawFitOptions& options,
                            const std::atomic<bool>* stop) {
  if (options.most_passes < 0) throw InputError(fmt::format("passes: must not be negative, got {}", options.most_passes));
  const System& system = *request.model.system;
  DeriveOptions smoothing = options.derive;
  smoothing.columns = request.problem.columns;
  const auto with_rows = [&](DerivedData data) {
    LearnedLog out{std::move(data), {}, {}, {}};
    const CsvTable table = as_table(out.data, system, log.name());
    const int n = std::min(request.problem.max_points.value_or(n_raw_rows), table.n_rows());
    out.rows = resample(request.model, table, {.n = n}).rows;
    std::sort(out.rows.begin(), out.rows.end());
    return out;
  };
  std::vector<Actuator> actuators = request.model.actuators;  // estimated anew by each fit, from where the last one found them
  const auto smoothed_by_fit_to = [&](const LearnedLog& before) {
    FitRequest quick = request;
    quick.logs = {{before.table(system, log.name())}};
    const CsvTable whole = as_table(before.data, system, log.name());
    quick.model.actuators = actuators;
    quick.problem.commands = whole;
    quick.problem.columns.clear();
    quick.problem.max_points.reset();
    quick.hyperparameters = HyperparameterChoice::optimise;
    quick.standard_errors = quick.thin = quick.problem.robust = false;
    const FitJob job = prepare_fit(std::move(quick));
    const FitOutcome fit = run_fit(job, {}, stop);
    if (stop != nullptr && *stop) throw NumericalError("stopped while the raw log was learned from");
    actuators = fit.file.model.actuators;
    return with_rows(derive(
        request.model, log, smoothing,
        left_out_accelerations(fit.posterior, job.problem.lines.front(), acting_states(fit.file.model, before.data, whole))));
  };

  LearnedLog best = with_rows(derive(request.model, log, smoothing));
  if (options.most_passes == 0) return best;
  constexpr double decisive = 10;  // nats
  LearnedLog next = smoothed_by_fit_to(best);
  const double first = total_gain(next.data);
  std::vector<double> gains;
  while (static_cast<int>(gains.size()) < options.most_passes) {
    // how good a smoothing is to learn from shows in the one after it
    LearnedLog after = smoothed_by_fit_to(next);
    const double gain = total_gain(after.data);
    if (!(gain > total_gain(next.data) + decisive)) break;
    gains.push_back(gain);
    best = std::exchange(next, std::move(after));
  }
  best.notes.push_back(
      gains.empty()
          ? "learning from a smoothing by what was learned makes positions that the fit has not seen no likelier: it is not kept"
          : fmt::format(
                "smoothed by what was learned, {} times: log likelihood of positions that the fits have not seen + {:.4g}, "
                "learned from that + {:.4g}",
                gains.size(), first, fmt::join(gains, ", + ")));
  best.gains = std::move(gains);
  return best;
}

}  // namespace gp2
