// Impacts with friction, of bodies in free flight before and after, against closed forms.
#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <string>
#include <vector>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "gp2/error.hpp"
#include "gp2/fit.hpp"
#include "gp2/inference/pathwise.hpp"
#include "gp2/posterior.hpp"
#include "gp2/simulate.hpp"
#include "gp2/simulation/model_motion.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::HasSubstr;
using Kind = ContactEvent::Kind;

constexpr double rounding =
    1e-11;  // of velocities near 1 after steps of a relative tolerance of 1e-9, that are exact but for turns

SimulateOptions options_of(const Model& model) {
  SimulateOptions options;
  options.times = Eigen::Vector2d(0, 1);
  options.contacts = contacts_of(model, model.system->parameter_values());
  options.switching = switching_functions(model, /*of_latents=*/false);
  options.pushed = pushed_acceleration(model);
  return options;
}

Trajectory motion_of(const Model& model, const std::vector<double>& start) {
  VectorXd state = VectorXd::Zero(model.system->layout().size());
  std::copy(start.begin(), start.end(), state.begin());
  return simulate(*model.system, model.system->parameter_values(), model_acceleration(model), state, options_of(model));
}

VectorXd velocities(const Model& model, const Trajectory& motion) {
  const StateLayout layout = model.system->layout();
  return motion.states.col(motion.states.cols() - 1).segment(layout.dq(0), layout.nq);
}

constexpr double m = 1.3, R = 0.3, J = m * R * R / 2, e = 0.7;

// a disc over a floor; phi turns so that the point of contact moves at dx + R dphi
Model disc(const std::string& friction) {
  return Model::parse(fmt::format(R"toml(
coordinates = ["x", "z", "phi"]
inputs      = ["touch"]
[mechanics]
mass  = [["{0}", "0", "0"], ["0", "{0}", "0"], ["0", "0", "{1}"]]
force = ["0", "0", "0"]
[constraints]
position = [{{ expr = "z - {2}", contact = "touch", restitution = {3} }}]
[truth]
force = ["-({4})*sign(dx + {2}*dphi)", "0", "-({4})*sign(dx + {2}*dphi)*{2}"]
)toml",
                                  m, J, R, e, friction),
                      "disc");
}

TEST(ImpactFriction, OfADiscSlipsThroughOrEndsRolling) {
  const double v = 2, P = m * (1 + e) * v;
  for (const double mu : {0.05, 0.2, 0.6}) {
    for (const auto& [dx, dphi] : std::vector<std::pair<double, double>>{{3, 0}, {-0.4, 0}, {1, -9}, {0.5, 2}, {0.3, -1}}) {
      SCOPED_TRACE(fmt::format("mu {}, dx {}, dphi {}", mu, dx, dphi));
      for (const std::string load : {"abs(lambda(1))", "abs(lambda0(1))", "lambda(1)"}) {
        const Model model = disc(fmt::format("{}*{}", mu, load));
        const Trajectory motion = motion_of(model, {0, R + 1, 0, dx, -v, dphi});
        // the impulse Q of friction changes the slip by Q (1/m + R²/J) = 3 Q/m, and no farther than to 0
        const double slip = dx + R * dphi, Q = -std::copysign(std::min(mu * P, std::abs(slip) * m / 3), slip);
        const VectorXd dq = velocities(model, motion);
        EXPECT_NEAR(dq[0], dx + Q / m, rounding);
        EXPECT_NEAR(dq[1], e * v, rounding);
        EXPECT_NEAR(dq[2], dphi + R * Q / J, 10 * rounding);
        const auto energy = [](double vx, double vz, double w) { return (m * vx * vx + m * vz * vz + J * w * w) / 2; };
        ASSERT_EQ(motion.events.size(), 1U);
        EXPECT_NEAR(motion.events[0].energy_loss, energy(dx, v, dphi) - energy(dq[0], dq[1], dq[2]), rounding);
      }
    }
  }
}

