#include "gp2/prior/kernel.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <Eigen/Eigenvalues>

#include "base/simd.hpp"
#include "gp2/error.hpp"
#include "input_error.hpp"
#include "prior/kernel_columns.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::random_matrix;
using testing::AllOf;
using testing::HasSubstr;

constexpr std::uint64_t kernel_seed = 30301;
const std::vector<std::string> two_features = {"a", "b"};

// parameters between 0.5 and 2
VectorXd random_parameters(const Kernel& kernel, RandomStream& random) {
  VectorXd values(static_cast<Index>(kernel.parameters().size()));
  for (double& value : values) value = std::exp2(2 * random.uniform() - 1);
  return values;
}

double value_at(const Kernel& kernel, const VectorXd& x, const VectorXd& y, const VectorXd& values) {
  return kernel.evaluate(x.transpose(), y.transpose(), values)(0, 0);
}

std::vector<std::string> names_of(const Kernel& kernel) {
  std::vector<std::string> names;
  for (const Kernel::Parameter& parameter : kernel.parameters()) names.push_back(parameter.name);
  return names;
}

// The formulas as kernel.hpp prints them, in extended precision. v: the primitive's own parameters.
long double printed_formula(const std::string& primitive, const VectorXd& x, const VectorXd& y, const double* v) {
  if (primitive == "constant") return 1;
  const Index n = x.size();
  long double r2 = 0, sines = 0, products = 0;
  for (Index d = 0; d < n; ++d) {
    const long double delta = static_cast<long double>(x[d]) - y[d];
    r2 += (delta / v[d]) * (delta / v[d]);
    products += static_cast<long double>(x[d]) * y[d] / (static_cast<long double>(v[d]) * v[d]);
    if (primitive == "periodic") {
      const long double sine = std::sin(std::numbers::pi_v<long double> * delta / v[n + d]);
      sines += sine * sine / (static_cast<long double>(v[d]) * v[d]);
    }
  }
  const long double r = std::sqrt(r2);
  if (primitive == "se") return std::exp(-r2 / 2);
  if (primitive == "matern32") return (1 + std::sqrt(3.0L) * r) * std::exp(-std::sqrt(3.0L) * r);
  if (primitive == "matern52") return (1 + std::sqrt(5.0L) * r + 5 * r2 / 3) * std::exp(-std::sqrt(5.0L) * r);
  if (primitive == "rq") return std::pow(1 + r2 / (2 * static_cast<long double>(v[n])), -static_cast<long double>(v[n]));
  if (primitive == "periodic") return std::exp(-2 * sines);
  return products;
}

class KernelPrimitives : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(Each, KernelPrimitives,
                         testing::Values("se", "matern32", "matern52", "rq", "periodic", "linear", "constant"),
                         [](const auto& instance) { return instance.param; });

TEST_P(KernelPrimitives, AreTheirPrintedFormulas) {
  SCOPED_TRACE(fmt::format("seed {}", kernel_seed));
  RandomStream random(kernel_seed);
  const Kernel kernel = Kernel::parse(GetParam(), two_features);
  for (int trial = 0; trial < 200; ++trial) {
    const VectorXd values = random_parameters(kernel, random);
    const VectorXd x = test::random_vector(2, random), y = test::random_vector(2, random);
    // exp(−z) carries the rounding of z, which is below 100 here
    const auto expected = static_cast<double>(printed_formula(GetParam(), x, y, values.data()));
    EXPECT_NEAR(value_at(kernel, x, y, values), expected, 256 * test::eps * std::max(1.0, std::abs(expected)));
    EXPECT_NEAR(value_at(kernel, y, x, values), value_at(kernel, x, y, values),
                16 * test::eps * std::max(1.0, std::abs(expected)));
  }
}

