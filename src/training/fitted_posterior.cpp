#include <fmt/format.h>

#include "gp2/error.hpp"
#include "gp2/fit.hpp"

// What a fit stands for, without the optimiser.
namespace gp2 {

using Eigen::Index;

std::vector<ModelValues> values_of(const Prior& prior, const std::vector<Observations>& observations, const FitReport& report) {
  const auto values_at = [&](const std::vector<Hyperparameter>& hyperparameters) {
    ModelValues values = model_values(prior, observations, hyperparameters);
    if (report.inducing) values.inducing = report.inducing->points;
    return values;
  };
  if (!report.draws) return {values_at(report.hyperparameters)};
  if (report.draws->values.rows() != std::ssize(report.hyperparameters) || report.draws->size() == 0) {
    throw InputError(fmt::format("the draws of a fit must hold one number for each of its {} hyperparameters, got {} × {}",
                                 report.hyperparameters.size(), report.draws->values.rows(), report.draws->size()));
  }
  std::vector<ModelValues> values;
  std::vector<Hyperparameter> drawn = report.hyperparameters;
  for (const auto& draw : report.draws->values.colwise()) {
    for (std::size_t h = 0; h < drawn.size(); ++h) drawn[h].value = draw[static_cast<Index>(h)];
    values.push_back(values_at(drawn));
  }
  return values;
}

Posterior posterior_of(const Prior& prior, const std::vector<Observations>& observations, const FitReport& report,
                       const Workers& workers) {
  const std::vector<ModelValues> values = values_of(prior, observations, report);
  if (report.inducing && report.inducing->summary) {
    return Posterior::of_summary(prior, observations, values, *report.inducing->summary);
  }
  return Posterior::mixture(prior, observations, values, workers);
}

}  // namespace gp2
