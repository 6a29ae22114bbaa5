#pragma once

/// GP2_API opens namespace gp2 in every public header. A shared gp2 exports what they declare and hides the rest, JSON and TOML
/// among it; of a static one all is hidden, so that a plug-in that links it re-exports nothing.
#ifdef GP2_SHARED
#define GP2_API __attribute__((visibility("default")))
#else
#define GP2_API
#endif

#include <Eigen/Core>

namespace gp2 GP2_API {

/// How Eigen allocates: by malloc or, with more alignment than that gives, by a scheme of its own. What one side allocates the
/// other frees, so a program must agree with the library. Instruction sets beyond the platform's baseline (-mavx, -march=native),
/// an address sanitizer and macros of Eigen's change what Eigen does. A program that would not agree does not link, and the name
/// of what is missing says how to compile it; docs/when-it-fails.md has more.
template <int alignment, bool by_malloc>
struct EigenMemory {
  static const char compile_like_libgp2_or_with_EIGEN_DONT_VECTORIZE;  // it exists for what the library does
};

/// What Eigen does in this file. Without vectors of its own it does with the alignment of malloc.
using EigenMemoryHere = EigenMemory<(EIGEN_DEFAULT_ALIGN_BYTES > 0 ? EIGEN_DEFAULT_ALIGN_BYTES : 16),
                                    EIGEN_DEFAULT_ALIGN_BYTES == 0 || EIGEN_MALLOC_ALREADY_ALIGNED != 0>;

/// Asks the library for it, from each file that sees a header of gp2.
[[maybe_unused, gnu::used]] static const char* const eigen_memory_here =
    &EigenMemoryHere::compile_like_libgp2_or_with_EIGEN_DONT_VECTORIZE;

}  // namespace gp2
