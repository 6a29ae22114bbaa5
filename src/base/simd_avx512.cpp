// compiled with AVX-512: src/CMakeLists.txt
#define GP2_SIMD_BYTES 64
#include "base/simd_loops.hpp"

namespace gp2::simd {
extern const Target avx512;
const Target avx512 = {"AVX-512", make_loops<double>(), make_loops<float>()};
}  // namespace gp2::simd