TEST_P(KernelPrimitives, AreOneAtNoDistanceUnlessLinear) {
  if (GetParam() == "linear") return;
  const Kernel kernel = Kernel::parse(GetParam(), two_features);
  const VectorXd x = Eigen::Vector2d(0.3, -7);
  EXPECT_EQ(value_at(kernel, x, x, VectorXd::Constant(static_cast<Index>(kernel.parameters().size()), 0.7)), 1.0);
}

TEST(KernelTest, SumsAndProductsCombineTheirPartsAndAmplitudesScaleLaterTerms) {
  SCOPED_TRACE(fmt::format("seed {}", kernel_seed));
  RandomStream random(kernel_seed);
  const Kernel kernel = Kernel::parse(" se*linear + periodic + rq * matern32*constant", two_features);
  EXPECT_EQ(names_of(kernel),
            (std::vector<std::string>{"se.lengthscale(a)", "se.lengthscale(b)", "linear.lengthscale(a)", "linear.lengthscale(b)",
                                      "periodic.lengthscale(a)", "periodic.lengthscale(b)", "periodic.period(a)",
                                      "periodic.period(b)", "periodic.amplitude", "rq.lengthscale(a)", "rq.lengthscale(b)",
                                      "rq.alpha", "matern32.lengthscale(a)", "matern32.lengthscale(b)", "rq.amplitude"}));
  for (int trial = 0; trial < 100; ++trial) {
    const VectorXd v = random_parameters(kernel, random);
    const VectorXd x = test::random_vector(2, random), y = test::random_vector(2, random);
    const long double expected =
        printed_formula("se", x, y, &v[0]) * printed_formula("linear", x, y, &v[2]) +
        static_cast<long double>(v[8]) * v[8] * printed_formula("periodic", x, y, &v[4]) +
        static_cast<long double>(v[14]) * v[14] * printed_formula("rq", x, y, &v[9]) * printed_formula("matern32", x, y, &v[12]);
    EXPECT_NEAR(value_at(kernel, x, y, v), static_cast<double>(expected),
                512 * test::eps * (10 + std::abs(static_cast<double>(expected))));
  }
}

TEST(KernelTest, ParenthesesAreMultipliedOutAndKeepOneSetOfParameters) {
  SCOPED_TRACE(fmt::format("seed {}", kernel_seed));
  RandomStream random(kernel_seed);
  const Kernel kernel = Kernel::parse(" ((se) + linear )* periodic", two_features);
  EXPECT_EQ(kernel.text(), "((se) + linear )* periodic") << "as written";
  EXPECT_EQ(names_of(kernel), (std::vector<std::string>{"se.lengthscale(a)", "se.lengthscale(b)", "periodic.lengthscale(a)",
                                                        "periodic.lengthscale(b)", "periodic.period(a)", "periodic.period(b)",
                                                        "linear.lengthscale(a)", "linear.lengthscale(b)", "linear.amplitude"}));
  for (int trial = 0; trial < 100; ++trial) {
    const VectorXd v = random_parameters(kernel, random);
    const VectorXd x = test::random_vector(2, random), y = test::random_vector(2, random);
    const long double expected =
        (printed_formula("se", x, y, &v[0]) + static_cast<long double>(v[8]) * v[8] * printed_formula("linear", x, y, &v[6])) *
        printed_formula("periodic", x, y, &v[2]);
    EXPECT_NEAR(value_at(kernel, x, y, v), static_cast<double>(expected),
                512 * test::eps * (10 + std::abs(static_cast<double>(expected))));
  }
}

TEST(KernelTest, EveryProductOfParenthesesHasAnAmplitudeOfItsOwnName) {
  const std::vector<std::string> one = {"q"};
  EXPECT_EQ(
      names_of(Kernel::parse("(se + linear)*(matern32 + matern52)", one)),
      (std::vector<std::string>{"se.lengthscale(q)", "matern32.lengthscale(q)", "matern52.lengthscale(q)", "matern52.amplitude",
                                "linear.lengthscale(q)", "linear.amplitude", "linear.matern52.amplitude"}));
  EXPECT_EQ(names_of(Kernel::parse("(se)", one)), (std::vector<std::string>{"lengthscale(q)"}));
  EXPECT_EQ(names_of(Kernel::parse("se + (linear + se)", one)),
            (std::vector<std::string>{"se1.lengthscale(q)", "linear.lengthscale(q)", "linear.amplitude", "se2.lengthscale(q)",
                                      "se2.amplitude"}));
}

