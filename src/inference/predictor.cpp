#include "gp2/predictor.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string_view>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "base/simd.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/state_evaluator.hpp"
#include "inference/posterior_implementation.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Quantity = View::Quantity;
using Status = Predictor::Status;

namespace {

template <typename T>
using MatrixOf = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic>;
template <typename T>
using VectorOf = Eigen::Matrix<T, Eigen::Dynamic, 1>;

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
MatrixOf<T> stored(const Ref<const MatrixXd>& rows, Index n_rows) {
  MatrixOf<T> out = MatrixOf<T>::Zero(n_rows, rows.cols());
  const Index n = std::min(n_rows, rows.rows());
  out.topRows(n) = rows.topRows(n).template cast<T>();
  return out;
}

// A latent that the view needs.
struct Term {
  std::size_t latent = 0;
  KernelColumns kernel;  // k between the samples and a state
  MatrixXd C;            // loading (p × F)

  [[nodiscard]] Index size() const { return C.rows(); }         // p
  [[nodiscard]] Index n_functions() const { return C.cols(); }  // F
};

// What is known of the latents at the N samples, in the precision it is stored in. Rows are padded to whole vectors.
template <typename T>
struct Data {
  struct Latent {
    MatrixOf<T> points;      // of se: scaled features, less their centre (n_rows × D)
    VectorXd centre;         // (D)
    MatrixOf<T> weights;     // β Cᵀ (n_rows × p)
    MatrixXd exact_weights;  // of another kernel: the same in double precision, where T is single
    MatrixOf<T> Z;           // as in Posterior::Implementation (n_rows × components·F)
  };
  std::vector<Latent> latents;  // per term
  std::vector<T> inverse;       // X = L⁻¹ row by row, each padded with zeros to whole vectors

  void store(const Posterior::Implementation& posterior, const std::vector<Term>& terms, bool stddev) {
    for (const Term& term : terms) {
      const Posterior::Implementation::LatentAtSamples& from = posterior.latents[term.latent];
      const Index n = static_cast<Index>(posterior.samples.size()), n_rows = simd::padded<T>(n);
      Latent& latent = latents.emplace_back();
      if (term.kernel.is_squared_exponential()) {
        MatrixXd points = term.kernel.scaled().topRows(n);
        latent.centre = VectorXd::Zero(points.cols());
        if (std::is_same_v<T, float> && n > 0) latent.centre = points.colwise().mean();
        points.rowwise() -= latent.centre.transpose();
        latent.points = stored<T>(points, n_rows);
      } else if (std::is_same_v<T, float>) {
        latent.exact_weights = from.beta * from.C.transpose();
      }
      latent.weights = stored<T>((from.beta * from.C.transpose()).topRows(n), n_rows);
      if (stddev) latent.Z = stored<T>(from.Z.topRows(n), n_rows);
    }
    if (stddev) store_inverse(posterior.factor);
  }

  void store_inverse(const GrowingCholesky& factor) {
    const Index n = factor.size();
    std::vector<Index> first{0};  // of each row
    for (Index i = 0; i < n; ++i) first.push_back(first.back() + simd::padded<T>(i + 1));
    inverse.resize(static_cast<std::size_t>(first.back()));
    // L X = I for blocks of columns, which begin with zeros
    constexpr Index block = 64;
    MatrixXd columns;
    for (Index j = 0; j < n; j += block) {
      const Index m = std::min(block, n - j), below = n - j;
      columns = MatrixXd::Identity(below, m);
      lapack::solve_lower(factor.L().bottomRightCorner(below, below), false, columns);
      for (Index i = 0; i < below; ++i) {
        T* const row = inverse.data() + first[static_cast<std::size_t>(j + i)] + j;
        for (Index l = 0; l < std::min(m, i + 1); ++l) row[l] = static_cast<T>(columns(i, l));
      }
    }
  }
};

// Memory of the sums over the samples.
template <typename T>
struct Memory {
  MatrixOf<T> k;         // k_a (n_rows × terms)
  VectorOf<T> point;     // of se: as Data::Latent::points (D)
  VectorOf<T> sums;      // of any few columns
  VectorOf<T> products;  // (n_rows)
  VectorOf<T> loading;   // (F)
  MatrixOf<T> cross;     // cov(ỹ, ·), by row of the factor (reduced size, padded × columns)
};

}  // namespace

