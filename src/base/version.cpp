#include "gp2/base/version.hpp"

#include "base/simd.hpp"

namespace gp2 {

const char* version() { return GP2_VERSION; }

const char* instruction_set() { return simd::target().name; }

}  // namespace gp2
