#include "gp2/inference/likelihood.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <utility>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "base/parallel.hpp"
#include "base/simd.hpp"
#include "gp2/error.hpp"
#include "inference/reduction.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {
constexpr Index large_size = 2000;         // of a matrix that OpenBLAS works on faster with several threads
constexpr std::size_t many_samples = 512;  // from here on threads pay in the sums over pairs of samples
}  // namespace

struct Likelihood::Implementation {
  Prior prior;
  std::vector<Observations> observations;
  Options options;
  std::vector<std::vector<MatrixXd>> features;  // [group][latent] (N × D)

  // kept when nothing they depend on can change
  std::optional<std::vector<ObservationModel>> fixed_models;
  std::optional<Reduction> fixed_reduction;
  int initial_size = 0;
  std::shared_ptr<const char> identity = std::make_shared<const char>();
};

struct Likelihood::Workspace::Implementation {
  int n_threads = 1;
  std::shared_ptr<const char> owner;  // identity of the likelihood whose data stands below; held, so that no other can have it
  std::vector<ObservationModel> own_models;     // where parameters are estimated
  Reduction own_reduction;                      // where parameters or the noise are
  MatrixXd K;                                   // K̃ + I, then its factor, then its inverse
  std::vector<KernelColumns> kernels;           // per latent, between the samples in the order of
  std::vector<std::pair<int, int>> sample_ids;  // … these (group, index)
  std::vector<MatrixXd> D;                      // per latent: R_i E_a, by component
  std::vector<MatrixXd> Z;                      // per latent: R_i E_a C_a, by component

  void prepare(const Likelihood::Implementation& self, const Reduction& reduction, bool directions_changed,
               const ModelValues& values);
};

void Likelihood::Workspace::Implementation::prepare(const Likelihood::Implementation& self, const Reduction& reduction,
                                                    bool directions_changed, const ModelValues& values) {
  std::vector<std::pair<int, int>> ids;
  ids.reserve(reduction.samples.size());
  for (const Reduction::Sample& sample : reduction.samples) ids.emplace_back(sample.group, sample.index);
  const bool reordered = owner != self.identity || ids != sample_ids;
  if (reordered) {
    const std::vector<MatrixXd> features = sorted_features(self.prior, self.features, reduction);
    kernels.clear();
    for (std::size_t a = 0; a < features.size(); ++a) kernels.emplace_back(self.prior.latents[a].kernel, features[a]);
    sample_ids = std::move(ids);
    owner = self.identity;
  }
  D.resize(kernels.size());
  Z.resize(kernels.size());
  const Index n_components = reduction.n_components();
  for (std::size_t a = 0; a < kernels.size(); ++a) {
    kernels[a].set_parameters(values.kernel[a]);
    if (reordered || directions_changed) D[a] = by_component(reduction, reduction.directions[a]);
    const MatrixXd C = values.loading(a);
    Z[a].resize(D[a].rows(), n_components * C.cols());
    for (Index c = 0; c < n_components; ++c) {
      Z[a].middleCols(c * C.cols(), C.cols()).noalias() = D[a].middleCols(c * C.rows(), C.rows()) * C;
    }
  }
}

Likelihood::Workspace::Workspace(int n_threads) : implementation_(std::make_unique<Implementation>()) {
  implementation_->n_threads = n_threads;
}
Likelihood::Workspace::~Workspace() = default;

Likelihood::Likelihood(Prior prior, std::vector<Observations> observations, const ModelValues& initial, Options options)
    : implementation_(std::make_unique<Implementation>()) {
  Implementation& self = *implementation_;
  self.prior = std::move(prior);
  self.observations = std::move(observations);
  self.options = std::move(options);
  for (const Observations& group : self.observations) {
    require_mechanics(prior_of(self.prior, group.view()), group.view(), group.states(),
                      parameters_of(group.view(), initial.parameters));
  }
  self.features = features_by_group(self.prior, self.observations);
  std::vector<ObservationModel> models;
  model_observations(self.prior, self.observations, initial.parameters, self.options.gradient_parameters, models);
  Reduction reduction;
  reduce(self.prior, self.observations, models, initial.noise_stddev, reduction);
  self.initial_size = static_cast<int>(reduction.size());
  if (!self.options.gradient_parameters.empty()) return;
  if (!self.options.noise_gradient) self.fixed_reduction = std::move(reduction);
  self.fixed_models = std::move(models);
}

