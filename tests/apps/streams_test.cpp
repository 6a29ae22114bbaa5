#include <csignal>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "gp2/files/fit_file.hpp"

// stdout and stderr that cannot be written: nothing is lost but what could not be said.
namespace gp2::test {
namespace {

using testing::HasSubstr;

class Streams : public testing::Test {
 protected:
  void SetUp() override { desk.done("gp2 generate models/surface.toml --n 40 -o train.csv"); }

  const std::string fit_line = "gp2 fit models/surface.toml --data train.csv --restarts 1 --max-iterations 3 -o fit.json";
  Desk desk;
};

TEST_F(Streams, AResultIsWrittenWhereNothingCanBeSaid) {
  desk.done(fit_line);
  const std::string fit = desk.read("fit.json"), predict = "gp2 predict fit.json --states train.csv --cov std -o prediction.csv";
  desk.done(predict);
  const std::string prediction = desk.read("prediction.csv");
  for (const char* stderr_is : {"2>/dev/full", "2>&-", "2>&- 1>&- 0>&-", "2>&1 | true"}) {
    desk.done(std::string("rm prediction.csv; ") + predict + " " + stderr_is);
    EXPECT_EQ(desk.read("prediction.csv"), prediction) << stderr_is;
  }
  desk.done("rm fit.json; " + fit_line + " 2>/dev/full");
  EXPECT_NO_THROW(FitFile::read(desk / "fit.json"));
  EXPECT_EQ(desk.json("fit.json")["hyperparameters"], nlohmann::json::parse(fit)["hyperparameters"]);
}

TEST_F(Streams, AnInterruptedFitIsSavedWhereNothingCanBeSaid) {
  const std::string line =
      "timeout --preserve-status -s TERM 6 gp2 fit models/surface.toml --data train.csv --restarts 20000 -o ";
  EXPECT_EQ(desk.run(line + "full.json 2>/dev/full").status, 128 + SIGTERM);
  EXPECT_EQ(FitFile::read(desk / "full.json").report.termination, FitReport::interrupted);
  // both streams go to a program that has ended, as of Ctrl-C in "gp2 fit … 2>&1 | tee log"
  desk.run("{ " + line + "pipe.json 2>&1; } | true");
  EXPECT_EQ(FitFile::read(desk / "pipe.json").report.termination, FitReport::interrupted);
}

TEST_F(Streams, AnErrorThatCannotBeSaidKeepsItsExitCode) {
  for (const char* line :
       {"gp2 frobnicate", "gp2 fit models/surface.toml --data absent.csv -o fit.json", "gp2 check absent.toml"}) {
    for (const char* stderr_is : {" 2>/dev/full", " 2>&-"}) EXPECT_EQ(desk.run(line + std::string(stderr_is)).status, 2) << line;
  }
}

TEST_F(Streams, AResultThatCannotBePrintedIsAnError) {
  for (const char* line :
       {"gp2 show models/surface.toml", "gp2 --help", "gp2 fit --help", "gp2 --version", "gp2 check models/surface.toml"}) {
    const Outcome full = desk.run(line + std::string(" >/dev/full"));
    EXPECT_EQ(full.status, 2) << line;
    EXPECT_THAT(full.err, HasSubstr("gp2: error: standard output: cannot be written: No space left on device")) << line;
    const Outcome closed = desk.run(line + std::string(" >&-"));
    EXPECT_EQ(closed.status, 2) << line;
    EXPECT_THAT(closed.err, HasSubstr("gp2: error: standard output: cannot be written: Bad file descriptor")) << line;
  }
  // the fit is written first
  EXPECT_EQ(desk.run(fit_line + " >/dev/full").status, 2);
  EXPECT_NO_THROW(FitFile::read(desk / "fit.json"));
}

TEST_F(Streams, AReaderThatHasSeenEnoughEndsItAsOtherPrograms) {
  const Outcome outcome = desk.run("{ sleep 0.3; gp2 show models/surface.toml; echo $? >status; } | true");
  EXPECT_EQ(desk.read("status"), "141\n");
  EXPECT_EQ(outcome.err, "");
}

TEST_F(Streams, ALogFromAPipeIsPredictedAsItsFile) {
  desk.done(fit_line);
  desk.done("gp2 predict fit.json --states train.csv --cov full -o file.csv");
  desk.done("cat train.csv | gp2 predict fit.json --states /dev/stdin --cov full -o pipe.csv");
  EXPECT_EQ(desk.read("pipe.csv"), desk.read("file.csv"));
  EXPECT_NE(desk.read("file.csv"), "");
}

TEST_F(Streams, ALogThatChangesBetweenReadingAndWritingIsRefused) {
  desk.done(fit_line);
  desk.done("gp2 generate models/surface.toml --n 3000 -o long.csv && mkfifo prediction");
  // what reads the predictions changes the log when it has seen the first of them
  desk.run(
      "(gp2 predict fit.json --states long.csv -o prediction 2>err; echo $? >status) & "
      "{ head -c 1 >/dev/null; echo >>long.csv; cat >/dev/null; } <prediction; wait");
  EXPECT_EQ(desk.read("status"), "2\n");
  EXPECT_THAT(desk.read("err"), HasSubstr("long.csv: changed while it was read"));
}

}  // namespace
}  // namespace gp2::test