struct Predictor::Implementation {
  Prior prior;          // where the view looks
  VectorXd parameters;  // there
  View view;
  Options options;
  std::vector<Term> terms;
  std::vector<std::vector<Index>> row_of;  // [component][sample], as in Posterior::Implementation
  Index reduced_size = 0;
  Index n_all_functions = 0;        // Σ F
  bool has_force = false;           // μ or a direction that is multiplied by M⁻¹
  bool needs_acceleration = false;  // ā itself, which is none where M is singular
  Data<double> in_double;
  Data<float> in_single;

  Implementation(const Posterior::Implementation& posterior, View viewed, Options given);

  // work(data, memory) in the precision of the storage
  template <typename Work>
  void with_data(Workspace::Implementation& w, const Work& work) const;

  Status evaluate(const Ref<const VectorXd>& state, StateEvaluator& at, Workspace::Implementation& w) const;
  void write_mean(const Ref<const VectorXd>& state, const StateEvaluator& at, Workspace::Implementation& w,
                  Ref<VectorXd> mean) const;
  // both; NaN in the mean where the state cannot be evaluated
  Status evaluate_mean(const Ref<const VectorXd>& state, StateEvaluator& at, Workspace::Implementation& w,
                       Ref<VectorXd>& mean) const;
  void write_stddev(const StateEvaluator& at, Workspace::Implementation& w, Ref<VectorXd> stddev) const;
  void write_jacobian(const Ref<const VectorXd>& state, const StateEvaluator& at, Workspace::Implementation& w,
                      Ref<MatrixXd> jacobian) const;

  [[nodiscard]] const Latent& latent(const Term& term) const { return prior.latents[term.latent]; }
  // whether the view is G ā + d, not G E_a f_a
  [[nodiscard]] bool is_whole() const { return view.latent < 0; }
  [[nodiscard]] bool has_mean_force() const { return is_whole() && prior.mean == Prior::Mean::force; }
  [[nodiscard]] bool is_of_functions() const { return n_all_functions < view.size(); }
  [[nodiscard]] double factor() const { return view.quantity == Quantity::next_velocity ? view.time_step : 1; }
};

struct Predictor::Workspace::Implementation {
  std::shared_ptr<const Predictor::Implementation> predictor;
  std::unique_ptr<StateEvaluator> values, values_and_derivatives;
  UdwadiaKalaba projection;
  UdwadiaKalaba::Workspace refinement;
  KernelColumns::Workspace kernel;
  VectorXd k, gradient;  // of a kernel that is no se: its values (rows), and (D·p)

  struct AtState {
    VectorXd features_tape, directions_tape, dfeatures_tape, ddirections_tape;
    VectorXd features;                // φ (D)
    VectorXd point;                   // scaled
    VectorXd directions;              // B (nq·p), none where B = I
    VectorXd dfeatures, ddirections;  // their derivatives that do not vanish
    VectorXd signal;                  // C g (p)
    MatrixXd dsignal;                 // d(C g)/dφ (D × p)
    MatrixXd E_dsignal;               // B d(C g)/dφ (nq × D)
    MatrixXd loading;                 // ℓ (F × d)
  };
  std::vector<AtState> terms;
  VectorXd a_bar;             // ā
  VectorXd force;             // what is multiplied by M⁻¹ in it …
  VectorXd a_of_force;        // … and the product
  VectorXd a;                 // ddq, or T ā of one latent alone
  VectorXd gap;               // a − ā, then ā − a − a_of_force
  VectorXd of_constraint;     // Aᵀλ = M (a − ā)
  VectorXd lambda;            // λ (nc)
  MatrixXd L;                 // (nq × nc)
  MatrixXd d_a_bar;           // dā, and (nq × layout size)
  MatrixXd d_force;           // what is multiplied by M⁻¹ in it and in da
  MatrixXd d_forced;          // … in da alone
  MatrixXd d_rows;            // db − dA a (nc × layout size)
  MatrixXd d_a;               // da
  MatrixXd d_gap;             // dM (a − ā)
  MatrixXd Gt, M_inverse_Gt;  // Gᵀ (nq × d)
  VectorXd variance;          // (d)
  Memory<double> in_double;
  Memory<float> in_single;

  explicit Implementation(std::shared_ptr<const Predictor::Implementation> owner);
};

template <typename Work>
void Predictor::Implementation::with_data(Workspace::Implementation& w, const Work& work) const {
  if (options.storage == Storage::single_precision) {
    work(in_single, w.in_single);
  } else {
    work(in_double, w.in_double);
  }
}

