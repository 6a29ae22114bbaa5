// Contacts that are made, bounced off and released, against closed forms.
#include <algorithm>
#include <cmath>
#include <numbers>
#include <numeric>
#include <optional>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "gp2/error.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/mechanics/symbolic_system.hpp"
#include "gp2/simulate.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "input_error.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::HasSubstr;
using Kind = ContactEvent::Kind;

constexpr double g = 9.81;
constexpr double of_event = 1e-6;  // s, what is asked of the time of an event

Model ball(const std::string& restitution) {
  return Model::parse(fmt::format(R"toml(
coordinates = ["x", "z"]
inputs      = ["touch"]
[parameters]
e = 0.8
[mechanics]
mass      = [["2", "0"], ["0", "2"]]
force     = ["0", "-2*9.81"]
potential = "2*9.81*z"
[constraints]
position = [{{ expr = "z", contact = "touch", restitution = {} }}]
)toml",
                                  restitution),
                      "ball");
}

// on a ball of radius 1
Model bead() {
  return Model::parse(R"toml(
coordinates = ["x", "z"]
inputs      = ["touch"]
[mechanics]
mass      = [["1", "0"], ["0", "1"]]
force     = ["0", "-9.81"]
potential = "9.81*z"
[constraints]
position = [{ expr = "sqrt(x^2 + z^2) - 1", contact = "touch" }]
)toml",
                      "bead");
}

Trajectory motion_of(const Model& model, const std::vector<double>& start, double t_end, int n, double tolerance = 0) {
  SimulateOptions options;
  options.times = VectorXd::LinSpaced(n, 0, t_end);
  if (tolerance > 0) options.relative_tolerance = options.absolute_tolerance = tolerance;
  options.contacts = contacts_of(model, model.system->parameter_values());
  options.pushed = pushed_acceleration(model);
  options.switching = switching_functions(model, /*of_latents=*/false);
  options.record = [motion = ModelMotion(model)](const Eigen::Ref<const VectorXd>& x) -> VectorXd {
    return motion.multipliers(x).col(0);
  };
  VectorXd state = VectorXd::Zero(model.system->layout().size());
  state.head(static_cast<Index>(start.size())) = Eigen::Map<const VectorXd>(start.data(), static_cast<Index>(start.size()));
  return simulate(*model.system, model.system->parameter_values(), model_acceleration(model), state, options);
}

std::vector<ContactEvent> of_kind(const Trajectory& motion, Kind kind) {
  std::vector<ContactEvent> found;
  std::copy_if(motion.events.begin(), motion.events.end(), std::back_inserter(found),
               [&](const ContactEvent& one) { return one.kind == kind; });
  return found;
}

// A ddq = b of the rows that are active at each state
void expect_constraints(const Model& model, const Trajectory& motion) {
  const SystemValues values = model.system->evaluate(motion.states, model.system->parameter_values());
  for (int i = 0; i < values.n_states(); ++i) {
    const VectorXd ddq = motion.accelerations.col(i);
    const VectorXd size = values.A(i).cwiseAbs() * ddq.cwiseAbs() + values.b(i).cwiseAbs();
    EXPECT_LE((values.A(i) * ddq - values.b(i)).lpNorm<Eigen::Infinity>(), 1e-14 * (1 + size.maxCoeff())) << i;
  }
}

TEST(Contact, OfABouncingBallHitsWhenTheClosedFormSays) {
  const double h = 1.3, e = 0.8, v = std::sqrt(2 * g * h);
  const Model model = ball("\"e\"");
  const Trajectory motion = motion_of(model, {0, h, 0.5, 0}, 6, 601);
  const std::vector<ContactEvent> impacts = of_kind(motion, Kind::impact);
  ASSERT_GT(impacts.size(), 40U);
  double t = v / g, speed = v, worst = 0;
  for (const ContactEvent& one : impacts) {
    worst = std::max(worst, std::abs(one.time - t));
    EXPECT_NEAR(one.approach, speed, 1e-6 * v);
    // ½ m v² (1 − e²)
    EXPECT_NEAR(one.energy_loss, speed * speed * (1 - e * e), 1e-6 * v * v);
    speed *= e;
    t += 2 * speed / g;
  }
  EXPECT_LE(worst, of_event);
  // the bounces end at v/g (1 + e)/(1 − e)
  const std::vector<ContactEvent> made = of_kind(motion, Kind::made);
  ASSERT_EQ(made.size(), 1U);
  EXPECT_NEAR(made[0].time, v / g * (1 + e) / (1 - e), of_event);
  EXPECT_TRUE(of_kind(motion, Kind::released).empty());
  // it rests on the ground and slides on
  for (Index i = 0; i < motion.times.size(); ++i) {
    const bool rests = motion.times[i] > made[0].time;
    EXPECT_EQ(motion.states(5, i), rests ? 1 : 0);
    EXPECT_NEAR(motion.states(0, i), 0.5 * motion.times[i], 1e-9);
    if (!rests) continue;
    EXPECT_NEAR(motion.states(1, i), 0, 1e-20);
    EXPECT_NEAR(motion.states(3, i), 0, 1e-20);
    EXPECT_NEAR(motion.records(0, i), 2 * g, 1e-12);
  }
  expect_constraints(model, motion);
}

TEST(Contact, EnergyFallsByTheSquareOfTheRestitution) {
  for (const double e : {0.3, 0.8, 1.0}) {
    const Model model = ball(fmt::format("{}", e));
    const double v = std::sqrt(2 * g);
    const Trajectory motion = motion_of(model, {0, 1, 0, 0}, v / g * (1 + e), 2);  // to the top of the first rebound
    ASSERT_EQ(motion.events.size(), 1U);
    const VectorXd energy = mechanical_energy(model, model.system->parameter_values(), motion.states);
    EXPECT_NEAR(energy[1] / energy[0], e * e, 1e-9);
    EXPECT_NEAR(energy[0] - energy[1], motion.events[0].energy_loss, 1e-9 * energy[0]);
  }
}

TEST(Contact, RestitutionMayDependOnTheSpeedOfTheImpact) {
  const Trajectory motion = motion_of(ball("\"max(0, 1 - 0.1*abs(dz))\""), {0, 1, 0, 0}, 2.5, 2);
  const std::vector<ContactEvent> impacts = of_kind(motion, Kind::impact);
  ASSERT_GE(impacts.size(), 3U);
  double speed = std::sqrt(2 * g);
  for (const ContactEvent& one : impacts) {
    EXPECT_NEAR(one.approach, speed, 1e-6);
    speed *= 1 - 0.1 * speed;
  }
  try {
    static_cast<void>(motion_of(ball("\"1 - dz\""), {0, 1, 0, 0}, 1, 2));
    FAIL() << "no error";
  } catch (const UnfinishedMotion& error) {
    EXPECT_THAT(error.what(), HasSubstr("the restitution of the contact 'z' must lie between 0 and 1, got 5.4"));
  }
}

