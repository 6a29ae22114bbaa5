#include "jobs/rate_check.hpp"

#include <cmath>
#include <functional>
#include <numbers>
#include <random>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "base/not_a_number.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "input_error.hpp"
#include "jobs/data_of_model.hpp"
#include "jobs/reading_notes.hpp"

namespace gp2 {

namespace {

using Eigen::Index;
using Eigen::RowVectorXd;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Not;

// Two seconds' and five seconds' swings, and what logs make of them.
struct Swing {
  double dt = 0.01;
  Index n = 3000;
  double noise = 0;  // of value and rate
  double late = 0;   // the rate [s]
  double factor = 1;
  unsigned seed = 1;
  double outliers = 0;  // of value, at three rows
  double offset = 0;    // of the rate

  [[nodiscard]] std::string text(bool wraps = false) const {
    std::mt19937 random(seed);
    std::normal_distribution<double> normal(0, noise);
    const double fast = std::numbers::pi, slow = 0.4 * std::numbers::pi;
    RowVectorXd t(n), value(n);
    std::vector<RowVectorXd> rates(2, RowVectorXd(n));
    for (Index i = 0; i < n; ++i) {
      const double now = t[i] = dt * static_cast<double>(i), then = now - late;
      value[i] = std::sin(fast * now) + std::cos(slow * now) + (wraps ? now : 0) + normal(random);
      rates[0][i] = std::cos(now * now / 9);
      rates[1][i] =
          factor * (fast * std::cos(fast * then) - slow * std::sin(slow * then) + (wraps ? 1 : 0)) + normal(random) + offset;
      if (i % 1'000 == 500) value[i] += outliers;
      if (wraps) value[i] = std::remainder(value[i], 2 * std::numbers::pi);
    }
    const std::vector<std::string> names = {"dx", "dy"};
    return better_rate({t, "y", value, wraps, rates, names, 1});
  }
};

TEST(RateCheck, SoundColumnsPass) {
  for (const double dt : {0.001, 0.01, 0.1}) {
    for (const double noise : {0.0, 0.01, 0.1}) {
      for (unsigned seed = 1; seed <= 10; ++seed) {
        EXPECT_THAT((Swing{.dt = dt, .noise = noise, .seed = seed}.text()), IsEmpty()) << dt << ' ' << noise << ' ' << seed;
      }
    }
  }
  EXPECT_THAT((Swing{.noise = 0.01}.text(true)), IsEmpty());
  EXPECT_THAT((Swing{.dt = 0.5}.text()), IsEmpty()) << "four rows a period tell nothing";
}

// What is said of 40 rows of a swing whose rate has errors that go together.
std::string text_of_few_rows(double error_size, unsigned seed) {
  std::mt19937 random(seed);
  std::normal_distribution<double> normal(0, error_size);
  const RowVectorXd t = RowVectorXd::LinSpaced(40, 0, 0.02 * 39);
  RowVectorXd rate = (4 * t.array()).cos();
  double error = 0;
  for (double& one : rate) {
    error = 0.9 * error + normal(random);
    one += error;
  }
  const std::vector<std::string> names = {"dx"};
  return better_rate({t, "x", (4 * t.array()).sin() / 4, false, {rate}, names, 0});
}

TEST(RateCheck, ErrorsThatGoTogetherInFewRowsAreNoFactorAndNoLag) {
  for (unsigned seed = 1; seed <= 400; ++seed) {
    EXPECT_THAT(text_of_few_rows(0.05, seed), IsEmpty()) << seed;
    EXPECT_THAT(text_of_few_rows(0.15, seed), Not(HasSubstr("the column l"))) << "errors as large as the rate, " << seed;
  }
}

TEST(RateCheck, ALagIsNamedHoweverFineTheLog) {
  for (const double late : {0.08, -0.08, 0.2, -0.2}) {
    for (const double dt : {0.001, 0.01, 0.04}) {
      for (const double noise : {0.0, 0.01}) {
        const std::string text = Swing{.dt = dt, .noise = noise, .late = late}.text();
        EXPECT_THAT(text, HasSubstr(late > 0 ? "the column lags by" : "the column leads by"))
            << dt << ' ' << noise << ' ' << late;
        const double found = std::stod(text.substr(text.find("by") + 2));
        EXPECT_NEAR(found, std::abs(late), 0.3 * std::abs(late)) << dt << ' ' << noise << ' ' << text;
      }
    }
  }
  EXPECT_THAT((Swing{.late = 0.005}.text()), IsEmpty()) << "half a row of a fine log changes nothing";
}

TEST(RateCheck, AFactorIsNamedUnderNoiseThatHidesSingleRows) {
  EXPECT_THAT((Swing{.dt = 0.001, .noise = 0.01, .factor = -1}.text()), testing::EndsWith(": a wrong sign"));
  const Swing degrees{.dt = 0.001, .noise = 0.01, .factor = 180 / std::numbers::pi};
  EXPECT_THAT(degrees.text(true),
              testing::AllOf(HasSubstr("the rate is 0.017"), testing::EndsWith(" × the column: degrees instead of radians")));
  EXPECT_THAT(degrees.text(), testing::EndsWith(": degrees instead of radians, if it is an angle"));
}

TEST(RateCheck, AClockInMinutesOrHoursIsNotTakenForDegrees) {
  for (const bool wraps : {false, true}) {
    EXPECT_THAT((Swing{.factor = 1 / 60.0}.text(wraps)), testing::EndsWith(": t in minutes instead of seconds"));
    EXPECT_THAT((Swing{.factor = 60}.text(wraps)), testing::EndsWith(": a rate per minute instead of per second"));
    EXPECT_THAT((Swing{.factor = 1 / 3600.0}.text(wraps)), testing::EndsWith(": t in hours instead of seconds"));
    EXPECT_THAT((Swing{.factor = 3600}.text(wraps)), testing::EndsWith(": a rate per hour instead of per second"));
    EXPECT_THAT((Swing{.factor = 1 / 50.0}.text(wraps)), testing::EndsWith(": a unit or a sign, or the clock"));
  }
}

TEST(RateCheck, AnOffsetIsNamed) {
  for (const double noise : {0.0, 0.05}) {
    EXPECT_THAT((Swing{.noise = noise, .offset = 1}.text()), testing::ContainsRegex("lies (1|0.99[0-9]|1.0[0-9]*) above"));
    EXPECT_THAT((Swing{.noise = noise, .offset = -9.81}.text()), testing::ContainsRegex("lies 9.8[0-9]* below"));
    EXPECT_THAT((Swing{.noise = noise, .offset = 0.1}.text()), IsEmpty()) << "a twentieth of the rate";
  }
  EXPECT_THAT((Swing{.noise = 0.01, .factor = 57, .offset = 1}.text()), Not(HasSubstr("throughout")));
}

TEST(RateCheck, SwappedColumnsAreNamedOfCoordinatesThatMoveTogether) {
  std::mt19937 random(5);
  std::normal_distribution<double> normal(0, 0.02);
  const RowVectorXd t = RowVectorXd::LinSpaced(800, 0, 8), x = (3 * t.array()).sin() + 0.4 * (7 * t.array()).cos();
  RowVectorXd dx = 3 * (3 * t.array()).cos() - 2.8 * (7 * t.array()).sin(), dy = -0.8 * dx.array() + (5 * t.array()).cos();
  for (RowVectorXd* const one : {&dx, &dy}) {
    for (double& value : *one) value += normal(random);
  }
  const std::vector<std::string> names = {"dx", "dy"};
  EXPECT_THAT(better_rate({t, "x", x, false, {dy, dx}, names, 0}), HasSubstr("by the column of dy: swapped?"));
  EXPECT_THAT(better_rate({t, "x", x, false, {dx, dy}, names, 0}), IsEmpty());
  // a noisy column is not another's, though that is proportional to the rate
  RowVectorXd noisy = dx;
  for (double& value : noisy) value += 80 * normal(random);
  EXPECT_THAT(better_rate({t, "x", x, false, {noisy, 0.4 * dx}, names, 0}), IsEmpty());
}

TEST(RateCheck, SwappedColumnsAreNamedOfCoordinatesInAFixedRatio) {
  const RowVectorXd t = RowVectorXd::LinSpaced(300, 0, 9);
  const std::vector<RowVectorXd> values = {(2 * t.array()).sin(), 0.02 * (2 * t.array()).sin()};
  const RowVectorXd dphi = 2 * (2 * t.array()).cos(), dx = 0.02 * dphi;
  const std::vector<std::string> names = {"dphi", "dx"};
  const auto text = [&](const RowVectorXd& of_phi, const RowVectorXd& of_x) {
    return better_rate({t, "phi", values[0], false, {of_phi, of_x}, names, 0, false, nullptr, &values});
  };
  EXPECT_THAT(text(dphi, dx), IsEmpty());
  EXPECT_THAT(text(dx, dphi), HasSubstr("by the column of dx: swapped?"));
  EXPECT_THAT(text(57.3 * dphi, dphi), HasSubstr("the rate is 0.0175 × the column")) << "dphi is not that of x too";
}

TEST(RateCheck, FewWrongValuesSayNothingOfTheirColumn) {
  for (const double outliers : {0.5, -3.0, 30.0, 1e4}) {
    EXPECT_THAT((Swing{.noise = 0.01, .outliers = outliers}.text()), IsEmpty()) << outliers;
    EXPECT_THAT((Swing{.noise = 0.01, .factor = 57, .outliers = outliers}.text()), HasSubstr("the rate is 0.017")) << outliers;
    EXPECT_THAT((Swing{.noise = 0.01, .late = 0.1, .outliers = outliers}.text()), HasSubstr("lags by 0.1")) << outliers;
  }
}

// A swing of some seconds, exact but for one value of x, dx or ddx.
struct ExactSwing {
  RowVectorXd t, x, dx, ddx;

