#include "inference/predictor_data.hpp"

#include <algorithm>
#include <type_traits>

#include "base/simd.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

template <typename T>
const simd::Loops<T>& loops() {
  if constexpr (std::is_same_v<T, double>) {
    return simd::target().loops;
  } else {
    return simd::target().loops_single;
  }
}

// `rows` in another precision, padded with zeros to n_rows
template <typename T>
typename PredictorData<T>::Matrix stored(const Ref<const MatrixXd>& rows, Index n_rows) {
  typename PredictorData<T>::Matrix out = PredictorData<T>::Matrix::Zero(n_rows, rows.cols());
  const Index n = std::min(n_rows, rows.rows());
  out.topRows(n) = rows.topRows(n).template cast<T>();
  return out;
}

Index n_functions(const std::vector<PredictorTerm>& terms) {
  Index sum = 0;
  for (const PredictorTerm& term : terms) sum += term.n_functions();
  return sum;
}

}  // namespace

template <typename T>
void PredictorData<T>::store(const LatentPosterior& posterior, const std::vector<PredictorTerm>& terms, bool stddev) {
  row_of_ = posterior.row_of();
  n_samples_ = posterior.latents().empty() ? 0 : posterior.latents().front().kernel.n_points();
  reduced_size_ = posterior.size();
  if (posterior.sums() != nullptr) sums_ = posterior.sums()->D.cast<T>();
  for (const PredictorTerm& term : terms) {
    const LatentPosterior::Basis& from = posterior.latents()[term.latent];
    const Index n = from.kernel.n_points(), n_rows = simd::padded<T>(n);
    LatentData& latent = latents_.emplace_back();
    const MatrixXd weights = from.beta * term.C.transpose();
    if (term.is_potential) {
      latent.exact_weights = weights;
    } else if (term.kernel.is_squared_exponential()) {
      MatrixXd points = term.kernel.scaled().topRows(n);
      latent.centre = VectorXd::Zero(points.cols());
      if (std::is_same_v<T, float> && n > 0) latent.centre = points.colwise().mean();
      points.rowwise() -= latent.centre.transpose();
      latent.points = stored<T>(points, n_rows);
    } else if (std::is_same_v<T, float>) {
      latent.exact_weights = weights;
    }
    if (!term.is_potential) latent.weights = stored<T>(weights.topRows(n), n_rows);
    if (stddev) latent.Z = stored<T>(from.Z.topRows(n), n_rows);
  }
  if (stddev) store_triangle(posterior);
}

template <typename T>
void PredictorData<T>::store_triangle(const LatentPosterior& posterior) {
  constexpr Index block = 64;  // rows
  whitens_by_factor_ = posterior.whitens_by_factor();
  for (Index first = 0; first < posterior.size(); first += block) {
    const MatrixXd rows = posterior.triangle_rows(first, std::min(block, posterior.size() - first));
    for (Index i = 0; i < rows.rows(); ++i) {
      const Index n = first + i + 1;
      const std::size_t begin = triangle_.size();
      triangle_.resize(begin + static_cast<std::size_t>(simd::padded<T>(n)));
      for (Index j = 0; j < n; ++j) triangle_[begin + static_cast<std::size_t>(j)] = static_cast<T>(rows(i, j));
    }
  }
}

