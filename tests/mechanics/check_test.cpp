#include "gp2/mechanics/check.hpp"

#include <cmath>
#include <random>
#include <stdexcept>

#include <gmock/gmock.h>

#include "gp2/mechanics/callable_system.hpp"
#include "gp2/model.hpp"
#include "input_error.hpp"

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

TEST(Check, ConstraintsThatLeaveNoFreedomAreWarnedOf) {
  const auto said = [](const std::string& constraints) {
    const Model model =
        Model::parse("coordinates = ['x', 'z']\n[mechanics]\nmass = [['1', '0'], ['0', '1']]\n" + constraints, "two");
    std::string text;
    for (const Finding& finding : check_system(*model.system, bead_states(), model.system->parameter_values())) {
      if (finding.level == Finding::Level::warning) text += finding.text;
    }
    return text;
  };
  EXPECT_EQ(said(""), "");
  EXPECT_THAT(said("[constraints]\nacceleration = ['ddx - 1', 'ddz - x*ddx']"), HasSubstr("they leave no freedom"));
  EXPECT_EQ(said("[constraints]\nacceleration = ['ddz - x*ddx']"), "");
  EXPECT_THAT(said("[constraints]\nposition = ['(z - 0.5*x^2)^2']"), HasSubstr("its row of A is zero wherever it holds"));
}

TEST(Check, AMotionThatConstraintsSayAllOfHasNoColumnsToObserve) {
  const Model model = Model::parse(
      "coordinates = ['x', 'z']\n[mechanics]\nmass = [['1', '0'], ['0', '1']]\n"
      "[constraints]\nposition = ['x - 0.3*sin(t)', 'z - 0.2*cos(t)']\n",
      "two");
  MatrixXd states(5, 8), accelerations(2, 8);
  for (Eigen::Index i = 0; i < 8; ++i) {
    const double t = 0.1 * static_cast<double>(i), s = std::sin(t), c = std::cos(t);
    states.col(i) << 0.3 * s, 0.2 * c, 0.3 * c, -0.2 * s, t;
    accelerations.col(i) << -0.3 * s, -0.2 * c;
  }
  EXPECT_EQ(dependent_columns(*model.system, states, Eigen::VectorXd(), accelerations), std::nullopt);
}

