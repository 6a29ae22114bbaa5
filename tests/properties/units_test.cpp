#include <array>
#include <cmath>

#include <gtest/gtest.h>

#include "gp2/fit.hpp"
#include "inference/problems.hpp"

// The same particle on the same surface, its log in other units: everything that is learned is the same, in those units.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;
using test::Quantity;

constexpr std::uint64_t units_seed = 20272;

/// Numbers in the new units for one of the old.
struct Units {
  std::string name;
  VectorXd coordinate = VectorXd::Ones(3);  // of each of its own
  double time = 1;
  double energy = 1;
  double constraint = 1;

  [[nodiscard]] VectorXd velocity() const { return coordinate / time; }
  [[nodiscard]] VectorXd acceleration() const { return coordinate / (time * time); }
  [[nodiscard]] VectorXd force() const { return energy * coordinate.cwiseInverse(); }
  [[nodiscard]] VectorXd state() const {
    VectorXd of_state(10);  // q, dq, t, u
    of_state << coordinate, velocity(), time, force();
    return of_state;
  }
};

// models/surface.toml with another mass for each direction, its expressions in the old units by way of [let]
Model surface_in(const Units& units, const std::string& kernel, const std::string& directions) {
  std::string text =
      "name = \"surface\"\ncoordinates = [\"Q1\", \"Q2\", \"Q3\"]\ninputs = [\"U1\", \"U2\", \"U3\"]\n"
      "[parameters]\nm = { value = 3, estimate = true, bounds = [1, 9] }\n"
      "p1 = { value = 0.08, estimate = true, bounds = [0.04, 0.16] }\n[let]\n";
  const VectorXd q = units.coordinate, dq = units.velocity(), u = units.force();
  for (int j = 0; j < 3; ++j) {
    text +=
        fmt::format("q{0} = \"Q{0}/{1:.17g}\"\ndq{0} = \"dQ{0}/{2:.17g}\"\nu{0} = \"U{0}/{3:.17g}\"\n", j + 1, q[j], dq[j], u[j]);
  }
  text += "[mechanics]\nmass = [";
  const char* masses[3][3] = {{"m", "0.2", "0"}, {"0.2", "2*m", "0"}, {"0", "0", "0.5*m + 0.1*q1^2"}};
  const double per_energy = units.energy * units.time * units.time;
  for (int i = 0; i < 3; ++i) {
    text += i == 0 ? "[" : ", [";
    for (int j = 0; j < 3; ++j) {
      text += fmt::format("{}\"{:.17g}*({})\"", j == 0 ? "" : ", ", per_energy / (q[i] * q[j]), masses[i][j]);
    }
    text += "]";
  }
  text += fmt::format("]\nforce = [\"{:.17g}*u1\", \"{:.17g}*u2\", \"{:.17g}*(u3 - 9.81*m)\"]\n", u[0], u[1], u[2]);
  text += fmt::format("[constraints]\nposition = [\"{:.17g}*(p1*q1^2 + 0.05*q2^2 + 0.05*q1*q2 + 0.1*cos(3*q1) - q3)\"]\n",
                      units.constraint);
  text += fmt::format(
      "[[latent]]\nkernel = \"{}\"\nfeatures = [\"Q1\", \"Q2\", \"Q3\", \"dQ1\", \"dQ2\", \"U1\"]\n"
      "directions = {}\n",
      kernel, directions);
  return Model::parse(text, "surface in " + units.name);
}

struct Case {
  std::string kernel, directions;
  Prior::Mean mean;
};

struct Learned {
  Prior prior;
  std::vector<Observations> observations;
  std::vector<Hyperparameter> hyperparameters;
};

