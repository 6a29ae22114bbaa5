#include <algorithm>
#include <map>
#include <set>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/suggestion.hpp"
#include "model/name_order.hpp"
#include "model/table_readers.hpp"
#include "model/tuned.hpp"
#include "robots/robot_checks.hpp"

// [parameters] and [let]

namespace gp2 {

namespace {

using Entries = std::vector<std::pair<std::string, TomlValue>>;

// mass("link7") or com('link7').x: a number of the robot that is this parameter from now on; gives the robot's own value
double read_robot_number(ModelReader& reader, const TomlValue& node, const std::string& parameter) {
  const std::string of = robot_number_name(node.text());
  if (!reader.model.robot) node.fail("only a model with a robot = \"FILE\" has such numbers; give a value instead");
  const auto [other, is_new] = reader.robot_parameters.emplace(of, parameter);
  if (!is_new) node.fail(fmt::format("{} is the parameter '{}' already", of, other->second));
  for (const auto& [name, value] : robot_numbers(*reader.model.robot)) {
    if (name == of) return value;
  }
  std::vector<std::string> bodies, joints;
  for (const RobotDescription::Body& body : reader.model.robot->bodies) bodies.push_back(body.name);
  for (const RobotDescription::Joint* joint : reader.model.robot->joints()) joints.push_back(joint->name);
  node.fail(fmt::format(
      "the robot has no number '{}'; there are mass(\"BODY\"), com(\"BODY\").x, inertia(\"BODY\").xx with the bodies {}, "
      "and damping(\"JOINT\"), stiffness, friction, armature with the joints {}",
      shortened(of), fmt::join(bodies, ", "), fmt::join(joints, ", ")));
}

bool may_be_negative(const std::string& robot_number) {
  const bool is_product_of_inertia = robot_number.starts_with("inertia(") && robot_number.back() != *(robot_number.end() - 2);
  return robot_number.starts_with("com(") || is_product_of_inertia;
}

void require_no_less_than_zero(const TomlValue& node, const std::string& of, const Parameter& parameter) {
  if (may_be_negative(of)) return;
  if (parameter.value < 0) node.fail(fmt::format("{} must be ≥ 0, got {}", of, parameter.value));
  if (parameter.bounds && parameter.bounds->first < 0) {
    node.fail(fmt::format("{} must be ≥ 0, and its bounds start at {}", of, parameter.bounds->first));
  }
}

// A body whose moments are partly estimated needs no more than to start with an inertia: in the plane one moment acts alone.
void require_possible_inertias(const ModelReader& reader, const TomlValue& parameters) {
  std::map<std::string, double> values;
  std::set<std::string> estimated;  // bodies
  for (const auto& [of, name] : reader.robot_parameters) {
    const auto parameter = std::ranges::find(reader.definition.parameters, name, &Parameter::name);
    values[of] = parameter->value;
    if (parameter->estimate) estimated.insert(of.substr(0, of.rfind('.')));
  }
  const RobotDescription robot = with_numbers(*reader.model.robot, values);
  try {
    check_robot(robot);
  } catch (const InputError& error) {
    parameters.fail(error.what());
  }
  for (std::size_t k = 0; k < robot.bodies.size(); ++k) {
    const RobotDescription::Body& body = robot.bodies[k];
    const bool is_own = body.inertia == reader.model.robot->bodies[k].inertia;
    if (is_own || estimated.contains(fmt::format("inertia(\"{}\")", body.name)) || is_of_rigid_body(body.inertia)) continue;
    parameters.fail(
        fmt::format("body '{}': no rigid body has such an inertia, of which one principal moment is larger than the sum of the "
                    "others",
                    body.name));
  }
}

// I2 = { value = "2*m", … }
void refuse_text_among_keys(const TomlValue& entry, const std::string& name) {
  if (!entry.is_table()) return;
  const std::optional<TomlValue> value = entry.get("value");
  if (!value || !value->is_text()) return;
  entry.fail(
      fmt::format("a parameter that follows from others has no bounds, no prior and no estimate of its own: write {} = \"{}\", "
                  "and say of those others what is to be estimated",
                  name, shortened(value->text())));
}

// Names may stand in any order and use each other, but not in a circle.
/// @param read  the expression of an entry, when those it uses are defined
template <class Read>
void define_in_order(ModelReader& reader, const Entries& entries, const Read& read) {
  std::vector<std::vector<std::string>> words;
  for (const auto& [name, value] : entries) {
    const std::set<std::string> of_entry = value.is_text() ? words_of(value.text()) : std::set<std::string>();
    words.emplace_back(of_entry.begin(), of_entry.end());
  }
  for (const std::size_t k : positions_by_use(entries, words, "defined in terms of itself")) {
    const auto& [name, value] = entries[k];
    reader.define(name, read(name, value));
  }
}

}  // namespace

void read_parameters(ModelReader& reader, const TomlValue& parameters) {
  for (const auto& [name, node] : parameters.entries()) {
    reader.declare(name, node);
    if (node.is_text()) continue;  // follows from others
    refuse_text_among_keys(node, name);
    const Tuned entry = read_tuned(node, {"value", "bounds", "estimate", "of", "prior"});
    Parameter parameter{name, 0, entry.bounds, entry.estimate.value_or(false), entry.prior};
    const std::optional<TomlValue> of = node.is_table() ? node.get("of") : std::nullopt;
    if (of) parameter.value = read_robot_number(reader, *of, name);
    if (entry.value) {
      parameter.value = entry.value->number();
    } else if (!of) {
      node.fail("missing value; write { value = 1.0, bounds = [0.5, 2.0], estimate = true }");
    }
    require_within(parameter.value, entry.bounds, node);
    if (of) require_no_less_than_zero(node, robot_number_name(of->text()), parameter);
    reader.definition.parameters.push_back(parameter);
  }
  if (!reader.robot_parameters.empty()) require_possible_inertias(reader, parameters);
}

void read_derived_parameters(ModelReader& reader, const TomlValue& table) {
  Entries entries = table.entries();
  std::erase_if(entries, [](const auto& entry) { return !entry.second.is_text(); });
  Model& model = reader.model;
  std::map<std::string, Expression> values;
  // to suggest from are parameters only
  const std::vector<std::string> all_names = std::exchange(reader.suggested_names(), {});
  for (const Parameter& parameter : reader.definition.parameters) {
    values.emplace(parameter.name, model.graph->constant(parameter.value));
    reader.suggested_names().push_back(parameter.name);
  }
  define_in_order(reader, entries, [&](const std::string& name, const TomlValue& entry) {
    const Expression expression = reader.unexpanded(entry);
    reader.refuse_multipliers(entry, expression);
    for (const auto& others : {reader.symbols->state(), reader.symbols->ddq})
      reader.allow_only(entry, expression, others, "a parameter may follow from other parameters only");
    const Expression value = model.graph->substitute(expression, values);
    if (!value.is_constant()) entry.fail("its value is no finite number where the other parameters have theirs");
    model.derived_parameters.push_back({name, entry.text(), expression, value.constant_value()});
    return expression;
  });
  reader.suggested_names() = all_names;
  for (const Model::DerivedParameter& derived : model.derived_parameters) reader.suggested_names().push_back(derived.name);
}

void read_let(ModelReader& reader, const TomlValue& let) {
  const Entries entries = let.entries();
  for (const auto& [name, entry] : entries) reader.declare(name, entry);
  define_in_order(reader, entries, [&](const std::string&, const TomlValue& entry) { return reader.unexpanded(entry); });
}

}  // namespace gp2
