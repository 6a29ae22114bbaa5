#pragma once

#include <atomic>
#include <vector>

#include <Eigen/Core>

namespace gp2 {

/// K = L Lᵀ of a positive definite matrix to which rows are added and from which rows are taken, and z = L⁻¹y of one right-hand
/// side. L stands in a larger matrix, so that most additions need no new memory; what lies outside L is undefined.
class GrowingCholesky {
 public:
  GrowingCholesky() = default;
  /// Room for a K of n rows, to be written to lower(), and for max(64, n/8) more.
  explicit GrowingCholesky(Eigen::Index n);
  GrowingCholesky(const GrowingCholesky& other);
  GrowingCholesky(GrowingCholesky&&) noexcept = default;
  GrowingCholesky& operator=(GrowingCholesky&&) noexcept = default;
  GrowingCholesky& operator=(const GrowingCholesky&) = delete;
  ~GrowingCholesky() = default;

  [[nodiscard]] Eigen::Index size() const { return size_; }  // n
  [[nodiscard]] Eigen::Index capacity() const { return memory_.rows(); }
  [[nodiscard]] Eigen::Block<const Eigen::MatrixXd> L() const { return memory_.topLeftCorner(size_, size_); }  // lower triangle
  [[nodiscard]] Eigen::Block<Eigen::MatrixXd> lower() { return memory_.topLeftCorner(size_, size_); }
  [[nodiscard]] const Eigen::VectorXd& z() const { return z_; }  // (n)
  [[nodiscard]] Eigen::VectorXd solve() const;                   // K⁻¹y = L⁻ᵀz

  [[nodiscard]] double log_det_half() const { return L().diagonal().array().log().sum(); }  // ½ log|K|

  /// For a K of n rows, to be written to lower(), without room for more. What stood here is lost; memory of that size is used
  /// again.
  void resize(Eigen::Index n);

  /// From K in the lower triangle of lower() to L and z = L⁻¹y; false where K is not positive definite.
  /// @param stop  set: gives up, and is false
  [[nodiscard]] bool factorise(const Eigen::Ref<const Eigen::VectorXd>& y, const std::atomic<bool>* stop = nullptr);

  /// The lower triangle of K⁻¹, in the place of L, which is lost.
  /// @param stop  set: gives up, and what stands there is neither
  [[nodiscard]] Eigen::Block<const Eigen::MatrixXd> invert(const std::atomic<bool>* stop = nullptr);

  /// L and z of [K k; kᵀ κ] and [y; υ], in O(n² m) operations. False, and nothing has changed, where that is not positive
  /// definite.
  ///
  /// @param k      (n × m)
  /// @param kappa  κ, in the lower triangle (m × m)
  /// @param more   υ (m)
  [[nodiscard]] bool append(Eigen::MatrixXd k, Eigen::MatrixXd kappa, const Eigen::Ref<const Eigen::VectorXd>& more);

  /// L and z of K and y without some rows and columns, by plane rotations: in (n − r)² multiplications and additions for row r,
  /// each column of L read and written once. Orthogonal, so as stable as a factorisation anew.
  /// @param rows  rising
  void erase(const std::vector<Eigen::Index>& rows);

 private:
  void reserve(Eigen::Index n);

  Eigen::MatrixXd memory_;  // (capacity × capacity)
  Eigen::VectorXd z_;
  Eigen::Index size_ = 0;
};

}  // namespace gp2