Likelihood::~Likelihood() = default;
Likelihood::Likelihood(Likelihood&&) noexcept = default;

const Prior& Likelihood::prior() const { return implementation_->prior; }
const std::vector<Observations>& Likelihood::observations() const { return implementation_->observations; }
int Likelihood::reduced_size() const { return implementation_->initial_size; }

namespace {

// Sums over pairs of samples, i ≥ j, that the gradient is made of; S_ij = P_ij − α̃_iα̃_jᵀ, P = (K̃ + I)⁻¹. One for each part of the
// work, added up in a fixed order.
struct PairSums {
  struct OfLatent {
    MatrixXd kernel;  // ½ Σ_ij ⟨S_ij, Z_i Z_jᵀ⟩ ∂k_ij/∂log v             (lanes × parameters)
    MatrixXd columns;  // ½ Σ_ij k_ij ⟨S_ij, ∂(Z_i Z_jᵀ)/∂log⟩ in a factor of each column of Z, where C is free and all samples
                       // alike: Σ_ij S_ij k_ij for each pair of components            (lanes × columns)
    MatrixXd V;     // V_i = Σ_j S_ij Z_j k_ij, by component             (N × components·functions)
    MatrixXd mean;  // Σ_j k_ij Z_jᵀα̃_j                                  (N × functions)
  };
  std::vector<OfLatent> latents;

  void add(const PairSums& other) {
    for (std::size_t a = 0; a < latents.size(); ++a) {
      latents[a].kernel += other.latents[a].kernel;
      latents[a].columns += other.latents[a].columns;
      latents[a].V += other.latents[a].V;
      latents[a].mean += other.latents[a].mean;
    }
  }
};

// What is wanted of a latent.
struct Wanted {
  bool kernel = false, columns = false, alike = false, V = false, mean = false;
  [[nodiscard]] bool any() const { return kernel || columns || V || mean; }
};

// The sweep over the tiles of P.
class PairSweep {
 public:
  PairSweep(const Reduction& reduction, const MatrixXd& P, const VectorXd& alpha, const std::vector<KernelColumns>& kernels,
            const std::vector<MatrixXd>& Z, std::vector<Index> n_functions, const std::vector<Wanted>& wanted)
      : reduction_(reduction),
        P_(P),
        alpha_(by_component(reduction, alpha)),
        kernels_(kernels),
        Z_(Z),
        n_functions_(std::move(n_functions)),
        wanted_(wanted) {
    for (std::size_t a = 0; a < Z.size(); ++a) {
      // β_i = Z_iᵀ α̃_i
      MatrixXd& beta = beta_.emplace_back(MatrixXd::Zero(Z[a].rows(), n_functions_[a]));
      for (Index c = 0; c < reduction.n_components(); ++c) {
        beta += alpha_.col(c).asDiagonal() * Z[a].middleCols(c * n_functions_[a], n_functions_[a]);
      }
    }
  }

  PairSums run(int n_threads) const {
    const Index n_tiles = (n_samples() + tile_size - 1) / tile_size;
    const int n_tasks = static_cast<int>(std::min<Index>(n_tiles, 32));
    std::vector<PairSums> sums(static_cast<std::size_t>(n_tasks), zero());
    parallel_for(n_tasks, n_threads, [&](int task, int) {
      Tile tile(*this);
      // columns of tiles get shorter: dealt out in turn, every task has about as much
      for (Index J = task; J < n_tiles; J += n_tasks) {
        for (Index I = J; I < n_tiles; ++I) tile.add(I * tile_size, J * tile_size, sums[static_cast<std::size_t>(task)]);
      }
    });
    for (std::size_t task = 1; task < sums.size(); ++task) sums[0].add(sums[task]);
    return std::move(sums[0]);
  }

