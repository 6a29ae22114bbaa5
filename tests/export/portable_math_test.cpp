#include "export/portable_math.hpp"

#include <cmath>
#include <map>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "base/random.hpp"
#include "export/compiled.hpp"
#include "inference/problems.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::Problem;
using testing::HasSubstr;

constexpr std::uint64_t portable_seed = 424243;
constexpr double infinity = HUGE_VAL;

// what a function of C may be off, and where
struct Accuracy {
  const char* name;
  long double (*exact)(long double);
  double lower, upper, ulps;
};

// call_exp(x), call_pow(x, y), … of the functions alone
test::Library portable_functions() {
  std::string source = "#include <math.h>\n";
  for (const auto& piece : c_export::portable_pieces) source += fmt::format("\n{}", piece.text);
  for (const char* name : {"exp", "log", "sin", "cos", "tan", "atan", "asin", "acos", "sinh", "cosh", "tanh"}) {
    source += fmt::format("double call_{0}(double x);\ndouble call_{0}(double x)\n{{\n  return portable_{0}(x);\n}}\n", name);
  }
  for (const char* name : {"atan2", "pow"}) {
    source += fmt::format(
        "double call_{0}(double x, double y);\ndouble call_{0}(double x, double y)\n{{\n  return portable_{0}(x, y);\n}}\n",
        name);
  }
  return {{{"functions.c", source}}, "gcc -O2"};
}

double ulps(double is, long double exact) {
  return static_cast<double>(std::abs(is - exact) / std::ldexp(1.0L, std::ilogb(static_cast<double>(exact)) - 52));
}

// at the ends of what a function takes: not finite, or 0, to the sign; else to rounding
void expect_at_end(double is, double expected, double smallest, const std::string& what) {
  EXPECT_EQ(std::isnan(is), std::isnan(expected)) << what;
  if (std::isnan(expected)) return;
  EXPECT_EQ(std::signbit(is), std::signbit(expected)) << what;
  if (std::isinf(expected) || std::abs(expected) <= smallest) {
    EXPECT_EQ(is, expected) << what;
  } else {
    EXPECT_NEAR(is / expected, 1, 1e-15) << what;
  }
}

TEST(PortableMath, IsAccurateAsItsDocumentationSays) {
  using Exact = long double (*)(long double);
  const Accuracy all[] = {
      {"exp", static_cast<Exact>(std::exp), -708, 709, 1},   {"exp", static_cast<Exact>(std::exp), -1, 1, 1},
      {"log", static_cast<Exact>(std::log), 0.4, 2.5, 1},    {"log", static_cast<Exact>(std::log), 1e-300, 1e-290, 1},
      {"sin", static_cast<Exact>(std::sin), -7, 7, 1},       {"sin", static_cast<Exact>(std::sin), -1e6, 1e6, 1},
      {"cos", static_cast<Exact>(std::cos), -7, 7, 1},       {"cos", static_cast<Exact>(std::cos), -1e6, 1e6, 1},
      {"tan", static_cast<Exact>(std::tan), -7, 7, 4},       {"atan", static_cast<Exact>(std::atan), -3, 3, 4},
      {"atan", static_cast<Exact>(std::atan), -1e6, 1e6, 4}, {"asin", static_cast<Exact>(std::asin), -1, 1, 4},
      {"acos", static_cast<Exact>(std::acos), -1, 1, 4},     {"sinh", static_cast<Exact>(std::sinh), -2, 2, 4},
      {"sinh", static_cast<Exact>(std::sinh), -710, 710, 4}, {"cosh", static_cast<Exact>(std::cosh), -2, 2, 4},
      {"cosh", static_cast<Exact>(std::cosh), -710, 710, 4}, {"tanh", static_cast<Exact>(std::tanh), -2, 2, 4}};
  const test::Library library = portable_functions();
  RandomStream random(portable_seed);
  for (const Accuracy& of : all) {
    auto* const function = library.get<double(double)>(fmt::format("call_{}", of.name));
    double worst = 0;
    for (int i = 0; i < 100000; ++i) {
      const double x = of.lower + (of.upper - of.lower) * random.uniform();
      worst = std::max(worst, ulps(function(x), of.exact(x)));
    }
    EXPECT_LE(worst, of.ulps) << of.name << " on " << of.lower << " … " << of.upper;
    EXPECT_GT(worst, 0.1) << of.name;
  }
  auto* const atan2 = library.get<double(double, double)>("call_atan2");
  for (int i = 0; i < 100000; ++i) {
    const double y = random.normal(), x = random.normal();
    ASSERT_LE(ulps(atan2(y, x), std::atan2(static_cast<long double>(y), static_cast<long double>(x))), 4) << y << ", " << x;
  }
}

