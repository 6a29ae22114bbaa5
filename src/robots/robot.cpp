#include "gp2/robots/robot.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <set>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <Eigen/Dense>
#include <nlohmann/json.hpp>

#include "gp2/error.hpp"
#include "robots/robot_checks.hpp"

namespace gp2 {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using Json = nlohmann::ordered_json;  // written: keys in the order that a person reads
using ParsedJson = nlohmann::json;    // read: a key is found at once, however many there are
using Body = RobotDescription::Body;
using Connect = RobotDescription::Connect;
using Coupling = RobotDescription::Coupling;
using Joint = RobotDescription::Joint;
using Site = RobotDescription::Site;
using Weld = RobotDescription::Weld;

std::vector<const Joint*> RobotDescription::joints() const {
  std::vector<const Joint*> all;
  for (const Body& body : bodies) {
    for (const Joint& joint : body.joints) all.push_back(&joint);
  }
  return all;
}

std::vector<std::string> Joint::coordinates() const {
  if (!has_quaternion()) return {name};
  std::vector<std::string> names;
  for (const char* component : {"x", "y", "z", "qw", "qx", "qy", "qz"}) {
    if (type == Type::free || component[0] == 'q') names.push_back(fmt::format("{}_{}", name, component));
  }
  return names;
}

std::vector<std::string> RobotDescription::coordinates() const {
  std::vector<std::string> all;
  for (const Joint* joint : joints()) {
    for (std::string& coordinate : joint->coordinates()) all.push_back(std::move(coordinate));
  }
  return all;
}

int RobotDescription::body_index(const std::string& body_name) const {
  const auto body = std::find_if(bodies.begin(), bodies.end(), [&](const Body& other) { return other.name == body_name; });
  return body == bodies.end() ? -1 : static_cast<int>(body - bodies.begin());
}

namespace {

// ---- rules

// how far unit vectors, rotations and inertias may be from their law: hand-written ones have fewer digits than a double
constexpr double tolerance = 1e-9;

void require(bool rule, const std::string& where, const std::string& what) {
  if (!rule) throw InputError(fmt::format("{}: {}", where, what));
}

template <class Numbers>
void check_finite(const Numbers& numbers, const std::string& where, const char* what) {
  require(numbers.allFinite(), where, fmt::format("{} is not finite", what));
}

void check_finite(double number, const std::string& where, const char* what) {
  require(std::isfinite(number), where, fmt::format("{} is not finite", what));
}

void check_not_negative(double number, const std::string& where, const char* what) {
  require(std::isfinite(number) && number >= 0, where, fmt::format("{} must be ≥ 0, got {}", what, number));
}

void check_rotation(const Matrix3d& rotation, const std::string& where) {
  check_finite(rotation, where, "its rotation");
  const double defect = (rotation.transpose() * rotation - Matrix3d::Identity()).cwiseAbs().maxCoeff();
  require(defect <= tolerance && rotation.determinant() > 0, where, "its rotation must have orthonormal, right-handed columns");
}

Vector3d principal_moments(const Matrix3d& inertia) {
  return Eigen::SelfAdjointEigenSolver<Matrix3d>(inertia, Eigen::EigenvaluesOnly).eigenvalues();
}

void check_inertia(const Matrix3d& inertia, const std::string& where) {
  check_finite(inertia, where, "its inertia");
  require(inertia == inertia.transpose(), where, "its inertia must be symmetric");
  const Vector3d moments = principal_moments(inertia);
  require(moments.minCoeff() >= -tolerance * moments.maxCoeff(), where,
          fmt::format("its inertia has the principal moment {}, but none can be negative", moments.minCoeff()));
}

// names of one kind are there and stand once
class Names {
 public:
  explicit Names(const char* kind) : kind_(kind) {}

  void add(const std::string& name) {
    require(!name.empty(), fmt::format("{} {}", kind_, names_.size()), "it has no name");
    require(names_.insert(name).second, fmt::format("{} '{}'", kind_, name), "its name stands twice");
  }

