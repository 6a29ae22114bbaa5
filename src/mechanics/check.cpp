#include "gp2/mechanics/check.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <numeric>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <Eigen/Cholesky>

#include "base/decompositions.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

using Level = Finding::Level;

// standard deviation of a row, or its magnitude where it does not vary; 0 where it is not measured
double spread(const Ref<const Eigen::RowVectorXd>& row) {
  if (row.hasNaN() || row.size() == 0) return 0;
  const double stddev = std::sqrt((row.array() - row.mean()).square().mean());
  const double magnitude = row.cwiseAbs().maxCoeff();
  return stddev > 1e-12 * magnitude ? stddev : magnitude;
}

// calls visit(subset) for every subset of `size` out of 0 … n − 1, in lexicographic order
template <typename Visit>
void for_each_subset(int n, int size, const Visit& visit) {
  std::vector<int> subset(static_cast<std::size_t>(size));
  std::iota(subset.begin(), subset.end(), 0);
  while (true) {
    visit(subset);
    int k = size - 1;
    while (k >= 0 && subset[static_cast<std::size_t>(k)] == n - size + k) --k;
    if (k < 0) return;
    ++subset[static_cast<std::size_t>(k)];
    for (int later = k + 1; later < size; ++later)
      subset[static_cast<std::size_t>(later)] = subset[static_cast<std::size_t>(later - 1)] + 1;
  }
}

double binomial(int n, int k) {
  double value = 1;
  for (int i = 0; i < k; ++i) value *= static_cast<double>(n - i) / (i + 1);
  return value;
}

// the smallest singular value of the given rows of T, in units of the spread, over the states
double worst_conditioning(const std::vector<MatrixXd>& scaled_T, const std::vector<int>& rows) {
  double worst = std::numeric_limits<double>::infinity();
  for (const MatrixXd& T : scaled_T) {
    const MatrixXd some = T(rows, Eigen::all);
    worst = std::min(worst, Eigen::JacobiSVD<MatrixXd>(some).singularValues().minCoeff());
  }
  return worst;
}

// `size` rows of ddq that determine the others at every state, as well-conditioned as can be found
std::vector<int> independent_rows(const std::vector<MatrixXd>& scaled_T, int size) {
  const int nq = static_cast<int>(scaled_T.front().rows());
  std::vector<int> best;
  double best_value = -1;
  constexpr double max_subsets = 2000;
  if (binomial(nq, size) <= max_subsets) {
    for_each_subset(nq, size, [&](const std::vector<int>& subset) {
      const double value = worst_conditioning(scaled_T, subset);
      if (value > best_value) {
        best_value = value;
        best = subset;
      }
    });
    return best;
  }
  // too many subsets: grow one, row by row
  while (static_cast<int>(best.size()) < size) {
    int next = -1;
    best_value = -1;
    for (int row = 0; row < nq; ++row) {
      if (std::find(best.begin(), best.end(), row) != best.end()) continue;
      std::vector<int> candidate = best;
      candidate.push_back(row);
      const double value = worst_conditioning(scaled_T, candidate);
      if (value > best_value) {
        best_value = value;
        next = row;
      }
    }
    best.push_back(next);
  }
  std::sort(best.begin(), best.end());
  return best;
}

// the states at which every acceleration is measured
std::vector<int> complete_states(const Ref<const MatrixXd>& accelerations) {
  std::vector<int> complete;
  for (Index i = 0; i < accelerations.cols(); ++i) {
    if (!accelerations.col(i).hasNaN()) complete.push_back(static_cast<int>(i));
  }
  return complete;
}

}  // namespace

