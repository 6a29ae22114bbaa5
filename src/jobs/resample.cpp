#include "gp2/jobs/resample.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/random.hpp"
#include "base/stop.hpp"
#include "base/suggestion.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/observations.hpp"
#include "model/prior_words.hpp"
#include "prior/expression_function.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

FarthestPoints farthest_points(const Ref<const MatrixXd>& points, int n, int first, const std::atomic<bool>* stop) {
  FarthestPoints out;
  out.distance = VectorXd::Zero(n);
  // squares of distances from the nearest chosen point; −1 at the chosen ones, so that none is chosen twice
  VectorXd nearest = VectorXd::Constant(points.cols(), std::numeric_limits<double>::infinity());
  Index next = first;
  for (int k = 0; k < n; ++k) {
    require_not_stopped(stop);
    if (k > 0) out.distance[k] = std::sqrt(nearest.maxCoeff(&next));
    out.chosen.push_back(static_cast<int>(next));
    nearest = nearest.cwiseMin((points.colwise() - points.col(next)).colwise().squaredNorm().transpose());
    nearest[next] = -1;
  }
  out.radius = std::sqrt(std::max(nearest.maxCoeff(), 0.0));
  return out;
}

namespace {

struct Features {
  std::vector<std::string> names;
  std::vector<std::shared_ptr<const StateFunction>>
      functions;            // whose values, one below the other, are these; and some that repeat
  std::vector<Index> rows;  // those of `names` among these values

  void add(const std::vector<std::string>& further, std::shared_ptr<const StateFunction> function) {
    Index row = 0;
    for (const auto& one : functions) row += one->size();
    for (const std::string& name : further) {
      if (std::find(names.begin(), names.end(), name) == names.end()) {
        names.push_back(name);
        rows.push_back(row);
      }
      ++row;
    }
    functions.push_back(std::move(function));
  }
};

// @throws InputError for what does not vary with the state, or is no function of it.
void require_of_state(const Model& model, Expression feature) {
  const std::vector<std::string> variables = model.graph->variables_of(feature);
  if (variables.empty()) throw InputError("is the same at every state, and measures nothing");
  for (const std::string& name : model.system->acceleration_names()) {
    if (std::ranges::find(variables, name) == variables.end()) continue;
    throw InputError(
        fmt::format("reads {}, which is no part of the state: measure by coordinates, velocities, t and inputs", name));
  }
}

// those asked for, with angles and parameters as the prior has them, or those of all latents of the prior
Features features_of(const Model& model, const std::vector<std::string>& asked) {
  Features out;
  if (asked.empty()) {
    for (const Latent& latent : make_prior(model).latents) out.add(latent.feature_names, latent.features);
    return out;
  }
  const PriorWords words = prior_words(model);
  std::vector<std::string> names;
  std::vector<Expression> values;
  for (const std::string& written : asked) {
    for (const std::string& name : expand_angle(written, model.system->coordinates())) {
      try {
        values.push_back(words.with_values(words.parse(name), *model.system));
        require_of_state(model, values.back());
      } catch (const InputError& error) {
        throw InputError(fmt::format("`features`: '{}': {}", written, error.what()));
      }
      names.push_back(name);
    }
  }
  out.add(names, ExpressionFunction::of_state(values, words.symbols, model.system));
  return out;
}

// divided by their standard deviation; 0 where they do not vary
MatrixXd standardised(const MatrixXd& values) {
  const VectorXd mean = values.rowwise().mean(), spread = row_spread(values);
  const VectorXd scale = (spread.array() > 0).select(spread.cwiseInverse(), 0);
  return scale.asDiagonal() * (values.colwise() - mean);
}

}  // namespace

std::vector<Option> options(ResampleOptions& options) {
  return {
      {"features", &options.features, "q1,dq1,…", "expressions in which distances are measured",
       "the features of the model's latents"},
      {"seed", &options.seed, "S", "random seed to choose the first row", "none: the row nearest to the mean"},
      columns_option(options.columns),
  };
}

Resample resample(const Model& model, const CsvTable& log, const ResampleOptions& options, const std::atomic<bool>* stop) {
  if (options.n < 1) throw InputError(fmt::format("resample: n must be positive, got {}", options.n));
  Features features = features_of(model, options.features);
  std::vector<bool> reads;
  for (int k = 0; k < model.system->layout().size(); ++k) {
    reads.push_back(std::any_of(features.functions.begin(), features.functions.end(),
                                [&](const auto& function) { return function->reads(k); }));
  }
  const MatrixXd states = open_log(model, log, options.columns).states_with_gaps(reads);
  MatrixXd all(0, states.cols());
  for (const auto& function : features.functions) {
    const MatrixXd of_this = function->evaluate(states, VectorXd());
    all.conservativeResize(all.rows() + of_this.rows(), Eigen::NoChange);
    all.bottomRows(of_this.rows()) = of_this;
  }
  const MatrixXd values = all(features.rows, Eigen::all);

  std::vector<int> usable;
  for (int i = 0; i < log.n_rows(); ++i) {
    if (values.col(i).allFinite()) usable.push_back(i);
  }
  const int n_usable = static_cast<int>(usable.size());
  if (options.n > n_usable) {
    throw InputError(fmt::format(
        "{}: has {} rows{}, fewer than the n = {} asked for", log.name(), n_usable,
        n_usable < log.n_rows() ? fmt::format(" with a number in every feature, of {}", log.n_rows()) : "", options.n));
  }
  const MatrixXd points = standardised(values(Eigen::all, usable));
  Index first = 0;
  if (options.seed) {
    first = static_cast<Index>(RandomStream(*options.seed).uniform() * n_usable);
  } else {
    points.colwise().squaredNorm().minCoeff(&first);
  }
  FarthestPoints farthest = farthest_points(points, options.n, static_cast<int>(first), stop);

  Resample out{{}, std::move(farthest.distance), farthest.radius, std::move(features.names), log.n_rows() - n_usable};
  for (const int chosen : farthest.chosen) out.rows.push_back(usable[static_cast<std::size_t>(chosen)]);
  return out;
}

std::vector<std::string> resample_notes(const Resample& chosen, const CsvTable& log, const std::string& name) {
  std::vector<std::string> notes;
  if (chosen.n_skipped > 0) {
    notes.push_back(fmt::format("{}: {} skipped: a feature has no value", log.name(), counted(chosen.n_skipped, "row")));
  }
  notes.push_back(fmt::format("distances are in {}, each divided by its standard deviation", fmt::join(chosen.features, ", ")));
  notes.push_back(fmt::format("{}: {} of {} rows; every other row is within {:.3g} of one of them", name, chosen.rows.size(),
                              log.n_rows(), chosen.radius));
  const auto n_repeating = (chosen.distance.array() == 0).count() - 1;  // the first has none before it
  if (n_repeating > 0) {
    notes.push_back(
        fmt::format("the last {} rows repeat those before them in every feature: fewer cover the log as well", n_repeating));
  }
  return notes;
}

}  // namespace gp2