 private:
  [[nodiscard]] Index n_samples() const { return static_cast<Index>(reduction_.samples.size()); }

  [[nodiscard]] PairSums zero() const {
    PairSums sums;
    const Index n_rows = simd::padded(n_samples());
    const Index n_components = reduction_.n_components();
    for (std::size_t a = 0; a < Z_.size(); ++a) {
      const Wanted& wanted = wanted_[a];
      const auto zeros = [](bool is_wanted, Index rows, Index columns) -> MatrixXd {
        return is_wanted ? MatrixXd::Zero(rows, columns) : MatrixXd();
      };
      sums.latents.push_back(
          {zeros(wanted.kernel, simd::lanes<double>, kernels_[a].values().size()),
           zeros(wanted.columns, simd::lanes<double>, wanted.alike ? n_components * n_components : n_functions_[a]),
           zeros(wanted.V, n_rows, Z_[a].cols()), zeros(wanted.mean, n_rows, n_functions_[a])});
    }
    return sums;
  }

  // memory for the pairs (i in I, j in J) of one tile
  struct Tile {
    const PairSweep& sweep;
    MatrixXd S;                  // of one pair of components; pairs off the diagonal count twice
    MatrixXd Sk;                 // S ∘ k
    MatrixXd together;           // H where C is free and all samples alike, before its factor
    std::vector<MatrixXd> k, H;  // per latent; H_ij = ⟨S_ij, Z_i Z_jᵀ⟩
    VectorXd ones, z, projected, point;
    KernelColumns::Workspace workspace;

    explicit Tile(const PairSweep& of)
        : sweep(of),
          S(tile_size, tile_size),
          Sk(tile_size, tile_size),
          together(tile_size, tile_size),
          k(of.Z_.size()),
          H(of.Z_.size()),
          ones(VectorXd::Ones(tile_size)) {
      Index n = 1;
      for (std::size_t a = 0; a < k.size(); ++a) {
        if (!of.wanted_[a].any()) continue;
        k[a].resize(tile_size, tile_size);
        H[a].resize(tile_size, tile_size);
        n = std::max(n, of.n_functions_[a]);
      }
      z.resize(n);
      projected.resize(n);
    }

    void add(Index I, Index J, PairSums& sums) {
      const bool diagonal = I == J;
      const Index ni = std::min(tile_size, sweep.n_samples() - I);
      const Index nj = std::min(tile_size, sweep.n_samples() - J);
      const Index n = simd::padded(ni);
      const auto skipped = [diagonal](Index j) { return diagonal ? whole_vectors_before(j) : 0; };

      for (std::size_t a = 0; a < k.size(); ++a) {
        if (!sweep.wanted_[a].any()) continue;
        H[a].setZero();
        for (Index j = 0; j < nj; ++j) {
          sweep.kernels_[a].scale(J + j, point);
          sweep.kernels_[a].evaluate(I + skipped(j), n - skipped(j), point, k[a].col(j).data() + skipped(j), workspace);
          if (diagonal) k[a].col(j).head(j).setZero();
        }
        if (sweep.wanted_[a].mean) add_mean(a, I, n, J, nj, diagonal, sums.latents[a].mean);
      }

      const int n_components = sweep.reduction_.n_components();
      for (int right = 0; right < n_components; ++right) {
        for (int left = 0; left < n_components; ++left) {
          const Index n_rows = std::min(ni, sweep.reduction_.count[static_cast<std::size_t>(left)] - I);
          const Index n_columns = std::min(nj, sweep.reduction_.count[static_cast<std::size_t>(right)] - J);
          if (n_rows <= 0 || n_columns <= 0) continue;
          load(left, I, n_rows, n, right, J, n_columns, diagonal);
          for (std::size_t a = 0; a < k.size(); ++a) {
            const Wanted& wanted = sweep.wanted_[a];
            if (!wanted.kernel && !wanted.columns && !wanted.V) continue;
            if (wanted.alike) {
              contract_alike(a, left, I, n, right, J, n_columns, diagonal,
                             sums.latents[a].columns.col(left * n_components + right));
            } else {
              contract(a, left, I, n, right, J, n_columns, diagonal, sums.latents[a]);
            }
          }
        }
      }

      for (std::size_t a = 0; a < k.size(); ++a) {
        if (!sweep.wanted_[a].kernel) continue;
        for (Index j = 0; j < nj; ++j) {
          const Index skip = skipped(j);
          sweep.kernels_[a].scale(J + j, point);
          sweep.kernels_[a].add_gradient(I + skip, n - skip, point, k[a].col(j).data() + skip, H[a].col(j).data() + skip,
                                         sums.latents[a].kernel, workspace);
        }
      }
    }

