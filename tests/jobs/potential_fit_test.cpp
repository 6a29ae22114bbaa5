// A potential beside friction, with an estimated mass and noise, as it is asked of a fit, its file and what is made of it.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "data_of_model.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/jobs/simulate_job.hpp"
#include "gp2/jobs/update_job.hpp"
#include "gp2/predictor.hpp"
#include "gp2/simulation/generate.hpp"
#include "input_error.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;
using testing::Contains;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::Not;

const Model& swing() {
  static const Model model = Model::parse(R"toml(
name        = "swing"
coordinates = ["x", { name = "q", angle = true }]
[parameters]
m = { value = 0.6, bounds = [0.2, 1.2], estimate = true }
[mechanics]
mass  = [["1 + m", "m*cos(q)"], ["m*cos(q)", "m"]]
force = ["m*sin(q)*dq^2", "0"]
[[latent]]
name       = "energy"
directions = "potential"
[[latent]]
name       = "friction"
kernel     = "se"
features   = ["dx"]
directions = { force = [["-dx"], ["0"]] }
[noise]
ddq = { value = 0.03, estimate = true }
[truth]
force = ["-4*x - x^3 - 0.6*dx", "-0.5*9.81*sin(q)"]
[sampling]
x  = [-1, 1]
q  = [-2, 2]
dx = [-1, 1]
dq = [-1, 1]
)toml",
                                          "swing");
  return model;
}

CsvTable log_of(int n, std::uint64_t seed) {
  const GeneratedData data = generate(swing(), {n, seed, VectorXd::Constant(2, 0.03)});
  return test::LogData{&swing(), data.states, data.accelerations}.table();
}

FitRequest request_of_swing() {
  FitRequest request = test::fit_request(swing(), {log_of(25, 1), log_of(15, 2)});
  request.max_escapes = 0;
  request.hyperparameters = HyperparameterChoice::optimise;
  return request;
}

void expect_energy_learned(FitRequest request) {
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
  std::vector<std::string> names;
  for (const Hyperparameter& h : outcome.file.report.hyperparameters) names.push_back(h.name);
  EXPECT_THAT(names, Contains("energy.signal_stddev(potential)"));
  EXPECT_THAT(names, Contains("m"));
  EXPECT_THAT(names, Not(Contains("discrepancy.size"))) << "whose force would have no energy";

  const test::TemporaryFolder folder;
  outcome.file.write(folder / "fit.json");
  const FitFile read = FitFile::read(folder / "fit.json");
  const Posterior posterior = read.posterior();
  const MatrixXd states = test::draw(swing(), 12, 9).states;
  const View view = View::constrained_acceleration(*swing().system);
  EXPECT_EQ(posterior.marginal(view, states).covariance, outcome.posterior.marginal(view, states).covariance);
  EXPECT_EQ(posterior.mean(view, states), outcome.posterior.mean(view, states));

  // the energy that is true, but for a constant
  const auto energy = [](const VectorXd& x) { return 2 * x[0] * x[0] + 0.25 * std::pow(x[0], 4) - 0.5 * 9.81 * std::cos(x[1]); };
  const Posterior::Potential learned = posterior.potential(0, states, states.col(0));
  for (Index i = 0; i < states.cols(); ++i) {
    const double expected = energy(states.col(i)) - energy(states.col(0));
    EXPECT_NEAR(learned.mean[i], expected, 0.1 + 4 * learned.stddev[i]) << i;
    EXPECT_LE(learned.stddev[i], 0.5) << i;
  }

  const Predictor predictor(posterior, view);
  auto memory = predictor.make_workspace();
  VectorXd mean(2), stddev(2);
  for (Index i = 0; i < states.cols(); ++i) {
    EXPECT_EQ(predictor.mean_and_stddev(states.col(i), mean, stddev, memory), Predictor::Status::ok);
    EXPECT_LE((mean - posterior.mean(view, states.col(i))).norm(), 1e-9 * (1 + mean.norm()));
    EXPECT_LE((stddev - posterior.marginal(view, states.col(i)).stddev()).norm(), 1e-6 * (1 + stddev.norm()));
  }

  const UpdateOutcome updated = update(read, {log_of(10, 3)}, {});
  EXPECT_EQ(updated.n_states, 50);
  EXPECT_LT(updated.fit.posterior().potential(0, states, states.col(0)).stddev.sum(), learned.stddev.sum());
}

TEST(PotentialFit, LearnsEnergyBesideFrictionAndItsFileGivesItAgain) { expect_energy_learned(request_of_swing()); }

