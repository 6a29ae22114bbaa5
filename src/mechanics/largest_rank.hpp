#pragma once

#include "gp2/system.hpp"

namespace gp2::internal {

/// System::largest_rank. The rank of the rows that are always there is found at states where their constraints hold; each conditional
/// row adds one, though it may follow from others. nc where the rank is not known: if some of the rows that are always there are not of
/// positions or have no residuals, or if too few such states are found. A state at which the system throws an exception is left out.
/// @param rows_may_vanish  whether a row that is 0 at such a state may be another one elsewhere, as where code switches it off; then nc
int find_largest_rank(const System& system, bool rows_may_vanish);

}  // namespace gp2::internal
