#include <algorithm>
#include <cmath>
#include <numeric>

#include "data/evenly.hpp"
#include "gp2/error.hpp"
#include "gp2/posterior.hpp"

namespace gp2 {

using Eigen::ArrayXXd;
using Eigen::Index;
using Eigen::MatrixXd;

namespace {

// of the states that were observed, evenly taken
MatrixXd some_observed_states(const Posterior& posterior, Index most) {
  const Index n = n_states(posterior.observations());
  MatrixXd all(posterior.prior().system->state_names().size(), n);
  Index first = 0;
  for (const Observations& group : posterior.observations()) {
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
};

// One for each component, about the mean of the first: variances of means that differ little would be rounding of their squares.
std::vector<Moments> moments_of_components(const Posterior& posterior, const View& view, const MatrixXd& states) {
  const ArrayXXd origin = posterior.component(0).mean(view, states);
  std::vector<Moments> components;
  for (int k = 0; k < posterior.n_components(); ++k) {
    const Posterior::Marginal one = posterior.component(k).marginal(view, states);
    const ArrayXXd mean = one.mean.array() - origin;
    components.push_back({mean, one.stddev().array().square() + mean.square()});
  }
  return components;
}

// How far the mixture of few components is from that of all, where that one has a deviation.
class Distance {
 public:
  // @param prior  its deviations, by whose size those of rounding are told
  Distance(const Moments& all, const ArrayXXd& prior) : mean_(all.mean / all.n), stddev_(all.stddev()) {
    // Where a constraint decides a value its deviation is rounding beside those of other values; where data say all, a variance is
    // rounding of the prior's.
    constexpr double of_largest = 1e-10, of_own = 1e-8;
    const double largest = prior.size() > 0 ? prior.maxCoeff() : 0;
    is_uncertain_ = stddev_ > (of_own * prior).max(of_largest * largest);
  }
  [[nodiscard]] double to(const Moments& few) const {
    const ArrayXXd squares = (few.mean / few.n - mean_).square() + (few.stddev() - stddev_).square();
    const double n = std::max(1.0, static_cast<double>(is_uncertain_.count()));
    return std::sqrt(is_uncertain_.select(squares / stddev_.square(), 0).sum() / n);
  }

 private:
  ArrayXXd mean_, stddev_;
  Eigen::Array<bool, Eigen::Dynamic, Eigen::Dynamic> is_uncertain_;
};

}  // namespace

std::vector<int> Posterior::fewest_components(double largest_error, const std::optional<View>& view) const {
  if (!(largest_error > 0)) throw InputError("fewest_components: the largest error must be above 0");
  constexpr Index most_states = 300;
  const MatrixXd states = some_observed_states(*this, most_states);
  const View at = view ? *view : View::constrained_acceleration(*prior().system);
  const std::vector<Moments> components = moments_of_components(*this, at, states);
  const Moments none{ArrayXXd::Zero(at.size(), states.cols()), ArrayXXd::Zero(at.size(), states.cols()), 0};
  const Moments all = std::accumulate(components.begin(), components.end(), none,
                                      [](const Moments& sum, const Moments& one) { return sum.with(one); });
  const Distance distance(all, without_data().marginal(at, states).stddev().array());
  std::vector<int> chosen, left(components.size());
  std::iota(left.begin(), left.end(), 0);
  Moments sum = none;
  do {
    const auto best = std::min_element(left.begin(), left.end(), [&](int a, int b) {
      return distance.to(sum.with(components[static_cast<std::size_t>(a)])) <
             distance.to(sum.with(components[static_cast<std::size_t>(b)]));
    });
    sum = sum.with(components[static_cast<std::size_t>(*best)]);
    chosen.push_back(*best);
    left.erase(best);
  } while (!left.empty() && distance.to(sum) > largest_error);
  std::sort(chosen.begin(), chosen.end());
  return chosen;
}

}  // namespace gp2
