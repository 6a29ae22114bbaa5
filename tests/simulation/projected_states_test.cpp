#include "gp2/simulation/projected_states.hpp"

#include <gmock/gmock.h>

#include "gp2/error.hpp"
#include "gp2/simulate.hpp"
#include "input_error.hpp"
#include "test_models.hpp"

// Measured states moved onto the constraints.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::HasSubstr;

constexpr std::uint64_t seed = 40721;

// q and dq with an error of this size
MatrixXd disturbed(const Model& model, MatrixXd states, double size) {
  RandomStream random(seed);
  for (Index i = 0; i < states.cols(); ++i) {
    for (int k = 0; k < 2 * model.system->nq(); ++k) states(k, i) += size * random.normal();
  }
  return states;
}

TEST(ProjectedStatesTest, StatesEndOnTheConstraintsNotFarFromWhereTheyWere) {
  for (const char* file : {"models/surface.toml", "models/double_pendulum.toml", "models/unicycle.toml"}) {
    SCOPED_TRACE(fmt::format("{}, seed {}", file, seed));
    const Model& model = test::model(file);
    const VectorXd parameters = model.system->parameter_values();
    const MatrixXd states = disturbed(model, generate(model, {20, seed, VectorXd::Zero(model.system->nq())}).states, 1e-3);
    const MatrixXd stddevs = MatrixXd::Constant(2 * model.system->nq(), states.cols(), 1e-3);
    const ProjectedStates projected = project_states(*model.system, parameters, states, stddevs);
    EXPECT_TRUE(projected.failures.empty());
    EXPECT_FALSE(projected.states.hasNaN() && !states.hasNaN());
    EXPECT_EQ(projected.states.array().isNaN().count(), states.array().isNaN().count());
    // the project's projection ends at rounding of the terms, here of size 1
    const MatrixXd residuals = model.system->residuals(projected.states, parameters);
    EXPECT_LT(residuals.cwiseAbs().maxCoeff(), 1e-13);
    // no farther than a few of the errors
    EXPECT_LT(projected.shift.maxCoeff(), 0.01);
    EXPECT_GT(projected.shift.maxCoeff(), 1e-4);
    // projected again they stay
    EXPECT_LT(project_states(*model.system, parameters, projected.states).shift.maxCoeff(), 1e-14);
  }
}

TEST(ProjectedStatesTest, StatesGoWhereWhatWasMeasuredBestAllows) {
  // M would move y a thousand times as far as x; what was measured says the opposite
  const Model circle = Model::parse(R"toml(
coordinates = ["x", "y"]
[mechanics]
mass = [["1000", "0"], ["0", "1"]]
[constraints]
position = ["x^2 + y^2 - 1"]
)toml",
                                    "circle.toml");
  MatrixXd states = MatrixXd::Zero(5, 2), stddevs(4, 2);
  states.col(0) << 0.9, 0.8, -0.5, 0.6, 0;
  states.col(1) << -0.2, 1.3, 2, 0.1, 0;
  stddevs.col(0) << 0.2, 0.01, 0.5, 0.01;
  stddevs.col(1) << 0.1, 0.1, 0.3, 1;
  const ProjectedStates projected = project_states(*circle.system, VectorXd(), states, stddevs);
  ASSERT_TRUE(projected.failures.empty());
  for (Index i = 0; i < 2; ++i) {
    const Eigen::Vector2d q = projected.states.col(i).head(2), dq = projected.states.col(i).segment(2, 2);
    EXPECT_NEAR(q.norm(), 1, 1e-14);
    EXPECT_NEAR(q.dot(dq), 0, 1e-14);
    // the nearest point of a curve: the way there, in units of the deviations, is along the gradient of the constraint
    const Eigen::Vector2d way = (states.col(i).head(2) - q).cwiseQuotient(stddevs.col(i).head(2).cwiseAbs2());
    EXPECT_NEAR(way[0] * q[1] - way[1] * q[0], 0, 1e-7 * way.norm());
    const Eigen::Vector2d turn = (states.col(i).segment(2, 2) - dq).cwiseQuotient(stddevs.col(i).tail(2).cwiseAbs2());
    EXPECT_NEAR(turn[0] * q[1] - turn[1] * q[0], 0, 1e-7 * turn.norm());
  }
  EXPECT_GT(projected.shift(0, 0), 10 * projected.shift(1, 0));

  // where nothing is stated, the entry that varies more may move more
  const ProjectedStates by_spread = project_states(*circle.system, VectorXd(), states);
  EXPECT_GT(by_spread.shift(0, 0), by_spread.shift(1, 0));
  // one entry stated: the others are as sure beside their spread
  MatrixXd one = MatrixXd::Constant(4, 2, std::nan(""));
  one.row(0).setConstant(0.1);
  const ProjectedStates in_proportion = project_states(*circle.system, VectorXd(), states, one);
  EXPECT_LT((in_proportion.states - by_spread.states).cwiseAbs().maxCoeff(), 1e-9);
}

