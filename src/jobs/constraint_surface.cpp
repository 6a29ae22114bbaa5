#include "gp2/jobs/report_job.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "base/not_a_number.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

// of the only position constraint, where it does not move with time; none: the constraints are no surface
std::optional<int> surface_row(const SymbolicSystem& system) {
  int row = -1;
  const std::vector<ConstraintRow>& constraints = system.definition().constraints;
  for (std::size_t k = 0; k < constraints.size(); ++k) {
    if (constraints[k].level != ConstraintRow::Level::position) continue;
    if (row >= 0) return std::nullopt;  // a curve or a point
    row = static_cast<int>(k);
  }
  if (row < 0) return std::nullopt;
  const Expression c = constraints[static_cast<std::size_t>(row)].residuals.front();
  const std::vector<std::string> read = c.graph().variables_of(c);
  if (std::find(read.begin(), read.end(), "t") != read.end()) return std::nullopt;
  return row;
}

// the coordinate in which c is never flat over the data: A's row is ∂c/∂q
int steepest_coordinate(const SystemValues& values, int row) {
  Eigen::Vector3d steepness = Eigen::Vector3d::Constant(std::numeric_limits<double>::infinity());
  for (int i = 0; i < values.n_states(); ++i) {
    const Eigen::Vector3d slope = values.A(i).row(row).cwiseAbs().transpose();
    steepness = steepness.cwiseMin(slope / std::max(slope.maxCoeff(), std::numeric_limits<double>::min()));
  }
  int steepest = 0;
  steepness.maxCoeff(&steepest);
  return steepest;
}

// n values from below the data to above
VectorXd range_of(const Ref<const MatrixXd>& states, int coordinate, double margin, Index n) {
  const double low = states.row(coordinate).minCoeff(), high = states.row(coordinate).maxCoeff();
  const double pad = margin * std::max(high - low, 1e-9 * std::abs(high) + 1e-300);
  return VectorXd::LinSpaced(n, low - pad, high + pad);
}

// states at each point of the grid, one after another along `scan`
MatrixXd probe_states(const ConstraintSurface& surface, const VectorXd& scan, Index n_entries) {
  MatrixXd probes = MatrixXd::Zero(n_entries, surface.first_grid.size() * surface.second_grid.size() * scan.size());
  Index column = 0;
  for (const double first : surface.first_grid) {
    for (const double second : surface.second_grid) {
      for (const double solved : scan) {
        probes(surface.first, column) = first;
        probes(surface.second, column) = second;
        probes(surface.solved, column++) = solved;
      }
    }
  }
  return probes;
}

// every change of sign is a point of the surface; the straight line between its ends is exact where c is linear in the
// coordinate
void add_sheets(const Eigen::RowVectorXd& residual, const VectorXd& scan, ConstraintSurface& surface) {
  const Index n_first = surface.first_grid.size(), n_second = surface.second_grid.size(), n_scan = scan.size();
  for (Index i = 0; i < n_first; ++i) {
    for (Index j = 0; j < n_second; ++j) {
      std::size_t sheet = 0;
      const Index first = (i * n_second + j) * n_scan;
      for (Index s = 0; s + 1 < n_scan; ++s) {
        const double here = residual[first + s], next = residual[first + s + 1];
        if (!(here * next < 0 || here == 0)) continue;
        if (sheet == surface.sheets.size()) surface.sheets.emplace_back(MatrixXd::Constant(n_first, n_second, not_a_number));
        surface.sheets[sheet++](i, j) = here == 0 ? scan[s] : scan[s] + (scan[s + 1] - scan[s]) * here / (here - next);
      }
    }
  }
}

}  // namespace

std::optional<ConstraintSurface> constraint_surface(const SymbolicSystem& system, const Ref<const VectorXd>& parameters,
                                                    const Ref<const MatrixXd>& states) {
  if (system.nq() != 3 || states.cols() < 2 || states.topRows(3).hasNaN()) return std::nullopt;
  const std::optional<int> row = surface_row(system);
  if (!row) return std::nullopt;
  const std::vector<System::Residual>& labels = system.residual_labels();
  const auto label =
      std::find_if(labels.begin(), labels.end(), [&](const auto& one) { return one.row == *row && !one.velocity; });

  ConstraintSurface surface;
  surface.solved = steepest_coordinate(system.evaluate(states, parameters), *row);
  surface.first = surface.solved == 0 ? 1 : 0;
  surface.second = surface.solved == 2 ? 1 : 2;

  constexpr Index n_grid = 25, n_scan = 41;
  surface.first_grid = range_of(states, surface.first, 0.08, n_grid);
  surface.second_grid = range_of(states, surface.second, 0.08, n_grid);
  const VectorXd scan = range_of(states, surface.solved, 0.6, n_scan);
  const MatrixXd probes = probe_states(surface, scan, system.layout().size());
  const Eigen::RowVectorXd residual = system.residuals(probes, parameters).row(label - labels.begin());
  add_sheets(residual, scan, surface);
  if (surface.sheets.empty()) return std::nullopt;
  return surface;
}

}  // namespace gp2
