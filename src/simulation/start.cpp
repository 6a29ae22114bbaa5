#include <algorithm>
#include <cmath>
#include <iterator>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"
#include "gp2/simulate.hpp"
#include "simulation/controlled_motion.hpp"
#include "simulation/projection.hpp"

namespace gp2 {

namespace {

// "q3 = 0.097, dq3 = -0.04 for -0.1", where something else than 0 stood before
std::string listed(const std::vector<std::string>& names, const Eigen::VectorXd& state, const std::vector<int>& entries,
                   const Eigen::VectorXd& before) {
  std::vector<std::string> parts;
  for (const int k : entries) {
    parts.push_back(fmt::format("{} = {:.6g}", names[static_cast<std::size_t>(k)], state[k]));
    if (before[k] != 0 && before[k] != state[k]) parts.back() += fmt::format(" for {:.6g}", before[k]);
  }
  return fmt::format("{}", fmt::join(parts, ", "));
}

// Whether a move of the coordinates, or of the velocities, is more than the last digits of a state that is written down as a whole.
bool is_beyond_rounding(const System& system, const Eigen::VectorXd& from, const Eigen::VectorXd& to) {
  constexpr double much = 1e-3;  // of the size of all coordinates, or of all velocities
  const Eigen::Index nq = system.nq();
  const auto is_moved = [&](Eigen::Index first) {
    const auto before = from.segment(first, nq), after = to.segment(first, nq);
    return (after - before).norm() > much * std::max(before.norm(), after.norm());
  };
  return is_moved(0) || is_moved(nq);
}

// "phi = 0.299864 for 0.3", of what is given and is something else in a state
std::string listed_moves(const std::vector<std::string>& names, const StartingPoint& start, const Eigen::VectorXd& state) {
  std::vector<std::string> parts;
  for (std::size_t k = 0; k < names.size(); ++k) {
    const double given = start.state[static_cast<Eigen::Index>(k)], found = state[static_cast<Eigen::Index>(k)];
    if (start.given[k] && found != given) parts.push_back(fmt::format("{} = {:.9g} for {:.9g}", names[k], found, given));
  }
  return fmt::format("{}", fmt::join(parts, ", "));
}

// The nearest state on the constraints to one of which more is given than they allow, by the least change of what is given alone.
// What is open there begins so near to it that the projection of simulate(), which moves all, ends there too.
struct Nearest {
  Eigen::VectorXd start;      // what is given as it is
  Eigen::VectorXd projected;  // and as simulate() projects it
};

Nearest nearest_to(const System& system, const Eigen::VectorXd& parameters, const StartingPoint& from, bool velocity) {
  constexpr double loose = 1e3;  // how much farther than what is given may move what is open
  const Eigen::Index nq = system.nq(), first = velocity ? nq : 0;
  Nearest found{from.state, from.state};
  Eigen::VectorXd stddevs = Eigen::VectorXd::Ones(2 * nq);
  for (Eigen::Index k = first; k < first + nq; ++k) stddevs[k] = from.given[static_cast<std::size_t>(k)] ? 1 : loose;
  if ((stddevs.array() > 1).any()) {
    ConstraintProjection by_what_is_given(system, parameters);
    by_what_is_given.weigh_by(stddevs);
    by_what_is_given.apply(found.projected);
    for (Eigen::Index k = first; k < first + nq; ++k) {
      if (!from.given[static_cast<std::size_t>(k)]) found.start[k] = found.projected[k];
    }
  }
  found.projected = project_onto_constraints(system, parameters, found.start);
  return found;
}

// What is given stays as it is and, where there is a solution, what the constraints do not read, though M may couple it to what moves.
std::vector<bool> held_entries(const System& system, const StartingPoint& start) {
  std::vector<bool> held = start.given;
  const std::vector<bool> reads = system.reads(SystemPart::residuals);
  for (std::size_t k = 0; k < held.size(); ++k) held[k] = held[k] || !reads[k];
  return held;
}

// The nearest solution for the coordinates, with those that are given as they are, that Newton's method finds.
// @throws NumericalError where it finds none
Eigen::VectorXd solve_coordinates(const System& system, const Eigen::VectorXd& parameters, const StartingPoint& start) {
  const Eigen::Index nq = system.nq();
  std::vector<bool> held = held_entries(system, start);
  std::fill(held.begin() + nq, held.begin() + 2 * nq, false);
  // each is moved by another share of `aside`: equal ones may keep a symmetry that has no slope
  const auto solve_from = [&](double aside) {
    Eigen::VectorXd from = start.state;
    int n_open = 0;
    for (Eigen::Index k = 0; k < nq; ++k) {
      if (!held[static_cast<std::size_t>(k)]) from[k] += aside * std::cos(2.0 * n_open++);
    }
    return project_onto_constraints(system, parameters, from, held);
  };
  try {
    return solve_from(0);
  } catch (const NumericalError&) {
    // where a constraint has no slope in what is open, as a circle at its highest point, Newton's method leaves other starts
    const auto distance = [&](const Eigen::VectorXd& one) { return (one - start.state).head(nq).norm(); };
    std::optional<Eigen::VectorXd> nearest;
    for (const double aside : {0.3, 1.0, -1.0}) {
      try {
        const Eigen::VectorXd found = solve_from(aside);
        if (!nearest || distance(found) < distance(*nearest)) nearest = found;
      } catch (const NumericalError&) {  // perhaps from another
      }
    }
    if (!nearest) throw;
    return *nearest;
  }
}

// A start on the constraints: coordinates first, then velocities there, since what is given of one level says nothing against a solution
// of the other. Where what is given leaves none, `why` says so, and the nearest stands for it.
// @throws NumericalError where there is none near
Nearest solve_start(const System& system, const Eigen::VectorXd& parameters, const StartingPoint& start, std::string& why) {
  const Eigen::Index nq = system.nq();
  const auto is_impossible = [&](const NumericalError& error) {
    if (why.empty()) why = error.what();
  };
  Nearest found;
  try {
    found.projected = solve_coordinates(system, parameters, start);
    found.start = found.projected;
  } catch (const NumericalError& error) {
    is_impossible(error);
    found = nearest_to(system, parameters, start, false);
  }
  found.projected.segment(nq, nq) = start.state.segment(nq, nq);
  const Eigen::VectorXd at = found.projected;
  Eigen::VectorXd velocities;
  try {
    std::vector<bool> held = held_entries(system, start);
    std::fill(held.begin(), held.begin() + nq, true);
    found.projected = project_onto_constraints(system, parameters, at, held);
    velocities = found.projected;
  } catch (const NumericalError& error) {
    is_impossible(error);
    const Nearest nearest = nearest_to(system, parameters, {at, start.given}, true);
    velocities = nearest.start;
    found.projected = nearest.projected;
  }
  found.start.segment(nq, nq) = velocities.segment(nq, nq);
  return found;
}

}  // namespace

Eigen::VectorXd complete_start(const Model& model, const Eigen::VectorXd& parameters, StartingPoint start,
                               std::vector<std::string>& notes) {
  const System& system = *model.system;
  const std::vector<std::string> names = system.state_names();
  const Eigen::VectorXd before = start.state;  // by a log, of what is open too
  std::vector<int> open;
  for (int k = 0; k < 2 * system.nq(); ++k) {
    if (start.given[static_cast<std::size_t>(k)]) continue;
    open.push_back(k);
    const auto newton_start = model.newton_start.find(names[static_cast<std::size_t>(k)]);
    // an entry that is known from elsewhere is the better start
    if (newton_start != model.newton_start.end() && start.state[k] == 0) start.state[k] = newton_start->second;
  }
  for (const int qw : quaternion_real_parts(model)) {
    const auto k = static_cast<std::size_t>(qw);
    const bool is_open = !start.given[k] && start.state[qw] == 0 && !model.newton_start.contains(names[k]);
    if (is_open && start.state.segment<3>(qw + 1).squaredNorm() < 1) start.state[qw] = 1;
  }
  const bool is_whole = open.empty();
  if (is_whole && system.residual_labels().empty()) return start.state;
  if (model.symbolic_system() == nullptr && system.nc() > 0 && system.residual_labels().empty()) {
    notes.push_back(
        fmt::format("warning: `start`: {}, as '{}' has no residuals to solve its constraints by: name all "
                    "coordinates and velocities",
                    listed(names, start.state, open, start.state), system.name()));
    return start.state;
  }
  Nearest found;
  std::string why;
  const auto warn_of_nearest = [&](const std::string& moves) {
    notes.push_back(
        fmt::format("warning: `start`: what is given leaves no solution of the constraints ({}); the nearest that has one is {}",
                    why, moves));
  };
  try {
    found = solve_start(system, parameters, start, why);
  } catch (const NumericalError& error) {
    if (why.empty()) why = error.what();
    try {
      // simulate() moves all coordinates together, which may lead to the constraints from here too
      const Eigen::VectorXd projected = project_onto_constraints(system, parameters, start.state);
      std::erase_if(open, [&](int k) { return projected[k] == before[k]; });
      std::vector<std::string> moves = {listed_moves(names, start, projected), listed(names, projected, open, before)};
      std::erase_if(moves, [](const std::string& one) { return one.empty(); });
      warn_of_nearest(fmt::format("{}", fmt::join(moves, ", ")));
    } catch (const NumericalError&) {
      notes.push_back(fmt::format("warning: `start`: what is given leaves no solution of the constraints ({})", why));
    }
    return start.state;
  }
  const std::string moves = listed_moves(names, start, found.projected);
  if (!moves.empty() && (!is_whole || is_beyond_rounding(system, start.state, found.projected))) warn_of_nearest(moves);
  std::vector<int> solved;
  std::ranges::copy_if(open, std::back_inserter(solved), [&](int k) { return found.projected[k] != start.state[k]; });
  if (solved.empty()) return found.start;
  const bool is_another = std::ranges::any_of(solved, [&](int k) { return before[k] != 0; });
  notes.push_back(fmt::format("{}start: from the constraints {}",
                              is_another && is_beyond_rounding(system, before, found.projected) ? "warning: " : "",
                              listed(names, found.projected, solved, before)));
  return found.start;
}

}  // namespace gp2
