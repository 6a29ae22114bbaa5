// Where a motion starts whose log was written by other lengths.
#include <cmath>
#include <tuple>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "gp2/jobs/simulate_job.hpp"
#include "input_error.hpp"

namespace gp2 {
namespace {

using Eigen::VectorXd;
using testing::Contains;
using testing::HasSubstr;
using testing::IsEmpty;

// a wire_pendulum in maximal coordinates
Model wire_pendulum(const std::string& more) {
  return Model::parse(R"toml(
name        = "pendulum"
coordinates = ["x", "y", { name = "a", angle = true }]
[parameters]
l = 1.1
[mechanics]
mass  = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "0.1"]]
force = ["0", "-9.81", "0"]
[constraints]
position = ["x - l*sin(a)", "y + l*cos(a)"]
)toml" + more,
                      "pendulum.toml");
}

// a = 0.8 and da = 0.5 are measured, the rest computed by a length
SimulateJob job_of(const Model& model, double length) {
  const double a = 0.8, da = 0.5;
  const CsvTable log =
      CsvTable::parse(fmt::format("x,y,a,dx,dy,da\n{},{},{},{},{},{}\n", length * std::sin(a), -length * std::cos(a), a,
                                  length * std::cos(a) * da, length * std::sin(a) * da, da),
                      "log.csv");
  SimulateRequest request;
  request.start = log;
  request.times = VectorXd::LinSpaced(2, 0, 0.1);
  return prepare_simulation(model, request);
}

TEST(StartOfALog, KeepsWhatWasMeasuredAndSolvesForTheRest) {
  for (const char* more : {"", "[sampling]\na = [-1, 1]\nda = [-1, 1]\n"}) {
    const SimulateJob job = job_of(wire_pendulum(more), 1);
    EXPECT_EQ(job.start[2], 0.8);
    EXPECT_EQ(job.start[5], 0.5);
    EXPECT_NEAR(job.start[0], 1.1 * std::sin(0.8), 1e-12);
    EXPECT_NEAR(job.start[4], 1.1 * std::sin(0.8) * 0.5, 1e-12);
    EXPECT_THAT(job.notes, Contains(HasSubstr("start: from the constraints x = ")));
  }
}

TEST(StartOfALog, IsTakenAsItIsWhereItIsOnTheConstraints) {
  const SimulateJob job = job_of(wire_pendulum(""), 1.1);
  EXPECT_THAT(job.notes, IsEmpty());
  EXPECT_EQ(job.start[0], 1.1 * std::sin(0.8));
}

TEST(StartOfALog, IsFoundWhereNewtonsMethodHasNoSlopeToBeginWith) {
  // x² + y² = l² at y = 0 has none in y
  const Model model = Model::parse(R"toml(
coordinates = ["x", "y"]
[parameters]
l = 1.1
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["0", "-9.81"]
[constraints]
position = ["x^2 + y^2 - l^2"]
)toml",
                                   "circle.toml");
  SimulateRequest request;
  request.start = std::map<std::string, double>{{"x", 0.1}};
  request.times = VectorXd::LinSpaced(2, 0, 0.1);
  SimulateJob job = prepare_simulation(model, request);
  EXPECT_EQ(job.start[0], 0.1);
  EXPECT_NEAR(job.start[1], std::sqrt(1.21 - 0.01), 1e-14);
  EXPECT_THAT(job.notes, Contains(HasSubstr("start: from the constraints y = 1.0954")));
  // nor has cos(a) at a = 0, from where it is not far
  request.start = std::map<std::string, double>{{"y", 0.3}};
  job = prepare_simulation(wire_pendulum(""), request);
  EXPECT_NEAR(std::cos(job.start[2]), -0.3 / 1.1, 1e-14);
  EXPECT_LE(std::abs(job.start[2]), 3.2);
  request.start = std::map<std::string, double>{{"x", 1.2}};
  job = prepare_simulation(model, request);
  EXPECT_THAT(job.notes, Contains(HasSubstr("warning: `start`: what is given leaves no solution of the constraints")));
}

