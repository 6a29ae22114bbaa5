#include <algorithm>
#include <cmath>
#include <numeric>

#include "gp2/error.hpp"
#include "gp2/posterior.hpp"

namespace gp2 {

using Eigen::ArrayXXd;
using Eigen::Index;
using Eigen::MatrixXd;

namespace {

// of the states that were observed on the prior's own system, evenly taken
MatrixXd some_observed_states(const Posterior& posterior, Index most) {
  Index n = 0;
  for (const Observations& group : posterior.observations()) n += group.view().other_system ? 0 : group.n_data();
  MatrixXd all(posterior.prior().system->state_names().size(), n);
  Index first = 0;
  for (const Observations& group : posterior.observations()) {
    if (group.view().other_system) continue;
    all.middleCols(first, group.n_data()) = group.states();
    first += group.n_data();
  }
  std::vector<Index> taken(static_cast<std::size_t>(std::min(n, most)));
  for (std::size_t k = 0; k < taken.size(); ++k) taken[k] = static_cast<Index>(k) * n / std::ssize(taken);
  return all(Eigen::all, taken);
}

// Sums over components, whose mixture has the moments m = Σ m_k/n and s² = Σ (s_k² + m_k²)/n − m².
struct Moments {
  ArrayXXd mean, square;
  double n = 1;

  [[nodiscard]] Moments with(const Moments& one) const { return {mean + one.mean, square + one.square, n + one.n}; }
  [[nodiscard]] ArrayXXd stddev() const { return (square / n - (mean / n).square()).max(0).sqrt(); }
  // what a constraint decides has no deviation, and no say
  [[nodiscard]] double error(const Moments& of) const {
    const ArrayXXd s = of.stddev();
    const ArrayXXd squares = (mean / n - of.mean / of.n).square() + (stddev() - s).square();
    const double n_decided = static_cast<double>((s == 0).count()), n_all = static_cast<double>(s.size());
    return std::sqrt((s == 0).select(0, squares / s.square()).sum() / std::max(1.0, n_all - n_decided));
  }
};

}  // namespace

std::vector<int> Posterior::fewest_components(double largest_error) const {
  if (!(largest_error > 0)) throw InputError("Posterior::fewest_components: the error must be above 0");
  constexpr Index most_states = 300;
  const MatrixXd states = some_observed_states(*this, most_states);
  const View view = View::constrained_acceleration(*prior().system);
  std::vector<Moments> components;
  for (int k = 0; k < n_components(); ++k) {
    const Marginal one = component(k).marginal(view, states);
    components.push_back({one.mean, one.stddev().array().square() + one.mean.array().square()});
  }
  const Moments none{ArrayXXd::Zero(view.size(), states.cols()), ArrayXXd::Zero(view.size(), states.cols()), 0};
  const Moments all = std::accumulate(components.begin(), components.end(), none,
                                      [](const Moments& sum, const Moments& one) { return sum.with(one); });
  std::vector<int> chosen, left(components.size());
  std::iota(left.begin(), left.end(), 0);
  Moments sum = none;
  do {
    const auto best = std::min_element(left.begin(), left.end(), [&](int a, int b) {
      return sum.with(components[static_cast<std::size_t>(a)]).error(all) <
             sum.with(components[static_cast<std::size_t>(b)]).error(all);
    });
    sum = sum.with(components[static_cast<std::size_t>(*best)]);
    chosen.push_back(*best);
    left.erase(best);
  } while (!left.empty() && sum.error(all) > largest_error);
  std::sort(chosen.begin(), chosen.end());
  return chosen;
}

}  // namespace gp2
