#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/error.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/model.hpp"
#include "input_error.hpp"
#include "test_models.hpp"

// What the mechanics refuse, and that they say where.
namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::AllOf;
using testing::HasSubstr;

Model model(const std::string& mass, const std::string& constraints) {
  return Model::parse(fmt::format(R"toml(
name        = "cart"
coordinates = ["x", "y"]
[mechanics]
mass  = {}
force = ["0", "0"]
[constraints]
{}
[[latent]]
kernel     = "se"
features   = ["x"]
directions = "acceleration"
)toml",
                                  mass, constraints),
                      "cart");
}

// x = 1, x = 2, … at rest
MatrixXd states(const std::vector<double>& x) {
  MatrixXd states = MatrixXd::Zero(5, static_cast<Eigen::Index>(x.size()));
  for (std::size_t i = 0; i < x.size(); ++i) states(0, static_cast<Eigen::Index>(i)) = x[i];
  return states;
}

std::string message(const Model& model, const MatrixXd& states) {
  return test::input_error_of([&] { require_mechanics(*model.system, states, model.system->parameter_values()); });
}

TEST(MechanicsFaults, ContradictoryConstraintsAreAnErrorThatNamesTheState) {
  // ẍ = 0 and ẍ = x: they agree at x = 0 only
  const Model contradictory = model(R"([["1", "0"], ["0", "1"]])", R"(acceleration = ["ddx", "ddx - x"])");
  EXPECT_THAT(message(contradictory, states({0, 3})),
              AllOf(HasSubstr("cart"), HasSubstr("contradict"), HasSubstr("state 2"), HasSubstr("x = 3")));
  EXPECT_EQ(message(contradictory, states({0})), "");
}

// ẍ = y and ẍ = y + x contradict each other where x is not 0, however large y is elsewhere
TEST(MechanicsFaults, AContradictionDoesNotHideBehindAnotherState) {
  const Model contradictory = model(R"([["1", "0"], ["0", "1"]])", R"(acceleration = ["ddx - y", "ddx - y - x"])");
  MatrixXd some = states({0, 0.5});
  some(1, 0) = 1e6;
  EXPECT_THAT(message(contradictory, some), AllOf(HasSubstr("contradict"), HasSubstr("state 2")));
  some(0, 1) = 0;
  EXPECT_EQ(message(contradictory, some), "");
}

// rounding near rest makes b of two rows differ altogether, which is nothing beside other states or an applied force
TEST(MechanicsFaults, RoundingAtRestIsNoContradiction) {
  const Model moving = model(R"([["1", "0"], ["0", "1"]])", R"(acceleration = ["ddx - dx^2", "ddx - dx*dy"])");
  MatrixXd some = states({1, 1});
  some.col(0).segment(2, 2) << 1, 1;
  some.col(1).segment(2, 2) << 1e-17, -3e-17;
  EXPECT_EQ(message(moving, some), "");
}

// b = −0.09 exp(−0.3 t) … is below 1e-308 there, where numbers have a few digits only
TEST(MechanicsFaults, AConstraintWhoseMotionHasDiedAwayIsNoContradiction) {
  const Model& duffing = test::model("models/duffing.toml");
  MatrixXd states = MatrixXd::Zero(duffing.system->layout().size(), 1);
  for (double t = 2300; t < 2500; t += 2) {
    states(duffing.system->layout().t(), 0) = t;
    EXPECT_EQ(message(duffing, states), "") << t;
  }
}

TEST(MechanicsFaults, ARowThatVanishesWhileItsRightHandSideDoesNotIsAContradiction) {
  const Model vanishing = model(R"([["1", "0"], ["0", "1"]])", R"(acceleration = ["x*ddx - 1"])");
  EXPECT_THAT(message(vanishing, states({2, 1, 0})), AllOf(HasSubstr("contradict"), HasSubstr("state 3")));
  EXPECT_THAT(message(vanishing, states({0})), HasSubstr("contradict"));
}