// 1.5 would create energy
TEST(Contact, RestitutionOfAProgramIsCheckedToo) {
  const Model model = ball("0.5");
  SimulateOptions options;
  options.times = VectorXd::LinSpaced(2, 0, 1);
  const VectorXd start = VectorXd::Unit(6, 1), parameters = model.system->parameter_values();
  const auto error_with = [&](Contact contact) -> std::string {
    options.contacts = {std::move(contact)};
    try {
      static_cast<void>(simulate(*model.system, parameters, model_acceleration(model), start, options));
      return "";
    } catch (const Error& error) {
      return error.what();
    }
  };
  const char* const told = "must lie between 0 and 1, got ";
  EXPECT_EQ(error_with({.row = 0, .input = 0, .restitution = 1}), "");
  for (const double e : {1.5, -0.2, std::nan("")}) {
    EXPECT_THAT(error_with({.row = 0, .input = 0, .restitution = e}), HasSubstr(fmt::format("{}{}", told, e)));
    EXPECT_THAT(error_with({.row = 0, .input = 0, .restitution_at = [e](const auto&) { return e; }}),
                HasSubstr(fmt::format("{}{}", told, e)));
  }
}

TEST(Contact, WithoutRestitutionIsMadeAtOnce) {
  const Trajectory motion = motion_of(ball("0"), {0, 1, 0, 0}, 1, 11);
  ASSERT_EQ(motion.events.size(), 1U);
  EXPECT_EQ(motion.events[0].kind, Kind::made);
  EXPECT_NEAR(motion.events[0].time, std::sqrt(2 / g), of_event);
  EXPECT_NEAR(motion.events[0].energy_loss, 2 * g, 1e-9);
}

// dt = dθ/√(2g (cos θ₀ − cos θ)), with s² = cos θ₀ − cos θ
double time_to_leave(double start, double end) {
  const double last = std::sqrt(std::cos(start) - std::cos(end));
  const auto f = [&](double s) {
    const double cosine = std::cos(start) - s * s;
    return 1 / std::sqrt(1 - cosine * cosine);
  };
  constexpr int n = 20000;
  double sum = f(0) + f(last);
  for (int k = 1; k < n; ++k) sum += (k % 2 == 1 ? 4 : 2) * f(k * last / n);
  return std::sqrt(2 / g) * sum * last / n / 3;
}

TEST(Contact, OfABeadOnABallIsReleasedAtTwoThirds) {
  const double start = 0.1, cosine = 2 * std::cos(start) / 3;
  const double expected = time_to_leave(start, std::acos(cosine));
  for (const double tolerance : {0.0, 1e-9}) {
    const Trajectory motion = motion_of(bead(), {std::sin(start), std::cos(start), 0, 0}, 1.3 * expected, 201, tolerance);
    ASSERT_EQ(motion.events.size(), 1U);
    EXPECT_EQ(motion.events[0].kind, Kind::released);
    EXPECT_NEAR(motion.events[0].time, expected, of_event);
    expect_constraints(bead(), motion);
    for (Index i = 0; i < motion.times.size(); ++i) {
      const bool is_free = motion.times[i] > motion.events[0].time;
      EXPECT_EQ(motion.states(5, i), is_free ? 0 : 1);
      const double height = motion.states(1, i), gap = std::hypot(motion.states(0, i), height) - 1;
      if (is_free) {
        EXPECT_GT(gap, 0);
        EXPECT_EQ(motion.records(0, i), 0);
        EXPECT_NEAR(motion.accelerations(1, i), -g, 1e-14);
      } else {
        EXPECT_GE(motion.records(0, i), 0);
        EXPECT_NEAR(gap, 0, 1e-15);
        EXPECT_GE(height, cosine - 1e-4);
      }
    }
    const VectorXd energy = mechanical_energy(bead(), VectorXd(0), motion.states);
    EXPECT_LE((energy.array() - energy[0]).abs().maxCoeff(), tolerance > 0 ? 1e-8 : 1e-5);
  }
}

// a plate that is moved up and down lets go where it accelerates downwards by g, and catches again
TEST(Contact, WithAMovedPlateIsReleasedAndMadeAgain) {
  const double size = 0.1, rate = 12;
  const Model model = Model::parse(fmt::format(R"toml(
coordinates = ["z"]
inputs      = ["touch"]
[mechanics]
mass  = [["0.7"]]
force = ["-0.7*9.81"]
[constraints]
position = [{{ expr = "z - {0}*sin({1}*t)", contact = "touch" }}]
)toml",
                                               size, rate),
                                   "plate");
  const Trajectory motion = motion_of(model, {0, size * rate}, 0.6, 61, 1e-10);
  ASSERT_GE(motion.events.size(), 2U);
  EXPECT_EQ(motion.events[0].kind, Kind::released);
  const double t0 = std::asin(g / (size * rate * rate)) / rate;
  EXPECT_NEAR(motion.events[0].time, t0, of_event);
  EXPECT_EQ(motion.events[1].kind, Kind::made);
  // the first zero of the gap of the flight
  const auto gap = [&](double t) {
    return size * std::sin(rate * t0) + size * rate * std::cos(rate * t0) * (t - t0) - g / 2 * (t - t0) * (t - t0) -
           size * std::sin(rate * t);
  };
  double before = t0 + 0.05, after = before;
  while (gap(after) > 0) after += 1e-3;
  for (int k = 0; k < 60; ++k) (gap(std::midpoint(before, after)) > 0 ? before : after) = std::midpoint(before, after);
  EXPECT_NEAR(motion.events[1].time, after, of_event);
}

TEST(Contact, KeepsOtherConstraintsThroughAnImpact) {
  // a bead on a wire z = 2 − x that ends on the floor
  const Model model = Model::parse(R"toml(
coordinates = ["x", "z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["0", "-9.81"]
[constraints]
position = ["z + x - 2", { expr = "z", contact = "touch", restitution = 0.5 }]
)toml",
                                   "wire");
  const Trajectory motion = motion_of(model, {1, 1, 0, 0}, 1, 101);
  ASSERT_FALSE(motion.events.empty());
  // along the wire g/2 of z̈
  const double t = std::sqrt(4 / g);
  EXPECT_NEAR(motion.events[0].time, t, of_event);
  EXPECT_NEAR(motion.events[0].approach, g / 2 * t, 1e-9);
  EXPECT_NEAR(motion.events[0].energy_loss, 0.75 * g, 1e-6);
  EXPECT_LE(motion.max_position_drift, 1e-14);
  EXPECT_LE(motion.max_velocity_drift, 1e-14);
  expect_constraints(model, motion);
}

