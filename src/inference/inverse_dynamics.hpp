#pragma once

#include "gp2/system.hpp"

namespace gp2 {

/// Which inputs say whether a constraint holds, and are not looked for: those of contacts, and those that a condition reads and no
/// force does (nu). None of a system that is code.
Eigen::Array<bool, Eigen::Dynamic, 1> inputs_of_sensors(const System& system);

}  // namespace gp2
