#include <algorithm>
#include <cmath>
#include <iterator>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"
#include "gp2/simulate.hpp"
#include "simulation/projection.hpp"

namespace gp2 {

namespace {

// "q3 = 0.097, dq3 = -0.04"
std::string listed(const std::vector<std::string>& names, const Eigen::VectorXd& state, const std::vector<int>& entries) {
  std::vector<std::string> parts;
  for (const int k : entries) parts.push_back(fmt::format("{} = {:.6g}", names[static_cast<std::size_t>(k)], state[k]));
  return fmt::format("{}", fmt::join(parts, ", "));
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

}  // namespace

Eigen::VectorXd complete_start(const Model& model, const Eigen::VectorXd& parameters, StartingPoint start,
                               std::vector<std::string>& notes) {
  const System& system = *model.system;
  const std::vector<std::string> names = system.state_names();
  std::vector<int> open;
  for (int k = 0; k < 2 * system.nq(); ++k) {
    if (start.given[static_cast<std::size_t>(k)]) continue;
    open.push_back(k);
    const auto newton_start = model.newton_start.find(names[static_cast<std::size_t>(k)]);
    // an entry that is known from elsewhere is the better start
    if (newton_start != model.newton_start.end() && start.state[k] == 0) start.state[k] = newton_start->second;
  }
  if (open.empty()) return start.state;
  if (model.symbolic_system() == nullptr && system.nc() > 0 && system.residual_labels().empty()) {
    notes.push_back(
        fmt::format("warning: `start`: {}, as '{}' has no residuals to solve its constraints by: name all "
                    "coordinates and velocities",
                    listed(names, start.state, open), system.name()));
    return start.state;
  }
  // coordinates first, then velocities there: what is given of one level says nothing against a solution of the other
  const Eigen::Index nq = system.nq();
  std::vector<bool> held = start.given;
  std::fill(held.begin() + nq, held.begin() + 2 * nq, false);
  std::optional<Eigen::VectorXd> state;      // on the constraints
  std::optional<Eigen::VectorXd> completed;  // where that is not what is given: with what is given as it is
  std::string why;
  // each is moved by another share of `aside`: equal ones may keep a symmetry that has no slope
  const auto try_from = [&](double aside) {
    Eigen::VectorXd from = start.state;
    for (std::size_t n = 0; n < open.size() && open[n] < nq; ++n) from[open[n]] += aside * std::cos(2.0 * static_cast<double>(n));
    try {
      const Eigen::VectorXd found = project_onto_constraints(system, parameters, from, held);
      const auto distance = [&](const Eigen::VectorXd& one) { return (one - start.state).head(nq).norm(); };
      if (!state || distance(found) < distance(*state)) state = found;
    } catch (const NumericalError& error) {
      if (why.empty()) why = error.what();
    }
  };
  try_from(0);
  // where a constraint has no slope in what is open, as a circle at its highest point, Newton's method leaves other starts
  if (!state) {
    for (const double aside : {0.3, 1.0, -1.0}) try_from(aside);
  }
  if (state) why.clear();
  try {
    if (!state) {
      const Nearest nearest = nearest_to(system, parameters, start, false);
      completed = nearest.start;
      state = nearest.projected;
    }
    state->segment(nq, nq) = start.state.segment(nq, nq);
    const Eigen::VectorXd at = *state;
    held = start.given;
    std::fill(held.begin(), held.begin() + nq, true);
    try {
      state = project_onto_constraints(system, parameters, at, held);
      if (completed) completed->segment(nq, nq) = state->segment(nq, nq);
    } catch (const NumericalError& error) {
      if (why.empty()) why = error.what();
      const Nearest nearest = nearest_to(system, parameters, {at, start.given}, true);
      if (!completed) completed = at;
      completed->segment(nq, nq) = nearest.start.segment(nq, nq);
      state = nearest.projected;
    }
  } catch (const NumericalError& error) {
    if (why.empty()) why = error.what();
    notes.push_back(fmt::format("warning: `start`: what is given leaves no solution of the constraints ({})", why));
    return start.state;
  }
  if (const std::string moves = listed_moves(names, start, *state); !moves.empty()) {
    notes.push_back(
        fmt::format("warning: `start`: what is given leaves no solution of the constraints ({}); the nearest that has one is {}",
                    why, moves));
  }
  std::vector<int> solved;
  std::copy_if(open.begin(), open.end(), std::back_inserter(solved), [&](int k) { return (*state)[k] != start.state[k]; });
  if (!solved.empty()) notes.push_back(fmt::format("start: from the constraints {}", listed(names, *state, solved)));
  return completed.value_or(*state);
}

}  // namespace gp2
