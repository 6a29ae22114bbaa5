#include "gp2/base/version.hpp"

#include "base/simd.hpp"

namespace gp2 {

template <int alignment, bool by_malloc>
const char EigenMemory<alignment, by_malloc>::compile_like_libgp2_or_with_EIGEN_DONT_VECTORIZE = 0;
template struct EigenMemory<(EIGEN_DEFAULT_ALIGN_BYTES > 0 ? EIGEN_DEFAULT_ALIGN_BYTES : 16),
                            EIGEN_DEFAULT_ALIGN_BYTES == 0 || EIGEN_MALLOC_ALREADY_ALIGNED != 0>;

const char* version() { return GP2_VERSION; }

const char* instruction_set() { return simd::target().name; }

}  // namespace gp2
