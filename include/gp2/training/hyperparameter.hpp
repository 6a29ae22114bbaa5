#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/inference/likelihood.hpp"

namespace gp2 GP2_API {

/// The optimiser's coordinate x of a value v: v = origin + unit·x, or v = exp x.
struct CoordinateMap {
  bool is_logarithm = true;
  double origin = 0, unit = 1;  // of v = origin + unit·x

  [[nodiscard]] double coordinate(double value) const;
  [[nodiscard]] double value(double x) const;
  [[nodiscard]] double value_slope(double value) const;      // dv/dx
  [[nodiscard]] double logarithm_slope(double value) const;  // d log v/dx
};

/// A hyper-prior of a value v, standard normal in z: −log of its density, without constants, is added to the objective. It is ½ z²,
/// or that of all z of a family together, any two of which have the same correlation ρ: what the data say of one is then expected
/// of its siblings.
struct HyperPrior {
  enum class Form {
    none,
    normal,      // z = (v − median)/stddev
    log_normal,  // z = log(v/median)/stddev
  };
  Form form = Form::none;
  double median = 0;
  double stddev = 0;        // of v, or of log v
  std::string family = {};  // empty: of its own
  double correlation = 0;   // ρ in [0, 1), the same throughout the family

  /// z
  [[nodiscard]] double standardised(double value) const;
  /// dz/dx in the map's coordinate
  [[nodiscard]] double standardised_slope(double value, const CoordinateMap& map) const;
};

/// One number that training adjusts, in physical units: a place in ModelValues, a map to the optimiser's coordinate, bounds, and
/// a hyper-prior. What depends on its kind is asked of it.
struct Hyperparameter {
  enum class Kind {
    kernel,                // parameter `index` of the kernel of latent `owner`
    signal_stddev,         // s_index of latent `owner`
    shared_signal_stddev,  // one factor for all s of latent `owner`, times `column_scale`
    loading,               // entry `index` of the free loading C of latent `owner`, column by column
    noise_stddev,          // σ_index of Observations `owner`
    parameter,             // θ_index of the system
  };

  Kind kind = Kind::kernel;
  int owner = 0;
  int index = 0;
  Eigen::VectorXd column_scale;  // of a shared signal standard deviation: the unit of each s
  std::string name;
  std::string unit;
  double value = 0;  // where the first restart starts; the fitted value in a FitReport
  double lower = 0, upper = 0;
  /// Positive by nature: optimised as its logarithm. Else it is optimised in widths of its box, from `lower` on, or in units of
  /// its `size`; one that is held in units of its value.
  bool positive = true;
  /// Typical size, where the bounds are no more than limits: random starts are drawn about it, and no scan crosses the box. 0:
  /// the box tells.
  double size = 0;
  HyperPrior hyperprior;
  /// A signal standard deviation of which `share` × this value is a factor, beside that of its latent.
  struct Follower {
    int latent = 0, column = 0;
    double share = 0;
  };
  std::vector<Follower> followers;

  /// A hyperparameter of no name and value: positive unless of the system's parameters or a loading.
  static Hyperparameter of(Kind kind, std::size_t owner, std::size_t index);

  /// Within 1e-6 of a bound, on the scale it is optimised on, and within 1e-3 of the bound's own size; not where it is held.
  [[nodiscard]] bool at_bound() const;
  /// Holds it at its value; its unit stays.
  void hold();
  /// Held at its value by a fit: its bounds leave it no room.
  [[nodiscard]] bool is_fixed() const { return lower == upper; }
  [[nodiscard]] bool is_system_parameter() const { return kind == Kind::parameter; }
  /// Entries of a loading enter by C Cᵀ: where all of one latent's that may be negative are 0, so is their gradient.
  [[nodiscard]] bool is_stationary_at_zero() const { return kind == Kind::loading && !positive; }

  // Its place in the model, whose signal standard deviations are 1 before.
  void write(ModelValues& values) const;
  void ask_for_gradient(Likelihood::Options& options) const;

  // The optimiser's coordinate.
  [[nodiscard]] CoordinateMap map() const;
  [[nodiscard]] double coordinate() const { return map().coordinate(value); }
  [[nodiscard]] double lower_coordinate() const { return map().coordinate(lower); }
  [[nodiscard]] double upper_coordinate() const { return map().coordinate(upper); }
  /// The value at a coordinate, within the bounds.
  [[nodiscard]] double value_at(double x) const;

  // The objective in that coordinate.
  /// ∂NLL/∂x, given the gradient of the negative log likelihood at its value.
  [[nodiscard]] double likelihood_slope(const ModelGradient& gradient) const;
};

/// @throws InputError when hyperparameters are not of this prior and these observations, one stands twice, a value is not finite or,
/// where it is positive by nature, not positive, or bounds are not in order.
void require_hyperparameters(const Prior& prior, const std::vector<Observations>& observations,
                             const std::vector<Hyperparameter>& hyperparameters);

/// The values that `hyperparameters` stand for; what they leave out keeps the model's value.
/// @throws InputError as require_hyperparameters, but for bounds and hyper-priors, which it does not read.
ModelValues model_values(const Prior& prior, const std::vector<Observations>& observations,
                         const std::vector<Hyperparameter>& hyperparameters);

}  // namespace gp2
