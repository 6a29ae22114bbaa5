#include "gp2/report/report_page.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "apps/command_line.hpp"
#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/jobs/show_job.hpp"

namespace gp2::command {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::HasSubstr;
using testing::Not;

TEST(Coverage, IsTheShareOfMeasurementsWithinTheirIntervals) {
  ReportData data;
  data.rows = {0, 1};
  // errors of 0.5, 1 and 2.5 standard deviations: within 38.3, 68.3 and 98.8 %
  data.measured = MatrixXd::Zero(2, 3);
  data.measured.row(0) << 0.5 * 5, 1.0 * 5, -2.5 * 5;
  data.predicted = MatrixXd::Zero(2, 3);
  data.stddev = MatrixXd::Constant(2, 3, 3);
  data.noise_stddev = MatrixXd::Constant(2, 3, 4);  // hypot(3, 4) = 5
  data.noise_stddev.row(1).setConstant(std::numeric_limits<double>::quiet_NaN());
  VectorXd levels(4);
  levels << 0.3, 0.5, 0.95, 0.99;
  const MatrixXd share = coverage(data, levels);
  ASSERT_EQ(share.cols(), 3);
  const double third = 1.0 / 3;
  EXPECT_TRUE(share.col(0).isApprox(Eigen::Vector4d(0, third, 2 * third, 1)));
  EXPECT_TRUE(share.col(1).array().isNaN().all()) << "an output whose noise is not known";
  EXPECT_EQ(share.col(2), share.col(0)) << "all outputs whose noise is known";
}

TEST(RmseToTruth, LeavesOutStatesWhereTheTruthIsNotKnown) {
  ReportData data;
  data.rows = {1};
  data.predicted = MatrixXd::Zero(2, 3);
  EXPECT_TRUE(std::isnan(data.rmse_to_truth()[0]));
  data.truth = MatrixXd::Constant(2, 3, 2);
  data.truth.col(1).setConstant(std::numeric_limits<double>::quiet_NaN());
  EXPECT_DOUBLE_EQ(data.rmse_to_truth()[0], 2);
}

Model particle(const std::string& constraints) {
  return Model::parse(
      "coordinates = ['x', 'y', 'z']\n[parameters]\nr = 2\n[mechanics]\nmass = [['1','0','0'],['0','1','0'],"
      "['0','0','1']]\n[constraints]\n" +
          constraints + "\n[[latent]]\nkernel = 'se'\nfeatures = ['x']\n",
      "particle.toml");
}

MatrixXd states_at(const MatrixXd& q) {
  MatrixXd states = MatrixXd::Zero(7, q.cols());
  states.topRows(3) = q;
  return states;
}

TEST(ConstraintSurfaceOf, ASphereIsTwoSheetsOnWhichTheConstraintHolds) {
  const Model model = particle("position = ['x^2 + y^2 + z^2 - r^2']");
  MatrixXd q(3, 4);
  q << 0.3, -0.5, 0.2, -0.4,  //
      0.4, -0.2, -0.6, 0.3,   //
      1.8, -1.7, 1.6, -1.9;
  const auto surface = constraint_surface(*model.symbolic_system(), model.system->parameter_values(), states_at(q));
  ASSERT_TRUE(surface);
  EXPECT_EQ(surface->solved, 2) << "the coordinate in which the constraint is never flat over the data";
  ASSERT_EQ(surface->sheets.size(), 2u);
  for (const MatrixXd& sheet : surface->sheets) {
    for (Eigen::Index i = 0; i < sheet.rows(); ++i) {
      for (Eigen::Index j = 0; j < sheet.cols(); ++j) {
        const double x = surface->first_grid[i], y = surface->second_grid[j];
        // the chord of a parabola over one step h of the scan is off by up to h²/4; h = 2.2·3.7/40 = 0.2
        EXPECT_NEAR(x * x + y * y + sheet(i, j) * sheet(i, j), 4, 0.25 * 0.21 * 0.21);
      }
    }
  }
}

TEST(ConstraintSurfaceOf, OtherThanOneFixedConstraintInThreeCoordinatesIsNotDrawn) {
  const MatrixXd q = MatrixXd::Random(3, 5);
  for (const char* constraints :
       {"position = []", "position = ['x - y', 'z']", "position = ['z - t']", "velocity = ['dx - y*dz']"}) {
    const Model model = particle(constraints);
    EXPECT_FALSE(constraint_surface(*model.symbolic_system(), model.system->parameter_values(), states_at(q))) << constraints;
  }
  const Model model = particle("position = ['z - x']");
  EXPECT_TRUE(constraint_surface(*model.symbolic_system(), model.system->parameter_values(), states_at(q)));
  MatrixXd unknown = states_at(q);
  unknown.row(1).setConstant(std::numeric_limits<double>::quiet_NaN());
  EXPECT_FALSE(constraint_surface(*model.symbolic_system(), model.system->parameter_values(), unknown));
}

class ReportOf : public testing::Test {
 protected:
  Report report(const std::string& model, const std::string& generate, const std::string& fit, bool with_test = true) {
    desk.done("gp2 generate models/" + model + ".toml --n 40 --seed 1 " + generate + " -o train.csv");
    desk.done("gp2 generate models/" + model + ".toml --n 30 --seed 2 -o test.csv");
    desk.done("gp2 fit models/" + model + ".toml --data train.csv --restarts 1 " + fit + " -o fit.json");
    std::vector<std::string> notes;
    return collect_reports({{(desk / "fit.json").string()},
                            with_test ? (desk / "test.csv").string() : "",
                            (desk / ("models/" + model + ".toml")).string(),
                            {}},
                           notes)
        .front();
  }
  test::Desk desk;
};

TEST_F(ReportOf, HasTheVeryFiguresOfEvaluate) {
  const Report r = report("surface", "", "--mean force");
  ASSERT_EQ(r.data.size(), 2u);
  const auto json = nlohmann::json::parse(report_json({r}, with_flags))[0];
  for (const auto& [k, file] : {std::pair(0, "train.csv"), std::pair(1, "test.csv")}) {
    const auto told = desk.done(std::string("gp2 evaluate fit.json --json --data ") + file).json();
    const auto& figures = json["data"][static_cast<std::size_t>(k)]["figures"];
    // the fit keeps its data to the bit, and a state's prediction does not depend on the others; a covariance may,
    // in its last digits
    for (const char* key : {"rmse_normalised", "nrmse", "max_constraint_error", "max_constraint_error_fitted", "n"}) {
      EXPECT_EQ(figures[key], told[key]) << key;
    }
    for (const char* key :
         {"nlpd", "coverage50", "coverage80", "coverage95", "nlpd_latent", "coverage50_latent", "coverage95_latent"}) {
      EXPECT_NEAR(figures[key].get<double>(), told[key].get<double>(), 1e-9 * std::abs(told[key].get<double>())) << key;
    }
    EXPECT_EQ(figures["rmse"][2], told["rmse"]["ddq3"]);
    const Evaluation& e = r.data[static_cast<std::size_t>(k)].evaluation;
    const MatrixXd near = pit_counts(r.data[static_cast<std::size_t>(k)], /*far=*/false);
    const MatrixXd far = pit_counts(r.data[static_cast<std::size_t>(k)], /*far=*/true);
    EXPECT_EQ((near + far).sum(), 2 * 3 * e.n) << "each output, and all together";
    EXPECT_LE(((near + far).col(3) / (3 * e.n) - e.pit).norm(), 1e-12);
  }
  EXPECT_EQ(json["left_out"], r.cross_validation.text());
  EXPECT_THAT(r.cross_validation.text(), HasSubstr("in 5 stretches of the log"));
  EXPECT_NEAR(coverage(r.data[1], VectorXd::Constant(1, 0.95))(0, 3), r.data[1].evaluation.coverage95, 1e-12);
  EXPECT_EQ(json["fit"]["nll"], desk.json("fit.json")["report"]["nll"]);
  EXPECT_EQ(json["hyperparameters"].size(), desk.json("fit.json")["hyperparameters"].size());
}

TEST_F(ReportOf, DrawsWhatChangesHoweverFarFromZeroItIs) {
  Report r = report("surface", "", "--mean force --max-iterations 0", /*with_test=*/false);
  ReportData& data = r.data[0];
  constexpr double far = 1e9;
  const MatrixXd measured = data.measured, residual = data.measured - data.predicted;
  data.measured.array() += far;
  data.predicted.array() += far;
  const auto json = nlohmann::json::parse(report_json({r}, with_flags))[0]["data"][0];
  for (Eigen::Index k = 0; k < measured.rows(); ++k) {
    const double range = measured.row(k).maxCoeff() - measured.row(k).minCoeff();
    const double largest = residual.row(k).cwiseAbs().maxCoeff();
    for (Eigen::Index i = 0; i < measured.cols(); ++i) {
      const auto row = static_cast<std::size_t>(k), column = static_cast<std::size_t>(i);
      EXPECT_NEAR(json["measured"][row][column].get<double>() - far, measured(k, i), 1e-4 * range);
      EXPECT_NEAR(json["residual"][row][column].get<double>(), residual(k, i), 1e-5 * largest + 1e-15 * far);
    }
  }
  EXPECT_EQ(json["largest_constraint_error"], data.constraint_error.maxCoeff());
  EXPECT_EQ(json["other_system"], false);
}

TEST_F(ReportOf, KnowsTheTruthAndTheConstraint) {
  const Report r = report("surface", "--noise-std 0.05", "--mean force");
  for (const ReportData& data : r.data) {
    EXPECT_LT(data.rmse_to_truth().maxCoeff(), data.evaluation.rmse.maxCoeff()) << "the truth has no noise";
    EXPECT_LT(data.constraint_error.maxCoeff(), 1e-12);
    EXPECT_DOUBLE_EQ(data.constraint_error.maxCoeff(), data.evaluation.max_constraint_error_fitted);
    EXPECT_EQ(data.features.size(), 9u);
    EXPECT_THAT(data.independent, testing::IsEmpty());
  }
  ASSERT_TRUE(r.surface);
  EXPECT_EQ(r.surface->solved, 2);
  EXPECT_EQ(r.relevance.size(), 9u);
  EXPECT_EQ(r.truth_source, "particle on a surface");
}

TEST_F(ReportOf, ShowsTheForceThatWasLearnedAlongWhatItDependsOn) {
  const Report r = report("surface", "--noise-std 0.01", "--mean force");
  const Posterior posterior = r.fit.posterior();
  const MatrixXd& states = posterior.observations().front().states();
  const std::vector<std::string> entries = r.fit.model.system->state_names();
  ASSERT_FALSE(r.learned.empty());
  EXPECT_LE(r.learned.size(), 6u);
  double largest = std::numeric_limits<double>::infinity();
  for (const LearnedForce& one : r.learned) {
    SCOPED_TRACE(one.along);
    EXPECT_THAT(one.names, testing::ElementsAre("force_q1", "force_q2", "force_q3"));
    const auto k = std::find(entries.begin(), entries.end(), one.along) - entries.begin();
    EXPECT_EQ(one.at[0], states.row(k).minCoeff());
    EXPECT_EQ(one.at[one.at.size() - 1], states.row(k).maxCoeff());
    // where it meets the usual row it is the prediction there
    const auto is_of_it = [&](Eigen::Index i) {
      MatrixXd there = states.col(i).replicate(1, one.at.size());
      there.row(k) = one.at.transpose();
      View view = View::learned_force(*r.fit.model.system);
      view.latent = 0;  // the discrepancy stands beside it
      return posterior.mean(view, there).isApprox(one.mean, 1e-9);
    };
    int n = 0;
    for (Eigen::Index i = 0; i < states.cols(); ++i) n += is_of_it(i) ? 1 : 0;
    EXPECT_EQ(n, 1) << "it is along a row of the data";
    const double effect = (one.mean.rowwise().maxCoeff() - one.mean.rowwise().minCoeff()).norm();
    EXPECT_LE(effect, largest);
    largest = effect;
  }
  const auto curves = nlohmann::json::parse(report_json({r}, with_flags))[0]["learned"];
  EXPECT_EQ(curves.size(), 3 * r.learned.size());
  EXPECT_NEAR(curves[1]["mean"][60], r.learned[0].mean(1, 60), 1e-5 * std::abs(r.learned[0].mean(1, 60)));
}

TEST_F(ReportOf, SaysWhatTheFitSaidAndOfAFileWithoutNotesWhatItsDataTell) {
  desk.done("gp2 generate models/surface.toml --n 40 --seed 1 --noise-std 0.05 -o sound.csv");
  const CsvTable log = CsvTable::read(desk / "sound.csv");
  std::string csv = desk.read("sound.csv");
  const std::vector<std::string>& header = log.header();
  const std::string cell = log.cell(20, static_cast<int>(std::ranges::find(header, "ddq1") - header.begin()));
  csv.replace(csv.find(cell), cell.size(), "30");
  desk.write("train.csv", csv);
  const std::string said = desk.done("gp2 fit models/surface.toml --data train.csv --restarts 1 --mean force -o fit.json").err;
  ASSERT_THAT(said, HasSubstr("six or more standard deviations"));
  FitFile file = FitFile::read(desk / "fit.json");
  ASSERT_TRUE(file.notes);
  for (const std::string& note : *file.notes) EXPECT_THAT(said, HasSubstr(with_flags(note)));
  EXPECT_THAT(desk.done("gp2 show fit.json").out, HasSubstr("six or more standard deviations"));
  std::vector<std::string> notes;
  const Posterior posterior = file.posterior();
  EXPECT_EQ(collect_report(file, posterior, {}, notes).notes, *file.notes);
  file.notes.reset();
  EXPECT_THAT(collect_report(file, posterior, {}, notes).notes, testing::Contains(HasSubstr("six or more standard deviations")));
  desk.done("gp2 update fit.json --data sound.csv -o more.json");
  EXPECT_FALSE(FitFile::read(desk / "more.json").notes) << "they are of the data that there were";
  // and so is the likelihood
  EXPECT_THAT(desk.done("gp2 show more.json").out, HasSubstr(", at the last fit or shoot; rows may have changed since\n"));
  EXPECT_THAT(desk.done("gp2 show fit.json").out, Not(HasSubstr("rows may have changed")));
  file.report.restarts.clear();
  EXPECT_THAT(show(file, {}, with_flags), Not(HasSubstr("rows may have changed"))) << "a checkpoint";
  for (const auto& [name, is_of_these] : {std::pair("fit.json", true), std::pair("more.json", false)}) {
    const Report report = collect_report(desk / name, {}, notes);
    EXPECT_EQ(nlohmann::json::parse(report_json({report}, with_flags))[0]["fit"]["rows_are_those_of_fit"], is_of_these);
  }
}

TEST_F(ReportOf, SeesThatComputedAccelerationsFollowFromEachOther) {
  const Report r = report("surface", "--noise-std 0", "--mean force --max-iterations 0", /*with_test=*/false);
  ASSERT_EQ(r.data.size(), 1u);
  EXPECT_EQ(r.data[0].independent.size(), 2u);
}

TEST_F(ReportOf, TakesTheDerivedAccelerationsOfARawLogForNoMeasurements) {
  // positions alone, with the noise of an encoder
  const auto noise = [](int i) { return 2e-4 * std::sin(37.0 * i * i); };
  desk.done("gp2 simulate models/surface.toml --start q1=0.4,q2=0.8,dq1=0.8,dq2=1 --t-end 2 --dt 0.02 -o motion.csv");
  const CsvTable motion = CsvTable::read(desk / "motion.csv");
  std::string raw = "t,q1,q2,q3,u1,u2,u3\n";
  for (int i = 0; i < motion.n_rows(); ++i) {
    raw += motion.cell(i, motion.find("t"));
    for (int j = 1; j <= 3; ++j)
      raw += fmt::format(",{}", motion.number(i, motion.find(fmt::format("q{}", j))) + noise(3 * i + j));
    for (const char* u : {"u1", "u2", "u3"}) raw += "," + std::string(motion.cell(i, motion.find(u)));
    raw += "\n";
  }
  desk.write("raw.csv", raw);
  desk.done("gp2 fit models/surface.toml --raw raw.csv --mean force --restarts 1 --max-iterations 3 -o raw.json");
  std::vector<std::string> notes;
  const Report report = collect_report(desk / "raw.json", {}, notes);
  ASSERT_TRUE(report.fit.observations.front().has_sums());
  EXPECT_THAT(report.data.front().independent, testing::IsEmpty());
}

// Two wheels that turn far, and a spring between them.
std::string two_wheels(const std::string& features) {
  return "coordinates = ['a', 'b']\n[mechanics]\nmass = [['1', '0'], ['0', '1']]\n[[latent]]\nname = 'spring'\nkernel = 'se'\n"
         "features = [" +
         features + "]\ndirections = { force = [['-1'], ['1']] }\n[noise]\nddq = 0.1\n";
}

std::string two_wheels_log() {
  std::string log = "a,b,da,db,dda,ddb\n";
  for (int i = 0; i < 60; ++i) {
    const double apart = std::sin(i), b = 0.5 * i, db = 10 * std::cos(0.7 * i);
    log += fmt::format("{},{},{},{},{},{}\n", b + 0.3 * apart, b, db + 0.2 * std::cos(2 * i), db, -apart, apart);
  }
  return log;
}

TEST_F(ReportOf, AForceOfDifferencesIsDrawnAlongThemAndOnlyWhereTheDataAre) {
  desk.write("wheels.toml", two_wheels("'a - b', 'da - db'"));
  desk.write("train.csv", two_wheels_log());
  desk.done("gp2 fit wheels.toml --data train.csv --restarts 1 --max-iterations 5 -o fit.json");
  std::vector<std::string> notes;
  const std::vector<LearnedForce> all = learned_forces(FitFile::read(desk / "fit.json").posterior(), &notes);
  EXPECT_THAT(notes, testing::IsEmpty());
  std::vector<std::string> along;
  for (const LearnedForce& one : all) {
    along.push_back(one.along);
    const double low = one.data.minCoeff(), high = one.data.maxCoeff();
    EXPECT_LT(high - low, 1) << "the marks are where the feature was";
    EXPECT_EQ(one.data.size(), 60);
    EXPECT_GE(one.at[0], low - 0.051 * (high - low));
    EXPECT_LE(one.at[100], high + 0.051 * (high - low));
    EXPECT_GT(one.at[100] - one.at[0], 0.9 * (high - low));
    EXPECT_GT((one.at.tail(100) - one.at.head(100)).minCoeff(), 0) << "ascending";
  }
  EXPECT_THAT(along, testing::Contains("a - b"));
  for (const char* entry : {"a", "b", "da", "db"}) EXPECT_THAT(along, Not(testing::Contains(entry)));
  desk.done("gp2 plot fit.json --along 'a - b' -o spring.svg");
  EXPECT_THAT(desk.run("gp2 plot fit.json --along a -o a.svg").err, HasSubstr("there are: a - b"));
}

TEST_F(ReportOf, WhereSeveralFeaturesLeaveTheDataNothingIsDrawnAndTheReportSaysSo) {
  desk.write("wheels.toml", two_wheels("'a - b', 'a - 2*b'"));
  desk.write("train.csv", two_wheels_log());
  desk.done("gp2 fit wheels.toml --data train.csv --restarts 1 --max-iterations 5 -o fit.json");
  std::vector<std::string> notes;
  const Report report = collect_report(desk / "fit.json", {}, notes);
  EXPECT_THAT(report.learned, testing::IsEmpty());
  EXPECT_THAT(report.notes, testing::Contains(HasSubstr("what 'spring' has learned is not drawn along a, b: moved alone, they")));
  EXPECT_THAT(desk.run("gp2 plot fit.json -o spring.svg").err, HasSubstr("nothing to plot: what 'spring' has learned"));
}

TEST_F(ReportOf, SaysWhenAConstraintHolds) {
  desk.write("floor.toml",
             "coordinates = ['x', 'z']\ninputs = ['touch']\n[mechanics]\nmass = [['1', '0'], ['0', '1']]\n[constraints]\n"
             "position = [{ expr = 'z', when = 'touch > 0.5' }]\n[[latent]]\nfeatures = ['dx']\n[noise]\nddq = 0.1\n");
  std::string log = "x,z,dx,dz,touch,ddx\n";
  for (int i = 0; i < 12; ++i) log += fmt::format("{},0,{},0,1,{}\n", 0.1 * i, std::sin(i), -std::sin(i));
  desk.write("train.csv", log);
  desk.done("gp2 fit floor.toml --data train.csv --observe ddx --max-iterations 0 -o fit.json");
  std::vector<std::string> notes;
  const auto json = nlohmann::json::parse(report_json({collect_report(desk / "fit.json", {}, notes)}, with_flags))[0];
  EXPECT_EQ(json["model"]["constraints"][0]["when"], "touch > 0.5");
  EXPECT_EQ(json["model"]["constraints"][0]["contact"], false);
}

TEST_F(ReportOf, ABaselineAndACoordinateThatIsNotReadHaveOneToo) {
  const Report r = report("unicycle", "", "--baseline se --max-iterations 5");
  EXPECT_GT(r.data[1].constraint_error.maxCoeff(), 1e-6) << "a baseline knows no constraint";
  const auto json = nlohmann::json::parse(report_json({r}, with_flags))[0];
  EXPECT_FALSE(json.contains("surface"));
  EXPECT_FALSE(json["data"][0]["columns"].contains("q1")) << "the fit does not keep it";
}

class RolloutOf : public testing::Test {
 protected:
  // of the test, against a fit
  Rollout of(const std::string& test, const std::string& fit = "fit.json") {
    std::vector<std::string> notes;
    return collect_reports({{(desk / fit).string()}, (desk / test).string(), "", {}}, notes).front().data.back().rollout;
  }
  VectorXd column(const std::string& file, const char* name) {
    const CsvTable table = CsvTable::read(desk / file);
    VectorXd values(table.n_rows());
    for (int i = 0; i < table.n_rows(); ++i) values[i] = table.number(i, table.find(name));
    return values;
  }
  void fit_surface() {
    desk.done("gp2 generate models/surface.toml --n 60 --noise-std 0.05 -o train.csv");
    desk.done("gp2 fit models/surface.toml --data train.csv --mean force --restarts 1 -o fit.json");
  }
  test::Desk desk;
};

TEST_F(RolloutOf, AMeasuredMotionIsThatOfSimulate) {
  fit_surface();
  desk.done("gp2 simulate models/surface.toml --start q1=0.4,q2=0.8,dq1=0.8,dq2=1 --t-end 2 --dt 0.05 -o test.csv");
  desk.done("gp2 simulate fit.json --start test.csv --t-end 2 --dt 0.05 -o simulated.csv");
  const Rollout motion = of("test.csv");
  ASSERT_EQ(motion.reason, "");
  ASSERT_EQ(motion.times.size(), 41);
  for (int j = 0; j < 3; ++j) {
    const std::string name = fmt::format("q{}", j + 1);
    EXPECT_TRUE(motion.measured.row(j).transpose().isApprox(column("test.csv", name.c_str()), 1e-14));
    EXPECT_TRUE(motion.simulated.row(j).transpose().isApprox(column("simulated.csv", name.c_str()), 1e-12)) << name;
    EXPECT_EQ(motion.stddev(j, 0), 0) << "all begin at the measured state";
    EXPECT_GT(motion.stddev(j, 40), 0);
  }
  EXPECT_TRUE(motion.simulated_multipliers.row(0).transpose().isApprox(column("simulated.csv", "lambda1"), 1e-12));
  EXPECT_TRUE(motion.simulated_energy.isApprox(column("simulated.csv", "energy"), 1e-12));
  EXPECT_TRUE(motion.energy.isApprox(column("test.csv", "energy"), 1e-12));
  EXPECT_NEAR(motion.multipliers(0, 0), motion.simulated_multipliers(0, 0), 1e-9) << "at the same state";
  EXPECT_EQ(motion.points, std::vector<std::string>{"particle"});
  EXPECT_EQ(motion.measured_points, motion.measured);
  EXPECT_EQ(motion.simulated_points, motion.simulated);
}

TEST_F(RolloutOf, ARobotIsDrawnByItsBodies) {
  if (desk.run("gp2 show models/four_bar.toml").status != 0) GTEST_SKIP() << "built without MuJoCo";
  desk.done("gp2 generate models/four_bar.toml --n 40 -o train.csv");
  desk.done("gp2 fit models/four_bar.toml --data train.csv --restarts 1 --max-iterations 5 -o fit.json");
  desk.done("gp2 simulate models/four_bar.toml --start train.csv --t-end 0.5 --dt 0.05 -o test.csv");
  const Rollout motion = of("test.csv");
  ASSERT_EQ(motion.reason, "");
  EXPECT_EQ(motion.points,
            (std::vector<std::string>{"crank", "coupler", "rocker", "middle", "end", "joint of coupler and rocker"}));
  EXPECT_EQ(motion.lines, (std::vector<std::vector<int>>{{0, 1}, {1, 3}, {1, 4}, {1, 5}, {2, 5}}));
  ASSERT_EQ(motion.measured_points.rows(), 18);
  // upright at 0, about y
  EXPECT_TRUE(motion.measured_points.row(3).isApprox(0.1 * motion.measured.row(0).array().sin().matrix(), 1e-12));
  EXPECT_TRUE(motion.measured_points.row(5).isApprox(0.1 * motion.measured.row(0).array().cos().matrix(), 1e-12));
  EXPECT_TRUE(motion.measured_points.bottomRows(3).isApprox(motion.measured_points.middleRows(12, 3), 1e-12));
}

TEST_F(RolloutOf, AMotionOfTheFitItselfIsNeverLeft) {
  fit_surface();
  const std::string start = " --start q1=0.4,q2=0.8,dq1=0.8,dq2=1 --t-end 4 --dt 0.05 -o ";
  desk.done("gp2 simulate fit.json" + start + "own.csv");
  EXPECT_FALSE(of("own.csv").leaves);
  // of a surface without gravity it is another motion
  desk.write("weightless.toml", test::replaced(desk.read("models/surface.toml"), "g  = 9.81", "g  = 0.01"));
  desk.done("gp2 simulate weightless.toml" + start + "other.csv");
  const Rollout other = of("other.csv");
  ASSERT_TRUE(other.leaves);
  const auto at = std::find(other.times.begin(), other.times.end(), *other.leaves) - other.times.begin();
  for (Eigen::Index j = 0; j < 3; ++j) {
    const auto row = other.measured.row(j);
    const double visible = 0.05 * (row.maxCoeff() - row.minCoeff());
    for (Eigen::Index i = 0; i < at; ++i)
      EXPECT_LE(std::abs(row[i] - other.simulated(j, i)), std::max(visible, 2 * other.stddev(j, i)));
  }
  const double range = other.measured.row(other.leaving).maxCoeff() - other.measured.row(other.leaving).minCoeff();
  EXPECT_GT(std::abs(other.measured(other.leaving, at) - other.simulated(other.leaving, at)), 0.05 * range);
}

TEST_F(RolloutOf, LearnedPotentialsKeepTheEnergyOfASimulatedMotion) {
  desk.write("springs.toml",
             "coordinates = ['x', 'y']\n[mechanics]\nmass = [['2', '0'], ['0', '1']]\npotential = '2*x^2 + 0.5*x^4 - x*y + "
             "1.5*y^2'\n[constraints]\nposition = []\n[[latent]]\nname = 'spring'\nkernel = 'se'\ndirections = 'potential'\n"
             "[truth]\nforce = ['-4*x - 2*x^3 + y', '-3*y + x']\n[noise]\nddq = 0.05\n[sampling]\nx = [-1, 1]\ny = [-1, 1]\n");
  desk.done("gp2 generate springs.toml --n 40 -o train.csv");
  desk.done("gp2 fit springs.toml --data train.csv --restarts 1 -o fit.json");
  desk.done("gp2 simulate springs.toml --start x=0.6,y=-0.3,dx=0,dy=0 --t-end 5 --dt 0.05 -o test.csv");
  desk.done("gp2 simulate fit.json --start test.csv --t-end 5 --dt 0.05 -o simulated.csv");
  const Rollout motion = of("test.csv");
  // what the file says of a force that the fit does not use is no energy of its motion
  EXPECT_TRUE(motion.simulated_energy.isApprox(column("simulated.csv", "energy"), 1e-12));
  ASSERT_EQ(motion.potentials, std::vector<std::string>{"spring"});
  const double exchanged = motion.potential.maxCoeff() - motion.potential.minCoeff();
  EXPECT_GT(exchanged, 0.5);
  EXPECT_LT(motion.simulated_energy.maxCoeff() - motion.simulated_energy.minCoeff(), 1e-4 * exchanged);
  EXPECT_GT(motion.energy.maxCoeff() - motion.energy.minCoeff(), 1e-3 * exchanged) << "what was learned is not the truth";
}

TEST_F(RolloutOf, TimesInOtherUnitsAreConvertedAndVelocitiesInOtherUnitsMakeNoMotion) {
  desk.write("mass.toml",
             "coordinates = ['x']\n[mechanics]\nmass = [['1']]\n[[latent]]\nkernel = 'se'\nfeatures = ['x', 'dx']\n[truth]\n"
             "force = ['-4*x - 0.3*dx']\n[noise]\nddq = 0.05\n[sampling]\nx = [-1, 1]\ndx = [-2, 2]\n");
  desk.done("gp2 generate mass.toml --n 40 -o train.csv");
  desk.done("gp2 fit mass.toml --data train.csv --restarts 1 -o fit.json");
  desk.done("gp2 simulate mass.toml --start x=0.8,dx=0 --t-end 4 --dt 0.05 -o test.csv");  // t, x, dx, ddx
  desk.done("awk 'BEGIN { FS = OFS = \",\" } NR > 1 { $1 *= 1000 } 1' test.csv > milliseconds.csv");
  desk.done("awk 'BEGIN { FS = OFS = \",\" } NR > 1 { $3 *= 57.29578 } 1' test.csv > degrees.csv");
  const Rollout motion = of("test.csv"), in_milliseconds = of("milliseconds.csv");
  ASSERT_EQ(motion.reason, "");
  EXPECT_TRUE(in_milliseconds.times.isApprox(motion.times, 1e-12));
  EXPECT_TRUE(in_milliseconds.simulated.isApprox(motion.simulated, 1e-6));
  EXPECT_THAT(desk.done("gp2 report fit.json --data milliseconds.csv -o report.html").err,
              HasSubstr("t counts 0.001 s, not seconds"));
  EXPECT_THAT(of("degrees.csv").reason, testing::StartsWith("dx is not the rate of x over t: "));
  for (const char* command : {"report fit.json -o report.html", "evaluate fit.json"})
    EXPECT_THAT(desk.done(fmt::format("gp2 {} --data degrees.csv", command)).err,
                HasSubstr("warning: degrees.csv: dx is not the rate of x over t"));
  EXPECT_THAT(desk.done("gp2 evaluate fit.json --data test.csv").err, Not(HasSubstr("is not the rate")));
}

TEST_F(RolloutOf, WhatIsNoMotionSaysWhy) {
  fit_surface();
  desk.done("gp2 generate models/surface.toml --n 20 --seed 2 -o random.csv");
  EXPECT_EQ(of("random.csv").reason, "the data lack t");
  std::vector<std::string> notes;
  const Report report = collect_reports({{(desk / "fit.json").string()}, "", "", {}}, notes).front();
  EXPECT_THAT(report.data.front().rollout.reason, HasSubstr("the data lack t, which the model does not read"));
  desk.done("awk 'NR == 1 { print $0 \",t\" } NR > 1 { print $0 \",\" 7 * NR % 20 }' random.csv > shuffled.csv");
  EXPECT_THAT(of("shuffled.csv").reason, HasSubstr("no 8 of them follow each other in time"));
}

TEST_F(RolloutOf, AMotionThatRunsAwayIsDrawnAsFarAsItWent) {
  desk.write("away.toml",
             "coordinates = ['x']\n[mechanics]\nmass = [['1']]\nforce = ['x^3']\n[constraints]\nposition = []\n[[latent]]\n"
             "kernel = 'se'\nfeatures = ['x']\n[truth]\nforce = ['0']\n[noise]\nddq = 0.1\n[sampling]\nx = [-1, 1]\n");
  desk.done("gp2 generate away.toml --n 20 -o train.csv");
  desk.done("gp2 fit away.toml --data train.csv --mean force --restarts 1 --max-iterations 0 -o fit.json");
  std::string log = "t,x,dx,ddx\n";
  for (int i = 0; i < 40; ++i) log += fmt::format("{},{},3,0\n", 0.05 * i, 3 + 0.15 * i);
  desk.write("test.csv", log);
  const Rollout motion = of("test.csv");
  EXPECT_EQ(motion.reason, "");
  EXPECT_NE(motion.ended, "");
  EXPECT_THAT(motion.ended, Not(HasSubstr("max_steps"))) << "a report has no such option";
  EXPECT_EQ(motion.simulated(0, 0), 3);
  EXPECT_TRUE(std::isnan(motion.simulated(0, 39)));
}

TEST_F(RolloutOf, TheLongestEpisodeIsShownAndAnAngleThatWrapsGoesOn) {
  desk.write("wheel.toml",
             "coordinates = [{ name = 'phi', angle = true }]\n[mechanics]\nmass = [['1']]\n[constraints]\nposition = []\n"
             "[[latent]]\nkernel = 'se'\nfeatures = ['dphi']\n[truth]\nforce = ['-0.1*dphi']\n[noise]\nddq = 0.01\n"
             "[sampling]\ndphi = [-6, 6]\n");
  desk.done("gp2 generate wheel.toml --n 30 -o train.csv");
  desk.done("gp2 fit wheel.toml --data train.csv --restarts 1 -o fit.json");
  // dphi = 5 exp(−0.1 t), phi = 50 (1 − exp(−0.1 t)) as a sensor with one turn tells it
  std::string log = "t,episode,phi,dphi,ddphi\n";
  for (int i = 0; i < 10; ++i) log += fmt::format("{},0,0,0,0\n", 0.1 * i);
  for (int i = 10; i < 70; ++i) {
    const double t = 0.1 * i, dphi = 5 * std::exp(-0.1 * (t - 1));
    log += fmt::format("{},1,{},{},{}\n", t, std::remainder(50 - 10 * dphi + 2, 2 * std::numbers::pi), dphi, -0.1 * dphi);
  }
  desk.write("test.csv", log);
  const Rollout motion = of("test.csv");
  ASSERT_EQ(motion.times.size(), 60);
  EXPECT_DOUBLE_EQ(motion.times[0], 1);
  EXPECT_NEAR(motion.measured(0, 59), 52 - 50 * std::exp(-0.59), 1e-4);
  EXPECT_NEAR(motion.simulated(0, 59), motion.measured(0, 59), 0.1);
  EXPECT_FALSE(motion.leaves);
}

TEST_F(ReportOf, TextOfAModelCannotLeaveTheData) {
  desk.write("hostile.toml", test::replaced(desk.read("models/unicycle.toml"), "\"unicycle\"", "\"</script><b>{{data}}\""));
  desk.done("gp2 generate hostile.toml --n 20 -o train.csv");
  desk.done("gp2 fit hostile.toml --data train.csv --max-iterations 0 -o fit.json");
  std::vector<std::string> notes;
  const std::vector<Report> r = collect_reports({{(desk / "fit.json").string()}, "", "", {}}, notes);
  EXPECT_THAT(report_json(r, with_flags), Not(HasSubstr("<")));
  EXPECT_EQ(nlohmann::json::parse(report_json(r, with_flags))[0]["model"]["name"], "</script><b>{{data}}");
  const std::string page = report_page(r, with_flags);
  EXPECT_THAT(page, HasSubstr("<h1 id=\"title\">&lt;/script&gt;&lt;b&gt;{{data}}</h1>"));
  EXPECT_THAT(page, Not(HasSubstr("<b>")));
}

}  // namespace
}  // namespace gp2::command
