// Data that deny the model are not believed without a word, and data that do not are.
#include <fmt/format.h>
#include <gmock/gmock.h>

#include "base/random.hpp"
#include "gp2/jobs/check_job.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/simulation/generate.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "jobs/data_of_model.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using testing::Contains;
using testing::HasSubstr;
using testing::Not;

using Data = test::LogData;

Data data_of(const std::string& file, std::uint64_t seed) { return test::drawn_log(file, 60, seed); }

std::vector<std::string> notes_of_fit(const Data& data, Prior::Mean mean = Prior::Mean::force) {
  FitRequest request;
  request.model = *data.model;
  request.logs = {{data.table()}};
  request.problem.mean = mean;
  request.restarts = 1;
  request.max_iterations = 60;
  return run_fit(prepare_fit(std::move(request))).notes;
}

std::vector<std::string> findings_of(const Data& data, Finding::Level level) {
  const CsvTable log = data.table();
  std::vector<std::string> texts;
  for (const Finding& finding : check(*data.model, &log)) {
    if (finding.level == level) texts.push_back(finding.text);
  }
  return texts;
}

constexpr const char* of_fit = "values lie farther than noise from what all others predict";
constexpr const char* of_constraint = "measured ddq on A ddq = b: rms residual";

TEST(Residuals, OfSoundDataAreNoise) {
  for (const char* file : {"models/surface.toml", "models/unicycle.toml"}) {
    for (const std::uint64_t seed : {11U, 12U, 13U}) {
      SCOPED_TRACE(fmt::format("{}, seed {}", file, seed));
      const Data data = data_of(file, seed);
      EXPECT_THAT(findings_of(data, Finding::Level::good), Contains(HasSubstr(", expected 0.")));
      EXPECT_THAT(findings_of(data, Finding::Level::warning), Not(Contains(HasSubstr("measured ddq"))));
      EXPECT_THAT(findings_of(data, Finding::Level::error), testing::IsEmpty());
      const std::vector<std::string> notes = notes_of_fit(data);
      EXPECT_THAT(notes, Not(Contains(HasSubstr(of_fit))));
      EXPECT_THAT(notes, Not(Contains(HasSubstr(of_constraint))));
      EXPECT_THAT(notes, Not(Contains(HasSubstr("residuals go on from row to row"))));
    }
  }
}

TEST(Residuals, TellOfGravityLeftInASensor) {
  Data data = data_of("models/surface.toml", 14);
  data.accelerations.row(2).array() += 9.81;
  EXPECT_THAT(findings_of(data, Finding::Level::error), Contains(testing::AllOf(HasSubstr(of_constraint), HasSubstr("mean -9.8"),
                                                                                HasSubstr(" ×; "), HasSubstr("gravity"))));
  const std::vector<std::string> notes = notes_of_fit(data);
  EXPECT_THAT(notes, Contains(testing::AllOf(testing::StartsWith("warning: "), HasSubstr(of_constraint), HasSubstr("gravity"))));
  EXPECT_THAT(notes, Contains(testing::AllOf(HasSubstr(of_fit), HasSubstr("ddq3"))));
}

TEST(Residuals, OfATestLogAreTold) {
  FitRequest request;
  request.model = *data_of("models/surface.toml", 16).model;
  request.logs = {{data_of("models/surface.toml", 16).table()}};
  request.restarts = 1;
  request.max_iterations = 5;
  const FitOutcome fit = run_fit(prepare_fit(std::move(request)));
  Data data = data_of("models/surface.toml", 17);
  EXPECT_THAT(evaluate(fit.file, fit.posterior, data.table(), {}).notes, Not(Contains(HasSubstr(of_constraint))));
  data.accelerations.row(2).array() += 9.81;
  EXPECT_THAT(
      evaluate(fit.file, fit.posterior, data.table(), {}).notes,
      Contains(testing::AllOf(testing::StartsWith("warning: log.csv: "), HasSubstr(of_constraint), HasSubstr("gravity"))));
}