TEST(PortableMath, IsRightAtTheEnds) {
  const test::Library library = portable_functions();
  const auto at = [&](const char* name, double x) { return library.get<double(double)>(fmt::format("call_{}", name))(x); };
  for (const auto& [name, exact] : std::map<const char*, double (*)(double)>{{"exp", std::exp},
                                                                             {"log", std::log},
                                                                             {"sin", std::sin},
                                                                             {"atan", std::atan},
                                                                             {"asin", std::asin},
                                                                             {"acos", std::acos},
                                                                             {"sinh", std::sinh},
                                                                             {"cosh", std::cosh},
                                                                             {"tanh", std::tanh}}) {
    for (const double x : {0.0, -0.0, 1.0, -1.0, infinity, -infinity, 5e-324, -1e-310, 720.0, -750.0}) {
      expect_at_end(at(name, x), exact(x), 0, fmt::format("{} of {}", name, x));
    }
    EXPECT_TRUE(std::isnan(at(name, std::nan("")))) << name;
  }
  auto* const atan2 = library.get<double(double, double)>("call_atan2");
  for (const double y : {0.0, -0.0, 1.0, -1.0, infinity, -infinity}) {
    for (const double x : {0.0, -0.0, 1.0, -1.0, infinity, -infinity}) {
      EXPECT_NEAR(atan2(y, x), std::atan2(y, x), 1e-15);
      EXPECT_EQ(std::signbit(atan2(y, x)), std::signbit(std::atan2(y, x)));
    }
  }
  EXPECT_TRUE(std::isnan(at("sin", 1.1e6))) << "told, not wrong";
}

TEST(PortableMath, HasPowersAsItsDocumentationSays) {
  const test::Library library = portable_functions();
  RandomStream random(portable_seed);
  auto* const pow = library.get<double(double, double)>("call_pow");
  const auto pow_ulps = [&](double x, double y) {
    return ulps(pow(x, y), std::pow(static_cast<long double>(x), static_cast<long double>(y)));
  };
  double worst = 0;
  for (int i = 0; i < 100000; ++i) {
    const double x = std::exp(10 * random.normal()),
                 y = (1400 * random.uniform() - 700) / std::log(x);  // all powers that a double holds
    if (std::isfinite(y)) worst = std::max(worst, pow_ulps(x, y));
    worst = std::max(worst, pow_ulps(random.uniform() + 0.5, 3 * random.normal()));
    worst = std::max(worst, pow_ulps(1 + 1e-8 * random.normal(), 1e9 * random.uniform()));
  }
  EXPECT_LE(worst, 2);
  EXPECT_GT(worst, 0.1);
  for (const double x : {0.0, -0.0, 1.0, -1.0, 2.0, -2.0, 0.3, -0.3, 5e-324, -1e300, infinity, -infinity, std::nan("")}) {
    for (const double y :
         {0.0, -0.0, 1.0, -1.0, 2.0, -3.0, 0.5, -1.5, 1e15 + 1, 1e17, -1e300, 1e-300, infinity, -infinity, std::nan("")}) {
      expect_at_end(pow(x, y), std::pow(x, y), 1e-300, fmt::format("{}^{}", x, y));
    }
  }
}

