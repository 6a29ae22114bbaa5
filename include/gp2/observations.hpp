#pragma once

#include <memory>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/base/statistics.hpp"
#include "gp2/export.hpp"
#include "gp2/view.hpp"

namespace gp2 GP2_API {

/// A matrix that its copies share until one of them is changed: many rows stand in memory once, whoever holds them.
class SharedMatrix {
 public:
  SharedMatrix() = default;
  explicit SharedMatrix(Eigen::MatrixXd matrix) : matrix_(std::make_shared<Eigen::MatrixXd>(std::move(matrix))) {}

  [[nodiscard]] const Eigen::MatrixXd& get() const;
  /// Its own from now on.
  [[nodiscard]] Eigen::MatrixXd& change();

 private:
  std::shared_ptr<Eigen::MatrixXd> matrix_;  // null: empty
};

/// Noise of N measurements of d values each: ε_i ~ N(0, diag(σ_i²)),  σ_ki = σ_k s_ki. Each row of values has one σ_k, and s = 1,
/// or each value has a scale s_ki of its own. What belongs to one state alone is a column of a matrix, so that rows of data are
/// taken, appended and removed alike for every kind of noise.
class Noise {
 public:
  /// @param stddev        σ  (d), > 0; the starting value where it is estimated
  /// @param is_estimated  whether a fit estimates σ
  /// @param scale         s  (d × N), > 0; of no meaning where a value is not measured. Empty: s = 1
  explicit Noise(Eigen::VectorXd stddev, bool is_estimated = false, Eigen::MatrixXd scale = {});

  [[nodiscard]] const Eigen::VectorXd& stddev() const { return stddev_; }
  [[nodiscard]] bool is_estimated() const { return is_estimated_; }
  [[nodiscard]] const Eigen::MatrixXd& scale() const { return scale_.get(); }
  [[nodiscard]] bool has_scale() const { return scale().size() > 0; }

  /// σ_i (d) of state i under a σ that may differ from stddev(), as an estimate does.
  [[nodiscard]] Eigen::VectorXd at(const Eigen::Ref<const Eigen::VectorXd>& stddev, Eigen::Index i) const;
  /// σ_ki of n states (d × n), n = N where there is a scale.
  [[nodiscard]] Eigen::MatrixXd of_values(const Eigen::Ref<const Eigen::VectorXd>& stddev, Eigen::Index n) const;

  /// The noise of these states, in this order.
  [[nodiscard]] Noise take(const std::vector<int>& states) const;
  [[nodiscard]] Noise slice(int first, int n) const;
  void append(const Noise& more);
  void remove_first(int n);

  /// @throws InputError when stddev() is not of one positive finite number for each row of `values`; when there is a scale and
  /// it is not as large as `values`, or not positive and finite where they are measured.
  void require_noise_of(const Eigen::MatrixXd& values) const;

 private:
  Eigen::VectorXd stddev_;
  bool is_estimated_;
  SharedMatrix scale_;
};

/// A measured sum of one entry of a view over states that stand one after the other (theory.md, T36):
///
///     z_r = Σ_i w_i v_k(x_{first + i}) + σ_k Σ_j L_rj ξ_j,   ξ_j ~ N(0, 1), one for each sum.
struct WeightedSum {
  int row = 0;              // k: of the view
  int first = 0;            // state
  Eigen::VectorXd weights;  // w
  double value = 0;         // z
  Eigen::VectorXd
      noise;  // row r of L, a lower triangle, as far as it is not zero: its last entry, > 0, belongs to the sum itself
};

/// N noisy measurements of one view: y_i = G(x_i) ā(x_i) + d(x_i) + ε_i.
///
/// They may have sums. Then these are what is learned from, and the values are only what they say about single states: what
/// hyperparameters start from, and what is shown.
class Observations {
 public:
  /// @param states  x_i  (layout size × N)
  /// @param view    what was measured, d rows
  /// @param values  y_i  (d × N); NaN: not measured
  /// @param noise   of ε_i
  /// @throws InputError when the sizes do not fit each other, a value is infinite, or as Noise::require_noise_of.
  Observations(Eigen::MatrixXd states, View view, Eigen::MatrixXd values, Noise noise);
  Observations(Eigen::MatrixXd states, View view, Eigen::MatrixXd values, Eigen::VectorXd noise_stddev,
               bool estimate_noise = false, Eigen::MatrixXd noise_scale = {});