template <typename T>
typename PredictorData<T>::Memory PredictorData<T>::make_memory(const std::vector<PredictorTerm>& terms, Index n_rows,
                                                                bool stddev) const {
  Memory memory;
  const Index n_padded = simd::padded<T>(n_samples_);
  Index widest = 1;  // of columns summed at once
  for (const PredictorTerm& term : terms) {
    const Index D = term.kernel.features().cols(), p = term.size();
    memory.point.setZero(std::max(memory.point.size(), D));
    widest = std::max({widest, D * p, p, term.n_functions()});
    memory.gradients.emplace_back();
    if (term.is_potential) {
      reserve_gradient(term, memory);
      continue;
    }
    if (term.kernel.is_squared_exponential()) continue;
    // once, so that the kernel's own memory is there
    const Index n = term.kernel.n_rows();
    VectorXd k(n), gradient(D * p);
    const VectorXd point = VectorXd::Zero(term.kernel.n_scaled());
    const MatrixXd weights = MatrixXd::Zero(n, p);
    term.kernel.evaluate(0, n, point, k.data(), memory.kernel);
    term.kernel.differentiate(0, n, point, k.data(), weights.data(), n, p, gradient.data(), memory.kernel);
    memory.k_in_double.setZero(n);
  }
  const Index n_columns = std::min(n_rows, n_functions(terms));
  memory.k.setZero(n_padded, static_cast<Index>(terms.size()));
  memory.sums.setZero(std::max(widest, n_columns));
  memory.loading.setZero(widest);
  if (stddev) {
    memory.products.setZero(n_padded);
    memory.explained.setZero(n_rows);
    memory.cross.setZero(simd::padded<T>(reduced_size_), n_columns);
    memory.rows.setZero(sums_.cols(), n_columns);
  }
  return memory;
}

// calls everything once, so that the memory is there
template <typename T>
void PredictorData<T>::reserve_gradient(const PredictorTerm& term, Memory& memory) {
  const GradientColumns columns(term.kernel);
  const Index D = term.size(), n = term.kernel.n_rows();
  if (memory.loading_of_gradient.size() < D) memory.loading_of_gradient.setZero(D);
  VectorXd sums = VectorXd::Zero(D);
  MatrixXd derivative = MatrixXd::Zero(D, D);
  const VectorXd point = VectorXd::Zero(term.kernel.n_scaled());
  const MatrixXd weights = MatrixXd::Zero(n, D);
  GradientColumns::Workspace& w = memory.gradients.back();
  columns.evaluate(0, n, point, w);
  columns.add_sums(weights, sums, w);
  columns.add_derivative(weights, derivative, w);
  columns.multiply(sums, w);
}

template <typename T>
void PredictorData<T>::move_point(const LatentData& data, const VectorXd& point, Memory& memory) const {
  for (Index d = 0; d < point.size(); ++d) memory.point[d] = static_cast<T>(point[d] - data.centre[d]);
}

// k between the samples and a state
template <typename T>
void PredictorData<T>::evaluate_kernel(const PredictorTerm& term, std::size_t a, const VectorXd& point, Memory& memory,
                                       T* k) const {
  const LatentData& data = latents_[a];
  if (term.kernel.is_squared_exponential()) {
    move_point(data, point, memory);
    loops<T>().squared_exponential(data.points.rows(), point.size(), data.points.data(), data.points.rows(), memory.point.data(),
                                   k);
    return;
  }
  const Index n = term.kernel.n_rows();
  if constexpr (std::is_same_v<T, double>) {
    term.kernel.evaluate(0, n, point, k, memory.kernel);
  } else {
    term.kernel.evaluate(0, n, point, memory.k_in_double.data(), memory.kernel);
    for (Index j = 0; j < n; ++j) k[j] = static_cast<T>(memory.k_in_double[j]);
  }
}

template <typename T>
void PredictorData<T>::evaluate_signal(const PredictorTerm& term, std::size_t a, const VectorXd& point, Memory& memory,
                                       VectorXd& signal) const {
  if (term.is_potential) {
    GradientColumns::Workspace& w = memory.gradients[a];
    const GradientColumns columns(term.kernel);
    columns.evaluate(0, term.kernel.n_rows(), point, w);
    signal.setZero();
    columns.add_sums(latents_[a].exact_weights, signal, w);
    return;
  }
  T* const k = memory.k.col(static_cast<Index>(a)).data();
  evaluate_kernel(term, a, point, memory, k);
  const Matrix& weights = latents_[a].weights;
  loops<T>().weighted_sums(weights.rows(), term.size(), k, weights.data(), weights.rows(), memory.sums.data());
  for (Index l = 0; l < term.size(); ++l) signal[l] = static_cast<double>(memory.sums[l]);
}

