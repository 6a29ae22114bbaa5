#include <filesystem>
#include <memory>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command.hpp"
#include "gp2/base/file.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/export_job.hpp"

namespace gp2::command {

namespace {

struct ExportArguments {
  std::string fit, system, output;
  ExportRequest request;
};

void run(ExportArguments& arguments) {
  const FitFile fit = FitFile::read(arguments.fit);
  arguments.request.view.system = read_other_system(arguments.system);
  const ExportOutcome outcome = export_fit(fit, fit.posterior(), arguments.request);
  make_folder(arguments.output);
  std::vector<std::string> written;
  for (const auto& [name, text] : outcome.files) {
    const std::filesystem::path path = std::filesystem::path(arguments.output) / name;
    write_file(path, text);
    written.push_back(fmt::format("{} ({:.0f} kB)", path.string(), static_cast<double>(text.size()) / 1e3));
  }
  print_notes(outcome.notes);
  print_notes({fmt::format("{}", fmt::join(written, ", "))});
}

}  // namespace

Command export_command() {
  const auto a = std::make_shared<ExportArguments>();
  Command command{"export",
                  "Write a fit as C: predictions that obey the constraints on machines without gp2, in CasADi and in acados",
                  "gp2 export fit.json --to c -o controller",
                  {},
                  {}};
  command.options = {argument("FIT.json", a->fit, "file written by gp2 fit"), {"system", &a->system, "OTHER.toml", system_help}};
  for (Option& option : options(a->request)) command.options.push_back(std::move(option));
  command.options.push_back(output(a->output, "DIR", "folder for the files; it is made where there is none"));
  command.run = [a](const std::set<std::string>&) { run(*a); };
  return command;
}

}  // namespace gp2::command
