#include <algorithm>
#include <cmath>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/random.hpp"
#include "gp2/error.hpp"
#include "model/table_readers.hpp"

// [mechanics], or code, or a robot in its place

namespace gp2 {

namespace {

// the rest of the file speaks of what it declares itself
void require_as_declared(const SymbolicSystem::Definition& declared, const System& system) {
  const auto require_same = [](const char* what, const std::string& wanted, const std::string& got) {
    if (wanted == got) return;
    throw InputError(
        fmt::format("the system that code returned has the {} {}, but this file declares {}; give it those of the declaration",
                    what, got.empty() ? "(none)" : got, wanted.empty() ? "(none)" : wanted));
  };
  const auto coordinates = [](const std::vector<Coordinate>& all) {
    std::vector<std::string> names;
    for (const Coordinate& c : all) names.push_back(c.angle ? c.name + " (an angle)" : c.name);
    return fmt::format("{}", fmt::join(names, ", "));
  };
  const auto parameters = [](const std::vector<Parameter>& all) {
    std::vector<std::string> names;
    for (const Parameter& p : all) {
      names.push_back(fmt::format("{} = {}", p.name, p.value));
      if (p.bounds) names.back() += fmt::format(" in [{}, {}]", p.bounds->first, p.bounds->second);
      if (p.estimate) names.back() += " (estimated)";
    }
    return fmt::format("{}", fmt::join(names, ", "));
  };
  require_same("coordinates", coordinates(declared.coordinates), coordinates(system.coordinates()));
  require_same("inputs", fmt::format("{}", fmt::join(declared.inputs, ", ")),
               fmt::format("{}", fmt::join(system.inputs(), ", ")));
  require_same("parameters", parameters(declared.parameters), parameters(system.parameters()));
}

}  // namespace

void ask_code_for_mechanics(ModelReader& reader) {
  for (const char* key : {"mechanics", "constraints"}) {
    if (const auto table = reader.file.get(key)) {
      table->fail(
          fmt::format("the mechanics of this model are given as code: remove [{}], or read the file without that code", key));
    }
  }
  const SymbolicSystem::Definition& declared = reader.definition;
  Model& model = reader.model;
  model.system = model.code.mechanics({declared.name, declared.coordinates, declared.inputs, declared.parameters});
  if (!model.system) throw InputError("the code that is to give the mechanics returned no system");
  require_as_declared(declared, *model.system);
}

namespace {

std::vector<std::vector<Expression>> read_mass(const ModelReader& reader, const TomlValue& mechanics) {
  const std::optional<TomlValue> mass = mechanics.get("mass");
  if (!mass) mechanics.fail("missing mass = [[…], …]");
  std::vector<std::vector<Expression>> M;
  for (const TomlValue& of_mass : reader.rows_per_coordinate(*mass)) {
    const TomlValue row = of_mass.called(fmt::format("{} row {}", mass->key(), M.size() + 1));
    const std::vector<TomlValue> entries = row.array();
    if (entries.size() != reader.nq()) row.fail(fmt::format("expected {} entries, got {}", reader.nq(), entries.size()));
    M.emplace_back();
    for (const TomlValue& entry : entries) {
      M.back().push_back(reader.expression_without(entry.called(fmt::format("{} column {}", row.key(), M.back().size() + 1)),
                                                   reader.of_motion(),
                                                   "the mass matrix may depend on coordinates, t and parameters only"));
    }
  }
  return M;
}

// Lagrange's equations: F_i −= Σ_j dM_ij/dt dq_j − ½ Σ_jk ∂M_jk/∂q_i dq_j dq_k
void add_coriolis_force(ModelReader& reader) {
  ExpressionGraph& graph = *reader.model.graph;
  const std::vector<Expression>&q = reader.symbols->q, &dq = reader.symbols->dq;
  const auto& M = reader.definition.mass;
  for (std::size_t i = 0; i < q.size(); ++i) {
    for (std::size_t j = 0; j < q.size(); ++j) {
      Expression rate = graph.differentiate(M[i][j], reader.symbols->t);
      Expression half = graph.constant(0);
      for (std::size_t k = 0; k < q.size(); ++k) {
        rate = rate + graph.differentiate(M[i][j], q[k]) * dq[k];
        half = half + graph.differentiate(M[j][k], q[i]) * dq[k];
      }
      Expression& F = reader.definition.force[i];
      F = F - (rate - graph.constant(0.5) * half) * dq[j];
    }
  }
}

// M and F are the robot's; inputs act on its joints one by one, unless [mechanics] says how they act
void take_mechanics_of_robot(ModelReader& reader, const std::optional<TomlValue>& mechanics) {
  const bool inputs_are_written = mechanics && mechanics->has("force");
  const RobotExpressions& robot = *reader.robot();
  SymbolicSystem::Definition& system = reader.definition;
  system.mass = robot.mass();
  system.force = robot.force();
  std::vector<Expression> applied(reader.nq(), system.graph->constant(0));
  if (mechanics) {
    if (const auto mass = mechanics->get("mass")) {
      mass->fail("the mass matrix is the robot's: remove it, or remove robot = …");
    }
    mechanics->only_keys({"force", "force_on", "potential"});
    applied = read_forces(reader, *mechanics);
  }
  const std::vector<Expression>& u = reader.symbols->u;
  if (!inputs_are_written && !u.empty()) {
    if (u.size() != robot.n_axes()) {
      reader.file.get("inputs")->fail(
          fmt::format("{} inputs for {} axes of joints: give one per axis, or say in [mechanics] force = [ … ] how they act",
                      u.size(), robot.n_axes()));
    }
    const std::vector<Expression> of_inputs = robot.on_coordinates(u);
    for (std::size_t j = 0; j < applied.size(); ++j) applied[j] = applied[j] + of_inputs[j];
  }
  for (std::size_t j = 0; j < applied.size(); ++j) system.force[j] = applied[j] + system.force[j];
}

const RobotQuantity& robot_quantity(const ModelReader& reader, const TomlValue& at, const std::string& name) {
  try {
    const Expression variable = reader.parsed(name);
    if (variable.operation() == Operation::variable) {
      const std::string quantity = variable.variable_name();
      if (quantity.starts_with('d') && quantity.find('(') != std::string::npos) {
        throw InputError(
            fmt::format("a force acts along {}, not along its derivative", quantity.substr(quantity.find_first_not_of('d'))));
      }
      return reader.robot()->quantity(quantity);
    }
  } catch (const InputError& error) {
    at.fail(error.what());
  }
  at.fail("expected a point of the robot, such as 'site(\"tip\").x'");
}

}  // namespace

void read_mechanics(ModelReader& reader) {
  const std::optional<TomlValue> mechanics = reader.file.get("mechanics");
  if (reader.model.robot) {
    take_mechanics_of_robot(reader, mechanics);
    return;
  }
  if (!mechanics) reader.file.fail_at(1, "mechanics", "missing; a model needs [mechanics] with mass = [[…], …]");
  mechanics->only_keys({"mass", "force", "coriolis", "potential"});
  reader.definition.mass = read_mass(reader, *mechanics);
  reader.definition.force = read_forces(reader, *mechanics);
  if (const auto coriolis = mechanics->get("coriolis"); coriolis && coriolis->boolean()) add_coriolis_force(reader);
}

std::vector<Expression> read_forces(const ModelReader& reader, const TomlValue& table, std::string* multiplier) {
  RobotExpressions* const robot = reader.robot();
  const auto read = [&](const TomlValue& entry) {
    return multiplier != nullptr
               ? reader.expression_with_multipliers(entry, *multiplier, "a force may not depend on accelerations")
               : reader.expression_without(entry, reader.symbols->ddq, "a force may not depend on accelerations");
  };
  const std::size_t nq = reader.nq();
  std::vector<Expression> forces(nq, reader.definition.graph->constant(0));
  if (const auto force = table.get("force")) {
    const std::size_t n = robot != nullptr ? robot->n_axes() : nq;
    const std::vector<TomlValue> entries = force->array();
    if (entries.size() != n) {
      force->fail(fmt::format("expected {} entries, one per {}, got {}", n, n == nq ? "coordinate" : "axis of the joints",
                              entries.size()));
    }
    std::vector<Expression> given;
    for (std::size_t j = 0; j < n; ++j) given.push_back(read(entries[j].called(fmt::format("{} entry {}", force->key(), j + 1))));
    forces = robot != nullptr ? robot->on_coordinates(given) : given;
  }
  const std::optional<TomlValue> force_on = table.get("force_on");
  if (!force_on) return forces;
  if (robot == nullptr) force_on->fail("only a model with a robot = \"FILE\" has points for a force to act on");
  for (const auto& [name, entry] : force_on->entries()) {
    const Expression force = read(entry);
    for (std::size_t j = 0; j < nq; ++j) forces[j] = forces[j] + robot_quantity(reader, entry, name).jacobian[j] * force;
  }
  return forces;
}

void read_potential(ModelReader& reader) {
  std::optional<Expression>& potential = reader.model.potential;
  if (reader.robot() != nullptr) potential = reader.robot()->potential();
  const std::optional<TomlValue> mechanics = reader.file.get("mechanics");
  const std::optional<TomlValue> written = mechanics ? mechanics->get("potential") : std::nullopt;
  if (!written) return;
  const Expression added =
      reader.expression_without(*written, reader.of_motion(), "the potential may depend on coordinates, t and parameters only");
  potential = potential ? *potential + added : added;
}

// M = Mᵀ at random points, to rounding: entries may be written differently on the two sides
void check_mass_symmetry(const ModelReader& reader) {
  constexpr int n_points = 10;
  const System& system = *reader.model.system;
  RandomStream random(1);
  Eigen::MatrixXd points(system.layout().size(), n_points);
  for (double& value : points.reshaped()) value = 2 * random.uniform() - 1;
  const SystemValues values = system.evaluate(points, system.parameter_values());
  const TomlValue mass = *reader.file.get("mechanics")->get("mass");
  const auto entry = [&](Eigen::Index row, Eigen::Index column) {
    return mass.array()[static_cast<std::size_t>(row)].array()[static_cast<std::size_t>(column)].written();
  };
  for (int i = 0; i < n_points; ++i) {
    const auto M = values.M(i);
    for (Eigen::Index row = 0; row < M.rows(); ++row) {
      for (Eigen::Index column = 0; column < row; ++column) {
        // a positive definite M has M_rc² < M_rr M_cc
        const double size = std::max(std::abs(M(row, column)), std::sqrt(std::abs(M(row, row) * M(column, column))));
        if (std::abs(M(row, column) - M(column, row)) <= 1e-10 * size || !std::isfinite(size)) continue;
        mass.fail(fmt::format("not symmetric: row {} column {} is {}, but row {} column {} is {}; write the same on both sides",
                              column + 1, row + 1, entry(column, row), row + 1, column + 1, entry(row, column)));
      }
    }
  }
}

}  // namespace gp2
