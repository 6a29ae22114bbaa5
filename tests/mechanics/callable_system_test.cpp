#include "gp2/mechanics/callable_system.hpp"

#include <limits>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "callable_surface.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/mechanics/state_evaluator.hpp"
#include "gp2/simulate.hpp"
#include "input_error.hpp"
#include "test_models.hpp"

// Mechanics given as functions against the same given as text.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::AllOf;
using testing::Each;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::SizeIs;

constexpr std::uint64_t callable_system_seed = 50501;
constexpr double nan = std::numeric_limits<double>::quiet_NaN();

const System& text_surface() { return *test::model("models/surface.toml").system; }

SystemDeclaration declaration_of(const System& system) {
  return {system.name(), system.coordinates(), system.inputs(), system.parameters()};
}

CallableSystem::Definition definition() { return test::surface_definition(declaration_of(text_surface())); }

const System& surface() {
  static const CallableSystem system(definition());
  return system;
}

MatrixXd states_of(int n) {
  const MatrixXd drawn = test::draw(test::model("models/surface.toml"), n, callable_system_seed).states;
  return drawn.array().isNaN().select(0, drawn);
}

MatrixXd stack_values(const SystemValues& values) {
  MatrixXd all(values.mass.rows() + values.constraint_matrix.rows() + values.constraint_vector.rows() + values.force.rows(),
               values.n_states());
  all << values.mass, values.constraint_matrix, values.constraint_vector, values.force;
  return all;
}

// numbers of a few operations each: some ε of the largest
void expect_close(const MatrixXd& got, const MatrixXd& expected, double tolerance = 64 * test::eps) {
  ASSERT_EQ(got.rows(), expected.rows());
  ASSERT_EQ(got.cols(), expected.cols());
  ASSERT_TRUE(got.allFinite());
  EXPECT_LE((got - expected).cwiseAbs().maxCoeff(), tolerance * (1 + expected.cwiseAbs().maxCoeff()));
}

TEST(CallableSystemTest, HasTheNumbersOfTheSameSystemAsText) {
  const MatrixXd states = states_of(20);
  const VectorXd parameters = text_surface().parameter_values() * 1.05;
  expect_close(stack_values(surface().evaluate(states, parameters)), stack_values(text_surface().evaluate(states, parameters)));
  expect_close(surface().residuals(states, parameters), text_surface().residuals(states, parameters));
  for (int p = 0; p < static_cast<int>(surface().parameters().size()); ++p) {
    const MatrixXd expected = stack_values(text_surface().differentiate(states, parameters, p));
    EXPECT_GT(expected.cwiseAbs().maxCoeff(), 0);
    expect_close(stack_values(surface().differentiate(states, parameters, p)), expected);
  }
  EXPECT_EQ(surface().nc(), 1);
  EXPECT_THAT(surface().constraint_labels(), ElementsAre("the surface"));
  for (const SystemPart part : {SystemPart::mechanics, SystemPart::force, SystemPart::residuals}) {
    EXPECT_EQ(surface().reads(part), text_surface().reads(part));
  }
}

TEST(CallableSystemTest, StateDerivativesAreThoseOfAnySystem) {
  const auto exact = text_surface().make_evaluator(text_surface().parameter_values(), true);
  const auto differences = surface().make_evaluator(surface().parameter_values(), true);
  const MatrixXd states = states_of(5);
  const auto jacobian_of = [](const StateEvaluator& evaluator) {
    MatrixXd jacobian = MatrixXd::Zero(4 * 4 * 4, 10);
    for (std::size_t k = 0; k < evaluator.derivatives().size(); ++k) {
      const StateEvaluator::Derivative& d = evaluator.derivatives()[k];
      jacobian(16 * static_cast<int>(d.quantity) + 4 * d.row + d.column, d.state_index) =
          evaluator.derivative_values()[static_cast<Index>(k)];
    }
    return jacobian;
  };
  for (Index i = 0; i < states.cols(); ++i) {
    exact->evaluate(states.col(i));
    differences->evaluate(states.col(i));
    expect_close(differences->A(), exact->A());
    expect_close(jacobian_of(*differences), jacobian_of(*exact), 1e-8);
  }
}

