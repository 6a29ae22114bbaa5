#pragma once

#include <string>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/model.hpp"

namespace gp2 GP2_API {

struct ShowRequest {
  bool latex = false;  // M, F, A and b alone
  bool full = false;   // long expressions too, which otherwise are counted
};
std::vector<Option> options(ShowRequest& request);

/// What a model means: the derived A, b, M, F, its parameters and latents, as text.
/// @throws InputError where its mechanics are code.
std::string show(const Model& model, const ShowRequest& request = {});

}  // namespace gp2