TEST(MechanicsFaults, AMassMatrixThatIsNotPositiveDefiniteIsAnErrorThatNamesTheState) {
  const Model indefinite = model(R"([["1", "x"], ["x", "1"]])", R"(position = ["y"])");
  EXPECT_EQ(message(indefinite, states({0.5, -0.9})), "");
  EXPECT_THAT(message(indefinite, states({0.5, 2, 3})),
              AllOf(HasSubstr("mass matrix"), HasSubstr("not positive definite"), HasSubstr("state 2"), HasSubstr("x = 2")));
  // singular is another thing, negative and not a number are no better
  EXPECT_EQ(message(indefinite, states({1})), "");
  EXPECT_THAT(message(model(R"([["-1", "0"], ["0", "1"]])", R"(position = ["y"])"), states({1})),
              HasSubstr("not positive definite"));
  EXPECT_THAT(message(model(R"-([["log(x)", "0"], ["0", "1"]])-", R"(position = ["y"])"), states({-1})),
              HasSubstr("not positive definite"));
}

TEST(MechanicsFaults, AConstraintThatIsNotANumberIsAnErrorThatNamesTheState) {
  const Model broken = model(R"([["1", "0"], ["0", "1"]])", R"(acceleration = ["ddy + sqrt(x)*ddx"])");
  EXPECT_THAT(message(broken, states({1, -1})), AllOf(HasSubstr("finite"), HasSubstr("state 2"), HasSubstr("x = -1")));
}

TEST(MechanicsFaults, TheCheckedEvaluationReportsTheSameFaultAsAValue) {
  const Model indefinite = model(R"([["1", "x"], ["x", "1"]])", R"(position = ["y"])");
  const MechanicsBatch batch = evaluate_mechanics(*indefinite.system, states({0, 2}), VectorXd());
  ASSERT_TRUE(batch.fault);
  EXPECT_EQ(batch.fault->state, 1);
}

TEST(MechanicsFaults, MatricesThatDoNotFitEachOtherAreRefused) {
  const MatrixXd M = MatrixXd::Identity(3, 3), A = MatrixXd::Ones(1, 3);
  const VectorXd b = VectorXd::Ones(1), two = VectorXd::Ones(2), four = VectorXd::Ones(4);
  const UdwadiaKalaba projection(M, A, b);
  const auto refused = [](const auto& call) { return test::input_error_of([&] { static_cast<void>(call()); }); };
  EXPECT_EQ(refused([&] { return UdwadiaKalaba(M.leftCols(2), A, b); }), "UdwadiaKalaba: M must be 3 × 3, got 3 × 2");
  EXPECT_EQ(refused([&] { return UdwadiaKalaba(M, A.leftCols(2), b); }), "UdwadiaKalaba: A must be 1 × 3, got 1 × 2");
  EXPECT_EQ(refused([&] { return UdwadiaKalaba(M, A, two); }), "UdwadiaKalaba: b must be 1 × 1, got 2 × 1");
  EXPECT_EQ(refused([&] { return projection.constrain(two); }), "UdwadiaKalaba::constrain: a_bar must be 3 × 1, got 2 × 1");
  EXPECT_EQ(refused([&] { return projection.solve_mass(four); }), "UdwadiaKalaba::solve_mass: v must be 3 × 1, got 4 × 1");
  EXPECT_EQ(refused([&] { return projection.is_contradictory(four); }),
            "UdwadiaKalaba::is_contradictory: F must be 3 × 1, got 4 × 1");
  EXPECT_EQ(refused([&] { return projection.differentiate(M, A, two); }),
            "UdwadiaKalaba::differentiate: db must be 1 × 1, got 2 × 1");
  EXPECT_EQ(refused([&] { return projection.differentiate_mass(M, A.leftCols(2)); }),
            "UdwadiaKalaba::differentiate_mass: dA must be 1 × 3, got 1 × 2");
  MatrixXd L(2, 1);
  EXPECT_EQ(test::input_error_of([&] { projection.write_L(L); }), "UdwadiaKalaba::write_L: L must be 3 × 1, got 2 × 1");
}

}  // namespace
}  // namespace gp2