TEST(Residuals, TellOfAColumnInAnotherUnit) {
  Data data = data_of("models/unicycle.toml", 15);
  data.accelerations.row(0) *= 10;
  EXPECT_THAT(findings_of(data, Finding::Level::error), Contains(HasSubstr(of_constraint)));
  EXPECT_THAT(notes_of_fit(data), Contains(HasSubstr(of_constraint)));
}

// a motion whose measured accelerations have errors that last
struct LastingErrors {
  static constexpr double noise = 0.1;
  Data data;
  MatrixXd truth;

  explicit LastingErrors(int n, double correlation)
      : data(test::moving_log("models/double_pendulum.toml", n, 0.005, 21)), truth(true_acceleration(*data.model, data.states)) {
    RandomStream random(21);
    VectorXd error = VectorXd::Zero(6);
    for (int i = -100; i < n; ++i) {
      for (double& one : error) one = correlation * one + std::sqrt(1 - correlation * correlation) * noise * random.normal();
      if (i >= 0) data.accelerations.col(i) = truth.col(i) + error;
    }
  }
  [[nodiscard]] FitOutcome fit(bool thin) const {
    FitRequest request;
    request.model = *data.model;
    request.logs = {{data.table()}};
    request.problem.mean = Prior::Mean::force;
    request.problem.noise_stddev = noise;
    request.problem.estimate = std::vector<std::string>();
    request.restarts = 1;
    request.thin = thin;
    return run_fit(prepare_fit(std::move(request)));
  }
  [[nodiscard]] double coverage(const FitOutcome& outcome) const {
    const Posterior::Marginal prediction =
        outcome.posterior.marginal(View::constrained_acceleration(*data.model->system), data.states);
    return ((prediction.mean - truth).array().abs() <= 1.96 * prediction.stddev().array() + 1e-9).cast<double>().mean();
  }
};

int n_rows(const FitOutcome& outcome) { return outcome.posterior.observations().front().n_data(); }

TEST(Residuals, ThatGoOnFromRowToRowAreFittedToAsManyRowsAsTheyAreWorth) {
  const LastingErrors log(300, 0.9);
  const FitOutcome all = log.fit(false), fewer = log.fit(true);
  EXPECT_EQ(n_rows(all), 300);
  EXPECT_THAT(all.notes, Contains(testing::AllOf(testing::StartsWith("warning: residuals go on from row to row"),
                                                 testing::EndsWith(": deviations are too small"))));
  EXPECT_LE(n_rows(fewer), 75);
  EXPECT_GE(n_rows(fewer), 40);
  EXPECT_THAT(fewer.notes, Contains(HasSubstr(fmt::format("fitted to {} of 300, evenly taken", n_rows(fewer)))));
  EXPECT_LT(log.coverage(all), 0.8);
  EXPECT_GT(log.coverage(fewer), 0.85);
  // the same fit again, from its own file
  const FitOutcome again = run_fit(prepare_fit_again(fewer.file));
  EXPECT_EQ(n_rows(again), n_rows(fewer));
  EXPECT_EQ(again.file.report.objective, fewer.file.report.objective);
}

TEST(Residuals, OfALongLogAreAskedOfAStretchFirst) {
  const LastingErrors lasting(1500, 0.9);
  const FitOutcome fewer = lasting.fit(true);  // all would take a matrix of 3000
  EXPECT_LE(n_rows(fewer), 375);
  EXPECT_GT(lasting.coverage(fewer), 0.85);
  const LastingErrors white(410, 0);
  EXPECT_EQ(n_rows(white.fit(true)), 410);
}

TEST(Residuals, WithoutANoiseAnOffsetOrNothingLeftOfTheCancellationIsFound) {
  ConstraintResidual one{"row", 50, 1.0, 0.0, std::numeric_limits<double>::quiet_NaN(), 5.0, {}};
  EXPECT_FALSE(one.is_too_large());
  one.mean = 0.95;
  EXPECT_TRUE(one.is_too_large());
  one.mean = 0;
  one.rms = 3;
  EXPECT_TRUE(one.is_too_large());
}