TEST(Check, DerivativesInAParameterAreHeldAgainstDifferencesOfItsOwnSize) {
  const auto found = [](const std::string& parameters, const std::string& force) {
    const Model model = Model::parse("coordinates = ['x', 'z']\n[parameters]\n" + parameters +
                                         "\n[mechanics]\nmass = [['1', '0'], ['0', '1']]\nforce = ['" + force + "', '0']\n",
                                     "two");
    for (Finding& finding : check_system(*model.system, bead_states(), model.system->parameter_values())) {
      if (finding.text.starts_with("derivatives of M, A, b, F")) return finding;
    }
    return Finding{Finding::Level::error, "not looked at"};
  };
  // 5 nm over which a force changes by e
  EXPECT_EQ(found("l = 5e-9", "exp(-1e-8*x/l)").level, Finding::Level::good);
  const Finding at_zero = found("c = 0", "-sqrt(c)*(1 + dx^2)");
  EXPECT_EQ(at_zero.level, Finding::Level::warning);
  EXPECT_EQ(
      at_zero.text,
      "derivatives of M, A, b, F in the parameters: that in 'c' is not finite where they are: it cannot be estimated from its "
      "value 0");
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

TEST(Check, AMassThatTimeAloneChangesNeedsNoCoriolisForces) {
  const auto is_told = [](const std::string& mass) {
    const Model model =
        Model::parse("coordinates = ['a', 'b']\n[mechanics]\nmass = [['" + mass + "', '0'], ['0', '1']]\n", "sledge");
    bool told = false;
    for (const Finding& finding : check_system(*model.system, MatrixXd::Random(5, 20), model.system->parameter_values())) {
      told = told || finding.text.find("centrifugal forces are missing") != std::string::npos;
    }
    return told;
  };
  EXPECT_FALSE(is_told("3 + 0.5*t"));
  EXPECT_TRUE(is_told("3 + 0.5*t + 0.5*cos(b)"));
  EXPECT_TRUE(is_told("3 + 0.5*t*cos(b)"));
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

// A bead on a wire that is moved along it by u, against friction that changes with t.
CallableSystem::Definition bead_in_code() {
  CallableSystem::Definition code;
  code.declaration = {"a bead in code", {{"x"}, {"z"}}, {"u"}, {}};
  code.constraints = {{"wire", ConstraintLevel::position}};
  code.evaluate = [](const CallableSystem::States& states, const CallableSystem::Parameters&) {
    const Eigen::Index n = states.cols();
    SystemValues values{MatrixXd::Zero(4, n), MatrixXd::Zero(2, n), MatrixXd::Zero(1, n), MatrixXd::Zero(2, n)};
    for (Eigen::Index i = 0; i < n; ++i) {
      const double x = states(0, i), dx = states(2, i), t = states(4, i), u = states(5, i);
      values.mass.col(i) << 1, 0, 0, 1;
      values.constraint_matrix.col(i) << -x, 1;
      values.constraint_vector(0, i) = dx * dx;
      values.force.col(i) << u - 0.1 * t * dx, -9.81;
    }
    return values;
  };
  code.residuals = [](const CallableSystem::States& states, const CallableSystem::Parameters&) -> MatrixXd {
    MatrixXd values(2, states.cols());
    values.row(0) = states.row(1).array() - 0.5 * states.row(0).array().square();
    values.row(1) = states.row(3).array() - states.row(0).array() * states.row(2).array();
    return values;
  };
  code.mechanics_reads = {{"x", "dx"}};
  code.force_reads = {{"dx", "t", "u"}};
  code.residuals_read = {{"x", "z", "dx", "dz"}};
  return code;
}

MatrixXd bead_states_with_input() {
  MatrixXd states(6, 3);
  states << bead_states(), Eigen::RowVector3d(0, 1, 0);
  return states;
}

std::vector<std::string> undeclared_reads(const CallableSystem::Definition& definition, const MatrixXd& states) {
  std::vector<std::string> texts;
  for (const Finding& finding : check_system(CallableSystem(definition), states, Eigen::VectorXd())) {
    if (finding.text.starts_with("declared reads:")) texts.push_back(finding.text);
    EXPECT_EQ(finding.level, finding.text.starts_with("declared reads:") ? Finding::Level::warning : Finding::Level::good);
  }
  return texts;
}

TEST(Check, WhatCodeReadsWithoutDeclaringItIsFound) {
  using testing::ElementsAre;
  MatrixXd states = bead_states_with_input();
  CallableSystem::Definition code = bead_in_code();
  EXPECT_THAT(undeclared_reads(code, states), testing::IsEmpty());
  code.mechanics_reads = {{"x"}};
  EXPECT_THAT(undeclared_reads(code, states),
              ElementsAre("declared reads: M, A or b depend on dx, which mechanics_reads (in Python reads) lacks: derivatives in "
                          "the state are wrong, and a log need not have such columns; add the names"));
  code.force_reads = {{"dx"}};
  code.residuals_read = {{"z", "dx", "dz"}};
  EXPECT_THAT(undeclared_reads(code, states), ElementsAre(HasSubstr("M, A or b depend on dx, which mechanics_reads"),
                                                          HasSubstr("F depends on t, u, which force_reads"),
                                                          HasSubstr("the residuals depend on x, which residuals_read")));
  // at rest, and where nothing that is declared as not read is measured
  states.middleRows(2, 2).setZero();
  EXPECT_THAT(undeclared_reads(code, states.leftCols(1)), testing::SizeIs(3));
  code = bead_in_code();
  code.residuals = nullptr;
  states.row(1).setConstant(std::nan(""));
  states.row(3).setConstant(std::nan(""));
  EXPECT_THAT(undeclared_reads(code, states), testing::IsEmpty());
  // to refuse a value is to read it
  code.evaluate = [evaluate = code.evaluate](const auto& x, const auto& parameters) {
    if (x.row(3).maxCoeff() > 0) throw std::range_error("dz");
    return evaluate(x, parameters);
  };
  EXPECT_THAT(undeclared_reads(code, states), ElementsAre(HasSubstr("M, A or b depend on dz"), HasSubstr("F depends on dz")));
}

TEST(Check, ToCodeMissingCoriolisForcesAreToldInItsOwnWords) {
  CallableSystem::Definition code = bead_in_code();
  code.evaluate = [evaluate = code.evaluate](const auto& states, const auto& parameters) {
    SystemValues values = evaluate(states, parameters);
    values.mass.row(0) = 1 + states.row(0).array().square();
    return values;
  };
  std::string text;
  for (const Finding& one : check_system(CallableSystem(code), bead_states_with_input(), Eigen::VectorXd())) {
    if (one.level == Finding::Level::warning) text += one.text;
  }
  EXPECT_EQ(text,
            "mass matrix: it changes with the motion, but no part of the force is quadratic in the velocities: the Coriolis and "
            "centrifugal forces are missing; add them to F");
}

TEST(Check, AFastMechanismIsFollowedByShorterSteps) {
  const Model model = Model::parse(R"(
coordinates = ["a", "b", "c"]
[mechanics]
mass = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]]
[constraints]
position = ['0.1*cos(a) + 0.3*cos(b) - c', '0.1*sin(a) + 0.3*sin(b)']
)",
                                   "a slider-crank");
  for (const double speed : {1.0, 100.0, 2000.0, 1e5}) {
    MatrixXd states(7, 20);
    for (Eigen::Index i = 0; i < states.cols(); ++i) {
      const double a = 0.3 * static_cast<double>(i), b = std::asin(-std::sin(a) / 3);
      const double db = -std::cos(a) / (3 * std::cos(b)) * speed, dc = -0.1 * std::sin(a) * speed - 0.3 * std::sin(b) * db;
      states.col(i) << a, b, 0.1 * std::cos(a) + 0.3 * std::cos(b), speed, db, dc, 0;
    }
    const Finding finding = motion_finding(*model.system, states);
    EXPECT_EQ(finding.level, Finding::Level::good) << speed << ": " << finding.text;
  }
}

