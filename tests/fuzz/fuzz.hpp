#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string_view>

#include "gp2/error.hpp"

/// What every target defines. @returns 0, or −1 for an input that is not worth keeping
extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size);

namespace gp2::test {

inline std::string_view text_of(const std::uint8_t* data, std::size_t size) {
  return {reinterpret_cast<const char*>(data), size};
}

/// Ends the process, which is what a fuzzer takes for a finding.
inline void require(bool good, const char* law) {
  if (good) return;
  static_cast<void>(std::fprintf(stderr, "broken: %s\n", law));
  std::abort();
}

/// Calls f, which may find fault with its input, in words, and otherwise must go well. @returns whether it did
template <class F>
bool accepts(F f) {
  try {
    f();
    return true;
  } catch (const InputError& error) {
    require(*error.what() != '\0', "an error has a text");
    return false;
  }
}

}  // namespace gp2::test
