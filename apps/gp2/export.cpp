#include <filesystem>
#include <memory>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command.hpp"
#include "gp2/base/file.hpp"
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
  // a robot's file is one, and is called as it is asked for
  const bool is_robot = arguments.request.is_of_robot();
  const ExportOutcome outcome =
      is_robot ? export_robot(fit, arguments.request) : export_fit(fit, fit.posterior(), arguments.request);
  if (is_robot) {
    require_output(arguments.output, {arguments.fit, outcome.robot});
  } else {
    make_folder(arguments.output);
  }
  std::vector<std::pair<std::filesystem::path, std::string>> files;
  std::vector<std::string> written;
  for (const auto& [name, text] : outcome.files) {
    std::filesystem::path path = arguments.output;
    if (!is_robot) path /= name;
    files.emplace_back(path, text);
    written.push_back(fmt::format("{} ({:.0f} kB)", path.string(), static_cast<double>(text.size()) / 1e3));
  }
  write_files(files);
  print_notes(outcome.notes);
  print_notes({fmt::format("{}", fmt::join(written, ", "))});
}

}  // namespace

Command export_command() {
  const auto a = std::make_shared<ExportArguments>();
  return {"export", "Export a fit as C code, also for CasADi and acados, or the parameters of a robot into its MJCF or URDF file",
          "gp2 export fit.json --to c -o controller",
          joined({{argument("FIT.json", a->fit, "file written by gp2 fit"), {"system", &a->system, "OTHER.toml", system_help}},
                  options(a->request),
                  {output(a->output, "OUT", "folder to write, created if necessary; for mjcf and urdf the file")}}),
          [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
