// The command chooses OpenBLAS' kernel: it starts over, once,
// where OpenBLAS took one that is too narrow (apps/gp2/blas_choice.hpp).

#include <map>
#include <sstream>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "gp2/base/blas.hpp"
#include "gp2/base/version.hpp"

namespace gp2::test {
namespace {

using testing::HasSubstr;
using testing::IsEmpty;
using testing::Not;

const std::string nothing_set = "env -u OPENBLAS_CORETYPE ";

// rows of gp2 --version --verbose
std::map<std::string, std::string> rows(const Outcome& outcome) {
  std::map<std::string, std::string> result;
  std::istringstream lines(outcome.out);
  for (std::string line; std::getline(lines, line);) {
    const std::string name = line.substr(0, 14);
    result[name.substr(0, name.find_last_not_of(' ') + 1)] = line.substr(std::min<std::size_t>(14, line.size()));
  }
  return result;
}

TEST(BlasChoice, VerboseVersionTellsBuildAndMachine) {
  const Outcome outcome = Desk().done("gp2 --version --verbose");
  std::map<std::string, std::string> told = rows(outcome);
  const BlasReport report = blas_report();
  EXPECT_EQ(told["version"], version());
  EXPECT_THAT(told["compiler"], testing::ContainsRegex("(g\\+\\+|[Cc]lang) [0-9]+"));
  EXPECT_EQ(told["BLAS library"], report.library);
  EXPECT_EQ(told["BLAS threads"], std::to_string(report.n_threads));
  EXPECT_EQ(told["processor"].find("AVX-512") == 0, processor_features().avx512);
  EXPECT_EQ(Desk().done("gp2 --verbose --version").out, outcome.out);
}

TEST(BlasChoice, VerboseIsOnlyForTheVersion) {
  const Outcome outcome = Desk().run("gp2 --verbose");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, HasSubstr("--verbose requires --version"));
}

TEST(BlasChoice, WithNothingSetTheKernelUsesTheWholeProcessor) {
  if (!processor_features().avx512) GTEST_SKIP() << "the processor has no AVX-512";
  std::map<std::string, std::string> told = rows(Desk().done(nothing_set + "gp2 --version --verbose"));
  const std::string kernel = told["BLAS kernel"].substr(0, told["BLAS kernel"].find(','));
  EXPECT_THAT(kernel, Not(IsEmpty()));
  EXPECT_EQ(recommended_kernel(kernel, processor_features()), "") << kernel;
  EXPECT_EQ(told.count("advice"), 0U);
}

TEST(BlasChoice, SettingOfTheUserWinsAndIsCommentedOn) {
  if (!processor_features().avx512) GTEST_SKIP() << "the processor has no AVX-512";
  std::map<std::string, std::string> told = rows(Desk().done("OPENBLAS_CORETYPE=Haswell gp2 --version --verbose"));
  EXPECT_EQ(told["BLAS kernel"], "Haswell, chosen by OPENBLAS_CORETYPE");
  EXPECT_EQ(
      told["advice"],
      "start the program with OPENBLAS_CORETYPE=SkylakeX in its environment: the processor has AVX-512, which the kernel in "
      "use, Haswell, leaves idle");
}

// with an OpenBLAS that chooses Haswell by itself
class NarrowBlas : public testing::Test {
 protected:
  void SetUp() override {
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
    GTEST_SKIP() << "a sanitizer wants to be the first library loaded";
#endif
    if (!processor_features().avx512) GTEST_SKIP() << "the processor has no AVX-512";
  }

  Desk desk;
  const std::string preloaded = nothing_set + "DIARY=diary LD_PRELOAD='" GP2_NARROW_BLAS "' ";

  [[nodiscard]] std::string diary() const { return desk.read("diary"); }
};

// the diary's last line: programs that the command calls find the environment as the user had it
TEST_F(NarrowBlas, CommandStartsOverOnceAndTakesTheBetterKernel) {
  std::map<std::string, std::string> told = rows(desk.done(preloaded + "gp2 --version --verbose"));
  EXPECT_EQ(told["BLAS kernel"], "SkylakeX, chosen by gp2");
  EXPECT_EQ(told.count("advice"), 0U);
  EXPECT_EQ(diary(), "gp2\ngp2\nended, variables not set\n");
}

TEST_F(NarrowBlas, CommandDoesNotStartAThirdTimeWhereTheSecondDidNotHelp) {
  const std::string kernel = rows(desk.done(preloaded + "STUBBORN_BLAS=1 gp2 --version --verbose"))["BLAS kernel"];
  EXPECT_EQ(kernel, "Haswell, chosen by gp2");
  EXPECT_EQ(diary(), "gp2\ngp2\nended, variables not set\n");
}

TEST_F(NarrowBlas, SettingOfTheUserEvenAnEmptyOneStaysAsItIs) {
  for (const std::string setting : {"Haswell", "SkylakeX", ""}) {
    const std::string variable = "OPENBLAS_CORETYPE=" + setting + " ";
    const std::string kernel = rows(desk.done(preloaded + variable + "gp2 --version --verbose"))["BLAS kernel"];
    EXPECT_THAT(kernel, HasSubstr(", chosen by OPENBLAS_CORETYPE"));
    if (!setting.empty()) {
      EXPECT_EQ(kernel.find(setting + ","), 0U) << kernel;
    }
    EXPECT_EQ(diary(), "gp2\nended, variables set\n");
    std::filesystem::remove(desk / "diary");
  }
}

TEST_F(NarrowBlas, ExitStatusAndArgumentsWithSpacesSurvive) {
  const Outcome outcome = desk.run(preloaded + "gp2 show ' no such  \"model\".toml'");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, HasSubstr(" no such  \"model\".toml"));
  EXPECT_EQ(diary(), "gp2\ngp2\nended, variables not set\n");
}

TEST_F(NarrowBlas, FirstArgumentSurvives) {
  // bash itself is not to be preloaded
  desk.done(nothing_set + "bash -c 'DIARY=diary LD_PRELOAD=\"" GP2_NARROW_BLAS "\" exec -a another gp2 --version'");
  EXPECT_EQ(diary(), "another\nanother\nended, variables not set\n");
}

TEST_F(NarrowBlas, StandardInputSurvives) {
  const Outcome outcome = desk.done(preloaded + "gp2 show /dev/stdin <models/unicycle.toml");
  EXPECT_EQ(outcome.out, desk.done("gp2 show /dev/stdin <models/unicycle.toml").out);
  EXPECT_THAT(outcome.out, HasSubstr("unicycle"));
}

}  // namespace
}  // namespace gp2::test
