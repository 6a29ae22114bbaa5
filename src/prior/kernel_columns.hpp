#pragma once

#include <vector>

#include <Eigen/Core>

#include "gp2/prior/kernel.hpp"

namespace gp2 {

struct FactorColumn;

/// A kernel between n points and one more at a time: a column of its matrix. The features of the points stand scaled by the
/// kernel's lengthscales and periods, and padded with zeros to whole vectors (simd.hpp).
class KernelColumns {
 public:
  /// @param features  (n × D), one row per point
  KernelColumns(Kernel kernel, const Eigen::Ref<const Eigen::MatrixXd>& features);
  KernelColumns(Kernel kernel, const Eigen::Ref<const Eigen::MatrixXd>& features,
                const Eigen::Ref<const Eigen::VectorXd>& values);

  /// Scales the points anew. Needed before anything below.
  /// @param values  parameters, in the order of kernel.parameters()
  void set_parameters(const Eigen::Ref<const Eigen::VectorXd>& values);

  /// More points, behind the others.
  /// @param features  (m × D)
  void append(const Eigen::Ref<const Eigen::MatrixXd>& features);
  /// Takes points away; those behind them move up.
  /// @param points  rising
  void erase(const std::vector<Eigen::Index>& points);

  [[nodiscard]] const Kernel& kernel() const { return kernel_; }
  [[nodiscard]] const Eigen::MatrixXd& features() const { return features_; }  // of the points, as given (n_rows × D)
  [[nodiscard]] const Eigen::VectorXd& values() const { return values_; }
  [[nodiscard]] Eigen::Index n_points() const { return n_points_; }
  [[nodiscard]] Eigen::Index n_rows() const { return scaled_.rows(); }  // n, padded

  /// The scaled features of a point, for each factor of the kernel: what the functions below call `point`. Size n_scaled().
  [[nodiscard]] Eigen::Index n_scaled() const { return scaled_.cols(); }
  void scale(const Eigen::Ref<const Eigen::VectorXd>& features, Eigen::VectorXd& point) const;
  void scale(Eigen::Index fixed_point, Eigen::VectorXd& point) const;
  [[nodiscard]] const Eigen::MatrixXd& scaled() const { return scaled_; }  // of the fixed points (n_rows × n_scaled)
  /// What a feature is multiplied by there, of each column (n_scaled()).
  [[nodiscard]] const Eigen::VectorXd& scales() const { return scales_; }
  [[nodiscard]] bool is_squared_exponential() const { return is_squared_exponential_; }
  /// What the product of a term's factors is multiplied by.
  [[nodiscard]] double amplitude(const Kernel::Term& term) const;

  /// Memory of the functions below; one per thread.
  struct Workspace {
    std::vector<double> columns;
  };

  /// out_i = k(φ_(first + i), φ'), i = 0 … n − 1
  /// @param first, n  whole vectors, within n_rows(); rows that pad the points get numbers without a meaning
  void evaluate(Eigen::Index first, Eigen::Index n, const Eigen::VectorXd& point, double* out, Workspace& workspace) const;

  /// k(φ', φ')
  [[nodiscard]] double variance(const Eigen::VectorXd& point) const;

  /// Adds Σ_i w_i ∂k(φ_(first + i), φ')/∂log v_p to the sum of column p of `sums` (lanes × parameters).
  /// @param k  what evaluate gives for the same arguments
  void add_gradient(Eigen::Index first, Eigen::Index n, const Eigen::VectorXd& point, const double* k, const double* w,
                    Eigen::MatrixXd& sums, Workspace& workspace) const;

  /// Σ_i w_i ∂k(φ_(first + i), φ')/∂φ'_d for every feature d (D), and for several columns of weights.
  /// @param W       (n × m) with leading dimension ldw; rows that pad the points are zero
  /// @param out     (D × m)
  void differentiate(Eigen::Index first, Eigen::Index n, const Eigen::VectorXd& point, const double* k, const double* W,
                     Eigen::Index ldw, Eigen::Index m, double* out, Workspace& workspace) const;

 private:
  [[nodiscard]] FactorColumn column_of(const Kernel::Factor& factor, Eigen::Index first, Eigen::Index n,
                                       const Eigen::VectorXd& point) const;
  double* columns(Workspace& workspace, Eigen::Index n) const;
  // the values of a term's factors into columns 2, 3, … of the memory
  void evaluate_factors(const Kernel::Term& term, Eigen::Index first, Eigen::Index n, const Eigen::VectorXd& point,
                        const double* k, double* memory) const;
  // w and, by the product rule, all of a term but its factor f, into column 0 of that memory
  void weigh(const Kernel::Term& term, std::size_t f, Eigen::Index n, const double* w, double* memory) const;

  Kernel kernel_;
  Eigen::MatrixXd features_;  // (n_rows × D)
  Eigen::MatrixXd scaled_;    // (n_rows × columns)
  Eigen::VectorXd scales_;    // of each column of scaled_
  Eigen::VectorXd values_;
  Eigen::Index n_points_ = 0;
  Eigen::Index max_factors_ = 1;  // of a term
  bool is_squared_exponential_ = false;
};

}  // namespace gp2
