#include <algorithm>
#include <set>
#include <utility>

#include <fmt/format.h>

#include "base/suggestion.hpp"
#include "model/table_readers.hpp"

// [columns], [units] and [drawing]: how logs and pictures show the system

namespace gp2 {

void read_columns(ModelReader& reader, const TomlValue& columns) {
  std::set<std::string> known, taken;
  for (Expression symbol : reader.symbols->state()) known.insert(symbol.variable_name());
  for (Expression symbol : reader.symbols->ddq) known.insert(symbol.variable_name());
  const auto is_coordinate = [&](const std::string& name) {
    return std::ranges::count(reader.definition.coordinates, name, &Coordinate::name) > 0;
  };
  for (const auto& [name, entry] : columns.entries()) {
    if (!known.contains(name)) entry.fail("not a coordinate, velocity, acceleration, input or t of this model");
    const std::string column = entry.text();
    if (column != name && known.contains(column)) {
      // columns of one kind can be exchanged; others have rates of their own
      const bool is_exchange = is_coordinate(name) && is_coordinate(column);
      entry.fail(fmt::format(
          "the column '{}' has the name of another quantity of this model, and in files that gp2 writes it is "
          "that quantity: leave this out{}",
          column, is_exchange ? fmt::format(", and read logs that are like this with `map={0}={1},{1}={0}`", column, name) : ""));
    }
    if (!taken.insert(column).second) entry.fail(fmt::format("the column '{}' is another name's already", column));
    reader.model.columns[name] = column;
  }
}

namespace {

std::string read_unit(const TomlValue& entry) {
  constexpr std::size_t longest = 30;
  const std::string unit = entry.text();
  const bool is_label = !unit.empty() && unit.size() <= longest &&
                        std::none_of(unit.begin(), unit.end(), [](unsigned char c) { return c < 32 || c == 127; });
  if (!is_label) entry.fail(R"(expected a short text, as in x = "m")");
  return unit;
}

// m: m/s, m/s², N
void derive_units(const Coordinate& coordinate, std::map<std::string, std::string>& units) {
  const auto stated = units.find(coordinate.name);
  if (stated == units.end()) return;
  const std::string unit = stated->second;
  const std::string numerator = unit.find_first_of("/ *") == std::string::npos ? unit : fmt::format("({})", unit);
  for (const std::string& velocity : {coordinate.velocity(), coordinate.velocity() + "_next"}) units[velocity] = numerator + "/s";
  for (const std::string& acceleration : {coordinate.acceleration(), "abar_" + coordinate.name})
    units[acceleration] = numerator + "/s²";
  const char* const force = unit == "m" ? "N" : unit == "rad" ? "N m" : nullptr;
  if (force == nullptr) return;
  for (const char* view : {"force_", "fc_"}) units[view + coordinate.name] = force;
}

// Of the joint of a robot; empty: it has none, as a quaternion, or is no joint's.
std::string unit_of_joint(const RobotDescription& robot, const std::string& coordinate) {
  for (const RobotDescription::Body& body : robot.bodies) {
    for (const RobotDescription::Joint& joint : body.joints) {
      const std::vector<std::string> names = joint.coordinates();
      const auto place = std::find(names.begin(), names.end(), coordinate) - names.begin();
      if (place == std::ssize(names)) continue;
      constexpr std::ptrdiff_t n_positions = 3;
      const bool is_free = joint.type == RobotDescription::Joint::Type::free;
      if (joint.type == RobotDescription::Joint::Type::hinge) return "rad";
      return joint.type == RobotDescription::Joint::Type::slide || (is_free && place < n_positions) ? "m" : "";
    }
  }
  return "";
}

}  // namespace

std::map<std::string, std::string> Model::known_units() const {
  std::map<std::string, std::string> known = units;
  for (const Coordinate& coordinate : system->coordinates()) {
    std::string unit = coordinate.angle ? "rad" : robot ? unit_of_joint(*robot, coordinate.name) : "";
    if (!unit.empty() && known.emplace(coordinate.name, std::move(unit)).second) derive_units(coordinate, known);
  }
  return known;
}

void read_units(ModelReader& reader, const TomlValue& table) {
  const SymbolicSystem::Definition& system = reader.definition;
  std::map<std::string, std::string>& units = reader.model.units;
  std::set<std::string> known(system.inputs.begin(), system.inputs.end());
  for (const Coordinate& coordinate : system.coordinates) {
    known.insert(coordinate.name);
    if (coordinate.angle) units[coordinate.name] = "rad";
  }
  for (const Parameter& parameter : system.parameters) known.insert(parameter.name);
  for (const Model::DerivedParameter& derived : reader.model.derived_parameters) known.insert(derived.name);
  for (const auto& [name, entry] : table.entries()) {
    if (!known.contains(name)) {
      entry.fail(fmt::format("not a coordinate, input or parameter of this model; units of velocities and accelerations follow{}",
                             suggestion(name, known)));
    }
    const std::string unit = read_unit(entry);
    const auto [stated, is_new] = units.emplace(name, unit);
    if (!is_new && stated->second != unit)
      entry.fail("this coordinate is an angle, whose sine and cosine are features: it is in rad");
  }
  units["t"] = "s";
  for (const Coordinate& coordinate : system.coordinates) derive_units(coordinate, units);
}

namespace {

std::vector<int> read_line(const TomlValue& entry, const std::vector<std::string>& points) {
  std::vector<int> line;
  for (const TomlValue& point : entry.array()) {
    const std::string name = point.text();
    const auto found = std::find(points.begin(), points.end(), name);
    if (found == points.end()) point.fail(fmt::format("'{}' is none of drawing.points{}", name, suggestion(name, points)));
    line.push_back(static_cast<int>(found - points.begin()));
  }
  return line;
}

}  // namespace

void read_drawing(ModelReader& reader, const TomlValue& drawing) {
  drawing.only_keys({"points", "lines"});
  if (!drawing.has("points")) drawing.fail(R"(missing points, as in points = { tip = ["x", "y"] })");
  Model::Drawing out;
  for (const auto& [name, point] : drawing.get("points")->entries()) {
    const std::vector<TomlValue> entries = point.array();
    const std::size_t size = out.points.empty() ? entries.size() : out.points.front().size();
    if (entries.size() != size || size < 2 || size > 3) {
      point.fail(fmt::format("expected two coordinates [m], or three, of every point alike, got {}", entries.size()));
    }
    out.names.push_back(name);
    out.points.emplace_back();
    for (const TomlValue& entry : entries) {
      out.points.back().push_back(
          reader.expression_without(entry, reader.of_motion(), "a point may depend on coordinates, t and parameters only"));
    }
  }
  if (const auto lines = drawing.get("lines")) {
    for (const TomlValue& line : lines->array()) out.lines.push_back(read_line(line, out.names));
  }
  reader.model.drawing = std::move(out);
}

}  // namespace gp2
