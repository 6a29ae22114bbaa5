#include "jobs/data_of_model.hpp"

#include "base/random.hpp"
#include "gp2/simulate.hpp"
#include "gp2/simulation/generate.hpp"
#include "test_models.hpp"

namespace gp2::test {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

CsvTable LogData::table() const {
  std::vector<CsvTable::Column> columns;
  const auto add = [&](const std::vector<std::string>& names, const MatrixXd& rows) {
    for (std::size_t k = 0; k < names.size(); ++k) {
      const auto row = rows.row(static_cast<Index>(k));
      if (!row.hasNaN()) columns.push_back({names[k], {row.begin(), row.end()}});
    }
  };
  add(model->system->state_names(), states);
  add(model->system->acceleration_names(), accelerations);
  return CsvTable::from_columns("log.csv", std::move(columns));
}

VectorXd noise_of(const Model& model) {
  const std::vector<double>& stated = model.noise.stddev;
  if (stated.empty()) return VectorXd::Constant(model.system->nq(), 0.05);
  return Eigen::Map<const VectorXd>(stated.data(), std::ssize(stated));
}

LogData drawn_log(const Model& model, int n, std::uint64_t seed) {
  GeneratedData data = generate(model, GenerateOptions{n, seed, noise_of(model)});
  return {&model, std::move(data.states), std::move(data.accelerations)};
}

LogData drawn_log(const std::string& file, int n, std::uint64_t seed) { return drawn_log(model(file), n, seed); }

LogData moving_log(const std::string& file, int n, double time_step, std::uint64_t seed) {
  const Model& of = model(file);
  const System& system = *of.system;
  VectorXd start = drawn_log(file, 1, seed).states.col(0);
  start = start.unaryExpr([](double one) { return std::isnan(one) ? 0.0 : one; });
  SimulateOptions options;
  options.times = VectorXd::LinSpaced(n, 0, time_step * (n - 1));
  Trajectory motion = simulate(system, system.parameter_values(), model_acceleration(of), start, options);
  RandomStream random(seed + 1000);
  const VectorXd noise = noise_of(of);
  for (auto column : motion.accelerations.colwise()) {
    for (Index j = 0; j < noise.size(); ++j) column[j] += noise[j] * random.normal();
  }
  return {&of, std::move(motion.states), std::move(motion.accelerations)};
}

FitRequest fit_request(Model model, std::vector<CsvTable> logs) {
  FitRequest request;
  request.model = std::move(model);
  for (CsvTable& log : logs) request.logs.push_back({std::move(log), nullptr});
  request.problem.mean = Prior::Mean::force;
  request.restarts = 1;
  return request;
}

}  // namespace gp2::test
