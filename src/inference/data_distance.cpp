#include "inference/data_distance.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <numeric>

#include "base/not_a_number.hpp"
#include "base/simd.hpp"
#include "data/evenly.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Ref;
using Eigen::VectorXd;
using Primitive = Kernel::Primitive;

double DataDistance::smallest(const Ref<const VectorXd>& z, Index first, Index last, double above) const {
  constexpr Index block = 64 * simd::lanes<double>;
  std::array<double, block> squares;
  double nearest = std::numeric_limits<double>::infinity();
  for (Index begin = 0; begin < n_observed_; begin += block) {
    const Index n_rows = std::min(block, observed_.rows() - begin), n = std::min(block, n_observed_ - begin);
    simd::loops().squared_distance(n_rows, z.size(), observed_.data() + begin, observed_.rows(), z.data(), squares.data());
    for (Index i = 0; i < n; ++i) {
      const double square = squares[static_cast<std::size_t>(i)];
      if ((begin + i < first || begin + i >= last) && square > above) nearest = std::min(nearest, square);
    }
  }
  return nearest;
}

double DataDistance::Coordinate::of(const Ref<const VectorXd>& features) const {
  const double phi = features[feature];
  return weight * (frequency > 0 ? std::cos(frequency * phi - phase) : phi);
}

DataDistance::DataDistance(const Posterior::Implementation& posterior, const View& view) {
  const Prior& prior = posterior.prior;
  const Index n_states = gp2::n_states(posterior.observations);
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    if (!view.has_latent(a)) continue;
    // of what is observed, in units of the noise
    const double variance = n_states == 0 ? 1 : posterior.latents->squared_weight(a) / static_cast<double>(n_states);
    add_coordinates(a, prior.latents[a].kernel, posterior.values.kernel[a], variance);
  }
  // of a long log some rows, evenly taken, are as near as all
  constexpr Index most = 5000;
  const Index step = std::max<Index>(1, (n_states + most - 1) / most);
  std::vector<Index> n_of_group;
  for (const Observations& group : posterior.observations) n_of_group.push_back((group.n_data() + step - 1) / step);
  n_observed_ = std::accumulate(n_of_group.begin(), n_of_group.end(), Index{0});
  observed_.setZero(simd::padded(n_observed_), n_coordinates());
  VectorXd z(n_coordinates());
  const auto features = features_by_group(prior, posterior.observations);
  Index i = 0;
  for (std::size_t g = 0; g < features.size() && n_coordinates() > 0; ++g) {
    for (Index k = 0; k < n_of_group[g]; ++k) {
      write_coordinates([&](std::size_t a) { return features[g][a].row(k * step).transpose(); }, z);
      observed_.row(i++) = z.transpose();
    }
  }
  set_unit(n_of_group);
}

void DataDistance::add_coordinates(std::size_t latent, const Kernel& kernel, const VectorXd& values, double variance) {
  for (const Kernel::Term& term : kernel.terms()) {
    const double amplitude = std::sqrt(variance) * (term.amplitude < 0 ? 1 : values[term.amplitude]);
    for (const Kernel::Factor& factor : term.factors) {
      if (factor.primitive == Primitive::constant) continue;
      for (Index d = 0; d < kernel.n_features(); ++d) {
        const double weight = amplitude / values[factor.first_parameter + d];
        if (factor.primitive != Primitive::periodic) {
          coordinates_.push_back({latent, d, weight, 0, 0});
          continue;
        }
        // 4 sin²(πΔ/p) is the squared distance of two points of a circle
        const double frequency = 2 * std::numbers::pi / values[factor.first_parameter + kernel.n_features() + d];
        coordinates_.push_back({latent, d, weight, frequency, 0});
        coordinates_.push_back({latent, d, weight, frequency, std::numbers::pi / 2});
      }
    }
  }
}

// Rows of a log follow each other, so those around a state say nothing of how well its surroundings are known: a tenth of its log,
// half before and half after, is left out; so are states that are the same, as where a grid is measured twice. Nineteen of
// twenty observed states are nearer to the others than a unit.
void DataDistance::set_unit(const std::vector<Index>& n_of_group) {
  constexpr Index most = 1000;  // states that are looked at
  const Index step = std::max<Index>(1, n_observed_ / most);
  std::vector<double> distances;
  Index first = 0;
  for (const Index n : n_of_group) {
    const Index margin = n / 20;
    for (Index k = 0; k < n; k += step) {
      const Index i = first + k;
      const VectorXd z = observed_.row(i).transpose();
      const double nearest = smallest(z, std::max(first, i - margin), std::min(first + n, i + margin + 1), 0);
      if (std::isfinite(nearest)) distances.push_back(std::sqrt(nearest));
    }
    first += n;
  }
  unit_ = not_a_number;
  if (distances.empty()) return;
  const auto at = distances.begin() + static_cast<std::ptrdiff_t>(0.95 * static_cast<double>(distances.size() - 1));
  std::nth_element(distances.begin(), at, distances.end());
  unit_ = *at;
}

double DataDistance::at(const Ref<const VectorXd>& z) const {
  if (z.size() == 0) return 0;
  const double distance = std::sqrt(smallest(z, 0, 0, -1));
  if (distance == 0 || std::isinf(distance)) return distance;
  return distance / unit_;
}

}  // namespace gp2