TEST(CallableSystemTest, WithoutDerivativesTakesDifferencesOfTheStatedError) {
  CallableSystem::Definition differenced = definition();
  differenced.differentiate = nullptr;
  // p1 at its lower bound, p2 at its upper
  std::vector<Parameter>& declared = differenced.declaration.parameters;
  ASSERT_TRUE(declared[2].bounds && declared[3].bounds);
  VectorXd parameters = text_surface().parameter_values();
  parameters[2] = declared[2].bounds->first;
  parameters[3] = declared[3].bounds->second;
  double smallest = std::numeric_limits<double>::infinity(), largest = 0;
  differenced.evaluate = [&](const CallableSystem::States& states, const CallableSystem::Parameters& p) {
    smallest = std::min(smallest, p[2]);
    largest = std::max(largest, p[3]);
    return test::surface_values(states, p);
  };
  const CallableSystem system(differenced);
  const MatrixXd states = states_of(20);
  const MatrixXd values = stack_values(text_surface().evaluate(states, parameters));
  for (int p = 0; p < static_cast<int>(declared.size()); ++p) {
    const MatrixXd expected = stack_values(text_surface().differentiate(states, parameters, p));
    const MatrixXd got = stack_values(system.differentiate(states, parameters, p));
    // ε^(2/3) of f/s, and of s²f‴: with p5 q1 up to 6 that is 200 of them at most; one-sided, twice
    const double tolerance = 2 * 200 * std::pow(test::eps, 2.0 / 3) * values.cwiseAbs().maxCoeff() / std::abs(parameters[p]);
    EXPECT_LE((got - expected).cwiseAbs().maxCoeff(), tolerance) << declared[static_cast<std::size_t>(p)].name;
    EXPECT_LE(tolerance, 1e-4 * expected.cwiseAbs().maxCoeff()) << declared[static_cast<std::size_t>(p)].name;
  }
  // never outside the bounds
  EXPECT_EQ(smallest, parameters[2]);
  EXPECT_EQ(largest, parameters[3]);
}

/// One coordinate whose force is F(p).
CallableSystem::Definition force_of(Parameter parameter, double (*F)(double)) {
  CallableSystem::Definition one;
  one.declaration = {"one", {{"q", false}}, {}, {std::move(parameter)}};
  one.evaluate = [F](const CallableSystem::States& states, const CallableSystem::Parameters& p) {
    const Index n = states.cols();
    return SystemValues{MatrixXd::Ones(1, n), MatrixXd(0, n), MatrixXd(0, n), MatrixXd::Constant(1, n, F(p[0]))};
  };
  return one;
}

TEST(CallableSystemTest, TheStepOfADifferenceSuitsTheParameter) {
  const auto slope = [](const Parameter& parameter, double p, double (*F)(double)) {
    const CallableSystem system(force_of(parameter, F));
    return system.differentiate(MatrixXd::Zero(3, 1), VectorXd::Constant(1, p), 0).force(0, 0);
  };
  const auto reciprocal = [](double p) { return 1 / p; };
  const auto sine = [](double p) { return std::sin(p); };
  const auto root = [](double p) { return std::sqrt(1e-3 + p); };
  const double tolerance = 100 * std::pow(test::eps, 2.0 / 3);
  // positive by its bounds: small values are small by themselves
  EXPECT_NEAR(slope({"p", 1, {{1e-6, 10}}, true}, 1e-5, reciprocal) / -1e10, 1, tolerance);
  // free to cross zero: the model's value is the scale, or 1, or the bounds
  EXPECT_NEAR(slope({"p", 2, {}, true}, 1e-12, sine), 1, tolerance);
  EXPECT_NEAR(slope({"p", 0, {}, true}, 0, sine), 1, tolerance);
  EXPECT_NEAR(slope({"p", 0, {{0, 1e-3}}, true}, 0, root) / (0.5 / std::sqrt(1e-3)), 1, tolerance);
  EXPECT_NEAR(slope({"p", 0, {{-1e-3, 0}}, true}, 0, root) / (0.5 / std::sqrt(1e-3)), 1, tolerance);
  EXPECT_NEAR(slope({"p", 0, {{0, 0}}, true}, 0, sine), 1, tolerance);
}

