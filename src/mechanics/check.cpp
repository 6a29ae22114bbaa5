#include "gp2/mechanics/check.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <exception>
#include <limits>
#include <map>
#include <mutex>
#include <tuple>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <Eigen/Cholesky>

#include "base/decompositions.hpp"
#include "base/mixed_states.hpp"
#include "base/parallel.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/symbolic_system.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "mechanics/differences.hpp"
#include "mechanics/in_blocks.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Level = Finding::Level;

std::vector<StateRank> ranks_of(const System& system, const MechanicsBatch& mechanics) {
  std::vector<StateRank> ranks;
  for (const UdwadiaKalaba& projection : mechanics.projections) {
    const auto i = static_cast<int>(ranks.size());
    StateRank& one = ranks.emplace_back();
    for (int row = 0; row < system.nc(); ++row) {
      if (system.is_conditional(row) && mechanics.values.A(i).row(row).isZero(0)) one.inactive.push_back(row);
    }
    one.rank = projection.rank() + static_cast<int>(one.inactive.size());
  }
  return ranks;
}

LowerRank states_of_lower_rank(const std::vector<StateRank>& ranks) {
  std::map<std::vector<int>, int> highest, usual;  // by the inactive rows
  for (const StateRank& one : ranks) {
    int& so_far = highest.try_emplace(one.inactive, one.rank).first->second;
    so_far = std::max(so_far, one.rank);
  }
  // a row that is switched off counts as one more, and switched on as one more or, where it follows from others, as none
  for (const auto& [inactive, rank] : highest) {
    int& expected = usual.emplace(inactive, rank).first->second;
    for (const auto& [fewer, of_fewer] : highest) {
      if (std::ranges::includes(inactive, fewer)) expected = std::max(expected, of_fewer);
    }
  }
  LowerRank lower;
  int largest_loss = -1;
  for (std::size_t i = 0; i < ranks.size(); ++i) {
    const int expected = usual.at(ranks[i].inactive), loss = expected - ranks[i].rank;
    if (loss > 0) lower.states.push_back(static_cast<int>(i));
    // where none is lost, what redundant rows leave
    if (loss < largest_loss || (loss == largest_loss && expected >= lower.usual)) continue;
    largest_loss = loss;
    lower.usual = expected;
    lower.lowest = ranks[i].rank;
  }
  return lower;
}

LowerRank states_of_lower_rank(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters) {
  if (system.nc() == 0) return {};
  std::vector<StateRank> ranks(static_cast<std::size_t>(states.cols()));
  const auto fault = for_each_mechanics(system, states, parameters, 1, [&](Index first, const MechanicsBatch& mechanics) {
    const std::vector<StateRank> here = ranks_of(system, mechanics);
    std::copy(here.begin(), here.end(), ranks.begin() + first);
  });
  return fault ? LowerRank{} : states_of_lower_rank(ranks);
}

