#include <limits>
#include <utility>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "gp2/jobs/report_job.hpp"
#include "hyperparameter.hpp"

namespace gp2 {
namespace {

using test::hyperparameter;
using testing::AllOf;
using testing::ElementsAre;
using testing::Field;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Not;
using testing::UnorderedElementsAre;

using Level = Advice::Level;

auto advises(Level level, const std::string& text, const std::string& mend) {
  return AllOf(Field(&Advice::level, level), Field(&Advice::text, HasSubstr(text)), Field(&Advice::mend, HasSubstr(mend)));
}

// a fit with nothing to mend
Report good_report() {
  Report report;
  FitReport& fit = report.fit.report;
  fit.converged = true;
  fit.termination = "the projected gradient fell below its tolerance";
  fit.iterations = 20;
  fit.objective = 10;
  for (int k = 0; k < 3; ++k) {
    RestartReport restart;
    restart.objective = 10 + 0.1 * k;
    restart.converged = true;
    fit.restarts.push_back(restart);
  }
  report.relevance = {{"friction", "dq1", 2, 1, 0.5, 0.7}};
  return report;
}

ReportData good_data(const std::string& name) {
  ReportData data;
  data.name = name;
  data.is_test = name == "test";
  data.outputs = {"ddq1"};
  data.rows = {0};
  data.noise_stddev = Eigen::MatrixXd::Constant(1, 1, 0.1);
  data.evaluation.n = 1000;
  data.evaluation.rmse = Eigen::VectorXd::Constant(1, 0.1);
  data.evaluation.coverage95 = 0.95;
  data.evaluation.coverage95_latent = 0.5;
  return data;
}

TEST(Advice, OfAGoodFitIsToTestItOrToLook) {
  Report report = good_report();
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::good, "No problem", "`data`")));
  report.data = {good_data("training"), good_data("test")};
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::good, "No problem", "pictures")));
}

TEST(Advice, TellsWhereAConstraintLetsGo) {
  Report report = good_report();
  report.data = {good_data("training"), good_data("test")};
  report.data[1].states = Eigen::MatrixXd::Zero(7, 50);
  report.data[1].lower_rank = {2, 1, {3, 8}};
  EXPECT_THAT(
      learning_advice(report),
      ElementsAre(advises(Level::warning,
                          "rank 2 but at 2 of 50 states of the test data, where it is as low as 1, first at row 4 of test",
                          "dead centre")));
  report.data[0].lower_rank = std::exchange(report.data[1].lower_rank, {});
  EXPECT_THAT(learning_advice(report),
              ElementsAre(advises(Level::warning, "first at row 4 of the rows that training kept", "dead centre")));
}

TEST(Advice, TellsThatTheOptimiserDidNotConverge) {
  Report report = good_report();
  report.fit.report.converged = false;
  report.fit.report.termination = "the limit of iterations was reached";
  EXPECT_THAT(learning_advice(report),
              ElementsAre(advises(Level::warning, "did not converge: the limit of iterations", "`max_iterations`")));
  report.fit.report.termination = FitReport::interrupted;
  EXPECT_THAT(learning_advice(report), ElementsAre(AllOf(advises(Level::warning, "did not converge: interrupted", "`start`"),
                                                         Field(&Advice::mend, Not(HasSubstr("max_iterations"))))));
}

TEST(Advice, DoesNotBlameAnOptimiserWhoseRestartsAgree) {
  Report report = good_report();
  report.fit.report.converged = false;
  report.fit.report.termination = "the line search could not lower the objective further";
  report.fit.report.restarts[1].objective = 10.0005;
  EXPECT_THAT(learning_advice(report),
              ElementsAre(advises(Level::note, "stopped short of its tolerances: the line search", "2 of 3 restarts")));
  report.fit.report.termination = FitReport::unsettled;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::warning, "did not converge", "")));
}

