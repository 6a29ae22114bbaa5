#include "gp2/inference/likelihood.hpp"

#include <cmath>
#include <limits>
#include <utility>

#include "base/parallel.hpp"
#include "gp2/error.hpp"
#include "inference/dense_gram.hpp"
#include "inference/inducing_gram.hpp"
#include "inference/requirements.hpp"
#include "inference/sample_gradient.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// ∂NLL/∂C of a free loading
// @param D  R_i E_a, by component
MatrixXd loading_gradient(const GramGradient::OfLatent& of_gram, bool alike, const MatrixXd& D, Index n_components,
                          const MatrixXd& C) {
  const Index p = C.rows(), m = C.cols();
  if (alike) {
    // ½ Dᵀ(G + Gᵀ)D C, G the sums of each pair of components, D the first sample's directions
    const MatrixXd D_first = D.row(0).reshaped(p, n_components).transpose();
    const MatrixXd G = of_gram.columns.reshaped(n_components, n_components);
    return 0.5 * D_first.transpose() * (G + G.transpose()) * D_first * C;
  }
  MatrixXd gradient = MatrixXd::Zero(p, m);
  for (Index c = 0; c < n_components; ++c) {
    gradient.noalias() += D.block(0, c * p, of_gram.V.rows(), p).transpose() * of_gram.V.middleCols(c * m, m);
  }
  return gradient;
}

}  // namespace

struct Likelihood::Implementation {
  Prior prior;
  std::vector<Observations> observations;
  Options options;
  std::vector<std::vector<MatrixXd>> features;  // [group][latent] (N × D); none through inducing points

  // kept when nothing they depend on can change
  std::optional<std::vector<ObservationModel>> fixed_models;
  std::optional<Reduction> fixed_reduction;
  std::vector<BlocksOfStates::Kept> kept_blocks;  // through inducing points, where they are small enough
  std::shared_ptr<const Linearisation> about;     // of the initial values
  int initial_size = 0;
  VectorXd initial_parameters;
  std::vector<VectorXd> initial_noise_stddev;
  std::shared_ptr<const char> identity = std::make_shared<const char>();

  // whether derivatives at single samples are asked for
  [[nodiscard]] bool differentiates_samples() const { return options.noise_gradient || !options.gradient_parameters.empty(); }

  // what is made once, under the values that nothing changes
  void prepare(const ModelValues& initial) {
    features = features_by_group(prior, observations);
    std::vector<ObservationModel> models = require_models(prior, observations, initial.parameters, initial.about.get());
    Reduction reduction;
    reduce(prior, observations, models, initial.noise_stddev, reduction);
    initial_size = static_cast<int>(reduction.size());
    if (!options.gradient_parameters.empty()) return;
    if (!options.noise_gradient) fixed_reduction = std::move(reduction);
    fixed_models = std::move(models);
  }

  void prepare_blocks(const ModelValues& initial) {
    const BlocksOfStates blocks(prior, observations, initial, about.get());
    const Index n = blocks.n_blocks();
    std::vector<BlocksOfStates::Kept> kept(static_cast<std::size_t>(n));
    std::atomic<std::size_t> bytes = 0;
    std::atomic<bool> is_sound = true;
    std::atomic<int> size = 0;
    const Pieces pieces(n);
    parallel_for(pieces.n, options.workers.n_threads, [&](int piece, int) {
      if (!options.workers.owns(piece, pieces.n)) return;
      RowBlocks::Memory memory;
      for (Index b = pieces.first(piece); b < pieces.first(piece + 1) && is_sound; ++b) {
        const RowBlock* const block = blocks.block(b, false, memory);
        if (block == nullptr) {
          is_sound = false;
          return;
        }
        size += static_cast<int>(block->rows.size());
        if (!options.gradient_parameters.empty() || bytes > BlocksOfStates::most_kept_bytes) continue;
        BlocksOfStates::Kept& of_block = kept[static_cast<std::size_t>(b)] = blocks.keep(*block, !options.noise_gradient);
        bytes += of_block.bytes();
      }
    });
    if (!is_sound) static_cast<void>(require_models(prior, observations, initial.parameters, about.get()));  // names the state
    initial_size = static_cast<int>(options.workers.sum(size));
    if (options.gradient_parameters.empty() && bytes <= BlocksOfStates::most_kept_bytes) kept_blocks = std::move(kept);
  }

  // that what was reduced once is as it was
  void require_initial(const ModelValues& values) const {
    if (!options.gradient_parameters.empty()) return;  // all is reduced anew
    if (values.parameters != initial_parameters) {
      throw InputError(
          "values: parameters of a likelihood that gives no derivative in them must be those that it was made with; make "
          "another, or name one in gradient_parameters");
    }
    if (options.noise_gradient || values.noise_stddev == initial_noise_stddev) return;
    throw InputError(
        "values: noise_stddev of a likelihood that gives no derivative in it must be that which it was made with; make "
        "another, or set noise_gradient");
  }

