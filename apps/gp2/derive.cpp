#include "gp2/jobs/derive.hpp"

#include <algorithm>
#include <memory>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command.hpp"
#include "gp2/base/statistics.hpp"

namespace gp2::command {

namespace {

struct Arguments {
  std::string log, model, output, map, episode, episodes, keep, smoothness = "9/2";
  double rate = 0;
  int every = 1;
  bool hold_constraints = false;
  double outlier_threshold = 5;
};

// "0-12,15" -> 0 … 12, 15; what is no range of whole numbers is a name
std::vector<std::string> parse_episodes(const std::string& text) {
  std::vector<std::string> episodes;
  for (const std::string& item : parse_list(text)) {
    const std::size_t dash = item.find('-', 1);
    int first = 0, last = 0;
    const bool range = dash != std::string::npos && CLI::detail::lexical_cast(item.substr(0, dash), first) &&
                       CLI::detail::lexical_cast(item.substr(dash + 1), last);
    if (!range) {
      episodes.push_back(item);
      continue;
    }
    constexpr int most = 1'000'000;
    if (last < first || last - first > most)
      throw InputError(fmt::format("--episodes: '{}' is not a range FIRST-LAST, say 0-12", item));
    for (int k = first; k <= last; ++k) episodes.push_back(std::to_string(k));
  }
  return episodes;
}

// "2 gaps, the longest 0.3 s"
std::string count_of(int n, const std::string& one, const std::string& many) {
  return fmt::format("{} {}", n, n == 1 ? one : many);
}

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
  std::string text =
      fmt::format("{} samples; lengthscale {:.3g} s, size {:.3g}, noise {:.2e}, bandwidth {:.3g} Hz", total(&DerivedSeries::used),
                  middle([](const DerivedSeries& one) { return one.model.lengthscale; }),
                  middle([](const DerivedSeries& one) { return one.model.signal_stddev; }),
                  middle([](const DerivedSeries& one) { return one.model.noise_stddev; }),
                  middle([](const DerivedSeries& one) { return one.bandwidth; }));
  if (series.size() > 1) text += " (medians)";
  if (const double resolution = middle([](const DerivedSeries& one) { return one.resolution; }); resolution > 0) {
    text += fmt::format(", resolution {:.3g}", resolution);
  }
  std::vector<std::string> counts;
  if (const int n = total(&DerivedSeries::outliers); n > 0)
    counts.push_back(count_of(n, "outlier left out", "outliers left out"));
  if (const int n = total(&DerivedSeries::repeated); n > 0) counts.push_back(fmt::format("{} repeated", n));
  if (const int n = total(&DerivedSeries::missing); n > 0) counts.push_back(fmt::format("{} missing", n));
  if (const int n = total(&DerivedSeries::wraps); n > 0)
    counts.push_back(count_of(n, "jump of 2π taken out", "jumps of 2π taken out"));
  if (const int n = total(&DerivedSeries::gaps); n > 0) {
    double longest = 0;
    for (const DerivedSeries* one : series) longest = std::max(longest, one->longest_gap);
    counts.push_back(fmt::format("{}, the longest {:.3g} s", count_of(n, "gap", "gaps"), longest));
  }
  const auto shared = std::count_if(series.begin(), series.end(), [](const DerivedSeries* one) { return one->shared_model; });
  if (shared > 0)
    counts.push_back(count_of(static_cast<int>(shared), "episode too short for a model of its own",
                              "episodes too short for a model of their own"));
  const auto at_least = std::count_if(series.begin(), series.end(), [](const DerivedSeries* one) { return one->noise_at_least; });
  if (at_least > 0)
    counts.push_back("noise at that of rounding" +
                     (series.size() > 1 ? fmt::format(" in {} of {} episodes", at_least, series.size()) : ""));
  if (!counts.empty()) text += fmt::format("; {}", fmt::join(counts, ", "));
  return text;
}

void report(const DerivedData& data, const System& system) {
  for (const int j : data.measured) {
    std::vector<const DerivedSeries*> series;
    for (const DerivedSeries& one : data.series) {
      if (one.coordinate == j) series.push_back(&one);
    }
    talk({fmt::format("{}: {}", system.coordinates()[static_cast<std::size_t>(j)].name, text_of(series))});
  }
}

void run(const Arguments& arguments) {
  require_output(arguments.output, {arguments.log, arguments.model});
  const Model model = Model::read(arguments.model);
  const CsvTable log = CsvTable::read(arguments.log);
  DeriveOptions options;
  options.columns = parse_map(arguments.map);
  options.episode_column = arguments.episode;
  options.episodes = parse_episodes(arguments.episodes);
  options.keep = parse_list(arguments.keep);
  options.rate = arguments.rate;
  options.every = arguments.every;
  options.hold_constraints = arguments.hold_constraints;
  options.outlier_threshold = arguments.outlier_threshold;
  options.smoothness = *smoothness_of(arguments.smoothness);
  const DerivedData data = derive(model, log, options);

  const CsvTable table = as_table(data, *model.system, arguments.output);
  write_file(arguments.output, table.text());
  talk(data.notes);
  report(data, *model.system);
  std::vector<std::string> independent;
  for (const int j : data.independent) independent.push_back(model.system->acceleration_names()[static_cast<std::size_t>(j)]);
  talk({fmt::format("{}: {} rows, {}; independent accelerations: {}", arguments.output, table.n_rows(),
                    count_of(static_cast<int>(data.episodes.size()), "episode", "episodes"), fmt::join(independent, ", "))});
}

}  // namespace

void add_derive(CLI::App& app) {
  CLI::App* command = app.add_subcommand("derive", "Smooth a raw log of positions into velocities and accelerations for a fit");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("LOG", arguments->log, "CSV of t and positions, and of velocities and inputs where there are")->required();
  command->add_option("--model", arguments->model, "model file")->required();
  command->add_option("--episode", arguments->episode,
                      "column that tells episodes apart (default: episode, where the log has it)");
  command->add_option("--episodes", arguments->episodes, "only these, say 0-12,15");
  command->add_option("--rate", arguments->rate, "rows per second, evenly within an episode (default: where there are samples)");
  command->add_option("--every", arguments->every, "only each so many rows")->capture_default_str();
  command->add_flag("--hold-constraints", arguments->hold_constraints,
                    "condition each row on the constraints, where more is measured than they leave free");
  command
      ->add_option(
          "--outlier-threshold", arguments->outlier_threshold,
          "a sample is distrusted that is farther than this many standard deviations from what the others say; 0: none is")
      ->capture_default_str();
  command->add_option("--smoothness", arguments->smoothness, "order of the Matérn kernel of the motion")
      ->check(CLI::IsMember(smoothness_words()))
      ->capture_default_str();
  command->add_option("--keep", arguments->keep, "further columns of the log to pass on, NAME,…");
  command->add_option("--map", arguments->map, "columns by other names, LOGNAME=MODELNAME,…");
  command->add_option("-o,--output", arguments->output, "CSV file to write")->required();
  command->footer(
      "Example:\n  gp2 derive encoders.csv --model models/double_pendulum.toml --map theta1=q3,theta2=q6 -o data.csv");
  command->callback([arguments] { run(*arguments); });
}

}  // namespace gp2::command