// what is given of a velocity says nothing against a solution of the coordinates
TEST(StartOfALog, IsFoundWhereACoordinateAndVelocitiesAreGiven) {
  SimulateRequest request;
  request.times = VectorXd::LinSpaced(2, 0, 0.1);
  for (const double da : {0.0, 0.7}) {
    request.start = std::map<std::string, double>{{"y", -0.3}, {"da", da}};
    const SimulateJob job = prepare_simulation(wire_pendulum(""), request);
    EXPECT_EQ(job.start[1], -0.3);
    EXPECT_EQ(job.start[5], da);
    EXPECT_NEAR(std::cos(job.start[2]), 0.3 / 1.1, 1e-14);
    EXPECT_NEAR(job.start[3], 0.3 * da, 1e-14);
    EXPECT_THAT(job.notes, testing::Not(Contains(HasSubstr("no solution"))));
  }
}

Model slider_crank() {
  return Model::parse(R"toml(
coordinates = [{ name = "phi", angle = true }, "x"]
[parameters]
r = 0.08
l = 0.22
[mechanics]
mass  = [["0.01", "0"], ["0", "1"]]
force = ["0", "0"]
[constraints]
position = ["(x - r*cos(phi))^2 + (r*sin(phi))^2 - l^2"]
)toml",
                      "slider_crank.toml");
}

// dx/dphi along the constraint
double slope_of_slider(double phi) {
  const double r = 0.08, s = r * std::sin(phi), c = r * std::cos(phi);
  return -s - s * c / std::sqrt(0.22 * 0.22 - s * s);
}

// what simulate() makes of a start
VectorXd begun(const SimulateJob& job) { return run_simulation(job)[0].states.col(0); }

TEST(StartOfALog, OfRoundedCoordinatesKeepsTheVelocityThatIsGiven) {
  SimulateRequest request;
  request.times = VectorXd::LinSpaced(2, 0, 0.01);
  for (const double x : {0.2952, 0.295, 0.3}) {
    request.start = std::map<std::string, double>{{"phi", 0.3}, {"x", x}, {"dphi", 2}};
    const SimulateJob job = prepare_simulation(slider_crank(), request);
    EXPECT_EQ(job.start.head(2), Eigen::Vector2d(0.3, x));  // as `project = false` wants them
    const VectorXd at = begun(job);
    EXPECT_NEAR(at[2], 2, 1e-12);
    EXPECT_NEAR(at[3], 2 * slope_of_slider(at[0]), 1e-12);
    EXPECT_LE(std::abs(at[1] - x), 1e-2);
    EXPECT_THAT(job.notes, Contains(HasSubstr(fmt::format("; the nearest that has one is phi = {:.9g} for 0.3, x = {:.9g} for {}",
                                                          at[0], at[1], x))));
    EXPECT_THAT(job.notes, Contains(HasSubstr("start: from the constraints dx = ")));
  }
}

TEST(StartOfALog, MovesVelocitiesWhereTheyContradictTheConstraintsAndNamesThem) {
  SimulateRequest request;
  request.times = VectorXd::LinSpaced(2, 0, 0.01);
  request.start = std::map<std::string, double>{{"phi", 0.3}, {"dphi", 2}, {"dx", 0.1}};
  const SimulateJob job = prepare_simulation(slider_crank(), request);
  EXPECT_EQ(job.start[0], 0.3);
  EXPECT_EQ(job.start[2], 2);
  EXPECT_EQ(job.start[3], 0.1);
  const VectorXd at = begun(job);
  EXPECT_EQ(at[0], 0.3);
  EXPECT_EQ(at[1], job.start[1]);
  EXPECT_THAT(
      job.notes,
      Contains(HasSubstr(fmt::format("; the nearest that has one is dphi = {:.9g} for 2, dx = {:.9g} for 0.1", at[2], at[3]))));
}