TEST(ProjectedStatesTest, AStateWithoutAnAdmissibleOneNearIsToldByItsNumber) {
  const Model circle = Model::parse(R"toml(
coordinates = ["x"]
[mechanics]
mass = [["1"]]
[constraints]
position = ["x^2 + 1"]
)toml",
                                    "circle.toml");
  MatrixXd states = MatrixXd::Zero(3, 2);
  states << 0.5, 0.7, 0, 0, 0, 0;
  const ProjectedStates projected = project_states(*circle.system, VectorXd(), states);
  ASSERT_EQ(projected.failures.size(), 2U);
  EXPECT_EQ(projected.failures[1].state, 1);
  EXPECT_THAT(projected.failures[1].text, HasSubstr("did not converge"));
  EXPECT_EQ(projected.states, states);
  const std::vector<Finding> findings = check_states(*circle.system, states, VectorXd());
  ASSERT_FALSE(findings.empty());
  EXPECT_EQ(findings.back().level, Finding::Level::warning);
  EXPECT_EQ(findings.back().text, "2 states have no state on the constraints near them: rows 1, 2; fit `project` refuses them");
}

TEST(ProjectedStatesTest, StatesThatLackWhatTheConstraintReadsAreRefused) {
  const Model& model = test::model("models/surface.toml");
  MatrixXd states = generate(model, {3, seed, VectorXd::Zero(3)}).states;
  states.row(1).setConstant(std::nan(""));
  EXPECT_THAT(
      test::input_error_of([&] { static_cast<void>(project_states(*model.system, model.system->parameter_values(), states)); }),
      testing::AllOf(HasSubstr("the states lack a coordinate or velocity that the constraint \""),
                     HasSubstr("reads, and cannot be projected onto it")));
  EXPECT_TRUE(check_states(*model.system, states, model.system->parameter_values()).empty());
}

TEST(ProjectedStatesTest, ACheckSaysHowFarOffTheStatesAre) {
  const Model circle = Model::parse(R"toml(
coordinates = ["x", "y"]
[mechanics]
mass = [["1", "0"], ["0", "1"]]
[constraints]
position = ["sqrt(x^2 + y^2) - 1"]
)toml",
                                    "circle.toml");
  MatrixXd states = MatrixXd::Zero(5, 4);
  // off by 0, 0.1, 0.2 and −0.3 along x, with velocities along the circle
  states.row(0) << 1, 1.1, 1.2, 0.7;
  states.row(3) << 1, 2, 3, 4;
  const std::vector<Finding> findings = check_states(*circle.system, states, VectorXd());
  ASSERT_EQ(findings.size(), 3U);
  EXPECT_EQ(findings[0].text, "off the position constraint 'sqrt(x^2 + y^2) - 1' by 0.2 in the median, 0.3 at most (row 4)");
  EXPECT_THAT(findings[1].text, HasSubstr("off the velocity constraint "));
  EXPECT_EQ(findings[2].text,
            "the nearest states on the constraints, to which fit `project` moves, differ in x by 0.2 in the median, 0.3 at most "
            "(row 4)");
  states.row(0).setOnes();
  EXPECT_TRUE(check_states(*circle.system, states, VectorXd()).empty());
}

TEST(ProjectedStatesTest, ACheckJudgesEachConstraintByItself) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "y", "z"]
inputs = ["grip"]
[mechanics]
mass = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]]
[constraints]
position = ["x - 2*y"]
velocity = [{ expr = "dz - 1", when = "grip > 0.5" }]
)toml",
                                   "grip.toml");
  MatrixXd states = MatrixXd::Zero(8, 6);
  states.row(0) << 0, 1.00001, 2, 3, 4, 5;
  states.row(1) = 0.5 * states.row(0).array().round();
  states.row(5) << 1.2, 1.3, 5, 7, 6, 8;
  states.row(7) << 1, 1, 0, 0, 0, 0;
  const std::vector<Finding> findings = check_states(*model.system, states, VectorXd());
  ASSERT_GE(findings.size(), 3U);
  EXPECT_EQ(findings[0].level, Finding::Level::good) << findings[0].text;
  EXPECT_EQ(findings[1].level, Finding::Level::good) << findings[1].text;
  EXPECT_EQ(findings[2].level, Finding::Level::warning) << findings[2].text;
  EXPECT_EQ(findings[2].text, "off the velocity constraint 'dz - 1' by 0.3 in the median, 0.3 at most (row 2)");
}

}  // namespace
}  // namespace gp2