namespace {

bool has_expressions(const System& system) { return dynamic_cast<const SymbolicSystem*>(&system) != nullptr; }

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

// M as it were at one time: where time alone changes it there are no Coriolis forces.
MatrixXd mass_at_time(const System& system, MatrixXd states, double t, const Ref<const VectorXd>& parameters) {
  states.row(system.layout().t()).setConstant(t);
  return system.evaluate(states, parameters).mass;
}

// an M that changes with the place comes with forces that are quadratic in the velocities
void check_coriolis(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                    const MechanicsSummary& mechanics, std::vector<Finding>& findings) {
  const double rounding = 1e-9 * mechanics.largest_entry;
  if (!(mechanics.largest_change > rounding)) return;
  const double t = states(system.layout().t(), 0);
  const VectorXd first_mass = system.evaluate(states.leftCols(1), parameters).mass.col(0);
  double largest_change = 0;
  in_blocks(states, 1, [&](Index, const Ref<const MatrixXd>& block) {
    const MatrixXd change = mass_at_time(system, block, t, parameters).colwise() - first_mass;
    largest_change = std::max(largest_change, change.cwiseAbs().maxCoeff());
  });
  if (!(largest_change > rounding)) return;
  bool is_zero = true;
  in_blocks(states, 1, [&](Index, const Ref<const MatrixXd>& block) {
    is_zero = is_zero && even_force(system, block, parameters).isZero(0);
  });
  if (!is_zero) return;
  findings.push_back(
      {Level::warning,
       fmt::format(
           "mass matrix: it changes with the motion, but no part of the force is quadratic in the velocities: the Coriolis "
           "and centrifugal forces are missing; {}",
           has_expressions(system) ? "write coriolis = true in [mechanics]" : "add them to F")});
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
void report_rank(const System& system, const std::vector<StateRank>& ranks, const MechanicsSummary& mechanics,
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
  int n_conditional = 0;
  for (int row = 0; row < system.nc(); ++row) n_conditional += system.is_conditional(row) ? 1 : 0;
  if (std::ranges::max(ranks, {}, &StateRank::rank).rank - n_conditional >= system.nq()) {
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

// The norm of a row of A beside a state; 0 where it is rounding of other rows.
double size_beside(const System& system, VectorXd state, const VectorXd& parameters, int row) {
  for (int j = 0; j < system.nq(); ++j) {
    double& q = state[system.layout().q(j)];
    q += 1e-3 * (1 + 0.1 * j) * (1 + std::abs(q));
  }
  constexpr double rounding = 1e-12;
  const VectorXd sizes = system.evaluate(state, parameters).A(0).rowwise().norm();
  return sizes[row] > rounding * std::max(1.0, sizes.maxCoeff()) ? sizes[row] : 0;
}

// a row of A that nearly vanishes somewhere decides the direction of its force from rounding
/// @param sizes  norms of the rows of A (nc × N)
/// @param state  one of them
void report_row_sizes(const System& system, const VectorXd& state, const VectorXd& parameters, const MatrixXd& sizes,
                      int n_zero_rows, std::vector<Finding>& findings) {
  for (int row = 0; row < system.nc(); ++row) {
    const std::string& label = system.constraint_labels()[static_cast<std::size_t>(row)];
    if (system.is_conditional(row)) {
      n_zero_rows -= static_cast<int>((sizes.row(row).array() == 0).count());
      continue;
    }
    // that of (q1 − q2)², unlike that of a loop in a plane which is closed in space
    constexpr double vanishing = 1e-9;
    if (const double beside = size_beside(system, state, parameters, row); sizes.row(row).maxCoeff() < vanishing * beside) {
      n_zero_rows -= static_cast<int>((sizes.row(row).array() == 0).count());
      findings.push_back(
          {Level::warning, fmt::format("constraint '{}': its row of A is zero wherever it holds, as that of a square "
                                       "is, so that it holds nothing; write its root",
                                       label)});
      continue;
    }
    if (sizes.row(row).isZero(0)) {
      // a loop in a plane, closed in space
      n_zero_rows -= static_cast<int>(sizes.cols());
      findings.push_back(
          {Level::good, fmt::format("constraint '{}': nothing moves along it, its row of A is zero at every state", label)});
      continue;
    }
    const double usual = median({sizes.row(row).begin(), sizes.row(row).end()});
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
  std::vector<StateRank> ranks(static_cast<std::size_t>(states.cols()));
  MatrixXd sizes(system.nc(), states.cols());
  std::mutex mutex;
  const auto fault = for_each_mechanics(system, states, parameters, n_threads, [&](Index first, const MechanicsBatch& block) {
    const std::vector<StateRank> ranks_here = ranks_of(system, block);
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
    findings.push_back({Level::good, "constraints: none: ddq is the unconstrained acceleration"});
    return true;
  }
  report_rank(system, ranks, mechanics, findings);
  report_conditions(system, sizes, findings);
  report_row_sizes(system, states.col(0), parameters, sizes, mechanics.n_zero_rows, findings);
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
  VectorXd errors = VectorXd::Zero(n_parameters), is_infinite = errors;
  in_blocks(states, n_threads, [&](Index, const Ref<const MatrixXd>& block) {
    const SystemValues value = system.evaluate(block, parameters);
    VectorXd here = VectorXd::Zero(n_parameters), is_infinite_here = here;
    for (int p = 0; p < n_parameters; ++p) {
      const double parameter = parameters[p] != 0 ? std::abs(parameters[p]) : 1e-3;
      const SystemValues d = system.differentiate(block, parameters, p);
      const SystemValues by_differences = difference_in_parameter(system, block, parameters, p);
      for (std::size_t part = 0; part < 4; ++part) {
        const auto entries = [&](const SystemValues& of) { return parts_of(of)[part]->reshaped(); };
        // an entry that is rounding beside the others is as good as zero
        const double rounding = 1e-6 * largest(static_cast<Index>(part), p);
        for (Index k = 0; k < entries(d).size(); ++k) {
          const double exact = entries(d)[k], difference = entries(by_differences)[k];
          if (!std::isfinite(exact) && std::isfinite(entries(value)[k])) is_infinite_here[p] = 1;
          if (!std::isfinite(difference) || !std::isfinite(exact)) continue;
          // about 1e-10 of the values is left by the step
          const double size = std::abs(exact) + rounding + 1e-4 * std::abs(entries(value)[k]) / parameter;
          here[p] = std::max(here[p], std::abs(difference - exact) / std::max(size, 1e-12));
        }
      }
    }
    const std::scoped_lock lock(mutex);
    errors = errors.cwiseMax(here);
    is_infinite = is_infinite.cwiseMax(is_infinite_here);
  });
  for (int p = 0; p < n_parameters; ++p) {
    if (is_infinite[p] == 0) continue;
    findings.push_back(
        {Level::warning, fmt::format("derivatives of M, A, b, F in the parameters: that in '{}' is not finite where they are: it "
                                     "cannot be estimated from its value {}",
                                     system.parameters()[static_cast<std::size_t>(p)].name, parameters[p])});
  }
  if (is_infinite.minCoeff() > 0) return;
  Index at = 0;
  const double worst = errors.maxCoeff(&at);
  findings.push_back(
      {worst > 1e-4 ? Level::error : Level::good,
       fmt::format("derivatives of M, A, b, F in the parameters: equal to central differences to {:.1e}{}", worst,
                   worst > 0 ? " (largest for '" + system.parameters()[static_cast<std::size_t>(at)].name + "')" : "")});
}

// The largest error of a rate of a constraint, relative to its size over the states.
struct ErrorOfRate {
  double relative = 0;
  std::string constraint;
};

// q(t + h) = q + h dq + ½h² ddq of every state, by its own step
MatrixXd moved(const StateLayout& layout, MatrixXd states, const MatrixXd& ddq, const Eigen::ArrayXd& steps) {
  const Eigen::DiagonalMatrix<double, Eigen::Dynamic> h(steps.matrix());
  auto dq = states.middleRows(layout.dq(0), layout.nq);
  states.middleRows(layout.q(0), layout.nq) += (dq + 0.5 * ddq * h) * h;
  dq += ddq * h;
  states.row(layout.t()) += steps.matrix().transpose();
  return states;
}

// A ddq − b against the second difference of each constraint along that motion
ErrorOfRate error_of_rates(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                           int n_threads, double h) {
  const auto n_residuals = std::ssize(system.residual_labels());
  const StateLayout layout = system.layout();
  // errors relative to the largest over the states: at one that rests there is nothing to be relative to
  Eigen::ArrayXd error = Eigen::ArrayXd::Zero(n_residuals), size = error;
  std::mutex mutex;
  in_blocks(states, n_threads, [&](Index, const Ref<const MatrixXd>& block) {
    const SystemValues values = system.evaluate(block, parameters);
    // an arbitrary acceleration of the size of the velocities
    const MatrixXd ddq =
        block.middleRows(layout.dq(0), layout.nq).unaryExpr([](double v) { return std::isnan(v) ? 0.0 : 0.7 * v + 0.3; });
    // the step of each state as its t rounds it, longer where t is that of a clock, 1.7e9 s: sin(3 t) is known there to 1e-6
    const Eigen::ArrayXd steps = block.row(layout.t()).unaryExpr([&](double t) {
      const double rounding = std::numeric_limits<double>::epsilon() * std::abs(t);
      const double step = std::max({h, std::min(4 * h, 1e3 * rounding), 4 * rounding});
      return std::isfinite(t) ? (t + step) - t : h;
    });
    const MatrixXd after = moved(layout, block, ddq, steps), before = moved(layout, block, ddq, -steps);
    const MatrixXd now = system.residuals(block, parameters);
    const MatrixXd difference =
        (system.residuals(after, parameters) - system.residuals(before, parameters)) * (0.5 / steps).matrix().asDiagonal();
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
  ErrorOfRate worst;
  for (Index k = 0; k < n_residuals; ++k) {
    constexpr double rounding = 1e-15;  // what is no faster than rounding of the others stands still
    if (!(error[k] > worst.relative * size[k] && size[k] > rounding * size.maxCoeff())) continue;
    worst = {error[k] / size[k], system.residual_labels()[static_cast<std::size_t>(k)].text};
  }
  return worst;
}

void check_motion(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters, int n_threads,
                  std::vector<Finding>& findings) {
  if (system.residual_labels().empty()) return;
  // 100 rad/s turn by 0.01 rad in 1e-4 s, and none by more: the error of a difference is a sixth of its square
  double fastest = 0;
  for (const double v : states.middleRows(system.layout().dq(0), system.nq()).reshaped()) {
    if (std::isfinite(v)) fastest = std::max(fastest, std::abs(v));
  }
  const double h = 1e-4 / std::max(1.0, fastest / 100);
  constexpr double most = 1e-3;
  ErrorOfRate worst = error_of_rates(system, states, parameters, n_threads, h);
  // a constraint may be faster than the coordinates, as a function of time or a fine grating
  for (const double shorter : {h / 10, h / 100}) {
    if (!(worst.relative > most)) break;
    ErrorOfRate other = error_of_rates(system, states, parameters, n_threads, shorter);
    if (other.relative < worst.relative) worst = std::move(other);
  }
  findings.push_back({worst.relative > most ? Level::warning : Level::good,
                      fmt::format("A and b: equal to differences of the constraints along a motion to {:.1e}{}", worst.relative,
                                  worst.relative > most ? " (largest for '" + worst.constraint + "')" : "")});
}

// What a part of a system gives at states, by quantity.
std::vector<MatrixXd> evaluate_part(const System& system, SystemPart part, const MatrixXd& states,
                                    const Ref<const VectorXd>& parameters) {
  if (part == SystemPart::residuals) return {system.residuals(states, parameters)};
  SystemValues values;
  system.evaluate_into(states, parameters, values);
  if (part == SystemPart::force) return {values.force};
  return {values.mass, values.constraint_matrix, values.constraint_vector};
}

// Functions declare what they read; what they read besides has no derivative in the state. Expressions show it themselves.
void check_reads(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                 std::vector<Finding>& findings) {
  if (has_expressions(system)) return;
  constexpr Index max_states = 50;
  const Index stride = (states.cols() + max_states - 1) / max_states;
  const MatrixXd here = states(Eigen::all, Eigen::seq(0, states.cols() - 1, stride));
  const auto largest = [](const MatrixXd& values) {
    return values.size() == 0 ? 0 : values.array().isFinite().select(values.array().abs(), 0).maxCoeff();
  };
  const std::vector<MatrixXd> mechanics = evaluate_part(system, SystemPart::mechanics, here, parameters);
  const double size_of_M = largest(mechanics[0]), size_of_A = largest(mechanics[1]);
  struct Part {
    SystemPart part;
    const char *text, *list;
    std::vector<double> sizes;  // of each quantity, beside its own: of terms that may cancel in it
  };
  for (const Part& one : {Part{SystemPart::mechanics, "M, A or b depend", "mechanics_reads", {0, 0, size_of_A}},
                          Part{SystemPart::force, "F depends", "force_reads", {size_of_M}},
                          Part{SystemPart::residuals, "the residuals depend", "residuals_read", {size_of_A}}}) {
    const std::vector<bool> reads = system.reads(one.part);
    const std::vector<MatrixXd> expected = evaluate_part(system, one.part, here, parameters);
    const auto changes = [&](const MatrixXd& moved) {
      try {
        const std::vector<MatrixXd> got = evaluate_part(system, one.part, moved, parameters);
        for (std::size_t k = 0; k < got.size(); ++k) {
          constexpr double rounding = 1e-10;
          const double size = one.sizes[k] + largest(expected[k]) + largest(got[k]);
          const auto before = expected[k].array(), after = got[k].array();
          const auto are_close = after == before || (after - before).abs() <= rounding * size;
          if (!(are_close || (after.isNaN() && before.isNaN())).all()) return true;
        }
        return false;
      } catch (const std::exception&) {
        return true;  // to refuse a value is to read it
      }
    };
    std::vector<std::string> missing;
    for (Index k = 0; k < here.rows(); ++k) {
      if (reads[static_cast<std::size_t>(k)]) continue;
      MatrixXd moved = here;
      for (double& x : moved.row(k).reshaped()) x = std::isfinite(x) ? x + 0.7 * (1 + std::abs(x)) : 0.3;
      if (changes(moved)) missing.push_back(system.state_names()[static_cast<std::size_t>(k)]);
    }
    if (missing.empty()) continue;
    findings.push_back(
        {Level::warning, fmt::format("declared reads: {} on {}, which {} (in Python reads) lacks: derivatives in the state are "
                                     "wrong, and a log need not have such columns; add the names",
                                     one.text, fmt::join(missing, ", "), one.list)});
  }
}

}  // namespace

std::optional<std::string> mixed_states(const System& system, const Ref<const MatrixXd>& states,
                                        const Ref<const VectorXd>& parameters) {
  if (has_expressions(system) || states.cols() == 0) return std::nullopt;
  const auto motion = states.topRows(system.layout().t()).array();  // q, dq
  const double size = motion.isFinite().select(motion.abs(), 0).maxCoeff();
  for (const auto& [part, what, terms] : {std::tuple(SystemPart::mechanics, "M, A or b", std::vector<double>{0, 0, size}),
                                          std::tuple(SystemPart::force, "F", std::vector<double>{size}),
                                          std::tuple(SystemPart::residuals, "the residuals", std::vector<double>{size})}) {
    const auto evaluate = [&, part = part](const MatrixXd& some) { return evaluate_part(system, part, some, parameters); };
    if (auto text = mixed_states_text(what, evaluate, states, terms)) return text;
  }
  return std::nullopt;
}

std::vector<Finding> check_system(const System& system, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
                                  int n_threads) {
  system.require_states(states);
  system.require_parameters(parameters);
  if (states.cols() == 0) throw InputError("check_system: there are no states");
  std::vector<Finding> findings;
  if (!check_mechanics(system, states, parameters, n_threads, findings)) return findings;
  check_parameter_derivatives(system, states, parameters, n_threads, findings);
  check_motion(system, states, parameters, n_threads, findings);
  if (auto mixed = mixed_states(system, states, parameters)) findings.push_back({Level::error, *std::move(mixed)});
  check_reads(system, states, parameters, findings);
  return findings;
}

}  // namespace gp2