// All are given: what is off by more than their last digits is a warning, and less is left to who tells of the projection.
TEST(StartOfALog, WarnsOfAWholeStartThatContradictsTheConstraints) {
  SimulateRequest request;
  request.times = VectorXd::LinSpaced(2, 0, 0.01);
  const double phi = 0.3, s = 0.08 * std::sin(phi), x = 0.08 * std::cos(phi) + std::sqrt(0.22 * 0.22 - s * s);
  const auto notes = [&](const MotionStart& start) {
    request.start = start;
    const SimulateJob job = prepare_simulation(slider_crank(), request);
    EXPECT_EQ(job.start[0], phi);
    return job.notes;
  };
  const auto warns = Contains(HasSubstr("warning: `start`: what is given leaves no solution of the constraints"));
  const double dx = 2 * slope_of_slider(phi);
  for (const auto& [off_x, off_dx, is_warned] :
       {std::tuple(0.05, 0.0, true), {0.0, 0.1, true}, {1e-6, 0.0, false}, {0.0, 1e-6, false}}) {
    const VectorXd values = Eigen::Vector4d(phi, x + off_x, 2, dx + off_dx);
    const std::map<std::string, double> named = {{"phi", phi}, {"x", values[1]}, {"dphi", 2}, {"dx", values[3]}};
    for (const MotionStart& start : {MotionStart(values), MotionStart(named)}) {
      if (is_warned) {
        EXPECT_THAT(notes(start), warns) << off_x << ", " << off_dx;
      } else {
        EXPECT_THAT(notes(start), IsEmpty()) << off_x << ", " << off_dx;
      }
    }
  }
}

// A Watt linkage, whose crank does not reach so far: only the projection of all coordinates together leads back.
TEST(StartOfALog, NamesWhereItMovesWhatIsFarFromTheConstraints) {
  const Model model = Model::parse(R"toml(
coordinates = [{ name = "q1", angle = true }, { name = "q2", angle = true }, { name = "q3", angle = true }]
[parameters]
a = 0.4
b = 0.3
m = 0.8
[mechanics]
mass  = [["m*a^2*4/3", "m*a*b/2*cos(q1-q2)", "0"], ["m*a*b/2*cos(q1-q2)", "m*b^2/3", "0"], ["0", "0", "m*a^2/3"]]
force = ["0", "0", "0"]
[constraints]
position = ["a*cos(q1) + b*cos(q2) - 2*a - a*cos(q3)", "a*sin(q1) + b*sin(q2) - b - a*sin(q3)"]
)toml",
                                   "watt.toml");
  SimulateRequest request;
  request.start = std::map<std::string, double>{{"q1", 1.9}};
  request.times = VectorXd::LinSpaced(2, 0, 0.01);
  const SimulateJob job = prepare_simulation(model, request);
  EXPECT_EQ(job.start[0], 1.9);
  const VectorXd at = begun(job);
  EXPECT_LT(at[0], 1.4);
  EXPECT_THAT(job.notes,
              testing::ElementsAre(testing::EndsWith(fmt::format(
                  "); the nearest that has one is q1 = {:.9g} for 1.9, q2 = {:.6g}, q3 = {:.6g}", at[0], at[1], at[2]))));
}

TEST(StartOfALog, IsMoreThanATime) {
  SimulateRequest request;
  request.times = VectorXd::LinSpaced(2, 0, 0.1);
  request.start = CsvTable::parse("t,u\n0,1\n1,2\n", "inputs.csv");
  EXPECT_EQ(test::input_error_of([&] { prepare_simulation(wire_pendulum(""), request); }),
            "`start`: inputs.csv has none of the columns x, y, a, dx, dy, da");
}

// A table of arrays is called as its errors begin.
TEST(StartOfALog, NamesTheInputsOnce) {
  const Model model = Model::parse(R"toml(
coordinates = ["x"]
inputs = ["u"]
[mechanics]
mass  = [["1"]]
force = ["u"]
)toml",
                                   "cart.toml");
  SimulateRequest request;
  request.start = std::map<std::string, double>{{"x", 0}};
  request.times = VectorXd::LinSpaced(2, 0, 1);
  request.inputs = CsvTable::parse("t,u\n0,1\n0,2\n", "inputs");
  EXPECT_EQ(test::input_error_of([&] { prepare_simulation(model, request); }), "inputs: times must increase, but 0 follows 0");
}