std::optional<ConstraintViolation> largest_violation(const System& system, const Ref<const MatrixXd>& states,
                                                     const Ref<const VectorXd>& parameters) {
  const MatrixXd residuals = system.residuals(states, parameters);
  const SystemValues values = system.evaluate(states, parameters);
  const StateLayout layout = system.layout();
  std::optional<ConstraintViolation> worst;
  for (Index k = 0; k < residuals.rows(); ++k) {
    if (residuals.row(k).hasNaN()) continue;  // not measured
    const System::Residual& label = system.residual_labels()[static_cast<std::size_t>(k)];
    double scale = 0;
    for (int j = 0; j < system.nq(); ++j) {
      double weight = 0;
      for (int i = 0; i < values.n_states(); ++i) weight = std::max(weight, std::abs(values.A(i)(label.row, j)));
      scale += weight * spread(states.row(label.velocity ? layout.dq(j) : layout.q(j)));
    }
    Index state = 0;
    const double value = residuals.row(k).cwiseAbs().maxCoeff(&state);
    if (scale == 0) scale = 1;
    const double relative = value / scale;
    const double rms = residuals.row(k).norm() / std::sqrt(static_cast<double>(residuals.cols())) / scale;
    if (!worst || relative > worst->relative) worst = {relative, rms, value, static_cast<int>(state), label.text};
  }
  return worst;
}

namespace {

LowerRank lower_of(const std::vector<int>& ranks) {
  LowerRank lower;
  if (ranks.empty()) return lower;
  const auto [lowest, highest] = std::minmax_element(ranks.begin(), ranks.end());
  lower.lowest = *lowest;
  lower.usual = *highest;
  for (std::size_t i = 0; i < ranks.size(); ++i) {
    if (ranks[i] < lower.usual) lower.states.push_back(static_cast<int>(i));
  }
  return lower;
}

void append_ranks(const MechanicsBatch& mechanics, std::vector<int>& ranks) {
  for (const UdwadiaKalaba& projection : mechanics.projections) ranks.push_back(projection.rank());
}

}  // namespace

LowerRank states_of_lower_rank(const MechanicsBatch& mechanics) {
  std::vector<int> ranks;
  if (!mechanics.fault) append_ranks(mechanics, ranks);
  return lower_of(ranks);
}

LowerRank states_of_lower_rank(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters) {
  if (system.nc() == 0) return {};
  constexpr Index block = 256;
  std::vector<int> ranks;
  for (Index first = 0; first < states.cols(); first += block) {
    const Index n = std::min(block, states.cols() - first);
    const MechanicsBatch mechanics = evaluate_mechanics(system, states.middleCols(first, n), parameters);
    if (mechanics.fault) return {};
    append_ranks(mechanics, ranks);
  }
  return lower_of(ranks);
}

std::optional<std::vector<int>> dependent_columns(const System& system, const Ref<const MatrixXd>& states,
                                                  const Ref<const VectorXd>& parameters,
                                                  const Ref<const MatrixXd>& accelerations) {
  if (accelerations.hasNaN()) {
    const std::vector<int> complete = complete_states(accelerations);
    if (complete.empty()) return std::nullopt;
    return dependent_columns(system, states(Eigen::all, complete), parameters, accelerations(Eigen::all, complete));
  }
  const MechanicsBatch mechanics = evaluate_mechanics(system, states, parameters);
  if (mechanics.fault || system.nc() == 0) return std::nullopt;
  // a log with 7 digits or more of a computed quantity; measured accelerations are never that good
  constexpr double tolerance = 1e-6;
  int rank = 0;
  for (int i = 0; i < mechanics.values.n_states(); ++i) {
    const MatrixXd A = mechanics.values.A(i);
    const VectorXd b = mechanics.values.b(i);
    const VectorXd residual = A * accelerations.col(i) - b;
    const VectorXd size = A.cwiseAbs() * accelerations.col(i).cwiseAbs() + b.cwiseAbs();
    if (((residual.array().abs() > tolerance * size.array())).any()) return std::nullopt;
    rank = std::max(rank, mechanics.projections[static_cast<std::size_t>(i)].rank());
  }
  if (rank == 0) return std::nullopt;

  VectorXd scale(system.nq());
  for (Index j = 0; j < scale.size(); ++j) scale[j] = std::max(spread(accelerations.row(j)), 1e-300);
  std::vector<MatrixXd> scaled_T;
  constexpr int max_states = 50;
  const int stride = std::max(1, mechanics.values.n_states() / max_states);
  for (int i = 0; i < mechanics.values.n_states(); i += stride) {
    scaled_T.emplace_back(scale.cwiseInverse().asDiagonal() * mechanics.projections[static_cast<std::size_t>(i)].T() *
                          scale.asDiagonal());
  }
  return independent_rows(scaled_T, system.nq() - rank);
}