TEST(Check, AConstraintThatIsFasterThanItsCoordinatesIsFollowedToo) {
  const Model model = Model::parse(
      "coordinates = ['x', 'z']\n[mechanics]\nmass = [['1', '0'], ['0', '1']]\n[constraints]\nposition = ['z - "
      "1e-5*sin(3000*x)']\n",
      "a stylus on a grating");
  MatrixXd states(5, 50);
  for (Eigen::Index i = 0; i < states.cols(); ++i) {
    const double x = 0.02 * static_cast<double>(i);
    states.col(i) << x, 1e-5 * std::sin(3000 * x), 1, 3e-2 * std::cos(3000 * x), 0;
  }
  const Finding finding = motion_finding(*model.system, states);
  EXPECT_EQ(finding.level, Finding::Level::good) << finding.text;
}

TEST(Check, ATimeOfAClockIsSteppedAsItRounds) {
  const Model model = Model::parse(
      "coordinates = ['x']\n[parameters]\nw = 3\n[mechanics]\nmass = [['1']]\n[constraints]\nposition = ['x - sin(w*t)']\n",
      "a moved body");
  for (const double w : {2.7, 3.0, 50.0}) {
    for (const double start : {0.0, 1.7e9}) {
      MatrixXd states(3, 1000);
      for (Eigen::Index i = 0; i < states.cols(); ++i) {
        const double t = start + 0.01 * static_cast<double>(i);
        states.col(i) << std::sin(w * t), w * std::cos(w * t), t;
      }
      for (Finding& finding : check_system(*model.system, states, Eigen::VectorXd::Constant(1, w))) {
        if (!finding.text.starts_with("A and b:")) continue;
        EXPECT_EQ(finding.level, Finding::Level::good) << w << ": " << finding.text;
      }
    }
  }
}

std::string all_of(const std::vector<Finding>& findings) {
  std::string text;
  for (const Finding& finding : findings) text += finding.text + "\n";
  return text;
}

