#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <numeric>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/decompositions.hpp"
#include "base/not_a_number.hpp"
#include "base/shape.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/mechanics/symbolic_system.hpp"
#include "mechanics/in_blocks.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Level = Finding::Level;

namespace {

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

// the smallest singular value of the given rows of bases of the accelerations that are free, in units of the spread, over the states
double worst_conditioning(const std::vector<MatrixXd>& free, const std::vector<int>& rows) {
  double worst = std::numeric_limits<double>::infinity();
  for (const MatrixXd& basis : free) {
    const MatrixXd some = basis(rows, Eigen::all);
    worst = std::min(worst, Eigen::JacobiSVD<MatrixXd>(some).singularValues().minCoeff());
  }
  return worst;
}

// `size` rows of ddq that determine the others at every state, as well-conditioned as can be found
std::vector<int> independent_rows(const std::vector<MatrixXd>& free, int size) {
  const int nq = static_cast<int>(free.front().rows());
  std::vector<int> best;
  double best_value = -1;
  constexpr double max_subsets = 2000;
  if (binomial(nq, size) <= max_subsets) {
    for_each_subset(nq, size, [&](const std::vector<int>& subset) {
      const double value = worst_conditioning(free, subset);
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
      const double value = worst_conditioning(free, candidate);
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

// The combinations c of the rows of A ddq = b (nc × how many) that measured accelerations obey far better than noise lets them, or to
// rounding: Σ (cᵀr)² < Σ cᵀ A S Aᵀ c, summed over the states, with r = A ddq − b and S the variances that are far too small for noise.
// Combinations in which A cancels say nothing of ddq and are left out.
MatrixXd obeyed_combinations(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                             const Ref<const MatrixXd>& accelerations, const Ref<const MatrixXd>& stddev) {
  // a log with 7 digits or more of a computed quantity; measured accelerations are never that good
  constexpr double rounding = 1e-6, beside_noise = 0.03, redundant = 1e-9;
  const int nc = system.nc();
  const bool are_many = states.cols() >= 2 * nc + 4;  // else chance makes a small residual
  VectorXd size = accelerations.array().square().rowwise().mean().sqrt();
  size = size.cwiseMax(rounding * size.maxCoeff());  // a column that is 0
  MatrixXd of_residual = MatrixXd::Zero(nc, nc), allowed = of_residual;
  in_blocks(states, 1, [&](Index first, const Ref<const MatrixXd>& block) {
    const SystemValues values = system.evaluate(block, parameters);
    for (int i = 0; i < values.n_states(); ++i) {
      VectorXd small = rounding * size;
      for (Index j = 0; j < small.size() && stddev.size() > 0 && are_many; ++j) {
        const double noise = stddev(j, first + i);
        if (std::isfinite(noise)) small[j] = std::hypot(small[j], beside_noise * noise);
      }
      const VectorXd residual = values.A(i) * accelerations.col(first + i) - values.b(i);
      const MatrixXd scaled = values.A(i) * small.asDiagonal();
      of_residual += residual * residual.transpose();
      allowed += scaled * scaled.transpose();
    }
  });
  if (!of_residual.allFinite() || !allowed.allFinite()) return MatrixXd(nc, 0);
  if (!are_many) {
    of_residual = MatrixXd(of_residual.diagonal().asDiagonal());
    allowed = MatrixXd(allowed.diagonal().asDiagonal());
  }
  // in combinations whose allowed variance is 1 each
  const VectorXd unit = (allowed.diagonal().array() > 0).select(allowed.diagonal().array().rsqrt(), 0);
  const Eigen::SelfAdjointEigenSolver<MatrixXd> of_allowed(unit.asDiagonal() * allowed * unit.asDiagonal());
  const auto n_kept = (of_allowed.eigenvalues().array() > redundant).count();
  if (n_kept == 0) return MatrixXd(nc, 0);  // accelerations of 0
  const MatrixXd combinations = unit.asDiagonal() * of_allowed.eigenvectors().rightCols(n_kept) *
                                of_allowed.eigenvalues().tail(n_kept).cwiseSqrt().cwiseInverse().asDiagonal();
  const Eigen::SelfAdjointEigenSolver<MatrixXd> ratios(combinations.transpose() * of_residual * combinations);
  return combinations * ratios.eigenvectors().leftCols((ratios.eigenvalues().array() < 1).count());
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
    // where the known force presses nothing half of them pull, by the noise
    const bool pulls = 4 * n_pulling > 3 * n_closed, is_beyond = 2 * n_beyond > n_open;
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

// r = A ddq − b of one row of A at one state.
struct StateResidual {
  int state = 0;
  double r = 0;
  double size = 0;      // of the terms that should cancel
  double variance = 0;  // of r, by the noise; NaN where it is not known

  [[nodiscard]] double distance() const { return std::abs(r) / (std::isfinite(variance) ? std::sqrt(variance) : 1); }
  [[nodiscard]] bool operator>(const StateResidual& other) const {
    return std::pair(distance(), state) > std::pair(other.distance(), other.state);
  }
};

// Those of one row of A at all states. The farthest are kept apart, so that the rest without them can be judged.
class RowResiduals {
 public:
  explicit RowResiduals(Index n_states)
      : most_kept_(std::max<std::size_t>(n_worst, static_cast<std::size_t>(n_states) / one_in)) {}

  void add(const StateResidual& one) {
    farthest_.push_back(one);
    std::ranges::push_heap(farthest_, std::greater());
    if (farthest_.size() <= most_kept_) return;
    std::ranges::pop_heap(farthest_, std::greater());
    add_to_sums(farthest_.back());
    farthest_.pop_back();
  }

  /// Of all states.
  [[nodiscard]] ConstraintResidual summary() && {
    std::ranges::sort(farthest_, std::greater());
    const std::size_t most_outliers = (static_cast<std::size_t>(sums_.n) + farthest_.size()) / one_in;
    std::vector<ConstraintResidual> without_first{means()};  // without all of the farthest, …, without none
    for (auto one = farthest_.rbegin(); one != farthest_.rend(); ++one) {
      add_to_sums(*one);
      without_first.push_back(means());
    }
    ConstraintResidual all = without_first.back();
    for (std::size_t k = 0; k < std::min(n_worst, farthest_.size()); ++k) all.worst.push_back(farthest_[k].state);
    for (std::size_t k = 1; k <= most_outliers && all.is_too_large(); ++k) {
      const ConstraintResidual& rest = without_first[farthest_.size() - k];
      // a residual that grows with some quantity loses less with its largest values
      if (rest.is_too_large() || rest.rms > 0.5 * all.rms) continue;
      all.n_outliers = static_cast<int>(k);
      break;
    }
    return all;
  }

 private:
  void add_to_sums(const StateResidual& one) {
    ++sums_.n;
    sums_.rms += one.r * one.r;
    sums_.mean += one.r;
    sums_.size += one.size * one.size;
    sums_.expected += one.variance;
  }

  [[nodiscard]] ConstraintResidual means() const {
    ConstraintResidual means = sums_;
    if (means.n == 0) return means;
    means.mean /= means.n;
    for (double* const square : {&means.rms, &means.size, &means.expected}) *square = std::sqrt(*square / means.n);
    return means;
  }

  static constexpr std::size_t n_worst = 3, one_in = 20;
  std::size_t most_kept_;
  std::vector<StateResidual> farthest_;  // a heap whose first is the least far
  ConstraintResidual sums_;              // of the others; squares where a root mean square is wanted
};

// Of all accelerations at all states, or empty: not known.
void require_stddev(const char* what, const System& system, const Ref<const MatrixXd>& states,
                    const Ref<const MatrixXd>& stddev) {
  if (stddev.size() > 0) require_shape(what, stddev, system.nq(), states.cols());
}

}  // namespace

std::vector<ConstraintViolation> constraint_violations(const System& system, const Ref<const MatrixXd>& states,
                                                       const Ref<const VectorXd>& parameters) {
  struct OfResidual {
    double largest = -1, squares = 0;
    Index at = 0;
    Index n_active = 0;
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
        one.n_active += system.is_conditional(labels[k].row) && A.isZero(0) ? 0 : 1;
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
  // a guide holds a coordinate where it is, whose spread is the violation itself: others of its kind tell how far the system moves
  const auto moved = [&](bool velocity, int j) {
    constexpr double share = 0.01;
    double largest = 0;
    for (int i = 0; i < system.nq(); ++i) {
      if (system.coordinates()[static_cast<std::size_t>(i)].angle != system.coordinates()[static_cast<std::size_t>(j)].angle)
        continue;
      largest = std::max(largest, spread_of(velocity ? layout.dq(i) : layout.q(i)));
    }
    return std::max(spread_of(velocity ? layout.dq(j) : layout.q(j)), share * largest);
  };
  std::vector<ConstraintViolation> violations;
  for (std::size_t k = 0; k < labels.size(); ++k) {
    const OfResidual& one = all[k];
    ConstraintViolation& violation = violations.emplace_back();
    violation = {not_a_number, not_a_number, not_a_number, 0, labels[k].text};
    if (!one.is_measured || states.cols() == 0) continue;
    double scale = 0;
    for (int j = 0; j < system.nq(); ++j) {
      if (one.weights[j] > 0) scale += one.weights[j] * moved(labels[k].velocity, j);
    }
    if (scale == 0) scale = 1;
    const double n = static_cast<double>(std::max<Index>(1, one.n_active));
    violation = {one.largest / scale, std::sqrt(one.squares / n) / scale, one.largest, static_cast<int>(one.at), labels[k].text};
  }
  return violations;
}

std::optional<ConstraintViolation> largest_violation(const System& system, const Ref<const MatrixXd>& states,
                                                     const Ref<const VectorXd>& parameters) {
  std::optional<ConstraintViolation> worst;
  for (ConstraintViolation& one : constraint_violations(system, states, parameters)) {
    if (one.relative > (worst ? worst->relative : -1)) worst = std::move(one);
  }
  return worst;
}

std::optional<std::vector<int>> dependent_columns(const System& system, const Ref<const MatrixXd>& states,
                                                  const Ref<const VectorXd>& parameters, const Ref<const MatrixXd>& accelerations,
                                                  const Ref<const MatrixXd>& stddev) {
  system.require_states(states);
  require_shape("dependent_columns: accelerations", accelerations, system.nq(), states.cols());
  require_stddev("dependent_columns: stddev", system, states, stddev);
  if (system.nc() == 0) return std::nullopt;
  if (accelerations.hasNaN()) {
    const std::vector<int> complete = complete_states(accelerations);
    if (complete.empty()) return std::nullopt;
    const MatrixXd of_complete = stddev.size() > 0 ? MatrixXd(stddev(Eigen::all, complete)) : MatrixXd();
    return dependent_columns(system, states(Eigen::all, complete), parameters, accelerations(Eigen::all, complete), of_complete);
  }
  const MatrixXd combinations = obeyed_combinations(system, states, parameters, accelerations, stddev);
  if (combinations.cols() == 0) return std::nullopt;
  VectorXd scale(system.nq());
  for (Index j = 0; j < scale.size(); ++j) scale[j] = std::max(spread(accelerations.row(j)), 1e-300);
  constexpr Index max_states = 50;
  const Index stride = std::max<Index>(1, states.cols() / max_states);
  // of B ddq = Cᵀ b with B = Cᵀ A: what it leaves free, one below the other by the state
  Index rank = 0, lowest_rank = system.nq();
  std::vector<MatrixXd> free;
  in_blocks(states, 1, [&](Index first, const Ref<const MatrixXd>& block) {
    const SystemValues values = system.evaluate(block, parameters);
    for (int i = 0; i < values.n_states(); ++i) {
      const bool is_taken = (first + i) % stride == 0;
      if (!is_taken && !system.has_conditional_constraints()) continue;
      Eigen::JacobiSVD<MatrixXd> svd(combinations.transpose() * values.A(i) * scale.asDiagonal(), Eigen::ComputeFullV);
      svd.setThreshold(1e-9);
      rank = std::max(rank, svd.rank());
      lowest_rank = std::min(lowest_rank, svd.rank());
      if (is_taken) free.emplace_back(svd.matrixV().rightCols(system.nq() - svd.rank()));
    }
  });
  // where the constraints leave no freedom there is nothing to measure
  if (rank == 0 || rank == system.nq()) return std::nullopt;
  // where a constraint is not active all columns are measurements
  if (system.has_conditional_constraints() && lowest_rank < rank) return std::nullopt;
  std::erase_if(free, [&](const MatrixXd& one) { return one.cols() > system.nq() - rank; });
  return independent_rows(free, system.nq() - static_cast<int>(rank));
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

bool ConstraintResidual::is_too_small() const {
  if (!(n > 0 && std::isfinite(expected))) return false;
  // χ²/n of n normal values is above this but once in 30000 (Wilson & Hilferty 1931)
  const double least = 1 - 2.0 / (9 * n) - 4 * std::sqrt(2.0 / (9 * n));
  return rms < 0.5 * expected && least > 0 && rms * rms < std::pow(least, 3) * expected * expected;
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
  const char* const word = lines.empty() ? "row" : "line";
  std::vector<int> rows;
  for (const int state : worst) rows.push_back(lines.empty() ? state + 1 : lines[static_cast<std::size_t>(state)]);
  if (n_outliers > 0) {
    rows.resize(std::min(rows.size(), static_cast<std::size_t>(n_outliers)));
    return fmt::format(
        "measured ddq on A ddq = b: rms residual {:.3g} for '{}' is more than noise, but only because of {} of {} rows (farthest "
        "off: {} {}): outliers of the log, or an event that the model lacks, such as a collision; correct or leave out these "
        "rows, or give them less weight by a fit with `robust`",
        rms, constraint, n_outliers, n, word, fmt::join(rows, ", "));
  }
  if (!is_known) {
    return fmt::format(
        "measured ddq on A ddq = b: rms residual {:.3g} for '{}', mean {:.3g}, is more than noise: a constraint, a "
        "unit, a sign or gravity in a sensor is wrong (farthest off: {} {})",
        rms, constraint, mean, word, fmt::join(rows, ", "));
  }
  return fmt::format(
      "measured ddq on A ddq = b: rms residual {:.3g} for '{}', mean {:.3g}, expected {:.2g} from the noise: {:.2g} ×; "
      "a constraint, a unit, a sign or gravity in a sensor is wrong, or the noise is stated too small (farthest off: "
      "{} {})",
      rms, constraint, mean, expected, rms / expected, word, fmt::join(rows, ", "));
}

std::vector<ConstraintResidual> constraint_residuals(const System& system, const Ref<const MatrixXd>& states,
                                                     const Ref<const VectorXd>& parameters,
                                                     const Ref<const MatrixXd>& accelerations,
                                                     const Ref<const MatrixXd>& stddev) {
  system.require_states(states);
  require_shape("constraint_residuals: accelerations", accelerations, system.nq(), states.cols());
  require_stddev("constraint_residuals: stddev", system, states, stddev);
  std::vector<RowResiduals> rows(static_cast<std::size_t>(system.nc()), RowResiduals(states.cols()));
  in_blocks(states, 1, [&](Index first, const Ref<const MatrixXd>& block) {
    const SystemValues values = system.evaluate(block, parameters);
    for (int row = 0; row < system.nc(); ++row) {
      for (int i = 0; i < values.n_states(); ++i) {
        const Index state = first + i;
        StateResidual one{static_cast<int>(state), -values.b(i)[row], std::abs(values.b(i)[row])};
        for (int j = 0; j < system.nq(); ++j) {
          const double a = values.A(i)(row, j);
          if (a == 0) continue;
          one.r += a * accelerations(j, state);
          one.size += std::abs(a * accelerations(j, state));
          one.variance += stddev.size() == 0 ? not_a_number : a * a * stddev(j, state) * stddev(j, state);
        }
        // a row that vanishes says nothing of ddq
        if (!std::isfinite(one.r) || one.variance == 0) continue;
        one.variance += std::pow(system.constraint_noise()[row], 2);
        rows[static_cast<std::size_t>(row)].add(one);
      }
    }
  });
  std::vector<ConstraintResidual> all;
  for (std::size_t row = 0; row < rows.size(); ++row) {
    ConstraintResidual one = std::move(rows[row]).summary();
    one.constraint = system.constraint_labels()[row];
    if (one.n > 0) all.push_back(std::move(one));
  }
  return all;
}

std::vector<Finding> check_data(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                                const Ref<const MatrixXd>& accelerations, const Ref<const MatrixXd>& stddev,
                                const std::vector<int>& stated, bool estimates_noise) {
  system.require_states(states);
  require_shape("check_data: accelerations", accelerations, system.nq(), states.cols());
  require_stddev("check_data: stddev", system, states, stddev);
  for (const int row : stated) {
    if (row >= 0 && row < system.nq()) continue;
    throw InputError(fmt::format("check_data: stated: there are the rows 0 … {}, got {}", system.nq() - 1, row));
  }
  const bool estimates =
      std::any_of(system.parameters().begin(), system.parameters().end(), [](const auto& one) { return one.estimate; });
  std::vector<Finding> findings;
  if (const auto violation = largest_violation(system, states, parameters)) {
    const Level level = violation->rms > 0.3                               ? Level::error
                        : violation->relative > large_constraint_violation ? Level::warning
                                                                           : Level::good;
    findings.push_back({estimates ? std::min(level, Level::warning) : level,
                        fmt::format("data on the constraint: off by {:.2g} at most, {:.1e} of its scale ('{}', row {})",
                                    violation->value, violation->relative, violation->constraint, violation->state + 1)});
  }
  MatrixXd told;
  if (estimates_noise) told = stddev;
  for (int row = 0; row < told.rows(); ++row) {
    if (std::find(stated.begin(), stated.end(), row) == stated.end()) told.row(row).setConstant(not_a_number);
  }
  const auto rows = dependent_columns(system, states, parameters, accelerations,
                                      estimates_noise ? Ref<const MatrixXd>(told) : Ref<const MatrixXd>(stddev));
  for (const ConstraintResidual& one : constraint_residuals(system, states, parameters, accelerations, stddev)) {
    // as large as what should cancel: nothing that is learned from such data is of this system
    const bool is_all = one.is_too_large() && one.n_outliers == 0 && one.rms > 0.3 * one.size && !estimates;
    std::string text = one.text();
    if (one.is_too_large() && estimates) text += "; here with the parameters as in the model file";
    if (one.is_too_small() && !rows && !estimates_noise) {
      text +=
          fmt::format(": {:.2g} ×; the noise is stated too large, or these columns share their errors", one.rms / one.expected);
    }
    findings.push_back({is_all ? Level::error : one.is_too_large() ? Level::warning : Level::good, std::move(text)});
  }
  if (const auto* symbolic = dynamic_cast<const SymbolicSystem*>(&system)) {
    check_contacts(*symbolic, states, parameters, accelerations, findings);
  }
  const auto names_of = [every = system.acceleration_names()](const std::vector<int>& some) {
    std::vector<std::string> names;
    for (const int row : some) names.push_back(every[static_cast<std::size_t>(row)]);
    return names;
  };
  // which of them a fit observes may change from row to row
  const auto most_stated = [&] { return (!stddev(stated, Eigen::all).array().isNaN()).colwise().count().maxCoeff(); };
  if (rows && !stated.empty() && stddev.size() > 0 && most_stated() <= std::ssize(*rows)) {
    findings.push_back(
        {Level::good,
         fmt::format(
             "dependent columns: the {} accelerations satisfy A ddq = b, or part of it, far more closely than measurement "
             "noise allows; a fit observes {}, whose standard deviations the log gives",
             system.nq(), fmt::join(names_of(stated), ", "))});
  } else if (rows) {
    findings.push_back(
        {Level::warning, fmt::format("dependent columns: the {} accelerations satisfy A ddq = b, or part of it, far more closely "
                                     "than measurement noise allows, so only {} of them are independent measurements: fit with "
                                     "`observe={}`",
                                     system.nq(), rows->size(), fmt::join(names_of(*rows), ","))});
  }
  return findings;
}

}  // namespace gp2
