#include "gp2/mechanics/state_evaluator.hpp"

#include <thread>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "allocation_count.hpp"
#include "gp2/error.hpp"
#include "input_error.hpp"
#include "test_models.hpp"

// M, A, b, F and their derivatives in the state, at one state after another.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Quantity = StateEvaluator::Quantity;
using testing::HasSubstr;

constexpr std::uint64_t state_evaluator_seed = 20303;

/// M, A, b, F as one vector, as a batch gives them.
VectorXd values_at(const System& system, const VectorXd& state) {
  const SystemValues values = system.evaluate(state, system.parameter_values());
  VectorXd all(values.mass.rows() + values.constraint_matrix.rows() + values.constraint_vector.rows() + values.force.rows());
  all << values.mass, values.constraint_matrix, values.constraint_vector, values.force;
  return all;
}

VectorXd values_of(const StateEvaluator& evaluator) {
  VectorXd all(evaluator.M().size() + evaluator.A().size() + evaluator.b().size() + evaluator.F().size());
  all << evaluator.M().reshaped(), evaluator.A().reshaped(), evaluator.b(), evaluator.F();
  return all;
}

/// ∂(M, A, b, F)/∂x (· × states) from the list.
MatrixXd jacobian_of(const StateEvaluator& evaluator, const System& system) {
  const int nq = system.nq(), nc = system.nc();
  MatrixXd jacobian = MatrixXd::Zero(values_of(evaluator).size(), system.layout().size());
  const auto& derivatives = evaluator.derivatives();
  for (std::size_t k = 0; k < derivatives.size(); ++k) {
    const StateEvaluator::Derivative& d = derivatives[k];
    const int start = d.quantity == Quantity::mass                ? 0
                      : d.quantity == Quantity::constraint_matrix ? nq * nq
                      : d.quantity == Quantity::constraint_vector ? nq * (nq + nc)
                                                                  : nq * (nq + nc) + nc;
    const int rows = d.quantity == Quantity::mass ? nq : nc;
    jacobian(start + d.row + rows * d.column, d.state_index) = evaluator.derivative_values()[static_cast<Index>(k)];
    EXPECT_LE(derivatives[k == 0 ? 0 : k - 1].state_index, d.state_index);
  }
  return jacobian;
}

class StateEvaluators : public testing::TestWithParam<std::string> {
 protected:
  const System& system() const { return *test::model(GetParam()).system; }
};
INSTANTIATE_TEST_SUITE_P(EveryModel, StateEvaluators, testing::ValuesIn(test::every_model()), test::model_test_name);

TEST_P(StateEvaluators, GiveTheBitsOfABatch) {
  const auto with = system().make_evaluator(system().parameter_values(), true);
  const auto without = system().make_evaluator(system().parameter_values(), false);
  EXPECT_TRUE(without->derivatives().empty());
  for (const test::StateFamily& family : test::state_families(GetParam(), state_evaluator_seed)) {
    for (Index i = 0; i < family.states.cols(); ++i) {
      SCOPED_TRACE(fmt::format("state {} of those {}, seed {}", i, family.name, state_evaluator_seed));
      const VectorXd expected = values_at(system(), family.states.col(i));
      for (StateEvaluator* evaluator : {with.get(), without.get()}) {
        evaluator->evaluate(family.states.col(i));
        const VectorXd values = values_of(*evaluator);
        // bit by bit; what a NaN of the state gives is NaN in both
        EXPECT_TRUE((values.array() == expected.array() || (values.array().isNaN() && expected.array().isNaN())).all());
      }
    }
  }
}

TEST_P(StateEvaluators, DifferentiateExactly) {
  const auto evaluator = system().make_evaluator(system().parameter_values(), true);
  double largest = 0;
  for (const test::StateFamily& family : test::state_families(GetParam(), state_evaluator_seed)) {
    // where the velocity is tiny, that of friction has a kink within any step
    if (family.name == "at rest" || family.name == "tiny velocities" || family.name == "nearly singular") continue;
    for (Index i = 0; i < std::min<Index>(family.states.cols(), 5); ++i) {
      const VectorXd state = family.states.col(i).array().isNaN().select(0, family.states.col(i));
      evaluator->evaluate(state);
      const MatrixXd jacobian = jacobian_of(*evaluator, system());
      for (Index k = 0; k < state.size(); ++k) {
        SCOPED_TRACE(fmt::format("x_{}, state {} of those {}, seed {}", k, i, family.name, state_evaluator_seed));
        const test::Difference difference = test::central_difference(
            [&](double value) {
              VectorXd moved = state;
              moved[k] = value;
              return values_at(system(), moved);
            },
            state[k], 0.05 * std::max(1.0, std::abs(state[k])), 64 * test::eps);
        EXPECT_TRUE(test::matches(jacobian.col(k), difference));
      }
      largest = std::max(largest, jacobian.cwiseAbs().maxCoeff());
    }
  }
  EXPECT_GT(largest, 1e-3);
}