    // S of a pair of components, from the lower triangle of P; where `left` comes before `right` its block is the transposed one
    void load(int left, Index I, Index n_rows, Index n, int right, Index J, Index n_columns, bool diagonal) {
      const Index row = sweep.reduction_.offset[static_cast<std::size_t>(left)] + I;
      const Index column = sweep.reduction_.offset[static_cast<std::size_t>(right)] + J;
      const auto alpha_I = sweep.alpha_.col(left).segment(I, n_rows);
      const auto alpha_J = sweep.alpha_.col(right).segment(J, n_columns);
      if (left >= right) {
        for (Index j = 0; j < n_columns; ++j) {
          S.col(j).head(n_rows) = 2 * (sweep.P_.col(column + j).segment(row, n_rows) - alpha_J[j] * alpha_I);
        }
      } else {
        for (Index i = 0; i < n_rows; ++i) {
          S.row(i).head(n_columns) = 2 * (sweep.P_.col(row + i).segment(column, n_columns) - alpha_I[i] * alpha_J).transpose();
        }
      }
      S.block(n_rows, 0, n - n_rows, n_columns).setZero();
      if (!diagonal) return;
      for (Index j = 0; j < n_columns; ++j) {
        S.col(j).head(std::min(j, n)).setZero();
        if (j < n_rows) S(j, j) *= 0.5;
      }
    }

    void contract(std::size_t a, int left, Index I, Index n, int right, Index J, Index n_columns, bool diagonal,
                  PairSums::OfLatent& sums) {
      const simd::Loops<double>& loops = simd::loops();
      const MatrixXd& Z = sweep.Z_[a];
      const Index m = sweep.n_functions_[a];
      const double* const Z_I = Z.col(left * m).data() + I;
      const bool wants_V = sweep.wanted_[a].V;
      for (Index j = 0; j < n_columns; ++j) {
        const Index skip = diagonal && !wants_V ? whole_vectors_before(j) : 0;
        for (Index l = 0; l < m; ++l) z[l] = Z(J + j, right * m + l);
        Sk.col(j).segment(skip, n - skip) = S.col(j).segment(skip, n - skip);
        loops.contract(n - skip, m, Sk.col(j).data() + skip, k[a].col(j).data() + skip, Z_I + skip, Z.rows(), z.data(),
                       H[a].col(j).data() + skip, sums.columns.data());
        if (!wants_V) continue;
        loops.weighted_sums(n, m, Sk.col(j).data(), Z_I, Z.rows(), projected.data());
        for (Index l = 0; l < m; ++l) sums.V(J + j, right * m + l) += 0.5 * projected[l];
      }
      if (!wants_V) return;
      for (Index l = 0; l < m; ++l) {
        const VectorXd half = 0.5 * Z.col(right * m + l).segment(J, n_columns);
        loops.add_scaled_products(n, n_columns, ones.data(), Sk.data(), tile_size, half.data(),
                                  sums.V.col(left * m + l).data() + I);
      }
    }