// y is open, x and a are given too many
TEST(StartOfALog, OfRoundedCoordinatesSolvesForTheOthersNearThem) {
  SimulateRequest request;
  request.times = VectorXd::LinSpaced(2, 0, 0.01);
  request.start = std::map<std::string, double>{{"x", 0.789}, {"a", 0.8}, {"da", 0.5}};
  const SimulateJob job = prepare_simulation(wire_pendulum(""), request);
  const VectorXd at = begun(job);
  EXPECT_LE((at.head(3) - Eigen::Vector3d(0.789, -1.1 * std::cos(0.8), 0.8)).cwiseAbs().maxCoeff(), 1e-3);
  EXPECT_NEAR(at[5], 0.5, 1e-12);
  EXPECT_NEAR(at[3], 1.1 * std::cos(at[2]) * 0.5, 1e-12);
  EXPECT_NEAR(at[4], 1.1 * std::sin(at[2]) * 0.5, 1e-12);
  EXPECT_THAT(job.notes, Contains(HasSubstr("; the nearest that has one is x = 0.789")));
}

// s is in no constraint, though M couples it to x; at the centre of the circle Newton's method has no slope.
TEST(StartByNames, LeavesWhatNoConstraintReadsAtZero) {
  const Model model = Model::parse(R"toml(
coordinates = ["s", "x", "z"]
[mechanics]
mass  = [["2", "0.5", "0"], ["0.5", "1", "0"], ["0", "0", "1"]]
force = ["0", "0", "-9.81"]
[constraints]
position = ["x^2 + z^2 - 1"]
)toml",
                                   "circle.toml");
  SimulateRequest request;
  request.times = VectorXd::LinSpaced(2, 0, 0.1);
  request.start = std::map<std::string, double>{{"ds", 0.5}};
  const VectorXd from_centre = prepare_simulation(model, request).start;
  EXPECT_EQ(from_centre[0], 0);
  EXPECT_NEAR(from_centre.segment(1, 2).norm(), 1, 1e-14);
  request.start = std::map<std::string, double>{{"x", 0.6}, {"dz", 0.3}};
  const VectorXd moving = prepare_simulation(model, request).start;
  EXPECT_EQ(moving[0], 0);
  EXPECT_EQ(moving[3], 0);
  EXPECT_NEAR(moving[1] * moving[4] + moving[2] * 0.3, 0, 1e-14);
}

// z = 0, which is taken where it is not given, may be inside the hill
TEST(StartByNames, IsOnTheSurfaceThatItWouldBeBelow) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "z"]
inputs = ["touch"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["0", "-9.81"]
[constraints]
position = [{ expr = "z - 0.3*cos(3*x)", contact = "touch" }]
)toml",
                                   "hill.toml");
  const auto start_at = [&](std::map<std::string, double> given) {
    SimulateRequest request;
    request.start = std::move(given);
    request.times = VectorXd::LinSpaced(2, 0, 0.1);
    return prepare_simulation(model, request).start;
  };
  const VectorXd on_hill = start_at({{"x", -0.5}, {"dx", 2.5}});
  EXPECT_NEAR(on_hill[1], 0.3 * std::cos(1.5), 1e-12);
  EXPECT_NEAR(on_hill[3], 0.9 * std::sin(1.5) * 2.5, 1e-12);
  EXPECT_EQ(on_hill[5], 0) << "the motion tells whether they touch";
  EXPECT_EQ(start_at({{"x", 1}})[1], 0) << "in the air";
  EXPECT_EQ(start_at({{"x", -0.5}, {"z", 0}})[1], 0) << "as given, which the motion refuses";
}

// an angle of many turns where that is the solution
TEST(StartOfALog, MayBeManyTurnsAway) {
  const Model model = Model::parse(R"toml(
coordinates = ["z", { name = "a", angle = true }]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["0", "0"]
[constraints]
position = ["z - 0.01*a"]
)toml",
                                   "winch.toml");
  SimulateRequest request;
  request.start = std::map<std::string, double>{{"z", 30}};
  request.times = VectorXd::LinSpaced(2, 0, 0.1);
  EXPECT_NEAR(prepare_simulation(model, request).start[1], 3000, 1e-10);
}

}  // namespace
}  // namespace gp2
