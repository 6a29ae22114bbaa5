#include <cmath>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "test_models.hpp"

namespace gp2::test {
namespace {

using testing::HasSubstr;
using testing::Not;

class Check : public testing::TestWithParam<std::string> {};

TEST_P(Check, FindsNothingWrongWithAShippedModelAndItsData) {
  const Desk desk;
  const Outcome alone = desk.run("gp2 check " + GetParam());
  EXPECT_EQ(alone.status, 0) << alone.out << alone.err;
  EXPECT_THAT(alone.out, Not(HasSubstr("ERROR")));
  EXPECT_THAT(alone.out, Not(HasSubstr("warning")));
  desk.done("gp2 generate " + GetParam() + " --n 25 --noise-std 0.01 -o log.csv");
  const Outcome with_data = desk.run("gp2 check " + GetParam() + " --data log.csv");
  EXPECT_EQ(with_data.status, 0) << with_data.out << with_data.err;
  EXPECT_THAT(with_data.out, HasSubstr("log.csv: 25 rows"));
  EXPECT_THAT(with_data.out, Not(HasSubstr("ERROR")));
  EXPECT_THAT(with_data.out, Not(HasSubstr("warning")));
}

INSTANTIATE_TEST_SUITE_P(OfEveryModel, Check, testing::ValuesIn(every_model()), model_test_name);

TEST(Check, SpeaksJsonOfALogInLatin1) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 25 -o 'l\xe4ngs.csv'");
  const Outcome checked = desk.done("gp2 check models/surface.toml --data 'l\xe4ngs.csv' --json");
  EXPECT_EQ(checked.json()["errors"], 0);
  EXPECT_THAT(checked.out, HasSubstr("l\uFFFDngs.csv: 25 rows"));
}

TEST(Check, WarnsOfAccelerationsThatWereComputedFromEachOther) {
  const Desk desk;
  desk.done("gp2 generate models/double_pendulum.toml --n 25 --noise-std 0 -o log.csv");
  const Outcome checked = desk.done("gp2 check models/double_pendulum.toml --data log.csv");
  EXPECT_THAT(checked.out,
              testing::ContainsRegex("warning +dependent columns: the 6 accelerations .* only 2 .* --observe ddq[0-9],ddq[0-9]"));
  const std::string fit = "gp2 fit models/double_pendulum.toml --data log.csv --max-iterations 0 -o fit.json";
  EXPECT_THAT(desk.done(fit).err,
              HasSubstr("warning: log.csv: the accelerations satisfy A ddq = b, or part of it, far more closely than noise"));
  EXPECT_THAT(desk.done(fit + " --observe ddq3,ddq6").err, Not(HasSubstr("warning")));
}

TEST(Check, WarnsOfStatesOffTheConstraint) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 25 -o good.csv");
  // the fourth row's q3 lifted off the surface
  const CsvTable good = desk.table("good.csv");
  std::string csv = "q1,q2,q3,dq1,dq2,dq3,u1,u2,u3,ddq1,ddq2,ddq3\n";
  for (int i = 0; i < good.n_rows(); ++i) {
    for (int column = 0; column < good.n_columns(); ++column) {
      const double lift = i == 3 && column == good.find("q3") ? 0.1 : 0;
      csv += column == 0 ? "" : ",";
      csv += shortest(good.number(i, column) + lift);
    }
    csv += "\n";
  }
  desk.write("log.csv", csv);
  const Outcome checked = desk.done("gp2 check models/surface.toml --data log.csv");
  EXPECT_THAT(checked.out, testing::ContainsRegex("warning +data on the constraint: off by 0.1 .*row 4"));
  desk.done("gp2 fit models/surface.toml --data good.csv --max-iterations 0 -o fit.json");
  for (const char* line : {"gp2 fit models/surface.toml --data log.csv --max-iterations 0 -o other.json",
                           "gp2 predict fit.json --states log.csv -o prediction.csv", "gp2 evaluate fit.json --data log.csv"}) {
    EXPECT_THAT(desk.done(line).err,
                testing::ContainsRegex("warning: log.csv: states are off the constraint: .* -?0.1 at data row 4"));
  }
}

