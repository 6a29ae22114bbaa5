#include "gp2/prior.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "gp2/error.hpp"
#include "gp2/prior/latent_spec.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr std::uint64_t prior_seed = 30302;

// directions and a force with parameters in them, on a mass matrix with parameters; the speed has no derivative at rest
const Model& friction_model() {
  static const Model model = Model::parse(test::before_latents(test::model_with_friction()) + R"toml([[latent]]
name       = "slip"
kernel     = "se"
features   = ["dx*u", "heading"]
directions = { force = [["-c*speed*dx", "k"], ["0", "e*heading"]] }
[[latent]]
name       = "rest"
kernel     = "matern32"
features   = ["dx", "u"]
directions = [["c^2*dx"], ["m"]]
[[latent]]
name       = "all forces"
kernel     = "se"
features   = ["dx"]
directions = "force"
)toml",
                                          "sledge");
  return model;
}

struct PriorCase {
  std::string name;
  const Model* model;
  PriorOptions options;
};

std::vector<PriorCase> prior_cases() {
  std::vector<PriorCase> all;
  const auto add = [&](std::string name, const Model& model) {
    for (Prior::Mean mean : {Prior::Mean::zero, Prior::Mean::force}) {
      PriorOptions options;
      options.mean = mean;
      all.push_back({name, &model, options});
      if (model.latents.size() > 1) continue;
      options.base = Latent::Base::force;
      all.push_back({name + ", prior on force", &model, options});
    }
  };
  for (const std::string& file : test::every_model()) add(file, test::model(file));
  add("sledge", friction_model());
  return all;
}

MatrixXd states_of(const Model& model) {
  if (!model.sampling.empty()) return test::draw(model, 5, prior_seed).states;
  RandomStream random(prior_seed);
  MatrixXd states = test::random_matrix(model.system->layout().size(), 6, random);
  states.col(5).segment(model.system->nq(), model.system->nq()).setZero();  // at rest
  return states;
}

VectorXd stack(const PriorValues& values) {
  std::vector<double> all(values.mean.data(), values.mean.data() + values.mean.size());
  for (const MatrixXd& E : values.directions) all.insert(all.end(), E.data(), E.data() + E.size());
  return Eigen::Map<const VectorXd>(all.data(), static_cast<Eigen::Index>(all.size()));
}

TEST(PriorTest, MeanAndDirectionsAreThoseOfItsEquations) {
  for (const PriorCase& one : prior_cases()) {
    SCOPED_TRACE(one.name);
    const Prior prior = make_prior(*one.model, one.options);
    const MatrixXd states = states_of(*one.model);
    const VectorXd parameters = prior.system->parameter_values();
    const MechanicsBatch mechanics = require_mechanics(*prior.system, states, parameters);
    const PriorValues values = evaluate_prior(prior, states, parameters, mechanics);
    for (int i = 0; i < mechanics.values.n_states(); ++i) {
      // M⁻¹ by another factorisation; condition numbers of M are a few hundred
      const MatrixXd M_inverse = mechanics.values.M(i).fullPivLu().inverse();
      const double tolerance = 1e5 * test::eps * M_inverse.cwiseAbs().maxCoeff();
      const VectorXd mean = prior.mean == Prior::Mean::zero ? VectorXd::Zero(prior.system->nq()).eval()
                                                            : (M_inverse * mechanics.values.F(i)).eval();
      EXPECT_LE((values.mean.col(i) - mean).cwiseAbs().maxCoeff(), tolerance * (1 + mechanics.values.F(i).cwiseAbs().maxCoeff()));
      for (std::size_t a = 0; a < prior.latents.size(); ++a) {
        const Latent& latent = prior.latents[a];
        MatrixXd B = MatrixXd::Identity(prior.system->nq(), prior.system->nq());
        if (latent.directions) {
          const MatrixXd entries = latent.directions->evaluate(states.col(i), parameters);
          B = entries.reshaped(prior.system->nq(), latent.size());
        }
        if (latent.base == Latent::Base::force) B = M_inverse * B;
        EXPECT_LE((values.E(a, i) - B).cwiseAbs().maxCoeff(), tolerance * (1 + B.cwiseAbs().maxCoeff()));
      }
    }
  }
}

