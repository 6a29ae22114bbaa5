#include "gp2/mechanics/check.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <limits>
#include <mutex>
#include <numeric>
#include <tuple>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <Eigen/Cholesky>

#include "base/decompositions.hpp"
#include "base/parallel.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/symbolic_system.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

using Level = Finding::Level;

// work(first, states) for every block of states, so that a long log is looked at in the memory of a few rows. What a system has to
// say against a state it says again of all together, by the number of the state among them.
template <typename Work>
void in_blocks(const Ref<const MatrixXd>& states, int n_threads, const Work& work) {
  constexpr Index block_size = 256;
  const auto visit = [&](Index first, const Ref<const MatrixXd>& block) { work(first, block); };
  try {
    for_each_block(states.cols(), block_size, thread_count(n_threads),
                   [&](Index first, Index n, int) { visit(first, states.middleCols(first, n)); });
  } catch (const InputError&) {
    visit(0, states);
    throw;
  }
}

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
  struct OfResidual {
    double largest = -1, squares = 0;
    Index at = 0;
    bool is_measured = true;
    VectorXd weights;  // largest |A|
  };
  const std::vector<System::Residual>& labels = system.residual_labels();
  std::vector<OfResidual> all(labels.size());
  for (OfResidual& one : all) one.weights.setZero(system.nq());
  in_blocks(states, 1, [&](Index first, const Ref<const MatrixXd>& block) {
    const MatrixXd residuals = system.residuals(block, parameters);
    const SystemValues values = system.evaluate(block, parameters);
    for (std::size_t k = 0; k < labels.size(); ++k) {
      OfResidual& one = all[k];
      for (Index i = 0; i < block.cols(); ++i) {
        const double size = std::abs(residuals(static_cast<Index>(k), i));
        one.is_measured = one.is_measured && !std::isnan(size);
        one.squares += size * size;
        if (size > one.largest) one.largest = size, one.at = first + i;
        const auto A = values.A(static_cast<int>(i)).row(labels[k].row);
        for (Index j = 0; j < A.size(); ++j) one.weights[j] = std::max(one.weights[j], std::abs(A[j]));
      }
    }
  });
  const StateLayout layout = system.layout();
  VectorXd spreads = VectorXd::Constant(2 * layout.nq, -1);
  const auto spread_of = [&](int row) {
    if (spreads[row] < 0) spreads[row] = spread(states.row(row));
    return spreads[row];
  };
  std::optional<ConstraintViolation> worst;
  for (std::size_t k = 0; k < labels.size(); ++k) {
    const OfResidual& one = all[k];
    if (!one.is_measured) continue;
    double scale = 0;
    for (int j = 0; j < system.nq(); ++j) {
      scale += one.weights[j] * spread_of(labels[k].velocity ? layout.dq(j) : layout.q(j));
    }
    if (scale == 0) scale = 1;
    const double relative = one.largest / scale;
    const double rms = std::sqrt(one.squares) / std::sqrt(static_cast<double>(states.cols())) / scale;
    if (!worst || relative > worst->relative) worst = {relative, rms, one.largest, static_cast<int>(one.at), labels[k].text};
  }
  return worst;
}

std::vector<int> ranks_of(const System& system, const MechanicsBatch& mechanics) {
  std::vector<int> ranks;
  for (const UdwadiaKalaba& projection : mechanics.projections) {
    const auto i = static_cast<int>(ranks.size());
    int rank = projection.rank();
    for (int row = 0; row < system.nc(); ++row) {
      if (system.is_conditional(row) && mechanics.values.A(i).row(row).isZero(0)) ++rank;
    }
    ranks.push_back(rank);
  }
  return ranks;
}

