#include "jobs/late_cart.hpp"

#include <cmath>
#include <numbers>

#include <fmt/format.h>

#include "base/random.hpp"
#include "gp2/jobs/simulate_job.hpp"

namespace gp2::test {

Model late_cart(const std::string& input, bool estimates_mass) {
  return Model::parse(fmt::format(R"toml(
name = "cart"
coordinates = ["x"]
inputs = [{}]
[parameters]
m = {{ value = 1.5, bounds = [0.5, 5], estimate = {} }}
[mechanics]
mass = [["m"]]
force = ["u"]
[[latent]]
name = "friction"
features = ["dx"]
directions = "force"
[noise]
ddq = 0.05
[truth]
force = ["-2*dx - tanh(5*dx)"]
)toml",
                                  input, estimates_mass),
                      "late_cart.toml");
}

CsvTable late_cart_log(double delay, double lag, double rate, double seconds, std::uint64_t seed, double noise_stddev) {
  RandomStream random(seed);
  const auto n = static_cast<Eigen::Index>(std::lround(seconds * rate)) + 1;
  SimulateRequest request;
  request.times = Eigen::VectorXd::LinSpaced(n, 0, static_cast<double>(n - 1) / rate);
  Eigen::VectorXd u = Eigen::VectorXd::Zero(n);
  for (int k = 0; k < 8; ++k) {
    const double omega = 2 * std::numbers::pi * (0.2 + 3.8 * random.uniform()), phase = 7 * random.uniform();
    u.array() += 1.5 * (omega * request.times.array() + phase).sin();
  }
  const auto column = [](const auto& row) { return std::vector<double>(row.begin(), row.end()); };
  request.start = std::map<std::string, double>{{"x", 0}, {"dx", 0}};
  request.inputs = CsvTable::from_columns("commands", {{"t", column(request.times)}, {"u", column(u)}});
  const Model truth = late_cart(fmt::format("{{ name = \"u\", delay = {}, lag = {} }}", delay, lag));
  const Trajectory motion = run_simulation(prepare_simulation(truth, request)).front();
  std::vector<double> ddx = column(motion.accelerations.row(0));
  for (double& one : ddx) one += noise_stddev * random.normal();
  return CsvTable::from_columns("late cart", {{"t", column(request.times)},
                                              {"x", column(motion.states.row(0))},
                                              {"dx", column(motion.states.row(1))},
                                              {"ddx", ddx},
                                              {"u", column(u)}});
}

}  // namespace gp2::test
