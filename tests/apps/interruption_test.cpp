#include <array>
#include <chrono>
#include <csignal>
#include <fstream>
#include <functional>
#include <set>
#include <thread>

#include <fcntl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "gp2/files/fit_file.hpp"

// Signals sent to the command, as by a person at a terminal or by a batch system.
namespace gp2::test {
namespace {

using testing::HasSubstr;

/// The command while it runs, started on a desk with signals as a terminal leaves them.
class Running {
 public:
  Running(const Desk& desk, const std::vector<std::string>& arguments, int ignored = 0) : desk_(desk), pid_(fork()) {
    if (pid_ != 0) return;
    for (const int signal : {SIGINT, SIGTERM, SIGHUP}) std::signal(signal, signal == ignored ? SIG_IGN : SIG_DFL);
    std::vector<char*> argv = {const_cast<char*>("gp2")};
    for (const std::string& argument : arguments) argv.push_back(const_cast<char*>(argument.c_str()));
    argv.push_back(nullptr);
    const bool there = chdir(desk.path().c_str()) == 0;
    const int out = open(".stdout", O_WRONLY | O_CREAT | O_TRUNC, 0666),
              err = open(".stderr", O_WRONLY | O_CREAT | O_TRUNC, 0666);
    if (there && dup2(out, 1) == 1 && dup2(err, 2) == 2) execv(GP2_COMMAND, argv.data());
    _exit(127);
  }
  ~Running() {
    if (ended_) return;
    kill(pid_, SIGKILL);
    waitpid(pid_, nullptr, 0);
  }
  Running(const Running&) = delete;
  Running& operator=(const Running&) = delete;

  void send(int signal) const { ASSERT_EQ(kill(pid_, signal), 0); }
  /// Until it handles the signal itself, as a fit does once it optimises.
  void wait_until_it_handles(int signal) const {
    for (int k = 0; k < 6000; ++k) {
      std::ifstream status("/proc/" + std::to_string(pid_) + "/status");
      for (std::string line; std::getline(status, line);) {
        if (line.starts_with("SigCgt:") && (std::stoull(line.substr(7), nullptr, 16) >> (signal - 1) & 1) != 0) return;
      }
      pause(0.01);
    }
    FAIL() << "the signal is not handled within a minute";
  }
  static void pause(double seconds) { std::this_thread::sleep_for(std::chrono::duration<double>(seconds)); }
  /// How it ended: as waitpid tells.
  int end() {
    int status = 0;
    EXPECT_EQ(waitpid(pid_, &status, 0), pid_);
    ended_ = true;
    return status;
  }
  [[nodiscard]] bool is_running() const { return waitpid(pid_, nullptr, WNOHANG) == 0; }
  [[nodiscard]] std::string err() const { return desk_.read(".stderr"); }

 private:
  const Desk& desk_;
  pid_t pid_;
  bool ended_ = false;
};

std::set<std::string> files(const Desk& desk) {
  std::set<std::string> names;
  for (const auto& entry : std::filesystem::directory_iterator(desk.path())) names.insert(entry.path().filename());
  return names;
}

class Interrupted : public testing::TestWithParam<int> {};
INSTANTIATE_TEST_SUITE_P(BySignal, Interrupted, testing::Values(SIGINT, SIGTERM, SIGHUP));

TEST_P(Interrupted, AFitSavesTheBestSoFarAndSaysSo) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 60 -o train.csv");
  Running fit(desk, {"fit", "models/surface.toml", "--data", "train.csv", "--restarts", "5000", "-o", "fit.json"});
  fit.wait_until_it_handles(GetParam());
  Running::pause(1);  // some evaluations, also under sanitizers on a busy machine; all of them take minutes
  fit.send(GetParam());
  const int status = fit.end();
  ASSERT_TRUE(WIFEXITED(status)) << "killed by " << WTERMSIG(status);
  EXPECT_EQ(WEXITSTATUS(status), 128 + GetParam());
  EXPECT_THAT(fit.err(), HasSubstr("gp2: interrupted by signal " + std::to_string(GetParam()) + " ("));
  EXPECT_THAT(fit.err(), HasSubstr("): fit.json holds the best so far, not converged; --start fit.json continues from there"));
  EXPECT_THAT(desk.read(".stdout"), HasSubstr("interrupted after "));
  const FitFile saved = FitFile::read(desk / "fit.json");
  EXPECT_FALSE(saved.report.converged);
  EXPECT_EQ(saved.report.termination, FitReport::interrupted);
  EXPECT_EQ(desk.json("fit.json")["options"]["restarts"], 5000);