Learned learn(const Units& units, const Case& c, const MatrixXd& states, const MatrixXd& accelerations) {
  const Model model = surface_in(units, c.kernel, c.directions);
  Learned out{make_prior(model, {c.mean, std::nullopt, false}), {}, {}};
  const VectorXd noise = VectorXd::Constant(3, 0.1).cwiseProduct(units.acceleration());
  out.observations = {{units.state().asDiagonal() * states, View::all(Quantity::constrained_acceleration, *model.system),
                       units.acceleration().asDiagonal() * accelerations, noise, true}};
  out.hyperparameters = default_hyperparameters(out.prior, out.observations, {"m", "p1"}, {});
  return out;
}

// in the new units, a number in the old: of hyperparameters by what they are
double factor(const Hyperparameter& h, const Prior& prior, const Units& units, bool own_directions) {
  switch (h.kind) {
    case Hyperparameter::Kind::kernel: {
      const Kernel::Parameter& parameter = prior.latents[0].kernel.parameters()[static_cast<std::size_t>(h.index)];
      if (parameter.kind != Kernel::ParameterKind::lengthscale && parameter.kind != Kernel::ParameterKind::period) return 1;
      const std::array<double, 6> of_feature = {units.coordinate[0], units.coordinate[1], units.coordinate[2],
                                                units.velocity()[0], units.velocity()[1], units.force()[0]};
      return of_feature[static_cast<std::size_t>(parameter.feature)];
    }
    case Hyperparameter::Kind::signal_stddev:
      if (own_directions) return 1 / units.time;  // of −dq f, an acceleration
      return prior.latents[0].base == Latent::Base::force ? units.force()[h.index] : units.acceleration()[h.index];
    case Hyperparameter::Kind::noise_stddev:
      return units.acceleration()[h.index];
    default:
      return 1;
  }
}

void expect_same(const Units& units, const Case& c) {
  SCOPED_TRACE(fmt::format("{}, kernel {}, directions {}, seed {}", units.name, c.kernel, c.directions, units_seed));
  // on the surface, in metres, seconds and joules
  const Model& surface = test::model("models/surface.toml");
  const MatrixXd states = test::draw(surface, 46, units_seed).states;
  RandomStream random(units_seed);
  MatrixXd accelerations = true_acceleration(surface, states);
  for (double& a : accelerations.reshaped()) a += 0.1 * random.normal();
  const MatrixXd observed = states.leftCols(40), queries = states.rightCols(6);
  const Learned old = learn({"SI"}, c, observed, accelerations.leftCols(40));
  const Learned other = learn(units, c, observed, accelerations.leftCols(40));

  // where fits start and how they are bounded
  const bool own = c.directions.front() == '[';
  ASSERT_EQ(old.hyperparameters.size(), other.hyperparameters.size());
  for (std::size_t k = 0; k < old.hyperparameters.size(); ++k) {
    const Hyperparameter &a = old.hyperparameters[k], &b = other.hyperparameters[k];
    const double scale = factor(a, old.prior, units, own);
    for (const auto& [one, another] :
         {std::pair{a.value, b.value}, {a.lower, b.lower}, {a.upper, b.upper}, {a.hyperprior.median, b.hyperprior.median}}) {
      EXPECT_NEAR(another, scale * one, 64 * eps * std::abs(scale * one)) << a.name;
    }
  }

  // the likelihood is a density of the values: in other units it differs by their logarithm
  const ModelValues in_old = model_values(old.prior, old.observations, old.hyperparameters);
  const ModelValues in_other = model_values(other.prior, other.observations, other.hyperparameters);
  Likelihood::Options options;
  options.noise_gradient = true;
  options.gradient_parameters = {0, 1};
  Likelihood::Workspace workspace;
  ModelGradient slope_old, slope_other;
  const double value_old = Likelihood(old.prior, old.observations, in_old, options).evaluate(in_old, &slope_old, workspace);
  const double value_other =
      Likelihood(other.prior, other.observations, in_other, options).evaluate(in_other, &slope_other, workspace);
  const double shift = 40 * units.acceleration().array().log().sum();
  EXPECT_NEAR(value_other - shift, value_old, 1e-8 * (std::abs(value_old) + std::abs(shift)));
  // slopes in logarithms and in θ, which has the same unit, do not differ
  const auto expect_equal = [](const VectorXd& a, const VectorXd& b, const char* what) {
    EXPECT_LE(test::largest(a - b), 1e-8 * (1 + test::largest(a))) << what;
  };
  expect_equal(slope_old.log_kernel[0], slope_other.log_kernel[0], "kernel");
  expect_equal(slope_old.log_signal_stddev[0], slope_other.log_signal_stddev[0], "signal");
  expect_equal(slope_old.log_noise_stddev[0], slope_other.log_noise_stddev[0], "noise");
  expect_equal(slope_old.parameters, slope_other.parameters, "θ");

  // predictions and their standard deviations
  const Posterior of_old(old.prior, old.observations, in_old), of_other(other.prior, other.observations, in_other);
  const auto compare = [&](Quantity quantity, const VectorXd& unit) {
    const Posterior::Marginal a = of_old.marginal(View::all(quantity, *old.prior.system), queries);
    const Posterior::Marginal b =
        of_other.marginal(View::all(quantity, *other.prior.system), units.state().asDiagonal() * queries);
    const MatrixXd mean = unit.cwiseInverse().asDiagonal() * b.mean, stddev = unit.cwiseInverse().asDiagonal() * b.stddev();
    EXPECT_LE(test::largest(mean - a.mean), 1e-8 * test::largest(a.mean)) << quantity->word();
    // friction along the surface leaves the force across it certain: a rounded zero, beside the mean
    EXPECT_LE(test::largest(stddev - a.stddev()), 1e-8 * test::largest(a.stddev()) + 1e-12 * test::largest(a.mean))
        << quantity->word();
  };
  compare(Quantity::constrained_acceleration, units.acceleration());
  compare(Quantity::unconstrained_acceleration, units.acceleration());
  compare(Quantity::constraint_force, units.force());
  compare(Quantity::learned_force, units.force());
  compare(Quantity::multipliers, VectorXd::Constant(1, units.energy / units.constraint));
}

