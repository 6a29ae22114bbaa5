#include "gp2/data/log_reader.hpp"

#include <cmath>

#include <gmock/gmock.h>

#include "gp2/model.hpp"
#include "io_testing.hpp"

namespace gp2 {
namespace {

using test::input_error_of;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;

/// A system with these coordinates (as TOML) and the inputs u1, u2 and u.
Model model_of(const std::string& coordinates) {
  return Model::parse("coordinates = " + coordinates +
                          "\ninputs = [\"u1\", \"u2\", \"u\"]\n[mechanics]\nmass = [[\"1\", \"0\"], [\"0\", \"1\"]]\n",
                      "model.toml");
}

class LogReaderTest : public testing::Test {
 protected:
  /// state entry `name` of the only data row, with the others not read
  double state(const std::string& log, const std::string& name, const std::map<std::string, std::string>& columns = {}) {
    const CsvTable table = CsvTable::parse(log, "log.csv");
    LogReader reader(table, *model.system, columns);
    const std::vector<std::string> names = model.system->state_names();
    std::vector<bool> reads;
    for (const std::string& other : names) reads.push_back(other == name);
    const Eigen::MatrixXd states = reader.states(reads);
    double found = NAN;
    for (std::size_t k = 0; k < names.size(); ++k) {
      if (reads[k]) {
        found = states(static_cast<Eigen::Index>(k), 0);
      } else {
        EXPECT_TRUE(std::isnan(states(static_cast<Eigen::Index>(k), 0))) << names[k] << " is not read";
      }
    }
    return found;
  }

  double value(const std::string& log, const std::string& name, const std::map<std::string, std::string>& columns = {}) {
    const CsvTable table = CsvTable::parse(log, "log.csv");
    return LogReader(table, *model.system, columns).values({name})(0, 0);
  }