  // @param reduction  of all rows; null: through inducing points
  [[nodiscard]] std::vector<GramGradientParts> parts(const Reduction* reduction, const ModelValues& values) const {
    std::vector<GramGradientParts> parts;
    for (std::size_t a = 0; a < prior.latents.size(); ++a) {
      const Latent& latent = prior.latents[a];
      GramGradientParts& part = parts.emplace_back();
      part.kernel = !latent.kernel_is_fixed && values.kernel[a].size() > 0;
      part.alike = reduction != nullptr && reduction->same_directions[a] && !differentiates_samples() && !latent.is_potential;
      part.V = differentiates_samples() || (values.has_free_loading(a) && !part.alike);
      part.mean = differentiates_samples();
    }
    return parts;
  }

  // adds what belongs to the rows of a block
  void add_rows(const RowBlock& block, const GramGradient& of_rows, const ModelValues& values, ModelGradient& gradient) const {
    const Reduction& reduction = *block.rows.reduction;
    for (std::size_t a = 0; a < prior.latents.size(); ++a) {
      if (!values.has_free_loading(a) || of_rows.latents[a].columns.size() + of_rows.latents[a].V.size() == 0) continue;
      const bool is_alike = of_rows.latents[a].V.size() == 0;
      gradient.free_loading[a] += loading_gradient(of_rows.latents[a], is_alike, by_component(reduction, reduction.directions[a]),
                                                   reduction.n_components(), values.loading(a));
    }
    if (!differentiates_samples()) return;
    // T13
    SampleGradient of_sample(options, block, values, of_rows);
    for (Index i = 0; i < reduction.n_samples(); ++i) of_sample.add(i, gradient);
    if (reduction.sums && options.noise_gradient) {
      for (Index r = 0; r < reduction.sums->size(); ++r) {
        const Sums::Of& of = reduction.sums->of[static_cast<std::size_t>(r)];
        if (of.group >= 0) gradient.log_noise_stddev[static_cast<std::size_t>(of.group)][of.row] += of_rows.log_noise[r];
      }
    }
  }
};

struct Likelihood::Workspace::Implementation {
  Implementation(const Workers& who, const std::atomic<bool>* stop_flag) : workers(who), stop(stop_flag) {}

  // of the likelihood whose data stands below; held, so that no other can have it
  std::shared_ptr<const char> owner;
  Workers workers;
  const std::atomic<bool>* stop;
  DenseGram gram{workers.n_threads, stop};

  std::vector<ObservationModel> own_models;  // where parameters are estimated …
  VectorXd modelled;                         // … at these, none: not yet
  bool has_derivatives = false;              // whether own_models has them
  Reduction own_reduction;                   // where parameters or the noise are estimated

  RowBlock whole;
  std::vector<std::pair<int, int>> sample_ids;  // (group, index) of the samples in `whole`

  // all rows under these values; false where the mechanics have a fault
  [[nodiscard]] bool move_to(const Likelihood::Implementation& self, const ModelValues& values, bool with_derivatives) {
    if (owner != self.identity) {
      modelled.resize(0);
      whole = {};
      owner = self.identity;
    }
    whole.models = models(self, values.parameters, with_derivatives);
    if (whole.models == nullptr) return false;
    whole.observations = &self.observations;
    if (!self.fixed_reduction) reduce(self.prior, self.observations, *whole.models, values.noise_stddev, own_reduction);
    update_rows(self, self.fixed_reduction ? *self.fixed_reduction : own_reduction, values);
    return true;
  }

  // null where the mechanics have a fault
  [[nodiscard]] const std::vector<ObservationModel>* models(const Likelihood::Implementation& self, const VectorXd& parameters,
                                                            bool with_derivatives) {
    if (self.fixed_models) return &*self.fixed_models;
    if (modelled.size() > 0 && modelled == parameters && (has_derivatives || !with_derivatives)) return &own_models;
    modelled.resize(0);
    const std::vector<int> in = with_derivatives ? self.options.gradient_parameters : std::vector<int>{};
    if (model_observations(self.prior, self.observations, parameters, in, self.about.get(), own_models)) return nullptr;
    modelled = parameters;
    has_derivatives = with_derivatives;
    return &own_models;
  }

  void update_rows(const Likelihood::Implementation& self, const Reduction& reduction, const ModelValues& values) {
    LatentRows& rows = whole.rows;
    const std::size_t n_latents = self.prior.latents.size();
    std::vector<std::pair<int, int>> ids;
    ids.reserve(reduction.samples.size());
    for (const Reduction::Sample& sample : reduction.samples) ids.emplace_back(sample.group, sample.index);
    if (rows.reduction == nullptr || ids != sample_ids) {
      const std::vector<MatrixXd> features = sorted_features(self.prior, self.features, reduction);
      rows.latents.clear();
      for (std::size_t a = 0; a < n_latents; ++a) {
        rows.latents.push_back(
            {KernelColumns(self.prior.latents[a].kernel, features[a]), {}, 0, self.prior.latents[a].is_potential});
      }
      sample_ids = std::move(ids);
    }
    rows.reduction = &reduction;
    for (std::size_t a = 0; a < n_latents; ++a) {
      LatentRows::OfLatent& latent = rows.latents[a];
      latent.kernel.set_parameters(values.kernel[a]);
      const MatrixXd D = by_component(reduction, reduction.directions[a]), C = values.loading(a);
      latent.n_functions = C.cols();
      latent.Z.resize(D.rows(), reduction.n_components() * C.cols());
      for (Index c = 0; c < reduction.n_components(); ++c) {
        latent.Z.middleCols(c * C.cols(), C.cols()).noalias() = D.middleCols(c * C.rows(), C.rows()) * C;
      }
    }
  }
};

