#pragma once

#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/jobs/fit_problem.hpp"

namespace gp2 GP2_API {

/// The memory of a fit at its peak, estimated before it is taken. What grows with the square of the data are triangles of the
/// reduced size r = Σ rank of what each state measures: one for each evaluation of the likelihood, one for the posterior. Through
/// inducing points they are a few squares of the number of inducing variables.
struct FitMemory {
  int reduced_size = 0;   // r
  int side_by_side = 1;   // evaluations at a time
  double shared = 0;      // data and what is computed from them once   [bytes]
  double evaluation = 0;  // of the likelihood and its gradient         [bytes]
  double posterior = 0;   // when the evaluations are done              [bytes]

  /// What is asked of the system in one piece: the whole square of which a triangle is touched, and the buffer of BLAS.
  double asked_by_evaluation = 0, asked_by_posterior = 0;  // [bytes]

  [[nodiscard]] double bytes() const;  // shared + max(side_by_side · evaluation, posterior)
};

/// @throws InputError  as the fit, where the mechanics do not hold at some state
FitMemory fit_memory(const FitProblem& problem, const FitOptions& options);

/// Bytes that a process may still take without others being paged out: MemAvailable of /proc/meminfo, or less where a control
/// group (a container, a batch job) leaves less. Nothing where the system does not say.
/// @param root  where /proc and /sys are; for tests
std::optional<double> free_memory(const std::filesystem::path& root = "/");

/// Whether the system gives so many bytes in each of several pieces, all at a time. It refuses what goes beyond a limit on the
/// address space (ulimit -v), and a piece beyond what the machine has. Nothing is kept.
bool is_given(double bytes, int n_pieces);

/// The options under which a fit stays within `free` bytes: with fewer evaluations side by side where those asked for would not,
/// and then a note says so. Results do not depend on it. A fit of less than 100 MB is never touched.
/// @param free   as free_memory(); nothing: no limit
/// @param given  as is_given: what the system does not give is not begun, also for a small fit
/// @throws InputError when one evaluation alone takes more, with the rows that would fit; as fit_memory.
FitOptions within_memory(const FitProblem& problem, const FitOptions& options, std::optional<double> free,
                         std::vector<std::string>& notes, const std::function<bool(double, int)>& given = is_given);

}  // namespace gp2
