#include <cmath>
#include <memory>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/jobs/shoot_job.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

struct ShootArguments {
  std::string fit, data, output;
  ShootRequest request;
};

std::string with_stddev(double value, double stddev) {
  return std::isfinite(stddev) ? fmt::format("{:.6g} ± {:.2g}", value, stddev) : fmt::format("{:.6g}", value);
}

void run(const ShootArguments& arguments) {
  require_own_system(arguments.data, "the motion that is compared with the log is that of the fit's own system");
  require_output(arguments.output, {arguments.fit, arguments.data});
  const ShootOutcome outcome = shoot(FitFile::read(arguments.fit), CsvTable::read(arguments.data), arguments.request);
  outcome.fit.write(arguments.output);
  print_notes(outcome.notes);
  print_result("{:<20} {:<26} {}\n", "", "one by one", "by the motion");
  for (const ShotParameter& one : outcome.parameters) {
    print_result("{:<20} {:<26} {}\n", outcome.fit.model.labelled(one.name), with_stddev(one.one_step, one.one_step_stddev),
                 with_stddev(one.value, one.stddev));
  }
  for (std::size_t c = 0; c < outcome.coordinates.size(); ++c) {
    const auto k = static_cast<Eigen::Index>(c);
    print_result("{:<20} {:<26.3g} {:.3g}\n", "rms off in " + outcome.coordinates[c], outcome.rms_before[k],
                 outcome.rms_after[k]);
  }
  print_notes({fmt::format("{}: {} stretches of {:.3g} s, {} iterations", arguments.output, outcome.n_stretches, outcome.duration,
                           outcome.iterations)});
}

}  // namespace

Command shoot_command() {
  const auto a = std::make_shared<ShootArguments>();
  return {"shoot", "Re-estimate the parameters of a fit from motions over stretches of a log (multiple shooting)",
          "gp2 shoot fit.json --data smoothed.csv -o shot.json",
          joined({{argument("FIT.json", a->fit, "file written by gp2 fit, with parameters that it estimates"),
                   required({"data", &a->data, "CSV",
                             "CSV with consecutive rows of t, coordinates, velocities and inputs, as written by gp2 derive"})},
                  options(a->request),
                  {output(a->output, "JSON", "fit to write, with the new parameters")}}),
          [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
