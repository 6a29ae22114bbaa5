#include <algorithm>

#include <fmt/format.h>

#include "gp2/baselines/baseline.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/symbolic_system.hpp"
#include "model/other_system.hpp"
#include "model/prior_words.hpp"
#include "prior/expression_function.hpp"
#include "prior/make_prior.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {

using Eigen::Index;

const std::vector<std::string>& Baseline::words() {
  static const std::vector<std::string> words = {"se", "icm", "lmc"};
  return words;
}

std::string Baseline::word(Kind kind) { return words()[static_cast<std::size_t>(kind)]; }

std::optional<Baseline::Kind> Baseline::kind_of(std::string_view word) {
  const auto found = std::find(words().begin(), words().end(), word);
  if (found == words().end()) return std::nullopt;
  return static_cast<Kind>(found - words().begin());
}

namespace {

void require_size(const Eigen::VectorXd& values, std::size_t size, const char* what, const char* of) {
  if (values.size() == static_cast<Index>(size)) return;
  throw InputError(
      fmt::format("{} of a baseline must hold one number for each of the {} {}, got {}", what, size, of, values.size()));
}

// What a baseline's latents are made of: the features of the model's latents, each once, and every entry of the state that the
// mechanics read and no latent does. What a latent need not learn a baseline must.
struct Parts {
  std::shared_ptr<const System> fitted;
  PriorWords words;
  std::vector<std::string> names;
  std::vector<Expression> raw;
  std::size_t n_of_latents = 0;

  explicit Parts(const Model& model) : fitted(model.system), words(prior_words(model)) {
    for (const LatentSpec& latent : model.latents) {
      if (latent.feature_code) {
        throw InputError(fmt::format("{}: a baseline needs features as expressions, but those of the latent '{}' are code",
                                     model.name, latent.name));
      }
      for (const std::string& feature : latent.features) {
        if (std::find(names.begin(), names.end(), feature) != names.end()) continue;
        names.push_back(feature);
        raw.push_back(words.with_values(words.parse(feature), *model.system));
      }
    }
    n_of_latents = names.size();
    add_states_of(*model.system);
  }

  void add_states_of(const System& system) {
    const std::vector<std::string> state_names = system.state_names();
    const std::vector<Expression> state = words.symbols.state();
    const std::vector<bool> mechanics = system.reads(SystemPart::mechanics), force = system.reads(SystemPart::force);
    const std::size_t n = raw.size();
    for (std::size_t k = 0; k < state.size(); ++k) {
      const auto reads = [&](Expression feature) { return words.graph.depends_on(feature, state[k]); };
      const auto end = raw.begin() + static_cast<std::ptrdiff_t>(n);
      if (!(mechanics[k] || force[k]) || std::any_of(raw.begin(), end, reads)) continue;
      names.push_back(state_names[k]);
      raw.push_back(state[k]);
    }
  }

  /// The first n: files of earlier versions have the features of the latents alone.
  void keep(std::size_t n) {
    names.resize(n);
    raw.erase(raw.begin() + static_cast<std::ptrdiff_t>(n), raw.end());
  }

  [[nodiscard]] Latent latent(std::string name, const char* kernel, const std::vector<Expression>& features) const {
    Latent latent;
    latent.name = std::move(name);
    latent.feature_names = names;
    latent.features = ExpressionFunction::of_state(features, words.symbols, fitted);
    latent.kernel = Kernel::parse(kernel, latent.feature_names);
    return latent;
  }
};

// Of unit masses that nothing constrains or moves: ddq = ā, also where M is singular.
std::shared_ptr<const System> without_mechanics(const Model& model) {
  const System& system = *model.system;
  const auto nq = static_cast<std::size_t>(system.nq());
  const Expression zero = model.graph->constant(0), one = model.graph->constant(1);
  std::vector<std::vector<Expression>> identity(nq, std::vector<Expression>(nq, zero));
  for (std::size_t j = 0; j < nq; ++j) identity[j][j] = one;
  return std::make_shared<const SymbolicSystem>(SymbolicSystem::Definition{system.name(),
                                                                           system.coordinates(),
                                                                           system.inputs(),
                                                                           system.parameters(),
                                                                           model.graph,
                                                                           std::move(identity),
                                                                           std::vector<Expression>(nq, zero),
                                                                           {}});
}

}  // namespace

