#include <limits>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "command.hpp"
#include "gp2/error.hpp"
#include "gp2/simulate.hpp"
#include "reproduce/experiment.hpp"
#include "reproduce/table.hpp"
#include "streams.hpp"

// Figures 3c and S7 of Geist & Trimpe 2020: how far trajectories leave the surface.
namespace gp2::command {

namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

struct Rollout {
  std::string name;
  Trajectory trajectory;
  VectorXd parameters;  // that the method holds for true
};

// |c| and |dc/dt| of the position constraints, largest over rows, at every time (2 × N)
MatrixXd errors(const System& system, const MatrixXd& states, const VectorXd& parameters) {
  const MatrixXd residuals = system.residuals(states, parameters);
  MatrixXd worst = MatrixXd::Zero(2, states.cols());
  for (std::size_t r = 0; r < system.residual_labels().size(); ++r) {
    const Index row = system.residual_labels()[r].velocity ? 1 : 0;
    worst.row(row) = worst.row(row).cwiseMax(residuals.row(static_cast<Index>(r)).cwiseAbs());
  }
  return worst;
}

// what the data's authors published of a method, after each step
std::vector<double> published_error(const Section& definition, const ReproduceOptions& options, const std::string& method) {
  if (!options.data || !definition.has("published")) return {};
  const std::filesystem::path path = *options.data / definition.text("published");
  if (!std::filesystem::exists(path)) return {};
  const nlohmann::json json = nlohmann::json::parse(read_file(path), nullptr, false);
  if (json.is_discarded()) throw InputError(fmt::format("{}: not valid JSON", path.string()));
  const nlohmann::json::json_pointer place("/published/ode_predictions/" + method + "/surface_error");
  return json.contains(place) ? json.at(place).get<std::vector<double>>() : std::vector<double>();
}

std::vector<Rollout> roll_out(const Section& definition, const ReproduceOptions& options) {
  const Model model = Model::read(options.experiments / definition.text("model"));
  const System& system = *model.system;
  const CsvTable log = observations_of(model, definition.text("data"), options.data, 0, definition.integer("n"));
  const Protocol::Name protocol = options.protocols.back();

  // the start is on the true surface, whatever the method believes
  VectorXd start = VectorXd::Zero(system.layout().size());
  std::vector<bool> given(static_cast<std::size_t>(start.size()), false);
  const Section values = definition.section("start");
  const std::vector<std::string> names = system.state_names();
  for (std::size_t k = 0; k < names.size(); ++k) {
    given[k] = values.has(names[k]);
    if (given[k]) start[static_cast<Index>(k)] = values.number(names[k]);
  }
  start = project_onto_constraints(system, system.parameter_values(), start, given);

  SimulateOptions simulation;
  simulation.times = VectorXd::LinSpaced(definition.integer("steps") + 1, 0, definition.number("t_end"));
  simulation.relative_tolerance = definition.number("relative_tolerance");
  simulation.absolute_tolerance = definition.number("absolute_tolerance");

  std::vector<Rollout> rollouts;
  for (const Section& section : definition.sections("method")) {
    const Method method = method_of(section, definition.section("restarts"));
    std::optional<Trained> trained;
    Acceleration acceleration;
    VectorXd parameters = system.parameter_values();
    if (method.is_truth) {
      acceleration = model_acceleration(model);
    } else {
      const std::vector<std::string> estimate =
          method.estimate ? definition.section("parameters").texts(method.mean) : std::vector<std::string>();
      trained = train(model, estimate, method, protocol, log, 0, options.threads);
      if (method.estimate) parameters = trained->fit.posterior.values().parameters;
      const View view = View::constrained_acceleration(system);
      acceleration = [posterior = trained->fit.posterior, view](const Eigen::Ref<const VectorXd>& state) -> VectorXd {
        return posterior.mean(view, state);
      };
    }
    for (const bool project : section.flags("project")) {
      simulation.project = project;
      rollouts.push_back({method.name + (project ? "_projected" : ""),
                          simulate(system, parameters, acceleration, start, simulation), parameters});
    }
  }
  return rollouts;
}

// errors to the true surface and, where a method has fitted its own, to that
void reproduce_trajectories(const ReproduceOptions& options, const std::string& name) {
  const Section definition = Section::read(options.experiments / (name + ".toml"));
  const Model model = Model::read(options.experiments / definition.text("model"));
  const System& system = *model.system;
  const std::vector<Rollout> rollouts = roll_out(definition, options);
  Table table, summary;
  const Index n = rollouts.front().trajectory.times.size();
  for (Index i = 0; i < n; ++i) table.add({{"t", rollouts.front().trajectory.times[i]}});
  const auto add = [&](const std::string& column, const auto& values) {
    for (Index i = 0; i < n; ++i) table.row(static_cast<std::size_t>(i))[column] = number_or_null(values(i));
  };
  for (const Rollout& rollout : rollouts) {
    const MatrixXd& states = rollout.trajectory.states;
    const MatrixXd to_true = errors(system, states, system.parameter_values());
    const MatrixXd to_fitted = errors(system, states, rollout.parameters);
    const bool fitted = rollout.parameters != system.parameter_values();
    add(rollout.name + "_surface_error", to_true.row(0));
    add(rollout.name + "_velocity_error", to_true.row(1));
    if (fitted) add(rollout.name + "_fitted_surface_error", to_fitted.row(0));
    for (int j = 0; j < system.nq(); ++j) {
      add(fmt::format("{}_{}", rollout.name, system.coordinates()[static_cast<std::size_t>(j)].name),
          states.row(system.layout().q(j)));
    }
    summary.add({{"method", rollout.name},
                 {"max_surface_error", to_true.row(0).maxCoeff()},
                 {"max_velocity_error", to_true.row(1).maxCoeff()},
                 {"max_fitted_surface_error", to_fitted.row(0).maxCoeff()},
                 {"max_fitted_velocity_error", to_fitted.row(1).maxCoeff()},
                 {"steps", rollout.trajectory.steps},
                 {"seconds", rollout.trajectory.seconds}});
  }
  // the published rollouts have the state after each step, but not the start
  for (const Rollout& rollout : rollouts) {
    const std::vector<double> published = published_error(definition, options, rollout.name);
    if (static_cast<Index>(published.size()) != n - 1) continue;
    add("published_" + rollout.name + "_surface_error",
        [&](Index i) { return i == 0 ? std::numeric_limits<double>::quiet_NaN() : published[static_cast<std::size_t>(i - 1)]; });
  }
  table.write(options.output / name);
  summary.write(options.output / (name + "_summary"));
  for (const Table::Row& row : summary.rows()) {
    print_result("{:<20} largest error to the surface {:>9.2e}   to the fitted one {:>9.2e}\n", row["method"].get<std::string>(),
                 row["max_surface_error"].get<double>(), row["max_fitted_surface_error"].get<double>());
  }
  plot(options, name);
}

}  // namespace

void reproduce_fig3c(const ReproduceOptions& options) { reproduce_trajectories(options, "fig3c"); }

void reproduce_figS7(const ReproduceOptions& options) { reproduce_trajectories(options, "figS7"); }

}  // namespace gp2::command