TEST(Check, ALongLogIsLookedAtRowByRow) {
  const Model model = Model::parse(R"(
coordinates = ["x", "z"]
[parameters]
a = 0.5
[mechanics]
mass = [["1 + x^2", "0"], ["0", "1"]]
coriolis = true
[constraints]
position = ["z - a*x^2"]
)",
                                   "a bead on a wire");
  const Eigen::VectorXd parameters = model.system->parameter_values();
  MatrixXd states = bead_states().replicate(1, 400);
  const std::string sound = all_of(check_system(*model.system, states, parameters));
  EXPECT_THAT(sound, HasSubstr("positive definite at all 1200 states, condition number up to 1.64"));
  EXPECT_EQ(all_of(check_system(*model.system, states, parameters, 2)), sound);

  const MatrixXd free = MatrixXd::Random(2, 1200), noise = MatrixXd::Constant(2, 1200, 1e-3);
  states.col(1001)[1] += 0.125;
  const auto violation = largest_violation(*model.system, states, parameters);
  EXPECT_EQ(violation->state, 1001);
  EXPECT_NEAR(violation->value, 0.125, 1e-15);
  // accelerations that obey the constraint but in the last block of rows
  const MechanicsBatch mechanics = evaluate_mechanics(*model.system, states, parameters);
  MatrixXd ddq(2, 1200);
  for (int i = 0; i < 1200; ++i) ddq.col(i) = mechanics.projections[static_cast<std::size_t>(i)].constrain(free.col(i));
  EXPECT_TRUE(dependent_columns(*model.system, states, parameters, ddq));
  ddq(1, 1190) += 1;
  EXPECT_FALSE(dependent_columns(*model.system, states, parameters, ddq));
  const ConstraintResidual residual = constraint_residuals(*model.system, states, parameters, ddq, noise).front();
  EXPECT_EQ(residual.n, 1200);
  EXPECT_EQ(residual.worst.front(), 1190);
  EXPECT_NEAR(residual.rms, std::sqrt(1 / 1200.0), 1e-9);

  states(0, 800) = states(0, 700) = std::nan("");
  for (const int n_threads : {1, 2}) {
    EXPECT_THAT(all_of(check_system(*model.system, states, parameters, n_threads)), HasSubstr("x is nan at state 701\n"));
  }
}

// Accelerations of a bead that obey z - a*x^2 up to noise.
struct NoisyBead {
  static constexpr int n = 100;
  Model model = bead();
  MatrixXd states = bead_states().replicate(1, n)(Eigen::all, Eigen::seqN(0, n));
  MatrixXd ddq, noise = MatrixXd::Constant(2, n, 0.01);

  NoisyBead() {
    const MechanicsBatch mechanics = evaluate_mechanics(*model.system, states, model.system->parameter_values());
    std::mt19937 engine(48);
    std::normal_distribution<double> normal;
    ddq = MatrixXd::NullaryExpr(2, n, [&] { return normal(engine); });
    for (int i = 0; i < n; ++i) ddq.col(i) = mechanics.projections[static_cast<std::size_t>(i)].constrain(ddq.col(i));
    ddq += noise.cwiseProduct(MatrixXd::NullaryExpr(2, n, [&] { return normal(engine); }));
  }

  [[nodiscard]] std::vector<Finding> findings(const MatrixXd& stddev) const {
    return check_data(*model.system, states, model.system->parameter_values(), ddq, stddev);
  }
  [[nodiscard]] Finding of_constraint(const MatrixXd& stddev) const {
    for (Finding& one : findings(stddev)) {
      if (one.text.starts_with("measured ddq")) return one;
    }
    return {Finding::Level::error, "not looked at"};
  }
};

// Where the known force presses nothing noise decides which of the states pull.
TEST(Check, AContactThatPullsAtMoreThanHalfOfTheStatesMayDoSoByChance) {
  const Model model = Model::parse(R"(
coordinates = ["x", "z"]
inputs = ["touch"]
[mechanics]
mass = [["1", "0"], ["0", "1"]]
[constraints]
position = [{ expr = "z", contact = "touch" }]
)",
                                   "a slide");
  MatrixXd states = MatrixXd::Zero(6, 60);
  states.row(5).setOnes();
  for (const int n_pulling : {36, 50}) {
    MatrixXd ddq = MatrixXd::Ones(2, 60);
    ddq.row(1).head(n_pulling).setConstant(-1);
    const std::string text =
        all_of(check_data(*model.system, states, model.system->parameter_values(), ddq, MatrixXd::Ones(2, 60)));
    EXPECT_THAT(text, HasSubstr(std::to_string(n_pulling) + " of 60 states where it is closed"));
    EXPECT_EQ(text.find("a contact only pushes") != std::string::npos, n_pulling == 50) << text;
  }
}

