#include "gp2/report/report_page.hpp"

#include <cmath>
#include <limits>

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "apps/command_line.hpp"
#include "command.hpp"

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

TEST_F(ReportOf, SeesThatComputedAccelerationsFollowFromEachOther) {
  const Report r = report("surface", "--noise-std 0", "--mean force --max-iterations 0", /*with_test=*/false);
  ASSERT_EQ(r.data.size(), 1u);
  EXPECT_EQ(r.data[0].independent.size(), 2u);
}

TEST_F(ReportOf, ABaselineAndACoordinateThatIsNotReadHaveOneToo) {
  const Report r = report("unicycle", "", "--baseline se --max-iterations 5");
  EXPECT_GT(r.data[1].constraint_error.maxCoeff(), 1e-6) << "a baseline knows no constraint";
  const auto json = nlohmann::json::parse(report_json({r}, with_flags))[0];
  EXPECT_FALSE(json.contains("surface"));
  EXPECT_FALSE(json["data"][0]["columns"].contains("q1")) << "the fit does not keep it";
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