TEST(PriorTest, DerivativesInEveryParameterMatchDifferences) {
  for (const PriorCase& one : prior_cases()) {
    const Prior prior = make_prior(*one.model, one.options);
    const MatrixXd states = states_of(*one.model);
    const VectorXd parameters = prior.system->parameter_values();
    const auto values_at = [&](const VectorXd& at) {
      return evaluate_prior(prior, states, at, require_mechanics(*prior.system, states, at));
    };
    const MechanicsBatch mechanics = require_mechanics(*prior.system, states, parameters);
    bool any = false;
    // away from the nominal state a redundant row contradicts the others; it has no part in the prior, M and F have
    const bool redundant = prior.system->name().find("redundant") != std::string::npos;
    for (int p = 0; p < static_cast<int>(parameters.size()); ++p) {
      const std::string& name = prior.system->parameters()[static_cast<std::size_t>(p)].name;
      SCOPED_TRACE(fmt::format("{}, mean {}, parameter {}, seed {}", one.name, static_cast<int>(prior.mean), name, prior_seed));
      const PriorValues d = differentiate_prior(prior, states, parameters, mechanics, values_at(parameters),
                                                prior.system->differentiate(states, parameters, p), p);
      const test::Difference difference = test::central_difference(
          [&](double value) {
            VectorXd moved = parameters;
            moved[p] = value;
            if (redundant) return stack(evaluate_prior(prior, states, moved, evaluate_mechanics(*prior.system, states, moved)));
            return stack(values_at(moved));
          },
          parameters[p], parameters[p] == 0 ? 0.01 : 0.05 * std::abs(parameters[p]), 1024 * test::eps);
      EXPECT_TRUE(stack(d).allFinite());
      EXPECT_TRUE(test::matches(stack(d), difference));
      any = any || stack(d).lpNorm<Eigen::Infinity>() > 1e-3;
    }
    const bool depends = prior.mean == Prior::Mean::force || prior.latents[0].base == Latent::Base::force;
    // the surfaces of the experiments write their mass and force as numbers
    if (depends && one.name.find("experiments/surface_") == std::string::npos) {
      EXPECT_TRUE(any) << one.name << ": every derivative is zero";
    }
  }
}

TEST(PriorTest, AtRestADirectionWithASpeedInItHasFiniteDerivatives) {
  const Prior prior = make_prior(friction_model());
  MatrixXd states = MatrixXd::Zero(prior.system->layout().size(), 1);
  const VectorXd parameters = prior.system->parameter_values();
  const MechanicsBatch mechanics = require_mechanics(*prior.system, states, parameters);
  const PriorValues values = evaluate_prior(prior, states, parameters, mechanics);
  for (int p = 0; p < static_cast<int>(parameters.size()); ++p) {
    const PriorValues d =
        differentiate_prior(prior, states, parameters, mechanics, values, prior.system->differentiate(states, parameters, p), p);
    EXPECT_TRUE(stack(d).allFinite()) << prior.system->parameters()[static_cast<std::size_t>(p)].name;
  }
}

TEST(PriorTest, AnAngleIsReadThroughItsSineAndCosineUnlessAskedForRaw) {
  const Model& model = test::model("models/unicycle.toml");
  EXPECT_EQ(make_prior(model).latents[0].feature_names,
            (std::vector<std::string>{"dq1", "dq2", "sin(q3)", "cos(q3)", "dq3", "u1", "u2"}));
  const Prior raw = make_prior(model, {Prior::Mean::zero, std::nullopt, true});
  EXPECT_EQ(raw.latents[0].feature_names, (std::vector<std::string>{"dq1", "dq2", "q3", "dq3", "u1", "u2"}));

  // features of a state in the order of their names
  const MatrixXd states = test::draw(model, 3, prior_seed).states;
  const StateLayout layout = model.system->layout();
  const MatrixXd features = evaluate_features(raw, 0, states);
  ASSERT_EQ(features.rows(), 3);
  ASSERT_EQ(features.cols(), 6);
  EXPECT_EQ(features(2, 2), states(layout.q(2), 2));
  EXPECT_EQ(features(1, 5), states(layout.u(1), 1));
  EXPECT_EQ(evaluate_features(make_prior(model), 0, states)(0, 3), std::cos(states(layout.q(2), 0)));
}

