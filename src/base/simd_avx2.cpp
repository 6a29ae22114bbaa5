// compiled with AVX2 and FMA: src/CMakeLists.txt
#define GP2_SIMD_BYTES 32
#include "base/simd_loops.hpp"

namespace gp2::simd {
extern const Target avx2;
const Target avx2 = {"AVX2", make_loops<double>(), make_loops<float>()};
}  // namespace gp2::simd