  [[nodiscard]] const Eigen::MatrixXd& states() const { return states_.get(); }
  [[nodiscard]] const View& view() const { return view_; }
  [[nodiscard]] const Eigen::MatrixXd& values() const { return values_.get(); }
  [[nodiscard]] const Noise& noise() const { return noise_; }
  [[nodiscard]] const std::vector<WeightedSum>& sums() const { return sums_; }
  [[nodiscard]] bool has_sums() const { return !sums_.empty(); }
  [[nodiscard]] int n_data() const { return static_cast<int>(states().cols()); }

  /// The same with as many other states. @throws InputError as the constructor.
  [[nodiscard]] Observations with_states(Eigen::MatrixXd states) const;
  /// The same with another view, other values, another noise, and without sums. @throws InputError as the constructor.
  [[nodiscard]] Observations with_view(View view) const { return {states_, std::move(view), values_, noise_}; }
  [[nodiscard]] Observations with_values(Eigen::MatrixXd values) const {
    return {states_, view_, SharedMatrix(std::move(values)), noise_};
  }
  [[nodiscard]] Observations with_noise(Noise noise) const { return {states_, view_, values_, std::move(noise)}; }
  /// The same with these sums.
  /// @throws InputError when one is of rows or states that there are not, has numbers that are not finite, a last entry of L that is
  /// not positive, or noise in common with a sum of another row.
  [[nodiscard]] Observations with_sums(std::vector<WeightedSum> sums) const;
  /// @throws InputError where there are some.
  void require_no_sums() const;

  /// These states, in this order. @throws InputError where there are sums, as append() and remove_first() do.
  [[nodiscard]] Observations take(const std::vector<int>& states) const;
  /// n states from the first on. @throws as take().
  [[nodiscard]] Observations slice(int first, int n) const;
  /// Adds the states of `more` behind one's own; its view and σ are taken to be the same.
  /// @throws InputError when one has a noise of each value and the other has not.
  void append(const Observations& more);
  void remove_first(int n);

  /// σ_i (d) at state i under a noise σ that may differ from noise().stddev(); ∞ where nothing is measured.
  /// @throws InputError as the functions below; when there is no such state or row, or σ is not of d numbers.
  [[nodiscard]] Eigen::VectorXd noise_at(const Eigen::Ref<const Eigen::VectorXd>& stddev, Eigen::Index i) const;
  /// The same of all states (d × N).
  [[nodiscard]] Eigen::MatrixXd noise_of_values(const Eigen::Ref<const Eigen::VectorXd>& stddev) const;
  /// Whether the values of row k came with standard deviations of their own, of which σ_k is a factor. A robust fit enlarges some
  /// scales and leaves the others at 1 where they did not.
  [[nodiscard]] bool states_noise(Eigen::Index k) const;
  /// s of the values of row k that are measured; 1 where none have one.
  [[nodiscard]] std::vector<double> measured_scales(Eigen::Index k) const;
  /// The noise of a usual value (d): σ times the median of s over the measured values of its row.
  [[nodiscard]] Eigen::VectorXd usual_noise(const Eigen::Ref<const Eigen::VectorXd>& stddev) const;

 private:
  Observations(SharedMatrix states, View view, SharedMatrix values, Noise noise);

  SharedMatrix states_;
  View view_;
  SharedMatrix values_;
  Noise noise_;
  std::vector<WeightedSum> sums_;
};

}  // namespace gp2