// The end of a rod, whose impulse turns it: the slip stops, and sticks or turns around (Darboux; Keller 1986).
TEST(ImpactFriction, OfARodReversesOrStops) {
  const double a = 0.5, th = 1.1, c = std::cos(th), s = std::sin(th), I = m * a * a / 3, v = 1.5, w = 0.8;
  const double nn = 1 / m + a * a * c * c / I, tt = 1 / m + a * a * s * s / I, nt = a * a * s * c / I;
  int reversed = 0, stopped = 0, through = 0;
  for (const double mu : {0.1, 0.3, 1.2}) {
    for (const double slip : {-1.2, -0.3, 0.0, 0.4, 3.0}) {
      SCOPED_TRACE(fmt::format("mu {}, slip {}", mu, slip));
      const Model model = Model::parse(fmt::format(R"toml(
coordinates = ["x", "z", "th"]
inputs      = ["touch"]
[let]
slip = "dx - {0}*sin(th)*dth"
F    = "-{1}*abs(lambda(1))*sign(slip)"
[mechanics]
mass  = [["{2}", "0", "0"], ["0", "{2}", "0"], ["0", "0", "{3}"]]
force = ["0", "0", "0"]
[constraints]
position = [{{ expr = "z - {0}*sin(th)", contact = "touch", restitution = {4} }}]
[truth]
force = ["F", "0", "-{0}*sin(th)*F"]
)toml",
                                                   a, mu, m, I, e),
                                       "rod");
      // it comes down so that it is hit at th after 0.25 s
      const double dx = slip + a * s * w, dz = -v + a * c * w;
      const Trajectory motion = motion_of(model, {0, a * s - dz * 0.25, th - w * 0.25, dx, dz, w});
      ASSERT_EQ(motion.events.size(), 1U);
      EXPECT_NEAR(motion.events[0].approach, v, 1e-9);
      // impulses P and Q in phases, until the end has turned from −v to e v
      double left = (1 + e) * v, P = 0, Q = 0, at = slip;
      double side = at > 0 ? 1 : at < 0 ? -1 : nt > mu * tt ? 1 : 0;
      while (left > 0) {
        const double of_P = side != 0 ? -side * mu : -nt / tt;  // dQ/dP
        const double slows = nt + of_P * tt, opens = nn + of_P * nt;
        const double stops = side != 0 && slows * at < 0 ? -at / slows : std::numeric_limits<double>::infinity();
        const double dP = std::min(stops, left / opens);
        P += dP;
        Q += of_P * dP;
        at += slows * dP;
        left = dP == stops ? left - opens * dP : 0;
        const bool turns = nt > mu * tt;
        if (dP == stops) side = turns ? 1 : 0;
        if (dP == stops) ++(turns ? reversed : stopped);
      }
      through += static_cast<int>(side == (slip > 0 ? 1 : -1) && side * slip > 0);
      const VectorXd dq = velocities(model, motion);
      constexpr double of_angle = 1e-9;  // the step's tolerance, of th
      EXPECT_NEAR(dq[0], dx + Q / m, of_angle);
      EXPECT_NEAR(dq[1], dz + P / m, of_angle);
      EXPECT_NEAR(dq[2], w - a * (c * P + s * Q) / I, 10 * of_angle);
    }
  }
  EXPECT_GE(reversed, 2);
  EXPECT_GE(stopped, 2);
  EXPECT_GE(through, 2);
}

