#include "gp2/jobs/fit_time.hpp"

#include <gmock/gmock.h>

#include "gp2/simulation/generate.hpp"
#include "test_models.hpp"
#include "training/objective.hpp"

namespace gp2 {
namespace {

using testing::HasSubstr;

/// A fit of the surface with so many states; each measures two of three accelerations independently.
FitProblem surface_of_states(int n_states) {
  const Model& model = test::model("models/surface.toml");
  const Eigen::VectorXd noise_stddev = Eigen::VectorXd::Constant(3, 0.1);
  const GeneratedData data = generate(model, {n_states, 3, noise_stddev});
  FitProblem problem;
  problem.prior = make_prior(model);
  problem.observations = {Observations(data.states, View::all(View::Quantity::constrained_acceleration, *model.system),
                                       data.accelerations, noise_stddev)};
  problem.hyperparameters = default_hyperparameters(problem.prior, problem.observations, {}, {});
  return problem;
}

TEST(FitTime, IsToldWhereAnEvaluationTakesLong) {
  std::vector<std::string> notes;
  note_time(9, 3000, notes);
  EXPECT_TRUE(notes.empty());
  note_time(42, 9000, notes);
  note_time(463, 24841, notes);
  note_time(2e4, 24841, notes);
  ASSERT_EQ(notes.size(), 3U);
  EXPECT_THAT(notes[0], HasSubstr("one evaluation of the likelihood factors a matrix of size 9000 and takes about 42 s here, and "
                                  "a fit takes hundreds: it can be interrupted at any time"));
  EXPECT_THAT(notes[1], HasSubstr("about 8 min here"));
  EXPECT_THAT(notes[2], HasSubstr("about 6 h here"));
  EXPECT_THAT(notes[2], HasSubstr("inducing points"));
  // which a baseline cannot have
  note_time(42, 9000, notes, /*takes_points=*/false);
  EXPECT_THAT(notes[3], testing::Not(HasSubstr("inducing")));
}

TEST(FitTime, OfASmallFitIsNotTold) {
  std::vector<std::string> notes;
  note_time(surface_of_states(50), {}, 100, notes);
  EXPECT_TRUE(notes.empty());
}

// of whose states none can be left out
TEST(FitTime, OfAFitToWindowsIsNotTold) {
  FitProblem problem = surface_of_states(50);
  problem.observations[0] = problem.observations[0].with_sums({{0, 0, Eigen::VectorXd::Ones(3), 1, Eigen::VectorXd::Ones(1)}});
  std::vector<std::string> notes;
  note_time(problem, {}, 5000, notes);
  EXPECT_TRUE(notes.empty());
}

TEST(FitTime, IsAboutThatOfAnEvaluation) {
  const FitProblem problem = surface_of_states(1200);
  FitOptions options;
  options.n_restarts = 1;
  options.n_threads = 1;
  const double estimated = evaluation_seconds(problem, options, 2400);
  const Objective objective(problem.prior, problem.observations, problem.hyperparameters);
  Likelihood::Workspace workspace;
  Eigen::VectorXd gradient(std::ssize(problem.hyperparameters));
  const auto start = std::chrono::steady_clock::now();
  objective(coordinates(problem.hyperparameters), &gradient, workspace);
  const double measured = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  // other programs may take the processor meanwhile
  EXPECT_LT(estimated, 10 * measured);
  EXPECT_GT(estimated, measured / 10);
}

}  // namespace
}  // namespace gp2
