#pragma once

#include <map>
#include <string>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/posterior.hpp"
#include "gp2/view.hpp"

namespace gp2 GP2_API {

struct CSourceOptions {
  std::string name = "gp2_model";       // what the files and every name in them begin with: a C identifier
  bool stddev = true;                   // NAME_mean_and_stddev: stores n²/2 numbers of n reduced observations
  bool jacobian = true;                 // NAME_mean_and_jacobian
  bool single_precision = false;        // everything in float
  bool portable_math = false;           // the same bits on every machine: functions of its own for those of <math.h>
  std::vector<std::string> about = {};  // lines at the head of the header
  /// For comments, by the names of the state, of what is predicted and of parameters.
  std::map<std::string, std::string> units = {};
};

/// A predictor as C99.
struct CSource {
  std::string header, source;  // NAME.h, NAME.c
};

/// What Predictor computes, in C99 that needs <math.h> alone: mean, standard deviation and Jacobian of a view, with the equations
/// of the model, the projection onto its constraints, and what was learned as constants; of a mixture its moments. The functions
/// allocate nothing and are reentrant: whoever calls them has a workspace. NAME_self_test predicts at states whose predictions
/// by Predictor stand in the file.
///
/// In single precision all of it is float, the mechanics too. What rounding of the terms alone makes of the sums over the points of a
/// posterior, ε Σ_j |k_j β_j| of each latent function, is held against the standard deviation of that function at observed states;
/// rounding of the n additions may make up to n/8 + 16 times as much.
///
/// @throws InputError as require_view; when the name is no C identifier, there are no observations, the system, features or
///   directions are code and not expressions, or single precision is off: the mean by more than a
///   fiftieth of a standard deviation, or a variance by more than a twentieth of itself.
[[nodiscard]] CSource export_c(const Posterior& posterior, const View& view, const CSourceOptions& options = {});

}  // namespace gp2
