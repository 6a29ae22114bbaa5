#pragma once

#include <functional>
#include <string>
#include <vector>

#include "gp2/mechanics/symbolic_system.hpp"
#include "gp2/prior/latent_spec.hpp"

namespace gp2 {

/// What the words of a prior mean: expressions of one graph, which grows.
struct PriorWords {
  std::string source;  // stands for them in messages
  ExpressionGraph& graph;
  SystemSymbols symbols;
  std::function<Expression(const std::string&)> parse;

  /// Parameters keep their values: kernels would otherwise have to be differentiated in θ.
  [[nodiscard]] Expression with_values(Expression e, const System& system) const;
};

/// make_prior with words of another vocabulary, that of a model file, say.
Prior make_prior(std::shared_ptr<const System> system, const std::vector<LatentSpec>& latents, const PriorOptions& options,
                 const PriorWords& words);

/// @throws InputError when there is none.
void require_system(const std::shared_ptr<const System>& system);

/// A feature that is an angle becomes its sine and cosine; another stays.
std::vector<std::string> expand_angle(const std::string& feature, const std::vector<Coordinate>& coordinates);

/// The lengthscales of single features, in their order; empty where the latent has none.
/// @throws InputError when no feature goes by a name, one has two, or the kernel has none in the unit of a feature.
std::vector<Latent::Range> lengthscales_of(const LatentSpec& spec, const Kernel& kernel, const std::vector<std::string>& features,
                                           const std::vector<Coordinate>& coordinates);

}  // namespace gp2
