#include <algorithm>
#include <iterator>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"
#include "model/name_order.hpp"
#include "model/table_readers.hpp"
#include "model/tuned.hpp"

// robot = "FILE", coordinates = [ … ] and inputs = [ … ]

namespace gp2 {

void read_robot(ModelReader& reader, const RobotSource& robot) {
  const std::optional<TomlValue> file = reader.file.get("robot");
  if (!file) return;
  if (reader.model.code.mechanics) file->fail("the mechanics of this model are given as code: remove it");
  try {
    reader.model.robot = robot(file->text());
  } catch (const InputError& error) {
    file->fail(error.what());
  }
  if (reader.model.robot->joints().empty()) file->fail("this robot has no joints: there is nothing that moves");
}

namespace {

void declare_coordinate(ModelReader& reader, const Coordinate& coordinate, const TomlValue& at) {
  for (const std::string& name : {coordinate.name, coordinate.velocity(), coordinate.acceleration()}) reader.declare(name, at);
  reader.definition.coordinates.push_back(coordinate);
}

// the joints of the robot, unless the file has names of its own for them
void take_coordinates_of_robot(ModelReader& reader, const TomlValue& robot) {
  for (const std::string& coordinate : reader.model.robot->coordinates()) {
    if (!is_identifier(coordinate)) {
      robot.fail(
          fmt::format("its joint '{}' has a name that cannot stand in an expression: give names of your own, one per coordinate, "
                      "in the order "
                      "of the file, with coordinates = [\"q1\", …]",
                      coordinate));
    }
    declare_coordinate(reader, {coordinate, false}, robot);
  }
}

// Of each coordinate of the robot, whether it is the angle of a hinge.
std::vector<bool> are_turns(const RobotDescription& robot) {
  std::vector<bool> out;
  for (const RobotDescription::Joint* joint : robot.joints()) {
    out.insert(out.end(), joint->coordinates().size(), joint->type == RobotDescription::Joint::Type::hinge);
  }
  return out;
}

// "q1", or { name = "q1", angle = true }
Coordinate read_coordinate(const TomlValue& entry) {
  if (!entry.is_table()) return {entry.text(), false};
  entry.only_keys({"name", "angle"});
  if (!entry.has("name")) entry.fail(R"(expected { name = "q1", angle = true })");
  Coordinate coordinate;
  coordinate.name = entry.get("name")->text();
  if (const auto angle = entry.get("angle")) coordinate.angle = angle->boolean();
  return coordinate;
}

// delay = 0.02, or { value = 0.02, bounds = [0, 0.1], estimate = true }
void read_lateness(const TomlValue& input, const std::string& word, Parameter& out) {
  const std::optional<TomlValue> lateness = input.get(word);
  if (!lateness) return;
  const Tuned entry = read_tuned(*lateness, {"value", "bounds", "estimate", "prior"});
  if (entry.value) out.value = entry.value->number();
  const auto require_not_negative = [&](double seconds) {
    if (seconds >= 0) return;
    lateness->fail(fmt::format("a {} [s] must not be negative, got {}: nothing acts before it is commanded", word, seconds));
  };
  require_not_negative(out.value);
  out.estimate = entry.estimate.value_or(false);
  out.bounds = entry.bounds;
  if (out.bounds) require_not_negative(out.bounds->first);
  require_within(out.value, out.bounds, *lateness);
  out.prior = entry.prior;
}

}  // namespace

void read_coordinates(ModelReader& reader) {
  const std::optional<RobotDescription>& robot = reader.model.robot;
  const std::optional<TomlValue> coordinates = reader.file.get("coordinates");
  if (!coordinates) {
    if (!robot) reader.file.fail_at(1, "coordinates", R"(missing; write coordinates = ["q1", "q2"])");
    take_coordinates_of_robot(reader, *reader.file.get("robot"));
    return;
  }
  for (const TomlValue& entry : coordinates->array()) declare_coordinate(reader, read_coordinate(entry), entry);
  if (reader.nq() == 0) coordinates->fail("a system needs at least one coordinate");
  if (!robot) return;
  const std::vector<std::string> of_robot = robot->coordinates();
  if (of_robot.size() != reader.nq()) {
    coordinates->fail(fmt::format("{} names for the {} coordinates of the robot; they are, in this order: {}", reader.nq(),
                                  of_robot.size(), fmt::join(of_robot, ", ")));
  }
  const std::vector<TomlValue> entries = coordinates->array();
  const std::vector<bool> turns = are_turns(*robot);
  for (std::size_t j = 0; j < of_robot.size(); ++j) {
    const Coordinate& own = reader.definition.coordinates[j];
    if (own.name != of_robot[j] && std::ranges::count(of_robot, own.name) > 0) {
      entries[j].fail(
          fmt::format("the name of another coordinate of the robot, of which this one is '{}'; they are, in this order: {}",
                      of_robot[j], fmt::join(of_robot, ", ")));
    }
    if (own.angle && !turns[j])
      entries[j].fail(fmt::format("no angle: it is '{}' of the robot, which no hinge turns", of_robot[j]));
  }
}

void read_inputs(ModelReader& reader, const TomlValue& inputs) {
  for (const TomlValue& entry : inputs.array()) {
    if (entry.is_table()) {
      entry.only_keys({"name", "delay", "lag"});
      if (!entry.has("name")) entry.fail(R"(expected { name = "u", delay = 0.02, lag = 0.05 })");
    }
    const std::string name = (entry.is_table() ? *entry.get("name") : entry).text();
    reader.definition.inputs.push_back(name);
    reader.declare(name, entry);
    Actuator& actuator = reader.model.actuators.emplace_back(Actuator::direct(name));
    if (!entry.is_table()) continue;
    read_lateness(entry, "delay", actuator.delay);
    read_lateness(entry, "lag", actuator.lag);
  }
}

void refuse_names_of_other_columns(const ModelReader& reader) {
  const System& system = *reader.model.system;
  std::vector<std::string> names = system.state_names();
  std::ranges::move(system.acceleration_names(), std::back_inserter(names));
  const auto forbid = [&](const std::string& column, const std::string& of) {
    if (std::ranges::count(names, column) == 0) return;
    const bool is_input = std::ranges::count(system.inputs(), column) > 0;
    const char* const key = is_input ? "inputs" : reader.file.has("coordinates") ? "coordinates" : "robot";
    const auto at = reader.file.get(key);
    reader.file.fail_at(at ? at->line() : 1, key,
                        fmt::format("the column {} would be a name of this model and what logs and predictions call a quantity "
                                    "of {}; choose another name{}",
                                    column, of, is_input ? "" : reader.way_to_rename()));
  };
  for (const Coordinate& coordinate : system.coordinates()) {
    const std::string of = fmt::format("'{}'", coordinate.name);
    for (const std::string& name : {coordinate.name, coordinate.velocity(), coordinate.acceleration()}) forbid(name + "_std", of);
    forbid(coordinate.velocity() + "_next", of);
    for (const char* prefix : {"abar_", "fc_", "force_"}) forbid(prefix + coordinate.name, of);
  }
  for (const char* column : {"episode", "energy", "energy_std", "distance_from_data"}) forbid(column, "the motion");
  for (int row = 1; row <= system.nc(); ++row) forbid(fmt::format("lambda{}", row), "the constraints");
}

}  // namespace gp2
