#include "export/portable_math.hpp"

#include <cmath>
#include <map>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "base/random.hpp"
#include "export/compiled.hpp"
#include "gp2/error.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::Problem;
using testing::HasSubstr;

constexpr std::uint64_t portable_seed = 424243;

// what a function of C may be off, and where
struct Accuracy {
  const char* name;
  long double (*exact)(long double);
  double lower, upper, ulps;
};

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
  std::string source = "#include <math.h>\n";
  for (const auto& piece : c_export::portable_pieces) source += fmt::format("\n{}", piece.text);
  for (const char* name : {"exp", "log", "sin", "cos", "tan", "atan", "asin", "acos", "sinh", "cosh", "tanh"}) {
    source += fmt::format("double call_{0}(double x);\ndouble call_{0}(double x)\n{{\n  return portable_{0}(x);\n}}\n", name);
  }
  source +=
      "double call_atan2(double y, double x);\ndouble call_atan2(double y, double x)\n{\n  return portable_atan2(y, x);\n}\n";
  const test::Library library({{"functions.c", source}}, "gcc -O2");
  const auto ulps = [](double is, long double exact) {
    return static_cast<double>(std::abs(is - exact) / std::ldexp(1.0L, std::ilogb(static_cast<double>(exact)) - 52));
  };
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

  // at their ends
  const auto at = [&](const char* name, double x) { return library.get<double(double)>(fmt::format("call_{}", name))(x); };
  const double infinity = HUGE_VAL;
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
      const double is = at(name, x), expected = exact(x);
      EXPECT_EQ(std::isnan(is), std::isnan(expected)) << name << " of " << x;
      if (std::isnan(expected)) continue;
      EXPECT_EQ(std::signbit(is), std::signbit(expected)) << name << " of " << x;
      if (std::isinf(expected) || expected == 0) {
        EXPECT_EQ(is, expected) << name << " of " << x;
      } else {
        EXPECT_NEAR(is / expected, 1, 1e-15) << name << " of " << x;
      }
    }
    EXPECT_TRUE(std::isnan(at(name, std::nan("")))) << name;
  }
  for (const double y : {0.0, -0.0, 1.0, -1.0, infinity, -infinity}) {
    for (const double x : {0.0, -0.0, 1.0, -1.0, infinity, -infinity}) {
      EXPECT_NEAR(atan2(y, x), std::atan2(y, x), 1e-15);
      EXPECT_EQ(std::signbit(atan2(y, x)), std::signbit(std::atan2(y, x)));
    }
  }
  EXPECT_TRUE(std::isnan(at("sin", 1.1e6))) << "told, not wrong";
}

const Model& model_with_every_function() {
  static const Model model = Model::parse(R"toml(
name        = "every function"
coordinates = ["x", "y"]
inputs      = ["u"]
[mechanics]
mass  = [["3 + sin(y)", "0.3*tanh(x)"], ["0.3*tanh(x)", "2 + cosh(y)"]]
force = ["-x*abs(dx) + min(x, u) + tan(0.3*tanh(x)) + log(2 + x^2)", "max(y, dx)^3 + asin(tanh(x)) + acos(tanh(y)) + sinh(0.1*x)"]
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

// mean, standard deviation and Jacobian at 200 states, digit by digit
std::string main_of_bits() {
  RandomStream random(portable_seed + 1);
  std::string states;
  for (int i = 0; i < 200; ++i) {
    states += "{";
    for (int k = 0; k < 6; ++k) states += fmt::format("{:a}, ", random.normal());
    states += "},\n";
  }
  return R"c(#include <stdio.h>
#include "gp2_model.h"
static gp2_model_workspace w;
static const double states[200][6] = {)c" +
         states + R"c(};
int main(void)
{
  int failed = gp2_model_self_test(&w);
  for (int i = 0; i < 200; ++i) {
    double mean[2], stddev[2], jacobian[12];
    const int status = (int)gp2_model_mean_and_stddev(states[i], mean, stddev, &w);
    printf("%d", status);
    if (status == 0) printf(" %a %a %a %a", mean[0], mean[1], stddev[0], stddev[1]);
    if (gp2_model_mean_and_jacobian(states[i], mean, jacobian, &w) == 0) {
      for (int k = 0; k < 12; ++k) printf(" %a", jacobian[k]);
    }
    printf("\n");
  }
  return failed;
}
)c";
}

TEST(PortableMath, GivesTheSameBitsByEveryCompiler) {
  const Problem p = problem_with_every_function();
  CSourceOptions options;
  options.portable_math = true;
  const CSource c = export_c(test::posterior_of(p), View::constrained_acceleration(*p.prior.system), options);
  EXPECT_THAT(c.header, HasSubstr("the same to the bit on every machine"));
  const test::TemporaryFolder folder;
  static_cast<void>(folder.write("gp2_model.h", c.header));
  static_cast<void>(folder.write("gp2_model.c", c.source));
  static_cast<void>(folder.write("main.c", main_of_bits()));
  const auto shell = [&](const std::string& line) {
    return std::system(fmt::format("cd '{}' && {{ {}; }} >out 2>errors", folder.path().string(), line).c_str()) == 0;
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
  std::string expected;
  for (const auto& [compiler, run] : builds) {
    ASSERT_TRUE(shell(fmt::format("{} {} && {}", compiler, files, run))) << compiler << read_file(folder / "errors");
    const std::string printed = read_file(folder / "out");
    if (expected.empty()) expected = printed;
    EXPECT_GT(printed.size(), 200 * 16 * 10U) << "most states have a prediction";
    EXPECT_TRUE(printed == expected) << compiler;
  }
  // who is told to fuse them all the same is told that the bits are others
  if (shell("clang --version && grep -qw fma /proc/cpuinfo")) {
    ASSERT_TRUE(shell("clang -O3 -march=native -ffp-contract=fast " + files)) << read_file(folder / "errors");
    EXPECT_FALSE(shell("./run"));
  }
}

TEST(PortableMath, SaysWhatItCannotDo) {
  const Problem p = problem_with_every_function();
  CSourceOptions options;
  options.portable_math = options.single_precision = true;
  const View view = View::constrained_acceleration(*p.prior.system);
  EXPECT_THAT(test::input_error_of([&] { static_cast<void>(export_c(test::posterior_of(p), view, options)); }),
              HasSubstr("`portable_math` is of double precision: leave `float` out"));
  options.single_precision = false;
  const Model model = Model::parse(R"toml(
name        = "a power"
coordinates = ["x"]
[mechanics]
mass  = [["2"]]
force = ["-(1 + x^2)^1.3"]
[[latent]]
features   = ["x"]
)toml",
                                   "a power");
  Problem power;
  power.prior = make_prior(model, {Prior::Mean::force, std::nullopt, false, std::nullopt});
  RandomStream random(portable_seed);
  power.observations = {
      test::observe(model, View::constrained_acceleration(*model.system), test::random_matrix(3, 5, random), random)};
  power.values = test::random_values(power.prior, power.observations, random);
  EXPECT_THAT(test::input_error_of([&] {
                static_cast<void>(export_c(test::posterior_of(power), View::constrained_acceleration(*model.system), options));
              }),
              HasSubstr("`portable_math`: the model has a power whose exponent is no whole number; write x^y as exp(y*log(x))"));
}

}  // namespace
}  // namespace gp2
