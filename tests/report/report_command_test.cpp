#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"

namespace gp2::test {
namespace {

using testing::HasSubstr;
using testing::Not;

class ReportCommand : public testing::Test {
 protected:
  void SetUp() override {
    desk.done("gp2 generate models/unicycle.toml --n 20 -o train.csv");
    desk.done("gp2 fit models/unicycle.toml --data train.csv --max-iterations 0 -o fit.json");
  }
  Desk desk;
};

TEST_F(ReportCommand, ExplainsItselfWithAnExample) {
  const Outcome help = desk.done("gp2 report --help");
  for (const char* part : {"--data", "--truth", "--map", "Example:\n  gp2 report"}) EXPECT_THAT(help.out, HasSubstr(part));
}

TEST_F(ReportCommand, WritesOnePageThatNeedsNothingElse) {
  const Outcome outcome = desk.done("gp2 report fit.json --data train.csv --truth models/unicycle.toml -o report.html");
  EXPECT_EQ(outcome.out, "");
  EXPECT_THAT(outcome.err, HasSubstr("report.html: report of 'unicycle'"));
  const std::string page = desk.read("report.html");
  EXPECT_THAT(page, testing::StartsWith("<!doctype html>"));
  for (const char* outside : {"src=\"http", "href=\"http", "@import", "url(http"}) EXPECT_THAT(page, Not(HasSubstr(outside)));
  EXPECT_THAT(page, HasSubstr("Permission is hereby granted, free of charge")) << "the licence of uPlot";
}

TEST_F(ReportCommand, IsTheSameForTheSameFiles) {
  desk.done("gp2 report fit.json -o a.html");
  desk.done("gp2 report fit.json -o b.html");
  EXPECT_EQ(desk.read("a.html"), desk.read("b.html"));
}

TEST_F(ReportCommand, PutsSeveralFitsOnOnePage) {
  desk.done("gp2 fit models/unicycle.toml --data train.csv --mean force --max-iterations 0 -o other.json");
  const Outcome outcome = desk.done("gp2 report fit.json other.json --data train.csv -o report.html");
  EXPECT_THAT(outcome.err, HasSubstr("report of 'unicycle' and 'unicycle'"));
  for (const char* label : {"\"label\":\"fit.json\"", "\"label\":\"other.json\""})
    EXPECT_THAT(desk.read("report.html"), HasSubstr(label));
  EXPECT_THAT(desk.run("gp2 report fit.json other.json -o other.json").err, HasSubstr("is the input"));
}

TEST_F(ReportCommand, SaysWithinWhatHyperparametersWereDrawn) {
  desk.done("gp2 generate models/duffing.toml --n 12 -o duffing.csv");
  desk.done("gp2 fit models/duffing.toml --data duffing.csv --restarts 1 --hyperparameters integrate -o drawn.json");
  desk.done("gp2 report drawn.json -o drawn.html");
  desk.done("gp2 report fit.json -o fit.html");
  for (const char* part : {"\"drawn95\":[", "\"draws\":{", "\"n_chains\":8", "\"n\":25"})
    EXPECT_THAT(desk.read("drawn.html"), HasSubstr(part));
  EXPECT_THAT(desk.read("fit.html"), HasSubstr("\"draws\":null"));
  EXPECT_THAT(desk.read("fit.html"), Not(HasSubstr("\"drawn95\":[")));
}

TEST_F(ReportCommand, FindsColumnsOfTheTestByOtherNames) {
  const std::string log = desk.read("train.csv");
  const std::size_t line = log.find('\n');
  std::string header = log.substr(0, line);
  header = replaced(header, "ddq3", "alpha");
  desk.write("other.csv", header + log.substr(line));
  EXPECT_THAT(desk.done("gp2 report fit.json --data other.csv -o report.html").err,
              HasSubstr("other.csv: not compared: ddq3, which it lacks"));
  desk.done("gp2 report fit.json --data other.csv --map alpha=ddq3 -o report.html");
}

TEST_F(ReportCommand, RefusesWhatDoesNotFitAndWritesNothing) {
  desk.write("no_fit.json", "{}");
  desk.write("no_accelerations.csv", "q1\n1\n");
  std::string untrue = desk.read("models/unicycle.toml");
  untrue.erase(untrue.find("[truth]"), untrue.find("[sampling]") - untrue.find("[truth]"));
  desk.write("untrue.toml", untrue);
  const std::pair<const char*, const char*> cases[] = {
      {"nowhere.json -o report.html", "nowhere.json"},
      {"no_fit.json -o report.html", "not a fit written by gp2"},
      {"fit.json --data nowhere.csv -o report.html", "nowhere.csv"},
      {"fit.json --data no_accelerations.csv -o report.html", "no_accelerations.csv"},
      {"fit.json --truth nowhere.toml -o report.html", "nowhere.toml"},
      {"fit.json --truth models/surface.toml -o report.html", "coordinates and inputs must be the same"},
      {"fit.json --truth untrue.toml -o report.html", "has no [truth]"},
      {"fit.json --map a=q1 -o report.html", "--map names columns of --data"},
      {"fit.json -o nowhere/report.html", "there is no folder 'nowhere'"},
      {"fit.json -o ''", "-o: expected the name of a file, got ''"},
  };
  for (const auto& [arguments, text] : cases) {
    const Outcome outcome = desk.run(std::string("gp2 report ") + arguments);
    EXPECT_EQ(outcome.status, 2) << arguments;
    EXPECT_THAT(outcome.err, HasSubstr(text)) << arguments;
    EXPECT_FALSE(desk.has("report.html")) << arguments;
  }
}

TEST_F(ReportCommand, RefusesATruthThatIsNowhereFinite) {
  // a truth that reads what the fit does not keep
  std::string far = desk.read("models/unicycle.toml");
  const std::size_t place = far.find("acceleration = [", far.find("[truth]"));
  far.insert(place + std::string("acceleration = [").size(), "\"q1\", \"0\", \"0\"]\n# [");
  desk.write("far.toml", far);
  const Outcome outcome = desk.run("gp2 report fit.json --truth far.toml -o report.html");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, HasSubstr("not finite at any state of the data"));
  // with the column in the test's log there is something to show
  desk.done("awk 'NR == 1 { print $0 \",q1\" } NR > 1 { print $0 \",1\" }' train.csv > test.csv");
  desk.done("gp2 report fit.json --truth far.toml --data test.csv -o report.html");
}

TEST_F(ReportCommand, AFitThatObservedNoAccelerationHasAPageWithoutPictures) {
  auto json = without_checksum(desk.json("fit.json"));
  json["observations"][0]["view"] = "unconstrained";
  auto& values = json["observations"][0]["values"];
  for (const char* name : {"q1", "q2", "q3"}) {
    values[std::string("abar_") + name] = values[std::string("dd") + name];
    values.erase(std::string("dd") + name);
  }
  desk.write("fit.json", json.dump());
  desk.done("gp2 report fit.json -o report.html");
  EXPECT_THAT(desk.read("report.html"), HasSubstr("\"data\":[]"));
}

}  // namespace
}  // namespace gp2::test