namespace {

void check_view(const View& view, const Prior& prior) {
  if (view.quantity == Quantity::multipliers) {
    throw InputError("Predictor: multipliers are not predicted; view the constraint force, or use Posterior::mean");
  }
  for (const int row : view.rows) {
    if (row < 0 || row >= prior.system->nq()) {
      throw InputError(fmt::format("Predictor: rows of the view are 0 … {}, got {}", prior.system->nq() - 1, row));
    }
  }
  if (view.latent >= static_cast<int>(prior.latents.size())) {
    throw InputError(fmt::format("Predictor: the prior has {} latents, numbered from 0, got a view of latent {}",
                                 prior.latents.size(), view.latent));
  }
}

template <typename Numbers>
bool is_finite(const Numbers& numbers) {
  // 0·x is 0 of a finite number only
  double sum = 0;
  for (const double number : numbers.reshaped()) sum += 0 * number;
  return sum == 0;
}

constexpr double not_a_number = std::numeric_limits<double>::quiet_NaN();

void check_size(std::string_view what, Index got, Index wanted) {
  if (got != wanted) throw InputError(fmt::format("Predictor: {} is of size {}, got {}", what, wanted, got));
}

}  // namespace

Predictor::Implementation::Implementation(const Posterior::Implementation& posterior, View viewed, Options given)
    : prior(prior_of(posterior.prior, viewed)),
      parameters(parameters_of(viewed, posterior.values.parameters)),
      view(std::move(viewed)),
      options(given),
      row_of(posterior.row_of),
      reduced_size(posterior.factor.size()) {
  check_view(view, prior);
  has_force = has_mean_force();
  needs_acceleration = what_needs_acceleration(prior, view).has_value();
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    if (!is_whole() && static_cast<int>(a) != view.latent) continue;
    terms.push_back({a, posterior.latents[a].kernel, posterior.latents[a].C});
    n_all_functions += terms.back().n_functions();
    has_force = has_force || prior.latents[a].base == Latent::Base::force;
  }
  if (options.storage == Storage::single_precision) {
    in_single.store(posterior, terms, options.stddev);
  } else {
    in_double.store(posterior, terms, options.stddev);
  }
}

Predictor::Workspace::Implementation::Implementation(std::shared_ptr<const Predictor::Implementation> owner)
    : predictor(std::move(owner)) {
  const Predictor::Implementation& self = *predictor;
  const System& system = *self.prior.system;
  const Index nq = system.nq(), nc = system.nc(), n_state = system.layout().size(), d = self.view.size();
  values = system.make_evaluator(self.parameters, false);
  if (self.options.jacobian) values_and_derivatives = system.make_evaluator(self.parameters, true);

  a_bar.setZero(nq);
  force = a_of_force = a = gap = of_constraint = a_bar;
  lambda.setZero(nc);
  L.setZero(nq, nc);
  d_a_bar.setZero(nq, n_state);
  d_force = d_forced = d_a = d_gap = d_a_bar;
  d_rows.setZero(nc, n_state);
  Gt.setZero(nq, d);
  M_inverse_Gt = Gt;
  variance.setZero(d);
  // rows that are all the same, so that the memory for redundant ones is there too
  projection.compute(MatrixXd::Identity(nq, nq), MatrixXd::Ones(nc, nq), VectorXd::Zero(nc));
  projection.constrain(a_bar, a, refinement);

  const Index n_samples = self.row_of.empty() ? 0 : static_cast<Index>(self.row_of.front().size());
  self.with_data(*this, [&]<typename T>(const Data<T>&, Memory<T>& memory) {
    const Index n_rows = simd::padded<T>(n_samples);
    Index widest = 1;  // of columns summed at once
    for (const Term& term : self.terms) {
      const Latent& latent = self.latent(term);
      const Index D = latent.n_features(), p = term.size();
      AtState& at = terms.emplace_back();
      at.features_tape = latent.features.make_workspace(VectorXd());
      at.features.setZero(D);
      at.point.setZero(term.kernel.n_scaled());
      at.signal.setZero(p);
      at.dsignal.setZero(D, p);
      at.E_dsignal.setZero(nq, D);
      at.loading.setZero(term.n_functions(), d);
      if (!latent.directions_are_identity) {
        at.directions_tape = latent.directions.make_workspace(self.parameters);
        at.directions.setZero(nq * p);
      }
      if (self.options.jacobian) {
        at.dfeatures_tape = latent.feature_state_derivatives.tape.make_workspace(VectorXd());
        at.dfeatures.setZero(static_cast<Index>(latent.feature_state_derivatives.entries.size()));
        if (!latent.directions_are_identity) {
          at.ddirections_tape = latent.direction_state_derivatives.tape.make_workspace(self.parameters);
          at.ddirections.setZero(static_cast<Index>(latent.direction_state_derivatives.entries.size()));
        }
      }
      if (!term.kernel.is_squared_exponential()) {
        // once, so that its own memory is there
        k.setZero(term.kernel.n_rows());
        const MatrixXd weights = MatrixXd::Zero(k.size(), p);
        gradient.setZero(std::max(gradient.size(), D * p));
        term.kernel.evaluate(0, k.size(), at.point, k.data(), kernel);
        term.kernel.differentiate(0, k.size(), at.point, k.data(), weights.data(), weights.rows(), p, gradient.data(), kernel);
      }
      if (memory.point.size() < D) memory.point.setZero(D);
      widest = std::max({widest, D * p, term.n_functions()});
    }
    const Index n_columns = std::min(d, self.n_all_functions);
    memory.k.setZero(n_rows, static_cast<Index>(self.terms.size()));
    memory.sums.setZero(std::max(widest, n_columns));
    memory.loading.setZero(widest);
    if (self.options.stddev) {
      memory.products.setZero(n_rows);
      memory.cross.setZero(simd::padded<T>(self.reduced_size), n_columns);
    }
  });
}

