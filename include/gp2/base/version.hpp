#pragma once

namespace gp2 {

/// The version of the library, say "0.1.0".
const char* version();

/// The instruction set that the library's own loops use on this processor: "AVX-512", "AVX2" or "baseline".
const char* instruction_set();

}  // namespace gp2