TEST(Contact, OfTwoBodiesKeepsTheirMomentum) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "y"]
inputs      = ["touch"]
[mechanics]
mass  = [["3", "0"], ["0", "1"]]
[constraints]
position = [{ expr = "y - x - 0.2", contact = "touch", restitution = 1 }]
)toml",
                                   "two bodies");
  const Trajectory motion = motion_of(model, {0, 1.2, 2, 0}, 1, 2);
  ASSERT_EQ(motion.events.size(), 1U);
  EXPECT_NEAR(motion.events[0].time, 0.5, of_event);
  EXPECT_NEAR(motion.states(2, 1), 1, 1e-14);
  EXPECT_NEAR(motion.states(3, 1), 3, 1e-14);
}

TEST(Contact, ThatIsShortIsNotSteppedOver) {
  // a gap that is below 0 for 0.02 s of a step
  const Model model = Model::parse(R"toml(
coordinates = ["z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1"]]
force = ["-z"]
[constraints]
position = [{ expr = "z + 0.99995", contact = "touch", restitution = 1 }]
)toml",
                                   "graze");
  const Trajectory motion = motion_of(model, {1, 0}, 5, 2, 1e-4);
  ASSERT_EQ(motion.events.size(), 1U);
  EXPECT_NEAR(motion.events[0].time, std::acos(-0.99995), 1e-2);
}

// What rests has no error, however long a step is: the forces of time that let it go are looked for all the same.
TEST(Contact, AtRestIsLetGoEachTimeThatItsLoadIsLifted) {
  const Model model = Model::parse(R"toml(
coordinates = ["z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1.3"]]
force = ["-1.3*9.81 + 16*sin(1.7*t)"]
[constraints]
position = [{ expr = "z", contact = "touch" }]
)toml",
                                   "at rest");
  const double first = std::asin(1.3 * g / 16) / 1.7, period = 2 * std::numbers::pi / 1.7;
  const std::vector<ContactEvent> released = of_kind(motion_of(model, {0, 0}, 37, 2), Kind::released);
  ASSERT_EQ(released.size(), 10U);
  for (std::size_t k = 0; k < released.size(); ++k) {
    EXPECT_NEAR(released[k].time, first + static_cast<double>(k) * period, of_event) << k;
  }
}

TEST(Contact, AtRestIsLetGoByAPulseOverAFewRows) {
  const Model model = Model::parse(R"toml(
coordinates = ["z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1"]]
force = ["-9.81 + 60*exp(-((t - 3.7)/0.3)^2)"]
[constraints]
position = [{ expr = "z", contact = "touch" }]
)toml",
                                   "pulse");
  const std::vector<ContactEvent> released = of_kind(motion_of(model, {0, 0}, 10, 101), Kind::released);
  ASSERT_EQ(released.size(), 1U);
  EXPECT_NEAR(released[0].time, 3.7 - 0.3 * std::sqrt(std::log(60 / g)), of_event);
}

TEST(Contact, HoldsForAnHour) {
  // driven to and fro over hills that are too flat to leave
  const Model model = Model::parse(R"toml(
coordinates = ["x", "z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["0.3*sin(0.2*t) - 0.5*dx", "-9.81"]
[constraints]
position = [{ expr = "z - 0.05*sin(x)", contact = "touch", restitution = 0.5 }]
)toml",
                                   "hills");
  const Trajectory motion = motion_of(model, {0, 0, 0, 0}, 3600, 361);
  EXPECT_TRUE(motion.events.empty());
  EXPECT_EQ(motion.states.row(5).minCoeff(), 1);
  EXPECT_GT(motion.records.row(0).minCoeff(), 9);
  EXPECT_LE(motion.max_position_drift, 1e-15);
  EXPECT_LE(motion.max_velocity_drift, 1e-15);
  expect_constraints(model, motion);
}

// ---- friction that reads the load of its contact, against closed forms

/// A body of mass m that a force h drives along a surface and N(t) = w − L sin(Ωt) presses onto it, where
/// m v' = h − s μ N, s = 1 and −1 of slip and 0 of flight. Its phases are integrated by hand.
struct Pressed {
  double m = 1, h = 0, mu = 0, w = 0, L = 0, rate = 1;

  [[nodiscard]] double load(double t) const { return w - L * std::sin(rate * t); }
  // ∫ N dt and ∫∫ N dt² from t0 to t
  [[nodiscard]] double impulse(double t0, double t) const {
    return w * (t - t0) + L / rate * (std::cos(rate * t) - std::cos(rate * t0));
  }
  [[nodiscard]] double twice(double t0, double t) const {
    const double d = t - t0;
    return w * d * d / 2 + L / rate * ((std::sin(rate * t) - std::sin(rate * t0)) / rate - d * std::cos(rate * t0));
  }
  [[nodiscard]] double speed(double v0, double side, double t0, double t) const {
    return v0 + (h * (t - t0) - side * mu * impulse(t0, t)) / m;
  }
  // of a body that is off the surface, whose weight and lift are −N
  [[nodiscard]] double height(double v0, double t0, double t) const { return v0 * (t - t0) - twice(t0, t) / m; }
  [[nodiscard]] double rise(double v0, double t0, double t) const { return v0 - impulse(t0, t) / m; }
};

// the first zero of f after `start`, where f is of one sign just after it
template <typename F>
double first_zero(const F& f, double start, double step = 1e-4) {
  double before = start + step;
  while ((f(before) > 0) == (f(before + step) > 0)) before += step;
  double after = before + step;
  for (int k = 0; k < 60; ++k) {
    const double middle = std::midpoint(before, after);
    ((f(middle) > 0) == (f(before) > 0) ? before : after) = middle;
  }
  return after;
}

void expect_friction(const Trajectory& motion, const std::vector<std::pair<double, bool>>& expected, int surface = 0) {
  std::vector<StickEvent> found;
  std::copy_if(motion.sticks.begin(), motion.sticks.end(), std::back_inserter(found),
               [&](const StickEvent& one) { return one.surface == surface; });
  ASSERT_EQ(found.size(), expected.size());
  for (std::size_t k = 0; k < found.size(); ++k) {
    EXPECT_NEAR(found[k].time, expected[k].first, of_event) << k;
    EXPECT_EQ(found[k].sticks, expected[k].second) << k;
  }
}

