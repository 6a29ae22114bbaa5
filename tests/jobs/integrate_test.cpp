// Hyperparameters integrated over, as it is asked of a fit.
#include <fmt/format.h>
#include <gmock/gmock.h>

#include "data_of_model.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/simulate_job.hpp"
#include "input_error.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using Eigen::MatrixXd;
using testing::Contains;
using testing::HasSubstr;
using testing::Not;

constexpr const char* surface = "models/surface.toml";

FitRequest request_of_rows(int n, HyperparameterChoice choice) {
  FitRequest request = test::fit_request(test::model(surface), {test::drawn_log(surface, n, 4).table()});
  request.max_escapes = 0;
  request.threads = 2;
  request.hyperparameters = choice;
  return request;
}

Model surface_with_the_default_prior() {
  std::string text = test::model(surface).text;
  const std::string kernel = "kernel     = \"se\"\n";
  return Model::parse(text.erase(text.find(kernel), kernel.size()), surface);
}

FitRequest integrating(int n = 12) { return request_of_rows(n, HyperparameterChoice::integrate); }

TEST(IntegratedFit, IsAMixtureThatItsFileGivesAgain) {
  const FitOutcome outcome = run_fit(prepare_fit(integrating()));
  const HyperparameterDraws& draws = outcome.file.report.draws.value();
  EXPECT_EQ(draws.size(), n_mixed_draws);
  EXPECT_EQ(outcome.posterior.n_components(), n_mixed_draws);
  EXPECT_LE(draws.evaluations, draw_evaluations);
  const test::TemporaryFolder folder;
  outcome.file.write(folder / "fit.json");
  const FitFile read = FitFile::read(folder / "fit.json");
  const View view = View::constrained_acceleration(*outcome.file.model.system);
  const MatrixXd& states = outcome.posterior.observations().front().states();
  EXPECT_EQ(read.posterior().marginal(view, states).covariance, outcome.posterior.marginal(view, states).covariance);
  EXPECT_EQ(read.posterior().sample({{view, states}}, 3, 1), outcome.posterior.sample({{view, states}}, 3, 1));
  // and again, from its options and data
  EXPECT_EQ(run_fit(prepare_fit_again(read, 1)).file.report.draws->values, draws.values);
}

TEST(IntegratedFit, OfARobustFitIsDrawnOnceItIsSettledWhatToDistrust) {
  FitRequest request = integrating();
  request.problem.robust = true;
  const FitOutcome outcome = run_fit(prepare_fit(std::move(request)));
  EXPECT_EQ(outcome.posterior.n_components(), n_mixed_draws);
  EXPECT_TRUE(outcome.file.report.draws);
}

TEST(IntegratedFit, AutoIntegratesWhereItPays) {
  const auto n_draws = [](int n, const std::function<void(FitRequest&)>& change) {
    FitRequest request = request_of_rows(n, HyperparameterChoice::automatic);
    change(request);
    return prepare_fit(std::move(request)).options.n_draws;
  };
  const auto as_it_is = [](FitRequest& request) { request.model = surface_with_the_default_prior(); };
  EXPECT_EQ(n_draws(40, as_it_is), n_mixed_draws);
  // two of three directions are free
  EXPECT_EQ(n_draws(largest_integrated_size / 2, as_it_is), n_mixed_draws);
  EXPECT_EQ(n_draws(largest_integrated_size / 2 + 1, as_it_is), 0);
  EXPECT_EQ(n_draws(12,
                    [&](FitRequest& request) {
                      as_it_is(request);
                      request.problem.baseline = Baseline::Kind::se;
                      request.problem.mean = Prior::Mean::zero;
                    }),
            0);
  EXPECT_EQ(n_draws(12,
                    [&](FitRequest& request) {
                      as_it_is(request);
                      request.max_iterations = 0;
                    }),
            0);
  EXPECT_EQ(n_draws(12, [](FitRequest&) {}), 0) << "one kernel, stated in the model file";
  FitRequest optimising = request_of_rows(12, HyperparameterChoice::optimise);
  as_it_is(optimising);
  EXPECT_EQ(prepare_fit(optimising).options.n_draws, 0);
}

