#include <map>
#include <set>

#include <gtest/gtest.h>

#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "test_models.hpp"

// dT and d(L b) in every parameter of every model, against differences.
namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr std::uint64_t parameter_derivatives_seed = 20203;

class ParameterDerivatives : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(EveryModel, ParameterDerivatives, testing::ValuesIn(test::every_model()), test::model_test_name);

// parameters that neither T nor L b can depend on: they enter forces only, or scale the whole of M
const std::map<std::string, std::set<std::string>> inert = {
    {"surface", {"m", "g"}},
    {"duffing", {"k1", "k2", "c1", "c2", "s1", "s2"}},
    {"duffing_published", {"k1", "k2", "c1", "c2", "s1", "s2"}},
    {"arm_on_moving_plane", {"h", "g"}},
    {"double_pendulum", {"c1", "c2", "g"}},
    {"slider_crank", {"d"}},
};

VectorXd stack(const MatrixXd& T, const VectorXd& Lb) {
  VectorXd both(T.size() + Lb.size());
  both << T.reshaped(), Lb;
  return both;
}

// Rows of the slider-crank that are redundant on its constraint only become independent once r or l moves at a fixed state: the
// derivative at constant rank is that of the loop's own two rows.
int n_rows_to_use(const std::string& file, const System& system) { return test::stem(file) == "slider_crank" ? 2 : system.nc(); }

TEST_P(ParameterDerivatives, OfTheProjectionMatchDifferences) {
  const System& system = *test::model(GetParam()).system;
  const VectorXd parameters = system.parameter_values();
  const auto inert_here = inert.find(test::stem(GetParam()));
  const int n_rows = n_rows_to_use(GetParam(), system);
  for (int p = 0; p < static_cast<int>(parameters.size()); ++p) {
    const std::string& name = system.parameters()[static_cast<std::size_t>(p)].name;
    double largest_derivative = 0;
    for (const test::StateFamily& family : test::state_families(GetParam(), parameter_derivatives_seed)) {
      for (int i = 0; i < static_cast<int>(family.states.cols()); ++i) {
        SCOPED_TRACE(fmt::format("{}, parameter {}, state {} of those {}, seed {}", GetParam(), name, i, family.name,
                                 parameter_derivatives_seed));
        const auto projection_at = [&](double value) {
          VectorXd moved = parameters;
          moved[p] = value;
          const SystemValues values = system.evaluate(family.states.col(i), moved);
          return UdwadiaKalaba(values.M(0), values.A(0).topRows(n_rows), values.b(0).head(n_rows));
        };
        const SystemValues d = system.differentiate(family.states.col(i), parameters, p);
        const UdwadiaKalaba projection = projection_at(parameters[p]);
        const UdwadiaKalaba::Derivative derivative =
            projection.differentiate(d.M(0), d.A(0).topRows(n_rows), d.b(0).head(n_rows));
        // the factor of M costs up to its condition number, a few hundred here
        const test::Difference difference = test::central_difference(
            [&](double value) {
              const UdwadiaKalaba moved = projection_at(value);
              return stack(moved.T(), moved.Lb());
            },
            parameters[p], parameters[p] == 0 ? 0.01 : 0.05 * std::abs(parameters[p]), 1024 * test::eps);
        EXPECT_TRUE(test::matches(stack(derivative.T, derivative.Lb), difference));
        largest_derivative = std::max(largest_derivative, stack(derivative.T, derivative.Lb).lpNorm<Eigen::Infinity>());
      }
    }
    const bool expected_inert = inert_here != inert.end() && inert_here->second.contains(name);
    // ∂T/∂p of an inert parameter is rounding; the smallest of the others is far above it
    if (expected_inert) {
      EXPECT_LE(largest_derivative, 1e-10) << name;
    } else {
      EXPECT_GE(largest_derivative, 1e-3) << name;
    }
  }
}

// A set whose redundancy lasts whatever the parameter: rows (A, b) and a combination of them that changes with the parameter.
TEST_P(ParameterDerivatives, OfARedundantSetAreThoseOfTheSetWithoutItsRedundantRow) {
  const System& system = *test::model(GetParam()).system;
  const VectorXd parameters = system.parameter_values();
  const int n_rows = n_rows_to_use(GetParam(), system);
  RandomStream random(parameter_derivatives_seed);
  const MatrixXd states = test::draw(test::model(GetParam()), 10, parameter_derivatives_seed).states;
  for (int p = 0; p < static_cast<int>(parameters.size()); ++p) {
    const SystemValues values = system.evaluate(states, parameters);
    const SystemValues d = system.differentiate(states, parameters, p);
    for (int i = 0; i < values.n_states(); ++i) {
      SCOPED_TRACE(fmt::format("{}, parameter {}, state {}, seed {}", GetParam(), p, i, parameter_derivatives_seed));
      const MatrixXd A = values.A(i).topRows(n_rows), dA = d.A(i).topRows(n_rows);
      const VectorXd b = values.b(i).head(n_rows), db = d.b(i).head(n_rows);
      const VectorXd w = test::random_vector(n_rows, random), dw = test::random_vector(n_rows, random);
      MatrixXd A2(n_rows + 1, A.cols()), dA2(n_rows + 1, A.cols());
      VectorXd b2(n_rows + 1), db2(n_rows + 1);
      A2 << A, w.transpose() * A;
      dA2 << dA, dw.transpose() * A + w.transpose() * dA;
      b2 << b, w.dot(b);
      db2 << db, dw.dot(b) + w.dot(db);
      const UdwadiaKalaba minimal(values.M(i), A, b), redundant(values.M(i), A2, b2);
      ASSERT_EQ(redundant.rank(), minimal.rank());
      const auto one = minimal.differentiate(d.M(i), dA, db), two = redundant.differentiate(d.M(i), dA2, db2);
      const VectorXd expected = stack(one.T, one.Lb);
      // products of three operators of the mechanics: ε · κ(M) · their sizes, with κ(M) < 1000
      const double tolerance =
          1e5 * test::eps * (1 + expected.lpNorm<Eigen::Infinity>() + stack(minimal.T(), minimal.Lb()).lpNorm<Eigen::Infinity>());
      EXPECT_LE((stack(two.T, two.Lb) - expected).lpNorm<Eigen::Infinity>(), tolerance);
    }
  }
}

}  // namespace
}  // namespace gp2
