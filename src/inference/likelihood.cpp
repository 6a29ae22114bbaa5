#include "gp2/inference/likelihood.hpp"

#include <cmath>
#include <limits>
#include <utility>

#include "base/parallel.hpp"
#include "inference/inducing_gram.hpp"
#include "inference/requirements.hpp"
#include "inference/sample_gradient.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

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

  // whether derivatives at single samples are asked for
  [[nodiscard]] bool differentiates_samples() const { return options.noise_gradient || !options.gradient_parameters.empty(); }
  [[nodiscard]] std::vector<GramGradientParts> parts(const Reduction& reduction, const ModelValues& values) const;
};

struct Likelihood::Workspace::Implementation {
  Implementation(int threads, const std::atomic<bool>* stop_flag) : n_threads(threads), stop(stop_flag) {}

  // of the likelihood whose data stands below; held, so that no other can have it
  std::shared_ptr<const char> owner;
  int n_threads;
  const std::atomic<bool>* stop;
  std::unique_ptr<Gram> gram;
  std::shared_ptr<const InducingPoints> inducing;  // of `gram`

  std::vector<ObservationModel> own_models;  // where parameters are estimated …
  VectorXd modelled;                         // … at these, none: not yet
  bool has_derivatives = false;              // whether own_models has them
  Reduction own_reduction;                   // where parameters or the noise are estimated

  LatentRows rows;
  std::vector<std::pair<int, int>> sample_ids;  // (group, index) of the samples in `rows`
  std::vector<MatrixXd> D;                      // per latent: R_i E_a, by component

  void start(const Likelihood::Implementation& self);
  Gram& gram_of(const ModelValues& values);
  // null where the mechanics have a fault
  [[nodiscard]] const std::vector<ObservationModel>* models(const Likelihood::Implementation& self, const VectorXd& parameters,
                                                            bool with_derivatives);
  [[nodiscard]] const Reduction& reduction(const Likelihood::Implementation& self, const std::vector<ObservationModel>& models,
                                           const ModelValues& values);
  void update_rows(const Likelihood::Implementation& self, const Reduction& reduction, const ModelValues& values);
};

void Likelihood::Workspace::Implementation::start(const Likelihood::Implementation& self) {
  if (owner == self.identity) return;
  modelled.resize(0);
  rows = {};
  owner = self.identity;
}

Gram& Likelihood::Workspace::Implementation::gram_of(const ModelValues& values) {
  if (gram == nullptr || inducing != values.inducing) {
    gram = make_gram(values, n_threads, stop);
    inducing = values.inducing;
  }
  return *gram;
}

const std::vector<ObservationModel>* Likelihood::Workspace::Implementation::models(const Likelihood::Implementation& self,
                                                                                   const VectorXd& parameters,
                                                                                   bool with_derivatives) {
  if (self.fixed_models) return &*self.fixed_models;
  if (modelled.size() > 0 && modelled == parameters && (has_derivatives || !with_derivatives)) return &own_models;
  modelled.resize(0);
  const std::vector<int> in = with_derivatives ? self.options.gradient_parameters : std::vector<int>{};
  if (!model_observations(self.prior, self.observations, parameters, in, own_models)) return nullptr;
  modelled = parameters;
  has_derivatives = with_derivatives;
  return &own_models;
}

const Reduction& Likelihood::Workspace::Implementation::reduction(const Likelihood::Implementation& self,
                                                                  const std::vector<ObservationModel>& models,
                                                                  const ModelValues& values) {
  if (self.fixed_reduction) return *self.fixed_reduction;
  reduce(self.prior, self.observations, models, values.noise_stddev, own_reduction);
  return own_reduction;
}

void Likelihood::Workspace::Implementation::update_rows(const Likelihood::Implementation& self, const Reduction& reduction,
                                                        const ModelValues& values) {
  const std::size_t n_latents = self.prior.latents.size();
  std::vector<std::pair<int, int>> ids;
  ids.reserve(reduction.samples.size());
  for (const Reduction::Sample& sample : reduction.samples) ids.emplace_back(sample.group, sample.index);
  const bool reordered = rows.reduction == nullptr || ids != sample_ids;
  if (reordered) {
    const std::vector<MatrixXd> features = sorted_features(self.prior, self.features, reduction);
    rows.latents.clear();
    for (std::size_t a = 0; a < n_latents; ++a) {
      rows.latents.push_back({KernelColumns(self.prior.latents[a].kernel, features[a]), {}, 0});
    }
    sample_ids = std::move(ids);
  }
  rows.reduction = &reduction;
  D.resize(n_latents);
  for (std::size_t a = 0; a < n_latents; ++a) {
    LatentRows::OfLatent& latent = rows.latents[a];
    latent.kernel.set_parameters(values.kernel[a]);
    if (reordered || !self.fixed_reduction) D[a] = by_component(reduction, reduction.directions[a]);
    const MatrixXd C = values.loading(a);
    latent.n_functions = C.cols();
    latent.Z.resize(D[a].rows(), reduction.n_components() * C.cols());
    for (Index c = 0; c < reduction.n_components(); ++c) {
      latent.Z.middleCols(c * C.cols(), C.cols()).noalias() = D[a].middleCols(c * C.rows(), C.rows()) * C;
    }
  }
}

