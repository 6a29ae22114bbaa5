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

// Each command by names of files, and with - for one of them: the same is written and printed.
TEST_F(Streams, ADashIsStandardInputOrOutputInEveryCommand) {
  desk.done(fit_line);
  desk.done("gp2 simulate models/surface.toml --start q1=0.3,dq2=0.5 --t-end 1 --dt 0.01 -o motion.csv");
  desk.done("gp2 generate models/unicycle.toml --n 20 -o unicycle.csv");
  struct Case {
    std::string line;   // with IN for the file that is read
    std::string input;  // OUT: what is written
  };
  const std::string start = "--start q1=0.3,dq2=0.5 --t-end 0.2 ";
  for (const auto& [line, input] : {
           Case{"gp2 show IN", "models/surface.toml"},
           Case{"gp2 show IN --json", "fit.json"},
           Case{"gp2 check IN --data train.csv", "models/surface.toml"},
           Case{"gp2 check models/surface.toml --data IN", "train.csv"},
           Case{"gp2 generate IN --n 5 -o OUT", "models/surface.toml"},
           Case{"gp2 derive IN --model models/surface.toml -o OUT", "motion.csv"},
           Case{"gp2 resample IN --model models/surface.toml -n 5 -o OUT", "train.csv"},
           Case{"gp2 predict fit.json --states IN --cov std -o OUT", "train.csv"},
           Case{"gp2 predict IN --states train.csv -o OUT", "fit.json"},
           Case{"gp2 simulate IN " + start + "-o OUT", "fit.json"},
           Case{"gp2 simulate IN " + start + "-o OUT", "models/surface.toml"},
           Case{"gp2 simulate fit.json " + start + "--system IN -o OUT", "models/surface.toml"},
           Case{"gp2 simulate fit.json --start IN --t-start 0 --t-end 0.2 -o OUT", "motion.csv"},
           Case{"gp2 evaluate fit.json --data IN", "train.csv"},
           Case{"gp2 evaluate IN --data train.csv --json", "fit.json"},
           Case{"gp2 update IN --data train.csv -o OUT", "fit.json"},
           Case{"gp2 report IN -o OUT", "fit.json"},
           Case{"gp2 export IN --name surface -o folder && cat folder/surface.c", "fit.json"},
       }) {
    SCOPED_TRACE(line);
    const auto filled = [&, &line = line](const std::string& in, const std::string& out) {
      std::string text = line;
      text.replace(text.find("IN"), 2, in);
      if (const std::size_t at = text.find("OUT"); at != std::string::npos) text.replace(at, 3, out);
      return text;
    };
    // what names a file, when it was written
    const auto neutral = [&, &input = input](std::string text) {
      for (const std::string& name : {input, std::string("/dev/stdin")}) {
        for (std::size_t at = text.find(name); at != std::string::npos; at = text.find(name))
          text.replace(at, name.size(), "FILE");
      }
      const std::size_t date = text.find("\"file_date\":\"");
      if (date != std::string::npos) text.erase(date, 25);
      return text;
    };
    const bool is_written = line.find("OUT") != std::string::npos;
    desk.done("rm -f by_name");
    const Outcome by_name = desk.done(filled(input, "by_name"));
    const std::string expected = neutral(is_written ? desk.read("by_name") : by_name.out);
    EXPECT_FALSE(expected.empty());
    EXPECT_EQ(neutral(desk.done("cat " + input + " | { " + filled("-", "-") + "; }").out), expected);
    EXPECT_EQ(neutral(desk.done("{ " + filled("-", "-") + "; } <" + input).out), expected);
  }

  // a fit says how long it took
  const Outcome piped = desk.done("cat train.csv | gp2 fit models/surface.toml --data - --restarts 1 --max-iterations 3 -o -");
  EXPECT_EQ(piped.json()["hyperparameters"], desk.json("fit.json")["hyperparameters"]);
  EXPECT_THAT(piped.err, HasSubstr("negative log likelihood"));
  desk.done(
      "gp2 fit models/surface.toml --data -@models/surface.toml --data train.csv --max-iterations 0 -o two.json <train.csv");
  EXPECT_EQ(desk.json("two.json")["data_source"], "/dev/stdin@models/surface.toml, train.csv");
}

TEST_F(Streams, WhatElseStandsInAFileOfStandardOutputStays) {
  desk.done(
      "{ echo before; gp2 generate models/surface.toml --n 2 -o -; echo after; } >both.csv; gp2 generate models/surface.toml --n "
      "2 -o one.csv");
  EXPECT_EQ(desk.read("both.csv"), "before\n" + desk.read("one.csv") + "after\n");
}

TEST_F(Streams, OneStreamIsOneFile) {
  desk.done(fit_line);
  const auto refusal = [&](const std::string& line) {
    const Outcome outcome = desk.run(line + " <train.csv");
    EXPECT_EQ(outcome.status, 2) << line;
    return outcome.err;
  };
  EXPECT_THAT(refusal("gp2 predict - --states - -o out.csv"),
              HasSubstr("standard input is read once, but - stands for several files: name all others"));
  EXPECT_THAT(refusal("gp2 fit models/surface.toml --data - --json -o -"),
              HasSubstr("--json prints to standard output, which is the file too: name a file"));
  EXPECT_THAT(refusal("gp2 fit models/surface.toml --raw train.csv --smoothed - -o -"),
              HasSubstr("standard output is one file, but - stands for several: name all others"));
  EXPECT_THAT(refusal("gp2 fit models/surface.toml --data - --checkpoint - -o out.json"),
              HasSubstr("--checkpoint is rewritten repeatedly: name a file instead of -"));
  EXPECT_THAT(refusal("gp2 export fit.json -o -"), HasSubstr("cannot be made"));
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