TEST(CallableSystemTest, ChecksLikeOneOfText) {
  const auto findings = [](const System& system) { return check_system(system, states_of(10), system.parameter_values()); };
  const std::vector<Finding> of_text = findings(text_surface()), of_code = findings(surface());
  ASSERT_THAT(of_code, SizeIs(of_text.size()));
  for (std::size_t k = 0; k < of_code.size(); ++k) EXPECT_EQ(of_code[k].level, of_text[k].level) << of_code[k].text;
  MatrixXd off = states_of(3);
  off(2, 1) += 0.5;
  const auto violation = largest_violation(surface(), off, surface().parameter_values());
  ASSERT_TRUE(violation);
  EXPECT_EQ(violation->state, 1);
  EXPECT_EQ(violation->constraint, "the surface");
}

// ---- motion

Trajectory motion(const System& system) {
  const VectorXd parameters = system.parameter_values();
  SimulateOptions options;
  options.times = VectorXd::LinSpaced(11, 0, 1);
  const Acceleration acceleration = [&](const Eigen::Ref<const VectorXd>& state) -> VectorXd {
    const MechanicsBatch mechanics = require_mechanics(system, state, parameters);
    return mechanics.projections[0].constrain(mechanics.projections[0].solve_mass(mechanics.values.F(0)));
  };
  return simulate(system, parameters, acceleration, states_of(1).col(0), options);
}

TEST(CallableSystemTest, MotionsAreProjectedWhereThereAreResiduals) {
  const Trajectory expected = motion(text_surface()), got = motion(surface());
  expect_close(got.states, expected.states, 1e-10);
  EXPECT_LT(got.max_position_drift, 1e-12);
}

TEST(CallableSystemTest, MotionsDriftWhereThereAreNone) {
  CallableSystem::Definition without = definition();
  without.residuals = nullptr;
  const CallableSystem system(without);
  EXPECT_THAT(system.residual_labels(), IsEmpty());
  EXPECT_THAT(system.reads(SystemPart::residuals), Each(false));
  EXPECT_FALSE(largest_violation(system, states_of(2), system.parameter_values()));
  const Trajectory drifting = motion(system);
  const double drift = surface().residuals(drifting.states, system.parameter_values()).cwiseAbs().maxCoeff();
  EXPECT_GT(drift, 1e-12);
  EXPECT_LT(drift, 1e-2);
  EXPECT_EQ(drifting.max_position_drift, 0) << "nothing to measure it by";
}

TEST(CallableSystemTest, AVelocityConstraintHasOneResidualAndAnAccelerationConstraintNone) {
  CallableSystem::Definition mixed = definition();
  mixed.constraints = {{"a", ConstraintLevel::acceleration}, {"v", ConstraintLevel::velocity}, {"p", ConstraintLevel::position}};
  const CallableSystem system(mixed);
  std::vector<std::string> rows;
  for (const System::Residual& r : system.residual_labels()) rows.push_back(fmt::format("{} {} {}", r.row, r.velocity, r.text));
  EXPECT_THAT(rows, ElementsAre("1 true v", "2 false p", "2 true d/dt of p"));
}

// ---- what is read

TEST(CallableSystemTest, ReadsEverythingUnlessItSaysOtherwise) {
  CallableSystem::Definition silent = definition();
  silent.mechanics_reads.reset();
  silent.force_reads.reset();
  silent.residuals_read.reset();
  const CallableSystem system(silent);
  for (const SystemPart part : {SystemPart::mechanics, SystemPart::force, SystemPart::residuals}) {
    EXPECT_THAT(system.reads(part), AllOf(SizeIs(10), Each(true)));
  }
}

TEST(CallableSystemTest, MayAnswerNothingWhereWhatItReadsIsNotMeasured) {
  MatrixXd states = states_of(3);
  states(0, 1) = nan;  // q1
  states(7, 2) = nan;  // u1
  const SystemValues values = surface().evaluate(states, surface().parameter_values());
  EXPECT_TRUE(values.A(1).hasNaN());
  EXPECT_TRUE(values.F(1).allFinite());
  EXPECT_TRUE(values.F(2).hasNaN());
  EXPECT_TRUE(values.A(2).allFinite());
  EXPECT_TRUE(surface().residuals(states, surface().parameter_values()).col(1).hasNaN());
}