TEST_P(StateEvaluators, AreDefinedAtRest) {
  const auto evaluator = system().make_evaluator(system().parameter_values(), true);
  for (const test::StateFamily& family : test::state_families(GetParam(), state_evaluator_seed)) {
    if (family.name != "at rest") continue;
    for (Index i = 0; i < family.states.cols(); ++i) {
      evaluator->evaluate(family.states.col(i));
      EXPECT_TRUE(values_of(*evaluator).allFinite());
      EXPECT_TRUE(evaluator->derivative_values().allFinite());
    }
  }
}

TEST_P(StateEvaluators, AllocateNothing) {
  const MatrixXd states = test::draw(test::model(GetParam()), 10, state_evaluator_seed).states;
  const auto evaluator = system().make_evaluator(system().parameter_values(), true);
  double sum = 0;
  EXPECT_EQ(test::allocations_of([&] {
              for (Index i = 0; i < states.cols(); ++i) {
                evaluator->evaluate(states.col(i));
                sum += evaluator->M()(0, 0) + evaluator->derivative_values().sum();
              }
            }),
            0U);
}

TEST_P(StateEvaluators, DoNotSpreadWhatIsNotRead) {
  const auto evaluator = system().make_evaluator(system().parameter_values(), true);
  VectorXd state = test::draw(test::model(GetParam()), 1, state_evaluator_seed).states.col(0);
  const std::vector<bool> mechanics = system().reads(SystemPart::mechanics), force = system().reads(SystemPart::force);
  for (Index k = 0; k < state.size(); ++k) {
    const auto index = static_cast<std::size_t>(k);
    if (!mechanics[index] && !force[index]) state[k] = std::numeric_limits<double>::quiet_NaN();
  }
  evaluator->evaluate(state);
  EXPECT_FALSE(values_of(*evaluator).hasNaN());
  EXPECT_FALSE(evaluator->derivative_values().hasNaN());
}

TEST_P(StateEvaluators, OfTwoThreadsDoNotDisturbEachOther) {
  // a system of its own, so that both ask for the derivatives first
  const Model model = Model::read(std::filesystem::path(GP2_SOURCE_DIR) / GetParam());
  const MatrixXd states = test::draw(model, 50, state_evaluator_seed).states;
  std::vector<VectorXd> sums(2);
  const auto work = [&](std::size_t thread) {
    const auto evaluator = model.system->make_evaluator(model.system->parameter_values(), true);
    VectorXd sum = VectorXd::Zero(static_cast<Index>(evaluator->derivatives().size()));
    for (int repeat = 0; repeat < 20; ++repeat) {
      for (Index i = 0; i < states.cols(); ++i) {
        const VectorXd state = states.col(i).array().isNaN().select(0, states.col(i));
        evaluator->evaluate(state);
        sum += evaluator->derivative_values();
      }
    }
    sums[thread] = sum;
  };
  std::thread first(work, 0), second(work, 1);
  first.join();
  second.join();
  EXPECT_GT(sums[0].size(), 0);
  EXPECT_EQ(sums[0], sums[1]);
}

/// A system that knows nothing of expressions.
class OpaqueSystem final : public System {
 public:
  explicit OpaqueSystem(const System& inside)
      : System(inside.name(), inside.coordinates(), inside.inputs(), inside.parameters(), inside.constraint_labels()),
        inside_(inside) {}
  SystemValues evaluate(const Eigen::Ref<const MatrixXd>& states, const Eigen::Ref<const VectorXd>& parameters) const override {
    return inside_.evaluate(states, parameters);
  }
  SystemValues differentiate(const Eigen::Ref<const MatrixXd>& states, const Eigen::Ref<const VectorXd>& parameters,
                             int index) const override {
    return inside_.differentiate(states, parameters, index);
  }
  MatrixXd residuals(const Eigen::Ref<const MatrixXd>& states, const Eigen::Ref<const VectorXd>& parameters) const override {
    return inside_.residuals(states, parameters);
  }
  const std::vector<Residual>& residual_labels() const override { return inside_.residual_labels(); }
  std::vector<bool> reads(SystemPart part) const override { return inside_.reads(part); }

 private:
  const System& inside_;
};

TEST_P(StateEvaluators, OfAnySystemTakeDifferencesOfTheStatedError) {
  const OpaqueSystem opaque(*test::model(GetParam()).system);
  const auto exact = system().make_evaluator(system().parameter_values(), true);
  const auto differences = opaque.make_evaluator(opaque.parameter_values(), true);
  EXPECT_TRUE(opaque.make_evaluator(opaque.parameter_values(), false)->derivatives().empty());
  const MatrixXd states = test::draw(test::model(GetParam()), 10, state_evaluator_seed).states;
  for (Index i = 0; i < states.cols(); ++i) {
    exact->evaluate(states.col(i));
    differences->evaluate(states.col(i));
    EXPECT_EQ(values_of(*differences), values_of(*exact));
    const MatrixXd jacobian = jacobian_of(*exact, system());
    // ε^(2/3) ≈ 4e-11 of the sizes of the quantity and its third derivative, up to a few thousand here
    EXPECT_LE((jacobian_of(*differences, opaque) - jacobian).cwiseAbs().maxCoeff(), 1e-7 * (1 + jacobian.cwiseAbs().maxCoeff()));
  }
}