bool ConstraintResidual::is_too_large() const {
  if (n < 4) return false;
  if (std::isfinite(expected)) {
    // χ²/n of n normal values is 1 ± √(2/n)
    const double ratio = rms / expected;
    return ratio > 2 && ratio * ratio > 1 + 6 * std::sqrt(2.0 / n);
  }
  const double scatter = std::sqrt(std::max(0.0, rms * rms - mean * mean));
  const bool is_offset = std::abs(mean) > scatter && std::abs(mean) * std::sqrt(n) > 6 * scatter && std::abs(mean) > 0.05 * size;
  return is_offset || rms > 0.5 * size;
}

std::string ConstraintResidual::text() const {
  const bool is_known = std::isfinite(expected);
  if (!is_too_large()) {
    if (!is_known) {
      return fmt::format("measured ddq on A ddq = b: rms residual {:.3g} for '{}' (noise, if the model is right)", rms,
                         constraint);
    }
    return fmt::format("measured ddq on A ddq = b: rms residual {:.3g} for '{}', expected {:.3g} from the noise", rms, constraint,
                       expected);
  }
  std::vector<int> rows;
  for (const int state : worst) rows.push_back(state + 1);
  if (!is_known) {
    return fmt::format(
        "measured ddq on A ddq = b: rms residual {:.3g} for '{}', mean {:.3g}, is more than noise: a constraint, a "
        "unit, a sign or gravity in a sensor is wrong (farthest off: row {})",
        rms, constraint, mean, fmt::join(rows, ", "));
  }
  return fmt::format(
      "measured ddq on A ddq = b: rms residual {:.3g} for '{}', mean {:.3g}, expected {:.2g} from the noise: {:.2g} ×; "
      "a constraint, a unit, a sign or gravity in a sensor is wrong, or the noise is stated too small (farthest off: "
      "row {})",
      rms, constraint, mean, expected, rms / expected, fmt::join(rows, ", "));
}

std::vector<ConstraintResidual> constraint_residuals(const System& system, const Ref<const MatrixXd>& states,
                                                     const Ref<const VectorXd>& parameters,
                                                     const Ref<const MatrixXd>& accelerations,
                                                     const Ref<const MatrixXd>& stddev) {
  const SystemValues values = system.evaluate(states, parameters);
  std::vector<ConstraintResidual> all;
  for (int row = 0; row < system.nc(); ++row) {
    ConstraintResidual one;
    one.constraint = system.constraint_labels()[static_cast<std::size_t>(row)];
    std::vector<std::pair<double, int>> distances;
    for (int i = 0; i < values.n_states(); ++i) {
      double r = -values.b(i)[row], size = std::abs(r), variance = 0;
      for (int j = 0; j < system.nq(); ++j) {
        const double a = values.A(i)(row, j);
        if (a == 0) continue;
        r += a * accelerations(j, i);
        size += std::abs(a * accelerations(j, i));
        variance += a * a * stddev(j, i) * stddev(j, i);
      }
      // a row that vanishes says nothing of ddq
      if (!std::isfinite(r) || variance == 0) continue;
      variance += std::pow(system.constraint_noise()[row], 2);
      ++one.n;
      one.rms += r * r;
      one.mean += r;
      one.size += size * size;
      one.expected += variance;
      distances.emplace_back(std::isfinite(variance) ? std::abs(r) / std::sqrt(variance) : std::abs(r), i);
    }
    if (one.n == 0) continue;
    one.mean /= one.n;
    for (double* const square : {&one.rms, &one.size, &one.expected}) *square = std::sqrt(*square / one.n);
    const std::size_t n_worst = std::min<std::size_t>(3, distances.size());
    std::partial_sort(distances.begin(), distances.begin() + static_cast<std::ptrdiff_t>(n_worst), distances.end(),
                      std::greater<>());
    for (std::size_t k = 0; k < n_worst; ++k) one.worst.push_back(distances[k].second);
    all.push_back(std::move(one));
  }
  return all;
}

