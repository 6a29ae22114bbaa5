#include <cmath>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"

// Every command on a model with a massless coordinate, and what there is none of.
namespace gp2 {
namespace {

using test::Desk;
using test::Outcome;
using testing::AllOf;
using testing::HasSubstr;
using testing::Not;

const std::string rod = "models/massless_rod.toml";

TEST(MasslessRod, PassesThroughEveryCommand) {
  const Desk desk;
  EXPECT_THAT(desk.done("gp2 check " + rod).out,
              AllOf(HasSubstr("ok       mass matrix: singular at 100 of 100 states, rank 2 of 3"), Not(HasSubstr("warning")),
                    Not(HasSubstr("ERROR"))));
  desk.done("gp2 show " + rod);
  desk.done("gp2 generate " + rod + " --n 60 --seed 1 -o log.csv");
  desk.done("gp2 generate " + rod + " --n 40 --seed 2 --noise-std 0 -o test.csv");
  const Outcome fit = desk.done("gp2 fit " + rod + " --data log.csv --mean force --seed 1 --restarts 2 -o fit.json");
  EXPECT_THAT(fit.err, Not(HasSubstr("warning")));
  // the noise-free accelerations spread over some 10 m/s²
  const nlohmann::json evaluation = desk.done("gp2 evaluate fit.json --data test.csv --json").json();
  EXPECT_LT(evaluation.at("rmse").at("ddtheta").get<double>(), 0.5) << evaluation.dump();
  EXPECT_LT(evaluation.at("max_constraint_error").get<double>(), 1e-9) << evaluation.dump();

  // the force of the rod on the ball and of the ball on the rod: Aᵀλ does no work along x = l sin θ, z = −l cos θ
  desk.done("gp2 predict fit.json --states test.csv --view constraint-force -o force.csv");
  const CsvTable force = desk.table("force.csv"), states = desk.table("test.csv");
  const auto number = [](const CsvTable& table, int row, const std::string& name) { return table.number(row, table.find(name)); };
  for (int i = 0; i < states.n_rows(); ++i) {
    const double theta = number(states, i, "theta");
    const double along = 0.6 * (number(force, i, "fc_x") * std::cos(theta) + number(force, i, "fc_z") * std::sin(theta));
    EXPECT_NEAR(along + number(force, i, "fc_theta"), 0, 1e-9 * (1 + std::abs(along)));
  }
  desk.done("gp2 predict fit.json --states test.csv --view multipliers -o multipliers.csv");
  desk.done("gp2 simulate " + rod + " --start theta=1 --t-end 1 -o motion.csv");
  desk.done("gp2 simulate fit.json --start theta=1 --t-end 1 -o learned.csv");
  desk.done("gp2 report fit.json -o report.html");
  EXPECT_THAT(desk.read("report.html"), HasSubstr("\"unconstrained\":[]"));
}

TEST(MasslessRod, HasNoUnconstrainedAccelerationAndTheErrorsSaySo) {
  const Desk desk;
  desk.done("gp2 generate " + rod + " --n 12 --seed 1 -o log.csv");
  desk.done("gp2 fit " + rod + " --data log.csv --max-iterations 0 -o fit.json");
  const auto refused = [&](const std::string& line) {
    const Outcome outcome = desk.run("gp2 " + line);
    EXPECT_EQ(outcome.status, 2) << line;
    return outcome.err + outcome.out;
  };
  EXPECT_THAT(
      refused("predict fit.json --states log.csv --view unconstrained -o out.csv"),
      HasSubstr("the mass matrix M is singular, so that there is no M⁻¹, but the view is of the unconstrained acceleration ā "
                "at state 1 (x = "));
  EXPECT_THAT(refused("fit " + rod + " --data log.csv --prior acceleration -o out.json"),
              AllOf(HasSubstr("log.csv: data row 1: the mass matrix M is singular"),
                    HasSubstr("the latent 'unknown force' acts on the unconstrained acceleration ā: let it act on forces")));
  // a baseline has no mechanics
  desk.done("gp2 fit " + rod + " --data log.csv --baseline se -o baseline.json");
  desk.write("loose.toml", test::replaced(desk.read(rod), "\"x - l*sin(theta)\", \"z + l*cos(theta)\"", "\"x - 0.1*theta^2\""));
  desk.write("rigid.toml", test::replaced(desk.read(rod), "directions = \"force\"", "directions = \"acceleration\""));
  EXPECT_THAT(refused("check rigid.toml --data log.csv"),
              HasSubstr("ERROR    the mass matrix M is singular, so that there is no M⁻¹"));
  // of a constraint that does not see the angle at one state
  desk.write("level.csv", "x,z,theta,dx,dz,dtheta,u1,ddx,ddz,ddtheta\n0.1,0,1,0,0,0,0,0,0,0\n0,0,0,0,0,0,0,0,0,0\n");
  EXPECT_THAT(refused("fit loose.toml --data level.csv -o out.json"),
              HasSubstr("level.csv: data row 2: the mass matrix M is singular, and nothing determines ddq along theta: only a "
                        "constraint that acts there, or a mass, does"));
}

}  // namespace
}  // namespace gp2
