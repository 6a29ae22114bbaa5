#include "gp2/jobs/derive.hpp"

#include <algorithm>
#include <memory>
#include <set>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/suggestion.hpp"
#include "command.hpp"
#include "gp2/base/statistics.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

struct DeriveArguments {
  std::string log, model, like, output;
  DeriveOptions options;
};

std::string text_of(const std::vector<const DerivedSeries*>& series) {
  const auto middle = [&](auto member) {
    std::vector<double> values;
    for (const DerivedSeries* one : series) values.push_back(member(*one));
    return median(values);
  };
  const auto total = [&](int DerivedSeries::*member) {
    int sum = 0;
    for (const DerivedSeries* one : series) sum += one->*member;
    return sum;
  };
  std::string text = fmt::format("{} samples at {:.3g} Hz; lengthscale {:.3g} s, size {:.3g}, noise {:.2e}, bandwidth {:.3g} Hz",
                                 total(&DerivedSeries::used), middle([](const DerivedSeries& one) { return one.rate; }),
                                 middle([](const DerivedSeries& one) { return one.model.lengthscale; }),
                                 middle([](const DerivedSeries& one) { return one.model.signal_stddev; }),
                                 middle([](const DerivedSeries& one) { return one.model.noise_stddev; }),
                                 middle([](const DerivedSeries& one) { return one.bandwidth; }));
  if (series.size() > 1) text += " (medians)";
  if (const double resolution = middle([](const DerivedSeries& one) { return one.resolution; }); resolution > 0) {
    text += fmt::format(", resolution {:.3g}", resolution);
  }
  std::vector<std::string> counts;
  if (const int n = total(&DerivedSeries::outliers); n > 0) counts.push_back(counted(n, "outlier left out", "outliers left out"));
  if (const int n = total(&DerivedSeries::repeated); n > 0) counts.push_back(fmt::format("{} repeated", n));
  if (const int n = total(&DerivedSeries::missing); n > 0) counts.push_back(fmt::format("{} missing", n));
  if (const int n = total(&DerivedSeries::wraps); n > 0)
    counts.push_back(counted(n, "jump of 2π removed", "jumps of 2π removed"));
  if (const int n = total(&DerivedSeries::gaps); n > 0) {
    double longest = 0;
    for (const DerivedSeries* one : series) longest = std::max(longest, one->longest_gap);
    counts.push_back(fmt::format("{}, the longest {:.3g} s", counted(n, "gap"), longest));
  }
  const auto shared = std::count_if(series.begin(), series.end(), [](const DerivedSeries* one) { return one->shared_model; });
  if (shared > 0)
    counts.push_back(counted(shared, "episode too short for a model of its own", "episodes too short for a model of their own"));
  const auto add_if_any = [&](bool DerivedSeries::*is, const std::string& what) {
    const auto n = std::count_if(series.begin(), series.end(), [is](const DerivedSeries* one) { return one->*is; });
    if (n > 0) counts.push_back(what + (series.size() > 1 ? fmt::format(" in {} of {} episodes", n, series.size()) : ""));
  };
  add_if_any(&DerivedSeries::noise_at_least, "noise at that of rounding");
  add_if_any(&DerivedSeries::noise_unseen,
             "no noise seen: the log is simulated, or the motion is too fast to be distinguished from noise, and then the "
             "standard deviation of the positions is too small");
  if (!counts.empty()) text += fmt::format("; {}", fmt::join(counts, ", "));
  return text;
}

}  // namespace

void print_smoothing(const DerivedData& data, const System& system) {
  for (const int j : data.measured) {
    std::vector<const DerivedSeries*> series;
    for (const DerivedSeries& one : data.series) {
      if (one.coordinate == j) series.push_back(&one);
    }
    print_notes({fmt::format("{}: {}", system.coordinates()[static_cast<std::size_t>(j)].name, text_of(series))});
  }
}

namespace {

void run(DeriveArguments& arguments) {
  require_output(arguments.output, {arguments.log, arguments.model, arguments.like});
  const Model model = Model::read(arguments.model);
  if (!arguments.like.empty()) arguments.options.like = CsvTable::read(arguments.like);
  arguments.options.progress = [](double fraction) {
    if (progress_is_due()) print_progress(fmt::format("smoothing {:3.0f} %", 100 * fraction));
  };
  const DerivedData data = derive(model, CsvTable::read(arguments.log), arguments.options);
  end_progress();

  const CsvTable table = as_table(data, *model.system, arguments.output);
  table.write(arguments.output);
  print_notes(data.notes);
  print_smoothing(data, *model.system);
  const std::set<std::string> episodes(data.episodes.begin(), data.episodes.end());  // parts of one have its name
  std::vector<std::string> independent;
  for (const int j : data.independent) independent.push_back(model.system->acceleration_names()[static_cast<std::size_t>(j)]);
  print_notes({fmt::format("{}: {} rows, {}; independent accelerations: {}", arguments.output, table.n_rows(),
                           counted(episodes.size(), "episode"), fmt::join(independent, ", "))});
}

}  // namespace

Command derive_command() {
  const auto a = std::make_shared<DeriveArguments>();
  return {"derive", "Smooth a raw log of positions into velocities and accelerations for a fit",
          "gp2 derive encoders.csv --model models/double_pendulum.toml --map theta1=q3,theta2=q6 -o data.csv",
          joined({{argument("LOG", a->log, "CSV with t and positions, optionally velocities and inputs"),
                   required({"model", &a->model, "MODEL", "model file"}),
                   {"like", &a->like, "LOG",
                    "use the smoothing models of this other raw log, so that training and test data pass through the same filter",
                    "the log's own models"}},
                  options(a->options),
                  {output(a->output, "CSV", "CSV file to write")}}),
          [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