namespace {

VectorXd eigenvalues_of(const MatrixXd& M) {
  return Eigen::SelfAdjointEigenSolver<MatrixXd>(M, Eigen::EigenvaluesOnly).eigenvalues();
}

// of a semidefinite M, each coordinate in units of its diagonal entry
int rank_of_mass(const MatrixXd& M) {
  VectorXd unit = M.diagonal();
  for (double& entry : unit) entry = entry > 0 ? 1 / std::sqrt(entry) : 0;
  const VectorXd eigenvalues = eigenvalues_of(unit.asDiagonal() * M * unit.asDiagonal());
  return static_cast<int>((eigenvalues.array() > UdwadiaKalaba::mass_tolerance).count());
}

// rows that nearly follow from each other: accelerations are a difference of large numbers
void check_independence(const MechanicsBatch& mechanics, std::vector<Finding>& findings) {
  // half of the digits are left; a row with noise that was meant to follow from the others is worse
  constexpr double tolerance = 1e-7;
  double worst = 1;
  int state = 0, n_states = 0;
  for (int i = 0; i < mechanics.values.n_states(); ++i) {
    const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
    if (projection.rank() == 0) continue;
    // rows of A M^{-1/2}, of unit norm
    MatrixXd B = projection.mass().llt().matrixL().solve(mechanics.values.A(i).transpose());
    for (Index row = 0; row < B.cols(); ++row) B.col(row).stableNormalize();
    const VectorXd values = Eigen::JacobiSVD<MatrixXd>(B).singularValues();
    const double smallest = values[projection.rank() - 1] / values[0];
    n_states += smallest < tolerance ? 1 : 0;
    if (smallest >= worst) continue;
    worst = smallest;
    state = i;
  }
  if (n_states == 0) return;
  findings.push_back(
      {Level::warning, fmt::format("constraints: rows nearly follow from each other at {} of {} states (singular values down to "
                                   "{:.1e} of the largest, at state {}); leave out what is redundant, or write it so that it is "
                                   "so to rounding",
                                   n_states, mechanics.values.n_states(), worst, state + 1)});
}

// The part of F that stays when all velocities change their sign, less F at rest: Coriolis and centrifugal forces, quadratic in dq.
MatrixXd even_force(const System& system, MatrixXd states, const Ref<const VectorXd>& parameters) {
  const StateLayout layout = system.layout();
  auto velocities = states.middleRows(layout.dq(0), layout.nq);
  // where a log is at rest, or has no velocities since nothing reads them
  for (double& one : velocities.reshaped()) one = one == 0 || std::isnan(one) ? 1 : one;
  const MatrixXd moving = system.evaluate(states, parameters).force;
  velocities *= -1;
  const MatrixXd back = system.evaluate(states, parameters).force;
  velocities.setZero();
  const MatrixXd even = (moving + back) / 2 - system.evaluate(states, parameters).force;
  // but for rounding
  return (even.array().abs() > 1e-12 * (moving.array().abs() + back.array().abs())).select(even, 0);
}

// an M that changes with the motion comes with forces that are quadratic in the velocities
void check_coriolis(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                    const MatrixXd& M, std::vector<Finding>& findings) {
  const double change = (M.colwise() - M.col(0)).cwiseAbs().maxCoeff();
  if (!(change > 1e-9 * M.cwiseAbs().maxCoeff())) return;
  if (!even_force(system, states, parameters).isZero(0)) return;
  findings.push_back(
      {Level::warning,
       "mass matrix: it changes with the motion, but no part of the force is quadratic in the velocities: the Coriolis and "
       "centrifugal forces are missing; write coriolis = true in [mechanics]"});
}

// M is symmetric, and definite or completed by A
void check_mass(const System& system, const MechanicsBatch& mechanics, std::vector<Finding>& findings) {
  const int n_states = mechanics.values.n_states();
  double worst_condition = 0, asymmetry = 0;
  int n_singular = 0, mass_rank = system.nq();
  for (int i = 0; i < n_states; ++i) {
    const MatrixXd M = mechanics.values.M(i);
    const double largest = M.cwiseAbs().maxCoeff();
    if (largest > 0) asymmetry = std::max(asymmetry, (M - M.transpose()).cwiseAbs().maxCoeff() / largest);
    if (mechanics.projections[static_cast<std::size_t>(i)].mass_is_singular()) {
      ++n_singular;
      mass_rank = std::min(mass_rank, rank_of_mass(M));
    } else {
      const VectorXd eigenvalues = eigenvalues_of(M);
      worst_condition = std::max(worst_condition, eigenvalues.maxCoeff() / eigenvalues.minCoeff());
    }
  }
  findings.push_back(
      {asymmetry > 1e-10 ? Level::error : Level::good,
       fmt::format("mass matrix: positive definite at all {} states, condition number up to {:.3g}", n_states, worst_condition)});
  if (n_singular > 0) {
    findings.back().text = fmt::format(
        "mass matrix: singular at {} of {} states, rank {} of {}{}; the constraints determine the motion all the same, and the "
        "latents must act on forces: directions = \"force\"",
        n_singular, n_states, mass_rank, system.nq(),
        n_singular < n_states ? fmt::format("; elsewhere positive definite, condition number up to {:.3g}", worst_condition)
                              : "");
  }
  if (asymmetry > 1e-10) findings.back().text = fmt::format("mass matrix: not symmetric (relative difference {:.3g})", asymmetry);
}

// the rank of A is the same at all states, and leaves some freedom
void check_rank(const System& system, const MechanicsBatch& mechanics, std::vector<Finding>& findings) {
  const LowerRank lower = states_of_lower_rank(mechanics);
  const int highest = lower.usual;
  if (!lower.states.empty()) {
    findings.push_back(
        {Level::warning,
         fmt::format("constraints: the rank of A changes over the states, from {} to {} of {} rows; it is lower at {} of {} "
                     "states, first at state {}",
                     lower.lowest, highest, system.nc(), lower.states.size(), mechanics.values.n_states(),
                     lower.states.front() + 1)});
  } else if (highest < system.nc()) {
    findings.push_back({Level::good, fmt::format("constraints: rank {} of {} rows: {} redundant, which is allowed", highest,
                                                 system.nc(), system.nc() - highest)});
  } else {
    findings.push_back({Level::good, fmt::format("constraints: {} rows, independent at every state", system.nc())});
  }
  check_independence(mechanics, findings);
  if (highest >= system.nq()) {
    findings.push_back(
        {Level::warning, "constraints: they leave no freedom (rank = number of coordinates): nothing is left to learn"});
  }
}

// a row of A that nearly vanishes somewhere decides the direction of its force from rounding
void check_row_sizes(const System& system, const MechanicsBatch& mechanics, std::vector<Finding>& findings) {
  int zero_rows = 0;
  for (const UdwadiaKalaba& projection : mechanics.projections) zero_rows += projection.n_zero_rows();
  for (int row = 0; row < system.nc(); ++row) {
    std::vector<double> sizes;
    for (int i = 0; i < mechanics.values.n_states(); ++i) sizes.push_back(mechanics.values.A(i).row(row).norm());
    if (std::all_of(sizes.begin(), sizes.end(), [](double size) { return size == 0; })) {
      // a loop in a plane, closed in space
      zero_rows -= mechanics.values.n_states();
      findings.push_back({Level::good, fmt::format("constraint '{}': nothing moves along it, its row of A is zero at every state",
                                                   system.constraint_labels()[static_cast<std::size_t>(row)])});
      continue;
    }
    std::vector<double> sorted = sizes;
    std::nth_element(sorted.begin(), sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2), sorted.end());
    const double usual = sorted[sorted.size() / 2];
    const auto smallest = std::min_element(sizes.begin(), sizes.end());
    if (*smallest > 0 && *smallest < 1e-6 * usual) {
      findings.push_back(
          {Level::warning, fmt::format("constraint '{}': its row of A is {:.2g} of its usual size at state {}; write the "
                                       "constraint so that the row does not vanish",
                                       system.constraint_labels()[static_cast<std::size_t>(row)], *smallest / usual,
                                       smallest - sizes.begin() + 1)});
    }
  }
  if (zero_rows > 0) {
    findings.push_back(
        {Level::warning, fmt::format("constraints: a row of A vanishes {} times; it is dropped there", zero_rows)});
  }
}

