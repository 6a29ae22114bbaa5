#pragma once

#include "gp2/system.hpp"

namespace gp2::internal {

/// System::largest_rank, found at states where the constraints hold; nc where that is not known: if not all of them are of positions
/// and hold always, if there are no residuals, or if too few such states are found. A state at which the system throws an exception
/// is left out.
/// @param rows_may_vanish  whether a row that is 0 at such a state may be another one elsewhere, as where code switches it off; then nc
int find_largest_rank(const System& system, bool rows_may_vanish);

}  // namespace gp2::internal