 private:
  const char* kind_;
  std::set<std::string> names_;
};

void check_joint(const Joint& joint) {
  const std::string where = fmt::format("joint '{}'", joint.name);
  check_finite(joint.axis, where, "its axis");
  require(std::abs(joint.axis.norm() - 1) <= tolerance, where,
          fmt::format("its axis must have length 1, got {}", joint.axis.norm()));
  check_finite(joint.anchor, where, "its anchor");
  check_finite(joint.reference, where, "its reference");
  check_finite(joint.spring_reference, where, "its spring_reference");
  check_not_negative(joint.armature, where, "its armature");
  check_not_negative(joint.damping, where, "its damping");
  check_not_negative(joint.stiffness, where, "its stiffness");
  check_not_negative(joint.dry_friction, where, "its dry_friction");
  require(!joint.has_quaternion() || joint.stiffness == 0, where, "only hinge and slide joints may have a stiffness");
}

void check_body(const Body& body, int index) {
  const std::string where = fmt::format("body '{}'", body.name);
  require(body.parent >= -1 && body.parent < index, where,
          fmt::format("its parent is {}, but must be −1 (the world) or a body before it, which is {}", body.parent, index));
  check_finite(body.position, where, "its position");
  check_rotation(body.rotation, where);
  check_not_negative(body.mass, where, "its mass");
  check_finite(body.com, where, "its com");
  check_inertia(body.inertia, where);
  const bool is_free =
      std::any_of(body.joints.begin(), body.joints.end(), [](const Joint& j) { return j.type == Joint::Type::free; });
  require(!is_free || (body.parent == -1 && body.joints.size() == 1), where,
          "a free joint must be its only one, and the world its parent");
}

// closing loops
class LoopChecks {
 public:
  explicit LoopChecks(const RobotDescription& robot) : robot_(robot), joints_(robot.joints()) {}

  void check_connect(const Connect& connect, const std::string& where) const {
    for (const int body : connect.bodies) {
      require(body >= -1 && body < static_cast<int>(robot_.bodies.size()), where,
              fmt::format("it names body {}, but there are −1 … {}", body, robot_.bodies.size() - 1));
    }
    require(connect.bodies[0] != connect.bodies[1], where, "it must hold two different bodies");
    for (const Vector3d& anchor : connect.anchors) check_finite(anchor, where, "an anchor");
  }

  void check_length(const Coupling::Length& length, const std::string& where) const {
    require(!length.joints.empty() || !length.segments.empty(), where, "a length has neither joints nor segments");
    for (const auto& [name, coefficient] : length.joints) {
      const auto joint = std::find_if(joints_.begin(), joints_.end(), [&name = name](const Joint* j) { return j->name == name; });
      require(joint != joints_.end(), where, fmt::format("there is no joint '{}'", name));
      require(!(*joint)->has_quaternion(), where, fmt::format("joint '{}' has a quaternion, which is no length", name));
      check_finite(coefficient, where, "a coefficient");
    }
    for (const Coupling::Segment& segment : length.segments) {
      for (const int site : {segment.first, segment.second}) {
        require(site >= 0 && site < static_cast<int>(robot_.sites.size()), where,
                fmt::format("it names site {}, but there are {}", site, robot_.sites.size()));
      }
      check_finite(segment.factor, where, "a factor");
    }
    check_finite(length.reference, where, "a reference");
  }

  void check_coupling(const Coupling& coupling) const {
    const std::string where = fmt::format("coupling '{}'", coupling.name);
    check_length(coupling.y, where);
    require(coupling.x.size() <= 1, where, fmt::format("x must hold one length or none, got {}", coupling.x.size()));
    for (const Coupling::Length& x : coupling.x) check_length(x, where);
    for (const double coefficient : coupling.polynomial) check_finite(coefficient, where, "a coefficient of its polynomial");
  }