// M, A, b: definite or completed by A, of constant rank, consistent
void check_mechanics(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                     const MechanicsBatch& mechanics, std::vector<Finding>& findings) {
  check_mass(system, mechanics, findings);
  check_coriolis(system, states, parameters, mechanics.values.mass, findings);
  if (system.nc() == 0) {
    findings.push_back({Level::warning, "constraints: none; T = I, and ddq is the unconstrained acceleration"});
    return;
  }
  check_rank(system, mechanics, findings);
  check_row_sizes(system, mechanics, findings);
}

// exact derivatives in the parameters against central differences
void check_parameter_derivatives(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                                 std::vector<Finding>& findings) {
  double worst = 0;
  std::string worst_name;
  for (int p = 0; p < static_cast<int>(system.parameters().size()); ++p) {
    // a step of ε^(1/3) balances truncation and rounding: about 1e-10 of the values is left
    const double step = 6e-6 * std::max(std::abs(parameters[p]), 1e-3);
    VectorXd above = parameters, below = parameters;
    above[p] += step;
    below[p] -= step;
    const SystemValues d = system.differentiate(states, parameters, p);
    const SystemValues high = system.evaluate(states, above);
    const SystemValues low = system.evaluate(states, below);
    const auto compare = [&](const MatrixXd& exact, const MatrixXd& up, const MatrixXd& down, const MatrixXd& value) {
      // an entry that is rounding beside the others is as good as zero
      const double rounding = 1e-6 * exact.lpNorm<Eigen::Infinity>();
      for (Index k = 0; k < exact.size(); ++k) {
        const double difference = (up.reshaped()[k] - down.reshaped()[k]) / (above[p] - below[p]);
        if (!std::isfinite(difference) || !std::isfinite(exact.reshaped()[k])) continue;
        const double size = std::abs(exact.reshaped()[k]) + rounding +
                            1e-4 * std::abs(value.reshaped()[k]) / std::max(std::abs(parameters[p]), 1e-3);
        const double error = std::abs(difference - exact.reshaped()[k]) / std::max(size, 1e-12);
        if (error > worst) {
          worst = error;
          worst_name = system.parameters()[static_cast<std::size_t>(p)].name;
        }
      }
    };
    const SystemValues value = system.evaluate(states, parameters);
    compare(d.mass, high.mass, low.mass, value.mass);
    compare(d.constraint_matrix, high.constraint_matrix, low.constraint_matrix, value.constraint_matrix);
    compare(d.constraint_vector, high.constraint_vector, low.constraint_vector, value.constraint_vector);
    compare(d.force, high.force, low.force, value.force);
  }
  if (system.parameters().empty()) return;
  findings.push_back({worst > 1e-4 ? Level::error : Level::good,
                      fmt::format("derivatives of M, A, b, F in the parameters: equal to central differences to {:.1e}{}", worst,
                                  worst_name.empty() ? "" : " (largest for '" + worst_name + "')")});
}

