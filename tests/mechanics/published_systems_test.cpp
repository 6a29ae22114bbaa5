#include <fstream>

#include <gtest/gtest.h>
#include <Eigen/Dense>
#include <nlohmann/json.hpp>

#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "reference_data.hpp"
#include "test_models.hpp"

// M, A, b, L, T and ddq of the paper's three systems, as its published code computes them.
namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using nlohmann::json;

VectorXd vector(const json& values) {
  VectorXd v(static_cast<Eigen::Index>(values.size()));
  for (Eigen::Index k = 0; k < v.size(); ++k) v[k] = values[static_cast<std::size_t>(k)].get<double>();
  return v;
}

MatrixXd matrix(const json& rows) {
  MatrixXd m(static_cast<Eigen::Index>(rows.size()), static_cast<Eigen::Index>(rows.front().size()));
  for (Eigen::Index i = 0; i < m.rows(); ++i) m.row(i) = vector(rows[static_cast<std::size_t>(i)]).transpose();
  return m;
}

struct Published {
  std::string key, file;
  std::vector<std::string> parameters;
};

class PublishedSystems : public testing::TestWithParam<Published> {};

INSTANTIATE_TEST_SUITE_P(
    EverySystem, PublishedSystems,
    testing::Values(Published{"surface", "experiments/surface_published.toml", {"p1", "p2", "p3", "p4", "p5", "p6", "p7"}},
                    Published{"unicycle_u_ignored", "experiments/unicycle_published.toml", {"R", "Ic"}},
                    Published{"unicycle_u_applied", "models/unicycle.toml", {"R", "Ic"}},
                    Published{"duffing", "experiments/duffing_published.toml", {"k1", "k2", "c1", "c2", "A0", "alpha", "omega"}}),
    [](const auto& instance) { return instance.param.key; });

TEST_P(PublishedSystems, HaveThePublishedMatricesAndAccelerations) {
  if (const auto absent = test::why_reference_is_absent()) GTEST_SKIP() << *absent;
  const json expected = json::parse(std::ifstream(test::reference_file("systems.json"))).at(GetParam().key);
  const Model& model = test::model(GetParam().file);
  const System& system = *model.system;
  VectorXd parameters = system.parameter_values();
  for (std::size_t k = 0; k < GetParam().parameters.size(); ++k) {
    const int index = system.parameter_index(GetParam().parameters[k]);
    ASSERT_GE(index, 0) << GetParam().parameters[k];
    EXPECT_EQ(parameters[index], expected["params"][k].get<double>()) << GetParam().parameters[k];
  }

  // states by the names of their columns
  const std::vector<std::string> names = system.state_names();
  const std::size_t n = expected["states"].size();
  MatrixXd states = MatrixXd::Constant(system.layout().size(), static_cast<Eigen::Index>(n), std::nan(""));
  for (std::size_t c = 0; c < expected["input_columns"].size(); ++c) {
    const auto row = std::find(names.begin(), names.end(), expected["input_columns"][c].get<std::string>()) - names.begin();
    for (std::size_t i = 0; i < n; ++i) states(row, static_cast<Eigen::Index>(i)) = expected["states"][i][c].get<double>();
  }

  const MechanicsBatch batch = require_mechanics(system, states, parameters);
  for (std::size_t k = 0; k < n; ++k) {
    SCOPED_TRACE(fmt::format("{}, state {}", GetParam().key, k));
    const int i = static_cast<int>(k);
    const MatrixXd M = matrix(expected["M"][k]);
    const VectorXd A = vector(expected["A"][k]);
    const double b = expected["b"][k].is_array() ? expected["b"][k][0].get<double>() : expected["b"][k].get<double>();
    // both sides round each of the few operations that lead to an entry once; M of the unicycle has condition number 60
    const auto near = [](const MatrixXd& got, const MatrixXd& want) {
      return (got - want).cwiseAbs().maxCoeff() <= 1024 * test::eps * (1 + want.cwiseAbs().maxCoeff());
    };
    EXPECT_TRUE(near(batch.values.M(i), M));
    // the published row may be a multiple of ours (the unicycle's is, by cos q3)
    Eigen::Index pivot = 0;
    A.cwiseAbs().maxCoeff(&pivot);
    const double scale = A[pivot] / batch.values.A(i)(0, pivot);
    EXPECT_TRUE(near(scale * batch.values.A(i).row(0).transpose(), A));
    EXPECT_NEAR(scale * batch.values.b(i)[0], b, 1024 * test::eps * (1 + std::abs(b)));
    const UdwadiaKalaba& projection = batch.projections[k];
    EXPECT_TRUE(near(projection.T(), matrix(expected["T"][k])));
    EXPECT_TRUE(near(projection.L() / scale, vector(expected["L"][k])));
    EXPECT_TRUE(near(projection.Lb(), vector(expected["L"][k]) * b));
    EXPECT_TRUE(near(projection.solve_mass(batch.values.F(i)), vector(expected["a_prior_mean"][k])));
    EXPECT_TRUE(near(projection.constrain(vector(expected["a_unconstrained"][k]) + vector(expected["z_nonideal"][k])),
                     vector(expected["ddq"][k])));
  }
  const MatrixXd truth = true_acceleration(model, states);
  for (std::size_t k = 0; k < n; ++k) {
    const VectorXd ddq = vector(expected["ddq"][k]);
    EXPECT_LE((truth.col(static_cast<Eigen::Index>(k)) - ddq).cwiseAbs().maxCoeff(),
              1024 * test::eps * (1 + ddq.cwiseAbs().maxCoeff()));
  }
}

}  // namespace
}  // namespace gp2