 private:
  const RobotDescription& robot_;
  const std::vector<const Joint*> joints_;
};

}  // namespace

void check_robot(const RobotDescription& robot) {
  check_finite(robot.gravity, "robot", "its gravity");
  Names bodies("body");
  Names joints("joint");
  Names sites("site");
  for (std::size_t k = 0; k < robot.bodies.size(); ++k) {
    const Body& body = robot.bodies[k];
    bodies.add(body.name);
    check_body(body, static_cast<int>(k));
    for (const Joint& joint : body.joints) {
      joints.add(joint.name);
      check_joint(joint);
    }
  }
  for (const Site& site : robot.sites) {
    sites.add(site.name);
    const std::string where = fmt::format("site '{}'", site.name);
    require(site.body >= -1 && site.body < static_cast<int>(robot.bodies.size()), where,
            fmt::format("it is on body {}, but there are −1 … {}", site.body, robot.bodies.size() - 1));
    check_finite(site.position, where, "its position");
    check_rotation(site.rotation, where);
  }
  const LoopChecks loops(robot);
  for (const Connect& connect : robot.connects) loops.check_connect(connect, fmt::format("connect '{}'", connect.name));
  for (const Weld& weld : robot.welds) {
    const std::string where = fmt::format("weld '{}'", weld.connect.name);
    loops.check_connect(weld.connect, where);
    check_rotation(weld.rotation, where);
  }
  for (const Coupling& coupling : robot.couplings) loops.check_coupling(coupling);
}

bool is_of_rigid_body(const Matrix3d& inertia) {
  const Vector3d moments = principal_moments(inertia);
  return moments.maxCoeff() <= (1 + tolerance) * moments.sum() / 2;
}

// ---- to JSON

namespace {

Json vector_json(const Vector3d& vector) { return {vector.x(), vector.y(), vector.z()}; }

// rows, as one reads a matrix
Json matrix_json(const Matrix3d& matrix) {
  Json json = Json::array();
  for (int row = 0; row < 3; ++row) json.push_back(vector_json(matrix.row(row)));
  return json;
}

constexpr std::array<std::pair<Joint::Type, const char*>, 4> joint_types = {
    {{Joint::Type::hinge, "hinge"}, {Joint::Type::slide, "slide"}, {Joint::Type::ball, "ball"}, {Joint::Type::free, "free"}}};

Json joint_json(const Joint& joint) {
  const auto* const type =
      std::find_if(joint_types.begin(), joint_types.end(), [&](const auto& known) { return known.first == joint.type; });
  return {{"name", joint.name},
          {"type", type->second},
          {"axis", vector_json(joint.axis)},
          {"anchor", vector_json(joint.anchor)},
          {"reference", joint.reference},
          {"armature", joint.armature},
          {"damping", joint.damping},
          {"stiffness", joint.stiffness},
          {"spring_reference", joint.spring_reference},
          {"dry_friction", joint.dry_friction}};
}

Json body_json(const Body& body) {
  Json json = {{"name", body.name},
               {"parent", body.parent},
               {"position", vector_json(body.position)},
               {"rotation", matrix_json(body.rotation)},
               {"mass", body.mass},
               {"com", vector_json(body.com)},
               {"inertia", matrix_json(body.inertia)},
               {"joints", Json::array()}};
  for (const Joint& joint : body.joints) json["joints"].push_back(joint_json(joint));
  return json;
}

Json site_json(const Site& site) {
  return {{"name", site.name},
          {"body", site.body},
          {"position", vector_json(site.position)},
          {"rotation", matrix_json(site.rotation)}};
}

Json connect_json(const Connect& connect) {
  return {{"name", connect.name},
          {"bodies", connect.bodies},
          {"anchors", Json::array({vector_json(connect.anchors[0]), vector_json(connect.anchors[1])})}};
}

Json weld_json(const Weld& weld) {
  Json json = connect_json(weld.connect);
  json["rotation"] = matrix_json(weld.rotation);
  return json;
}

Json length_json(const Coupling::Length& length) {
  Json json = {{"joints", Json::array()}, {"segments", Json::array()}, {"reference", length.reference}};
  for (const auto& [name, coefficient] : length.joints) {
    json["joints"].push_back({{"name", name}, {"coefficient", coefficient}});
  }
  for (const Coupling::Segment& segment : length.segments) {
    json["segments"].push_back({{"first", segment.first}, {"second", segment.second}, {"factor", segment.factor}});
  }
  return json;
}

Json coupling_json(const Coupling& coupling) {
  Json json = {
      {"name", coupling.name}, {"y", length_json(coupling.y)}, {"x", Json::array()}, {"polynomial", coupling.polynomial}};
  for (const Coupling::Length& x : coupling.x) json["x"].push_back(length_json(x));
  return json;
}

template <class Item, class ToJson>
Json list_json(const std::vector<Item>& items, ToJson item_json) {
  Json json = Json::array();
  for (const Item& item : items) json.push_back(item_json(item));
  return json;
}

}  // namespace

std::string to_json(const RobotDescription& robot) {
  const Json json = {{"name", robot.name},
                     {"gravity", vector_json(robot.gravity)},
                     {"bodies", list_json(robot.bodies, body_json)},
                     {"sites", list_json(robot.sites, site_json)},
                     {"connects", list_json(robot.connects, connect_json)},
                     {"welds", list_json(robot.welds, weld_json)},
                     {"couplings", list_json(robot.couplings, coupling_json)},
                     {"notes", robot.notes}};
  return json.dump(1, ' ', false, Json::error_handler_t::replace);
}

// ---- from JSON

namespace {

// An entry of the JSON text, with the words that say where it stands. Each has a fixed set of keys: one more or less is an error.
class Entry {
 public:
  Entry(const ParsedJson& json, std::string where) : json_(json), where_(std::move(where)) {}

