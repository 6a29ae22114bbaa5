// One fit on several processes: mpirun -n 4 gp2 fit.
#include <cstdlib>
#include <string>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"

namespace gp2::test {
namespace {

using testing::HasSubstr;

#ifdef GP2_MPIRUN

class ManyRanks : public testing::Test {
 protected:
  void SetUp() override {
    // a container may have less room for messages, and fewer processors, than the test has processes
    setenv("OMPI_ALLOW_RUN_AS_ROOT", "1", 1);
    setenv("OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "1", 1);
    setenv("OMPI_MCA_btl_vader_single_copy_mechanism", "none", 1);
    desk.done("gp2 generate models/surface.toml --n 900 --seed 3 -o log.csv");
  }
  Outcome on(int n, const std::string& command) {
    return desk.run(fmt::format("{} --oversubscribe -n {} {}", GP2_MPIRUN, n, command));
  }
  const std::string fit = "gp2 fit models/surface.toml --data log.csv --mean force --inducing 30 --threads 1 --max-iterations 4 ";

  Desk desk;
};

TEST_F(ManyRanks, FitTheSameBits) {
  desk.done(fit + "--estimate m --noise-std estimate -o alone.json");
  const std::string alone = desk.read("alone.json");
  for (const int n : {2, 4}) {
    const Outcome outcome = on(n, fit + fmt::format("--estimate m --noise-std estimate -o on_{}.json", n));
    ASSERT_EQ(outcome.status, 0) << outcome.err;
    EXPECT_EQ(desk.read(fmt::format("on_{}.json", n)), alone);
    EXPECT_THAT(outcome.out, HasSubstr("negative log likelihood"));
    EXPECT_EQ(outcome.out.find("negative log likelihood"), outcome.out.rfind("negative log likelihood")) << "said once";
  }
}

TEST_F(ManyRanks, ShareOutTheRunsAndChainsOfAnExactFit) {
  const std::string exact =
      "gp2 fit models/surface.toml --data log.csv --max-points 20 --estimate m --hyperparameters integrate --max-iterations 20 "
      "--threads 1 ";
  desk.done(exact + "-o alone.json");
  for (const int n : {2, 4}) {
    const Outcome outcome = on(n, exact + fmt::format("-o on_{}.json", n));
    ASSERT_EQ(outcome.status, 0) << outcome.err;
    EXPECT_EQ(desk.read(fmt::format("on_{}.json", n)), desk.read("alone.json"));
  }
}

TEST_F(ManyRanks, AnErrorOfAllIsToldOnceAndEndsThem) {
  const Outcome outcome = on(2, "gp2 fit models/surface.toml --data none.csv -o fit.json");
  EXPECT_NE(outcome.status, 0);
  const std::size_t first = outcome.err.find("gp2: error: none.csv");
  EXPECT_NE(first, std::string::npos) << outcome.err;
  EXPECT_EQ(outcome.err.find("none.csv: ", first + 20), std::string::npos) << outcome.err;
}

TEST_F(ManyRanks, WhoReadsOtherDataEndsAll) {
  desk.done("gp2 generate models/surface.toml --n 900 --seed 4 -o other.csv");
  const Outcome outcome =
      desk.run(fmt::format("{0} --oversubscribe -n 1 {1} -o fit.json : -n 1 gp2 fit models/surface.toml --data other.csv "
                           "--mean force --inducing 30 --max-iterations 4 --threads 1 -o fit.json",
                           GP2_MPIRUN, fit));
  EXPECT_NE(outcome.status, 0);
  EXPECT_THAT(outcome.err, HasSubstr("have read different data"));
  EXPECT_FALSE(desk.has("fit.json"));
}

TEST_F(ManyRanks, WhereOneDiesTheCheckpointIsNamed) {
  const std::string long_fit =
      "gp2 fit models/surface.toml --data log.csv --mean force --max-points 60 --threads 1 --restarts 5000 --checkpoint "
      "last.json "
      "-o fit.json";
  const Outcome outcome =
      desk.run(fmt::format("{0} --oversubscribe -n 1 {1} : -n 1 sh -c 'echo $$ > pid; exec {1}' &\n"
                           "for k in $(seq 600); do [ -e last.json ] && break; sleep 0.1; done\n"
                           "kill -9 $(cat pid)\nwait $!",
                           GP2_MPIRUN, long_fit));
  EXPECT_NE(outcome.status, 0);
  EXPECT_THAT(outcome.err, HasSubstr("gp2: last.json holds the best so far; --start last.json continues from there"));
  EXPECT_FALSE(desk.has("fit.json"));
  desk.done("gp2 predict last.json --states log.csv -o prediction.csv");
}

TEST_F(ManyRanks, AreForFitsOnly) {
  EXPECT_THAT(on(2, "gp2 check models/surface.toml").err, HasSubstr("mpirun is for gp2 fit; start this command alone"));
}

#else

TEST(Ranks, WithoutMpiSeveralAreRefused) {
  Desk desk;
  desk.done("gp2 generate models/surface.toml --n 12 --seed 3 -o log.csv");
  setenv("OMPI_COMM_WORLD_SIZE", "2", 1);
  const Outcome outcome = desk.run("gp2 fit models/surface.toml --data log.csv -o fit.json");
  unsetenv("OMPI_COMM_WORLD_SIZE");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, HasSubstr("built without MPI"));
}

#endif

}  // namespace
}  // namespace gp2::test
