#include <memory>

#include <fmt/format.h>

#include "command.hpp"
#include "report/report_data.hpp"

namespace gp2::command {

namespace {

struct Arguments {
  std::string fit, data, truth, map, output;
};

void run(const Arguments& arguments) {
  require_output(arguments.output, {arguments.fit, arguments.data, arguments.truth});
  if (!arguments.map.empty() && arguments.data.empty()) {
    throw InputError("--map names columns of --data, which is not given; the fit has its own data");
  }
  std::vector<std::string> notes;
  const Report report = collect_report({arguments.fit, arguments.data, arguments.truth, parse_map(arguments.map)}, notes);
  talk(notes);
  const std::string page = report_page(report);
  write_file(arguments.output, page);
  talk({fmt::format("{}: report of '{}', {:.0f} kB; open it in a browser", arguments.output, report.fit.model.system->name(),
                    static_cast<double>(page.size()) / 1e3)});
}

}  // namespace

void add_report(CLI::App& app) {
  CLI::App* command = app.add_subcommand("report",
                                         "Write a fit as one HTML page: what was fitted, how well, pictures of residuals, "
                                         "calibration and motion, and what to do next");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("FIT.json", arguments->fit, "file written by gp2 fit")->required();
  command->add_option("--data", arguments->data, "CSV with states and accelerations that the fit has not seen: a test");
  command->add_option("--truth", arguments->truth,
                      "model file whose [truth] is the true acceleration, shown beside the prediction");
  command->add_option("--map", arguments->map, "columns of --data by other names, LOGNAME=MODELNAME,…");
  command->add_option("-o,--output", arguments->output, "HTML file to write; it needs no network")->required();
  command->footer("Example:\n  gp2 report fit.json --data test.csv -o report.html");
  command->callback([arguments] { run(*arguments); });
}

}  // namespace gp2::command
