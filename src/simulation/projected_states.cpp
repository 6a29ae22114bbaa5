#include "gp2/simulation/projected_states.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/shape.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "simulation/projection.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// What stands for deviations that are not stated (2 nq): the spread of each entry, in proportion to those that are. An entry that
// never changes is taken as the steadiest of its level that does.
VectorXd usual_deviations(const Ref<const MatrixXd>& states, const MatrixXd& stddevs) {
  const Index nq = states.rows() / 2;
  VectorXd spreads = row_stddev(states);
  spreads = spreads.array().isFinite().select(spreads, 0);
  for (const Index first : {Index{0}, nq}) {
    const auto level = spreads.segment(first, nq);
    const double least = (level.array() > 0).select(level, std::numeric_limits<double>::infinity()).minCoeff();
    for (Index k = first; k < first + nq; ++k) {
      if (spreads[k] == 0) spreads[k] = std::isfinite(least) ? least : 1;
    }
  }
  std::vector<double> ratios;
  for (Index k = 0; k < stddevs.rows(); ++k) {
    for (const double stddev : stddevs.row(k)) {
      if (!std::isnan(stddev)) ratios.push_back(stddev / spreads[k]);
    }
  }
  return ratios.empty() ? spreads : VectorXd(median(ratios) * spreads);
}

// The median size of a residual, which is exactly 0 where its row is switched off.
double median_where_active(const System& system, int row, const Ref<const Eigen::RowVectorXd>& residuals) {
  std::vector<double> sizes;
  for (const double residual : residuals) {
    if (!system.is_conditional(row) || residual != 0) sizes.push_back(std::abs(residual));
  }
  return sizes.empty() ? 0 : median(std::move(sizes));
}

}  // namespace

ProjectedStates project_states(const System& system, const Ref<const VectorXd>& parameters, const Ref<const MatrixXd>& states,
                               const MatrixXd& stddevs) {
  const Index n_moving = 2 * static_cast<Index>(system.nq());
  system.require_states(states);
  if (stddevs.size() > 0) require_shape("project_states: stddevs", stddevs, n_moving, states.cols());
  ProjectedStates out{states, MatrixXd::Zero(n_moving, states.cols()), {}};
  const MatrixXd residuals = system.residuals(states, parameters);
  const auto label = [&](Index k) { return system.residual_labels()[static_cast<std::size_t>(k)].text; };
  const bool lacks_columns = states.topRows(n_moving).array().isNaN().rowwise().all().any();
  for (Index k = 0; lacks_columns && k < residuals.rows(); ++k) {
    if (!residuals.row(k).array().isNaN().all()) continue;
    throw InputError(
        fmt::format("system '{}': the states lack a coordinate or velocity that the constraint \"{}\" reads, and "
                    "cannot be projected onto it",
                    system.name(), label(k)));
  }
  ConstraintProjection projection(system, parameters);
  const VectorXd usual = usual_deviations(states.topRows(n_moving), stddevs);
  VectorXd state;
  for (Index i = 0; i < states.cols(); ++i) {
    if (residuals.col(i).hasNaN()) {
      Index k = 0;
      while (!std::isnan(residuals(k, i))) ++k;
      out.failures.push_back({static_cast<int>(i), fmt::format("the constraint \"{}\" is not a number there", label(k))});
      continue;
    }
    // what is not measured is read by nothing, but must not turn up in products with zero
    state = states.col(i).array().isNaN().select(0, states.col(i));
    projection.weigh_by(stddevs.size() == 0 ? usual : VectorXd(stddevs.col(i).array().isNaN().select(usual, stddevs.col(i))));
    try {
      projection.apply(state);
    } catch (const Error& error) {
      out.failures.push_back({static_cast<int>(i), error.what()});
      continue;
    }
    out.states.col(i) = states.col(i).array().isNaN().select(states.col(i), state);
    out.shift.col(i) = (out.states.col(i) - states.col(i)).head(n_moving).cwiseAbs();
  }
  out.shift = out.shift.array().isNaN().select(0, out.shift);
  return out;
}

SizeSummary summarise_sizes(const Ref<const VectorXd>& sizes) {
  if (sizes.size() == 0) return {};
  SizeSummary summary;
  Index at = 0;
  summary.largest = sizes.maxCoeff(&at);
  summary.at = static_cast<int>(at);
  summary.mean = sizes.mean();
  summary.median = median({sizes.begin(), sizes.end()});
  return summary;
}

std::vector<Finding> check_states(const System& system, const Ref<const MatrixXd>& states,
                                  const Ref<const VectorXd>& parameters) {
  const std::vector<ConstraintViolation> violations = constraint_violations(system, states, parameters);
  if (std::ranges::none_of(violations, [](const auto& one) { return one.relative > constraint_violation_tolerance; })) return {};
  const MatrixXd residuals = system.residuals(states, parameters);
  if (residuals.hasNaN()) return {};
  using Level = Finding::Level;
  std::vector<Finding> findings;
  for (Index k = 0; k < residuals.rows(); ++k) {
    const System::Residual& label = system.residual_labels()[static_cast<std::size_t>(k)];
    const ConstraintViolation& violation = violations[static_cast<std::size_t>(k)];
    findings.push_back(
        {violation.relative > large_constraint_violation ? Level::warning : Level::good,
         fmt::format("off the {} constraint '{}' by {:.2g} in the median, {:.2g} at most (row {})",
                     label.velocity ? "velocity" : "position", label.text,
                     median_where_active(system, label.row, residuals.row(k)), violation.value, violation.state + 1)});
  }
  const ProjectedStates projected = project_states(system, parameters, states);
  const std::vector<std::string> names = system.state_names();
  std::vector<std::string> shifts;
  for (Index k = 0; k < projected.shift.rows(); ++k) {
    const SizeSummary size = summarise_sizes(projected.shift.row(k));
    if (size.largest == 0) continue;
    shifts.push_back(fmt::format("{} by {:.2g} in the median, {:.2g} at most (row {})", names[static_cast<std::size_t>(k)],
                                 size.median, size.largest, size.at + 1));
  }
  if (!shifts.empty()) {
    findings.push_back(
        {Level::good, fmt::format("the nearest states on the constraints, to which fit `project` moves, differ in {}",
                                  fmt::join(shifts, ", "))});
  }
  if (!projected.failures.empty()) {
    std::vector<std::string> rows;
    for (const ProjectedStates::Failure& failure : projected.failures) {
      if (rows.size() < 12) rows.push_back(std::to_string(failure.state + 1));
    }
    if (rows.size() < projected.failures.size()) rows.emplace_back("…");
    findings.push_back(
        {Level::warning, fmt::format("{} states have no state on the constraints near them: rows {}; fit `project` "
                                     "refuses them",
                                     projected.failures.size(), fmt::join(rows, ", "))});
  }
  return findings;
}

}  // namespace gp2