TEST(ImpactFriction, InAPlaneIsAgainstTheSlip) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "y", "z"]
inputs      = ["touch"]
[mechanics]
mass  = [["2", "0", "0"], ["0", "2", "0"], ["0", "0", "2"]]
force = ["0", "0", "0"]
[constraints]
position = [{ expr = "z", contact = "touch", restitution = 0.5 }]
[truth]
force = ["-0.2*lambda(1)*dx/sqrt(dx^2 + dy^2)", "-0.2*lambda(1)*dy/sqrt(dx^2 + dy^2)", "0"]
)toml",
                                   "puck");
  const double lost = 0.2 * 1.5 * 2;
  const VectorXd fast = velocities(model, motion_of(model, {0, 0, 1, 3, -4, -2}));
  EXPECT_NEAR(fast[0], 3 * (1 - lost / 5), 1e-8);
  EXPECT_NEAR(fast[1], -4 * (1 - lost / 5), 1e-8);
  const VectorXd slow = velocities(model, motion_of(model, {0, 0, 1, 0.3, -0.4, -2}));
  EXPECT_NEAR(slow.head(2).norm(), 0, 1e-8);
  EXPECT_NEAR(slow[2], 1, rounding);
}

// A disc that spins on a smooth floor hits a rough wall, which lifts it or presses it down.
TEST(ImpactFriction, LiftsWhatTheFloorHolds) {
  const double mu = 0.15, v = 2;
  const Model model = Model::parse(fmt::format(R"toml(
coordinates = ["x", "z", "phi"]
inputs      = ["floor", "wall"]
[mechanics]
mass  = [["{0}", "0", "0"], ["0", "{0}", "0"], ["0", "0", "{1}"]]
force = ["0", "0", "0"]
[constraints]
position = [{{ expr = "z - {2}", contact = "floor", restitution = {3} }}, {{ expr = "1 - {2} - x", contact = "wall", restitution = {3} }}]
[truth]
force = ["0", "-{4}*abs(lambda(2))*sign(dz + {2}*dphi)", "-{4}*abs(lambda(2))*sign(dz + {2}*dphi)*{2}"]
)toml",
                                               m, J, R, e, mu),
                                   "spinning");
  const double P = m * (1 + e) * v;
  for (const double spin : {-30.0, 30.0}) {
    SCOPED_TRACE(spin);
    const Trajectory motion = motion_of(model, {0, R, 0, v, 0, spin});
    const VectorXd dq = velocities(model, motion);
    EXPECT_NEAR(dq[0], -e * v, rounding);
    EXPECT_NEAR(dq[1], spin < 0 ? mu * P / m : 0, rounding);
    EXPECT_NEAR(dq[2], spin - std::copysign(mu * P * R / J, spin), 10 * rounding);
    const auto released = [](const ContactEvent& one) { return one.kind == Kind::released; };
    EXPECT_EQ(std::count_if(motion.events.begin(), motion.events.end(), released), spin < 0 ? 1 : 0);
  }
}

TEST(ImpactFriction, ThatIsNotProportionalToItsLoad) {
  // what is bounded has no impulse
  const Model bounded = disc("min(0.5*abs(lambda(1)), 4)");
  const VectorXd dq = velocities(bounded, motion_of(bounded, {0, R + 1, 0, 3, -2, 0}));
  EXPECT_NEAR(dq[0], 3, rounding);
  EXPECT_NEAR(dq[1], 2 * e, rounding);
  const Model squared = disc("0.1*lambda(1)^2");
  try {
    static_cast<void>(motion_of(squared, {0, R + 1, 0, 3, -2, 0}));
    ADD_FAILURE();
  } catch (const UnfinishedMotion& error) {
    EXPECT_THAT(error.what(), HasSubstr("at t = 0.5: the friction of an impact grows faster than its load"));
  }
}