  // the entry is an object with these keys
  void has(std::initializer_list<const char*> keys) const {
    if (!json_.is_object()) fail("an object");
    for (const char* key : keys) {
      if (!json_.contains(key)) throw InputError(fmt::format("{}: '{}' is missing", where_, key));
    }
    for (const auto& [key, value] : json_.items()) {
      if (std::find(keys.begin(), keys.end(), key) == keys.end()) {
        throw InputError(fmt::format("{}: '{}' is not known; there is: {}", where_, key, fmt::join(keys, ", ")));
      }
    }
  }

  [[nodiscard]] Entry operator[](const char* key) const { return {json_.at(key), fmt::format("{}.{}", where_, key)}; }

  // of an array
  [[nodiscard]] std::vector<Entry> items() const {
    if (!json_.is_array()) fail("an array");
    std::vector<Entry> entries;
    for (const ParsedJson& item : json_) entries.emplace_back(item, fmt::format("{}[{}]", where_, entries.size()));
    return entries;
  }
  [[nodiscard]] std::vector<Entry> items(std::size_t n) const {
    std::vector<Entry> entries = items();
    if (entries.size() != n) throw InputError(fmt::format("{}: has {} entries, must have {}", where_, entries.size(), n));
    return entries;
  }

  [[nodiscard]] std::string text() const {
    if (!json_.is_string()) fail("a text");
    return json_.get<std::string>();
  }
  [[nodiscard]] double number() const {
    if (!json_.is_number()) fail("a number");
    return json_.get<double>();
  }
  [[nodiscard]] int integer() const {
    if (!json_.is_number_integer()) fail("a whole number");
    // ParsedJson itself would wrap
    if (std::abs(json_.get<double>()) > std::numeric_limits<int>::max()) fail("a smaller number");
    return json_.get<int>();
  }
  [[nodiscard]] Vector3d vector() const {
    const std::vector<Entry> numbers = items(3);
    return {numbers[0].number(), numbers[1].number(), numbers[2].number()};
  }
  [[nodiscard]] Matrix3d matrix() const {
    Matrix3d matrix;
    int row = 0;
    for (const Entry& entry : items(3)) matrix.row(row++) = entry.vector();
    return matrix;
  }

  // every item of an array, read by `read`
  template <class Read>
  [[nodiscard]] auto list(Read read) const {
    std::vector<decltype(read(*this))> values;
    for (const Entry& item : items()) values.push_back(read(item));
    return values;
  }

  [[noreturn]] void fail(const std::string& expected) const {
    const std::string got =
        json_.is_structured() ? json_.type_name() : json_.dump(-1, ' ', false, ParsedJson::error_handler_t::replace);
    throw InputError(fmt::format("{}: {} stands where {} must", where_, got, expected));
  }

