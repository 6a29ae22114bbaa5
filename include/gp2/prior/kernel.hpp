#pragma once

#include <span>
#include <string>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"

namespace gp2 GP2_API {

/// A scalar covariance function of D features, a sum of products of these, with Δ_d = φ_d − φ'_d and r² = Σ_d (Δ_d/ℓ_d)²:
///
///     se        exp(−½ r²)
///     matern32  (1 + √3 r) exp(−√3 r)
///     matern52  (1 + √5 r + 5/3 r²) exp(−√5 r)
///     rq        (1 + r²/(2α))^(−α)
///     periodic  exp(−2 Σ_d sin²(π Δ_d/p_d)/ℓ_d²)
///     linear    Σ_d φ_d φ'_d/ℓ_d²
///     constant  1
///
/// The first term of a sum has amplitude 1 (the latent's signal standard deviation scales the whole); term k ≥ 2 is multiplied by
/// w_k², its amplitude relative to the first. All parameters are positive. Parentheses are multiplied out: of (se + linear)*periodic
/// the terms are se*periodic and linear*periodic, with one and the same periodic. Sources: Rasmussen & Williams 2006, ch. 4.
class Kernel {
 public:
  enum class Primitive { se, matern32, matern52, rq, periodic, linear, constant };
  enum class ParameterKind {
    lengthscale,           // ℓ_d, in the unit of feature d
    periodic_lengthscale,  // ℓ_d of `periodic`, dimensionless
    period,                // p_d, in the unit of feature d
    shape,                 // α
    amplitude,             // w_k
  };

  struct Parameter {
    ParameterKind kind;
    int feature;       // d, of a lengthscale or period; else −1
    std::string name;  // "lengthscale(q1)", "periodic.lengthscale(q1)" where the kernel has several factors, "linear.amplitude"
  };

  Kernel() = default;

  /// @param text      sums and products of the names above, in parentheses where wanted: "se", "(se + linear)*periodic"
  /// @param features  the D feature names, for the names of the parameters
  /// @throws InputError naming what was found, where, and the kernels there are.
  static Kernel parse(std::string_view text, std::span<const std::string> features);

  [[nodiscard]] const std::string& text() const { return text_; }
  [[nodiscard]] int n_features() const { return n_features_; }
  [[nodiscard]] const std::vector<Parameter>& parameters() const { return parameters_; }

  /// The sum of products it is.
  struct Factor {
    Primitive primitive;
    int first_parameter;  // index of ℓ_1; periods or α follow the lengthscales
    int first_column;     // of its D, where the features are scaled for each factor (constant has none)
  };
  struct Term {
    int amplitude;  // index of w_k, −1 for the first term
    std::vector<Factor> factors;
  };
  [[nodiscard]] const std::vector<Term>& terms() const { return terms_; }
  [[nodiscard]] int n_scaled_columns() const { return n_scaled_columns_; }

  /// k(φ_i, φ'_j) between two sets of points.
  ///
  /// @param left    (n × D), one row per point
  /// @param right   (m × D)
  /// @param values  parameters, in the order of parameters()
  /// @returns (n × m)
  /// @throws InputError when the points are not of D features, or there is not one value for each parameter.
  [[nodiscard]] Eigen::MatrixXd evaluate(const Eigen::Ref<const Eigen::MatrixXd>& left,
                                         const Eigen::Ref<const Eigen::MatrixXd>& right,
                                         const Eigen::Ref<const Eigen::VectorXd>& values) const;

 private:
  std::string text_;
  int n_features_ = 0;
  int n_scaled_columns_ = 0;
  std::vector<Term> terms_;
  std::vector<Parameter> parameters_;
};

}  // namespace gp2