namespace {

// k between the samples and a state
template <typename T>
void evaluate_kernel(const Term& term, const typename Data<T>::Latent& data, Predictor::Workspace::Implementation& w,
                     const VectorXd& point, Memory<T>& memory, T* k) {
  if (term.kernel.is_squared_exponential()) {
    const Index D = point.size();
    for (Index d = 0; d < D; ++d) memory.point[d] = static_cast<T>(point[d] - data.centre[d]);
    loops<T>().squared_exponential(data.points.rows(), D, data.points.data(), data.points.rows(), memory.point.data(), k);
    return;
  }
  const Index n = term.kernel.n_rows();
  if constexpr (std::is_same_v<T, double>) {
    term.kernel.evaluate(0, n, point, k, w.kernel);
  } else {
    term.kernel.evaluate(0, n, point, w.k.data(), w.kernel);
    for (Index j = 0; j < n; ++j) k[j] = static_cast<T>(w.k[j]);
  }
}

// d(C g)/dφ (D × p)
template <typename T>
void differentiate_signal(const Term& term, const typename Data<T>::Latent& data, Predictor::Workspace::Implementation& w,
                          const VectorXd& point, Memory<T>& memory, const T* k, MatrixXd& dsignal) {
  const Index D = dsignal.rows(), p = dsignal.cols(), n = data.weights.rows();
  if (term.kernel.is_squared_exponential()) {
    for (Index d = 0; d < D; ++d) memory.point[d] = static_cast<T>(point[d] - data.centre[d]);
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
    term.kernel.differentiate(0, n_rows, point, k, data.weights.data(), n, p, dsignal.data(), w.kernel);
  } else {
    term.kernel.evaluate(0, n_rows, point, w.k.data(), w.kernel);
    term.kernel.differentiate(0, n_rows, point, w.k.data(), data.exact_weights.data(), n_rows, p, dsignal.data(), w.kernel);
  }
}

// B v added to sum, B (nq × p) or the identity
void add_product(const VectorXd& B, const VectorXd& v, VectorXd& sum) {
  const Index nq = sum.size();
  if (B.size() == 0) {
    for (Index i = 0; i < nq; ++i) sum[i] += v[i];
    return;
  }
  for (Index l = 0; l < v.size(); ++l) {
    for (Index i = 0; i < nq; ++i) sum[i] += B[l * nq + i] * v[l];
  }
}

}  // namespace