TEST(Check, TakesNoMapWithoutALog) {
  const Outcome checked = Desk().run("gp2 check models/surface.toml --map q1=x");
  EXPECT_NE(checked.status, 0);
  EXPECT_THAT(checked.err, HasSubstr("--map renames columns of a log, and there is none: give --data"));
}

TEST(Check, JudgesPriorsByTheirBounds) {
  const Desk desk;
  const auto check_of = [&](const std::string& bounds, const std::string& prior) {
    desk.write("model.toml", "coordinates = [\"x\"]\n[parameters]\nm = { value = 1, bounds = " + bounds +
                                 ", estimate = true, prior = " + prior +
                                 " }\n[mechanics]\nmass = [[\"m\"]]\n[[latent]]\nfeatures = [\"dx\"]\n");
    return desk.run("gp2 check model.toml");
  };
  const Outcome refused = check_of("[0, 2]", "{ median = 0.5, log_stddev = 0.1 }");
  EXPECT_NE(refused.status, 0);
  EXPECT_THAT(refused.out,
              testing::ContainsRegex("ERROR +parameter 'm': a prior of the logarithm needs bounds above 0, got .0, 2"));
  const Outcome beyond = check_of("[0, 2]", "{ mean = 5, stddev = 0.1 }");
  EXPECT_THAT(beyond.out,
              testing::ContainsRegex("warning +parameter 'm': the centre of its prior, 5, lies 30 standard deviations"));
  EXPECT_THAT(check_of("[0.1, 2]", "{ median = 0.5, log_stddev = 0.1 }").out, Not(HasSubstr("prior")));
  EXPECT_THAT(check_of("[0, 2]", "{ mean = 2.1, stddev = 0.1 }").out, Not(HasSubstr("prior")));
}

TEST(Check, RefusesMarksThatAFitRefuses) {
  const Desk desk;
  const auto check_of = [&](const std::string& parameters, const std::string& feature) {
    desk.write("model.toml",
               "coordinates = [\"x\"]\n[parameters]\n" + parameters +
                   "\n[let]\nspeed = \"c*dx\"\n[mechanics]\nmass = [[1]]\nforce = [\"c\"]\n[[latent]]\nfeatures = [\"" + feature +
                   "\"]\n");
    return desk.run("gp2 check model.toml");
  };
  const Outcome of_feature = check_of("c = { value = 1, estimate = true }", "speed");
  EXPECT_NE(of_feature.status, 0);
  EXPECT_THAT(of_feature.out,
              testing::ContainsRegex("ERROR +.parameters. c: estimate = true: parameter 'c' stands in a feature of the latent"));
  const Outcome of_zero = check_of("c = { value = 0, estimate = true }", "dx");
  EXPECT_EQ(of_zero.status, 0) << "the paper's protocol fits it";
  EXPECT_THAT(of_zero.out,
              testing::ContainsRegex("warning +parameter 'c' is 0 and has no bounds: write c = .*; a fit by the default "));
  EXPECT_EQ(check_of("c = { value = 1, estimate = true }", "dx").status, 0);
  EXPECT_EQ(check_of("c = 1", "speed").status, 0);
}