template <typename T>
void PredictorData<T>::differentiate_signal(const PredictorTerm& term, std::size_t a, const VectorXd& point, Memory& memory,
                                            MatrixXd& dsignal) const {
  const LatentData& data = latents_[a];
  if (term.is_potential) {
    dsignal.setZero();
    GradientColumns(term.kernel).add_derivative(data.exact_weights, dsignal, memory.gradients[a]);
    return;
  }
  const T* const k = memory.k.col(static_cast<Index>(a)).data();
  const Index D = dsignal.rows(), p = dsignal.cols(), n = data.weights.rows();
  if (term.kernel.is_squared_exponential()) {
    move_point(data, point, memory);
    loops<T>().difference_products(n, D, p, k, data.weights.data(), n, data.points.data(), n, memory.point.data(),
                                   memory.sums.data());
    // dk/dφ_d = k Δ_d/ℓ_d of scaled differences
    for (Index l = 0; l < p; ++l) {
      for (Index d = 0; d < D; ++d) dsignal(d, l) = static_cast<double>(memory.sums[l * D + d]) / term.kernel.values()[d];
    }
    return;
  }
  const Index n_rows = term.kernel.n_rows();
  if constexpr (std::is_same_v<T, double>) {
    term.kernel.differentiate(0, n_rows, point, k, data.weights.data(), n, p, dsignal.data(), memory.kernel);
  } else {
    double* const exact = memory.k_in_double.data();
    term.kernel.evaluate(0, n_rows, point, exact, memory.kernel);
    term.kernel.differentiate(0, n_rows, point, exact, data.exact_weights.data(), n_rows, p, dsignal.data(), memory.kernel);
  }
}

// memory.products += k_a Σ_f Z_f loading_f, n functions of a latent from the first
template <typename T>
void PredictorData<T>::add_products(const PredictorTerm& term, std::size_t a, std::size_t component, Index first, Index n,
                                    const T* loading, Memory& memory) const {
  const Matrix& Z = latents_[a].Z;
  if (term.is_potential) {
    GradientColumns::Workspace& w = memory.gradients[a];
    auto all = memory.loading_of_gradient.head(term.n_functions());
    all.setZero();
    for (Index f = 0; f < n; ++f) all[first + f] = static_cast<double>(loading[f]);
    GradientColumns(term.kernel).multiply(all, w);
    const Index n_points = term.kernel.n_points();
    for (Index f = 0; f < all.size(); ++f) {
      memory.products.head(n_points).array() += Z.col(static_cast<Index>(component) * all.size() + f).head(n_points).array() *
                                                w.out.col(f).head(n_points).template cast<T>();
    }
    return;
  }
  loops<T>().add_scaled_products(Z.rows(), n, memory.k.col(static_cast<Index>(a)).data(),
                                 Z.col(static_cast<Index>(component) * term.n_functions() + first).data(), Z.rows(), loading,
                                 memory.products.data());
}

// memory.products, one component of each sample, to its rows
template <typename T>
void PredictorData<T>::scatter(std::size_t component, Index column, Memory& memory) const {
  const std::vector<Index>& rows = row_of_[component];
  T* const to = (sums_.size() > 0 ? memory.rows : memory.cross).col(column).data();
  for (std::size_t j = 0; j < rows.size(); ++j) {
    if (rows[j] >= 0) to[rows[j]] = memory.products[static_cast<Index>(j)];
  }
}

template <typename T>
void PredictorData<T>::sum_up(Memory& memory) const {
  for (Index column = 0; column < memory.rows.cols(); ++column) {
    for (Index r = 0; r < sums_.rows(); ++r) {
      T sum = 0;
      for (typename Eigen::SparseMatrix<T, Eigen::RowMajor>::InnerIterator entry(sums_, r); entry; ++entry) {
        sum += entry.value() * memory.rows(entry.col(), column);
      }
      memory.cross(r, column) = sum;
    }
  }
}