TEST(KernelTest, AMalformedKernelIsRefusedWithAPlace) {
  const auto error_of = [](const std::string& text) { return test::input_error_of([&] { Kernel::parse(text, two_features); }); };
  EXPECT_EQ(error_of("se*(linear + rq"), "kernel \"se*(linear + rq\", column 4: this '(' is not closed");
  EXPECT_EQ(error_of("se + linear)"), "kernel \"se + linear)\", column 12: ')' closes nothing");
  EXPECT_EQ(error_of("(se + linear) rq"), "kernel \"(se + linear) rq\", column 15: expected '+' or '*' after ')'");
  EXPECT_EQ(error_of("se(linear)"), "kernel \"se(linear)\", column 3: expected '+' or '*' before '('");
  EXPECT_THAT(error_of("se*()"), HasSubstr("unknown kernel ''"));
  EXPECT_THAT(error_of(std::string(101, '(') + "se" + std::string(101, ')')),
              HasSubstr("column 101: parentheses are nested deeper than 100"));
  std::string many = "(constant + constant)";
  for (int k = 0; k < 20; ++k) many += "*(constant + constant)";
  EXPECT_THAT(error_of(many), HasSubstr("more than 20000 factors, its parentheses multiplied out"));
}

TEST(KernelTest, ManyPointsAtOnceAreThePointsOneByOne) {
  RandomStream random(kernel_seed);
  for (const char* text : {"matern52", "se + linear*periodic"}) {
    const Kernel kernel = Kernel::parse(text, two_features);
    const VectorXd values = random_parameters(kernel, random);
    const MatrixXd points = random_matrix(9, 2, random);
    const VectorXd out = kernel.evaluate(points, points.row(4), values);
    for (Index i = 0; i < 9; ++i) {
      EXPECT_NEAR(out[i], value_at(kernel, points.row(i), points.row(4), values),
                  16 * test::eps * std::max(1.0, std::abs(out[i])));
    }
  }
}

// a kernel between points and one more
struct Columns {
  KernelColumns of_points;
  VectorXd point, k;

  Columns(const Kernel& kernel, const MatrixXd& points, const VectorXd& values, const VectorXd& other)
      : of_points(kernel, points, values), k(of_points.n_rows()) {
    KernelColumns::Workspace workspace;
    of_points.scale(other, point);
    of_points.evaluate(0, n(), point, k.data(), workspace);
  }
  [[nodiscard]] Index n() const { return of_points.n_rows(); }
  // with zeros where no point is
  [[nodiscard]] VectorXd padded(const VectorXd& w) const {
    VectorXd padded = VectorXd::Zero(n());
    padded.head(w.size()) = w;
    return padded;
  }
};

class KernelGradients : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(Each, KernelGradients,
                         testing::Values("se", "matern32", "matern52", "rq", "periodic", "linear", "constant",
                                         "se + linear*periodic", "rq*matern32 + matern52*periodic + constant", "se + se*se",
                                         "(se + linear)*periodic", "(rq + constant)*(matern32 + linear)"),
                         [](const auto& instance) { return fmt::format("Kernel{}", instance.index); });

