#pragma once

#include <optional>
#include <string>
#include <vector>

#include <fmt/format.h>
#include <Eigen/Core>

namespace gp2 {

/// Functions of all states at once must give each its own values: not one array for all, nor those of its neighbours. Single
/// precision is precise enough.
/// @param evaluate  of some states, one column each, the values by quantity
/// @param terms     of each quantity, how large terms are that may cancel in it; empty: 0
template <typename Evaluate>
std::optional<std::string> mixed_states_text(const std::string& what, const Evaluate& evaluate,
                                             const Eigen::Ref<const Eigen::MatrixXd>& states,
                                             const std::vector<double>& terms = {}) {
  if (states.cols() < 2) return std::nullopt;
  constexpr Eigen::Index enough = 50;
  const Eigen::Index stride = (states.cols() + enough - 1) / enough;
  const Eigen::MatrixXd some = states(Eigen::all, Eigen::seq(0, states.cols() - 1, stride));
  const auto largest = [](const Eigen::MatrixXd& values) {
    return values.size() == 0 ? 0 : values.array().isFinite().select(values.array().abs(), 0).maxCoeff();
  };
  const std::vector<Eigen::MatrixXd> together = evaluate(some);
  for (const Eigen::Index i : {Eigen::Index{0}, some.cols() / 2, some.cols() - 1}) {
    const std::vector<Eigen::MatrixXd> alone = evaluate(some.col(i));
    for (std::size_t k = 0; k < alone.size(); ++k) {
      const auto a = alone[k].col(0).array(), b = together[k].col(i).array();
      constexpr double rounding = 1e-5;
      const double size = largest(together[k]) + (terms.empty() ? 0 : terms[k]);
      if ((a == b || (a - b).abs() <= rounding * size || (a.isNaN() && b.isNaN())).all()) continue;
      return fmt::format(
          "{} of one state differ between a call with it alone and a call with several: the function mixes rows, or "
          "returns the same array each time (copy it)",
          what);
    }
  }
  return std::nullopt;
}

}  // namespace gp2
