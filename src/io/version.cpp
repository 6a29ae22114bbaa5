#include "gp2/version.hpp"

#include "prior/simd.hpp"

namespace gp2 {

const char* version() { return GP2_VERSION; }

const char* instruction_set() { return simd::target().name; }

}  // namespace gp2