// an angle that swings by half a radian, in rad and in degrees; a wheel that turns one way as fast as it likes
TEST(Check, WarnsOfAnAngleThatSwingsByHalfTurnsFromRowToRow) {
  const Desk desk;
  desk.write("model.toml",
             "coordinates = [{ name = \"a\", angle = true }]\n[mechanics]\nmass = [[\"1\"]]\n[[latent]]\nfeatures = [\"a\"]\n");
  const auto check_of = [&](double scale, double spin) {
    std::string log = "t,a,da,dda\n";
    for (int k = 0; k < 100; ++k) {
      const double t = 0.05 * k;
      log += fmt::format("{},{},{},{}\n", t, scale * 0.5 * std::sin(4 * t) + spin * t, scale * 2 * std::cos(4 * t) + spin,
                         -scale * 8 * std::sin(4 * t));
    }
    desk.write("log.csv", log);
    return desk.run("gp2 check model.toml --data log.csv").out;
  };
  EXPECT_THAT(check_of(57.3, 0),
              testing::ContainsRegex("warning +a moves by more than half a turn from row to row, back and forth"));
  EXPECT_THAT(check_of(1, 0), Not(HasSubstr("half a turn")));
  EXPECT_THAT(check_of(1, 100), Not(HasSubstr("half a turn")));
  // of an angle that nothing reads, and the log lacks, there is no range
  desk.write("model.toml", replaced(desk.read("model.toml"), "[\"a\"]", "[\"da\"]"));
  check_of(57.3, 0);
  desk.write("rates.csv", "t,da,dda\n");
  desk.done("tail -n +2 log.csv | cut -d, -f1,3,4 >> rates.csv");
  EXPECT_THAT(desk.run("gp2 check model.toml --data rates.csv").out,
              testing::ContainsRegex("back and forth, at [0-9]+ of 99 rows: is it in rad"));
}

// A motor that moves a carriage by a gear turns as far as the carriage moves.
TEST(Check, BelievesHalfTurnsFromRowToRowThatAConstraintCounts) {
  const Desk desk;
  desk.write("model.toml",
             "coordinates = [{ name = \"a\", angle = true }, \"x\"]\n[mechanics]\nmass = [[1, 0], [0, 1]]\n[constraints]\n"
             "position = [\"x - 0.02*a\"]\n[[latent]]\nfeatures = [\"dx\"]\n");
  const auto check_of = [&](double ratio) {
    std::string log = "t,a,da,dda,x,dx,ddx\n";
    for (int k = 0; k < 100; ++k) {
      const double t = 0.05 * k, a = 30 * std::sin(4 * t), da = 120 * std::cos(4 * t), dda = -16 * a;
      log += fmt::format("{},{},{},{},{},{},{}\n", t, a, da, dda, ratio * a, ratio * da, ratio * dda);
    }
    desk.write("log.csv", log);
    return desk.run("gp2 check model.toml --data log.csv").out;
  };
  EXPECT_THAT(check_of(0.02), Not(HasSubstr("half a turn")));
  EXPECT_THAT(check_of(0.02 / 57.3), HasSubstr("half a turn")) << "degrees";
  // a gear between two angles holds in any unit
  desk.write(
      "model.toml",
      "coordinates = [{ name = \"a\", angle = true }, { name = \"x\", angle = true }]\n[mechanics]\nmass = [[1, 0], [0, 1]]\n"
      "[constraints]\nposition = [\"x - 0.02*a\"]\n[[latent]]\nfeatures = [\"dx\"]\n");
  EXPECT_THAT(check_of(0.02), HasSubstr("half a turn"));
}

TEST(Check, SaysWhichAccelerationsTheLogLacks) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 25 -o log.csv");
  desk.write("log.csv", replaced(desk.read("log.csv"), ",ddq2,", ",vertical_comment,"));
  const Outcome checked = desk.done("gp2 check models/surface.toml --data log.csv");
  EXPECT_THAT(checked.out, HasSubstr("not in the log: ddq2; fit with --observe"));
  EXPECT_THAT(checked.out, HasSubstr("columns not needed: vertical_comment"));
  desk.done("cut -d, -f1-9 log.csv > states.csv");
  const Outcome of_states = desk.done("gp2 check models/surface.toml --data states.csv");
  EXPECT_THAT(of_states.out, HasSubstr("not in the log: ddq1, ddq2, ddq3; a fit needs at least one of them"));
  EXPECT_THAT(of_states.out, Not(HasSubstr("for the others")));
}

/// A particle on a line with a changed mass matrix or constraint.
std::string particle(const std::string& mass, const std::string& acceleration) {
  return R"(
name = "particle"
coordinates = ["q1", "q2"]
[mechanics]
mass = )" +
         mass + R"(
force = ["0", "0"]
[constraints]
acceleration = )" +
         acceleration + R"(
[[latent]]
name = "force"
kernel = "se"
features = ["q1"]
directions = "acceleration"
[noise]
ddq = 0.1
)";
}