template <typename T>
void PredictorData<T>::write_cross_of_functions(const std::vector<PredictorTerm>& terms, Memory& memory) const {
  const T one = 1;
  for (std::size_t c = 0; c < row_of_.size(); ++c) {
    Index column = 0;
    for (std::size_t a = 0; a < terms.size(); ++a) {
      for (Index f = 0; f < terms[a].n_functions(); ++f) {
        memory.products.setZero();
        add_products(terms[a], a, c, f, 1, &one, memory);
        scatter(c, column++, memory);
      }
    }
  }
}

template <typename T>
void PredictorData<T>::write_cross_of_rows(const std::vector<PredictorTerm>& terms, const std::vector<MatrixXd>& loadings,
                                           Memory& memory) const {
  for (std::size_t c = 0; c < row_of_.size(); ++c) {
    for (Index r = 0; r < memory.cross.cols(); ++r) {
      memory.products.setZero();
      for (std::size_t a = 0; a < terms.size(); ++a) {
        const Index n = terms[a].n_functions();
        for (Index f = 0; f < n; ++f) memory.loading[f] = static_cast<T>(loadings[a](f, r));
        add_products(terms[a], a, c, 0, n, memory.loading.data(), memory);
      }
      scatter(c, r, memory);
    }
  }
}

// Entry i of what is whitened, to memory.sums, of each column of `cross`; row i of the triangle.
template <typename T>
void PredictorData<T>::whiten(Index i, const T* row, Memory& memory) const {
  const Index n_columns = memory.cross.cols();
  if (!whitens_by_factor_) {
    loops<T>().weighted_sums(simd::padded<T>(i + 1), n_columns, row, memory.cross.data(), memory.cross.rows(),
                             memory.sums.data());
    return;
  }
  // whole vectors of entries before it, then those that were found just now
  const Index before = i - i % simd::lanes<T>;
  loops<T>().weighted_sums(before, n_columns, row, memory.cross.data(), memory.cross.rows(), memory.sums.data());
  for (Index column = 0; column < n_columns; ++column) {
    T* const v = memory.cross.col(column).data();
    T rest = v[i] - memory.sums[column];
    for (Index j = before; j < i; ++j) rest -= row[j] * v[j];
    memory.sums[column] = v[i] = rest * row[i];
  }
}

template <typename T>
void PredictorData<T>::subtract_explained(const std::vector<PredictorTerm>& terms, const std::vector<MatrixXd>& loadings,
                                          Memory& memory, MatrixXd& covariance) const {
  const Index d = covariance.rows();
  // the covariance is with each latent function where those are fewer than the rows of the view
  const bool by_function = n_functions(terms) < d;
  if (by_function) {
    write_cross_of_functions(terms, memory);
  } else {
    write_cross_of_rows(terms, loadings, memory);
  }
  if (sums_.size() > 0) sum_up(memory);
  // an entry of X c for row r of the view, from that of each column of `cross`
  const auto entry = [&](Index r) {
    if (!by_function) return static_cast<double>(memory.sums[r]);
    double sum = 0;
    Index column = 0;
    for (const MatrixXd& loading : loadings) {
      for (Index f = 0; f < loading.rows(); ++f) sum += loading(f, r) * static_cast<double>(memory.sums[column++]);
    }
    return sum;
  };
  const T* row = triangle_.data();
  for (Index i = 0; i < reduced_size_; ++i) {
    whiten(i, row, memory);
    row += simd::padded<T>(i + 1);
    for (Index r = 0; r < d; ++r) {
      memory.explained[r] = entry(r);
      for (Index s = 0; s <= r; ++s) covariance(r, s) -= memory.explained[r] * memory.explained[s];
    }
  }
}

template class PredictorData<double>;
template class PredictorData<float>;

}  // namespace gp2