TEST(PriorTest, ReadsWhatItsPartsReadAndNoMore) {
  const Model& model = test::model("models/unicycle.toml");
  const StateLayout layout = model.system->layout();
  const std::vector<bool> zero_mean = make_prior(model).reads();
  EXPECT_FALSE(zero_mean[static_cast<std::size_t>(layout.q(0))]);
  EXPECT_FALSE(zero_mean[static_cast<std::size_t>(layout.t())]);
  EXPECT_TRUE(zero_mean[static_cast<std::size_t>(layout.q(2))]);
  EXPECT_TRUE(zero_mean[static_cast<std::size_t>(layout.u(0))]) << "a feature";
  // the double pendulum's linear velocities enter neither mechanics nor features
  const Model& pendulum = test::model("models/double_pendulum.toml");
  EXPECT_FALSE(make_prior(pendulum).reads()[static_cast<std::size_t>(pendulum.system->layout().dq(0))]);
}

TEST(PriorTest, AnotherBaseIsRefusedForAModelOfSeveralLatents) {
  PriorOptions options;
  options.base = Latent::Base::force;
  EXPECT_THROW(make_prior(friction_model(), options), InputError);
}

TEST(PriorTest, FeaturesFromCodeOfAnotherShapeAreRefusedAlsoWhereTheyAreCentred) {
  const Model& model = test::model("models/duffing.toml");
  LatentSpec spec{.name = "code", .features = {"a"}};
  spec.feature_code.evaluate = [](const auto& states, const auto&) -> MatrixXd { return MatrixXd::Ones(500, states.cols()); };
  PriorOptions options;
  options.feature_centres = {{"a", 2.0}};
  const Prior prior = make_prior(model.system, {spec}, options);
  EXPECT_THAT(test::input_error_of([&] { evaluate_features(prior, 0, states_of(model)); }),
              testing::HasSubstr("returned the shape 500 × "));
}

TEST(PriorTest, AnotherBaseLeavesNothingOfDirectionsNorOfTheSignAlongThem) {
  const Model damped = Model::parse(R"toml(
name        = "damped"
coordinates = ["x", "y"]
[mechanics]
mass = [["1", "0"], ["0", "2"]]
[[latent]]
kernel     = "se"
features   = ["dx", "dy"]
directions = { force = [["-dx"], ["-dy"]] }
positive   = true
)toml",
                                    "damped");
  EXPECT_TRUE(make_prior(damped).latents[0].is_positive);
  PriorOptions options;
  for (const Latent::Base base : {Latent::Base::acceleration, Latent::Base::force}) {
    options.base = base;
    const Prior prior = make_prior(damped, options);
    EXPECT_FALSE(prior.latents[0].is_positive) << "accelerations of either sign";
    EXPECT_FALSE(prior.is_nonlinear());
  }
}

TEST(PriorTest, ColumnsAreNamedAfterWhatTheyActOn) {
  const Prior prior = make_prior(friction_model());
  EXPECT_EQ(prior.latents[0].column_names.size(), 2u);
  EXPECT_EQ(prior.latents[1].column_names.size(), 1u);
  EXPECT_EQ(prior.latents[2].column_names, (std::vector<std::string>{"force_x", "force_heading"}));
  EXPECT_EQ(make_prior(test::model("models/duffing.toml")).latents[0].column_names, (std::vector<std::string>{"ddq1", "ddq2"}));
}

}  // namespace
}  // namespace gp2