// A ddq − b against the second difference of each constraint along q(t + h) = q + h dq + ½h² ddq
void check_motion(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                  std::vector<Finding>& findings) {
  if (system.residual_labels().empty()) return;
  const StateLayout layout = system.layout();
  const SystemValues values = system.evaluate(states, parameters);
  // an arbitrary acceleration of the size of the velocities
  MatrixXd ddq =
      states.middleRows(layout.dq(0), layout.nq).unaryExpr([](double v) { return std::isnan(v) ? 0.0 : 0.7 * v + 0.3; });
  const double h = 1e-4;
  const auto moved = [&](double step) {
    MatrixXd x = states;
    for (int j = 0; j < layout.nq; ++j) {
      x.row(layout.q(j)) += step * states.row(layout.dq(j)) + 0.5 * step * step * ddq.row(j);
      x.row(layout.dq(j)) += step * ddq.row(j);
    }
    x.row(layout.t()).array() += step;
    return system.residuals(x, parameters);
  };
  const MatrixXd now = system.residuals(states, parameters);
  const MatrixXd difference = (moved(h) - moved(-h)) / (2 * h);
  double worst = 0;
  std::string worst_label;
  for (Index k = 0; k < now.rows(); ++k) {
    const System::Residual& label = system.residual_labels()[static_cast<std::size_t>(k)];
    // errors relative to the largest over the states: at one that rests there is nothing to be relative to
    double error = 0, size = 0;
    for (Index i = 0; i < now.cols(); ++i) {
      // d/dt of a velocity-level residual is A ddq − b; d/dt of a position-level one is the residual that follows it
      const auto A = values.A(static_cast<int>(i)).row(label.row);
      double expected = 0, size_here = 0;
      if (label.velocity) {
        const double b = values.b(static_cast<int>(i))[label.row];
        expected = A.dot(ddq.col(i)) - b;
        size_here = A.cwiseAbs().dot(ddq.col(i).cwiseAbs()) + std::abs(b);
      } else {
        expected = now(k + 1, i);
        size_here = std::abs(expected);
        for (int j = 0; j < layout.nq; ++j) {
          const double rate = A[j] * states(layout.dq(j), i);
          if (std::isfinite(rate)) size_here += std::abs(rate);
        }
      }
      const double error_here = std::abs(difference(k, i) - expected);
      if (!std::isfinite(error_here) || !std::isfinite(size_here)) continue;
      error = std::max(error, error_here);
      size = std::max(size, size_here);
    }
    if (error > worst * size && size > 0) {
      worst = error / size;
      worst_label = label.text;
    }
  }
  findings.push_back({worst > 1e-3 ? Level::warning : Level::good,
                      fmt::format("A and b: equal to differences of the constraints along a motion to {:.1e}{}", worst,
                                  worst > 1e-3 ? " (largest for '" + worst_label + "')" : "")});
}

}  // namespace