TEST(PotentialFit, LearnsEnergyThroughInducingPoints) {
  FitRequest request = request_of_swing();
  request.inducing = 60;
  ASSERT_EQ(prepare_fit(request).options.n_inducing, 60);
  expect_energy_learned(std::move(request));
}

TEST(PotentialFit, PredictGivesTheEnergyRelativeToTheFirstRow) {
  FitRequest request = request_of_swing();
  request.max_iterations = 3;
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
  PredictRequest asked;
  asked.potential = "energy";
  asked.covariance = PredictRequest::Covariance::stddev;
  const CsvTable table = log_of(6, 4);
  const PredictOutcome predicted = predict(outcome.file, table, asked);
  EXPECT_THAT(predicted.names, ElementsAre("potential@energy", "potential@energy_std"));
  EXPECT_EQ(predicted.values(0, 0), 0);
  EXPECT_GT(predicted.values.row(1).tail(5).minCoeff(), 0);
  asked.potential = "friction";
  EXPECT_THAT(input_error_of([&] { static_cast<void>(predict(outcome.file, table, asked)); }),
              HasSubstr("the latent 'friction' is none"));
  asked.potential = "energy";
  asked.covariance = PredictRequest::Covariance::full;
  EXPECT_THAT(input_error_of([&] { static_cast<void>(predict(outcome.file, table, asked)); }), HasSubstr("goes with"));
  asked.view.time_step = 0.1;
  EXPECT_THAT(input_error_of([&] { static_cast<void>(predict(outcome.file, table, asked)); }), HasSubstr("replaces a view"));
}

// A spring that is known, with its potential, and one that is not: their sum is the energy that the learned motion keeps.
TEST(PotentialFit, MotionsKeepTheEnergyOfTheKnownAndTheLearnedPotential) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "y"]
[mechanics]
mass      = [["2", "0"], ["0", "1"]]
force     = ["-3*x", "0"]
potential = "1.5*x^2"
[[latent]]
directions = "potential"
[noise]
ddq = 0.01
[truth]
force = ["-2*(x - y)", "2*(x - y) - y^3"]
[sampling]
x  = [-1, 1]
y  = [-1, 1]
dx = [-1, 1]
dy = [-1, 1]
)toml",
                                   "springs");
  for (const Prior::Mean mean : {Prior::Mean::force, Prior::Mean::zero}) {
    const GeneratedData data = test::draw(model, 30, 1);
    FitRequest request = test::fit_request(model, {test::LogData{&model, data.states, data.accelerations}.table()});
    request.problem.mean = mean;
    const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
    SimulateRequest asked;
    asked.start = VectorXd((VectorXd(4) << 0.8, 0, 0, 0.3).finished());
    asked.times = VectorXd::LinSpaced(101, 0, 20);
    asked.relative_tolerance = 1e-9;
    const FitSystem system = system_of(outcome.file, outcome.posterior.prior(), nullptr);
    for (const int n_samples : {0, 2}) {
      asked.n_samples = n_samples > 0 ? std::optional(n_samples) : std::nullopt;
      const SimulateJob job = prepare_simulation(system, outcome.posterior, asked);
      const std::vector<Trajectory> motions = run_simulation(job);
      for (std::size_t k = 0; k < motions.size(); ++k) {
        const MatrixXd& states = motions[k].states;
        const MotionEnergy energy = job.motions[k].energy(states);
        const VectorXd kinetic = kinetic_energy(*model.system, job.motions[k].parameters, states);
        EXPECT_GT(kinetic.maxCoeff() - kinetic.minCoeff(), 0.5);
        EXPECT_LE((energy.values.array() - energy.values[0]).abs().maxCoeff(), 1e-6) << k;
        const double known = mean == Prior::Mean::force ? 1.5 * 0.8 * 0.8 : 0;
        EXPECT_NEAR(energy.values[0], 0.5 * 0.3 * 0.3 + known, 1e-12);
        if (n_samples > 0) {
          EXPECT_EQ(energy.stddev.size(), 0);
        } else {
          EXPECT_TRUE(energy.stddev.isApprox(outcome.posterior.potential(0, states, states.col(0)).stddev, 1e-9));
        }
      }
    }
  }
}

TEST(PotentialFit, IntegratesByItself) {
  FitRequest request = request_of_swing();
  EXPECT_EQ(prepare_fit(request).options.n_draws, 0);
  request.hyperparameters = HyperparameterChoice::automatic;
  EXPECT_EQ(prepare_fit(request).options.n_draws, n_mixed_draws);
}

}  // namespace
}  // namespace gp2