// M, A, b, F, the projection and ā at a state
Status Predictor::Implementation::evaluate(const Ref<const VectorXd>& state, StateEvaluator& at,
                                           Workspace::Implementation& w) const {
  at.evaluate(state);
  if (!is_finite(at.M()) || !is_finite(at.A()) || !is_finite(at.b())) return Status::not_finite;
  w.projection.compute(at.M(), at.A(), at.b());
  switch (w.projection.mass_kind()) {
    case UdwadiaKalaba::Mass::positive_definite:
      break;
    case UdwadiaKalaba::Mass::singular:
      if (needs_acceleration) return Status::no_unconstrained_acceleration;
      break;
    case UdwadiaKalaba::Mass::undetermined:
      return Status::motion_undetermined;
    case UdwadiaKalaba::Mass::indefinite:
      return Status::mass_not_positive_definite;
  }
  if (w.projection.inconsistency() > MechanicsBatch::consistency_tolerance * w.projection.size_of_b()) {
    return Status::contradicting_constraints;
  }

  w.a_bar.setZero();
  if (is_whole() && prior.mean == Prior::Mean::constant) w.a_bar = prior.constant_mean;
  w.force.setZero();
  if (has_mean_force()) w.force = at.F();
  bool all_features = true;  // are finite; without observations ā does not show it
  with_data(w, [&]<typename T>(const Data<T>& data, Memory<T>& memory) {
    for (std::size_t a = 0; a < terms.size(); ++a) {
      const Term& term = terms[a];
      const Latent& of = latent(term);
      Workspace::Implementation::AtState& here = w.terms[a];
      of.features.evaluate_at(state, here.features_tape, here.features);
      all_features = all_features && is_finite(here.features);
      term.kernel.scale(here.features, here.point);
      T* const k = memory.k.col(static_cast<Index>(a)).data();
      evaluate_kernel<T>(term, data.latents[a], w, here.point, memory, k);
      const MatrixOf<T>& weights = data.latents[a].weights;
      loops<T>().weighted_sums(weights.rows(), term.size(), k, weights.data(), weights.rows(), memory.sums.data());
      for (Index l = 0; l < term.size(); ++l) here.signal[l] = static_cast<double>(memory.sums[l]);
      if (!of.directions_are_identity) of.directions.evaluate_at(state, here.directions_tape, here.directions);
      add_product(here.directions, here.signal, of.base == Latent::Base::force ? w.force : w.a_bar);
    }
  });
  w.a_of_force = w.force;
  if (has_force) {
    w.projection.solve_mass_in_place(w.a_of_force);
    w.a_bar += w.a_of_force;
  }
  return is_finite(w.a_bar) && all_features ? Status::ok : Status::not_finite;
}

void Predictor::Implementation::write_mean(const Ref<const VectorXd>& state, const StateEvaluator& at,
                                           Workspace::Implementation& w, Ref<VectorXd> mean) const {
  const Index nq = w.a_bar.size();
  if (view.quantity == Quantity::unconstrained_acceleration) {
    w.a = w.a_bar;
  } else if (is_whole()) {
    w.projection.constrain(w.a_bar, w.a, w.refinement);
  } else {
    w.a.noalias() = w.projection.T() * w.a_bar;
  }
  w.gap = w.a - w.a_bar;
  if (view.quantity == Quantity::constraint_force || options.jacobian) {
    // where M is singular ā has nothing but a_of_force, of M', and so drops out
    w.of_constraint = -w.force;
    w.of_constraint.noalias() += at.M() * w.gap;
    w.of_constraint.noalias() += at.M() * w.a_of_force;
  }
  for (Index r = 0; r < mean.size(); ++r) {
    const Index row = view.rows[static_cast<std::size_t>(r)];
    if (view.quantity == Quantity::constraint_force) {
      mean[r] = w.of_constraint[row];
    } else {
      mean[r] = factor() * w.a[row];
      if (view.quantity == Quantity::next_velocity && is_whole()) mean[r] += state[nq + row];
    }
  }
}