TEST(Check, FailsWhereTheModelIsNotWellPosedAndSaysAtWhichState) {
  const Desk desk;
  desk.write("log.csv", "q1,q2,ddq1,ddq2\n1,0,0.1,0\n2,0,0.2,0.1\n-1,0,0.2,0.1\n3,1,0.1,0\n");
  struct Broken {
    const char* name;
    std::string text, finding;
  };
  for (const Broken& one :
       {Broken{"indefinite.toml", particle(R"([["q1", "0"], ["0", "1"]])", R"(["ddq2"])"),
               "mass matrix M is not positive definite at state 3"},
        Broken{"contradiction.toml", particle(R"([["1", "0"], ["0", "1"]])", R"x(["ddq2 - q1", "ddq2 - abs(q1)"])x"),
               "constraints contradict each other: no acceleration satisfies A ddq = b at state 3"}}) {
    SCOPED_TRACE(one.name);
    desk.write(one.name, one.text);
    const Outcome checked = desk.run(std::string("gp2 check ") + one.name + " --data log.csv");
    EXPECT_EQ(checked.status, 2);
    EXPECT_THAT(checked.out, testing::AllOf(HasSubstr("ERROR"), HasSubstr(one.finding)));
    EXPECT_THAT(checked.err, HasSubstr(std::string(one.name) + ": 1 of the checks failed"));
    const Outcome as_json = desk.run(std::string("gp2 check ") + one.name + " --data log.csv --json");
    EXPECT_EQ(as_json.status, 2);
    EXPECT_EQ(as_json.json()["errors"], 1);
    EXPECT_THAT(as_json.out, HasSubstr("\"level\": \"error\""));
  }
}

TEST(Check, WarnsOfARowThatVanishes) {
  const Desk desk;
  desk.write("model.toml", particle(R"([["1", "0"], ["0", "1"]])", R"(["q1*ddq2"])"));
  desk.write("log.csv", "q1,q2,ddq1,ddq2\n1,0,0.1,0\n2,0,0.2,0.1\n1e-9,0,0.2,0.1\n3,1,0.1,0\n");
  EXPECT_THAT(desk.done("gp2 check model.toml --data log.csv").out,
              testing::ContainsRegex("warning +constraint .*of its usual size at state 3"));
}

// a belt that a constraint drives at a constant speed
TEST(Check, TakesNoVelocityForStuckThatAConstraintHolds) {
  const Desk desk;
  const std::string belt = R"toml(
coordinates = ["x", "belt"]
[mechanics]
mass = [["2", "0"], ["0", "1"]]
force = ["-20*x", "0"]
[constraints]
position = ["belt - 0.5*t"]
[[latent]]
features = ["dx - dbelt"]
directions = { force = [["1"], ["0"]] }
[truth]
force = ["-2*tanh(10*(dx - dbelt))", "0"]
[sampling]
x = [-0.2, 0.2]
dx = [-1, 1]
t = [0, 4]
[noise]
ddq = 0.05
)toml";
  const std::string stuck = "dbelt is the same in every row, while the system moves";
  desk.write("belt.toml", belt);
  desk.done("gp2 generate belt.toml --n 30 --noise-std 0.05 -o log.csv");
  EXPECT_THAT(desk.done("gp2 check belt.toml --data log.csv").out, Not(HasSubstr("stuck")));
  desk.write("speed.toml", replaced(belt, "position = [\"belt - 0.5*t\"]", "velocity = [\"dbelt - 0.5\"]"));
  EXPECT_THAT(desk.done("gp2 check speed.toml --data log.csv").out, Not(HasSubstr("stuck")));
  // one that says nothing of the belt
  desk.write("free.toml", replaced(belt, "belt - 0.5*t", "x - 0.2*sin(t)"));
  EXPECT_THAT(desk.run("gp2 check free.toml --data log.csv").out, HasSubstr(stuck));
}