 private:
  const ParsedJson& json_;
  std::string where_;
};

Joint joint_from(const Entry& entry) {
  entry.has(
      {"name", "type", "axis", "anchor", "reference", "armature", "damping", "stiffness", "spring_reference", "dry_friction"});
  Joint joint;
  joint.name = entry["name"].text();
  const std::string type = entry["type"].text();
  const auto* const known =
      std::find_if(joint_types.begin(), joint_types.end(), [&](const auto& one) { return one.second == type; });
  if (known == joint_types.end()) entry["type"].fail("hinge, slide, ball or free");
  joint.type = known->first;
  joint.axis = entry["axis"].vector();
  joint.anchor = entry["anchor"].vector();
  joint.reference = entry["reference"].number();
  joint.armature = entry["armature"].number();
  joint.damping = entry["damping"].number();
  joint.stiffness = entry["stiffness"].number();
  joint.spring_reference = entry["spring_reference"].number();
  joint.dry_friction = entry["dry_friction"].number();
  return joint;
}

Body body_from(const Entry& entry) {
  entry.has({"name", "parent", "position", "rotation", "mass", "com", "inertia", "joints"});
  Body body;
  body.name = entry["name"].text();
  body.parent = entry["parent"].integer();
  body.position = entry["position"].vector();
  body.rotation = entry["rotation"].matrix();
  body.mass = entry["mass"].number();
  body.com = entry["com"].vector();
  body.inertia = entry["inertia"].matrix();
  body.joints = entry["joints"].list(joint_from);
  return body;
}

Site site_from(const Entry& entry) {
  entry.has({"name", "body", "position", "rotation"});
  return {entry["name"].text(), entry["body"].integer(), entry["position"].vector(), entry["rotation"].matrix()};
}

Connect connect_keys_from(const Entry& entry) {
  Connect connect;
  connect.name = entry["name"].text();
  const std::vector<Entry> bodies = entry["bodies"].items(2);
  const std::vector<Entry> anchors = entry["anchors"].items(2);
  for (std::size_t k = 0; k < 2; ++k) {
    connect.bodies.at(k) = bodies[k].integer();
    connect.anchors.at(k) = anchors[k].vector();
  }
  return connect;
}

Connect connect_from(const Entry& entry) {
  entry.has({"name", "bodies", "anchors"});
  return connect_keys_from(entry);
}

Weld weld_from(const Entry& entry) {
  entry.has({"name", "bodies", "anchors", "rotation"});
  return {connect_keys_from(entry), entry["rotation"].matrix()};
}

Coupling::Length length_from(const Entry& entry) {
  entry.has({"joints", "segments", "reference"});
  Coupling::Length length;
  length.joints = entry["joints"].list([](const Entry& term) {
    term.has({"name", "coefficient"});
    return std::pair(term["name"].text(), term["coefficient"].number());
  });
  length.segments = entry["segments"].list([](const Entry& term) {
    term.has({"first", "second", "factor"});
    return Coupling::Segment{term["first"].integer(), term["second"].integer(), term["factor"].number()};
  });
  length.reference = entry["reference"].number();
  return length;
}

Coupling coupling_from(const Entry& entry) {
  entry.has({"name", "y", "x", "polynomial"});
  Coupling coupling;
  coupling.name = entry["name"].text();
  coupling.y = length_from(entry["y"]);
  coupling.x = entry["x"].list(length_from);
  const std::vector<Entry> coefficients = entry["polynomial"].items(coupling.polynomial.size());
  std::transform(coefficients.begin(), coefficients.end(), coupling.polynomial.begin(),
                 [](const Entry& coefficient) { return coefficient.number(); });
  return coupling;
}

}  // namespace

RobotDescription robot_from_json(const std::string& text) {
  const ParsedJson json = ParsedJson::parse(text, nullptr, false);
  if (json.is_discarded()) throw InputError("robot: not valid JSON: the text is cut short or damaged");
  const Entry entry(json, "robot");
  entry.has({"name", "gravity", "bodies", "sites", "connects", "welds", "couplings", "notes"});
  RobotDescription robot;
  robot.name = entry["name"].text();
  robot.gravity = entry["gravity"].vector();
  robot.bodies = entry["bodies"].list(body_from);
  robot.sites = entry["sites"].list(site_from);
  robot.connects = entry["connects"].list(connect_from);
  robot.welds = entry["welds"].list(weld_from);
  robot.couplings = entry["couplings"].list(coupling_from);
  robot.notes = entry["notes"].list([](const Entry& note) { return note.text(); });
  check_robot(robot);
  return robot;
}

}  // namespace gp2