TEST(Residuals, TellOfAKnownForceThatIsNotUsed) {
  // the latent acts along the velocity, and gravity does not
  const Model thrown = Model::parse(R"toml(
coordinates = ["x", "y"]
[mechanics]
mass  = [["1", "0"], ["0", "1"]]
force = ["0", "-9.81"]
[noise]
ddq = 0.05
[[latent]]
kernel     = "se"
features   = ["dx", "dy"]
directions = { force = [["-dx"], ["-dy"]] }
[truth]
force = ["-0.3*dx", "-0.3*dy"]
[sampling]
dx = [-2, 2]
dy = [-2, 2]
)toml",
                                    "thrown.toml");
  GeneratedData drawn = generate(thrown, GenerateOptions{60, 16, test::noise_of(thrown)});
  Data data = {&thrown, std::move(drawn.states), std::move(drawn.accelerations)};
  EXPECT_THAT(notes_of_fit(data, Prior::Mean::zero),
              Contains(HasSubstr("the known force of [mechanics] is not used: with `mean=force` the log likelihood")));
  EXPECT_THAT(notes_of_fit(data, Prior::Mean::force), Not(Contains(HasSubstr("known force"))));
  // and these features know nothing of the inputs
  data = data_of("models/surface.toml", 16);
  std::string text = data.model->text;
  const std::size_t first = text.find("features   = ["), last = text.find(']', first);
  text.replace(first, last + 1 - first, R"(features = ["dq1", "dq2", "dq3"])");
  const Model narrow = Model::parse(text, "narrow.toml");
  data.model = &narrow;
  EXPECT_THAT(notes_of_fit(data, Prior::Mean::zero),
              Contains(HasSubstr("warning: the known force of [mechanics] is not used, and no feature reads u1, u2, u3")));
}

// a car whose axle is behind its centre of mass, driven such that it does not turn faster; its inertia is that of a coin
TEST(Residuals, TellOfAConstraintThatSpinsWhatIsLight) {
  const auto car = [](const char* inertia) {
    return Model::parse(fmt::format(R"toml(
coordinates = ["x", "y", "h"]
[mechanics]
mass  = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "{}"]]
force = ["0", "0", "0"]
[constraints]
velocity = ["dx*sin(h) - dy*cos(h) + 0.1*dh"]
[noise]
ddq = 0.05
[[latent]]
kernel     = "se"
features   = ["dx", "dy", "h", "dh"]
directions = "acceleration"
[truth]
acceleration = ["0", "0", "0"]
[sampling]
v  = [1, 2]
h  = [0, 6]
dh = [-1, 1]
dx = "v*cos(h) - 0.1*dh*sin(h)"
dy = "v*sin(h) + 0.1*dh*cos(h)"
)toml",
                                    inertia),
                        "car.toml");
  };
  for (const bool is_light : {true, false}) {
    const Model model = car(is_light ? "1e-4" : "10");
    GeneratedData drawn = generate(model, GenerateOptions{60, 16, test::noise_of(model)});
    RandomStream random(16, 1);
    for (Eigen::Index i = 0; i < drawn.states.cols(); ++i) {
      const double h = drawn.states(2, i), along = drawn.states(3, i) * std::cos(h) + drawn.states(4, i) * std::sin(h);
      drawn.accelerations.col(i) = -drawn.states(5, i) * along * Eigen::Vector3d(std::sin(h), -std::cos(h), 0);
      for (int k = 0; k < 3; ++k) drawn.accelerations(k, i) += 0.05 * random.normal();
    }
    const Data data = {&model, std::move(drawn.states), std::move(drawn.accelerations)};
    const testing::Matcher<std::vector<std::string>> is_told =
        Contains(HasSubstr("the constraint alone makes far more than was measured: ddh"));
    EXPECT_THAT(notes_of_fit(data, Prior::Mean::zero), is_light ? is_told : Not(is_told));
    EXPECT_THAT(notes_of_fit(data, Prior::Mean::force), Not(is_told));
  }
}

}  // namespace
}  // namespace gp2
