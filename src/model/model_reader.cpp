#include "model/model_reader.hpp"

#include <algorithm>
#include <utility>

#include <fmt/format.h>

#include "base/suggestion.hpp"
#include "gp2/error.hpp"
#include "mechanics/known_multipliers.hpp"
#include "model/name_order.hpp"
#include "model/table_readers.hpp"

namespace gp2 {

void ModelReader::declare(const std::string& name, const TomlValue& at) {
  static const std::set<std::string> reserved = {"pi",   "sin", "cos", "tan",  "asin", "acos", "atan", "atan2", "sinh",   "cosh",
                                                 "tanh", "exp", "log", "sqrt", "abs",  "sign", "min",  "max",   "lambda0"};
  if (!is_identifier(name)) {
    at.fail(fmt::format("'{}' is not a name: use letters, digits and _, beginning with a letter", name));
  }
  if (reserved.contains(name)) {
    at.fail(fmt::format("'{}' is the name of a function or constant; choose another{}", name, way_to_rename()));
  }
  if (!names_.insert(name).second) {
    at.fail(fmt::format("the name '{}' is taken already; choose another{}", name, way_to_rename()));
  }
}

const char* ModelReader::way_to_rename() const {
  return model.robot && !file.has("coordinates")
             ? R"(, for a joint by coordinates = ["q1", …], one per coordinate, in the order of the file)"
             : "";
}

void ModelReader::define_symbols() {
  symbols.emplace(*definition.graph, definition.coordinates, definition.inputs, definition.parameters);
  if (model.robot) {
    std::map<std::string, Expression> numbers;
    for (const auto& [of, parameter] : robot_parameters) numbers.emplace(of, definition.graph->variable(parameter));
    model.robot_expressions_ = std::make_shared<RobotExpressions>(*model.robot, *definition.graph, *symbols, std::move(numbers));
  }
  for (Expression symbol : symbols->state_and_parameters()) define(symbol.variable_name(), symbol);
  for (Expression symbol : symbols->ddq) define(symbol.variable_name(), symbol);
}

std::vector<TomlValue> ModelReader::rows_per_coordinate(const TomlValue& matrix) const {
  std::vector<TomlValue> rows = matrix.array();
  if (rows.size() != nq()) matrix.fail(fmt::format("expected {} rows, one per coordinate, got {}", nq(), rows.size()));
  return rows;
}

Expression ModelReader::expression_without(const TomlValue& value, const std::vector<Expression>& forbidden,
                                           const char* rule) const {
  const Expression e = expanded(value, forbidden);
  refuse_multipliers(value, e);
  allow_only(value, e, forbidden, rule);
  return e;
}

Expression ModelReader::expression_with_multipliers(const TomlValue& value, std::string& multiplier, const char* rule) const {
  const Expression e = expanded(value, symbols->ddq);
  for (const std::string& read : multipliers_of(e)) {
    if (const auto fault = row_fault(read, model.system->nc())) value.fail(*fault);
    if (multiplier.empty()) multiplier = read;
    if (const auto fault = mixture_fault(multiplier, read)) value.fail(*fault);
  }
  allow_only(value, e, symbols->ddq, rule);
  return e;
}

Expression ModelReader::feature(const TomlValue& value) const {
  std::string multiplier;
  const Expression e = expression_with_multipliers(value, multiplier, "a feature may not depend on accelerations");
  if (is_multiplier_of_motion(multiplier)) {
    value.fail("lambda is what the latents make it, so that only directions and [truth] may read it; write lambda0");
  }
  return e;
}

Expression ModelReader::expanded(const TomlValue& value, const std::vector<Expression>& forbidden) const {
  const Expression e = unexpanded(value, forbidden);
  return robot() != nullptr ? robot()->expand(e) : e;
}

Expression ModelReader::unexpanded(const TomlValue& value, const std::vector<Expression>& forbidden) const {
  if (value.is_number()) return definition.graph->constant(value.number());
  if (!value.is_text()) value.fail(fmt::format("expected an expression in quotes, or a number, got {}", value.written()));
  return parsed(value, forbidden, parse_expression);
}

Expression ModelReader::parsed(const TomlValue& value, const std::vector<Expression>& forbidden,
                               decltype(parse_expression)& parse) const {
  const std::string text = value.text();
  try {
    return model.parse_symbols(text, forbidden, parse);
  } catch (const InputError& error) {
    value.fail(fmt::format("\"{}\", {}", shortened(text), error.what()));
  }
}

std::vector<std::string> ModelReader::multipliers_of(Expression e) const {
  std::vector<std::string> multipliers = definition.graph->variables_of(e);
  std::erase_if(multipliers, [](const std::string& variable) { return !is_multiplier(variable); });
  return multipliers;
}

void ModelReader::refuse_multipliers(const TomlValue& value, Expression e) const {
  for (const std::string& multiplier : multipliers_of(e)) {
    value.fail(fmt::format(
        "{} follows from M, F and the constraints, so that it may stand in features, directions, [truth] and [let] only",
        multiplier));
  }
}

void ModelReader::allow_only(const TomlValue& value, Expression e, const std::vector<Expression>& forbidden,
                             const char* rule) const {
  const std::vector<std::string> used = definition.graph->variables_of(e);
  for (Expression symbol : forbidden) {
    if (std::binary_search(used.begin(), used.end(), symbol.variable_name()))
      value.fail(fmt::format("{}, but this entry depends on '{}'", rule, symbol.variable_name()));
  }
}

std::vector<Expression> ModelReader::accelerations_and_inputs() const {
  std::vector<Expression> both = symbols->ddq;
  both.insert(both.end(), symbols->u.begin(), symbols->u.end());
  return both;
}

std::vector<Expression> ModelReader::of_motion() const {
  std::vector<Expression> all = symbols->dq;
  const std::vector<Expression> rest = accelerations_and_inputs();
  all.insert(all.end(), rest.begin(), rest.end());
  return all;
}

ConstraintRow ModelReader::derive(ConstraintRow::Level level, Expression c, std::string text) const {
  if (robot() == nullptr) return derive_constraint(level, c, std::move(text), *symbols);
  return robot()->derive_constraint(level, c, std::move(text), definition.coordinates, definition.inputs, definition.parameters);
}

std::vector<std::size_t> positions_by_use(const std::vector<std::pair<std::string, TomlValue>>& entries,
                                          const std::vector<std::vector<std::string>>& words, const char* fault) {
  std::map<std::string, std::size_t> position;
  for (const auto& entry : entries) position.emplace(entry.first, position.size());
  std::vector<std::vector<std::size_t>> uses(entries.size());
  for (std::size_t k = 0; k < entries.size(); ++k) {
    for (const std::string& word : words[k]) {
      if (const auto other = position.find(word); other != position.end()) uses[k].push_back(other->second);
    }
  }
  Order order = order_by_use(uses);
  if (order.circle.empty()) return std::move(order.positions);
  // ": a uses b uses a"
  constexpr std::size_t enough = 8;
  std::string text = std::string(fault) + ": ";
  for (std::size_t k = 0; k < std::min(order.circle.size(), enough); ++k)
    text += fmt::format("{} uses ", entries[order.circle[k]].first);
  if (order.circle.size() > enough) text += "… uses ";
  const auto& [name, value] = entries[order.circle.front()];
  value.fail(text + name);
}

std::string robot_number_name(std::string_view written) {
  std::string name;
  bool is_in_quotes = false;  // where the names of bodies and joints stand, which may have spaces
  for (const char c : written) {
    const bool is_quote = c == '"' || c == '\'';
    if (is_quote) is_in_quotes = !is_in_quotes;
    if (c != ' ' || is_in_quotes) name += is_quote ? '"' : c;
  }
  return name;
}

RobotNames robot_names(const Model& model) {
  const toml::table root = toml::parse(model.text, model.name);
  RobotNames names;
  names.file = root["robot"].value_or(std::string());
  if (const toml::table* const parameters = root["parameters"].as_table()) {
    for (const auto& [parameter, node] : *parameters) {
      const toml::table* const entry = node.as_table();
      if (entry == nullptr || !entry->contains("of")) continue;
      names.parameters[robot_number_name((*entry)["of"].value_or(std::string()))] = parameter.str();
    }
  }
  return names;
}

void read_model(const toml::table& root, const RobotSource& robot, Model& model) {
  ModelReader reader(TomlValue(model.name, root, ""), model);
  reader.file.only_keys({"name", "robot", "coordinates", "inputs", "parameters", "let", "mechanics", "constraints", "latent",
                         "noise", "truth", "sampling", "motion", "columns", "units", "drawing"});
  reader.definition.graph = model.graph = std::make_shared<ExpressionGraph>();
  const std::optional<TomlValue> name = reader.file.get("name");
  reader.definition.name = name ? name->text() : model.name;
  const auto read = [&](const char* key, void (*read_value)(ModelReader&, const TomlValue&)) {
    if (const auto value = reader.file.get(key)) read_value(reader, *value);
  };
  read_robot(reader, robot);
  read_coordinates(reader);
  read("inputs", read_inputs);
  read("parameters", read_parameters);
  reader.define_symbols();
  read("parameters", read_derived_parameters);
  declare_constraint_names(reader);
  read("let", read_let);
  if (model.code.mechanics) {
    ask_code_for_mechanics(reader);
  } else {
    read_mechanics(reader);
    read_constraints(reader);
    model.system = std::make_shared<const SymbolicSystem>(reader.definition);
    if (!model.robot) check_mass_symmetry(reader);
  }
  refuse_names_of_other_columns(reader);
  read_latents(reader);
  read("noise", read_noise);
  read("truth", read_truth);
  read("sampling", read_sampling);
  read("motion", read_motion);
  read("columns", read_columns);
  read("units", read_units);
  // last, so that M, A, b and F are built the same way with these and without
  if (!model.code.mechanics) read_potential(reader);
  read("drawing", read_drawing);
}

}  // namespace gp2
