#pragma once

#include "gp2/export.hpp"

namespace gp2 GP2_API {

/// The version of the library, say "0.1.0".
const char* version();

/// The instruction set that the library's own loops use on this processor: "AVX-512", "AVX2" or "baseline".
const char* instruction_set();

}  // namespace gp2