const Eigen::Vector3d ones = Eigen::Vector3d::Ones();
const std::vector<Case> cases = {{"se", "\"acceleration\"", Prior::Mean::zero},
                                 {"se", "\"force\"", Prior::Mean::force},
                                 {"rq + linear", "\"force\"", Prior::Mean::zero},
                                 {"matern52*periodic", "\"acceleration\"", Prior::Mean::force}};
const Case friction = {"se", R"([["-dQ1"], ["-dQ2"], ["-dQ3"]])", Prior::Mean::zero};

// 1 kg (mm)²/(ms)² is 1 J; 1 t m²/s² is 1e3 J
TEST(UnitsTest, MillimetresTonnesAndMillisecondsLearnTheSame) {
  for (const Case& c : cases) {
    expect_same({"mm, ms, kg", 1e3 * ones, 1e3, 1, 1}, c);
    expect_same({"t", ones, 1, 1e-3, 1}, c);
    expect_same({"mm, t", 1e3 * ones, 1, 1e3, 1e3}, c);
    expect_same({"huge", 1e-9 * ones, 1e-6, 1e20, 1e30}, c);
    expect_same({"tiny", 1e12 * ones, 1e9, 1e-15, 1e-20}, c);
  }
  expect_same({"mm, ms, kg", 1e3 * ones, 1e3, 1, 1}, friction);
  expect_same({"huge", 1e-9 * ones, 1e-6, 1e20, 1e30}, friction);
}

TEST(UnitsTest, EachCoordinateMayHaveAUnitOfItsOwn) {
  for (const Case& c : cases) {
    expect_same({"mm, inches and kilometres", Eigen::Vector3d(1e3, 1 / 0.0254, 1e-3), 1, 1, 7}, c);
    expect_same({"micrometres, metres and megametres", Eigen::Vector3d(1e6, 1, 1e-6), 1, 1, 1}, c);
  }
}

}  // namespace
}  // namespace gp2