// a block on a belt that a spring holds back, under a load that comes and goes
TEST(ContactFriction, OfABlockOnABeltSticksAndSlipsWhenTheClosedFormSays) {
  const double k = 5, mu = 0.5, w = 9.81, L = 4, rate = 2.2, belt = 0.6;
  const Model model = Model::parse(fmt::format(R"toml(
coordinates = ["x", "z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["-{0}*x", "-({1} - {2}*sin({3}*t))"]
[constraints]
position = [{{ expr = "z", contact = "touch", restitution = 0.5 }}]
[truth]
force = ["-{4}*abs(lambda(1))*sign(dx - {5})", "0"]
)toml",
                                               k, w, L, rate, mu, belt),
                                   "belt");
  const double t_end = 40;
  // slip at −1: x'' = −ω²x + μN(t), so x = a cos ωt + b sin ωt + μ (w/k − L sin Ωt/(k − Ω²))
  const double omega = std::sqrt(k);
  std::vector<std::pair<double, bool>> expected;
  double t = 0, x = 0;
  while (true) {
    const double t0 = t, x0 = x;
    const auto excess = [&](double time) { return k * (x0 + belt * (time - t0)) - mu * (w - L * std::sin(rate * time)); };
    ASSERT_LT(excess(t0), 0);
    t = first_zero(excess, t0);
    if (t > t_end) break;
    expected.emplace_back(t, false);
    x = x0 + belt * (t - t0);
    const auto forced = [&](double time) { return mu * (w / k - L * std::sin(rate * time) / (k - rate * rate)); };
    const auto forced_rate = [&](double time) { return -mu * L * rate * std::cos(rate * time) / (k - rate * rate); };
    const double t1 = t, a = x - forced(t1), b = (belt - forced_rate(t1)) / omega;
    const auto slip = [&](double time) {
      return omega * (b * std::cos(omega * (time - t1)) - a * std::sin(omega * (time - t1))) + forced_rate(time) - belt;
    };
    t = first_zero(slip, t1);
    if (t > t_end) break;
    expected.emplace_back(t, true);
    x = a * std::cos(omega * (t - t1)) + b * std::sin(omega * (t - t1)) + forced(t);
  }
  ASSERT_GT(expected.size(), 12U);
  const Trajectory motion = motion_of(model, {0, 0, belt, 0}, t_end, 401, 1e-10);
  expect_friction(motion, expected);
  EXPECT_TRUE(motion.events.empty());
  expect_constraints(model, motion);
}

// a block that a force presses onto the slope it slides down: it stops, and goes on when the force has gone
TEST(ContactFriction, HoldsABlockOnASlopeWhileItIsPressed) {
  const double angle = 0.5, mu = 0.3, press = 3, span = 6;
  const Model model = Model::parse(fmt::format(R"toml(
coordinates = ["x", "z"]
inputs      = ["touch"]
[parameters]
a = {0}
[mechanics]
mass  = [["2", "0"], ["0", "2"]]
force = ["-sin(a)*{1}*t*({2} - t)", "-2*9.81 - cos(a)*{1}*t*({2} - t)"]
[constraints]
position = [{{ expr = "cos(a)*z + sin(a)*x", contact = "touch" }}]
[truth]
force = ["-{3}*lambda(1)*cos(a)*sign(lambda(1)*(dx*cos(a) - dz*sin(a)))",
         "{3}*lambda(1)*sin(a)*sign(lambda(1)*(dx*cos(a) - dz*sin(a)))"]
)toml",
                                               angle, press, span, mu),
                                   "slope");
  const double drive = g * (std::sin(angle) - mu * std::cos(angle)), c = mu * press / 2;
  // v = drive t − c (span t²/2 − t³/3), c(span t − t²) = drive at the end of rest
  const double stops = first_zero([&](double t) { return drive - c * (span * t / 2 - t * t / 3); }, 0);
  const double root = std::sqrt(span * span / 4 - drive / c), goes = span / 2 + root;
  ASSERT_GT(stops, span / 2 - root);
  ASSERT_LT(stops, goes);
  const Trajectory motion = motion_of(model, {0, 0, 0, 0}, span, 61);
  expect_friction(motion, {{stops, true}, {goes, false}});
  const double way = drive * stops * stops / 2 - c * (span * std::pow(stops, 3) / 6 - std::pow(stops, 4) / 12);
  for (Index i = 0; i < motion.times.size(); ++i) {
    if (motion.times[i] < stops || motion.times[i] > goes) continue;
    EXPECT_NEAR(std::hypot(motion.states(0, i), motion.states(1, i)), way, 1e-6);
    EXPECT_NEAR(motion.states.col(i).segment(2, 2).norm(), 0, 1e-12);
    EXPECT_NEAR(motion.records(0, i), 2 * g * std::cos(angle) + press * motion.times[i] * (span - motion.times[i]), 1e-11);
  }
  expect_constraints(model, motion);
}

// On a slope friction along the floor plan presses as well: the more it pushes up the slope, the less the block weighs on it. At rest
// the load is the weight, and friction all that a growing force is not borne by.
TEST(ContactFriction, InAPlaneKnowsTheLoadThatItChangesItself) {
  const double slope = 0.4, mu = 0.7;
  for (const double direction : {0.0, 1.0, 2.5, -2.0}) {
    SCOPED_TRACE(direction);
    const auto model_of = [&](double smoothing) {
      return Model::parse(fmt::format(R"toml(
coordinates = ["x", "y", "z"]
[let]
v = "sqrt(dx^2 + dy^2 + {4})"
[mechanics]
mass  = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]]
force = ["{0}*t", "{1}*t", "-9.81"]
[constraints]
position = ["z - {2}*x"]
[truth]
force = ["-{3}*abs(lambda(1))*dx/v", "-{3}*abs(lambda(1))*dy/v", "0"]
)toml",
                                      std::cos(direction), std::sin(direction), slope, mu, smoothing),
                          "slope");
    };
    const Model model = model_of(0);
    const double goes = first_zero(
        [&](double t) { return mu * g - std::hypot(slope * g - t * std::cos(direction), t * std::sin(direction)); }, 0);
    const Trajectory motion = motion_of(model, {0, 0, 0, 0, 0, 0}, goes + 1, 41);
    expect_friction(motion, {{goes, false}});
    for (Index i = 0; i < motion.times.size(); ++i) {
      if (motion.times[i] > goes) continue;
      EXPECT_LT(motion.states.col(i).head(6).norm(), 1e-9);
      EXPECT_NEAR(motion.records(0, i), g, 1e-8);
    }
    const Trajectory nearly = motion_of(model_of(1e-6), {0, 0, 0, 0, 0, 0}, goes + 1, 41);
    EXPECT_LT((motion.states - nearly.states).cwiseAbs().maxCoeff(), 0.02);
    expect_constraints(model, motion);
  }
}

