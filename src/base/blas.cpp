#include "gp2/base/blas.hpp"

#include <algorithm>
#include <array>

#include <fmt/format.h>

#include "base/lapack.hpp"

// present in OpenBLAS only
extern "C" {
__attribute__((weak)) char* openblas_get_config();
__attribute__((weak)) char* openblas_get_corename();
__attribute__((weak)) int openblas_get_num_threads();
}

namespace gp2 {

namespace {

// weak symbols alone would let the linker leave OpenBLAS out of a program that calls nothing but blas_report()
[[gnu::used]] constexpr auto needed = &dpotrf_;

// OpenBLAS' names of its kernels, by the widest instructions they use; driver/others/dynamic.c has them all
constexpr std::array without_avx2 = {"Katmai",       "Coppermine", "Northwood",  "Prescott", "Banias",     "Atom",
                                     "Core2",        "Penryn",     "Dunnington", "Nehalem",  "Athlon",     "Opteron",
                                     "Opteron_SSE3", "Barcelona",  "Nano",       "Bobcat",   "Sandybridge"};
constexpr std::array of_bulldozers = {"Bulldozer", "Piledriver", "Steamroller", "Excavator"};
constexpr std::array with_avx2 = {"Haswell", "Zen"};

bool contains(const auto& names, std::string_view name) { return std::find(names.begin(), names.end(), name) != names.end(); }

// "OpenBLAS 0.3.21 NO_LAPACKE DYNAMIC_ARCH …" -> "OpenBLAS 0.3.21"
std::string first_two_words(std::string_view text) {
  const std::size_t first = text.find(' ');
  return std::string(text.substr(0, first == std::string_view::npos ? first : text.find(' ', first + 1)));
}

}  // namespace

ProcessorFeatures processor_features() {
  ProcessorFeatures features;
#if defined(__x86_64__) || defined(__i386__)
  // these ask the operating system too (XCR0)
  features.avx2 = __builtin_cpu_supports("avx2") != 0 && __builtin_cpu_supports("fma") != 0;
  features.avx512 = features.avx2 && __builtin_cpu_supports("avx512f") != 0 && __builtin_cpu_supports("avx512cd") != 0 &&
                    __builtin_cpu_supports("avx512bw") != 0 && __builtin_cpu_supports("avx512dq") != 0 &&
                    __builtin_cpu_supports("avx512vl") != 0;
#endif
  return features;
}

std::string_view recommended_kernel(std::string_view kernel_in_use, const ProcessorFeatures& features) {
  const bool narrow = contains(without_avx2, kernel_in_use);
  // Cooperlake, and SapphireRapids of later versions, share SkylakeX' double precision but ask for more of the processor
  if (features.avx512 && (narrow || contains(of_bulldozers, kernel_in_use) || contains(with_avx2, kernel_in_use)))
    return "SkylakeX";
  if (features.avx2 && narrow) return "Haswell";
  return "";
}

BlasReport blas_report() {
  BlasReport report;
  report.library = "unknown";
  if (openblas_get_config == nullptr || openblas_get_corename == nullptr) return report;
  const std::string_view config = openblas_get_config();
  report.library = first_two_words(config);
  report.kernel = openblas_get_corename();
  if (openblas_get_num_threads != nullptr) report.n_threads = openblas_get_num_threads();

  // only a library built with all kernels can change between them
  if (config.find("DYNAMIC_ARCH") == std::string_view::npos) return report;
  const ProcessorFeatures features = processor_features();
  report.fastest_kernel = recommended_kernel(report.kernel, features);
  if (!report.fastest_kernel.empty()) {
    report.advice = fmt::format(
        "start the program with OPENBLAS_CORETYPE={} in its environment: the processor has {}, which the kernel in use, {}, "
        "leaves idle",
        report.fastest_kernel, features.avx512 ? "AVX-512" : "AVX2", report.kernel);
  }
  return report;
}

}  // namespace gp2