TEST_P(KernelGradients, MatchDifferencesInTheLogarithmOfEveryParameter) {
  SCOPED_TRACE(fmt::format("kernel {}, seed {}", GetParam(), kernel_seed));
  RandomStream random(kernel_seed);
  const Kernel kernel = Kernel::parse(GetParam(), two_features);
  const VectorXd values = random_parameters(kernel, random);
  MatrixXd points = random_matrix(7, 2, random);
  const VectorXd point = points.row(3);  // one pair at no distance, where a Matérn kernel's r has no derivative
  const VectorXd w = test::random_vector(7, random);
  const auto weighted_sum = [&](const VectorXd& at) -> VectorXd {
    return VectorXd::Constant(1, w.dot(kernel.evaluate(points, point.transpose(), at).col(0)));
  };
  const Columns columns(kernel, points, values, point);
  const VectorXd before = VectorXd::Constant(values.size(), 0.25);
  MatrixXd sums = MatrixXd::Zero(simd::lanes<double>, values.size());
  sums.row(0) = before.transpose();
  KernelColumns::Workspace workspace;
  const VectorXd padded_w = columns.padded(w);
  columns.of_points.add_gradient(0, columns.n(), columns.point, columns.k.data(), padded_w.data(), sums, workspace);
  const VectorXd gradient = sums.colwise().sum();
  for (Index p = 0; p < values.size(); ++p) {
    SCOPED_TRACE(kernel.parameters()[static_cast<std::size_t>(p)].name);
    const test::Difference difference = test::central_difference(
        [&](double log_value) {
          VectorXd moved = values;
          moved[p] = std::exp(log_value);
          return weighted_sum(moved);
        },
        // a kernel whose terms cancel is rounded as they are
        std::log(values[p]), 0.5, 256 * test::eps);
    const VectorXd added = VectorXd::Constant(1, gradient[p] - before[p]);
    EXPECT_TRUE(test::matches(added, difference));
    EXPECT_GT(std::abs(added[0]), 1e3 * difference.error[0]) << "a gradient that is zero tests nothing";
  }
}

TEST_P(KernelGradients, MatchDifferencesInEveryFeatureOfAPoint) {
  SCOPED_TRACE(fmt::format("kernel {}, seed {}", GetParam(), kernel_seed));
  RandomStream random(kernel_seed);
  const Kernel kernel = Kernel::parse(GetParam(), two_features);
  const VectorXd values = random_parameters(kernel, random);
  const MatrixXd points = random_matrix(21, 2, random);
  const VectorXd point = random_matrix(1, 2, random).row(0);
  const Columns columns(kernel, points, values, point);
  MatrixXd W = MatrixXd::Zero(columns.n(), 3);
  W.topRows(21) = random_matrix(21, 3, random);
  MatrixXd gradient(2, 3);
  KernelColumns::Workspace workspace;
  columns.of_points.differentiate(0, columns.n(), columns.point, columns.k.data(), W.data(), columns.n(), 3, gradient.data(),
                                  workspace);
  for (Index d = 0; d < 2; ++d) {
    const test::Difference difference = test::central_difference(
        [&](double value) -> VectorXd {
          VectorXd moved = point;
          moved[d] = value;
          return W.topRows(21).transpose() * kernel.evaluate(points, moved.transpose(), values).col(0);
        },
        point[d], 0.5, 1024 * test::eps);
    EXPECT_TRUE(test::matches(gradient.row(d).transpose(), difference)) << "feature " << d;
  }
}

class KernelGrams : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(Each, KernelGrams,
                         testing::Values("se", "matern32", "matern52", "rq", "periodic", "linear", "constant",
                                         "se + linear*periodic", "(se + linear)*periodic"),
                         [](const auto& instance) { return fmt::format("Kernel{}", instance.index); });

TEST_P(KernelGrams, ArePositiveSemidefinite) {
  RandomStream random(kernel_seed);
  const Kernel kernel = Kernel::parse(GetParam(), two_features);
  for (int trial = 0; trial < 10; ++trial) {
    SCOPED_TRACE(fmt::format("kernel {}, seed {}, trial {}", GetParam(), kernel_seed, trial));
    const VectorXd values = random_parameters(kernel, random);
    const MatrixXd points = random_matrix(25, 2, random);
    const MatrixXd gram = kernel.evaluate(points, points, values);
    const VectorXd eigenvalues = Eigen::SelfAdjointEigenSolver<MatrixXd>(gram).eigenvalues();
    // each entry is off by some ε of its terms: eigenvalues by at most 25 of them
    EXPECT_GE(eigenvalues[0], -25 * 64 * test::eps * gram.cwiseAbs().maxCoeff());
  }
}