const Model& model_with_every_function() {
  static const Model model = Model::parse(R"toml(
name        = "every function"
coordinates = ["x", "y"]
inputs      = ["u"]
[mechanics]
mass  = [["3 + sin(y)", "0.3*tanh(x)"], ["0.3*tanh(x)", "2 + cosh(y)"]]
force = ["-x*abs(dx) + min(x, u) + tan(0.3*tanh(x)) + log(2 + x^2)", "max(y, dx)^3 + asin(tanh(x)) + acos(tanh(y)) + sinh(0.1*x) + (2 + x^2)^1.3"]
[constraints]
acceleration = ["ddx*cos(y) + ddy*exp(-x^2) + atan(dx) + atan2(dy, 1 + x^2)"]
[[latent]]
kernel     = "se*periodic + rq + matern52 + matern32*linear"
features   = ["x", "sin(y)", "u^2"]
directions = "force"
)toml",
                                          "every function");
  return model;
}

Problem problem_with_every_function() {
  Problem p;
  p.name = "every function";
  p.prior = make_prior(model_with_every_function(), {Prior::Mean::force, std::nullopt, false, std::nullopt});
  RandomStream random(portable_seed);
  const MatrixXd states = test::random_matrix(6, 20, random);
  p.observations = {test::observe(model_with_every_function(), View::constrained_acceleration(*p.prior.system), states, random)};
  p.values = test::random_values(p.prior, p.observations, random);
  return p;
}

// mean, standard deviation and Jacobian at 200 states, bit by bit
std::string main_of_bits(bool single_precision) {
  RandomStream random(portable_seed + 1);
  std::string states;
  for (int i = 0; i < 200; ++i) {
    states += "{";
    for (int k = 0; k < 6; ++k) {
      const double x = random.normal();
      states += single_precision ? fmt::format("{}F, ", static_cast<float>(x)) : fmt::format("{}, ", x);
    }
    states += "},\n";
  }
  return R"c(#include <stdio.h>
#include <string.h>
#include "gp2_model.h"
static gp2_model_workspace w;
static const gp2_model_real states[200][6] = {)c" +
         states + R"c(};
static void print(const gp2_model_real *x, int n)
{
  unsigned char bytes[sizeof *x];
  for (int i = 0; i < n; ++i) {
    memcpy(bytes, x + i, sizeof bytes);
    printf(" ");
    for (int k = 0; k < (int)sizeof bytes; ++k) printf("%02x", (unsigned)bytes[k]);
  }
}
int main(void)
{
  int failed = gp2_model_self_test(&w);
  for (int i = 0; i < 200; ++i) {
    gp2_model_real mean[2], stddev[2], jacobian[12];
    const int status = (int)gp2_model_mean_and_stddev(states[i], mean, stddev, &w);
    printf("%d", status);
    if (status == 0) print(mean, 2), print(stddev, 2);
    if (gp2_model_mean_and_jacobian(states[i], mean, jacobian, &w) == 0) print(jacobian, 12);
    printf("\n");
  }
  printf("%d\n", failed);
  return failed;
}
)c";
}

// what a microcontroller with a Cortex-M7 does before main: its floating-point unit on
constexpr const char* start_of_cortex_m7 = R"c(extern void _start(void);
static void reset(void)
{
  *(volatile unsigned *)0xE000ED88u |= 0xFu << 20;
  __asm volatile("dsb\n isb");
  _start();
}
__attribute__((section(".vectors"), used)) void (*const vectors[])(void) = {(void (*)(void))0x203FFFF0u, reset};
)c";

class PortableMathOf : public testing::TestWithParam<bool> {};