const char* LoadingEntry::word(Kind kind) { return kind == Kind::mixing ? "mixing" : "sqrt_kappa"; }

std::vector<LoadingEntry> loading_entries(const Latent& latent) {
  if (!latent.free_loading) return {};
  const int p = latent.size(), rank = *latent.free_loading - p;
  std::vector<LoadingEntry> entries;
  for (int k = 0; k < p * rank; ++k) entries.push_back({LoadingEntry::Kind::mixing, k % p, k / p, k, k});
  for (int j = 0; j < p; ++j) entries.push_back({LoadingEntry::Kind::sqrt_kappa, j, j, j, (rank + j) * p + j});
  return entries;
}

Baseline unstandardised(const Model& model, Baseline::Kind kind) {
  require_system(model.system);
  const auto n_features = static_cast<Index>(Parts(model).names.size());
  using Eigen::VectorXd;
  return {kind, VectorXd::Zero(model.system->nq()), VectorXd::Zero(n_features), VectorXd::Ones(n_features)};
}

Prior make_baseline_prior(const Model& model, const Baseline& baseline) {
  require_system(model.system);
  const internal::StepLimit limit;
  const System& system = *model.system;
  ExpressionGraph& graph = *model.graph;
  Parts parts(model);
  if (baseline.feature_mean.size() == static_cast<Index>(parts.n_of_latents)) parts.keep(parts.n_of_latents);
  const auto n_outputs = static_cast<std::size_t>(system.nq());
  require_size(baseline.output_mean, n_outputs, "output_mean", "outputs");
  require_size(baseline.feature_mean, parts.names.size(), "feature_mean", "features");
  require_size(baseline.feature_stddev, parts.names.size(), "feature_stddev", "features");

  Prior prior{without_mechanics(model), {}, Prior::Mean::constant, baseline.output_mean, model.system};
  if (baseline.kind == Baseline::Kind::se) {
    // latent j acts on output j
    for (std::size_t j = 0; j < n_outputs; ++j) {
      const std::string output = system.coordinates()[j].acceleration();
      Latent latent = parts.latent(output, "se", parts.raw);
      latent.column_names = {output};
      std::vector<Expression> unit(n_outputs, graph.constant(0));
      unit[j] = graph.constant(1);
      latent.directions = ExpressionFunction::of_state_and_parameters(unit, parts.words.symbols, graph, model.system);
      prior.latents.push_back(std::move(latent));
    }
    return prior;
  }

  prior.latents = {parts.latent("se", "se", parts.raw)};
  if (baseline.kind == Baseline::Kind::lmc) {
    std::vector<Expression> standardised;
    for (std::size_t d = 0; d < parts.raw.size(); ++d) {
      const auto row = static_cast<Index>(d);
      standardised.push_back((parts.raw[d] - graph.constant(baseline.feature_mean[row])) /
                             graph.constant(baseline.feature_stddev[row]));
    }
    prior.latents.push_back(parts.latent("bias", "constant", parts.raw));
    prior.latents.push_back(parts.latent("linear", "linear", standardised));
    prior.latents.back().kernel_is_fixed = true;
  }
  for (Latent& latent : prior.latents) {
    for (const Coordinate& coordinate : system.coordinates()) latent.column_names.push_back(coordinate.acceleration());
    latent.free_loading = static_cast<int>(2 * n_outputs);  // [W, diag √κ]
  }
  return prior;
}

Prior make_prior(const Model& model, const FitPriorOptions& options) {
  if (options.baseline) return make_baseline_prior(model, *options.baseline);
  return make_prior(model, static_cast<const PriorOptions&>(options));
}

std::shared_ptr<const OtherSystem> make_other_system(const Model& fitted, const Model& other, const FitPriorOptions& options) {
  if (!options.baseline) return make_other_system(fitted, other, static_cast<const PriorOptions&>(options));
  // means and deviations are of the features of the fitted system: first see whether they are the same there
  const auto unscaled = [&](const Model& model) {
    return make_baseline_prior(model, unstandardised(model, options.baseline->kind));
  };
  require_same_latents(fitted, unscaled(fitted), other, unscaled(other));
  return share_parameters(fitted, make_baseline_prior(fitted, *options.baseline), other,
                          make_baseline_prior(other, *options.baseline));
}

}  // namespace gp2