TEST(IntegratedFit, IsRefusedWhereItHasNoMeaning) {
  FitRequest request = integrating();
  request.problem.mean = Prior::Mean::zero;
  request.problem.baseline = Baseline::Kind::icm;
  EXPECT_EQ(test::input_error_of([&] { prepare_fit(request); }),
            "`hyperparameters=integrate` is not for a `baseline`, whose hyperparameters are optimised");
  request = integrating();
  request.max_iterations = 0;
  EXPECT_EQ(test::input_error_of([&] { prepare_fit(request); }),
            "`hyperparameters=integrate` samples around the optimum: leave out `max_iterations=0`");
}

// A bead on a wire whose slope and mass were drawn.
TEST(IntegratedFit, MovesASampleUnderTheParametersOfItsDraw) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "y"]
[parameters]
m = { value = 1, bounds = [0.1, 10], estimate = true }
s = { value = 0.5, bounds = [0.1, 1], estimate = true }
[mechanics]
mass      = [["m", "0"], ["0", "m"]]
force     = ["0", "-9.81*m"]
potential = "9.81*m*y"
[constraints]
position = ["y - s*x"]
[noise]
ddq = 0.1
[truth]
force = ["-0.2*dx", "0"]
[sampling]
x  = [-1, 1]
dx = [-1, 1]
)toml",
                                   "wire.toml");
  FitRequest request;
  request.model = model;
  const GeneratedData data = test::draw(model, 12, 1);
  request.logs = {{test::LogData{&model, data.states, data.accelerations}.table(), nullptr}};
  request.problem.mean = Prior::Mean::force;
  request.max_iterations = 0;
  const FitOutcome fit = run_fit(prepare_fit(std::move(request)));
  std::vector<ModelValues> values(2, fit.posterior.values());
  values[1].parameters << 3, 0.7;
  const Posterior posterior = Posterior::mixture(fit.posterior.prior(), fit.posterior.observations(), values);
  const auto energy_of = [&](const Eigen::VectorXd& parameters, const MatrixXd& states) {
    return mechanical_energy(model, parameters, states);
  };
  SimulateRequest asked;
  asked.start = std::map<std::string, double>{{"x", 0.4}};
  asked.times = Eigen::VectorXd::LinSpaced(11, 0, 0.5);
  const FitSystem system = system_of(fit.file, posterior.prior(), nullptr);
  asked.n_samples = 4;
  SimulateJob job = prepare_simulation(system, posterior, asked);
  std::vector<Trajectory> motions = run_simulation(job);
  std::set<double> masses;
  for (std::size_t k = 0; k < motions.size(); ++k) {
    const Eigen::VectorXd& own = job.motions[k].parameters;
    masses.insert(own[0]);
    const MatrixXd& states = motions[k].states;
    EXPECT_EQ(job.motions[k].energy(states).values, energy_of(own, states));
    EXPECT_LE((states.row(1) - own[1] * states.row(0)).cwiseAbs().maxCoeff(), 1e-9) << own.transpose();
  }
  EXPECT_THAT(masses, testing::ElementsAre(1, 3));

  asked.n_samples.reset();
  job = prepare_simulation(system, posterior, asked);
  const MatrixXd states = run_simulation(job).front().states;
  const Eigen::VectorXd mean = 0.5 * (energy_of(values[0].parameters, states) + energy_of(values[1].parameters, states));
  EXPECT_TRUE(job.motions.front().energy(states).values.isApprox(mean, 1e-12));
}

TEST(IntegratedFit, SaysWhereNothingIsDrawnAndWhereChainsHaveNotMixed) {
  FitJob job = prepare_fit(integrating());
  for (Hyperparameter& h : job.problem.hyperparameters) h.lower = h.upper = h.value;
  EXPECT_THAT(run_fit(job).notes, Contains(HasSubstr("warning: no hyperparameters were drawn: none is free")));
  const FitOutcome outcome = run_fit(prepare_fit(integrating()));
  const bool agree = outcome.file.report.draws->r_hat.maxCoeff() <= HyperparameterDraws::largest_r_hat;
  if (agree) {
    EXPECT_THAT(outcome.notes, Not(Contains(HasSubstr("have not mixed"))));
  } else {
    EXPECT_THAT(outcome.notes, Contains(HasSubstr("have not mixed")));
  }
}

}  // namespace
}  // namespace gp2
