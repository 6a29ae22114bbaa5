#pragma once

#include <vector>

#include <Eigen/Core>

namespace gp2 {

/// X, a lower triangle with XᵀX = K⁻¹, of a positive definite matrix K to which rows are added and from which rows are taken. It is
/// L⁻¹ of K = L Lᵀ until rows are taken, and an orthogonal matrix times that from then on: |X c| is the same. It stands row by row,
/// each padded with zeros to whole vectors (simd.hpp).
class InverseRoot {
 public:
  [[nodiscard]] Eigen::Index size() const { return size_; }  // n
  [[nodiscard]] const double* row(Eigen::Index i) const { return numbers_.data() + begin_of(i); }
  [[nodiscard]] const std::vector<double>& numbers() const { return numbers_; }

  /// Of a K with more rows behind the others: in O(n²) operations for each.
  /// @param L  of all rows, in the lower triangle
  void append(const Eigen::Ref<const Eigen::MatrixXd>& L);

  /// Of K without some rows and columns, by plane rotations: in O(n²) operations for each. Orthogonal, so as stable as the inverse
  /// computed anew.
  /// @param rows  rising
  void erase(const std::vector<Eigen::Index>& rows);

  /// Where row i begins in numbers(): padded rows of 1, 2, …, i numbers stand before it.
  [[nodiscard]] static Eigen::Index begin_of(Eigen::Index i);

 private:
  void erase(Eigen::Index r);

  Eigen::Index size_ = 0;
  std::vector<double> numbers_;
};

}  // namespace gp2
