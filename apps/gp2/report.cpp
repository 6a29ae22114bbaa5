#include <memory>

#include <fmt/format.h>
#include <fmt/ranges.h>

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
  std::vector<std::string> inputs = options.fits;
  inputs.insert(inputs.end(), {options.data, options.system, options.truth});
  require_output(arguments.output, inputs);
  std::vector<std::string> notes;
  const std::vector<Report> reports = collect_reports(options, notes);
  print_notes(notes);
  const std::string page = report_page(reports, with_flags);
  write_file(arguments.output, page);
  std::vector<std::string> names;
  for (const Report& report : reports) names.push_back(report.fit.model.system->name());
  print_notes({fmt::format("{}: report of '{}', {:.0f} kB; open it in a browser", arguments.output, fmt::join(names, "' and '"),
                           static_cast<double>(page.size()) / 1e3)});
}

}  // namespace

Command report_command() {
  const auto a = std::make_shared<ReportArguments>();
  return {"report",
          "Write a fit as one HTML page: what was fitted, how well, pictures of residuals, calibration and motion, and what "
          "to do next",
          "gp2 report fit.json --data test.csv -o report.html",
          joined({{arguments("FIT.json", a->options.fits, "file written by gp2 fit; several stand side by side on the page")},
                  options(a->options),
                  {output(a->output, "HTML", "HTML file to write; it needs no network")}}),
          [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