// thrown onto a table: falls, bounces at half the speed each time, rubs in each impact, slides on along its way and rests when the
// weight has taken its momentum, bounces or none
TEST(ContactFriction, BringsAPuckToRestThatIsThrownOntoATable) {
  const double mu = 0.4, e = 0.5, height = 0.5, vx = 5, vy = 3.5;
  const Model model = Model::parse(fmt::format(R"toml(
coordinates = ["x", "y", "z"]
inputs      = ["touch"]
[let]
v = "sqrt(dx^2 + dy^2)"
[mechanics]
mass  = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]]
force = ["0", "0", "-9.81"]
[constraints]
position = [{{ expr = "z", contact = "touch", restitution = {1} }}]
[truth]
force = ["-{0}*lambda(1)*dx/v", "-{0}*lambda(1)*dy/v", "0"]
)toml",
                                               mu, e),
                                   "puck");
  const Trajectory motion = motion_of(model, {0, 0, height, vx, vy, 0}, 4, 41);
  const double fall = std::sqrt(2 * height / g), bounces = fall * (1 + 2 * e / (1 - e)), v = std::hypot(vx, vy);
  double way = v * fall, speed = v;
  for (double w = g * fall; w > 1e-12; w *= e) {
    speed -= mu * (1 + e) * w;
    way += speed * 2 * e * w / g;
  }
  EXPECT_NEAR(speed, v - mu * g * bounces, 1e-11);
  way += speed * speed / (2 * mu * g);
  expect_friction(motion, {{v / (mu * g), true}});
  EXPECT_NEAR(motion.states(0, 40), way * vx / v, 1e-6);
  EXPECT_NEAR(motion.states(1, 40), way * vy / v, 1e-6);
  EXPECT_LT(motion.states.col(40).segment(3, 3).norm(), 1e-12);
  expect_constraints(model, motion);
}

// a bead on a wire moves along it alone, whatever the number of coordinates that its velocity is written in
TEST(ContactFriction, OverTheLengthOfAVelocityIsThatOfItsSignOnAWire) {
  const auto bead = [](const std::string& direction_x, const std::string& direction_z) {
    return Model::parse(fmt::format(R"toml(
coordinates = ["x", "y", "z"]
[mechanics]
mass  = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]]
force = ["4*sin(t)", "0", "-9.81"]
[constraints]
position = ["z - x^2/2", "y - x/2"]
[truth]
force = ["-0.3*sqrt(1.25 + x^2)*lambda(1)*{0}", "-0.3*sqrt(1.25 + x^2)*lambda(1)*{0}/2", "-0.3*sqrt(1.25 + x^2)*lambda(1)*{1}"]
)toml",
                                    direction_x, direction_z),
                        "bead");
  };
  const std::string length = "sqrt(dx^2 + dy^2 + dz^2)";
  const Trajectory of_sign =
      motion_of(bead("sign(dx)/sqrt(1.25 + x^2)", "x*sign(dx)/sqrt(1.25 + x^2)"), {1, 0.5, 0.5, 0, 0, 0}, 12, 121, 1e-9);
  const Trajectory of_length = motion_of(bead("dx/" + length, "dz/" + length), {1, 0.5, 0.5, 0, 0, 0}, 12, 121, 1e-9);
  EXPECT_LT((of_sign.states - of_length.states).cwiseAbs().maxCoeff(), 1e-6);
  ASSERT_EQ(of_sign.sticks.size(), of_length.sticks.size());
  EXPECT_GE(of_sign.sticks.size(), 4);
  for (std::size_t k = 0; k < of_sign.sticks.size(); ++k) EXPECT_NEAR(of_sign.sticks[k].time, of_length.sticks[k].time, 1e-6);
}

// rides on a belt, slips as its load falls, is lifted off, lands, bounces, slips and rides again
TEST(ContactFriction, OfABlockThatIsLiftedOffAndLandsAgain) {
  const Pressed body = {.m = 1.3, .h = 1.5, .mu = 0.6, .w = 1.3 * g, .L = 16, .rate = 1.7};
  const double belt = 0.4, e = 0.3;
  const Model model = Model::parse(fmt::format(R"toml(
coordinates = ["x", "z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1.3", "0"], ["0", "1.3"]]
force = ["{0}", "-1.3*9.81 + {1}*sin({2}*t)"]
[constraints]
position = [{{ expr = "z", contact = "touch", restitution = {3} }}]
[truth]
force = ["-{4}*abs(lambda(1))*sign(dx - {5})", "0"]
)toml",
                                               body.h, body.L, body.rate, e, body.mu, belt),
                                   "lifted");
  const double slips = first_zero([&](double t) { return body.mu * body.load(t) - body.h; }, 0);
  const double leaves = first_zero([&](double t) { return body.load(t); }, 0);
  double vx = body.speed(belt, 1, slips, leaves);
  std::vector<double> impacts;
  double t = leaves, rise = 0;
  while (true) {
    const double t0 = t, v0 = rise;
    const double lands = first_zero([&](double time) { return body.height(v0, t0, time); }, t0, v0 > 0 ? v0 / 100 : 1e-4);
    vx = body.speed(vx, 0, t0, lands);
    const double approach = -body.rise(v0, t0, lands), slip = vx - belt;
    vx -= std::copysign(std::min(body.mu * (1 + e) * approach, std::abs(slip)), slip);
    rise = e * approach;
    impacts.push_back(t = lands);
    if (rise < 1e-4) break;  // what is left of the bounces is over within 10⁻⁴ s
  }
  ASSERT_GT(impacts.size(), 3U);
  EXPECT_EQ(vx, belt);  // the last impacts stop what it gains in flight
  const double rides = t;
  const double t_end = 2 * std::numbers::pi / body.rate + slips - 0.05;
  ASSERT_LT(rides, t_end);
  const Trajectory motion = motion_of(model, {0, 0, belt, 0}, t_end, 201, 1e-10);
  const std::vector<ContactEvent> found = of_kind(motion, Kind::impact);
  ASSERT_GE(found.size(), impacts.size());
  for (std::size_t k = 0; k < impacts.size(); ++k) EXPECT_NEAR(found[k].time, impacts[k], of_event);
  ASSERT_EQ(of_kind(motion, Kind::released).size(), 1U);
  EXPECT_NEAR(of_kind(motion, Kind::released)[0].time, leaves, of_event);
  ASSERT_EQ(of_kind(motion, Kind::made).size(), 1U);
  ASSERT_EQ(motion.sticks.size(), 2U);
  EXPECT_NEAR(motion.sticks[0].time, slips, of_event);
  EXPECT_FALSE(motion.sticks[0].sticks);
  EXPECT_NEAR(motion.sticks[1].time, rides, 1e-4);  // the last bounces are not in the closed form
  EXPECT_TRUE(motion.sticks[1].sticks);
  expect_constraints(model, motion);
}