TEST_P(StateEvaluators, HaveTheirLikeInTheFeaturesAndDirectionsOfALatent) {
  const Model& model = test::model(GetParam());
  const Prior prior = make_prior(model);
  const MatrixXd states = test::draw(model, 3, state_evaluator_seed).states;
  const auto check = [&](const StateFunction& function, const VectorXd& parameters, const char* what) {
    const auto evaluator = function.make_evaluator(parameters);
    const std::vector<StateDerivatives::Entry>& entries = evaluator->entries();
    for (Index i = 0; i < states.cols(); ++i) {
      const VectorXd state = states.col(i).array().isNaN().select(0, states.col(i));
      MatrixXd jacobian = MatrixXd::Zero(function.size(), state.size());
      VectorXd values(static_cast<Index>(entries.size()));
      evaluator->differentiate(state, values);
      for (std::size_t k = 0; k < entries.size(); ++k) {
        jacobian(entries[k].output, entries[k].state_index) = values[static_cast<Index>(k)];
      }
      for (Index k = 0; k < state.size(); ++k) {
        SCOPED_TRACE(fmt::format("{}, x_{}, state {}, seed {}", what, k, i, state_evaluator_seed));
        const test::Difference difference = test::central_difference(
            [&](double value) -> VectorXd {
              VectorXd moved = state;
              moved[k] = value;
              return function.evaluate(moved, parameters);
            },
            state[k], 0.05, 64 * test::eps);
        EXPECT_TRUE(test::matches(jacobian.col(k), difference));
      }
    }
  };
  for (const Latent& latent : prior.latents) {
    EXPECT_GE(latent.features->make_evaluator(VectorXd())->entries().size(), static_cast<std::size_t>(latent.n_features()));
    check(*latent.features, VectorXd(), "features");
    if (latent.directions) check(*latent.directions, system().parameter_values(), "directions");
  }
}

TEST(StateEvaluatorTest, DifferencesSuitAnAngleOfManyTurnsAndTheTimeOfAClock) {
  const Model model =
      Model::parse("coordinates = ['x']\n[mechanics]\nmass = [['1']]\nforce = ['sin(x) + sin(3*t)']\n", "a driven wheel");
  const OpaqueSystem opaque(*model.system);
  const auto exact = model.system->make_evaluator(VectorXd(), true), differences = opaque.make_evaluator(VectorXd(), true);
  const Eigen::Vector3d state(1e5, 1, 1.7e9);
  exact->evaluate(state);
  differences->evaluate(state);
  const MatrixXd jacobian = jacobian_of(*exact, *model.system);
  EXPECT_GT(jacobian.cwiseAbs().maxCoeff(), 0.5);
  EXPECT_LE((jacobian_of(*differences, opaque) - jacobian).cwiseAbs().maxCoeff(), 1e-3);
}

TEST(StateEvaluatorTest, WhereASpeedHasNoDerivativeItIsZero) {
  const Model model = Model::parse(R"toml(
name = "two coordinates"
coordinates = ["x", "y"]
[let]
v = "sqrt(dx^2 + dy^2)"
[mechanics]
mass = [["1", "0"], ["0", "2 + x^2"]]
force = ["v - v*dx", "abs(dy)"]
[constraints]
acceleration = ["ddx - ddy*v"]
[[latent]]
kernel = "se"
features = ["x"]
directions = [["-v*dx"], ["-v"]]
)toml",
                                   "two.toml");
  const auto evaluator = model.system->make_evaluator(VectorXd(), true);
  VectorXd state = VectorXd::Zero(5);
  state[0] = 3;
  evaluator->evaluate(state);
  ASSERT_FALSE(evaluator->derivatives().empty());
  for (std::size_t k = 0; k < evaluator->derivatives().size(); ++k) {
    // ∂M_22/∂x alone does not vanish here
    const bool of_mass = evaluator->derivatives()[k].quantity == Quantity::mass;
    EXPECT_EQ(evaluator->derivative_values()[static_cast<Index>(k)], of_mass ? 6 : 0);
  }
  const Latent latent = make_prior(model).latents.front();
  const auto directions = latent.directions->make_evaluator(VectorXd());
  ASSERT_FALSE(directions->entries().empty());
  VectorXd derivatives(static_cast<Index>(directions->entries().size()));
  directions->differentiate(state, derivatives);
  EXPECT_TRUE(derivatives.isZero(0));
}

TEST(StateEvaluatorTest, RefusesWrongSizes) {
  const System& system = *test::model("models/surface.toml").system;
  EXPECT_THAT(test::input_error_of([&] { return system.make_evaluator(VectorXd::Zero(1), true); }),
              testing::AllOf(HasSubstr("make_evaluator"), HasSubstr("parameters, got 1")));
  const auto evaluator = system.make_evaluator(system.parameter_values(), false);
  EXPECT_THAT(test::input_error_of([&] { evaluator->evaluate(VectorXd::Zero(4)); }), HasSubstr("a state has 10 entries, got 4"));
}

}  // namespace
}  // namespace gp2
