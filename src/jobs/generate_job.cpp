#include "gp2/jobs/generate_job.hpp"

#include <fmt/format.h>

#include "base/number_range.hpp"
#include "gp2/error.hpp"

namespace gp2 {

namespace {

Eigen::VectorXd noise_of(const Model& model, const std::optional<double>& given) {
  const Eigen::Index nq = model.system->nq();
  if (given) {
    if (!(*given >= 0 && *given <= largest_number))
      throw InputError(fmt::format("`noise_std`: must be 0 … {:.0e}, got {}", largest_number, *given));
    return Eigen::VectorXd::Constant(nq, *given);
  }
  if (model.noise.stddev.empty()) {
    throw InputError(fmt::format("{}: no [noise] ddq to draw from; give `noise_std=S` (0 for the truth)", model.name));
  }
  return Eigen::Map<const Eigen::VectorXd>(model.noise.stddev.data(), nq);
}

}  // namespace

std::vector<Option> options(GenerateRequest& request) {
  return {
      {"n", &request.n, "N", "number of rows, drawn at random"},
      {"grid", &request.grid, "q1=5,dq1=3,…",
       "instead of `n`: a grid with this many evenly spaced points in each range of [sampling]; for test data add `noise_std=0`"},
      {"seed", &request.seed, "S", "random seed; the states do not depend on the noise"},
      {"noise_std", &request.noise_stddev, "S", "standard deviation of the noise on every ddq; 0 gives the truth",
       "the model's [noise]"},
  };
}

GeneratedData generate(const Model& model, const GenerateRequest& request) {
  for (const Actuator& actuator : model.actuators) {
    if (actuator.is_direct() && !actuator.is_estimated()) continue;
    throw InputError(
        fmt::format("generate: {}: states are drawn one by one, but with {} and {} what acts depends on what was commanded "
                    "before: simulate a motion, or leave both out",
                    model.name, actuator.delay.name, actuator.lag.name));
  }
  if (request.n && *request.n < 1) throw InputError(fmt::format("`n`: must be positive, got {}", *request.n));
  return generate(model,
                  GenerateOptions{request.n.value_or(1), request.seed, noise_of(model, request.noise_stddev), request.grid});
}

}  // namespace gp2