std::vector<Finding> check_system(const System& system, const Ref<const MatrixXd>& states,
                                  const Ref<const VectorXd>& parameters) {
  std::vector<Finding> findings;
  const MechanicsBatch mechanics = evaluate_mechanics(system, states, parameters);
  if (mechanics.fault) {
    findings.push_back({Level::error, fmt::format("{} at state {}", mechanics.fault->text, mechanics.fault->state + 1)});
    return findings;
  }
  check_mechanics(system, states, parameters, mechanics, findings);
  check_parameter_derivatives(system, states, parameters, findings);
  check_motion(system, states, parameters, findings);
  return findings;
}

std::vector<Finding> check_data(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                                const Ref<const MatrixXd>& accelerations, const Ref<const MatrixXd>& stddev,
                                const std::vector<int>& stated) {
  const bool estimates =
      std::any_of(system.parameters().begin(), system.parameters().end(), [](const auto& one) { return one.estimate; });
  std::vector<Finding> findings;
  if (const auto violation = largest_violation(system, states, parameters)) {
    const Level level = violation->rms > 0.3                                   ? Level::error
                        : violation->relative > constraint_violation_tolerance ? Level::warning
                                                                               : Level::good;
    findings.push_back({estimates ? std::min(level, Level::warning) : level,
                        fmt::format("data on the constraint: off by {:.2g} at most, {:.1e} of its scale ('{}', row {})",
                                    violation->value, violation->relative, violation->constraint, violation->state + 1)});
  }
  for (const ConstraintResidual& one : constraint_residuals(system, states, parameters, accelerations, stddev)) {
    // as large as what should cancel: nothing that is learned from such data is of this system
    const bool is_all = one.is_too_large() && one.rms > 0.3 * one.size && !estimates;
    const std::string of_file = one.is_too_large() && estimates ? "; here with the parameters as in the model file" : "";
    findings.push_back({is_all ? Level::error : one.is_too_large() ? Level::warning : Level::good, one.text() + of_file});
  }
  const std::vector<std::string> every = system.acceleration_names();
  const auto rows = dependent_columns(system, states, parameters, accelerations);
  if (rows && !stated.empty() && stated.size() <= rows->size()) {
    std::vector<std::string> names;
    for (int row : stated) names.push_back(every[static_cast<std::size_t>(row)]);
    findings.push_back(
        {Level::good, fmt::format("dependent columns: the {} accelerations obey A ddq = b to rounding; a fit observes "
                                  "{}, whose deviations the log gives",
                                  system.nq(), fmt::join(names, ", "))});
  } else if (rows) {
    std::vector<std::string> names;
    for (int row : *rows) names.push_back(every[static_cast<std::size_t>(row)]);
    findings.push_back(
        {Level::warning, fmt::format("dependent columns: the {} accelerations obey A ddq = b to rounding, so only {} of them are "
                                     "independent measurements: fit with `observe={}`",
                                     system.nq(), rows->size(), fmt::join(names, ","))});
  }
  return findings;
}

}  // namespace gp2
