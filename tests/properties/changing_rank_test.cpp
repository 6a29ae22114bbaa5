#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/simulation/generate.hpp"
#include "input_error.hpp"

// Constraints that let go at some states, or nearly follow from each other: counted, reported, and named where they contradict.
namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::AllOf;
using testing::Contains;
using testing::HasSubstr;

Model model_with(const std::string& constraints) {
  return Model::parse(R"toml(
name        = "cart"
coordinates = ["x", "y", "z"]
[mechanics]
mass  = [["2", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]]
force = ["0", "0", "0"]
[constraints]
acceleration = )toml" + constraints +
                          R"toml(
[[latent]]
kernel     = "se"
features   = ["x", "dx"]
directions = "acceleration"
[noise]
ddq = 0.1
)toml",
                      "cart");
}

// eight states, x = 0 at the third and the seventh
MatrixXd states() {
  MatrixXd states = MatrixXd::Constant(7, 8, 0.5);
  states.row(0).setLinSpaced(1, 8);
  states(0, 2) = states(0, 6) = 0;
  return states;
}

CsvTable log_of(const Model& model) {
  GeneratedData data{states(), MatrixXd::Random(3, 8), std::vector<bool>(7, true)};
  return as_table(data, *model.system, "log.csv");
}

std::string text_of(const std::vector<Finding>& findings, Finding::Level level) {
  std::string text;
  for (const Finding& finding : findings) {
    if (finding.level == level) text += finding.text + "\n";
  }
  return text;
}

TEST(ChangingRankTest, StatesOfLowerRankAreCounted) {
  const Model lets_go = model_with(R"-(["x*(ddx - ddy)", "ddz"])-");
  const LowerRank lower = states_of_lower_rank(*lets_go.system, states(), VectorXd());
  EXPECT_EQ(lower.usual, 2);
  EXPECT_EQ(lower.lowest, 1);
  EXPECT_EQ(lower.states, (std::vector<int>{2, 6}));
  // more than are evaluated at once
  const LowerRank of_many = states_of_lower_rank(*lets_go.system, states().replicate(1, 40), VectorXd());
  EXPECT_EQ(of_many.usual, 2);
  EXPECT_EQ(of_many.lowest, 1);
  ASSERT_EQ(of_many.states.size(), 80U);
  for (int k = 0; k < 80; ++k) EXPECT_EQ(of_many.states[static_cast<std::size_t>(k)], 8 * (k / 2) + (k % 2 == 0 ? 2 : 6));
  EXPECT_THAT(text_of(check_system(*lets_go.system, states(), VectorXd()), Finding::Level::warning),
              AllOf(HasSubstr("from 1 to 2 of 2 rows; it is lower at 2 of 8 states, first at state 3"),
                    HasSubstr("a row of A vanishes 2 times; it is dropped there")));
  const FitProblem problem = make_fit_problem(lets_go, log_of(lets_go), {});
  EXPECT_THAT(problem.notes, Contains(AllOf(HasSubstr("the constraints have rank 2 but at 2 of 8 rows"),
                                            HasSubstr("as low as 1, first at data row 3"))));
}

TEST(ChangingRankTest, ConstraintsOfOneRankAreNoteworthyToNobody) {
  const Model constant = model_with(R"-(["ddx - ddy", "2*ddx - 2*ddy", "ddz"])-");
  EXPECT_TRUE(states_of_lower_rank(*constant.system, states(), VectorXd()).states.empty());
  EXPECT_EQ(text_of(check_system(*constant.system, states(), VectorXd()), Finding::Level::warning), "");
  EXPECT_THAT(make_fit_problem(constant, log_of(constant), {}).notes, testing::Not(Contains(HasSubstr("rank"))));
}

