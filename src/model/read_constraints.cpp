#include <algorithm>
#include <utility>

#include <fmt/format.h>

#include "base/suggestion.hpp"
#include "gp2/error.hpp"
#include "model/table_readers.hpp"

// [constraints] of a model file, and those of its robot

namespace gp2 {

using Level = ConstraintRow::Level;

namespace {

// calls f(level, entry) for each constraint of the file, in the order of the rows
template <class Function>
void for_each_constraint(const ModelReader& reader, Function f) {
  const std::optional<TomlValue> constraints = reader.file.get("constraints");
  if (!constraints) return;
  constraints->only_keys({"position", "velocity", "acceleration"});
  const std::pair<const char*, Level> levels[] = {
      {"position", Level::position}, {"velocity", Level::velocity}, {"acceleration", Level::acceleration}};
  for (const auto& [level_name, level] : levels) {
    const std::optional<TomlValue> rows = constraints->get(level_name);
    if (!rows) continue;
    int k = 0;
    for (const TomlValue& entry : rows->array()) f(level, entry.called(fmt::format("{} entry {}", rows->key(), ++k)));
  }
}

// what derive_constraint refuses
std::vector<Expression> forbidden_in(const ModelReader& reader, Level level) {
  if (level == Level::position) return reader.of_motion();
  if (level == Level::acceleration) return {};
  return reader.accelerations_and_inputs();
}

ConstraintRow read_exact_constraint(const ModelReader& reader, Level level, const TomlValue& value) {
  const Expression c = reader.unexpanded(value, forbidden_in(reader, level));
  reader.refuse_multipliers(value, c);
  try {
    return reader.derive(level, c, ModelReader::text_of(value, c));
  } catch (const InputError& error) {
    value.fail(error.what());
  }
}

// "gap <= 0", of a state and parameters
Expression read_condition(const ModelReader& reader, const TomlValue& value) {
  const std::vector<Expression>& ddq = reader.symbols->ddq;
  const Expression written = reader.parsed(value, ddq, parse_condition);
  reader.refuse_multipliers(value, written);
  const Expression active = reader.robot() != nullptr ? reader.robot()->expand(written) : written;
  reader.allow_only(value, active, ddq, "a condition may not depend on accelerations");
  if (active.is_constant(0)) value.fail("never holds: remove the constraint");
  return active;
}

// between 0 and 1 where it is a number
Expression read_restitution(const ModelReader& reader, const TomlValue& value) {
  std::vector<Expression> forbidden = reader.symbols->u;
  forbidden.insert(forbidden.end(), reader.symbols->ddq.begin(), reader.symbols->ddq.end());
  const Expression e = reader.expression_without(value, forbidden, "a restitution may not depend on inputs or accelerations");
  if (e.is_constant() && !(e.constant_value() >= 0 && e.constant_value() <= 1))
    value.fail(fmt::format("must lie between 0 and 1, got {}", e.constant_value()));
  return e;
}

// contact = "touch", an input that is 1 in contact and 0 apart, and restitution
void read_contact(const ModelReader& reader, Level level, const TomlValue& entry, ConstraintRow& row) {
  const std::optional<TomlValue> contact = entry.get("contact"), restitution = entry.get("restitution");
  if (!contact) {
    if (restitution) restitution->fail("belongs to a contact: name its input, contact = \"touch\"");
    return;
  }
  const std::string name = contact->text();
  const SymbolicSystem::Definition& system = reader.definition;
  const auto input = std::find(system.inputs.begin(), system.inputs.end(), name);
  if (input == system.inputs.end()) {
    contact->fail(fmt::format("'{0}' is no input of this model: declare inputs = [\"{0}\"], which is 1 in contact and 0 apart",
                              shortened(name)));
  }
  if (level != Level::position) contact->fail("a contact is a gap, of position level: write it in position");
  if (entry.has("when")) contact->fail("says when the constraint is there: remove when");
  const auto index = static_cast<int>(input - system.inputs.begin());
  const bool is_taken = std::any_of(system.constraints.begin(), system.constraints.end(),
                                    [&](const ConstraintRow& one) { return one.contact && one.contact->input == index; });
  if (is_taken) contact->fail(fmt::format("'{}' is another contact's input: each needs its own", name));
  const Actuator& actuator = reader.model.actuators[static_cast<std::size_t>(index)];
  if (!actuator.is_direct() || actuator.is_estimated()) {
    contact->fail(fmt::format("'{}' is a contact, which has neither a delay nor a lag: remove them", name));
  }
  const std::string condition = name + " > 0.5";
  switch_constraint(row, reader.parsed(condition, parse_condition), condition);
  row.contact = {index, system.graph->constant(0)};
  if (restitution) row.contact->restitution = read_restitution(reader, *restitution);
}

// "c", or { expr = "c" } with noise = 0.05, when = "gap <= 0", or contact = "touch" and restitution = 0.8
ConstraintRow read_constraint(const ModelReader& reader, Level level, const TomlValue& entry) {
  if (!entry.is_table()) return read_exact_constraint(reader, level, entry);
  entry.only_keys({"expr", "name", "noise", "when", "contact", "restitution"});
  if (!entry.has("expr")) {
    entry.fail(
        "missing expr; write { expr = \"dx*sin(heading) - dy*cos(heading)\", noise = 0.05 }, or name, when or contact in the "
        "place of noise");
  }
  ConstraintRow row = read_exact_constraint(reader, level, entry.get("expr")->called(entry.key()));
  if (const auto noise = entry.get("noise")) {
    row.noise = noise->number();
    if (row.noise < 0) noise->fail("a standard deviation must not be negative");
  }
  if (const auto when = entry.get("when")) switch_constraint(row, read_condition(reader, *when), when->text());
  read_contact(reader, level, entry, row);
  return row;
}

}  // namespace

void declare_constraint_names(ModelReader& reader) {
  if (reader.model.code.mechanics) return;
  std::size_t row = 0;
  for_each_constraint(reader, [&](Level, const TomlValue& entry) {
    ++row;
    const std::optional<TomlValue> name = entry.is_table() ? entry.get("name") : std::nullopt;
    if (!name) return;
    reader.declare(name->text(), *name);
    const std::size_t of_robot = reader.robot() != nullptr ? reader.robot()->constraints().size() : 0;
    for (const char* symbol : {"lambda0", "lambda"}) {
      reader.defined().emplace(fmt::format("{}({})", symbol, name->text()),
                               reader.definition.graph->variable(fmt::format("{}({})", symbol, of_robot + row)));
    }
  });
}

void read_constraints(ModelReader& reader) {
  if (reader.robot() != nullptr) {
    for (auto& [c, name] : reader.robot()->constraints())
      reader.definition.constraints.push_back(reader.derive(Level::position, c, std::move(name)));
  }
  for_each_constraint(reader, [&](Level level, const TomlValue& entry) {
    reader.definition.constraints.push_back(read_constraint(reader, level, entry));
  });
}

}  // namespace gp2