    // Z_i is the same at every sample: a sum over pairs of samples is one number for each pair of components
    void contract_alike(std::size_t a, int left, Index I, Index n, int right, Index J, Index n_columns, bool diagonal,
                        Eigen::Ref<VectorXd> sums) {
      const MatrixXd& Z = sweep.Z_[a];
      const Index m = sweep.n_functions_[a];
      const double product = Z.row(I).segment(left * m, m).dot(Z.row(J).segment(right * m, m));
      const double one = 1;
      together.leftCols(n_columns).setZero();
      for (Index j = 0; j < n_columns; ++j) {
        const Index skip = diagonal ? whole_vectors_before(j) : 0;
        Sk.col(j).segment(skip, n - skip) = S.col(j).segment(skip, n - skip);
        simd::loops().contract(n - skip, 1, Sk.col(j).data() + skip, k[a].col(j).data() + skip, ones.data(), tile_size, &one,
                               together.col(j).data() + skip, sums.data());
        H[a].col(j).segment(skip, n - skip) += product * together.col(j).segment(skip, n - skip);
      }
    }

    void add_mean(std::size_t a, Index I, Index n, Index J, Index nj, bool diagonal, MatrixXd& mean) {
      const simd::Loops<double>& loops = simd::loops();
      const MatrixXd& beta = sweep.beta_[a];
      const Index m = sweep.n_functions_[a];
      for (Index l = 0; l < m; ++l) {
        loops.add_scaled_products(n, nj, ones.data(), k[a].data(), tile_size, beta.col(l).data() + J, mean.col(l).data() + I);
      }
      for (Index j = 0; j < nj; ++j) {
        loops.weighted_sums(n, m, k[a].col(j).data(), beta.data() + I, beta.rows(), projected.data());
        for (Index l = 0; l < m; ++l) {
          mean(J + j, l) += projected[l] - (diagonal ? k[a](j, j) * beta(J + j, l) : 0);
        }
      }
    }
  };

  const Reduction& reduction_;
  const MatrixXd& P_;
  MatrixXd alpha_;  // by component
  const std::vector<KernelColumns>& kernels_;
  const std::vector<MatrixXd>& Z_;
  std::vector<Index> n_functions_;
  const std::vector<Wanted>& wanted_;
  std::vector<MatrixXd> beta_;
};

// What θ and the noise change at one sample: ∂NLL/∂e, ∂NLL/∂W and ∂NLL/∂E there, and the chain rule on to σ and θ.
class SampleGradient {
 public:
  SampleGradient(const Likelihood::Options& options, const std::vector<Observations>& observations,
                 const std::vector<ObservationModel>& models, const Reduction& reduction, const ModelValues& values,
                 const VectorXd& alpha, const PairSums& sums)
      : options_(options),
        observations_(observations),
        models_(models),
        reduction_(reduction),
        noise_stddev_(values.noise_stddev),
        alpha_(alpha),
        sums_(sums),
        V_(sums.latents.size()) {
    for (std::size_t a = 0; a < V_.size(); ++a) loading_.push_back(values.loading(a));
  }

