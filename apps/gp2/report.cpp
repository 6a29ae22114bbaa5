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
  return {"report", "Write an HTML report of a fit: model, accuracy, residuals, calibration, simulated motion, advice",
          "gp2 report fit.json --data test.csv -o report.html",
          joined({{arguments("FIT.json", a->options.fits, "file written by gp2 fit; several are compared")},
                  options(a->options),
                  {output(a->output, "HTML", "self-contained HTML file to write")}}),
          [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
