#include "jobs/acting_states.hpp"

#include <algorithm>

#include <fmt/format.h>

#include "gp2/view.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

ActingStates::ActingStates(const Prior& prior) {
  for (const Latent& latent : prior.latents) {
    names_.push_back(latent.name);
    directions_.push_back(latent.direction);
    are_of_coordinates_.push_back(std::ranges::any_of(prior.system->coordinates(), [&](const Coordinate& one) {
      return latent.direction == one.acceleration() || latent.direction == "force_" + one.name;
    }));
    acts_.push_back(!latent.directions);
  }
  moves_ = acts_;
}

void ActingStates::count(const Prior& prior, const MatrixXd& states, const VectorXd& parameters) {
  n_states_ += states.cols();
  constexpr Index piece = 1000;      // states, of which the first tell as a rule
  constexpr double rounding = 1e-9;  // of what is projected; coordinates may be in m and in mm
  const View view = View::constrained_acceleration(*prior.system);
  for (Index from = 0; from < states.cols() && std::ranges::count(moves_, false) > 0; from += piece) {
    const MatrixXd some = states.middleCols(from, std::min(piece, states.cols() - from));
    const auto fault = for_each_mechanics(prior, view, some, parameters, [&](Index first, const MechanicsBatch& block) {
      const int n = block.values.n_states();
      const PriorValues values = evaluate_prior(prior, some.middleCols(first, n), parameters, block);
      for (std::size_t a = 0; a < acts_.size(); ++a) {
        for (int i = 0; i < n && !moves_[a]; ++i) {
          const auto E = values.E(a, i);
          acts_[a] = acts_[a] || values.fault || !E.isZero(0);
          moves_[a] = values.fault || (block.projections[static_cast<std::size_t>(i)].T() * E).norm() > rounding * E.norm();
        }
      }
    });
    // others tell
    if (fault) moves_.assign(moves_.size(), true);
    if (fault) acts_ = moves_;
  }
}

std::vector<std::string> ActingStates::idle_texts(bool accelerations) const {
  std::vector<std::string> warnings;
  for (std::size_t a = 0; a < acts_.size() && n_states_ > 0; ++a) {
    const std::string direction = directions_[a].empty() ? "" : fmt::format(", {},", directions_[a]);
    // a constraint takes up the directions of some coordinates wherever it holds them
    bool is_needless = false;
    for (std::size_t k = 0; k < names_.size() && are_of_coordinates_[a]; ++k)
      is_needless = is_needless || (moves_[k] && names_[k] == names_[a]);
    if (acts_[a] && !moves_[a] && accelerations && !is_needless) {
      warnings.push_back(
          fmt::format("latent '{}'{} acts along the constraints, which take it up, at all of {} states: accelerations "
                      "tell nothing of it; check the signs of its directions",
                      names_[a], direction, n_states_));
    }
    if (acts_[a]) continue;
    warnings.push_back(fmt::format(
        "latent '{}'{} acts at 0 of {} states: its direction is 0, and nothing is learned of it; check the sign of its "
        "load, or the condition under which it acts",
        names_[a], direction, n_states_));
  }
  return warnings;
}

}  // namespace gp2
