#include "gp2/base/blas.hpp"

#include <string>
#include <vector>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "base/lapack.hpp"

extern "C" {
__attribute__((weak)) char* openblas_get_config();
__attribute__((weak)) char* openblas_get_corename();
__attribute__((weak)) int openblas_get_num_threads();
__attribute__((weak)) void openblas_set_num_threads(int);
}

namespace gp2 {
namespace {

constexpr ProcessorFeatures none = {.avx2 = false, .avx512 = false};
constexpr ProcessorFeatures avx2 = {.avx2 = true, .avx512 = false};
constexpr ProcessorFeatures avx512 = {.avx2 = true, .avx512 = true};

TEST(Blas, KernelIsRecommendedWhereItUsesMoreOfTheProcessor) {
  struct Row {
    std::vector<const char*> kernels;
    std::string with_none, with_avx2, with_avx512;
  };
  // the first three rows hold all kernels for x86 that OpenBLAS 0.3.21 knows but for those of its 32 bits
  const std::vector<Row> rows = {
      {{"Prescott", "Atom", "Core2", "Penryn", "Dunnington", "Nehalem", "Opteron", "Opteron_SSE3", "Barcelona", "Nano", "Bobcat",
        "Sandybridge"},
       "",
       "Haswell",
       "SkylakeX"},
      {{"Bulldozer", "Piledriver", "Steamroller", "Excavator", "Haswell", "Zen"}, "", "", "SkylakeX"},
      {{"SkylakeX", "Cooperlake"}, "", "", ""},
      {{"SapphireRapids", "NEOVERSEN1", "POWER9", "Unknown", "", "haswell"}, "", "", ""},
  };
  for (const Row& row : rows) {
    for (const char* kernel : row.kernels) {
      EXPECT_EQ(recommended_kernel(kernel, none), row.with_none) << kernel;
      EXPECT_EQ(recommended_kernel(kernel, avx2), row.with_avx2) << kernel;
      EXPECT_EQ(recommended_kernel(kernel, avx512), row.with_avx512) << kernel;
    }
  }
}

// a second start with the recommended kernel must find nothing more to do
TEST(Blas, RecommendedKernelIsFinal) {
  for (const ProcessorFeatures& features : {none, avx2, avx512}) {
    for (const char* kernel : {"Prescott", "Haswell", "Excavator"}) {
      const std::string_view better = recommended_kernel(kernel, features);
      if (!better.empty()) {
        EXPECT_EQ(recommended_kernel(better, features), "") << kernel;
      }
    }
  }
}

TEST(Blas, TheNumberOfThreadsReturnsUnlessSomebodyHasChosenAnother) {
  if (openblas_set_num_threads == nullptr) GTEST_SKIP() << "another BLAS";
  openblas_set_num_threads(3);
  {
    const lapack::SingleThread outer;
    const lapack::SingleThread inner;
    EXPECT_EQ(openblas_get_num_threads(), 1);
    {
      const lapack::ManyThreads many(2);
      EXPECT_EQ(openblas_get_num_threads(), 2);
    }
    EXPECT_EQ(openblas_get_num_threads(), 1);
  }
  EXPECT_EQ(openblas_get_num_threads(), 3);
  for (const bool many : {false, true}) {
    {
      const lapack::SingleThread single;
      const lapack::ManyThreads several(many ? 4 : 1);
      openblas_set_num_threads(2);
    }
    EXPECT_EQ(openblas_get_num_threads(), 2);
  }
}

TEST(Blas, ReportSaysWhatTheLibrarySays) {
  const BlasReport report = blas_report();
  if (openblas_get_corename == nullptr) {
    EXPECT_EQ(report.library, "unknown");
    EXPECT_EQ(report.kernel, "");
    EXPECT_EQ(report.advice, "");
    return;
  }
  EXPECT_EQ(std::string(openblas_get_config()).find(report.library + " "), 0U);
  EXPECT_THAT(report.library, testing::MatchesRegex("OpenBLAS [0-9.]+[a-z.]*"));
  EXPECT_EQ(report.kernel, openblas_get_corename());
  EXPECT_EQ(report.n_threads, openblas_get_num_threads());
}

TEST(Blas, AdviceNamesTheSettingTheProcessorAndTheKernelInUse) {
  const BlasReport report = blas_report();
  if (report.library != "unknown" && std::string(openblas_get_config()).find("DYNAMIC_ARCH") != std::string::npos) {
    EXPECT_EQ(report.fastest_kernel, recommended_kernel(report.kernel, processor_features()));
  } else {
    EXPECT_EQ(report.fastest_kernel, "");
  }
  if (report.fastest_kernel.empty()) {
    EXPECT_EQ(report.advice, "");
  } else {
    EXPECT_EQ(report.advice, "start the program with OPENBLAS_CORETYPE=" + report.fastest_kernel +
                                 " in its environment: the processor has " +
                                 (report.fastest_kernel == "SkylakeX" ? "AVX-512" : "AVX2") + ", which the kernel in use, " +
                                 report.kernel + ", leaves idle");
  }
}

TEST(Blas, Avx512ComesWithAvx2) {
  const ProcessorFeatures features = processor_features();
  EXPECT_TRUE(features.avx2 || !features.avx512);
}

}  // namespace
}  // namespace gp2
