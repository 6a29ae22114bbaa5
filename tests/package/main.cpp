// An outside project: the main job through the installed headers and library alone.
#include <cmath>
#include <cstdio>

#include <Eigen/Core>

#include "gp2/base/version.hpp"
#include "gp2/fit.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/simulation/generate.hpp"

int main() {
  const gp2::Model model = gp2::Model::parse(R"(
coordinates = ["x", "y"]
[parameters]
m = 2.0
slope = 0.5
[mechanics]
mass  = [["m", "0"], ["0", "m"]]
force = ["0", "-9.81*m"]
[constraints]
position = ["y - slope*x"]
[[latent]]
features = ["dx"]
[truth]
acceleration = ["-0.3*dx", "-0.3*dy"]
[sampling]
x  = [-1, 1]
dx = [-2, 2]
)",
                                             "a bead on a wire");
  const gp2::GeneratedData data = gp2::generate(model, {50, 1, Eigen::Vector2d(0.01, 0.01)});
  const gp2::Prior prior = gp2::make_prior(model, {gp2::Prior::Mean::force, std::nullopt, false});
  const gp2::View view = gp2::View::all(gp2::View::Quantity::constrained_acceleration, *model.system);
  const std::vector<gp2::Observations> observations = {
      {data.states, view, data.accelerations, Eigen::Vector2d(0.01, 0.01), false}};
  const gp2::Fit fit = gp2::fit(prior, observations, gp2::default_hyperparameters(prior, observations, {}, {}));
  const gp2::Evaluation evaluation =
      gp2::evaluate_predictions(fit.posterior, data.states, view.rows, gp2::true_acceleration(model, data.states));
  std::printf("gp2 %s: nll %.3f, rmse / spread %.2g, max |A ddq - b| %.1e\n", gp2::version(), fit.report.negative_log_likelihood,
              evaluation.rmse_normalised, evaluation.max_constraint_error);
  return std::isfinite(fit.report.negative_log_likelihood) && evaluation.rmse_normalised < 0.05 &&
                 evaluation.max_constraint_error < 1e-12
             ? 0
             : 1;
}
