#pragma once

#include "gp2/model.hpp"
#include "prior/make_prior.hpp"

namespace gp2 {

/// The words that a model's latents are written in.
inline PriorWords prior_words(const Model& model) {
  return {model.name, *model.graph, model.symbols(), [&model](const std::string& text) { return model.expression(text); }};
}

}  // namespace gp2
