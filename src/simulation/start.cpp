#include <algorithm>
#include <functional>
#include <iterator>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"
#include "gp2/simulate.hpp"

namespace gp2 {

namespace {

// "q3 = 0.097, dq3 = -0.04"
std::string listed(const std::vector<std::string>& names, const Eigen::VectorXd& state, const std::vector<int>& entries) {
  std::vector<std::string> parts;
  for (const int k : entries) parts.push_back(fmt::format("{} = {:.6g}", names[static_cast<std::size_t>(k)], state[k]));
  return fmt::format("{}", fmt::join(parts, ", "));
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
  std::optional<Eigen::VectorXd> state;
  std::string why;
  const auto try_from = [&](double aside) {
    Eigen::VectorXd from = start.state;
    for (const int k : open) from[k] += k < system.nq() ? aside : 0;
    try {
      const Eigen::VectorXd found = project_onto_constraints(system, parameters, from, start.given);
      if (!state || (found - start.state).norm() < (*state - start.state).norm()) state = found;
    } catch (const NumericalError& error) {
      if (why.empty()) why = error.what();
    }
  };
  try_from(0);
  // where a constraint has no slope in what is open, as a circle at its highest point, Newton's method leaves other starts
  const bool is_of_velocities =
      std::any_of(start.given.begin() + system.nq(), start.given.begin() + 2 * system.nq(), std::identity());
  if (!state && !is_of_velocities) {
    for (const double aside : {0.3, 1.0, -1.0}) try_from(aside);
  }
  if (!state) {
    notes.push_back(fmt::format("`start`: what is given leaves no solution of the constraints ({})", why));
    return start.state;
  }
  std::vector<int> solved;
  std::copy_if(open.begin(), open.end(), std::back_inserter(solved), [&](int k) { return (*state)[k] != start.state[k]; });
  if (!solved.empty()) notes.push_back(fmt::format("start: from the constraints {}", listed(names, *state, solved)));
  return *state;
}

}  // namespace gp2
