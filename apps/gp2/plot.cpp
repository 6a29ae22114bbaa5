#include "gp2/report/plot.hpp"

#include <memory>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/base/file.hpp"
#include "gp2/files/fit_file.hpp"

namespace gp2::command {

namespace {

struct PlotArguments {
  std::string fit, output;
  PlotRequest request;
};

void run(const PlotArguments& arguments) {
  require_output(arguments.output, {arguments.fit});
  require_name_of_svg(arguments.output);
  const FitFile fit = FitFile::read(arguments.fit);
  const LearnedCurve curve = learned_curve(fit.posterior(), arguments.request);
  write_file(arguments.output, plot(curve, fit.model));
  print_notes({fmt::format("{}: {} along {}", arguments.output, curve.force.names[static_cast<std::size_t>(curve.row)],
                           curve.force.along)});
}

}  // namespace

Command plot_command() {
  const auto a = std::make_shared<PlotArguments>();
  return {"plot", "Plot what a fit has learned: a force along one variable, with its 95 % band and the data",
          "gp2 plot fit.json --what friction -o friction.svg",
          joined({{argument("FIT.json", a->fit, "file written by gp2 fit")},
                  options(a->request),
                  {output(a->output, "SVG", "self-contained SVG file to write")}}),
          [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