TEST_P(PortableMathOf, GivesTheSameBitsByEveryCompiler) {
  const Problem p = problem_with_every_function();
  CSourceOptions options;
  options.portable_math = true;
  options.single_precision = GetParam();
  const CSource c = export_c(test::posterior_of(p), View::constrained_acceleration(*p.prior.system), options);
  EXPECT_THAT(c.header, HasSubstr("the same to the bit on every machine"));
  const test::TemporaryFolder folder;
  static_cast<void>(folder.write("gp2_model.h", c.header));
  static_cast<void>(folder.write("gp2_model.c", c.source));
  static_cast<void>(folder.write("main.c", main_of_bits(options.single_precision)));
  static_cast<void>(folder.write("start.c", start_of_cortex_m7));
  const auto shell = [&](const std::string& line) {
    return std::system(fmt::format("cd '{}' && {{ {}; }} >out 2>errors </dev/null", folder.path().string(), line).c_str()) == 0;
  };
  const std::string strict = "-std=c99 -Wall -Wextra -pedantic -Wconversion -Werror", files = "gp2_model.c main.c -lm -o run";
  std::vector<std::pair<std::string, std::string>> builds;  // compiler, what runs
  for (const std::string compiler : {"gcc", "clang"}) {
    if (!shell(compiler + " --version")) continue;
    for (int level = 0; level <= 3; ++level) builds.emplace_back(fmt::format("{} {} -O{}", compiler, strict, level), "./run");
    // products that the machine could fuse, and GNU's C, which would; clang's -ffp-contract=fast disregards all pragmas
    builds.emplace_back(compiler + " -std=gnu99 -O3 -march=native" + (compiler == "gcc" ? " -ffp-contract=fast" : ""), "./run");
  }
  static_cast<void>(folder.write("nothing.c", "#include <math.h>\nint main(void) { return 0; }\n"));
  if (shell("aarch64-linux-gnu-gcc -static nothing.c -o nothing && qemu-aarch64-static ./nothing")) {
    for (const char* flags : {" -O0", " -O3", " -std=gnu99 -O3 -ffp-contract=fast"}) {
      builds.emplace_back(fmt::format("aarch64-linux-gnu-gcc -static{}", flags), "qemu-aarch64-static ./run");
    }
  } else {
    fmt::print("not compared with aarch64: there is no compiler, C library or emulator for it\n");
  }
  const std::string cortex_m7 =
      "arm-none-eabi-gcc -mcpu=cortex-m7 -mthumb -mfloat-abi=hard -mfpu=fpv5-d16 --specs=rdimon.specs "
      "-Wl,--section-start=.vectors=0 start.c";
  const std::string board =
      "timeout 60 qemu-system-arm -M mps2-an500 -nographic -semihosting-config enable=on,target=native -kernel ";
  if (shell(fmt::format("{} nothing.c -o nothing && {} nothing", cortex_m7, board))) {
    for (const char* flags : {" -O0", " -O2", " -Os -std=gnu99 -ffp-contract=fast"})
      builds.emplace_back(cortex_m7 + flags, board + "run");
  } else {
    fmt::print("not compared with a Cortex-M7: there is no compiler, C library or emulator for it\n");
  }
  std::string expected;
  for (const auto& [compiler, run] : builds) {
    ASSERT_TRUE(shell(fmt::format("{} {} && {}", compiler, files, run))) << compiler << read_file(folder / "errors");
    const std::string printed = read_file(folder / "out");
    if (expected.empty()) expected = printed;
    EXPECT_GT(printed.size(), 200U * 16 * (options.single_precision ? 8 : 16)) << "most states have a prediction";
    EXPECT_TRUE(printed == expected) << compiler;
  }
  // who is told to fuse them all the same is told that the bits are others
  if (shell("clang --version && grep -qw fma /proc/cpuinfo")) {
    ASSERT_TRUE(shell("clang -O3 -march=native -ffp-contract=fast " + files)) << read_file(folder / "errors");
    EXPECT_FALSE(shell("./run"));
  }
}
INSTANTIATE_TEST_SUITE_P(Precisions, PortableMathOf, testing::Values(false, true),
                         [](const auto& tested) { return tested.param ? "Single" : "Double"; });

}  // namespace
}  // namespace gp2