TEST(Advice, TellsThatNothingWasOptimisedAndThenSaysNothingOfRelevance) {
  Report report = good_report();
  report.fit.report.converged = false;
  report.fit.report.iterations = 0;
  report.relevance = {{"friction", "dq1", 1e6, 1, 1e-6, 1e-6}};
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "Nothing was optimised", "`max_iterations=0`")));
  report.fit.report.termination = FitReport::interrupted;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "Nothing was optimised", "without stopping it")));
  // the best restart is the one that stayed where it began
  report.fit.report.restarts[1].iterations = 5;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::warning, "did not converge", "`start`")));
}

TEST(Advice, TellsOfRestartsThatFailedOrDisagree) {
  Report report = good_report();
  report.fit.report.restarts[1].objective = 15;
  report.fit.report.restarts[2].objective = 12;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "Only one of 3 restarts", "`restarts`")));
  report.fit.report.objective = 5;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "No restart reached", "`restarts`")));
  report.fit.report.objective = 10;
  report.fit.report.restarts[1].objective = std::numeric_limits<double>::infinity();
  report.fit.report.restarts[1].evaluations = 1;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "1 of 3 restarts found no finite start", "bounds")));
  report.fit.report.restarts[1].evaluations = 0;  // as where the fit was interrupted
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "1 of 3 restarts were not begun", "`start`")));
}

TEST(Advice, SaysWhatIsWrongWithTheLogOfATest) {
  Report report = good_report();
  report.data = {good_data("training"), good_data("test")};
  report.data[1].notes = {"warning: test.csv: dx is not the rate of x over t: it lags by 3 rows"};
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::warning, "test.csv: dx is not the rate of x", "")));
}

TEST(Advice, SaysWhatTheFitSaid) {
  Report report = good_report();
  report.notes = {"fitted to 40 of 400, evenly spaced",
                  "warning: p1 ended at its bound, 0.1. It may lie beyond, or the model lacks something"};
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::warning, "p1 ended at its bound, 0.1.",
                                                           "It may lie beyond, or the model lacks something."),
                                                   advises(Level::note, "fitted to 40 of 400, evenly spaced.", "")));
  EXPECT_THAT(learning_advice(report)[1].mend, IsEmpty());
  EXPECT_THAT(learning_advice(report)[0].text, Not(HasSubstr("beyond")));
}

TEST(Advice, LeavesParametersAndNoiseAtTheirLowerBoundToTheNotesOfTheFit) {
  Report report = good_report();
  report.fit.report.hyperparameters = {hyperparameter(Hyperparameter::Kind::parameter, "p1", 0.1, 0.06, 0.1),
                                       hyperparameter(Hyperparameter::Kind::noise_stddev, "noise_stddev(ddq1)", 1e-6, 1e-6, 2)};
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::good, "", "")));
  report.fit.report.hyperparameters[1].value = 2;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "noise_stddev(ddq1) (upper bound, 2)", "Widen")));
}

TEST(Advice, NamesFeaturesThatHardlyMatterButNotThoseWithALinearEffect) {
  Report report = good_report();
  report.relevance.push_back({"friction", "q1", 1e6, 1, 1e-6, 1e-5});
  report.relevance.push_back({"friction", "u1", 1e3, 1, 1e-3, 0.8});  // a long lengthscale and a large signal: linear
  EXPECT_THAT(learning_advice(report), ElementsAre(AllOf(advises(Level::note, "the feature q1 hardly matters", "smaller"),
                                                         Field(&Advice::text, Not(HasSubstr("u1"))))));
  report.relevance = {report.relevance[1]};
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "No feature of 'friction' matters", "known part")));
}

TEST(Advice, ALengthscaleAtItsUpperBoundIsOnlyAnIrrelevantFeature) {
  Report report = good_report();
  report.fit.report.hyperparameters = {hyperparameter(Hyperparameter::Kind::kernel, "lengthscale(q1)", 1e6, 0.05, 1e6)};
  report.relevance.push_back({"friction", "q1", 1e6, 1, 1e-6, 1e-5});
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "q1 hardly matters", "")));
  report.fit.report.hyperparameters.front().value = 0.05;
  EXPECT_THAT(learning_advice(report),
              UnorderedElementsAre(advises(Level::note, "lower bound: lengthscale(q1) (0.05)", "wiggles"),
                                   advises(Level::note, "q1 hardly matters", "")));
}