TEST(Check, ANoiseThatIsNotGivenIsNotKnown) {
  const NoisyBead bead;
  const MatrixXd unknown = MatrixXd::Constant(2, NoisyBead::n, std::nan(""));
  const Eigen::VectorXd none;
  for (const std::vector<int>& stated : {std::vector<int>{}, {1}}) {
    for (const bool estimates : {false, true}) {
      const auto of = [&](const MatrixXd& stddev) {
        return all_of(check_data(*bead.model.system, bead.states, none, bead.ddq, stddev, stated, estimates));
      };
      EXPECT_EQ(of(MatrixXd()), of(unknown));
    }
  }
  const auto residuals = constraint_residuals(*bead.model.system, bead.states, none, bead.ddq, MatrixXd());
  ASSERT_THAT(residuals, testing::SizeIs(1));
  EXPECT_EQ(residuals[0].n, NoisyBead::n);
  EXPECT_TRUE(std::isnan(residuals[0].expected));
}

TEST(Check, WrongSizesAreRefused) {
  const NoisyBead bead;
  const System& system = *bead.model.system;
  const MatrixXd &x = bead.states, &ddq = bead.ddq, &noise = bead.noise;
  const Eigen::VectorXd none;
  const auto refused = [](const auto& call) { return test::input_error_of([&] { static_cast<void>(call()); }); };
  EXPECT_EQ(refused([&] { return check_system(system, x.leftCols(0), none); }), "check_system: there are no states");
  EXPECT_EQ(refused([&] { return check_data(system, x, none, ddq, noise.leftCols(2)); }),
            "check_data: stddev must be 2 × 100, got 2 × 2");
  EXPECT_EQ(refused([&] {
              return check_data(system, x, none, ddq, noise, {1, 2});
            }),
            "check_data: stated: there are the rows 0 … 1, got 2");
  EXPECT_THAT(refused([&] { return check_data(system, x, none, ddq, noise, {-1}); }), HasSubstr("got -1"));
  EXPECT_EQ(refused([&] { return constraint_residuals(system, x, none, ddq.leftCols(2), noise); }),
            "constraint_residuals: accelerations must be 2 × 100, got 2 × 2");
  EXPECT_EQ(refused([&] { return constraint_residuals(system, x, none, ddq, noise.topRows(1)); }),
            "constraint_residuals: stddev must be 2 × 100, got 1 × 100");
  EXPECT_EQ(refused([&] { return dependent_columns(system, x, none, ddq.topRows(1)); }),
            "dependent_columns: accelerations must be 2 × 100, got 1 × 100");
  EXPECT_EQ(refused([&] { return dependent_columns(system, x, none, ddq, noise.leftCols(99)); }),
            "dependent_columns: stddev must be 2 × 100, got 2 × 99");
  EXPECT_TRUE(std::isnan(constraint_violations(system, x.leftCols(0), none).front().value));
}

TEST(Check, OutliersAreNamedAsSuch) {
  NoisyBead bead;
  const MatrixXd unknown = MatrixXd::Constant(2, NoisyBead::n, std::nan(""));
  EXPECT_EQ(bead.of_constraint(bead.noise).level, Finding::Level::good);
  bead.ddq(1, 40) += 50;
  bead.ddq(1, 70) -= 1e9;
  bead.ddq(0, 15) += 0.4;
  for (const MatrixXd& stddev : {bead.noise, unknown}) {
    const Finding finding = bead.of_constraint(stddev);
    EXPECT_EQ(finding.level, Finding::Level::warning);
    EXPECT_THAT(finding.text, HasSubstr("only because of 2 of 100 rows (farthest off: row 71, 41): outliers of the log"));
    EXPECT_THAT(finding.text, HasSubstr("`robust`"));
  }
}

