#pragma once

#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "gp2/base/workers.hpp"
#include "gp2/observations.hpp"

// Several processes that mpirun has started together. Without MPI in the build, or without mpirun, there is one.
namespace gp2::command {

/// How many processes were started together, as their environment says.
int n_started_together();

/// The processes that were started together, this one among them; null where it was started alone. All but the first are silent from
/// then on, but for what abort_ranks says.
/// @throws InputError when gp2 was built without MPI, or they are no equals: other versions of gp2, other kernels of OpenBLAS.
std::shared_ptr<const Ranks> join_ranks();

/// @throws InputError when one of them has read other data than the first.
void require_same_data(const Ranks& ranks, const std::vector<Observations>& observations);

/// After the work; does nothing where none were joined.
void leave_ranks();

/// Ends all processes that were joined, and says why where the first one has not: an error of all is told once.
void abort_ranks(int exit_code, std::string_view why);

}  // namespace gp2::command
