#pragma once

#include <span>
#include <string_view>

#include <Eigen/Core>

#include "base/random.hpp"
#include "gp2/prior/kernel.hpp"

// What each primitive of a kernel is. A new one has its place in Kernel::Primitive and here, and nowhere else.
namespace gp2 {

/// In the order of Kernel::Primitive.
std::span<const std::string_view> primitive_names();

/// What parameters it has, in their order: of those that are of a feature (see Kernel::Parameter) one for each feature.
std::span<const Kernel::ParameterKind> parameter_kinds(Kernel::Primitive primitive);

/// What a feature of it is multiplied by.
/// @param v  its parameters
double feature_scale(Kernel::Primitive primitive, const double* v, Eigen::Index n_features, Eigen::Index d);

/// Adds a draw from the spectral density of one that has one.
/// @param v  its parameters
void add_frequency(Kernel::Primitive primitive, const double* v, RandomStream& random, Eigen::VectorXd& frequency);

/// One factor of a kernel between n points and one more, in scaled features: Δ_d = x_d − p_d.
struct FactorColumn {
  Kernel::Primitive primitive;
  Eigen::Index n, n_features, stride;
  const double* x;       // (n × D)
  const double* p;       // (D)
  const double* values;  // of the factor's parameters

  /// The factor's value, with √3 r or √5 r of a Matérn kernel left in `distance`.
  void evaluate(double* out, double* distance) const;
  /// Adds Σ_i w_i ∂k_i/∂log v for the factor's parameters; column v of `sums` begins at sums + v · lanes.
  void add_gradient(const double* k, const double* w, double* sums, double* scratch) const;
  /// out_d += scale_d Σ_i w_i ∂k_i/∂p_d, p the scaled features of the point.
  void add_point_gradient(const double* k, const double* w, const double* scales, double* out, double* scratch,
                          double* sums) const;

 private:
  [[nodiscard]] double shape() const { return values[n_features]; }  // α of rq
  [[nodiscard]] auto delta(Eigen::Index d) const { return Eigen::Map<const Eigen::ArrayXd>(x + d * stride, n) - p[d]; }
  void squared_distance(double* r2) const;
  // −2 dk/d(r²) of a factor of r² alone and of value k, times w
  void weighted_slope(const double* k, const double* w, double* slope) const;
};

}  // namespace gp2