void Predictor::Implementation::write_stddev(const StateEvaluator& at, Workspace::Implementation& w, Ref<VectorXd> stddev) const {
  const Index nq = w.a_bar.size(), d = view.size();
  // Gᵀ
  const MatrixXd& T = w.projection.T();
  for (Index r = 0; r < d; ++r) {
    const Index row = view.rows[static_cast<std::size_t>(r)];
    switch (view.quantity) {
      case Quantity::unconstrained_acceleration:
        w.Gt.col(r).setZero();
        w.Gt(row, r) = 1;
        break;
      case Quantity::constraint_force:
        for (Index j = 0; j < nq; ++j) {
          double entry = -w.projection.mass()(row, j);
          for (Index i = 0; i < nq; ++i) entry += at.M()(row, i) * T(i, j);
          w.Gt(j, r) = entry;
        }
        break;
      default:
        for (Index j = 0; j < nq; ++j) w.Gt(j, r) = factor() * T(row, j);
    }
  }
  if (has_force) {
    w.M_inverse_Gt = w.Gt;
    w.projection.solve_mass_in_place(w.M_inverse_Gt);
  }

  // ℓ = Cᵀ Bᵀ Gᵀ, or with M⁻¹, and the prior's variance
  w.variance.setZero();
  for (std::size_t a = 0; a < terms.size(); ++a) {
    const Term& term = terms[a];
    Workspace::Implementation::AtState& here = w.terms[a];
    const MatrixXd& Gt = latent(term).base == Latent::Base::force ? w.M_inverse_Gt : w.Gt;
    const double k = term.kernel.variance(here.point);
    for (Index r = 0; r < d; ++r) {
      here.loading.col(r).setZero();
      for (Index l = 0; l < term.size(); ++l) {
        double along = 0;
        if (here.directions.size() == 0) {
          along = Gt(l, r);
        } else {
          for (Index i = 0; i < nq; ++i) along += here.directions[l * nq + i] * Gt(i, r);
        }
        for (Index f = 0; f < term.n_functions(); ++f) here.loading(f, r) += term.C(l, f) * along;
      }
      w.variance[r] += k * here.loading.col(r).squaredNorm();
    }
  }

  with_data(w, [&]<typename Real>(const Data<Real>& data, Memory<Real>& memory) {
    const simd::Loops<Real>& loop = loops<Real>();
    // the covariance of ỹ with each row of the view, or with each latent function where those are fewer
    const Index n_columns = memory.cross.cols();
    const auto add_products = [&](std::size_t a, std::size_t c, const Real* loading, Index first, Index n) {
      const MatrixOf<Real>& Z = data.latents[a].Z;
      loop.add_scaled_products(Z.rows(), n, memory.k.col(static_cast<Index>(a)).data(),
                               Z.col(static_cast<Index>(c) * terms[a].n_functions() + first).data(), Z.rows(), loading,
                               memory.products.data());
    };
    for (std::size_t c = 0; c < row_of.size(); ++c) {
      const auto scatter = [&](Index column) {
        const std::vector<Index>& rows = row_of[c];
        Real* const to = memory.cross.col(column).data();
        for (std::size_t j = 0; j < rows.size(); ++j) {
          if (rows[j] >= 0) to[rows[j]] = memory.products[static_cast<Index>(j)];
        }
      };
      if (is_of_functions()) {
        const Real one = 1;
        Index column = 0;
        for (std::size_t a = 0; a < terms.size(); ++a) {
          for (Index f = 0; f < terms[a].n_functions(); ++f) {
            memory.products.setZero();
            add_products(a, c, &one, f, 1);
            scatter(column++);
          }
        }
        continue;
      }
      for (Index r = 0; r < d; ++r) {
        memory.products.setZero();
        for (std::size_t a = 0; a < terms.size(); ++a) {
          const Index n_functions = terms[a].n_functions();
          for (Index f = 0; f < n_functions; ++f) memory.loading[f] = static_cast<Real>(w.terms[a].loading(f, r));
          add_products(a, c, memory.loading.data(), 0, n_functions);
        }
        scatter(r);
      }
    }

    // |X c|², row by row of X
    const Real* row = data.inverse.data();
    for (Index i = 0; i < reduced_size; ++i) {
      const Index n = simd::padded<Real>(i + 1);
      loop.weighted_sums(n, n_columns, row, memory.cross.data(), memory.cross.rows(), memory.sums.data());
      row += n;
      if (!is_of_functions()) {
        for (Index r = 0; r < d; ++r) w.variance[r] -= static_cast<double>(memory.sums[r]) * static_cast<double>(memory.sums[r]);
        continue;
      }
      for (Index r = 0; r < d; ++r) {
        double sum = 0;
        Index column = 0;
        for (const Workspace::Implementation::AtState& here : w.terms) {
          for (Index f = 0; f < here.loading.rows(); ++f) sum += here.loading(f, r) * static_cast<double>(memory.sums[column++]);
        }
        w.variance[r] -= sum * sum;
      }
    }
  });
  for (Index r = 0; r < d; ++r) stddev[r] = w.variance[r] < 0 ? 0 : std::sqrt(w.variance[r]);
}

