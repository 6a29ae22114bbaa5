#pragma once

#include <vector>

#include <Eigen/Core>

#include "inference/gram.hpp"
#include "prior/gradient_columns.hpp"
#include "prior/kernel_columns.hpp"

namespace gp2 {

/// A latent that the view of a predictor needs.
struct PredictorTerm {
  std::size_t latent = 0;
  KernelColumns kernel;           // k between the samples and a state
  Eigen::MatrixXd C;              // loading (p × F)
  bool is_potential = false;      // its functions are a gradient: GradientColumns in the place of k
  Eigen::VectorXd variance = {};  // of each function of a potential (F)

  [[nodiscard]] Eigen::Index size() const { return C.rows(); }         // p
  [[nodiscard]] Eigen::Index n_functions() const { return C.cols(); }  // F
};

/// What a predictor knows of the latents at the N samples of a posterior, stored as T, double or float, and the sums over the
/// samples that predictions at one state need. Rows are padded to whole vectors (simd.hpp).
template <typename T>
class PredictorData {
 public:
  using Matrix = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic>;
  using Vector = Eigen::Matrix<T, Eigen::Dynamic, 1>;

  /// Memory of the sums: they allocate nothing.
  struct Memory {
    Matrix k;         // k_a (n_rows × terms)
    Vector point;     // of se: as LatentData::points (D)
    Vector sums;      // of any few columns
    Vector products;  // (n_rows)
    Vector loading;   // (F)
    Matrix rows;      // where there are sums: cov of each row of a sample with · (rows × columns)
    Matrix cross;     // cov(basis variables, ·), whitened in place by a factor (basis variables, padded × columns)

    Eigen::VectorXd explained;    // a row of X c (rows of the view)
    Eigen::VectorXd k_in_double;  // of a kernel that is no se
    KernelColumns::Workspace kernel;
    std::vector<GradientColumns::Workspace> gradients;  // per term: of potentials
    Eigen::VectorXd loading_of_gradient;                // (the largest D of these)
  };

  /// @param stddev  whether subtract_explained is wanted
  void store(const LatentPosterior& posterior, const std::vector<PredictorTerm>& terms, bool stddev);
  /// @param n_rows  of the view
  [[nodiscard]] Memory make_memory(const std::vector<PredictorTerm>& terms, Eigen::Index n_rows, bool stddev) const;

  /// C g of term a at a scaled point (p), g = Σ_j k_j β_j the posterior mean of its functions. Keeps k for the functions below.
  void evaluate_signal(const PredictorTerm& term, std::size_t a, const Eigen::VectorXd& point, Memory& memory,
                       Eigen::VectorXd& signal) const;

  /// d(C g)/dφ of term a (D × p).
  void differentiate_signal(const PredictorTerm& term, std::size_t a, const Eigen::VectorXd& point, Memory& memory,
                            Eigen::MatrixXd& dsignal) const;

  /// covariance_rs −= (X c_r)ᵀ(X c_s) for s ≤ r, c_r the covariance of ỹ with row r of the view.
  /// @param loadings  ℓ, per term (F × rows of the view)
  void subtract_explained(const std::vector<PredictorTerm>& terms, const std::vector<Eigen::MatrixXd>& loadings, Memory& memory,
                          Eigen::MatrixXd& covariance) const;

 private:
  struct LatentData {
    Matrix points;                  // of se: scaled features, less their centre (n_rows × D)
    Eigen::VectorXd centre;         // (D)
    Matrix weights;                 // β Cᵀ (n_rows × p)
    Eigen::MatrixXd exact_weights;  // of another kernel: the same in double precision, where T is single; of a potential
    Matrix Z;                       // as in LatentPosterior (n_rows × components·F)
  };

  static void reserve_gradient(const PredictorTerm& term, Memory& memory);
  void store_triangle(const LatentPosterior& posterior);
  void whiten(Eigen::Index i, const T* row, Memory& memory) const;
  void evaluate_kernel(const PredictorTerm& term, std::size_t a, const Eigen::VectorXd& point, Memory& memory, T* k) const;
  void move_point(const LatentData& data, const Eigen::VectorXd& point, Memory& memory) const;
  void add_products(const PredictorTerm& term, std::size_t a, std::size_t component, Eigen::Index first, Eigen::Index n,
                    const T* loading, Memory& memory) const;
  void scatter(std::size_t component, Eigen::Index column, Memory& memory) const;
  void sum_up(Memory& memory) const;
  void write_cross_of_rows(const std::vector<PredictorTerm>& terms, const std::vector<Eigen::MatrixXd>& loadings,
                           Memory& memory) const;
  void write_cross_of_functions(const std::vector<PredictorTerm>& terms, Memory& memory) const;

  std::vector<LatentData> latents_;                // per term
  std::vector<std::vector<Eigen::Index>> row_of_;  // [component][sample], as in LatentPosterior
  Eigen::SparseMatrix<T, Eigen::RowMajor> sums_;   // D, as in LatentPosterior; empty: there are none
  Eigen::Index n_samples_ = 0, reduced_size_ = 0;
  bool whitens_by_factor_ = false;
  std::vector<T>
      triangle_;  // of LatentPosterior, row by row, each padded with zeros to whole vectors; of a factor 1/L_ii for L_ii
};

extern template class PredictorData<double>;
extern template class PredictorData<float>;

}  // namespace gp2