TEST(Advice, SaysNothingOfWigglesWhereAKernelIsLinear) {
  const auto of_kernel = [](const std::string& kernel, int index, const std::string& name) {
    Report report = good_report();
    report.fit.model = Model::parse(
        "coordinates = ['x']\n[mechanics]\nmass = [['1']]\n[[latent]]\nkernel = '" + kernel + "'\nfeatures = ['x']\n",
        "model.toml");
    report.fit.report.hyperparameters = {hyperparameter(Hyperparameter::Kind::kernel, name, 0.05, 0.05, 1e6)};
    report.fit.report.hyperparameters.front().index = index;
    return learning_advice(report);
  };
  EXPECT_THAT(of_kernel("linear", 0, "lengthscale(x)"), ElementsAre(advises(Level::good, "", "")));
  EXPECT_THAT(of_kernel("se", 0, "lengthscale(x)"), ElementsAre(advises(Level::note, "lower bound", "wiggles")));
  EXPECT_THAT(of_kernel("se + linear", 1, "linear.lengthscale(x)"), ElementsAre(advises(Level::good, "", "")));
  EXPECT_THAT(of_kernel("se + linear", 0, "se.lengthscale(x)"), ElementsAre(advises(Level::note, "lower bound", "wiggles")));
}

TEST(Advice, DoesNotSendToTheModelFileForTheBoundsOfABaseline) {
  Report report = good_report();
  report.fit.report.hyperparameters = {hyperparameter(Hyperparameter::Kind::signal_stddev, "signal_stddev(ddx)", 2, 1e-3, 2)};
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "signal_stddev(ddx) (upper bound, 2)", "Widen")));
  report.fit.prior_options.baseline = Baseline();
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "signal_stddev(ddx)", "of a baseline are fixed")));
}

TEST(Advice, TellsOfDataOffTheConstraintByHowFarTheyAre) {
  Report report = good_report();
  report.data = {good_data("training")};
  report.data[0].violation = ConstraintViolation{1e-9, 1e-9, 1e-9, 3, "q1 - q2"};
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::good, "", "")));
  report.data[0].violation->relative = 1e-4;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "of the training data are off the constraint", "units")));
  report.data[0].violation->relative = 0.3;
  report.data.push_back(good_data("test"));
  report.data[1].violation = ConstraintViolation{1e-3, 1e-3, 1e-3, 5, "q1 - q2"};
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::warning, "of the training and test data", "")));
  EXPECT_THAT(learning_advice(report),
              ElementsAre(advises(Level::warning, "row 4 of the rows that training kept: q1 - q2 = 1e-09, 0.3", "`estimate`")));
}

TEST(Advice, TellsOfColumnsThatFollowFromEachOther) {
  Report report = good_report();
  report.data = {good_data("training")};
  report.data[0].independent = {"ddq1", "ddq3"};
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::warning, "follow from each other", "`observe=ddq1,ddq3`")));
}

TEST(Advice, JudgesTheCoverageOfTheTestByItsSize) {
  Report report = good_report();
  report.data = {good_data("training"), good_data("test")};
  report.data[0].evaluation.coverage95 = 0.5;  // training says nothing
  Evaluation& test = report.data[1].evaluation;
  test.coverage95 = 0.90;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::warning, "Over-confident: 90.0 %", "noise")));
  test.n = 30;  // three standard deviations of the share are 0.12
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::good, "", "")));
  test.n = 1000;
  test.coverage95 = 0.999;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "Too cautious: 99.9 %", "`noise_std=estimate`")));
  report.fit.prior_options.baseline = Baseline();  // which refuses that
  EXPECT_THAT(learning_advice(report),
              ElementsAre(advises(Level::note, "Too cautious: 99.9 %", "the noise is stated too large.")));
  report.fit.prior_options.baseline.reset();
  report.fit.options = R"({"protocol": "paper"})";  // alike
  EXPECT_THAT(learning_advice(report),
              ElementsAre(advises(Level::note, "Too cautious: 99.9 %", "the noise is stated too large.")));
  report.fit.options.clear();
  test.coverage95_latent = 0.95;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "Too cautious: 99.9 %", "free of noise")));
}