// ---- what is refused

TEST(CallableSystemTest, DefinitionsThatMeanNothingAreRefused) {
  const auto refused = [](const std::function<void(CallableSystem::Definition&)>& spoil) {
    CallableSystem::Definition spoilt = definition();
    spoil(spoilt);
    return test::input_error_of([&] { CallableSystem{spoilt}; });
  };
  EXPECT_EQ(refused([](auto& d) { d.evaluate = nullptr; }), "system 'particle on a surface': evaluate is an empty function");
  EXPECT_EQ(refused([](auto& d) {
              d.declaration.coordinates.clear();
              d.mechanics_reads = d.force_reads = d.residuals_read = {{"t"}};
            }),
            "system 'particle on a surface': a system needs at least one coordinate");
  EXPECT_EQ(refused([](auto& d) { d.constraints[0].level = ConstraintLevel::acceleration; }),
            "system 'particle on a surface': residuals are given, but none of its 1 constraints is at position or velocity "
            "level; say the levels, or leave out the residuals");
  for (const auto member : {&CallableSystem::Definition::mechanics_reads, &CallableSystem::Definition::force_reads,
                            &CallableSystem::Definition::residuals_read}) {
    EXPECT_THAT(refused([&](auto& d) {
                  d.*member = {{"q1", "ddq1"}};
                }),
                HasSubstr("'ddq1' is no entry of the state, which has q1, q2, q3, dq1, dq2, dq3, t, u1, u2, u3"));
  }
}

// what evaluate, at 4 states, makes of spoilt values
using Spoil = std::function<void(SystemValues&)>;

std::string evaluated(const Spoil& spoil) {
  CallableSystem::Definition spoilt = definition();
  spoilt.evaluate = [spoil](const CallableSystem::States& states, const CallableSystem::Parameters& p) {
    SystemValues values = test::surface_values(states, p);
    spoil(values);
    return values;
  };
  const CallableSystem system(spoilt);
  return test::input_error_of([&] { static_cast<void>(system.evaluate(states_of(4), system.parameter_values())); });
}

std::string differentiated(const Spoil& spoil) {
  CallableSystem::Definition spoilt = definition();
  spoilt.differentiate = [spoil](const CallableSystem::States& states, const CallableSystem::Parameters& p, int index) {
    SystemValues values = test::surface_derivatives(states, p, index);
    spoil(values);
    return values;
  };
  const CallableSystem system(spoilt);
  return test::input_error_of([&] { static_cast<void>(system.differentiate(states_of(4), system.parameter_values(), 0)); });
}

TEST(CallableSystemTest, ShapesAreHeldAgainstTheSystem) {
  EXPECT_EQ(evaluated([](SystemValues& v) { v.mass.resize(9, 3); }),
            "system 'particle on a surface': evaluate returned mass M of the shape 9 × 3, expected 9 × 4 (nq·nq × N, with nq = 3 "
            "coordinates, nc = 1 constraints, N = 4 states)");
  EXPECT_THAT(evaluated([](SystemValues& v) { v.constraint_matrix = MatrixXd::Zero(6, 4); }),
              HasSubstr("constraint_matrix A of the shape 6 × 4, expected 3 × 4 (nc·nq × N"));
  EXPECT_THAT(evaluated([](SystemValues& v) { v.constraint_vector = MatrixXd::Zero(4, 1); }),
              HasSubstr("constraint_vector b of the shape 4 × 1, expected 1 × 4 (nc × N"));
  EXPECT_THAT(evaluated([](SystemValues& v) { v.force = MatrixXd(); }),
              HasSubstr("force F of the shape 0 × 0, expected 3 × 4 (nq × N"));
  EXPECT_THAT(evaluated([](SystemValues& v) { v = {}; }), HasSubstr("evaluate returned mass M of the shape 0 × 0"));
  EXPECT_THAT(differentiated([](SystemValues& v) { v.mass.resize(4, 9); }),
              HasSubstr("differentiate returned mass M of the shape 4 × 9, expected 9 × 4"));
  EXPECT_EQ(evaluated([](SystemValues&) {}), "");

  // no states at all
  EXPECT_EQ(surface().evaluate(MatrixXd(10, 0), surface().parameter_values()).n_states(), 0);

  CallableSystem::Definition spoilt = definition();
  spoilt.residuals = [](const CallableSystem::States& states, const CallableSystem::Parameters& p) -> MatrixXd {
    return test::surface_residuals(states, p).topRows(1);
  };
  EXPECT_EQ(test::input_error_of(
                [&] { static_cast<void>(CallableSystem(spoilt).residuals(states_of(4), surface().parameter_values())); }),
            "system 'particle on a surface': residuals returned the shape 1 × 4, expected 2 × 4: a row for each of the surface, "
            "d/dt of the surface; a column for each of the N = 4 states");
}