TEST(KernelTest, ParameterNamesCarryTheKernelOnlyWhereThereAreSeveral) {
  EXPECT_EQ(names_of(Kernel::parse("se", two_features)), (std::vector<std::string>{"lengthscale(a)", "lengthscale(b)"}));
  EXPECT_EQ(names_of(Kernel::parse("rq", two_features)), (std::vector<std::string>{"lengthscale(a)", "lengthscale(b)", "alpha"}));
  EXPECT_EQ(names_of(Kernel::parse("constant", two_features)), std::vector<std::string>{});
  const std::vector<std::string> one = {"q"};
  EXPECT_EQ(names_of(Kernel::parse("se + linear", one)),
            (std::vector<std::string>{"se.lengthscale(q)", "linear.lengthscale(q)", "linear.amplitude"}));
  EXPECT_EQ(names_of(Kernel::parse("se + se", one)),
            (std::vector<std::string>{"se1.lengthscale(q)", "se2.lengthscale(q)", "se2.amplitude"}));
}

TEST(KernelTest, EveryParameterKnowsItsKindAndFeature) {
  const Kernel kernel = Kernel::parse("periodic + rq", two_features);
  using Kind = Kernel::ParameterKind;
  const std::vector<Kind> kinds = {Kind::periodic_lengthscale, Kind::periodic_lengthscale, Kind::period, Kind::period,
                                   Kind::lengthscale,          Kind::lengthscale,          Kind::shape,  Kind::amplitude};
  const std::vector<int> features = {0, 1, 0, 1, 0, 1, -1, -1};
  ASSERT_EQ(kernel.parameters().size(), kinds.size());
  for (std::size_t p = 0; p < kinds.size(); ++p) {
    EXPECT_EQ(kernel.parameters()[p].kind, kinds[p]);
    EXPECT_EQ(kernel.parameters()[p].feature, features[p]);
  }
}

TEST(KernelTest, AnUnknownOrEmptyKernelIsAnErrorThatNamesThoseThereAre) {
  for (const char* text : {"rbf", "", "se +", "se**linear", "se - linear", "2*se", "SE"}) {
    SCOPED_TRACE(text);
    EXPECT_THAT(test::input_error_of([&] { Kernel::parse(text, two_features); }),
                AllOf(HasSubstr(text), HasSubstr("unknown kernel"), HasSubstr("matern52"), HasSubstr("periodic")));
  }
}

TEST(KernelTest, IsEvaluatedAtPointsOfItsFeaturesWithAValueForEachParameter) {
  const Kernel kernel = Kernel::parse("se", two_features);
  const MatrixXd points = MatrixXd::Ones(3, 2);
  const auto refusal = [&](const MatrixXd& left, const MatrixXd& right, const VectorXd& values) {
    return test::input_error_of([&] { static_cast<void>(kernel.evaluate(left, right, values)); });
  };
  EXPECT_EQ(refusal(MatrixXd::Ones(3, 1), MatrixXd::Ones(3, 1), VectorXd::Ones(2)),
            "Kernel::evaluate: the points on the left must be 3 × 2, got 3 × 1");
  EXPECT_EQ(refusal(points, MatrixXd::Ones(4, 3), VectorXd::Ones(2)),
            "Kernel::evaluate: the points on the right must be 4 × 2, got 4 × 3");
  EXPECT_EQ(refusal(points, points, VectorXd::Ones(1)), "Kernel::evaluate: values must be 2 × 1, got 1 × 1");
}

}  // namespace
}  // namespace gp2
