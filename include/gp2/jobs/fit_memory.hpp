#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/jobs/fit_problem.hpp"

namespace gp2 GP2_API {

/// The memory of a fit at its peak, estimated before it is taken. What grows with the square of the data are triangles of the
/// reduced size r = Σ rank of what each state measures: one for each evaluation of the likelihood, one for the posterior.
struct FitMemory {
  int reduced_size = 0;   // r
  int side_by_side = 1;   // evaluations at a time
  double shared = 0;      // data and what is computed from them once   [bytes]
  double evaluation = 0;  // of the likelihood and its gradient         [bytes]
  double posterior = 0;   // when the evaluations are done              [bytes]

  [[nodiscard]] double bytes() const;  // shared + max(side_by_side · evaluation, posterior)
};

/// @throws InputError  as the fit, where the mechanics do not hold at some state
FitMemory fit_memory(const FitProblem& problem, const FitOptions& options);

/// Bytes that a process may still take without others being paged out: MemAvailable of /proc/meminfo, or less where a control
/// group (a container, a batch job) leaves less. Nothing where the system does not say.
/// @param root  where /proc and /sys are; for tests
std::optional<double> free_memory(const std::filesystem::path& root = "/");

/// The options under which a fit stays within `free` bytes: with fewer evaluations side by side where those asked for would not,
/// and then a note says so. Results do not depend on it. A fit of less than 100 MB is never touched.
/// @param free  as free_memory(); nothing: no limit
/// @throws InputError when one evaluation alone takes more, with the rows that would fit; as fit_memory.
FitOptions within_memory(const FitProblem& problem, const FitOptions& options, std::optional<double> free,
                         std::vector<std::string>& notes);

}  // namespace gp2
