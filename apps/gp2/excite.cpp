#include "gp2/jobs/excite_job.hpp"

#include <cmath>
#include <memory>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "command.hpp"
#include "gp2/error.hpp"
#include "gp2/files/fit_file.hpp"
#include "interruption.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

using Json = nlohmann::ordered_json;

struct ExciteArguments {
  std::string fit, system, start, inputs_within, within, output;
  ExciteRequest request;
  bool json = false;
};

Json to_json(const std::vector<Excitation::Known>& known) {
  Json list = Json::array();
  for (const Excitation::Known& one : known) {
    list.push_back({{"name", one.name}, {"now", one.now}, {"after", one.after}, {"random", one.random}});
  }
  return list;
}

Json to_json(const Excitation& found) {
  Json limits = Json::array();
  for (const Excitation::LimitUse& one : found.limits) {
    limits.push_back({{"name", one.name},
                      {"lower", one.lower},
                      {"upper", one.upper},
                      {"lowest", one.lowest},
                      {"highest", one.highest},
                      {"share", one.share}});
  }
  return {{"for", found.target == ExcitationTarget::parameters ? "parameters" : "accelerations"},
          {"factor", found.factor},
          {"random_factor", found.random_factor},
          {"parameters", to_json(found.parameters)},
          {"accelerations", to_json(found.accelerations)},
          {"limits", limits},
          {"n_motions", found.n_motions},
          {"n_random", found.n_random},
          {"n_failed", found.n_failed},
          {"highest_frequency", found.highest_frequency},
          {"leaves_data_at", found.leaves_data ? Json(*found.leaves_data) : Json()},
          {"interrupted", found.interrupted},
          {"seconds", found.seconds}};
}

std::string known_text(const Excitation::Known& one) {
  const std::string random = std::isnan(one.random) ? "" : fmt::format("; {:.3g} after a random one", one.random);
  return fmt::format("{}: standard deviation {:.3g} now, {:.3g} after this motion{}", one.name, one.now, one.after, random);
}

std::vector<std::string> notes_of(const Excitation& found, const ExciteArguments& arguments) {
  std::vector<std::string> notes = found.notes;
  for (const Excitation::Known& one : found.parameters) notes.push_back(known_text(one));
  for (const Excitation::Known& one : found.accelerations) {
    notes.push_back(known_text(one) + ", rms over motions within the limits");
  }
  if (found.n_random == 0) {
    notes.emplace_back("no random motion stays within the limits for comparison");
  } else {
    notes.push_back(
        fmt::format("overall, standard deviations fall to {:.3g} of their present values; with a random motion to {:.3g}, the "
                    "median of {}, each as large as the limits allow",
                    found.factor, found.random_factor, found.n_random));
  }
  for (const Excitation::LimitUse& one : found.limits) {
    notes.push_back(fmt::format("{} goes from {:.4g} to {:.4g}: {:.0f} % of its limits {:.4g}:{:.4g}", one.name, one.lowest,
                                one.highest, 100 * one.share, one.lower, one.upper));
  }
  if (found.leaves_data) {
    notes.push_back(
        fmt::format("warning: the motion leaves the region of the data at t = {:.6g}, where its prediction is uncertain: leave a "
                    "margin in the limits, and plan again after a fit with the new measurements",
                    *found.leaves_data));
  }
  notes.push_back(fmt::format(
      "{}: {} rows, frequencies up to {:.3g} Hz; the best of {} motions ({} could not be integrated), {:.1f} s", arguments.output,
      found.motion.times.size(), found.highest_frequency, found.n_motions, found.n_failed, found.seconds));
  return notes;
}

void print_search(const ExciteProgress& p) {
  if (!progress_is_due()) return;
  const double left = p.seconds * (p.n_all - p.n_motions) / p.n_motions;
  const std::string best =
      std::isnan(p.best) ? "none within the limits yet" : fmt::format("standard deviations fall to {:.3g}", p.best);
  print_progress(fmt::format("motion {}/{}  {}  about {:.0f} s left", p.n_motions, p.n_all, best, std::max(left, 0.0)));
}

void run(ExciteArguments& arguments) {
  require_output(arguments.output, {arguments.fit, arguments.start, arguments.system});
  const FitFile fit = FitFile::read(arguments.fit);
  const Posterior posterior = fit.posterior();
  const std::shared_ptr<const Model> other = read_other_system(arguments.system);
  const FitSystem driven = system_of(fit, posterior.prior(), other);
  arguments.request.start = read_start(arguments.start);
  arguments.request.inputs_within = parse_limits(arguments.inputs_within, "--inputs-within");
  arguments.request.within = parse_limits(arguments.within, "--within");

  const Interruption interruption;
  const Excitation found = [&] {
    try {
      return excite(driven, posterior, fit.report.hyperparameters, arguments.request, print_search, interruption.stop());
    } catch (const NumericalError&) {
      if (interruption.signal() == 0) throw;
      print_notes({fmt::format("{} before there was a motion: nothing is written", interruption.text())});
      throw Interrupted{interruption.signal()};
    }
  }();
  end_progress();

  as_table(found.motion, *driven.model->system, arguments.output).write(arguments.output);
  print_notes(notes_of(found, arguments));
  if (arguments.json) print_json(to_json(found));
  if (!found.interrupted) return;
  print_notes({fmt::format("{}: {} holds the best motion so far", interruption.text(), arguments.output)});
  throw Interrupted{interruption.signal()};
}

}  // namespace

Command excite_command() {
  const auto a = std::make_shared<ExciteArguments>();
  return {
      "excite", "Plan the most informative motion to measure next, within limits",
      "gp2 excite fit.json --start q1=0,q2=0 --duration 10 --inputs-within u1=-5:5,u2=-5:5,u3=-5:5 -o next.csv",
      joined({{argument("FIT", a->fit, "file written by gp2 fit"),
               {"system", &a->system, "OTHER.toml", system_help},
               start_option(a->start),
               required({"duration", &a->request.duration, "SECONDS", "duration of the motion [s]"}),
               required({"inputs_within", &a->inputs_within, "NAME=LOWEST:HIGHEST,…",
                         "limits of every input but of contacts, never exceeded"}),
               {"within", &a->within, "NAME=LOWEST:HIGHEST,…",
                "limits of coordinates, velocities and accelerations, kept at every row of the predicted motion"}},
              options(a->request),
              {{"json", &a->json, "", "print the report as JSON"},
               output(a->output, "CSV", "CSV file to write: t, planned q, dq and ddq, and inputs; gp2 simulate reads it too")}}),
      [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
