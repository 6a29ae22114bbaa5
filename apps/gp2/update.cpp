#include <memory>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/jobs/update_job.hpp"

namespace gp2::command {

namespace {

struct UpdateArguments {
  std::string fit, output;
  std::vector<std::string> data;
  UpdateRequest request;
};

void run(const UpdateArguments& arguments) {
  require_output(arguments.output, arguments.data);  // the fit itself may be replaced
  std::vector<CsvTable> logs;
  for (const std::string& path : arguments.data) {
    require_own_system(path,
                       "hyperparameters are held, and those of another system's data are not known: fit to all logs, gp2 fit "
                       "--data LOG --data LOG@OTHER.toml");
    logs.push_back(CsvTable::read(path));
  }
  const UpdateOutcome outcome = update(FitFile::read(arguments.fit), logs, arguments.request);
  outcome.fit.write(arguments.output);
  print_notes(outcome.notes);
  print_notes({fmt::format("{}: {} rows added, {} in all; hyperparameters unchanged", arguments.output, outcome.n_added,
                           outcome.n_states)});
}

}  // namespace

Command update_command() {
  const auto a = std::make_shared<UpdateArguments>();
  return {"update", "Add new data to a fit, with fixed hyperparameters", "gp2 update fit.json --data today.csv -o fit.json",
          joined({{argument("FIT.json", a->fit, "file written by gp2 fit"),
                   required({"data", Repeated{&a->data}, "CSV", "log to add; may be repeated"})},
                  options(a->request),
                  {output(a->output, "JSON", "updated fit to write; may be FIT.json itself")}}),
          [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