LowerRank states_of_lower_rank(const std::vector<int>& ranks) {
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

LowerRank states_of_lower_rank(const MechanicsBatch& mechanics) {
  std::vector<int> ranks;
  if (mechanics.fault) return {};
  for (const UdwadiaKalaba& projection : mechanics.projections) ranks.push_back(projection.rank());
  return states_of_lower_rank(ranks);
}

LowerRank states_of_lower_rank(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters) {
  if (system.nc() == 0) return {};
  std::vector<int> ranks(static_cast<std::size_t>(states.cols()));
  const auto fault = for_each_mechanics(system, states, parameters, 1, [&](Index first, const MechanicsBatch& mechanics) {
    const std::vector<int> here = ranks_of(system, mechanics);
    std::copy(here.begin(), here.end(), ranks.begin() + first);
  });
  return fault ? LowerRank{} : states_of_lower_rank(ranks);
}

namespace {

// Whether A ddq = b holds to rounding wherever all accelerations are measured.
bool obey_to_rounding(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                      const Ref<const MatrixXd>& accelerations) {
  // a log with 7 digits or more of a computed quantity; measured accelerations are never that good
  constexpr double tolerance = 1e-6;
  bool obey = true;
  in_blocks(states, 1, [&](Index first, const Ref<const MatrixXd>& block) {
    if (!obey) return;
    const SystemValues values = system.evaluate(block, parameters);
    for (int i = 0; i < values.n_states(); ++i) {
      const auto ddq = accelerations.col(first + i);
      if (ddq.hasNaN()) continue;
      const VectorXd residual = values.A(i) * ddq - values.b(i);
      const VectorXd size = values.A(i).cwiseAbs() * ddq.cwiseAbs() + values.b(i).cwiseAbs();
      obey = obey && !((residual.array().abs() > tolerance * size.array())).any();
    }
  });
  return obey;
}

}  // namespace

std::optional<std::vector<int>> dependent_columns(const System& system, const Ref<const MatrixXd>& states,
                                                  const Ref<const VectorXd>& parameters,
                                                  const Ref<const MatrixXd>& accelerations) {
  if (system.nc() == 0 || !obey_to_rounding(system, states, parameters, accelerations)) return std::nullopt;
  if (accelerations.hasNaN()) {
    const std::vector<int> complete = complete_states(accelerations);
    if (complete.empty()) return std::nullopt;
    return dependent_columns(system, states(Eigen::all, complete), parameters, accelerations(Eigen::all, complete));
  }
  VectorXd scale(system.nq());
  for (Index j = 0; j < scale.size(); ++j) scale[j] = std::max(spread(accelerations.row(j)), 1e-300);
  int rank = 0, lowest_rank = system.nq();
  std::vector<MatrixXd> scaled_T;
  constexpr Index max_states = 50;
  const Index stride = std::max<Index>(1, states.cols() / max_states);
  const auto fault = for_each_mechanics(system, states, parameters, 1, [&](Index first, const MechanicsBatch& mechanics) {
    for (std::size_t i = 0; i < mechanics.projections.size(); ++i) {
      const UdwadiaKalaba& projection = mechanics.projections[i];
      rank = std::max(rank, projection.rank());
      lowest_rank = std::min(lowest_rank, projection.rank());
      if ((first + static_cast<Index>(i)) % stride != 0) continue;
      scaled_T.emplace_back(scale.cwiseInverse().asDiagonal() * projection.T() * scale.asDiagonal());
    }
  });
  if (fault || rank == 0) return std::nullopt;
  // where a constraint is not active all columns are measurements
  if (system.has_conditional_constraints() && lowest_rank < rank) return std::nullopt;
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
  constexpr std::size_t n_worst = 3;
  using Distances = std::vector<std::pair<double, int>>;  // of the worst states, the largest first
  std::vector<ConstraintResidual> all(static_cast<std::size_t>(system.nc()));
  std::vector<Distances> distances(all.size());
  in_blocks(states, 1, [&](Index first, const Ref<const MatrixXd>& block) {
    const SystemValues values = system.evaluate(block, parameters);
    for (int row = 0; row < system.nc(); ++row) {
      ConstraintResidual& one = all[static_cast<std::size_t>(row)];
      Distances& worst = distances[static_cast<std::size_t>(row)];
      for (int i = 0; i < values.n_states(); ++i) {
        const Index state = first + i;
        double r = -values.b(i)[row], size = std::abs(r), variance = 0;
        for (int j = 0; j < system.nq(); ++j) {
          const double a = values.A(i)(row, j);
          if (a == 0) continue;
          r += a * accelerations(j, state);
          size += std::abs(a * accelerations(j, state));
          variance += a * a * stddev(j, state) * stddev(j, state);
        }
        // a row that vanishes says nothing of ddq
        if (!std::isfinite(r) || variance == 0) continue;
        variance += std::pow(system.constraint_noise()[row], 2);
        ++one.n;
        one.rms += r * r;
        one.mean += r;
        one.size += size * size;
        one.expected += variance;
        const std::pair distance(std::isfinite(variance) ? std::abs(r) / std::sqrt(variance) : std::abs(r),
                                 static_cast<int>(state));
        if (worst.size() == n_worst && distance < worst.back()) continue;
        worst.insert(std::upper_bound(worst.begin(), worst.end(), distance, std::greater<>()), distance);
        worst.resize(std::min(worst.size(), n_worst));
      }
    }
  });
  for (std::size_t row = 0; row < all.size(); ++row) {
    ConstraintResidual& one = all[row];
    one.constraint = system.constraint_labels()[row];
    if (one.n == 0) continue;
    one.mean /= one.n;
    for (double* const square : {&one.rms, &one.size, &one.expected}) *square = std::sqrt(*square / one.n);
    for (const auto& [distance, state] : distances[row]) one.worst.push_back(state);
  }
  std::erase_if(all, [](const ConstraintResidual& one) { return one.n == 0; });
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

// What the mechanics of some states say.
struct MechanicsSummary {
  // M
  double asymmetry = 0, worst_condition = 0, largest_entry = 0;
  double largest_change = 0;  // from the first state
  int n_singular = 0, lowest_rank_of_mass = 0;
  // A
  double smallest_ratio = 1;  // of singular values
  int state_of_smallest = 0, n_nearly_dependent = 0;
  int n_zero_rows = 0;

  void add(const MechanicsSummary& other) {
    asymmetry = std::max(asymmetry, other.asymmetry);
    worst_condition = std::max(worst_condition, other.worst_condition);
    largest_entry = std::max(largest_entry, other.largest_entry);
    largest_change = std::max(largest_change, other.largest_change);
    n_singular += other.n_singular;
    lowest_rank_of_mass = std::min(lowest_rank_of_mass, other.lowest_rank_of_mass);
    const std::pair mine(smallest_ratio, state_of_smallest), its(other.smallest_ratio, other.state_of_smallest);
    std::tie(smallest_ratio, state_of_smallest) = std::min(mine, its);
    n_nearly_dependent += other.n_nearly_dependent;
    n_zero_rows += other.n_zero_rows;
  }
};

constexpr double dependence_tolerance = 1e-7;  // half of the digits are left; a row with noise that was meant to follow is worse

/// @param first       the number of the first state among all
/// @param first_mass  M at the first of all
MechanicsSummary summary_of(const MechanicsBatch& mechanics, Index first, const MatrixXd& first_mass) {
  MechanicsSummary out;
  out.lowest_rank_of_mass = static_cast<int>(first_mass.rows());
  for (int i = 0; i < mechanics.values.n_states(); ++i) {
    const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
    out.n_singular += projection.mass_is_singular() ? 1 : 0;
    out.n_zero_rows += projection.n_zero_rows();
    const auto M = mechanics.values.M(i);
    // most often M is that of the state before
    if (i == 0 || M != mechanics.values.M(i - 1)) {
      const double largest = M.cwiseAbs().maxCoeff();
      out.largest_entry = std::max(out.largest_entry, largest);
      out.largest_change = std::max(out.largest_change, (M - first_mass).cwiseAbs().maxCoeff());
      if (largest > 0) out.asymmetry = std::max(out.asymmetry, (M - M.transpose()).cwiseAbs().maxCoeff() / largest);
      if (projection.mass_is_singular()) {
        out.lowest_rank_of_mass = std::min(out.lowest_rank_of_mass, rank_of_mass(M));
      } else {
        const VectorXd eigenvalues = eigenvalues_of(M);
        out.worst_condition = std::max(out.worst_condition, eigenvalues.maxCoeff() / eigenvalues.minCoeff());
      }
    }
    if (projection.rank() < 2) continue;
    // rows of A M^{-1/2}, of unit norm
    MatrixXd B = projection.mass().llt().matrixL().solve(mechanics.values.A(i).transpose());
    for (Index row = 0; row < B.cols(); ++row) B.col(row).stableNormalize();
    const VectorXd values = Eigen::JacobiSVD<MatrixXd>(B).singularValues();
    const double ratio = values[projection.rank() - 1] / values[0];
    out.n_nearly_dependent += ratio < dependence_tolerance ? 1 : 0;
    if (ratio < out.smallest_ratio) out.smallest_ratio = ratio, out.state_of_smallest = static_cast<int>(first) + i;
  }
  return out;
}

// rows that nearly follow from each other: accelerations are a difference of large numbers
void report_independence(const MechanicsSummary& mechanics, Index n_states, std::vector<Finding>& findings) {
  if (mechanics.n_nearly_dependent == 0) return;
  findings.push_back(
      {Level::warning,
       fmt::format("constraints: rows nearly follow from each other at {} of {} states (singular values down to "
                   "{:.1e} of the largest, at state {}); leave out what is redundant, or write it so that it is "
                   "so to rounding",
                   mechanics.n_nearly_dependent, n_states, mechanics.smallest_ratio, mechanics.state_of_smallest + 1)});
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
                    const MechanicsSummary& mechanics, std::vector<Finding>& findings) {
  if (!(mechanics.largest_change > 1e-9 * mechanics.largest_entry)) return;
  bool is_zero = true;
  in_blocks(states, 1, [&](Index, const Ref<const MatrixXd>& block) {
    is_zero = is_zero && even_force(system, block, parameters).isZero(0);
  });
  if (!is_zero) return;
  findings.push_back(
      {Level::warning,
       "mass matrix: it changes with the motion, but no part of the force is quadratic in the velocities: the Coriolis and "
       "centrifugal forces are missing; write coriolis = true in [mechanics]"});
}

// M is symmetric, and definite or completed by A
void report_mass(const System& system, const MechanicsSummary& mechanics, Index n_states, std::vector<Finding>& findings) {
  findings.push_back({mechanics.asymmetry > 1e-10 ? Level::error : Level::good,
                      fmt::format("mass matrix: positive definite at all {} states, condition number up to {:.3g}", n_states,
                                  mechanics.worst_condition)});
  if (mechanics.n_singular > 0) {
    findings.back().text = fmt::format(
        "mass matrix: singular at {} of {} states, rank {} of {}{}; the constraints determine the motion all the same, and the "
        "latents must act on forces: directions = \"force\"",
        mechanics.n_singular, n_states, mechanics.lowest_rank_of_mass, system.nq(),
        mechanics.n_singular < n_states
            ? fmt::format("; elsewhere positive definite, condition number up to {:.3g}", mechanics.worst_condition)
            : "");
  }
  if (mechanics.asymmetry > 1e-10) {
    findings.back().text = fmt::format("mass matrix: not symmetric (relative difference {:.3g})", mechanics.asymmetry);
  }
}

// the rank of A is the same at all states, and leaves some freedom
void report_rank(const System& system, const std::vector<int>& ranks, const MechanicsSummary& mechanics,
                 std::vector<Finding>& findings) {
  const LowerRank lower = states_of_lower_rank(ranks);
  const int highest = lower.usual;
  if (!lower.states.empty()) {
    findings.push_back(
        {Level::warning,
         fmt::format("constraints: the rank of A changes over the states, from {} to {} of {} rows; it is lower at {} of {} "
                     "states, first at state {}",
                     lower.lowest, highest, system.nc(), lower.states.size(), ranks.size(), lower.states.front() + 1)});
  } else if (highest < system.nc()) {
    findings.push_back({Level::good, fmt::format("constraints: rank {} of {} rows: {} redundant, which is allowed", highest,
                                                 system.nc(), system.nc() - highest)});
  } else {
    findings.push_back({Level::good, fmt::format("constraints: {} rows, independent at every state{}", system.nc(),
                                                 system.has_conditional_constraints() ? " where they are active" : "")});
  }
  report_independence(mechanics, std::ssize(ranks), findings);
  if (highest >= system.nq()) {
    findings.push_back(
        {Level::warning, "constraints: they leave no freedom (rank = number of coordinates): nothing is left to learn"});
  }
}

// Where the rows that come and go are there.
void report_conditions(const System& system, const MatrixXd& sizes, std::vector<Finding>& findings) {
  for (int row = 0; row < system.nc(); ++row) {
    if (!system.is_conditional(row)) continue;
    const Index n_active = (sizes.row(row).array() > 0).count();
    const std::string what =
        fmt::format("constraint '{}': active, {}, at {} of {} states", system.constraint_labels()[static_cast<std::size_t>(row)],
                    system.constraint_conditions()[static_cast<std::size_t>(row)], n_active, sizes.cols());
    if (n_active == 0) {
      findings.push_back({Level::warning, what + ": these states say nothing of it; look at the condition and its sign"});
    } else {
      findings.push_back({Level::good, what});
    }
  }
}

// a row of A that nearly vanishes somewhere decides the direction of its force from rounding
/// @param sizes  norms of the rows of A (nc × N)
void report_row_sizes(const System& system, const MatrixXd& sizes, int n_zero_rows, std::vector<Finding>& findings) {
  for (int row = 0; row < system.nc(); ++row) {
    const std::string& label = system.constraint_labels()[static_cast<std::size_t>(row)];
    if (system.is_conditional(row)) {
      n_zero_rows -= static_cast<int>((sizes.row(row).array() == 0).count());
      continue;
    }
    if (sizes.row(row).isZero(0)) {
      // a loop in a plane, closed in space
      n_zero_rows -= static_cast<int>(sizes.cols());
      findings.push_back(
          {Level::good, fmt::format("constraint '{}': nothing moves along it, its row of A is zero at every state", label)});
      continue;
    }
    std::vector<double> sorted(sizes.row(row).begin(), sizes.row(row).end());
    std::nth_element(sorted.begin(), sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2), sorted.end());
    const double usual = sorted[sorted.size() / 2];
    Index at = 0;
    const double smallest = sizes.row(row).minCoeff(&at);
    if (smallest > 0 && smallest < 1e-6 * usual) {
      findings.push_back(
          {Level::warning, fmt::format("constraint '{}': its row of A is {:.2g} of its usual size at state {}; write the "
                                       "constraint so that the row does not vanish",
                                       label, smallest / usual, at + 1)});
    }
  }
  if (n_zero_rows > 0) {
    findings.push_back(
        {Level::warning, fmt::format("constraints: a row of A vanishes {} times; it is dropped there", n_zero_rows)});
  }
}

// M, A, b: definite or completed by A, of constant rank, consistent. False where numbers are unusable.
bool check_mechanics(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                     int n_threads, std::vector<Finding>& findings) {
  const MatrixXd first_mass = system.evaluate(states.leftCols(1), parameters).M(0);
  MechanicsSummary mechanics;
  mechanics.lowest_rank_of_mass = system.nq();
  std::vector<int> ranks(static_cast<std::size_t>(states.cols()));
  MatrixXd sizes(system.nc(), states.cols());
  std::mutex mutex;
  const auto fault = for_each_mechanics(system, states, parameters, n_threads, [&](Index first, const MechanicsBatch& block) {
    const std::vector<int> ranks_here = ranks_of(system, block);
    std::copy(ranks_here.begin(), ranks_here.end(), ranks.begin() + first);
    for (int i = 0; i < block.values.n_states(); ++i) {
      sizes.col(first + i) = block.values.A(i).rowwise().norm();
    }
    const MechanicsSummary summary = summary_of(block, first, first_mass);
    const std::scoped_lock lock(mutex);
    mechanics.add(summary);
  });
  if (fault) {
    findings.push_back({Level::error, fmt::format("{} at state {}", fault->text, fault->state + 1)});
    return false;
  }
  report_mass(system, mechanics, states.cols(), findings);
  check_coriolis(system, states, parameters, mechanics, findings);
  if (system.nc() == 0) {
    findings.push_back({Level::warning, "constraints: none; T = I, and ddq is the unconstrained acceleration"});
    return true;
  }
  report_rank(system, ranks, mechanics, findings);
  report_conditions(system, sizes, findings);
  report_row_sizes(system, sizes, mechanics.n_zero_rows, findings);
  return true;
}

// exact derivatives in the parameters against central differences
void check_parameter_derivatives(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                                 int n_threads, std::vector<Finding>& findings) {
  if (system.parameters().empty()) return;
  const int n_parameters = static_cast<int>(system.parameters().size());
  const auto parts_of = [](const SystemValues& values) {
    return std::array{&values.mass, &values.constraint_matrix, &values.constraint_vector, &values.force};
  };
  std::mutex mutex;
  MatrixXd largest = MatrixXd::Zero(4, n_parameters);  // derivatives of each part
  in_blocks(states, n_threads, [&](Index, const Ref<const MatrixXd>& block) {
    MatrixXd here(4, n_parameters);
    for (int p = 0; p < n_parameters; ++p) {
      const SystemValues d = system.differentiate(block, parameters, p);
      for (std::size_t part = 0; part < 4; ++part)
        here(static_cast<Index>(part), p) = parts_of(d)[part]->lpNorm<Eigen::Infinity>();
    }
    const std::scoped_lock lock(mutex);
    largest = largest.cwiseMax(here);
  });
  VectorXd errors = VectorXd::Zero(n_parameters);
  in_blocks(states, n_threads, [&](Index, const Ref<const MatrixXd>& block) {
    const SystemValues value = system.evaluate(block, parameters);
    VectorXd here = VectorXd::Zero(n_parameters);
    for (int p = 0; p < n_parameters; ++p) {
      const double parameter = std::max(std::abs(parameters[p]), 1e-3);
      // a step of ε^(1/3) balances truncation and rounding: about 1e-10 of the values is left
      const double step = 6e-6 * parameter;
      VectorXd above = parameters, below = parameters;
      above[p] += step;
      below[p] -= step;
      const SystemValues d = system.differentiate(block, parameters, p);
      const SystemValues high = system.evaluate(block, above), low = system.evaluate(block, below);
      for (std::size_t part = 0; part < 4; ++part) {
        const auto entries = [&](const SystemValues& of) { return parts_of(of)[part]->reshaped(); };
        // an entry that is rounding beside the others is as good as zero
        const double rounding = 1e-6 * largest(static_cast<Index>(part), p);
        for (Index k = 0; k < entries(d).size(); ++k) {
          const double exact = entries(d)[k], difference = (entries(high)[k] - entries(low)[k]) / (above[p] - below[p]);
          if (!std::isfinite(difference) || !std::isfinite(exact)) continue;
          const double size = std::abs(exact) + rounding + 1e-4 * std::abs(entries(value)[k]) / parameter;
          here[p] = std::max(here[p], std::abs(difference - exact) / std::max(size, 1e-12));
        }
      }
    }
    const std::scoped_lock lock(mutex);
    errors = errors.cwiseMax(here);
  });
  Index at = 0;
  const double worst = errors.maxCoeff(&at);
  findings.push_back(
      {worst > 1e-4 ? Level::error : Level::good,
       fmt::format("derivatives of M, A, b, F in the parameters: equal to central differences to {:.1e}{}", worst,
                   worst > 0 ? " (largest for '" + system.parameters()[static_cast<std::size_t>(at)].name + "')" : "")});
}

// A ddq − b against the second difference of each constraint along q(t + h) = q + h dq + ½h² ddq
void check_motion(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters, int n_threads,
                  std::vector<Finding>& findings) {
  const auto n_residuals = std::ssize(system.residual_labels());
  if (n_residuals == 0) return;
  const StateLayout layout = system.layout();
  // errors relative to the largest over the states: at one that rests there is nothing to be relative to
  Eigen::ArrayXd error = Eigen::ArrayXd::Zero(n_residuals), size = error;
  std::mutex mutex;
  in_blocks(states, n_threads, [&](Index, const Ref<const MatrixXd>& block) {
    const SystemValues values = system.evaluate(block, parameters);
    // an arbitrary acceleration of the size of the velocities
    const MatrixXd ddq =
        block.middleRows(layout.dq(0), layout.nq).unaryExpr([](double v) { return std::isnan(v) ? 0.0 : 0.7 * v + 0.3; });
    const double h = 1e-4;
    const auto moved_by = [&](double step) {
      MatrixXd x = block;
      for (int j = 0; j < layout.nq; ++j) {
        x.row(layout.q(j)) += step * block.row(layout.dq(j)) + 0.5 * step * step * ddq.row(j);
        x.row(layout.dq(j)) += step * ddq.row(j);
      }
      x.row(layout.t()).array() += step;
      return x;
    };
    const MatrixXd after = moved_by(h), before = moved_by(-h);
    const MatrixXd now = system.residuals(block, parameters);
    const MatrixXd difference = (system.residuals(after, parameters) - system.residuals(before, parameters)) / (2 * h);
    // a row that comes or goes on the way has no difference
    const auto switches = [&, values_after = system.has_conditional_constraints() ? system.evaluate(after, parameters) : values,
                           values_before = system.has_conditional_constraints() ? system.evaluate(before, parameters) : values](
                              int row, int i) {
      const bool is_there = !values.A(i).row(row).isZero(0);
      return !values_after.A(i).row(row).isZero(0) != is_there || !values_before.A(i).row(row).isZero(0) != is_there;
    };
    Eigen::ArrayXd error_in_block = Eigen::ArrayXd::Zero(n_residuals), size_in_block = error_in_block;
    for (Index k = 0; k < n_residuals; ++k) {
      const System::Residual& label = system.residual_labels()[static_cast<std::size_t>(k)];
      for (Index i = 0; i < now.cols(); ++i) {
        if (system.is_conditional(label.row) && switches(label.row, static_cast<int>(i))) continue;
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
            const double rate = A[j] * block(layout.dq(j), i);
            if (std::isfinite(rate)) size_here += std::abs(rate);
          }
        }
        const double error_here = std::abs(difference(k, i) - expected);
        if (!std::isfinite(error_here) || !std::isfinite(size_here)) continue;
        error_in_block[k] = std::max(error_in_block[k], error_here);
        size_in_block[k] = std::max(size_in_block[k], size_here);
      }
    }
    const std::scoped_lock lock(mutex);
    error = error.max(error_in_block);
    size = size.max(size_in_block);
  });
  double worst = 0;
  std::string worst_label;
  for (Index k = 0; k < n_residuals; ++k) {
    if (!(error[k] > worst * size[k] && size[k] > 0)) continue;
    worst = error[k] / size[k];
    worst_label = system.residual_labels()[static_cast<std::size_t>(k)].text;
  }
  findings.push_back({worst > 1e-3 ? Level::warning : Level::good,
                      fmt::format("A and b: equal to differences of the constraints along a motion to {:.1e}{}", worst,
                                  worst > 1e-3 ? " (largest for '" + worst_label + "')" : "")});
}