TEST(Advice, TellsThatTheTestGoesBeyondTraining) {
  Report report = good_report();
  report.data = {good_data("training"), good_data("test")};
  report.data[1].evaluation.rmse[0] = 0.5;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::warning, "5.0 times those of training", "band")));
  // errors below twice the noise are noise
  report.data[0].evaluation.rmse[0] = 0.01;
  report.data[1].evaluation.rmse[0] = 0.15;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::good, "", "")));
}

TEST(Advice, TellsOfATestThatDeniesAConstraint) {
  Report report = good_report();
  report.data = {good_data("training"), good_data("test")};
  report.data[1].constraint_residuals = {{"z - h*x^2", 50, 9.7, 9.69, 0.2, 10, {3, 4, 5}}};
  EXPECT_THAT(learning_advice(report),
              ElementsAre(advises(Level::warning,
                                  "The test data violate a constraint: measured ddq on A ddq = b: rms residual 9.7 for 'z - "
                                  "h*x^2', mean 9.69, expected 0.2 from the noise: 48 ×",
                                  "units, signs")));
  report.data[1].constraint_residuals[0].rms = report.data[1].constraint_residuals[0].mean = 0.21;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::good, "", "")));
}

TEST(Advice, TellsOfOneErrorFarOutAndOfErrorsThatFollowAFeature) {
  Report report = good_report();
  report.data = {good_data("training"), good_data("test")};
  ReportData& test = report.data[1];
  constexpr int n = 60;
  test.measured = Eigen::MatrixXd::Zero(1, n);
  test.predicted = Eigen::MatrixXd::Zero(1, n);
  test.stddev = Eigen::MatrixXd::Zero(1, n);
  test.noise_stddev = Eigen::MatrixXd::Constant(1, n, 0.1);
  test.measured(0, 16) = 1.3;
  EXPECT_THAT(learning_advice(report),
              ElementsAre(advises(Level::warning, "At row 17 of the test data ddq1 is off by 13 standard deviations", "")));
  // a bow over the feature
  const Eigen::VectorXd feature = Eigen::VectorXd::LinSpaced(n, -1, 1);
  test.measured = (0.6 * feature.array().square() - 0.2).transpose();
  test.features = {{"x", feature}};
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::warning, "Errors of ddq1 in the test data follow x", "shape")));
}

TEST(Advice, DoesNotBlameTheNoiseWhereTheTestHasNone) {
  Report report = good_report();
  report.data = {good_data("training"), good_data("test")};
  Evaluation& test = report.data[1].evaluation;
  report.cross_validation.residuals = {{0, "ddq1", 100, 1, 0.95, 0}};
  test.coverage95 = 1;
  test.rmse[0] = 0.02;
  test.coverage95_latent = 0.99;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::good, "", "")));
  test.coverage95_latent = 0.7;
  EXPECT_THAT(learning_advice(report),
              ElementsAre(advises(Level::warning, "Over-confident: 70.0 % of the test data, which seem", "")));
  report.cross_validation.residuals[0].rms = 0.3;
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::note, "Too cautious: 100.0 %", "`noise_std=estimate`")));
}

TEST(Advice, PutsWarningsFirst) {
  Report report = good_report();
  report.relevance.push_back({"friction", "q1", 1e6, 1, 1e-6, 1e-5});
  report.data = {good_data("training")};
  report.data[0].independent = {"ddq1"};
  EXPECT_THAT(learning_advice(report), ElementsAre(advises(Level::warning, "", ""), advises(Level::note, "", "")));
}

}  // namespace
}  // namespace gp2