  explicit ExactSwing(Index n) : t(RowVectorXd::LinSpaced(n, 0, 0.06 * static_cast<double>(n - 1))) {
    const Eigen::ArrayXXd slow = 2 * t.array(), fast = 3.1 * t.array();
    x = slow.sin() + 0.4 * fast.cos();
    dx = 2 * slow.cos() - 1.24 * fast.sin();
    ddx = -4 * slow.sin() - 3.844 * fast.cos();
  }
};

TEST(RateCheck, OneWrongValueOfAShortLogIsNoLag) {
  for (const Index n : {95, 130, 160}) {
    for (Index row = 8; row < 90; row += 6) {
      ExactSwing swing(n);
      swing.x[row] += 1.5;
      const std::vector<std::string> names = {"dx"};
      EXPECT_THAT(better_rate({swing.t, "x", swing.x, false, {swing.dx}, names, 0}), IsEmpty()) << n << ' ' << row;
    }
  }
}

TEST(RateCheck, AFactorAndALagAreBothNamed) {
  EXPECT_THAT((Swing{.factor = 1.2}.text()), HasSubstr("the rate is 0.83"));
  EXPECT_THAT((Swing{.factor = 1.02}.text()), IsEmpty());
  EXPECT_THAT((Swing{.late = 0.1, .factor = 57}.text()),
              testing::AllOf(HasSubstr("the rate is 0.016"), HasSubstr("; the column lags by 0.1")));
}

TEST(RateCheck, AnotherColumnIsNamed) {
  const RowVectorXd t = RowVectorXd::LinSpaced(1000, 0, 10);
  const RowVectorXd value = (3 * t.array()).sin();
  std::vector<RowVectorXd> rates = {3 * (3 * t.array()).cos(), (7 * t.array()).cos()};
  const std::vector<std::string> names = {"dx", "dy"};
  EXPECT_THAT(better_rate({t, "y", value, false, rates, names, 1}), HasSubstr("dx: swapped?"));
  rates[0].segment(300, 100).setConstant(not_a_number);
  EXPECT_THAT(better_rate({t, "y", value, false, rates, names, 1}), HasSubstr("is neither this rate nor noise"))
      << "a column with gaps is not offered";
}

// no column is the right one: a copy of the coordinate stands for its rate
TEST(RateCheck, AColumnThatIsNoRateIsNamedWhateverItIs) {
  const Index n = 2000;
  for (const double noise : {0.0, 0.02}) {
    std::mt19937 random(5);
    std::normal_distribution<double> normal(0, noise);
    RowVectorXd t(n), value(n), copy(n);
    for (Index i = 0; i < n; ++i) {
      t[i] = 0.01 * static_cast<double>(i);
      const double exact = std::sin(2 * t[i]) + std::cos(0.9 * t[i] * (1 + 0.02 * t[i])) - std::exp(-t[i]);
      value[i] = exact + normal(random);
      copy[i] = exact + normal(random);
    }
    const std::vector<std::string> names = {"dx"};
    EXPECT_THAT(better_rate({t, "x", value, false, {copy}, names, 0}), HasSubstr("is neither this rate nor noise")) << noise;
  }
}

// What a fit of a model that does not read the time says of a swing that is logged over the time.
std::vector<std::string> rate_notes_of_fit(double unit_of_time, double factor_of_velocity, const std::string& time = "") {
  const Model model = Model::parse(R"(
coordinates = ["x"]
[mechanics]
mass = [["1"]]
force = ["-9*x"]
[noise]
ddq = 0.01
[[latent]]
name = "friction"
kernel = "se"
features = ["dx"]
directions = "force"
)",
                                   "a spring");
  std::string text = "t,x,dx,ddx\n";
  for (int i = 0; i < 200; ++i) {
    const double t = 0.05 * i, phase = 3 * t;
    text += fmt::format("{},{},{},{}\n", time.empty() ? fmt::format("{}", unit_of_time * t) : time, std::sin(phase),
                        factor_of_velocity * 3 * std::cos(phase), -9 * std::sin(phase));
  }
  std::vector<std::string> notes = make_fit_problem(model, CsvTable::parse(text, "log.csv"), {}).notes;
  std::erase_if(notes, [](const std::string& note) { return note.find("is not the rate of") == std::string::npos; });
  return notes;
}

TEST(RateNotes, OfAFitDoNotNeedAModelThatReadsTheTime) {
  EXPECT_THAT(rate_notes_of_fit(1, 1), IsEmpty());
  EXPECT_THAT(rate_notes_of_fit(1, -1),
              testing::ElementsAre(testing::StartsWith("warning: log.csv: dx is not the rate of x over t: the rate is -1 × ")));
  EXPECT_THAT(rate_notes_of_fit(1e9, 1), IsEmpty()) << "nanoseconds";
  EXPECT_THAT(rate_notes_of_fit(1e3, -1), testing::SizeIs(1)) << "milliseconds";
  EXPECT_THAT(rate_notes_of_fit(1, 1, "noon"), IsEmpty());
}

TEST(WrongRates, AreNamedWhereARowIsThereTwiceOrAnEpisodeBeginsAnew) {
  const Model model = Model::parse("coordinates = [\"x\"]\n[mechanics]\nmass = [[\"1\"]]\nforce = [\"0\"]\n", "mass");
  for (const bool is_episode : {false, true}) {
    Eigen::MatrixXd states(3, 400);  // x, dx, t
    for (Index i = 0; i < states.cols(); ++i) {
      const Index row = is_episode ? i % 200 : std::min<Index>(i, 300);
      const double t = 0.02 * static_cast<double>(row);
      states.col(i) << std::sin(3 * t), -3 * std::cos(3 * t), t;
    }
    const Index n = is_episode ? 400 : 303;
    const auto notes = wrong_rates(*model.system, states.leftCols(n), Eigen::MatrixXd::Constant(1, n, std::nan("")), true);
    EXPECT_THAT(notes, testing::ElementsAre(HasSubstr("a wrong sign"))) << is_episode;
  }
}

// Which single values are told of a swing of a mass that may have stops.
std::vector<std::string> single_values_of(const ExactSwing& swing, bool has_stop = false) {
  const Model model = Model::parse(
      fmt::format("coordinates = ['x']\ninputs = ['stop']\n[mechanics]\nmass = [['1']]\nforce = ['0']\n{}",
                  has_stop ? "[constraints]\nposition = [{ expr = '5 - x', contact = 'stop', restitution = 0.2 }]\n" : ""),
      "mass");
  Eigen::MatrixXd states(4, swing.t.size());
  states << swing.x, swing.dx, swing.t, RowVectorXd::Zero(swing.t.size());
  return single_wrong_values(*model.system, states, swing.ddx, 1);
}

TEST(SingleWrongValues, AreNamedWithTheirRow) {
  const auto named = [](const char* name, const char* other) {
    return testing::ElementsAre(testing::MatchesRegex(fmt::format(
        "single values of {} contradict {} and the rows beside them: .* at data row 42\\. Correct them, .*", name, other)));
  };
  ExactSwing swing(150);
  EXPECT_THAT(single_values_of(swing), IsEmpty());
  swing.x[41] += 3;
  EXPECT_THAT(single_values_of(swing), named("x", "dx"));
  swing = ExactSwing(150);
  swing.dx[41] += 5;
  EXPECT_THAT(single_values_of(swing), named("dx", "x"));
  swing.x.setConstant(not_a_number);
  EXPECT_THAT(single_values_of(swing), named("dx", "ddx"));
  swing = ExactSwing(150);
  swing.ddx[41] -= 20;
  EXPECT_THAT(single_values_of(swing), named("ddx", "dx"));
  for (Index row = 20; row < 140; row += 10) swing.ddx[row] -= 20;
  EXPECT_THAT(single_values_of(swing), IsEmpty()) << "many";
}

TEST(SingleWrongValues, AreNotThoseOfImpactsPausesAndEncoders) {
  ExactSwing swing(150);
  swing.dx.segment(60, 90).array() -= 4, swing.x.segment(60, 90).array() -= 4 * (swing.t.segment(60, 90).array() - 3.57);
  EXPECT_THAT(single_values_of(swing), IsEmpty()) << "an impact between rows";
  // two impacts at once, on one side and on the other: the position tells that the velocity was there
  swing = ExactSwing(150);
  swing.dx[60] -= 40, swing.x.segment(60, 90).array() -= 1.2, swing.x.segment(61, 89).array() -= 1.2;
  EXPECT_THAT(single_values_of(swing), IsEmpty());
  swing = ExactSwing(150);
  swing.t.segment(60, 90).array() += 3;
  EXPECT_THAT(single_values_of(swing), IsEmpty()) << "a pause";
  swing = ExactSwing(150);
  swing.x.array() = (swing.x.array() / 0.2).round() * 0.2;
  EXPECT_THAT(single_values_of(swing), IsEmpty()) << "an encoder";
  swing = ExactSwing(150);
  swing.x.setZero(), swing.dx.setZero(), swing.ddx.setZero();
  swing.x[41] = 0.01;
  EXPECT_THAT(single_values_of(swing), IsEmpty()) << "an encoder at rest between two of its steps";
  swing = ExactSwing(150);
  swing.dx[41] += 5;
  EXPECT_THAT(single_values_of(swing, true), testing::SizeIs(1)) << "where a stop may act too, the position tells it";
}

// A driven mass of which 15 of 150 rows are edited.
std::vector<std::string> stuck_in(const std::function<void(Eigen::Ref<Eigen::MatrixXd> states, Eigen::RowVectorXd& ddx)>& edit) {
  static const Model model =
      Model::parse("coordinates = [\"x\"]\ninputs = [\"u\"]\n[mechanics]\nmass = [[\"1\"]]\nforce = [\"u\"]\n", "mass");
  Eigen::MatrixXd states(4, 150);  // x, dx, t, u
  Eigen::RowVectorXd ddx(states.cols());
  for (Index i = 0; i < states.cols(); ++i) {
    const double t = 0.05 * static_cast<double>(i);
    states.col(i) << std::sin(2 * t) + 0.2 * std::sin(5 * t), 2 * std::cos(2 * t) + std::cos(5 * t), t,
        -4 * std::sin(2 * t) - 5 * std::sin(5 * t) + 0.1;
    ddx[i] = states(3, i) - 0.1 + 0.05 * std::sin(100.0 * static_cast<double>(i));
  }
  edit(states, ddx);
  return stuck_channels(*model.system, states, ddx);
}

TEST(StuckChannels, AreNamedWithTheirRows) {
  constexpr Index first = 60, n = 15;
  const auto hold = [](auto row) { row.segment(first, n).setConstant(row[first]); };
  const auto named = [](const char* name) {
    return testing::ElementsAre(HasSubstr(std::string(name) + " is the same in data rows 61 to 75, while the system moves"));
  };
  EXPECT_THAT(stuck_in([](auto, auto&) {}), IsEmpty());
  EXPECT_THAT(stuck_in([&](auto states, auto&) { hold(states.row(0)); }), named("x"));
  EXPECT_THAT(stuck_in([&](auto states, auto&) { hold(states.row(1)); }), named("dx"));
  EXPECT_THAT(stuck_in([&](auto, auto& ddx) { hold(ddx.segment(0, ddx.size())); }), named("ddx"));
  EXPECT_THAT(stuck_in([](auto states, auto&) { states.row(3).segment(40, 15).setConstant(states(3, 40)); }),
              testing::ElementsAre(HasSubstr("u is the same in data rows 41 to 55, while the system moves")));
}

TEST(StuckChannels, AreNotThoseThatRestOrAreHeld) {
  const auto rounded = [](auto row, double step) { row = (row.array() / step).round() * step; };
  EXPECT_THAT(stuck_in([&](auto states, auto& ddx) {  // a stop, whose accelerometer has noise
                states.row(0).segment(60, 30).setConstant(0.3), states.row(1).segment(60, 30).setZero();
                ddx.segment(60, 30) *= 0.01;
              }),
              IsEmpty());
  EXPECT_THAT(stuck_in([&](auto states, auto& ddx) {  // the same stop, with an offset of the velocity
                const double from = states(0, 60) - states(0, 90);
                states.row(0).segment(60, 30).setConstant(states(0, 60)), states.row(1).segment(60, 30).setZero();
                ddx.segment(60, 30) *= 0.01;
                for (Index i = 90; i < 150; ++i) states(0, i) += from;
                states.row(1).array() += 0.13 * std::sqrt(states.row(1).squaredNorm() / static_cast<double>(states.cols()));
              }),
              IsEmpty());
  EXPECT_THAT(stuck_in([&](auto states, auto& ddx) {  // a constant acceleration, that of a fall say
                for (Index i = 0; i < 40; ++i) {
                  const double t = 0.05 * static_cast<double>(i);
                  states(0, i) = 1 - 4.905 * t * t, states(1, i) = -9.81 * t, ddx[i] = -9.81;
                }
              }),
              IsEmpty());
  EXPECT_THAT(stuck_in([&](auto states, auto& ddx) {
                for (Index row : {0, 1, 3}) rounded(states.row(row), 0.4);
                rounded(ddx.segment(0, ddx.size()), 2);
              }),
              IsEmpty());
  EXPECT_THAT(stuck_in([](auto states, auto&) {  // steps of ten rows
                for (Index i = 0; i < 150; ++i) states(3, i) = states(3, i / 10 * 10);
              }),
              IsEmpty());
  EXPECT_THAT(stuck_in([](auto states, auto&) {  // a dwell, after which the input goes on from there
                const Eigen::RowVectorXd u = states.row(3);
                for (Index i = 60; i < 150; ++i) states(3, i) = u[std::max<Index>(60, i - 20)];
              }),
              IsEmpty());
  for (const Index begin : {0, 130}) {
    EXPECT_THAT(stuck_in([&](auto states, auto&) { states.row(3).segment(begin, 20).setConstant(0.4); }), IsEmpty()) << begin;
  }
  EXPECT_THAT(stuck_in([](auto states, auto&) { states.row(3).segment(40, 30).setZero(); }), IsEmpty()) << "switched off";
  EXPECT_THAT(stuck_in([](auto states, auto&) { states.row(3) = states.row(3).cwiseMin(5).eval(); }), IsEmpty()) << "clipped";
}

TEST(StuckChannels, AreToldByAFit) {
  const Model model = Model::parse(
      "coordinates = ['x']\ninputs = ['u']\n[mechanics]\nmass = [['1']]\nforce = ['u']\n[noise]\nddq = 0.05\n[[latent]]\n"
      "features = ['dx']\ndirections = 'force'\n",
      "mass");
  std::string text = "t,x,dx,u,ddx\n";
  for (int i = 0; i < 150; ++i) {
    const double t = 0.05 * i, logged = i > 60 && i < 75 ? 3.0 : t, x = std::sin(2 * t);
    text += fmt::format("{},{},{},{},{}\n", t, x, 2 * std::cos(2 * t), -4 * std::sin(2 * logged), -4 * x);
  }
  EXPECT_THAT(make_fit_problem(model, CsvTable::parse(text, "log.csv"), {}).notes,
              testing::Contains(HasSubstr("warning: log.csv: u is the same in data rows 61 to 75, while the system moves")));
}

// A rope that was slack is pulled tight in three impacts: the acceleration shows nothing of these, and the swing only begins after them.
TEST(WrongRates, AreNotThoseOfAMotionWithImpacts) {
  const auto notes_under = [](const std::string& rope, const std::string& inputs) {
    const Model model = Model::parse(fmt::format(R"(
coordinates = ["x"]
inputs = [{}]
[mechanics]
mass = [["1"]]
force = ["0"]
[constraints]
position = [{}]
)",
                                                 inputs, rope),
                                     "rope");
    const Index n = 300;
    Eigen::MatrixXd states = Eigen::MatrixXd::Zero(model.system->layout().size(), n), accelerations(1, n);
    double x = 0, dx = 0.46;
    for (Index i = 0; i < n; ++i) {
      const double dt = 0.01, since = dt * static_cast<double>(i - 44);
      const double before = i == 0 ? 0.2 : accelerations(0, i - 1), now = i < 44 ? 0.2 : -4.3 * std::cos(4.3 * since);
      const double impact = i == 31 ? -1.25 : i == 38 ? -0.21 : i == 44 ? -0.04 : 0;
      if (i > 0) {
        const double change = impact + dt * (i == 44 ? before : (before + now) / 2);
        x += dt * (dx + change / 2);
        dx += change;
      }
      states(0, i) = x, states(1, i) = dx, states(2, i) = dt * static_cast<double>(i);
      accelerations(0, i) = now;
    }
    return wrong_rates(*model.system, states, accelerations, true);
  };
  EXPECT_THAT(notes_under(R"({ expr = "5 - x", contact = "taut", restitution = 0.2 })", "\"taut\""), IsEmpty());
  EXPECT_THAT(notes_under("", ""), testing::ElementsAre(HasSubstr("the column leads")));
}

// A controller holds its inputs from row to row: accelerations jump at the rows, and are not the velocities' by trapezoids.
TEST(WrongRates, AreNotThoseOfInputsThatAreHeld) {
  const char* const file = "models/four_bar.toml";
  const std::string error = test::input_error_of([&] { test::drawn_log(file, 30, 1); });
  if (error.find("without MuJoCo") != std::string::npos) GTEST_SKIP() << error;
  for (const std::uint64_t seed : {3U, 4U}) {
    test::LogData log = test::drawn_log(file, 200, seed);
    EXPECT_THAT(wrong_rates(*log.model->system, log.states, log.accelerations, false), IsEmpty());
    log.accelerations.row(0) *= -1;
    EXPECT_THAT(wrong_rates(*log.model->system, log.states, log.accelerations, false),
                testing::ElementsAre(testing::StartsWith("ddcrank is not the rate of dcrank")));
  }
}

TEST(PileUp, IsOfAClippedColumnAndOfNoSwitchedOne) {
  std::mt19937 random(3);
  std::normal_distribution<double> normal(0, 1);
  RowVectorXd smooth(300), held(300), starts_late(300);
  for (Index i = 0; i < 300; ++i) smooth[i] = 2 * std::sin(0.05 * static_cast<double>(i)) + 0.1 * normal(random);
  for (Index i = 0; i < 300; ++i) held[i] = smooth[i / 10 * 10];
  for (Index i = 0; i < 300; ++i) starts_late[i] = i < 100 ? 0 : std::abs(smooth[i]);
  EXPECT_FALSE(pile_up(smooth));
  const auto found = pile_up(smooth.cwiseMin(1).cwiseMax(-1.2));
  ASSERT_TRUE(found);
  EXPECT_EQ(found->value, 1);
  EXPECT_GT(found->share, 0.2);
  EXPECT_FALSE(pile_up(held)) << "held";
  EXPECT_FALSE(pile_up(smooth.array().sign())) << "switched";
  EXPECT_FALSE(pile_up((4 * smooth.array()).round())) << "coarsely rounded";
  EXPECT_FALSE(pile_up(starts_late)) << "0 is no end of a range";
  EXPECT_FALSE(pile_up(RowVectorXd::Constant(300, 2))) << "constant";
}

TEST(PileUp, OfAVelocityIsToldWhereTheSystemIsAccelerated) {
  RowVectorXd t = RowVectorXd::LinSpaced(300, 0, 12), dx = t.array().sin(), ddx = t.array().cos();
  const RowVectorXd clipped = dx.cwiseMin(0.7);
  EXPECT_THAT(clipped_velocity("dx", clipped, ddx).value_or(""),
              testing::AllOf(testing::StartsWith("dx is exactly 0.7, its extreme, in "), HasSubstr("the end of its range?")));
  EXPECT_EQ(clipped_velocity("dx", dx, ddx), std::nullopt);
  RowVectorXd of_drive = (dx.array() < 0.7).select(ddx, 0);
  EXPECT_EQ(clipped_velocity("dx", clipped, of_drive), std::nullopt) << "a drive's constant speed";
  std::mt19937 random(5);
  std::normal_distribution<double> noise(0, 0.2);
  for (double& one : of_drive) one += noise(random);
  EXPECT_EQ(clipped_velocity("dx", clipped, of_drive), std::nullopt) << "with noise";
  for (double& one : ddx) one += noise(random);
  EXPECT_NE(clipped_velocity("dx", clipped, ddx), std::nullopt) << "clipped, with noise";
}

TEST(FarValues, AreThoseFarBeyondAllOthers) {
  std::mt19937 random(4);
  std::normal_distribution<double> normal(0, 1);
  RowVectorXd values(300);
  for (double& one : values) one = normal(random);
  EXPECT_THAT(far_values(values), IsEmpty());
  values[7] = std::nan("");
  values[250] = 1e6;
  EXPECT_THAT(far_values(values), testing::ElementsAre(250));
  EXPECT_THAT(far_values_text("u", {values}).value(), testing::HasSubstr(": 1e+06 at row 251. "));
  // of values that are some of a log's, in another order
  std::vector<int> lines(300);
  for (int k = 0; k < 300; ++k) lines[static_cast<std::size_t>(k)] = 2 + 3 * (299 - k);
  EXPECT_THAT(far_values_text("u", {values}, {lines}).value(), testing::HasSubstr(": 1e+06 at line 149. "));
  RowVectorXd pulses = RowVectorXd::Zero(300);
  pulses[12] = 50;
  EXPECT_THAT(far_values(pulses), IsEmpty()) << "an input that rests but for a pulse";
  EXPECT_THAT(far_values(values.head(10)), IsEmpty()) << "too few";
}

TEST(WrappedDegrees, AreToldFromRadAndFromDegreesThatDoNotWrap) {
  std::vector<double> degrees, positive, unwrapped, rad;
  for (int k = 0; k < 400; ++k) {
    const double angle = 0.04 * k, in_degrees = angle * 180 / std::numbers::pi;
    unwrapped.push_back(in_degrees);
    degrees.push_back(std::remainder(in_degrees, 360));
    positive.push_back(std::fmod(in_degrees, 360));
    rad.push_back(std::remainder(angle, 2 * std::numbers::pi));
  }
  EXPECT_TRUE(is_wrapped_in_degrees(degrees));
  EXPECT_TRUE(is_wrapped_in_degrees(positive));
  EXPECT_FALSE(is_wrapped_in_degrees(unwrapped));
  EXPECT_FALSE(is_wrapped_in_degrees(rad));
}

}  // namespace

}  // namespace gp2