Likelihood::Workspace::Workspace(const Workers& workers, const std::atomic<bool>* stop)
    : implementation_(std::make_unique<Implementation>(workers, stop)) {}
Likelihood::Workspace::~Workspace() = default;

Likelihood::Likelihood(Prior prior, std::vector<Observations> observations, const ModelValues& initial, Options options)
    : implementation_(std::make_unique<Implementation>()) {
  require_observations(prior, observations);
  require_values(prior, observations, initial);
  for (const int parameter : options.gradient_parameters) prior.system->require_parameter(parameter);
  Implementation& self = *implementation_;
  self.prior = std::move(prior);
  self.observations = std::move(observations);
  self.options = std::move(options);
  self.about = initial.about;
  self.initial_parameters = initial.parameters;
  self.initial_noise_stddev = initial.noise_stddev;
  require_learnable(self.prior, self.observations);
  if (initial.inducing) {
    self.prepare_blocks(initial);
  } else {
    self.prepare(initial);
  }
}

Likelihood::~Likelihood() = default;
Likelihood::Likelihood(Likelihood&&) noexcept = default;

const Likelihood::Implementation& Likelihood::implementation() const { return require_held(implementation_, "Likelihood"); }
const Prior& Likelihood::prior() const { return implementation().prior; }
const std::vector<Observations>& Likelihood::observations() const { return implementation().observations; }
int Likelihood::reduced_size() const { return implementation().initial_size; }

double Likelihood::evaluate(const ModelValues& values, ModelGradient* gradient, Workspace& workspace) const {
  constexpr double infinity = std::numeric_limits<double>::infinity();
  const Implementation& self = implementation();
  Workspace::Implementation& work = require_held(workspace.implementation_, "Likelihood::Workspace");
  require_values(self.prior, self.observations, values);
  self.require_initial(values);
  if (!values.inducing && self.features.size() < self.observations.size()) {
    throw InputError("values: the likelihood was made through inducing points, and these have none");
  }

  // T10, T11: the observations under these values, and what solves for them
  std::unique_ptr<RowBlocks> blocks;
  std::unique_ptr<InducingGram> through_points;
  if (values.inducing) {
    blocks = std::make_unique<BlocksOfStates>(self.prior, self.observations, values, self.about.get(),
                                              self.options.gradient_parameters,
                                              self.kept_blocks.empty() ? nullptr : &self.kept_blocks);
    through_points = std::make_unique<InducingGram>(InducingLatents(self.prior, values), work.workers, work.stop);
  } else {
    if (!work.move_to(self, values, gradient != nullptr)) return infinity;
    blocks = std::make_unique<WholeRows>(work.whole);
  }
  Gram& gram = through_points ? static_cast<Gram&>(*through_points) : work.gram;

  // T12, T14
  const auto total = [](const std::optional<GramValue>& value) {
    const double sum = value ? value->constant + value->data_fit + value->complexity : infinity;
    return std::isfinite(sum) ? sum : infinity;
  };
  if (gradient == nullptr) return total(gram.value(*blocks));
  const std::vector<GramGradientParts> parts = self.parts(through_points ? nullptr : work.whole.rows.reduction, values);
  const Pieces pieces(blocks->n_blocks());
  std::vector<ModelGradient> of_piece(static_cast<std::size_t>(pieces.n), ModelGradient::zero(values));
  GramGradient of_gram;
  const double value =
      total(gram.differentiate(*blocks, parts, of_gram, [&](int piece, const RowBlock& block, const GramGradient& of_rows) {
        self.add_rows(block, of_rows, values, of_piece[static_cast<std::size_t>(piece)]);
      }));
  if (value == infinity || is_set(work.stop)) return infinity;  // the gradient may be that of a part
  const Workers workers = through_points ? work.workers : Workers();
  PieceSums<ModelGradient> sums(pieces.n, ModelGradient::zero(values));
  for (int piece = 0; piece < pieces.n; ++piece) {
    if (workers.owns(piece, pieces.n)) sums.put(piece, std::move(of_piece[static_cast<std::size_t>(piece)]));
  }
  *gradient = sums.total(workers);
  for (std::size_t a = 0; a < parts.size(); ++a) {
    if (parts[a].kernel) gradient->log_kernel[a] = of_gram.latents[a].kernel;
    if (!values.has_free_loading(a)) gradient->log_signal_stddev[a] = of_gram.latents[a].columns;
  }
  return value;
}

}  // namespace gp2