// What rests has no error, however long a step is: the forces of time that let it go are looked for all the same.
TEST(ContactFriction, AtRestIsLetGoEachTimeThatItsLoadIsLifted) {
  const std::string text = R"toml(
coordinates = ["x", "z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1.3", "0"], ["0", "1.3"]]
force = ["0", "-1.3*9.81 + 16*sin(1.7*t)"]
[constraints]
position = [{ expr = "z", contact = "touch" }]
[truth]
force = ["-0.6*abs(lambda(1))*sign(dx)", "0"]
)toml";
  const double first = std::asin(1.3 * g / 16) / 1.7, period = 2 * std::numbers::pi / 1.7;
  const Trajectory motion = motion_of(Model::parse(text, "at rest"), {0, 0, 0, 0}, 37, 2);
  const std::vector<ContactEvent> released = of_kind(motion, Kind::released);
  ASSERT_EQ(released.size(), 10U);
  for (std::size_t k = 0; k < released.size(); ++k) {
    EXPECT_NEAR(released[k].time, first + static_cast<double>(k) * period, of_event) << k;
  }
  // and a body on rough ground under a force that comes and goes
  std::string pushed = text;
  pushed.replace(pushed.find("\"0\", \"-1.3*9.81 + 16*sin(1.7*t)\""), 32, "\"8*sin(1.7*t)\", \"-1.3*9.81\"");
  const Trajectory pulled = motion_of(Model::parse(pushed, "pushed"), {0, 0, 0, 0}, 37, 2);
  ASSERT_GE(pulled.sticks.size(), 38U);  // twice in each of ten periods, but for the last
  const double limit = std::asin(0.6 * 1.3 * g / 8) / 1.7;
  for (std::size_t k = 0; k < pulled.sticks.size(); k += 2) {
    EXPECT_FALSE(pulled.sticks[k].sticks);
    EXPECT_NEAR(pulled.sticks[k].time, limit + static_cast<double>(k) / 4 * period, of_event) << k;
  }
}

// A holds B up against its side, as a hand holds a book against a shelf; each friction changes the load of the other.
Model book(const std::string& press) {
  return Model::parse(fmt::format(R"toml(
coordinates = ["xA", "zA", "xB", "zB"]
[mechanics]
mass  = [["3", "0", "0", "0"], ["0", "3", "0", "0"], ["0", "0", "1", "0"], ["0", "0", "0", "1"]]
force = ["0", "-3*9.81", "-({})", "-9.81"]
[constraints]
position = ["zA", "xB - xA - 0.1"]
[truth]
force = ["-0.5*abs(lambda(1))*sign(dxA)", "0.7*abs(lambda(2))*sign(dzB - dzA)",
         "0", "-0.7*abs(lambda(2))*sign(dzB - dzA)"]
)toml",
                                  press),
                      "book");
}

TEST(ContactFriction, OfTwoContactsHoldsToTheLimitOfEach) {
  // both at rest: N₁ = (3 + 1) g, N₂ = P; A goes at P = μ₁N₁, B falls at μ₂P = g
  const auto surface_of = [](const Model& model, const std::string& name) {
    const std::vector<std::string> names = switching_functions(model, false).names();
    return static_cast<int>(std::find(names.begin(), names.end(), name) - names.begin());
  };
  const Model grows = book("16 + t"), falls = book("16 - t");
  const VectorXd start = (VectorXd(8) << 0, 0, 0.1, 0, 0, 0, 0, 0).finished();
  const std::vector<double> at(start.begin(), start.end());
  const Trajectory pushed = motion_of(grows, at, 8, 81, 1e-10), dropped = motion_of(falls, at, 4, 41, 1e-10);
  ASSERT_EQ(pushed.sticks.size(), 1U);
  EXPECT_EQ(pushed.sticks[0].surface, surface_of(grows, "dxA"));
  EXPECT_NEAR(pushed.sticks[0].time, 0.5 * 4 * g - 16, of_event);
  ASSERT_EQ(dropped.sticks.size(), 1U);
  EXPECT_EQ(dropped.sticks[0].surface, surface_of(falls, "dzB - dzA"));
  EXPECT_NEAR(dropped.sticks[0].time, 16 - g / 0.7, of_event);
  // then (3 + 1) ẍ = −P + μ₁N₁ while B rides along, and z̈_B = −g + μ₂P while A rests
  const double t0 = 0.5 * 4 * g - 16, t1 = 16 - g / 0.7;
  EXPECT_NEAR(pushed.states(0, 80), -std::pow(8 - t0, 3) / 24, 1e-7);
  EXPECT_NEAR(dropped.states(3, 40), -0.7 * std::pow(4 - t1, 3) / 6, 1e-7);
  // the loads of rest
  for (Index i = 0; pushed.times[i] < t0; ++i) {
    EXPECT_NEAR(pushed.records(0, i), 4 * g, 1e-11);
    EXPECT_NEAR(pushed.records(1, i), 16 + pushed.times[i], 1e-11);
  }
}

// on two feet, or on the left one alone
Model box(double mu, bool has_right_foot, double w = 0.3, double h = 0.2) {
  return Model::parse(fmt::format(R"toml(
coordinates = ["x", "z", "a"]
inputs      = ["l", "r"]
[parameters]
w = {3}
h = {4}
[mechanics]
mass      = [["2", "0", "0"], ["0", "2", "0"], ["0", "0", "0.05"]]
force     = ["0", "-2*9.81", "0"]
potential = "2*9.81*z"
[constraints]
position = [{{ expr = "z - h*cos(a) - w*sin(a)", contact = "l", name = "L" }}{0}]
[let]
vl = "dx + h*cos(a)*da - w*sin(a)*da"
vr = "dx + h*cos(a)*da + w*sin(a)*da"
fl = "-{2}*abs(lambda(L))*sign(vl)"
fr = "{1}"
[truth]
force = ["fl + fr", "0", "(h*cos(a) - w*sin(a))*fl + (h*cos(a) + w*sin(a))*fr"]
)toml",
                                  has_right_foot ? R"x(, { expr = "z - h*cos(a) + w*sin(a)", contact = "r", name = "R" })x" : "",
                                  has_right_foot ? fmt::format("-{}*abs(lambda(R))*sign(vr)", mu) : "0", mu, w, h),
                      "box");
}

// Flat on the floor both feet slide at one velocity: two surfaces that are one.
TEST(ContactFriction, OfTwoFeetBringsABoxToRest) {
  const Model model = box(0.1, true);
  for (const double v : {-0.8, -0.7, -0.6, 0.5}) {
    const Trajectory motion = motion_of(model, {0, 0.2, 0, v, 0, 0}, 5, 6, 1e-10);
    ASSERT_EQ(motion.states.cols(), 6);
    EXPECT_NEAR(motion.states(0, 5), v * std::abs(v) / (2 * 0.1 * g), 1e-7) << v;
  }
}