  void add(Index i, ModelGradient& gradient) {
    const Reduction::Sample& sample = reduction_.samples[static_cast<std::size_t>(i)];
    const std::size_t group = static_cast<std::size_t>(sample.group);
    const ObservationModel& model = models_[group];
    whitening_ = observations_[group].noise_at(noise_stddev_[group], sample.index).cwiseInverse();
    const Index rank = sample.R.rows();

    // α_i = Q_i α̃_i + (I − Q_iQ_iᵀ) e_i
    alpha_i_.resize(rank);
    for (Index c = 0; c < rank; ++c) alpha_i_[c] = alpha_[reduction_.offset[static_cast<std::size_t>(c)] + i];
    d_e_ = sample.e_out;
    d_e_.noalias() += sample.Q.lazyProduct(alpha_i_);
    // ∂NLL/∂W_i = Q_i Σ_a V_i,a E_aᵀ − (I − Q_iQ_iᵀ) e_i (posterior mean of ā − μ)ᵀ
    V_E_.setZero(rank, sample.R.cols());
    mean_.setZero(sample.R.cols());
    for (std::size_t a = 0; a < V_.size(); ++a) {
      const PairSums::OfLatent& of_latent = sums_.latents[a];
      E_.noalias() = model.values.prior.E(a, sample.index).lazyProduct(loading_[a]);
      const Index m = of_latent.mean.cols();
      V_[a].resize(rank, m);
      for (Index c = 0; c < rank; ++c) V_[a].row(c) = of_latent.V.row(i).segment(c * m, m);
      V_E_.noalias() += V_[a].lazyProduct(E_.transpose());
      mean_.noalias() += E_.lazyProduct(of_latent.mean.row(i).transpose());
    }
    d_W_.noalias() = sample.Q.lazyProduct(V_E_);
    d_W_.noalias() -= sample.e_out.lazyProduct(mean_.transpose());
    const auto G = model.values.view.G(sample.index);

    // S^{-1/2} scales the rows of W and e, and σ_k the whole row k of S^{1/2}
    if (options_.noise_gradient) {
      // a value of weight 0, which is not measured, has no log S
      gradient.log_noise_stddev[group].array() += (whitening_.array() > 0).cast<double>() - d_e_.array() * sample.e.array() -
                                                  whitening_.array() * d_W_.cwiseProduct(G).rowwise().sum().array();
    }
    if (options_.gradient_parameters.empty()) return;

    // e = S^{-1/2}(y − d − Gμ) and W = S^{-1/2}G: ∂NLL/∂d, ∂NLL/∂G, ∂NLL/∂μ and ∂NLL/∂E
    d_offset_ = -whitening_.cwiseProduct(d_e_);
    d_G_ = whitening_.asDiagonal() * d_W_;
    d_G_.noalias() += d_offset_.lazyProduct(model.values.prior.mean.col(sample.index).transpose());
    d_mean_.noalias() = G.transpose().lazyProduct(d_offset_);
    for (std::size_t a = 0; a < V_.size(); ++a) {
      E_.noalias() = sample.R.transpose().lazyProduct(V_[a]);
      V_[a].noalias() = E_.lazyProduct(loading_[a].transpose());  // now ∂NLL/∂E_a
    }
    for (std::size_t p = 0; p < options_.gradient_parameters.size(); ++p) {
      const ObservationModel::Values& d = model.derivatives[p];
      double slope = d_offset_.dot(d.view.offset.col(sample.index)) + d_G_.cwiseProduct(d.view.G(sample.index)).sum() +
                     d_mean_.dot(d.prior.mean.col(sample.index));
      for (std::size_t a = 0; a < V_.size(); ++a) slope += V_[a].cwiseProduct(d.prior.E(a, sample.index)).sum();
      gradient.parameters[options_.gradient_parameters[p]] += slope;
    }
  }

 private:
  const Likelihood::Options& options_;
  const std::vector<Observations>& observations_;
  const std::vector<ObservationModel>& models_;
  const Reduction& reduction_;
  const std::vector<VectorXd>& noise_stddev_;
  const VectorXd& alpha_;
  const PairSums& sums_;
  std::vector<MatrixXd> loading_;  // per latent: C_a
  // memory used again at each sample
  std::vector<MatrixXd> V_;
  MatrixXd V_E_, E_, d_W_, d_G_;
  VectorXd whitening_;  // S^{-1/2}
  VectorXd alpha_i_, d_e_, mean_, d_offset_, d_mean_;
};

}  // namespace