TEST(CallableSystemTest, NumbersMustBeFinite) {
  EXPECT_EQ(
      evaluated([](SystemValues& v) { v.mass(8, 1) = nan; }),
      "system 'particle on a surface': evaluate returned mass M with a number that is not finite at state 2, where all that "
      "is read is finite");
  constexpr double inf = std::numeric_limits<double>::infinity();
  EXPECT_THAT(evaluated([](SystemValues& v) { v.constraint_matrix(1, 3) = inf; }),
              HasSubstr("constraint_matrix A with a number that is not finite at state 4"));
  EXPECT_THAT(evaluated([](SystemValues& v) { v.constraint_vector(0, 0) = nan; }), HasSubstr("constraint_vector b with"));
  EXPECT_THAT(evaluated([](SystemValues& v) { v.force(0, 0) = -inf; }), HasSubstr("force F with"));
  EXPECT_THAT(differentiated([](SystemValues& v) { v.force(0, 0) = nan; }), HasSubstr("differentiate returned force F with"));

  CallableSystem::Definition spoilt = definition();
  spoilt.residuals = [](const CallableSystem::States& states, const CallableSystem::Parameters& p) -> MatrixXd {
    return test::surface_residuals(states, p) / 0;
  };
  EXPECT_EQ(test::input_error_of(
                [&] { static_cast<void>(CallableSystem(spoilt).residuals(states_of(4), surface().parameter_values())); }),
            "system 'particle on a surface': residuals returned a number that is not finite at state 1, where all that is read "
            "is finite");
}

TEST(CallableSystemTest, AtParametersAFitStraysToNumbersNeedNotBeFiniteButTheirDifferencesMust) {
  const CallableSystem system(force_of({"p", 1, {}, true}, [](double p) { return std::sqrt(p); }));
  const MatrixXd state = MatrixXd::Zero(3, 1);
  EXPECT_TRUE(system.evaluate(state, VectorXd::Constant(1, -1)).F(0).hasNaN());
  EXPECT_EQ(test::input_error_of([&] { static_cast<void>(system.differentiate(state, VectorXd::Zero(1), 0)); }),
            "system 'one': the difference of evaluate in 'p' returned force F with a number that is not finite at state 1, where "
            "all that is read is finite");
}

TEST(CallableSystemTest, TheMassMatrixMustBeSymmetric) {
  EXPECT_EQ(
      evaluated([](SystemValues& v) { v.mass(3, 2) = 0.25; }),
      "system 'particle on a surface': evaluate returned a mass M that is not symmetric at state 3: row 1 column 2 is 0.25, "
      "but row 2 column 1 is 0");
  EXPECT_EQ(evaluated([](SystemValues& v) { v.mass(3, 2) = 1e-11; }), "") << "rounding";
  EXPECT_THAT(differentiated([](SystemValues& v) { v.mass(1, 0) = 1e-3; }),
              HasSubstr("differentiate returned a mass M that is not symmetric at state 1"));
}

TEST(CallableSystemTest, WhatAFunctionThrowsGoesToTheCallerAsItIs) {
  struct Interrupted {};
  CallableSystem::Definition thrower = definition();
  thrower.evaluate = [](const CallableSystem::States&, const CallableSystem::Parameters&) -> SystemValues {
    throw Interrupted();
  };
  const CallableSystem system(thrower);
  EXPECT_THROW(static_cast<void>(system.evaluate(states_of(1), system.parameter_values())), Interrupted);
  EXPECT_THROW(require_mechanics(system, states_of(1), system.parameter_values()), Interrupted);
}

}  // namespace
}  // namespace gp2