TEST(Check, NamesTheRowsInWhichAChannelIsStuck) {
  const Desk desk;
  desk.write("mass.toml", R"toml(
coordinates = ["x"]
inputs = ["u"]
[mechanics]
mass = [["1"]]
force = ["u"]
[[latent]]
features = ["dx"]
directions = "force"
)toml");
  const auto log_with = [&](int first, int n) {
    std::string text = "t,x,dx,u,ddx\n";
    for (int i = 0; i < 150; ++i) {
      const double t = 0.05 * i, logged = i >= first && i < first + n ? 0.05 * first : t;
      text += fmt::format("{},{},{},{},{}\n", t, std::sin(2 * t), 2 * std::cos(2 * logged), -4 * std::sin(2 * t),
                          -4 * std::sin(2 * t) + 0.01 * std::sin(100.0 * i));
    }
    desk.write("log.csv", text);
    return desk.done("gp2 check mass.toml --data log.csv").out;
  };
  EXPECT_THAT(log_with(0, 0), Not(HasSubstr("stuck")));
  EXPECT_THAT(log_with(60, 15),
              HasSubstr("dx is the same in data rows 61 to 75, while the system moves: was its channel stuck?"));
}

/// A bead on a wire z = x²/2 beside a belt that rubs, whose potential is told.
std::string bead_with(const std::string& potential) {
  return R"toml(
coordinates = ["x", "z"]
inputs = ["push"]
[mechanics]
mass = [["1", "0"], ["0", "1"]]
force = ["push - 0.2*tanh(dx - 1)", "-9.81"]
potential = ")toml" +
         potential + R"toml("
[constraints]
position = ["z - 0.5*x^2"]
[[latent]]
features = ["dx"]
[truth]
force = ["-dx", "0"]
[sampling]
x = [-1, 1]
dx = [-1, 1]
push = [-1, 1]
)toml";
}

TEST(Check, WarnsOfAPotentialThatContradictsTheForce) {
  const Desk desk;
  const auto check_of = [&](const std::string& text) {
    desk.write("model.toml", text);
    return desk.done("gp2 check model.toml").out;
  };
  const auto driven = [](const std::string& force, const std::string& potential) {
    return "coordinates = [\"x\"]\n[mechanics]\nmass = [[\"1\"]]\nforce = [\"" + force + "\"]\npotential = \"" + potential +
           "\"\n[[latent]]\nfeatures = [\"dx\"]\n[truth]\nforce = [\"-dx\"]\n[sampling]\nx = [-1, 1]\ndx = [-1, 1]\nt = [0, 5]\n";
  };
  const std::string wrong = "potential: at rest the force is farther from -dV/dq than from 0";
  EXPECT_THAT(check_of(driven("-9.81*sin(x)", "9.81*cos(x)")), testing::ContainsRegex("warning +" + wrong));
  EXPECT_THAT(check_of(driven("-9.81*sin(x)", "-9.81*cos(x)")), Not(HasSubstr(wrong)));
  EXPECT_THAT(check_of(bead_with("-9.81*z")), HasSubstr(wrong));
  EXPECT_THAT(check_of(bead_with("9.81*z")), Not(HasSubstr(wrong)));
  EXPECT_THAT(check_of(bead_with("4.905*x^2")), Not(HasSubstr(wrong))) << "the same on the wire";
  // forces that have no potential
  EXPECT_THAT(check_of(driven("-x + 3*sin(t)", "x^2/2")), Not(HasSubstr(wrong)));
  EXPECT_THAT(check_of(driven("3 - x", "x^2/2")), Not(HasSubstr(wrong)));
  EXPECT_THAT(check_of(driven("-x - 0.3*sign(dx)", "x^2/2")), Not(HasSubstr(wrong)));
}

TEST(Check, WithoutSamplingOrDataSaysThatNothingWasEvaluated) {
  const Desk desk;
  desk.write("model.toml", particle(R"([["1", "0"], ["0", "1"]])", R"(["ddq2"])"));
  EXPECT_THAT(desk.done("gp2 check model.toml").out,
              HasSubstr("no --data, and the model has no [truth] with [sampling] or [motion]"));
}

}  // namespace
}  // namespace gp2::test
