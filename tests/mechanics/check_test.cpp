#include "gp2/mechanics/check.hpp"

#include <gmock/gmock.h>

#include "gp2/mechanics/callable_system.hpp"
#include "gp2/model.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using testing::HasSubstr;

// a bead on a wire: at rest, and moving along it
MatrixXd bead_states() {
  MatrixXd states = MatrixXd::Zero(5, 3);  // x z dx dz t
  states.col(0) << 0.4, 0.08, 0, 0, 0;
  states.col(1) << 0.4, 0.08, 1.5, 0.6, 0;
  states.col(2) << -0.8, 0.32, -0.7, 0.56, 1;
  return states;
}

Model bead() {
  return Model::parse(R"(
coordinates = ["x", "z"]
[mechanics]
mass = [["1", "0"], ["0", "1"]]
[constraints]
position = ["z - 0.5*x^2"]
)",
                      "a bead on a wire");
}

Finding motion_finding(const System& system, const MatrixXd& states) {
  for (Finding& finding : check_system(system, states, system.parameter_values())) {
    if (finding.text.starts_with("A and b:")) return finding;
  }
  return {Finding::Level::error, "not looked at"};
}

TEST(Check, AStateAtRestIsNoFaultOfAAndB) {
  const Model model = bead();
  EXPECT_EQ(motion_finding(*model.system, bead_states()).level, Finding::Level::good);
  EXPECT_EQ(motion_finding(*model.system, bead_states().leftCols(1)).level, Finding::Level::good);
}

TEST(Check, ConstraintsThatAreNotThereOrLeaveNoFreedomAreToldOf) {
  const auto said = [](const std::string& constraints) {
    const Model model =
        Model::parse("coordinates = ['x', 'z']\n[mechanics]\nmass = [['1', '0'], ['0', '1']]\n" + constraints, "two");
    std::string text;
    for (const Finding& finding : check_system(*model.system, bead_states(), model.system->parameter_values())) {
      if (finding.level == Finding::Level::warning) text += finding.text;
    }
    return text;
  };
  EXPECT_THAT(said(""), HasSubstr("constraints: none; T = I"));
  EXPECT_THAT(said("[constraints]\nacceleration = ['ddx - 1', 'ddz - x*ddx']"), HasSubstr("they leave no freedom"));
  EXPECT_EQ(said("[constraints]\nacceleration = ['ddz - x*ddx']"), "");
}

TEST(Check, CoriolisForcesThatAreMissingAreFoundBesideFriction) {
  // two links, h = k sin(b − a)
  const auto is_told = [](const std::string& force) {
    const Model model = Model::parse(
        "coordinates = ['a', 'b']\n[parameters]\nk = 0.7\n[mechanics]\nmass = [['3', 'k*cos(b - a)'], ['k*cos(b - a)', '1']]\n" +
            force,
        "arm");
    MatrixXd states = MatrixXd::Random(5, 20);
    bool told = false, told_at_rest = false;
    for (bool* const one : {&told, &told_at_rest}) {
      for (const Finding& finding : check_system(*model.system, states, model.system->parameter_values())) {
        *one = *one || finding.text.find("centrifugal forces are missing") != std::string::npos;
      }
      states.middleRows(2, 2).setZero();
    }
    EXPECT_EQ(told, told_at_rest) << force;
    return told;
  };
  EXPECT_TRUE(is_told("force = ['-a', '0']"));
  EXPECT_TRUE(is_told("force = ['-a - 0.1*da - 0.2*da*abs(da)', '-tanh(db)']"));
  EXPECT_FALSE(is_told("force = ['-a - 0.1*da', '-tanh(db)']\ncoriolis = true"));
  EXPECT_FALSE(is_told("force = ['k*sin(b - a)*db^2 - 0.1*da', '-k*sin(b - a)*da^2']"));
}

TEST(Check, AWrongBIsFound) {
  const Model model = bead();
  CallableSystem::Definition wrong;
  wrong.declaration = {"wrong", model.system->coordinates(), {}, {}};
  wrong.constraints = {{"wire", ConstraintLevel::position}};
  wrong.evaluate = [&](const auto& states, const auto& parameters) {
    SystemValues values = model.system->evaluate(states, parameters);
    values.constraint_vector *= 1.01;
    return values;
  };
  wrong.residuals = [&](const auto& states, const auto& parameters) { return model.system->residuals(states, parameters); };
  const Finding finding = motion_finding(CallableSystem(wrong), bead_states());
  EXPECT_EQ(finding.level, Finding::Level::warning);
  EXPECT_THAT(finding.text, HasSubstr("largest for 'd/dt of wire'"));
}

}  // namespace
}  // namespace gp2
