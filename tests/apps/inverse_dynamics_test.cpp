#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"

namespace gp2::test {
namespace {

using Eigen::MatrixXd;
using testing::HasSubstr;

class InverseDynamicsCommand : public testing::Test {
 protected:
  void SetUp() override {
    desk.done("gp2 generate models/arm_on_moving_plane.toml --n 30 --seed 1 -o train.csv");
    desk.done("gp2 generate models/arm_on_moving_plane.toml --n 8 --seed 2 -o test.csv");
    desk.done(
        "gp2 fit models/arm_on_moving_plane.toml --data train.csv --mean force --restarts 1 --max-iterations 20 -o fit.json");
    // what the fit itself says can be reached
    desk.done("gp2 predict fit.json --states test.csv -o predicted.csv");
    desk.done("sed 's/ddshoulder_input,ddelbow_input/measured1,measured2/' predicted.csv >wanted.csv");
  }
  const std::vector<std::string> ddq = {"ddshoulder", "ddelbow"}, inputs = {"tau1", "tau2"};
  Desk desk;
};

TEST_F(InverseDynamicsCommand, PredictingWithTheInputsGivesWhatWasWanted) {
  const Outcome outcome = desk.done("gp2 predict fit.json --states wanted.csv --inverse-dynamics --cov full -o inputs.csv");
  EXPECT_THAT(outcome.err, HasSubstr("inputs.csv: inputs at 8 states"));
  const CsvTable found = desk.table("inputs.csv");
  const MatrixXd std = columns(found, {"tau1_std", "tau2_std"}), variance = columns(found, {"cov_tau1_tau1", "cov_tau2_tau2"});
  EXPECT_LE((std.cwiseAbs2() - variance).cwiseAbs().maxCoeff(), 1e-12 * variance.maxCoeff());
  EXPECT_GT(std.minCoeff(), 0);
  desk.done("gp2 predict fit.json --states inputs.csv -o reached.csv");
  const MatrixXd wanted = columns(desk.table("wanted.csv"), ddq), reached = columns(desk.table("reached.csv"), ddq);
  EXPECT_LE((wanted - reached).cwiseAbs().maxCoeff(), 1e-10 * (1 + wanted.cwiseAbs().maxCoeff()));
  EXPECT_LE(columns(found, {"ddshoulder_missed", "ddelbow_missed"}).cwiseAbs().maxCoeff(),
            1e-10 * (1 + wanted.cwiseAbs().maxCoeff()));
}

TEST_F(InverseDynamicsCommand, SaysWhatIsMissed) {
  // the plane moves: no acceleration of both that is 0
  desk.done(
      "sed 's/ddshoulder/a/;s/ddelbow/b/' wanted.csv | awk -F, 'NR==1{print $0\",ddshoulder,ddelbow\"} NR>1{print $0\",0,0\"}' "
      ">still.csv");
  const Outcome outcome = desk.done("gp2 predict fit.json --states still.csv --inverse-dynamics -o inputs.csv");
  EXPECT_THAT(outcome.err, HasSubstr("warning: still.csv: no inputs produce the accelerations at 8 of 8 rows"));
  EXPECT_GT(columns(desk.table("inputs.csv"), {"ddshoulder_missed"}).norm(), 1e-3);
}

TEST_F(InverseDynamicsCommand, AnAccelerationOfZeroIsProducedToRounding) {
  desk.done(
      "sed 's/ddshoulder/a/;s/ddelbow/b/' wanted.csv | awk -F, 'NR==1{print $0\",ddshoulder\"} NR>1{print $0\",0\"}' >still.csv");
  const Outcome outcome = desk.done("gp2 predict fit.json --states still.csv --inverse-dynamics -o inputs.csv");
  EXPECT_THAT(outcome.err, testing::Not(HasSubstr("no inputs produce")));
  EXPECT_LE(columns(desk.table("inputs.csv"), {"ddshoulder_missed"}).cwiseAbs().maxCoeff(), 1e-9);
}

TEST_F(InverseDynamicsCommand, NamesInputsThatTheAccelerationsLeaveOpen) {
  EXPECT_THAT(desk.done("gp2 predict fit.json --states wanted.csv --inverse-dynamics -o inputs.csv").err,
              HasSubstr("wanted.csv: the desired accelerations do not determine tau1, tau2 at 8 of 8 rows"));
  desk.done("gp2 generate models/unicycle.toml --n 8 --seed 1 -o log.csv");
  desk.done("gp2 fit models/unicycle.toml --data log.csv --mean force --restarts 1 --max-iterations 5 -o unicycle.json");
  const auto said = [&] { return desk.done("gp2 predict unicycle.json --states log.csv --inverse-dynamics -o inputs.csv").err; };
  EXPECT_THAT(said(), testing::Not(HasSubstr("do not determine")));
  desk.done("sed -i '1s/ddq[12]/x&/g' log.csv");  // the turn alone, of which both inputs are read
  EXPECT_THAT(said(), HasSubstr("do not determine u1, u2 at 8 of 8 rows"));
}

TEST_F(InverseDynamicsCommand, AsksForNothingUnusualWhereOneInputDoesWhatIsWanted) {
  desk.done("gp2 generate models/unicycle.toml --n 50 --seed 1 -o log.csv");
  desk.done("gp2 fit models/unicycle.toml --data log.csv --mean force -o unicycle.json");
  desk.done("gp2 generate models/unicycle.toml --n 30 --seed 2 --noise-std 0 -o other.csv");
  desk.done("sed -i '1s/ddq[23]/x&/g' other.csv");
  desk.done("gp2 predict unicycle.json --states other.csv --inverse-dynamics --cov std -o inputs.csv");
  const CsvTable found = desk.table("inputs.csv");
  // the torque was 0.5 N m at most, and turns the wheel alone
  EXPECT_LE(columns(found, {"u2"}).cwiseAbs().maxCoeff(), 0.05);
  EXPECT_LE(columns(found, {"u2_std"}).cwiseAbs().maxCoeff(), 0.05);
  desk.done("gp2 predict unicycle.json --states inputs.csv -o reached.csv");
  const MatrixXd wanted = columns(desk.table("other.csv"), {"ddq1"});
  EXPECT_LE((wanted - columns(desk.table("reached.csv"), {"ddq1"})).cwiseAbs().maxCoeff(), 1e-10);
}

TEST_F(InverseDynamicsCommand, ReadsWhatSensorsOfConstraintsSay) {
  desk.done(R"sh(cat >floor.toml <<'END'
coordinates = ["x", "z"]
inputs      = ["touch", "u"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["u", "-9.81"]
[constraints]
position = [{ expr = "z", contact = "touch" }]
[[latent]]
kernel   = "se"
features = ["dx"]
[noise]
ddq = 0.01
[truth]
force = ["-0.5*dx", "0"]
[sampling]
x     = [-1, 1]
z     = 0
dx    = [-1, 1]
dz    = 0
touch = [0, 1]
u     = [-1, 1]
END
gp2 generate floor.toml --n 30 --seed 1 -o log.csv
gp2 fit floor.toml --data log.csv --mean force -o floor.json
gp2 predict floor.json --states log.csv -o predicted.csv
sed '1s/ddx_input,ddz_input/measured1,measured2/' predicted.csv >wanted.csv)sh");
  const Outcome outcome = desk.done("gp2 predict floor.json --states wanted.csv --inverse-dynamics -o inputs.csv");
  EXPECT_THAT(outcome.err, testing::Not(HasSubstr("no inputs produce")));
  EXPECT_THAT(outcome.err, testing::Not(HasSubstr("do not determine")));
  const MatrixXd expected = columns(desk.table("log.csv"), {"touch", "u"});
  EXPECT_LE((columns(desk.table("inputs.csv"), {"touch", "u"}) - expected).cwiseAbs().maxCoeff(), 1e-9);
  desk.done("sed '1s/touch/untold/' wanted.csv >blind.csv");
  const Outcome blind = desk.run("gp2 predict floor.json --states blind.csv --inverse-dynamics -o inputs.csv");
  EXPECT_EQ(blind.status, 2);
  EXPECT_THAT(blind.err, HasSubstr("blind.csv: missing column 'touch'"));
}

TEST_F(InverseDynamicsCommand, RefusesWhatDoesNotGoWithIt) {
  const auto refusal = [&](const std::string& options) {
    const Outcome outcome = desk.run("gp2 predict fit.json --inverse-dynamics -o inputs.csv " + options);
    EXPECT_EQ(outcome.status, 2) << options;
    return outcome.err;
  };
  EXPECT_THAT(refusal("--states wanted.csv --view force"),
              HasSubstr("--inverse-dynamics replaces a view: leave out --view, --latent, --dt and --samples"));
  desk.done("cut -d, -f1-6 train.csv | sed 's/dd/x/g' >bare.csv");
  EXPECT_THAT(refusal("--states bare.csv"), HasSubstr("has none of the columns ddshoulder, ddelbow, the desired accelerations"));
}

}  // namespace
}  // namespace gp2::test