  const Model model = model_of("[\"q1\", \"q2\"]");
};

TEST_F(LogReaderTest, RefusesNumbersThatNothingCanBeComputedWith) {
  EXPECT_EQ(state("q1\n1e100\n", "q1"), 1e100);
  EXPECT_EQ(input_error_of([&] { state("q1\n-1e300\n", "q1"); }),
            "log.csv:2: column 'q1': -1e+300 is too large: at most 1e+100 can be computed with");
  EXPECT_THAT(input_error_of([&] { value("u1\n2e120\n", "u1"); }), HasSubstr("is too large"));
}

TEST_F(LogReaderTest, ReadsNoColumnAsTwoNames) {
  const CsvTable table = CsvTable::parse("q1,dq1,ddq1\n1,2,3\n", "log.csv");
  LogReader reader(table, *model.system, {{"q2", "q1"}});
  const std::string error = input_error_of([&] { static_cast<void>(reader.values({"q1", "q2"})); });
  EXPECT_EQ(error, "log.csv: column 'q1' is read as q1 and as q2; each needs a column of its own (`map=LOGNAME=q2`)");
  // where q1 itself is not read there is no doubt
  LogReader other(table, *model.system, {{"q2", "q1"}});
  EXPECT_EQ(other.values({"q2", "dq2"}).col(0), Eigen::Vector2d(1, 2));
}

TEST_F(LogReaderTest, FindsColumnsInAnyOrderAndReportsThoseItLeaves) {
  const CsvTable table = CsvTable::parse("remark,dq2,q1,ddq1,q2,t\nfirst,4,1,7,2,0\nsecond,5,2,8,3,1\n", "log.csv");
  LogReader reader(table, *model.system);
  //                                            q1    q2    dq1    dq2   t      u1     u2     u
  const Eigen::MatrixXd states = reader.states({true, true, false, true, false, false, false, false});
  EXPECT_EQ(states.rows(), 8);
  EXPECT_EQ(states.col(0).head(2), Eigen::Vector2d(1, 2));
  EXPECT_EQ(states.col(1).head(2), Eigen::Vector2d(2, 3));
  EXPECT_EQ(states.row(3), Eigen::RowVector2d(4, 5));
  EXPECT_TRUE(states.row(2).array().isNaN().all());
  EXPECT_TRUE(states.bottomRows(4).array().isNaN().all());
  EXPECT_EQ(reader.values({"ddq1"}), Eigen::RowVector2d(7, 8));
  EXPECT_THAT(reader.unused_columns(), ElementsAre("remark", "t"));
  EXPECT_THAT(reader.notes(), IsEmpty());
}

TEST_F(LogReaderTest, ReadsSeveralValuesInTheOrderAskedFor) {
  const CsvTable table = CsvTable::parse("ddq1,ddq2\n1,2\n", "log.csv");
  EXPECT_EQ(LogReader(table, *model.system).values({"ddq2", "ddq1"}), Eigen::Vector2d(2, 1));
}

TEST_F(LogReaderTest, UnderstandsTheUsualOtherNames) {
  for (const char* name : {"qd2", "v2", "qvel2", "q2_dot"}) EXPECT_EQ(state(std::string(name) + "\n7\n", "dq2"), 7) << name;
  for (const char* name : {"qdd2", "a2", "qacc2", "q2_ddot"}) EXPECT_EQ(value(std::string(name) + "\n7\n", "ddq2"), 7) << name;
  EXPECT_EQ(state("tau2\n7\n", "u2"), 7);
  EXPECT_EQ(state("tau\n7\n", "u"), 7);
  EXPECT_EQ(state("time\n7\n", "t"), 7);
  EXPECT_EQ(state("timestamp\n7\n", "t"), 7);
}

TEST_F(LogReaderTest, SaysWhichOtherNamesItTook) {
  const CsvTable table = CsvTable::parse("q1,v1,time\n1,2,3\n", "log.csv");
  LogReader reader(table, *model.system);
  static_cast<void>(reader.states({true, false, true, false, true, false, false, false}));
  EXPECT_THAT(reader.notes(), ElementsAre("column 'v1' taken as dq1", "column 'time' taken as t"));
  EXPECT_THAT(reader.unused_columns(), IsEmpty());
}

TEST_F(LogReaderTest, WarnsOfAGivenColumnThatIsMissingWhereOthersAreThere) {
  const auto notes_of = [&](const std::string& header) {
    const CsvTable table = CsvTable::parse(header + "\n1,2\n", "log.csv");
    LogReader reader(table, *model.system, {{"q1", "theta"}, {"q2", "phi"}});
    static_cast<void>(reader.states({true, true, false, false, false, false, false, false}));
    return reader.notes();
  };
  EXPECT_THAT(notes_of("theta,phi"), ElementsAre("column 'theta' taken as q1", "column 'phi' taken as q2"));
  EXPECT_THAT(notes_of("q2,theta"),
              ElementsAre("warning: log.csv: no column 'phi', which is to be q2: column 'q2' is read instead",
                          "column 'theta' taken as q1"));
  EXPECT_THAT(notes_of("q1,q2"), IsEmpty());
}

TEST_F(LogReaderTest, PrefersTheNameItselfToOtherNames) {
  EXPECT_EQ(state("v1,dq1\n1,2\n", "dq1"), 2);
  EXPECT_EQ(state("dq1,v1\n1,2\n", "dq1"), 1);
}

TEST_F(LogReaderTest, PrefersTheGivenColumnToTheNameItself) {
  EXPECT_EQ(state("q1,theta\n1,2\n", "q1", {{"q1", "theta"}}), 2);
  EXPECT_EQ(state("q1,other\n1,2\n", "q1", {{"q1", "theta"}}), 1);
}

TEST_F(LogReaderTest, ARenamedCoordinateBringsItsDerivatives) {
  const std::map<std::string, std::string> columns = {{"q2", "theta"}};
  EXPECT_EQ(state("dtheta\n7\n", "dq2", columns), 7);
  EXPECT_EQ(state("theta_dot\n7\n", "dq2", columns), 7);
  EXPECT_EQ(value("ddtheta\n7\n", "ddq2", columns), 7);
  EXPECT_EQ(value("theta_ddot\n7\n", "ddq2", columns), 7);
  // unless they are given a name of their own
  EXPECT_EQ(state("dtheta,omega\n1,7\n", "dq2", {{"q2", "theta"}, {"dq2", "omega"}}), 7);
}

TEST_F(LogReaderTest, TwoCoordinatesMayTradeNames) {
  const std::map<std::string, std::string> columns = {{"q1", "q2"}, {"q2", "q1"}};
  EXPECT_EQ(state("q1,q2\n1,2\n", "q1", columns), 2);
  EXPECT_EQ(state("dq1,dq2\n1,2\n", "dq2", columns), 1);
}

TEST_F(LogReaderTest, AMissingColumnIsRefusedWithWhatWasTriedAndWhatThereIs) {
  EXPECT_EQ(
      input_error_of([&] { state("q1,remark\n1,x\n", "dq2"); }),
      "log.csv: missing column 'dq2' (looked for dq2, qd2, v2, qvel2, q2_dot); the file has: q1, remark. It has no "
      "velocities: gp2 derive computes them from positions over time, as a fit of a raw log does; or give `map=LOGNAME=dq2`");
  // others are there: this one may have another name
  EXPECT_THAT(input_error_of([&] { state("q1,dq1,omega\n1,2,3\n", "dq2"); }), HasSubstr("omega. Rename it, or give `map="));
  EXPECT_THAT(input_error_of([&] { state("dq1\n1\n", "q2"); }), HasSubstr("dq1. Rename it, or give `map="));
  EXPECT_THAT(input_error_of([&] { state("t,q1\n0,1\n", "q2"); }), HasSubstr("q1. It has no velocities: gp2 derive"));
  EXPECT_THAT(
      input_error_of([&] { value("q1,q2,dq1,dq2\n1,2,3,4\n", "ddq1"); }),
      HasSubstr("It has no accelerations: gp2 derive computes them from positions over time, as a fit of a raw log does; or "
                "give `map=LOGNAME=ddq1`"));
  EXPECT_THAT(input_error_of([&] {
                state("q1\n1\n", "q2", {{"q2", "theta"}});
              }),
              HasSubstr("(looked for theta, q2); the file has: q1."));
}

TEST_F(LogReaderTest, ABadCellIsRefusedOnlyInColumnsThatAreRead) {
  EXPECT_EQ(state("q1,q2\n1,x\n", "q1"), 1);
  EXPECT_EQ(input_error_of([&] { state("q1,q2\n1,x\n", "q2"); }), "log.csv:2: column 'q2': 'x' is not a finite number");
  EXPECT_EQ(input_error_of([&] { value("ddq1\nnan\n", "ddq1"); }), "log.csv:2: column 'ddq1': 'nan' is not a finite number");
  EXPECT_EQ(
      input_error_of([&] { state("q1,q2\n1,2\nq1,q2\n3,4\n", "q1"); }),
      "log.csv:3: column 'q1': 'q1' is not a finite number: the header again: are these files that were joined? Remove the line");
}

TEST_F(LogReaderTest, KnowsWhatIsThereWithoutReadingIt) {
  const CsvTable table = CsvTable::parse("q1,a2\n1,2\n", "log.csv");
  const LogReader reader(table, *model.system);
  EXPECT_TRUE(reader.has("q1"));
  EXPECT_TRUE(reader.has("ddq2"));
  EXPECT_FALSE(reader.has("dq1"));
  EXPECT_THAT(reader.unused_columns(), ElementsAre("q1", "a2"));
}

TEST(LogReader, ANameOfTheModelIsNoOtherNameForSomethingElse) {
  const Model model = model_of("[\"q1\", \"v1\"]");
  const CsvTable table = CsvTable::parse("q1,v1\n1,2\n", "log.csv");
  LogReader reader(table, *model.system);
  EXPECT_TRUE(reader.has("v1"));
  EXPECT_FALSE(reader.has("dq1"));
}

TEST(LogReader, AnyCoordinateHasDotNames) {
  const Model model = model_of("[\"shoulder\", \"elbow\"]");
  const CsvTable table = CsvTable::parse("elbow_dot,elbow_ddot\n1,2\n", "log.csv");
  LogReader reader(table, *model.system);
  EXPECT_TRUE(reader.has("delbow"));
  EXPECT_EQ(reader.values({"ddelbow"})(0, 0), 2);
}

}  // namespace
}  // namespace gp2
