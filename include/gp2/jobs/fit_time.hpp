#pragma once

#include <string>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/jobs/fit_problem.hpp"

namespace gp2 GP2_API {

/// Seconds that one evaluation of the likelihood and its gradient takes on this machine, estimated from some of the states: what
/// grows with the cube of the reduced size and what grows with its square are timed apart. Takes a second or so.
/// @param reduced_size  of all states
/// @throws InputError  as the fit, where the mechanics do not hold at some state
double evaluation_seconds(const FitProblem& problem, const FitOptions& options, int reduced_size);

/// A note where an evaluation takes more than 10 s.
/// @param takes_points  whether inducing points may stand for the rows
void note_time(double seconds, int reduced_size, std::vector<std::string>& notes, bool takes_points = true);

/// The same of a fit; a small one is not timed, nor one to windows, whose states are few.
void note_time(const FitProblem& problem, const FitOptions& options, int reduced_size, std::vector<std::string>& notes);

}  // namespace gp2
