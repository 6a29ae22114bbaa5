#include "base/simd.hpp"

namespace gp2::simd {

extern const Target baseline;
#if defined(GP2_SIMD_X86)
extern const Target avx2, avx512;
#endif

namespace {

struct Targets {
  const Target* known[3] = {&baseline, nullptr, nullptr};
  int count = 1;

  Targets() {
#if defined(GP2_SIMD_X86)
    // asks the operating system too: it must save the wide registers
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) known[count++] = &avx2;
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl")) {
      known[count++] = &avx512;
    }
#endif
  }
};

const Targets& all() {
  static const Targets targets;
  return targets;
}

}  // namespace

const Target& target() {
  const Targets& known = all();
  return *known.known[known.count - 1];
}

const Target* const* targets(int& count) {
  count = all().count;
  return all().known;
}

}  // namespace gp2::simd