// With a = T ā + L b, b = 0 for one latent alone:
//
//     dā = P + M⁻¹(R − dM a_of_force),    P, R: the changes of what stands without and with M⁻¹ in ā
//     da = T (P + M⁻¹(R + dM (ā − a − a_of_force) + dAᵀλ)) + L (db − dA a)
//
// Where M is singular P = 0 and ā = a_of_force: the second line is then M ddq = F̄ + Aᵀλ, differentiated, with T M'⁻¹ and L of M'.
// Derivatives are few: each entry of dM, dA, db, dF is added where it belongs.
void Predictor::Implementation::write_jacobian(const Ref<const VectorXd>& state, const StateEvaluator& at,
                                               Workspace::Implementation& w, Ref<MatrixXd> jacobian) const {
  const Index nq = w.a_bar.size();
  MatrixXd& P = w.d_a_bar;
  MatrixXd& R = w.d_force;
  P.setZero();
  R.setZero();
  with_data(w, [&]<typename T>(const Data<T>& data, Memory<T>& memory) {
    for (std::size_t a = 0; a < terms.size(); ++a) {
      const Term& term = terms[a];
      const Latent& of = latent(term);
      Workspace::Implementation::AtState& here = w.terms[a];
      differentiate_signal<T>(term, data.latents[a], w, here.point, memory, memory.k.col(static_cast<Index>(a)).data(),
                              here.dsignal);
      MatrixXd& sum = of.base == Latent::Base::force ? R : P;
      // B d(C g)/dφ, then along the features
      if (here.directions.size() == 0) {
        here.E_dsignal = here.dsignal.transpose();
      } else {
        here.E_dsignal.noalias() =
            Map<const MatrixXd>(here.directions.data(), nq, term.size()).lazyProduct(here.dsignal.transpose());
      }
      of.feature_state_derivatives.tape.evaluate_at(state, here.dfeatures_tape, here.dfeatures);
      for (std::size_t e = 0; e < of.feature_state_derivatives.entries.size(); ++e) {
        const StateDerivatives::Entry& entry = of.feature_state_derivatives.entries[e];
        const double value = here.dfeatures[static_cast<Index>(e)];
        for (Index i = 0; i < nq; ++i) sum(i, entry.state_index) += here.E_dsignal(i, entry.output) * value;
      }
      // dB C g
      if (of.directions_are_identity) continue;
      of.direction_state_derivatives.tape.evaluate_at(state, here.ddirections_tape, here.ddirections);
      for (std::size_t e = 0; e < of.direction_state_derivatives.entries.size(); ++e) {
        const StateDerivatives::Entry& entry = of.direction_state_derivatives.entries[e];
        sum(entry.output % nq, entry.state_index) += here.ddirections[static_cast<Index>(e)] * here.signal[entry.output / nq];
      }
    }
  });

  const bool is_constrained = view.quantity != Quantity::unconstrained_acceleration;
  if (is_constrained) {
    w.projection.write_L(w.L);
    w.lambda.noalias() = w.L.transpose() * w.of_constraint;
  }
  w.d_forced.setZero();
  w.d_rows.setZero();
  w.d_gap.setZero();
  const auto values = at.derivative_values();
  for (std::size_t e = 0; e < at.derivatives().size(); ++e) {
    const auto [quantity, i, j, k] = at.derivatives()[e];
    const double value = values[static_cast<Index>(e)];
    switch (quantity) {
      case StateEvaluator::Quantity::mass:
        R(i, k) -= value * w.a_of_force[j];
        w.d_gap(i, k) += value * w.gap[j];
        break;
      case StateEvaluator::Quantity::constraint_matrix:
        w.d_forced(j, k) += value * w.lambda[i];
        w.d_rows(i, k) -= value * w.a[j];
        break;
      case StateEvaluator::Quantity::constraint_vector:
        if (is_whole()) w.d_rows(i, k) += value;
        break;
      case StateEvaluator::Quantity::force:
        if (has_mean_force()) R(i, k) += value;
        break;
    }
  }

  if (view.quantity == Quantity::unconstrained_acceleration) {
    w.d_a = R;
    w.projection.solve_mass_in_place(w.d_a);
    w.d_a += P;
    for (Index r = 0; r < jacobian.rows(); ++r) jacobian.row(r) = w.d_a.row(view.rows[static_cast<std::size_t>(r)]);
    return;
  }
  if (view.quantity == Quantity::constraint_force) {
    // M dā
    w.d_a = R;
    w.d_a.noalias() += at.M().lazyProduct(P);
  }
  // da, in the place of P
  R += w.d_forced - w.d_gap;
  w.projection.solve_mass_in_place(R);
  P += R;
  w.d_forced.noalias() = w.projection.T().lazyProduct(P);
  w.d_forced.noalias() += w.L.lazyProduct(w.d_rows);
  const MatrixXd& d_a = w.d_forced;
  if (view.quantity == Quantity::constraint_force) {
    // d(M (a − ā))
    w.d_gap.noalias() += at.M().lazyProduct(d_a);
    w.d_gap -= w.d_a;
    for (Index r = 0; r < jacobian.rows(); ++r) jacobian.row(r) = w.d_gap.row(view.rows[static_cast<std::size_t>(r)]);
    return;
  }
  for (Index r = 0; r < jacobian.rows(); ++r) {
    const Index row = view.rows[static_cast<std::size_t>(r)];
    jacobian.row(r) = factor() * d_a.row(row);
    if (view.quantity == Quantity::next_velocity && is_whole()) jacobian(r, nq + row) += 1;
  }
}

