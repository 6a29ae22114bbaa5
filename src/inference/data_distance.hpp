#pragma once

#include <vector>

#include <Eigen/Core>

#include "inference/posterior_implementation.hpp"

namespace gp2 {

/// How far a state lies from the observed ones (theory.md, T30): min_j D(x, x_j), of coordinates z in which every latent of the view
/// weighs what its features can change,
///
///     D²(x, x') = |z − z'|² = Σ_a v_a Σ_terms w² Σ_factors r²(φ_a, φ'_a),
///
/// in units of what D is between an observed state and other ones observed at other times.
class DataDistance {
 public:
  DataDistance() = default;
  DataDistance(const Posterior::Implementation& posterior, const View& view);

  /// z of one state (n_coordinates).
  /// @param features_of  latent ↦ φ_a there (D_a)
  template <typename FeaturesOf>
  void write_coordinates(const FeaturesOf& features_of, Eigen::Ref<Eigen::VectorXd> z) const {
    for (std::size_t c = 0; c < coordinates_.size(); ++c)
      z[static_cast<Eigen::Index>(c)] = coordinates_[c].of(features_of(coordinates_[c].latent));
  }
  [[nodiscard]] Eigen::Index n_coordinates() const { return std::ssize(coordinates_); }

  /// As Posterior::distance_from_data.
  [[nodiscard]] double at(const Eigen::Ref<const Eigen::VectorXd>& z) const;

 private:
  struct Coordinate {
    std::size_t latent;
    Eigen::Index feature;
    double weight;
    double frequency;  // of a periodic one [rad per unit of the feature], else 0
    double phase;
    [[nodiscard]] double of(const Eigen::Ref<const Eigen::VectorXd>& features) const;
  };
  void add_coordinates(std::size_t latent, const Kernel& kernel, const Eigen::VectorXd& values, double variance);
  /// @param n_of_group  observed states of each Observations, one after the other
  void set_unit(const std::vector<Eigen::Index>& n_of_group);
  // the smallest |z − z_j|² above a number, over the observed states but those from `first` to before `last`; allocates nothing
  [[nodiscard]] double smallest(const Eigen::Ref<const Eigen::VectorXd>& z, Eigen::Index first, Eigen::Index last,
                                double above) const;

  std::vector<Coordinate> coordinates_;
  Eigen::MatrixXd observed_;  // z of the observed states, group after group, padded (simd.hpp)  (N × coordinates)
  Eigen::Index n_observed_ = 0;
  double unit_ = 0;
};

}  // namespace gp2
