#include <memory>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/base/file.hpp"
#include "gp2/report/report_page.hpp"

namespace gp2::command {

namespace {

struct ReportArguments {
  std::string output;
  ReportOptions options;
};

void run(const ReportArguments& arguments) {
  const ReportOptions& options = arguments.options;
  require_output(arguments.output, {options.fit, options.data, options.system, options.truth});
  std::vector<std::string> notes;
  const Report report = collect_report(options, notes);
  print_notes(notes);
  const std::string page = report_page(report, with_flags);
  write_file(arguments.output, page);
  print_notes({fmt::format("{}: report of '{}', {:.0f} kB; open it in a browser", arguments.output,
                           report.fit.model.system->name(), static_cast<double>(page.size()) / 1e3)});
}

}  // namespace

Command report_command() {
  const auto a = std::make_shared<ReportArguments>();
  Command command{
      "report",
      "Write a fit as one HTML page: what was fitted, how well, pictures of residuals, calibration and motion, and what "
      "to do next",
      "gp2 report fit.json --data test.csv -o report.html",
      {},
      {}};
  command.options = {argument("FIT.json", a->options.fit, "file written by gp2 fit")};
  for (Option& option : options(a->options)) command.options.push_back(std::move(option));
  command.options.push_back(output(a->output, "HTML", "HTML file to write; it needs no network"));
  command.run = [a](const std::set<std::string>&) { run(*a); };
  return command;
}

}  // namespace gp2::command
