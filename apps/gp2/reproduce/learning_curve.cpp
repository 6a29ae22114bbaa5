#include <algorithm>

#include <fmt/format.h>

#include "command.hpp"
#include "reproduce/experiment.hpp"
#include "reproduce/table.hpp"
#include "streams.hpp"

// Error against the number of observations.
namespace gp2::command {

namespace {

// the q-quantile of sorted values, linear in between
double quantile(const std::vector<double>& sorted, double q) {
  const double place = q * static_cast<double>(sorted.size() - 1);
  const auto below = static_cast<std::size_t>(place);
  const std::size_t above = std::min(below + 1, sorted.size() - 1);
  return sorted[below] + (place - static_cast<double>(below)) * (sorted[above] - sorted[below]);
}

// median, quartiles and extremes over the runs
// @param errors  [method][size][run]
void add_summary(const std::string& system, const std::vector<Method>& methods, const std::vector<double>& sizes,
                 std::vector<std::vector<std::vector<double>>> errors, Table& summary) {
  for (std::size_t m = 0; m < methods.size(); ++m) {
    for (std::size_t k = 0; k < sizes.size(); ++k) {
      std::vector<double>& of = errors[m][k];
      std::sort(of.begin(), of.end());
      summary.add({{"system", system},
                   {"method", methods[m].name},
                   {"n", static_cast<int>(sizes[k])},
                   {"rmse_median", quantile(of, 0.5)},
                   {"rmse_quartile1", quantile(of, 0.25)},
                   {"rmse_quartile3", quantile(of, 0.75)},
                   {"rmse_min", of.front()},
                   {"rmse_max", of.back()}});
    }
  }
}

}  // namespace

void reproduce_learning_curve(const ReproduceOptions& options) {
  const Section definition = Section::read(options.experiments / "learning_curve.toml");
  const std::vector<Method> methods = methods_of(definition);
  const std::vector<double> sizes = definition.numbers("n");
  const auto largest = static_cast<int>(*std::max_element(sizes.begin(), sizes.end()));
  const int n_runs = number_of_runs("", std::nullopt, options.runs, definition.integer("runs"));
  const Protocol::Name protocol = options.protocols.back();
  if (options.data)
    print_notes({"learning-curve: the published observations are 100 per run; these are drawn from the same distributions"});

  Table runs, summary;
  for (const Section& section : definition.sections("system")) {
    const ExperimentSystem system(section, options.experiments, methods);
    // [method][size][run]
    std::vector<std::vector<std::vector<double>>> errors(methods.size(), std::vector<std::vector<double>>(sizes.size()));
    for (int run = 0; run < n_runs; ++run) {
      const CsvTable log = observations_of(system.model, "", std::nullopt, run, largest);
      for (std::size_t k = 0; k < sizes.size(); ++k) {
        const auto n = static_cast<int>(sizes[k]);
        for (std::size_t m = 0; m < methods.size(); ++m) {
          if (progress_is_due())
            print_progress(
                fmt::format("learning-curve: {} run {}/{}, n = {}: {}", system.name, run + 1, n_runs, n, methods[m].name));
          const Score score = score_of(system, methods[m], protocol, log.first_rows(n), run, options.threads,
                                       definition.integer("train_at_most"));
          errors[m][k].push_back(score.rmse_normalised);
          runs.add({{"system", system.name},
                    {"method", methods[m].name},
                    {"n", n},
                    {"run", run},
                    {"rmse_normalised", number_or_null(score.rmse_normalised)},
                    {"max_constraint_error", score.max_constraint_error},
                    {"seconds", score.seconds}});
        }
      }
    }
    add_summary(system.name, methods, sizes, std::move(errors), summary);
  }
  end_progress();
  runs.write(options.output / "learning_curve_runs");
  summary.write(options.output / "learning_curve");
  plot(options, "learning_curve");
}

}  // namespace gp2::command