// Both feet stick and stay, whichever of them rounding brings to rest first.
TEST(ContactFriction, OfTwoFeetHoldsABoxAtRest) {
  for (const double mu : {0.3, 0.4, 0.6}) {
    const Trajectory motion = motion_of(box(mu, true), {0, 0.2, 0, 1.5, 0, 0}, 5, 101);
    ASSERT_EQ(motion.states.cols(), 101) << mu;
    EXPECT_NEAR(motion.states(0, 100), 1.5 * 1.5 / (2 * mu * g), 1e-7) << mu;
    EXPECT_NEAR(motion.accelerations(0, 100), 0, 1e-9) << mu;
    ASSERT_EQ(motion.sticks.size(), 2U) << mu << ", once each foot";
    for (const StickEvent& stick : motion.sticks) EXPECT_TRUE(stick.sticks) << mu;
    EXPECT_LT(motion.steps, 100) << mu;
  }
}

TEST(ContactFriction, OfABoxThatFallsOnItsFeetTakesEnergy) {
  const auto energy = [](const auto& s) { return 2 * g * s[1] + s[3] * s[3] + s[4] * s[4] + 0.025 * s[5] * s[5]; };
  for (const double mu : {0.1, 0.4}) {
    const Model model = box(mu, true);
    for (const double tilt : {-0.3, -0.1, 0.05, 0.3, 0.5}) {
      for (const double v : {-1.0, 0.0, 0.5}) {
        const Trajectory motion = motion_of(model, {0, 0.6, tilt, v, 0, 0}, 1, 11);
        ASSERT_EQ(motion.states.cols(), 11) << mu << ' ' << tilt << ' ' << v;
        for (Index i = 1; i < 11; ++i) EXPECT_LE(energy(motion.states.col(i)), energy(motion.states.col(i - 1)) + 1e-6);
      }
    }
  }
}

// It rocks from foot to foot ever faster, infinitely often. Each impact keeps its moment of momentum about the foot that is hit.
TEST(ContactFriction, OfABoxThatRocksEndsInRest) {
  const Model model = box(0.6, true, 0.2, 0.3);
  for (const double tilt : {-0.2, 0.1, 0.3}) {
    const double height = 0.3 * std::cos(tilt) + 0.2 * std::sin(std::abs(tilt));
    const Trajectory motion = motion_of(model, {0, height, tilt, 0, 0, 0}, 2, 21);
    ASSERT_EQ(motion.states.cols(), 21) << tilt;
    EXPECT_LT(motion.states.col(20).segment(3, 3).norm(), 1e-12) << tilt;
    EXPECT_EQ(motion.states.col(20).tail(2), Eigen::Vector2d(1, 1)) << tilt;
    EXPECT_LT(motion.steps + motion.rejected_steps, 1000) << tilt;
    std::vector<double> approaches;
    for (const ContactEvent& event : motion.events) {
      if (event.kind == ContactEvent::Kind::made && event.approach > 1e-3) approaches.push_back(event.approach);
    }
    ASSERT_GT(approaches.size(), 5U) << tilt;
    for (std::size_t k = 1; k < approaches.size(); ++k) EXPECT_NEAR(approaches[k] / approaches[k - 1], 0.15 / 0.31, 1e-3) << tilt;
  }
}

// the foot that has just come to rest neither opens nor closes by rounding
TEST(ContactFriction, OfOneFootIsHitOnce) {
  for (const double mu : {0.1, 0.2, 0.4}) {
    const Model model = box(mu, false);
    for (const double tilt : {-0.1, 0.1, 0.2}) {
      for (const double height : {0.6, 0.7}) {
        const Trajectory motion = motion_of(model, {0, height, tilt, 0, 0, 0}, 0.4, 5);
        ASSERT_EQ(motion.states.cols(), 5) << mu << ' ' << tilt << ' ' << height;
        EXPECT_LT(motion.events.size(), 6U);
      }
    }
  }
}

// a ball hits a block that its friction holds
TEST(ContactFriction, LetsABlockGoThatIsHit) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "z", "y"]
inputs      = ["touch"]
[mechanics]
mass  = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]]
force = ["0", "-9.81", "0"]
[constraints]
position = ["z", { expr = "x - y", contact = "touch", restitution = 1 }]
[truth]
force = ["-0.4*abs(lambda(1))*sign(dx)", "0", "0"]
)toml",
                                   "struck");
  for (const double way : {1.0, -1.0}) {
    std::string text = model.text;
    if (way < 0) text.replace(text.find("x - y"), 5, "y - x");
    const Model one = Model::parse(text, "struck");
    const double v = 2 * way;
    const Trajectory motion = motion_of(one, {0, 0, -v / 2, 0, 0, v}, 2, 201);
    ASSERT_EQ(motion.events.size(), 1U);
    EXPECT_NEAR(motion.events[0].time, 0.5, of_event);
    expect_friction(motion, {{0.5, false}, {0.5 + 2 / (0.4 * g), true}});
    EXPECT_NEAR(motion.states(0, 200), way * 2 / (0.4 * g), 1e-7);
    EXPECT_NEAR(motion.states(5, 200), 0, 1e-14);
  }
}

// hundreds of bounces, slips and rides
TEST(ContactFriction, KeepsItsConstraintsForTenMinutes) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["-3*x", "-9.81 + 12*sin(1.7*t)"]
[constraints]
position = [{ expr = "z", contact = "touch", restitution = 0.3 }]
[truth]
force = ["-0.4*abs(lambda(1))*sign(dx - 0.3)", "0"]
)toml",
                                   "long");
  const Trajectory motion = motion_of(model, {0, 0, 0.3, 0}, 600, 1201);
  const auto periods = static_cast<std::size_t>(600 * 1.7 / (2 * std::numbers::pi));
  EXPECT_NEAR(static_cast<double>(of_kind(motion, Kind::made).size()), static_cast<double>(periods), 1);
  EXPECT_NEAR(static_cast<double>(of_kind(motion, Kind::released).size()), static_cast<double>(periods), 1);
  EXPECT_GT(of_kind(motion, Kind::impact).size(), 3 * periods);
  EXPECT_GE(motion.sticks.size(), periods);
  EXPECT_GE(motion.states.row(1).minCoeff(), -1e-15);
  EXPECT_GE(motion.records.row(0).minCoeff(), 0);
  expect_constraints(model, motion);
}