// A row that is switched off would not follow from others, but one that is switched on may.
TEST(ChangingRankTest, RedundantRowsThatComeAndGoLowerNoRank) {
  const std::string on_two_sides = R"-([{ expr = "z - y", when = "x > 3.5" }, { expr = "2*(z - y)", when = "x > 3.5" }])-";
  const Model comes_and_goes = model_with("[]\nposition = " + on_two_sides);
  const LowerRank none = states_of_lower_rank(*comes_and_goes.system, states(), VectorXd());
  EXPECT_TRUE(none.states.empty());
  EXPECT_EQ(none.usual, 1);
  const std::vector<Finding> findings = check_system(*comes_and_goes.system, states(), VectorXd());
  EXPECT_THAT(text_of(findings, Finding::Level::warning), testing::Not(HasSubstr("rank")));
  EXPECT_THAT(text_of(findings, Finding::Level::good), HasSubstr("constraints: rank 1 of 2 rows: 1 redundant"));
  EXPECT_THAT(make_fit_problem(comes_and_goes, log_of(comes_and_goes), {}).notes, testing::Not(Contains(HasSubstr("rank"))));

  const Model lets_go_too = model_with("[\"x*(ddx - ddy)\"]\nposition = " + on_two_sides);
  const LowerRank lower = states_of_lower_rank(*lets_go_too.system, states(), VectorXd());
  EXPECT_EQ(lower.states, (std::vector<int>{2, 6}));
  EXPECT_EQ(lower.usual - lower.lowest, 1);

  // one state of its kind: what others with more rows have is a measure for it too
  EXPECT_EQ(states_of_lower_rank({{2, {}}, {1, {1}}}).states, std::vector<int>{1});
  EXPECT_TRUE(states_of_lower_rank({{1, {}}, {2, {1}}}).states.empty());
}

TEST(ChangingRankTest, RowsThatNearlyFollowFromEachOtherAreReported) {
  // the third row differs from the first by 1e-9 at one state, by much at others
  const Model nearly = model_with(R"-(["ddx - ddy", "ddx - ddy*(1 + 1e-9 + (x - 4)^2)"])-");
  EXPECT_THAT(text_of(check_system(*nearly.system, states(), VectorXd()), Finding::Level::warning),
              AllOf(HasSubstr("rows nearly follow from each other at 1 of 8 states"), HasSubstr("at state 4")));
}

TEST(ChangingRankTest, AContradictionIsRefusedByItsRowOfTheLog) {
  const Model contradictory = model_with(R"-(["ddx - ddy - 1", "x*(2*ddx - 2*ddy - 2) - 0.001*x*(x - 4)^2*(x - 8)"])-");
  EXPECT_THAT(text_of(check_system(*contradictory.system, states(), VectorXd()), Finding::Level::error),
              AllOf(HasSubstr("contradict"), HasSubstr("at state 1")));
  EXPECT_THAT(test::input_error_of([&] { make_fit_problem(contradictory, log_of(contradictory), {}); }),
              AllOf(HasSubstr("log.csv: data row 1"), HasSubstr("contradict")));
}

// squares of such entries are no doubles
TEST(ChangingRankTest, RowsOfAnySizeCount) {
  const MatrixXd M = MatrixXd::Identity(2, 2);
  for (const double size : {1e-300, 1e-170, 1e-160, 1.0, 1e160, 1e300}) {
    const MatrixXd A = size * (MatrixXd(1, 2) << 1, 2).finished();
    const UdwadiaKalaba projection(M, A, VectorXd::Constant(1, 5 * size));
    EXPECT_EQ(projection.rank(), 1);
    EXPECT_EQ(projection.n_zero_rows(), 0);
    EXPECT_LE((projection.Lb() - Eigen::Vector2d(1, 2)).norm(), 1e-15 * 8);
    EXPECT_LE(projection.inconsistency(), 1e-14);
  }
  // what is no number with an inverse is none, and that is counted
  EXPECT_EQ(UdwadiaKalaba(M, MatrixXd::Constant(1, 2, 1e-310), VectorXd::Zero(1)).n_zero_rows(), 1);
}

// Found by a property: M (T − I) was rounding there, which a small noise made into an observation of ā.
TEST(ChangingRankTest, AForceOfConstraintsThatAreNotThereSaysNothing) {
  const MatrixXd M = (MatrixXd(2, 2) << 1.7, 0.3, 0.3, 0.9).finished();
  for (const int n_rows : {0, 1, 3}) {
    const UdwadiaKalaba projection(M, MatrixXd::Zero(n_rows, 2), VectorXd::Zero(n_rows));
    EXPECT_EQ(projection.T(), MatrixXd::Identity(2, 2));
  }
  const Model free = model_with("[]");
  const Prior prior = make_prior(free);
  const View force = View::all(View::Quantity::constraint_force, *free.system);
  const Observations contradicting{states(), force, MatrixXd::Ones(3, 8), VectorXd::Constant(3, 1e-6), false};
  const ModelValues values = model_values(prior, {contradicting}, default_hyperparameters(prior, {contradicting}, {}, {}));
  const Posterior posterior(prior, {contradicting}, values);
  EXPECT_EQ(posterior.reduced_size(), 0);
  EXPECT_TRUE(posterior.mean(View::all(View::Quantity::unconstrained_acceleration, *free.system), states()).isZero(0));
}

}  // namespace
}  // namespace gp2