double Likelihood::evaluate(const ModelValues& values, ModelGradient* gradient, Workspace& workspace) const {
  constexpr double infinity = std::numeric_limits<double>::infinity();
  const Implementation& self = *implementation_;
  Workspace::Implementation& work = *workspace.implementation_;
  const std::size_t n_latents = self.prior.latents.size();

  // observations under these parameters and noise
  if (!self.fixed_models &&
      !model_observations(self.prior, self.observations, values.parameters,
                          gradient != nullptr ? self.options.gradient_parameters : std::vector<int>{}, work.own_models)) {
    return infinity;
  }
  const std::vector<ObservationModel>& models = self.fixed_models ? *self.fixed_models : work.own_models;
  if (!self.fixed_reduction) reduce(self.prior, self.observations, models, values.noise_stddev, work.own_reduction);
  const Reduction& reduction = self.fixed_reduction ? *self.fixed_reduction : work.own_reduction;
  work.prepare(self, reduction, !self.fixed_reduction, values);

  // K̃ + I = L Lᵀ
  const int n_threads = reduction.samples.size() >= many_samples ? work.n_threads : 1;
  const lapack::ManyThreads many_threads(reduction.size() >= large_size ? n_threads : 1);
  if (work.K.rows() != reduction.size()) work.K.resize(reduction.size(), reduction.size());
  assemble(reduction, work.kernels, work.Z, n_threads, work.K);
  if (!lapack::factorise(work.K)) return infinity;

  // −log N(ỹ; 0, K̃ + I)
  VectorXd alpha = reduction.y;
  lapack::solve_lower(work.K, false, alpha);
  const double value = reduction.constant + 0.5 * alpha.squaredNorm() + work.K.diagonal().array().log().sum();
  if (!std::isfinite(value)) return infinity;
  if (gradient == nullptr) return value;
  lapack::solve_lower(work.K, true, alpha);
  lapack::invert_factored(work.K);

  const bool needs_V = self.options.noise_gradient || !self.options.gradient_parameters.empty();
  std::vector<Wanted> wanted(n_latents);
  std::vector<Index> n_functions;
  for (std::size_t a = 0; a < n_latents; ++a) {
    const Latent& latent = self.prior.latents[a];
    wanted[a].kernel = !latent.kernel_is_fixed && values.kernel[a].size() > 0;
    wanted[a].alike = reduction.same_directions[a] && !needs_V;
    wanted[a].V = needs_V || (values.has_free_loading(a) && !wanted[a].alike);
    wanted[a].columns = wanted[a].kernel || wanted[a].V || !latent.signal_is_fixed;
    wanted[a].mean = needs_V;
    n_functions.push_back(values.loading(a).cols());
  }
  const PairSums sums = PairSweep(reduction, work.K, alpha, work.kernels, work.Z, n_functions, wanted).run(n_threads);

  *gradient = ModelGradient::zero(values);
  const Index n_components = reduction.n_components();
  for (std::size_t a = 0; a < n_latents; ++a) {
    if (wanted[a].kernel) gradient->log_kernel[a] = 0.5 * sums.latents[a].kernel.colwise().sum().transpose();
    if (!wanted[a].columns) continue;
    const VectorXd columns = sums.latents[a].columns.colwise().sum();
    const Index p = self.prior.latents[a].size();
    if (!values.has_free_loading(a)) {
      gradient->log_signal_stddev[a] = columns;
    } else if (wanted[a].alike) {
      // ∂NLL/∂C = ½ Dᵀ(G + Gᵀ)D C, G the sums of each pair of components, D the first sample's directions
      const MatrixXd D = work.D[a].row(0).reshaped(p, n_components).transpose();
      const MatrixXd G = columns.reshaped(n_components, n_components);
      gradient->free_loading[a] = 0.5 * D.transpose() * (G + G.transpose()) * D * values.loading(a);
    } else {
      const Index m = sums.latents[a].V.cols() / n_components;
      for (Index c = 0; c < n_components; ++c) {
        gradient->free_loading[a].noalias() +=
            work.D[a].middleCols(c * p, p).transpose() * sums.latents[a].V.middleCols(c * m, m);
      }
    }
  }
  if (!needs_V) return value;
  SampleGradient of_sample(self.options, self.observations, models, reduction, values, alpha, sums);
  for (Index i = 0; i < static_cast<Index>(reduction.samples.size()); ++i) of_sample.add(i, *gradient);
  return value;
}

}  // namespace gp2