TEST(Contact, IsCheckedAgainstALog) {
  const double start = 0.1;
  const Trajectory log = motion_of(bead(), {std::sin(start), std::cos(start), 0, 0}, 1.1, 56);
  const auto findings_of = [&](const Model& model, const MatrixXd& states) {
    const VectorXd parameters = model.system->parameter_values();
    std::vector<Finding> all = check_system(*model.system, states, parameters);
    const MatrixXd stddev = MatrixXd::Constant(2, states.cols(), 0.01);
    const std::vector<Finding> of_data = check_data(*model.system, states, parameters, log.accelerations, stddev);
    all.insert(all.end(), of_data.begin(), of_data.end());
    return all;
  };
  const auto warned = [](const std::vector<Finding>& findings, const std::string& text) {
    for (const Finding& one : findings) {
      if (one.text.find(text) != std::string::npos) return one.level == Finding::Level::warning ? "warning" : "good";
    }
    return "none";
  };
  const auto n_closed = static_cast<int>(log.states.row(5).sum());
  ASSERT_GT(n_closed, 40);
  ASSERT_LT(n_closed, 56);
  const std::vector<Finding> right = findings_of(bead(), log.states);
  EXPECT_STREQ(warned(right, fmt::format("active, touch > 0.5, at {} of 56 states", n_closed)), "good");
  EXPECT_STREQ(warned(right, fmt::format("it pulls at 0 of {} states where it is closed", n_closed)), "good");
  EXPECT_STREQ(warned(right, "independent at every state where they are active"), "good");
  EXPECT_STREQ(warned(right, "the rank of A changes"), "none");
  EXPECT_STREQ(warned(right, "dependent columns"), "none");
  std::string text = bead().text;
  text.replace(text.find("sqrt(x^2 + z^2) - 1"), 19, "1 - sqrt(x^2 + z^2)");
  EXPECT_STREQ(warned(findings_of(Model::parse(text, "inside"), log.states), "a gap is not negative: change its sign"),
               "warning");
  MatrixXd apart = log.states;
  apart.row(5).setZero();
  EXPECT_STREQ(warned(findings_of(bead(), apart), "at 0 of 56 states: these states say nothing of it"), "warning");
}

TEST(Contact, ThatTheStartIsBeyondIsRefused) {
  EXPECT_THAT(test::input_error_of([&] {
                static_cast<void>(motion_of(ball("0.5"), {0, -0.1, 0, 0}, 1, 2));
              }),
              HasSubstr("the start is beyond the contact 'z', whose gap is -0.1"));
}

TEST(Contact, OfAnotherFormIsRefused) {
  const auto message = [](const std::string& entry, const std::string& level = "position",
                          const std::string& inputs = "\"touch\"") {
    return test::input_error_of([&] {
      static_cast<void>(Model::parse(fmt::format("coordinates = [\"z\"]\ninputs = [{}]\n[mechanics]\nmass = [[1]]\n"
                                                 "[constraints]\n{} = [{}]\n",
                                                 inputs, level, entry),
                                     "it.toml"));
    });
  };
  EXPECT_THAT(message(R"({ expr = "z", contact = "feel" })"), HasSubstr("it.toml:6: constraints.position entry 1.contact"));
  EXPECT_THAT(message(R"({ expr = "z", contact = "feel" })"), HasSubstr("'feel' is no input of this model: declare inputs"));
  EXPECT_THAT(message(R"({ expr = "dz", contact = "touch" })", "velocity"), HasSubstr("a contact is a gap, of position level"));
  EXPECT_THAT(message(R"({ expr = "z", contact = "touch", when = "z < 0" })"), HasSubstr("remove when"));
  EXPECT_THAT(message(R"({ expr = "z", restitution = 1 })"), HasSubstr("belongs to a contact: name its input"));
  EXPECT_THAT(message(R"({ expr = "z", contact = "touch", restitution = 1.1 })"), HasSubstr("must lie between 0 and 1, got 1.1"));
  EXPECT_THAT(message(R"({ expr = "z", contact = "touch", restitution = "touch" })"),
              HasSubstr("a restitution may not depend on inputs or accelerations"));
  EXPECT_THAT(message(R"({ expr = "z", contact = "touch" }, { expr = "2 - z", contact = "touch" })"),
              HasSubstr("is another contact's input"));
  EXPECT_THAT(message(R"({ expr = "z", contact = "touch" })", "position", R"({ name = "touch", delay = 0.1 })"),
              HasSubstr("neither a delay nor a lag"));
  EXPECT_THAT(message(R"({ expr = "z", contact = "touch" })", "position",
                      R"({ name = "touch", lag = { value = 0, bounds = [0, 0.1], estimate = true } })"),
              HasSubstr("neither a delay nor a lag"));
}

// ---- constraints that come and go without being contacts

TEST(Condition, IsOneComparison) {
  ExpressionGraph graph;
  const auto read = [&](const std::string& text) {
    return parse_condition(text, graph, [&](std::string_view name) { return std::optional(graph.variable(name)); }, {});
  };
  const auto value = [&](const std::string& text, double a) {
    const std::vector<Expression> inputs = {graph.variable("a")}, outputs = {read(text)};
    MatrixXd out;
    Tape(outputs, inputs).evaluate(VectorXd::Constant(1, a), VectorXd(0), out);
    return out(0, 0);
  };
  for (const double a : {-1.0, 0.0, -0.0, 1e-300, 2.0}) {
    EXPECT_EQ(value("a <= 0", a), a <= 0 ? 1 : 0);
    EXPECT_EQ(value("a < 0", a), a < 0 ? 1 : 0);
    EXPECT_EQ(value("0 <= a", a), a >= 0 ? 1 : 0);
    EXPECT_EQ(value("a > 0", a), a > 0 ? 1 : 0);
  }
  EXPECT_TRUE(std::isnan(value("a <= 0", std::nan(""))));
  EXPECT_TRUE(std::isnan(value("a > 0", std::nan(""))));
  EXPECT_TRUE(graph.differentiate(read("a^2 <= 3"), graph.variable("a")).is_constant(0));
  const auto message = [&](const std::string& text) { return test::input_error_of([&] { static_cast<void>(read(text)); }); };
  EXPECT_THAT(message(""), HasSubstr("the condition is empty; write a comparison such as gap <= 0"));
  EXPECT_THAT(message("a"), HasSubstr("found the end of the text where one of < <= > >= must stand"));
  EXPECT_THAT(message("a == 1"), HasSubstr("found '=' where one of < <= > >= must stand"));
  EXPECT_THAT(message("0 < a < 1"), HasSubstr("a condition is one comparison: combine several by min and max"));
}

TEST(Condition, OfAConstraintIsRefusedWhereItCannotBe) {
  const auto message = [](const std::string& when) {
    return test::input_error_of([&] {
      static_cast<void>(
          Model::parse("coordinates = [\"z\"]\n[mechanics]\nmass = [[1]]\n[constraints]\n"
                       "position = [{ expr = \"z\", when = " +
                           when + " }]\n",
                       "it.toml"));
    });
  };
  EXPECT_THAT(message("\"ddz < 0\""), HasSubstr("a condition may not depend on accelerations"));
  EXPECT_THAT(message("\"lambda0(1) < 0\""), HasSubstr("lambda0(1) follows from M, F and the constraints"));
  EXPECT_THAT(message("\"1 < 0\""), HasSubstr("never holds: remove the constraint"));
  EXPECT_THAT(message("3"), HasSubstr("expected a text in quotes, got 3"));
  EXPECT_THAT(message("\"z\""), HasSubstr("it.toml:5: constraints.position entry 1.when: \"z\", column 2"));
}

}  // namespace
}  // namespace gp2
