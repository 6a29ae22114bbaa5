#pragma once

#include <cstddef>
#include <vector>

#include <sys/mman.h>

namespace gp2 {

/// OpenBLAS maps a buffer of this size for each thread that calls it, and where it gets none tries again for ever.
inline constexpr double blas_buffer = 128 * 1024. * 1024;

/// Whether the system gives so many bytes in each of several pieces, all at a time. Nothing is kept.
inline bool maps(double bytes, int n_pieces) {
  const auto size = static_cast<std::size_t>(bytes);
  std::vector<void*> pieces;
  bool all = true;
  for (int k = 0; k < n_pieces && all; ++k) {
    void* const piece = mmap(nullptr, size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    all = piece != MAP_FAILED;
    if (all) pieces.push_back(piece);
  }
  for (void* const piece : pieces) munmap(piece, size);
  return all;
}

}  // namespace gp2