  // it predicts, and can be gone on from, in place
  desk.done("gp2 predict fit.json --states train.csv -o prediction.csv");
  const std::string again = "gp2 fit models/surface.toml --data train.csv --restarts 1 --start fit.json -o fit.json --json";
  EXPECT_LE(desk.done(again).json()["nll"], saved.report.negative_log_likelihood + 1);
}

TEST_P(Interrupted, ASimulationSavesTheMotionUpToThere) {
  const Desk desk;
  Running simulation(desk,
                     {"simulate", "models/duffing.toml", "--start", "q1=0.4", "--t-end", "1e6", "--dt", "1", "-o", "motion.csv"});
  simulation.wait_until_it_handles(GetParam());
  Running::pause(0.5);
  simulation.send(GetParam());
  const int status = simulation.end();
  ASSERT_TRUE(WIFEXITED(status)) << "killed by " << WTERMSIG(status);
  EXPECT_EQ(WEXITSTATUS(status), 128 + GetParam()) << simulation.err();
  EXPECT_THAT(simulation.err(), HasSubstr("gp2: interrupted by signal " + std::to_string(GetParam()) + " ("));
  EXPECT_THAT(simulation.err(), HasSubstr("): motion.csv holds the motion up to there"));
  const CsvTable motion = CsvTable::read(desk / "motion.csv");
  ASSERT_GT(motion.n_rows(), 2);
}

TEST(InterruptedTwice, AFitEndsAtOnceAndLeavesTheOldFile) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 1500 -o train.csv");
  desk.write("fit.json", "what was here before\n");
  const std::set<std::string> before = files(desk);
  // what is under way is given up within some milliseconds, and the second signal comes before
  Running fit(desk, {"fit", "models/surface.toml", "--data", "train.csv", "-o", "fit.json"});
  fit.wait_until_it_handles(SIGINT);
  fit.send(SIGINT);
  fit.send(SIGTERM);
  const int status = fit.end();
  ASSERT_TRUE(WIFSIGNALED(status)) << WEXITSTATUS(status) << fit.err();
  EXPECT_TRUE(WTERMSIG(status) == SIGTERM || WTERMSIG(status) == SIGINT) << WTERMSIG(status);
  EXPECT_EQ(desk.read("fit.json"), "what was here before\n");
  EXPECT_EQ(files(desk), before);
}

TEST(Killed, AFitLeavesItsCheckpointWhichAnotherGoesOnFrom) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 60 -o train.csv");
  Running fit(desk, {"fit", "models/surface.toml", "--data", "train.csv", "--restarts", "5000", "--checkpoint", "last.json", "-o",
                     "fit.json"});
  for (int k = 0; k < 6000 && !desk.has("last.json"); ++k) Running::pause(0.01);
  Running::pause(0.2);
  fit.send(SIGKILL);
  ASSERT_TRUE(WIFSIGNALED(fit.end())) << fit.err();
  EXPECT_FALSE(desk.has("fit.json"));
  const FitFile saved = FitFile::read(desk / "last.json");
  EXPECT_EQ(saved.report.termination, FitReport::interrupted);
  desk.done("gp2 predict last.json --states train.csv -o prediction.csv");
  desk.done(
      "gp2 fit models/surface.toml --data train.csv --restarts 1 --hyperparameters optimise --start last.json "
      "--checkpoint last.json -o last.json");
  EXPECT_LE(FitFile::read(desk / "last.json").report.objective, saved.report.objective);
}

TEST(InterruptedTwice, AFitSaysWhereItsCheckpointIs) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 60 -o train.csv");
  Running fit(desk, {"fit", "models/surface.toml", "--data", "train.csv", "--restarts", "5000", "--checkpoint", "last.json", "-o",
                     "fit.json"});
  for (int k = 0; k < 6000 && !desk.has("last.json"); ++k) Running::pause(0.01);
  fit.send(SIGINT);
  fit.send(SIGTERM);
  const int status = fit.end();
  // what is under way may be given up before the second signal comes
  if (WIFSIGNALED(status)) {
    EXPECT_THAT(fit.err(), HasSubstr("gp2: last.json holds the best so far; --start last.json continues from there\n"));
  } else {
    EXPECT_EQ(FitFile::read(desk / "fit.json").report.termination, FitReport::interrupted);
  }
}

TEST(InterruptedOnce, ASignalThatWasIgnoredStaysIgnored) {
  const Desk desk;
  desk.done("gp2 generate models/surface.toml --n 200 -o train.csv");
  Running fit(desk, {"fit", "models/surface.toml", "--data", "train.csv", "--restarts", "5000", "-o", "fit.json"}, SIGHUP);
  fit.wait_until_it_handles(SIGTERM);
  fit.send(SIGHUP);
  Running::pause(0.3);
  EXPECT_TRUE(fit.is_running());
  fit.send(SIGTERM);
  EXPECT_EQ(WEXITSTATUS(fit.end()), 128 + SIGTERM);
}

TEST(InterruptedOnce, OtherCommandsLeaveTheOldFile) {
  const Desk desk;
  desk.done("gp2 generate models/duffing.toml --n 100 -o train.csv");
  desk.write("old.csv", "what was here before\n");
  const std::set<std::string> before = files(desk);
  Running command(desk, {"generate", "models/surface.toml", "--n", "10000000", "-o", "old.csv"});
  Running::pause(0.5);
  command.send(SIGTERM);
  const int status = command.end();
  ASSERT_TRUE(WIFSIGNALED(status)) << command.err();
  EXPECT_EQ(desk.read("old.csv"), "what was here before\n");
  EXPECT_EQ(files(desk), before);
}

}  // namespace
}  // namespace gp2::test