Predictor::Predictor(const Posterior& posterior)
    : Predictor(posterior, View::all(Quantity::constrained_acceleration, *posterior.prior().system)) {}
Predictor::Predictor(const Posterior& posterior, View view) : Predictor(posterior, std::move(view), Options()) {}
Predictor::Predictor(const Posterior& posterior, View view, Options options)
    : implementation_(std::make_shared<const Implementation>(*posterior.implementation_, std::move(view), options)) {}

Predictor::Workspace::Workspace(const Predictor& predictor)
    : implementation_(std::make_unique<Implementation>(predictor.implementation_)) {}
Predictor::Workspace::~Workspace() = default;
Predictor::Workspace::Workspace(Workspace&&) noexcept = default;
Predictor::Workspace& Predictor::Workspace::operator=(Workspace&&) noexcept = default;

Status Predictor::Implementation::evaluate_mean(const Ref<const VectorXd>& state, StateEvaluator& at,
                                                Workspace::Implementation& w, Ref<VectorXd>& mean) const {
  Status status = evaluate(state, at, w);
  if (status == Status::ok) {
    write_mean(state, at, w, mean);
    if (!is_finite(mean)) status = Status::not_finite;
  }
  if (status != Status::ok) mean.setConstant(not_a_number);
  return status;
}

const View& Predictor::view() const { return implementation_->view; }
const Predictor::Options& Predictor::options() const { return implementation_->options; }

namespace {

void check_arguments(const Predictor::Implementation* predictor, const Ref<const VectorXd>& state, const Ref<VectorXd>& mean,
                     const Predictor::Workspace::Implementation* workspace) {
  if (workspace == nullptr || workspace->predictor.get() != predictor) {
    throw InputError("Predictor: the workspace is of another predictor; use make_workspace() of this one");
  }
  check_size("a state", state.size(), predictor->prior.system->layout().size());
  check_size("the mean", mean.size(), predictor->view.size());
}

}  // namespace

Status Predictor::mean(const Ref<const VectorXd>& state, Ref<VectorXd> mean, Workspace& workspace) const {
  check_arguments(implementation_.get(), state, mean, workspace.implementation_.get());
  Workspace::Implementation& w = *workspace.implementation_;
  return implementation_->evaluate_mean(state, *w.values, w, mean);
}

Status Predictor::mean_and_stddev(const Ref<const VectorXd>& state, Ref<VectorXd> mean, Ref<VectorXd> stddev,
                                  Workspace& workspace) const {
  if (!options().stddev) throw InputError("Predictor: it was made without Options::stddev");
  check_size("the standard deviation", stddev.size(), view().size());
  check_arguments(implementation_.get(), state, mean, workspace.implementation_.get());
  Workspace::Implementation& w = *workspace.implementation_;
  const Status status = implementation_->evaluate_mean(state, *w.values, w, mean);
  if (status == Status::ok) {
    implementation_->write_stddev(*w.values, w, stddev);
  } else {
    stddev.setConstant(not_a_number);
  }
  return status;
}

Status Predictor::mean_and_jacobian(const Ref<const VectorXd>& state, Ref<VectorXd> mean, Ref<MatrixXd> jacobian,
                                    Workspace& workspace) const {
  if (!options().jacobian) throw InputError("Predictor: it was made without Options::jacobian");
  check_arguments(implementation_.get(), state, mean, workspace.implementation_.get());
  check_size("a column of the Jacobian", jacobian.rows(), view().size());
  check_size("a row of the Jacobian", jacobian.cols(), state.size());
  Workspace::Implementation& w = *workspace.implementation_;
  StateEvaluator& at = *w.values_and_derivatives;
  Status status = implementation_->evaluate_mean(state, at, w, mean);
  if (status == Status::ok) {
    implementation_->write_jacobian(state, at, w, jacobian);
    if (!is_finite(jacobian)) {
      mean.setConstant(not_a_number);
      status = Status::not_finite;
    }
  }
  if (status != Status::ok) jacobian.setConstant(not_a_number);
  return status;
}

}  // namespace gp2