// Of a fit the friction of an impact is the one that it has learned, whichever way it reads the load.
TEST(ImpactFriction, OfAPosteriorIsThatOfItsLatents) {
  for (const std::string latent : {"lambda(1)", "lambda0(1)", "lambda(1) positive"}) {
    SCOPED_TRACE(latent);
    const std::string load = latent.substr(0, latent.find(' '));
    const Model model = Model::parse(fmt::format(R"toml(
coordinates = ["x", "z"]
inputs      = ["touch"]
[mechanics]
mass  = [["2", "0"], ["0", "3"]]
force = ["0", "-3*9.81"]
[constraints]
position = [{{ expr = "z - 0.1*x", contact = "touch", restitution = 0.5 }}]
[[latent]]
kernel     = "constant"
features   = ["x"]
directions = {{ force = [["-abs({0})*sign(dx)"], ["-abs({0})*sign(dx)*0.1"]] }}
{1}
[truth]
force = ["-0.3*abs({0})*sign(dx)", "-0.03*abs({0})*sign(dx)"]
)toml",
                                                 load, load == latent ? "" : "positive = true"),
                                     "puck");
    MatrixXd states = MatrixXd::Zero(model.system->layout().size(), 6);
    states.row(2) << 1, -1, 2, -2, 0.5, -3;
    states.row(3) = 0.1 * states.row(2);
    states.row(5).setOnes();
    const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
    const View ddq = View::constrained_acceleration(*model.system);
    const std::vector<Observations> observed = {
        {states, ddq, ModelMotion(model).acceleration(states), VectorXd::Constant(2, 0.3)}};
    const Posterior posterior(prior, observed, model_values(prior, observed, default_hyperparameters(prior, observed, {}, {})));
    const PathwiseSamples samples = sample_paths(posterior, 1, {.seed = 7});
    const auto mean = [&](const View& view, const Eigen::Ref<const MatrixXd>& x) { return posterior.mean(view, x); };
    const auto sample = [&](const View& view, const Eigen::Ref<const MatrixXd>& x) { return samples.evaluate(0, view, x); };
    for (const auto& function :
         std::vector<std::function<MatrixXd(const View&, const Eigen::Ref<const MatrixXd>&)>>{mean, sample}) {
      const Acceleration acceleration = [&](const Eigen::Ref<const VectorXd>& x) -> VectorXd { return function(ddq, x).col(0); };
      SimulateOptions options = options_of(model);
      options.switching = switching_functions(model, /*of_latents=*/true);
      options.pushed = pushed_acceleration(prior, ddq, function);
      options.times = Eigen::Vector2d(0, 1e-3);
      VectorXd start = VectorXd::Zero(model.system->layout().size());
      start.segment(1, 3) << 5e-4, 1.5, -1;
      const Trajectory motion = simulate(*model.system, {}, acceleration, start, options);
      ASSERT_EQ(motion.events.size(), 1U);
      // M ddq = F + Aᵀλ + d μ L, L = λ or λ₀, says what μ is; the impulses of the impact are M Δdq = AᵀP + d μ L of theirs
      const Eigen::Vector2d A(-0.1, 1), d(-1, -0.1), F(0, -3 * 9.81), M(2, 3);
      const auto over_M = [&](const Eigen::Vector2d& force) { return A.dot(force.cwiseQuotient(M)); };
      VectorXd slides = VectorXd::Zero(model.system->layout().size());
      slides.segment(2, 2) << 1, 0.1;
      slides[5] = 1;
      const Eigen::Vector2d both = (Eigen::Matrix2d() << A, d).finished().inverse() * (M.cwiseProduct(acceleration(slides)) - F);
      const double gain = 1.5 * motion.events[0].approach;
      const bool is_known = load != "lambda(1)";
      const double mu = both[1] / (is_known ? -over_M(F) / over_M(A) : both[0]);
      ASSERT_GT(mu, 0.05);
      const double of_known = gain / over_M(A);
      const double P = is_known ? of_known * (1 - mu * over_M(d) / over_M(A)) : gain / over_M(A + mu * d);
      EXPECT_NEAR(motion.states(2, 1), 1.5 + (A[0] * P + d[0] * mu * (is_known ? of_known : P)) / M[0], 1e-9);
    }
  }
}

// Without friction of a load nothing is pushed, and impacts are those along M⁻¹Aᵀ.
TEST(ImpactFriction, IsThereOnlyWhereALoadIsRead) {
  EXPECT_FALSE(pushed_acceleration(disc("0.1")));
  EXPECT_TRUE(pushed_acceleration(disc("0.1*lambda(1)")));
}

}  // namespace
}  // namespace gp2
