// the instruction set every processor of the platform has
#define GP2_SIMD_BYTES 16
#include "base/simd_loops.hpp"

namespace gp2::simd {
extern const Target baseline;
const Target baseline = {"baseline", make_loops<double>(), make_loops<float>()};
}  // namespace gp2::simd