TEST(Check, AnErrorOfManyRowsIsNoOutlier) {
  NoisyBead bead;
  bead.ddq.row(1).array() += 9.81;
  EXPECT_EQ(bead.of_constraint(bead.noise).level, Finding::Level::error);
  EXPECT_THAT(bead.of_constraint(bead.noise).text, testing::Not(HasSubstr("outliers")));
  bead = NoisyBead();
  for (int i = 0; i < 7; ++i) bead.ddq(1, 10 * i) += 50;
  EXPECT_THAT(bead.of_constraint(bead.noise).text, testing::Not(HasSubstr("outliers")));
}

// A hoist: two loads on one drum, whose rates of change are logged by one sensor.
TEST(Check, AccelerationsMayDependOnEachOtherInPart) {
  const Model model = Model::parse(R"(
coordinates = ["th", "y1", "y2"]
[mechanics]
mass = [["0.02", "0", "0"], ["0", "1.2", "0"], ["0", "0", "0.9"]]
[constraints]
position = ["y1 - 0.1*th", "y2 + 0.1*th"]
)",
                                   "hoist");
  constexpr int n = 40;
  const Eigen::Vector3d noise(0.5, 0.05, 0.05);
  const MatrixXd stddev = noise.replicate(1, n), states = MatrixXd::Zero(7, n);
  std::mt19937 random(7);
  std::normal_distribution<double> normal;
  MatrixXd ddq(3, n);
  for (Eigen::Index i = 0; i < n; ++i) {
    const double th = 20 * normal(random);
    ddq.col(i) << th + noise[0] * normal(random), 0.1 * th + noise[1] * normal(random), -0.1 * th + noise[2] * normal(random);
  }
  const auto found = [&](const MatrixXd& of_noise) {
    return dependent_columns(*model.system, states, Eigen::VectorXd(), ddq, of_noise);
  };
  EXPECT_EQ(found(stddev), std::nullopt);
  EXPECT_EQ(found(MatrixXd()), std::nullopt);
  const auto text = [&] { return all_of(check_data(*model.system, states, Eigen::VectorXd(), ddq, 5 * stddev)); };
  EXPECT_THAT(text(), HasSubstr("the noise is stated too large, or these columns share their errors"));

  ddq.row(2) = -ddq.row(1);
  for (const MatrixXd& of_noise : {MatrixXd(), stddev}) {
    const auto rows = found(of_noise);
    ASSERT_TRUE(rows);
    EXPECT_THAT(*rows, testing::AnyOf(testing::ElementsAre(0, 1), testing::ElementsAre(0, 2)));
  }
  EXPECT_THAT(text(), HasSubstr("so only 2 of them are independent measurements"));
  EXPECT_THAT(text(), testing::Not(HasSubstr("stated too large")));

  ddq.row(2) = ddq.row(2).unaryExpr([](double one) { return 1e-3 * std::round(1e3 * one); });
  EXPECT_TRUE(found(stddev)) << "rounding is far below the noise";
  EXPECT_FALSE(found(MatrixXd())) << "it may be the noise";
}

TEST(Check, WhatIsRoundingIsJudgedOverAllRows) {
  const Model model = Model::parse(R"(
coordinates = ["x"]
[mechanics]
mass = [["1"]]
[constraints]
acceleration = ["ddx - t", "ddx - t - 1e-14"]
)",
                                   "two rows that agree to rounding");
  MatrixXd states = MatrixXd::Zero(3, 600);  // x dx t
  for (const double largest : {0.0, 1e-3, 1.0}) {
    states(2, 599) = largest;
    const std::optional<MechanicsBatch::Fault> all = evaluate_mechanics(*model.system, states, Eigen::VectorXd()).fault;
    EXPECT_EQ(all.has_value(), largest < 1);
    for (const int n_threads : {1, 2}) {
      const auto fault = for_each_mechanics(*model.system, states, Eigen::VectorXd(), n_threads, [](auto, const auto&) {});
      ASSERT_EQ(fault.has_value(), all.has_value()) << largest;
      if (!fault) continue;
      EXPECT_EQ(fault->state, all->state);
      EXPECT_EQ(fault->text, all->text);
    }
  }
}

}  // namespace
}  // namespace gp2