// A contact only pushes, and its gap is positive where it is open.
void check_contacts(const SymbolicSystem& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                    const Ref<const MatrixXd>& accelerations, std::vector<Finding>& findings) {
  for (int row = 0; row < system.nc(); ++row) {
    const ConstraintRow& constraint = system.definition().constraints[static_cast<std::size_t>(row)];
    if (!constraint.contact) continue;
    const int touch = system.layout().u(constraint.contact->input);
    const auto& labels = system.residual_labels();
    const auto gap = std::find_if(labels.begin(), labels.end(), [&](const auto& one) { return one.row == row; });
    int n_closed = 0, n_pulling = 0, n_open = 0, n_beyond = 0;
    const auto fault = for_each_mechanics(system, states, parameters, 1, [&](Index first, const MechanicsBatch& block) {
      MatrixXd all_closed = states.middleCols(first, block.values.n_states());
      all_closed.row(touch).setOnes();
      const auto gaps = system.residuals(all_closed, parameters).row(gap - labels.begin()).eval();
      for (int i = 0; i < block.values.n_states(); ++i) {
        if (block.values.A(i).row(row).isZero(0)) {
          ++n_open;
          n_beyond += gaps[i] < 0 ? 1 : 0;
          continue;
        }
        const VectorXd force = block.values.M(i) * accelerations.col(first + i) - block.values.F(i);
        const double lambda = block.projections[static_cast<std::size_t>(i)].multipliers_of_force().row(row).dot(force);
        if (!std::isfinite(lambda)) continue;
        ++n_closed;
        n_pulling += lambda < 0 ? 1 : 0;
      }
    });
    if (fault) return;
    const bool pulls = 2 * n_pulling > n_closed, is_beyond = 2 * n_beyond > n_open;
    findings.push_back(
        {pulls || is_beyond ? Level::warning : Level::good,
         fmt::format(
             "contact '{}': under the measured ddq and the known force it pulls at {} of {} states where it is closed, and its "
             "gap is negative at {} of {} where it is open{}",
             constraint.text, n_pulling, n_closed, n_beyond, n_open,
             is_beyond ? "; a gap is not negative: change its sign, or the input that says where it is closed"
             : pulls   ? "; a contact only pushes: change the sign of the gap, or give the force that presses it"
                       : "")});
  }
}

}  // namespace

std::vector<Finding> check_system(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                                  int n_threads) {
  std::vector<Finding> findings;
  if (!check_mechanics(system, states, parameters, n_threads, findings)) return findings;
  check_parameter_derivatives(system, states, parameters, n_threads, findings);
  check_motion(system, states, parameters, n_threads, findings);
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
  if (const auto* symbolic = dynamic_cast<const SymbolicSystem*>(&system)) {
    check_contacts(*symbolic, states, parameters, accelerations, findings);
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
