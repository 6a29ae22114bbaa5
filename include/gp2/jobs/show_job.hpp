#pragma once

#include <string>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/model.hpp"

namespace gp2 GP2_API {

struct ShowRequest {
  bool latex = false;  // M, F, A and b alone
  bool full = false;   // long expressions too, which otherwise are counted
  bool json = false;   // all of it, as JSON
};
std::vector<Option> options(ShowRequest& request);

/// What a model means: the derived A, b, M, F, its parameters and latents, as text.
/// @throws InputError where its mechanics are code; for `latex` and `json` together.
std::string show(const Model& model, const ShowRequest& request = {});

/// What a fit was learned from, what it found and what it said of itself, before what its model means.
/// @throws InputError as of a model.
std::string show(const FitFile& fit, const ShowRequest& request, const Spelling& spelled);

/// "position", "velocity" or "acceleration".
const char* word_of(ConstraintRow::Level level);

/// How a fit ended, and its hyperparameters with their standard errors and the model's units, a line each.
std::string text_of(const FitReport& report, const Model& model);

/// The unit of a hyperparameter where the model states it; empty: it does not.
std::string unit_of(const Hyperparameter& h, const Model& model);

}  // namespace gp2