Likelihood::Workspace::Workspace(int n_threads, const std::atomic<bool>* stop)
    : implementation_(std::make_unique<Implementation>(n_threads, stop)) {}
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
  self.features = features_by_group(self.prior, self.observations);
  std::vector<ObservationModel> models = require_models(self.prior, self.observations, initial.parameters, {});
  Reduction reduction;
  reduce(self.prior, self.observations, models, initial.noise_stddev, reduction);
  self.initial_size = static_cast<int>(reduction.size());
  if (!self.options.gradient_parameters.empty()) return;
  if (!self.options.noise_gradient) self.fixed_reduction = std::move(reduction);
  self.fixed_models = std::move(models);
}

Likelihood::~Likelihood() = default;
Likelihood::Likelihood(Likelihood&&) noexcept = default;

const Likelihood::Implementation& Likelihood::implementation() const { return require_held(implementation_, "Likelihood"); }
const Prior& Likelihood::prior() const { return implementation().prior; }
const std::vector<Observations>& Likelihood::observations() const { return implementation().observations; }
int Likelihood::reduced_size() const { return implementation().initial_size; }

std::vector<GramGradientParts> Likelihood::Implementation::parts(const Reduction& reduction, const ModelValues& values) const {
  std::vector<GramGradientParts> parts;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    GramGradientParts& part = parts.emplace_back();
    part.kernel = !latent.kernel_is_fixed && values.kernel[a].size() > 0;
    part.alike = reduction.same_directions[a] && !differentiates_samples() && !values.inducing;
    part.V = differentiates_samples() || (values.has_free_loading(a) && !part.alike);
    part.columns = part.kernel || part.V || !latent.signal_is_fixed;
    part.mean = differentiates_samples();
  }
  return parts;
}

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
    gradient.noalias() += D.middleCols(c * p, p).transpose() * of_gram.V.middleCols(c * m, m);
  }
  return gradient;
}

}  // namespace

double Likelihood::evaluate(const ModelValues& values, ModelGradient* gradient, Workspace& workspace) const {
  constexpr double infinity = std::numeric_limits<double>::infinity();
  const Implementation& self = implementation();
  Workspace::Implementation& work = require_held(workspace.implementation_, "Likelihood::Workspace");
  require_values(self.prior, self.observations, values);

  // T10, T11: the observations under these values
  work.start(self);
  const std::vector<ObservationModel>* const models = work.models(self, values.parameters, gradient != nullptr);
  if (models == nullptr) return infinity;
  const Reduction& reduction = work.reduction(self, *models, values);
  work.update_rows(self, reduction, values);

  // T12
  Gram& gram = work.gram_of(values);
  const std::optional<GramValue> of_gram_value = gram.factorise(work.rows);
  if (!of_gram_value) return infinity;
  const double value = reduction.constant + of_gram_value->data_fit + of_gram_value->complexity;
  if (!std::isfinite(value)) return infinity;
  if (gradient == nullptr) return value;

  // T14
  const std::vector<GramGradientParts> parts = self.parts(reduction, values);
  const GramGradient of_gram = gram.differentiate(work.rows, parts);
  if (is_set(work.stop)) return infinity;  // the gradient may be that of a part
  *gradient = ModelGradient::zero(values);
  for (std::size_t a = 0; a < parts.size(); ++a) {
    const GramGradient::OfLatent& of_latent = of_gram.latents[a];
    if (parts[a].kernel) gradient->log_kernel[a] = of_latent.kernel;
    if (!parts[a].columns) continue;
    if (values.has_free_loading(a)) {
      gradient->free_loading[a] =
          loading_gradient(of_latent, parts[a].alike, work.D[a], reduction.n_components(), values.loading(a));
    } else {
      gradient->log_signal_stddev[a] = of_latent.columns;
    }
  }

  // T13
  if (!self.differentiates_samples()) return value;
  SampleGradient of_sample(self.options, self.observations, *models, reduction, values, of_gram);
  for (Index i = 0; i < reduction.n_samples(); ++i) of_sample.add(i, *gradient);
  if (reduction.sums && self.options.noise_gradient) {
    for (Index r = 0; r < reduction.sums->size(); ++r) {
      const Sums::Of& of = reduction.sums->of[static_cast<std::size_t>(r)];
      if (of.group >= 0) gradient->log_noise_stddev[static_cast<std::size_t>(of.group)][of.row] += of_gram.log_noise[r];
    }
  }
  return value;
}

}  // namespace gp2
