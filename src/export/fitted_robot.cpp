#include "export/fitted_robot.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <optional>
#include <string_view>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <Eigen/Dense>

#include "export/xml_text.hpp"
#include "gp2/error.hpp"
#include "robots/robot_checks.hpp"

namespace gp2 {

namespace {

using Body = RobotDescription::Body;
using Eigen::Matrix3d;
using Eigen::Vector3d;
using Element = XmlText::Element;
using Joint = RobotDescription::Joint;

// kind("NAME").component
struct NumberName {
  std::string kind, of, component;

  explicit NumberName(const std::string& name) {
    const std::size_t open = name.find("(\""), close = name.rfind("\")");
    kind = name.substr(0, open);
    of = name.substr(open + 2, close - open - 2);
    if (close + 3 <= name.size()) component = name.substr(close + 3);
  }
  [[nodiscard]] bool is_of_body() const { return kind == "mass" || kind == "com" || kind == "inertia"; }
};

int axis_of(char letter) { return letter - 'x'; }

// without −0, which eigenvectors have
std::string numbers_text(std::vector<double> numbers) {
  for (double& number : numbers) number += 0.0;
  return fmt::format("{}", fmt::join(numbers, " "));
}

// What stands in a file as 0.3 and what a fit found for it. Two hyphens, which a comment may not have, cannot come from numbers.
std::string comment_text(const std::vector<const FittedNumber*>& numbers) {
  std::vector<std::string> entries;
  for (const FittedNumber* number : numbers) {
    const NumberName name(number->name);
    const std::string what = name.component.empty() ? name.kind : fmt::format("{}.{}", name.kind, name.component);
    const std::string how = !number->is_estimated           ? "held"
                            : std::isfinite(number->stddev) ? fmt::format("standard error {:.2g}", number->stddev)
                                                            : "standard error not known";
    entries.push_back(fmt::format("{} = {} ({})", what, number->value, how));
  }
  return fmt::format("<!-- fitted: {} -->", fmt::join(entries, ", "));
}

std::string vector_text(const Vector3d& numbers) { return numbers_text({numbers.x(), numbers.y(), numbers.z()}); }

/// What of a body was fitted.
struct FittedParts {
  bool mass = false, com = false;
  std::vector<std::pair<int, int>> inertia;  // i ≤ j
};

/// What both formats have in common: a text, its robot, and numbers that change both.
class RobotWriter {
 public:
  /// @param of_bodies  tag of a body
  RobotWriter(const std::string& text, std::string file, RobotDescription robot, const char* of_bodies)
      : xml_(text, file), file_(std::move(file)), of_bodies_(of_bodies) {
    out_.robot = std::move(robot);
  }
  virtual ~RobotWriter() = default;
  RobotWriter(const RobotWriter&) = delete;
  RobotWriter& operator=(const RobotWriter&) = delete;

  FittedRobot write(const std::vector<FittedNumber>& numbers) {
    std::map<std::string, std::vector<const FittedNumber*>> of_joints, of_bodies;
    for (const FittedNumber& number : numbers) {
      const NumberName name(number.name);
      (name.is_of_body() ? of_bodies : of_joints)[name.of].push_back(&number);
    }
    for (const auto& [name, fitted] : of_joints) write_joint(name, fitted);
    if (!of_bodies.empty()) require_own_inertias();
    for (const auto& [name, fitted] : of_bodies) write_body(name, fitted);
    out_.text = xml_.changed();
    return std::move(out_);
  }

 protected:
  [[noreturn]] void fail(const std::string& what) const { throw InputError(fmt::format("{}: {}", file_, what)); }

  /// Name of an attribute that holds a number of a joint; null: the format has none.
  [[nodiscard]] virtual const char* attribute_of(const std::string& kind) const = 0;
  /// @param numbers  those that have an attribute
  virtual void write_attributes(const Element& joint, const std::vector<const FittedNumber*>& numbers) = 0;
  virtual void require_own_inertias() const {}
  virtual void write_inertial(const Element& inertial, const Body& body, const FittedParts& parts,
                              const std::vector<const FittedNumber*>& numbers) = 0;
  [[nodiscard]] virtual std::string inertial_text(const Body& body, const std::vector<const FittedNumber*>& numbers) const = 0;
  [[nodiscard]] virtual bool is_in_place(const Element& element) const = 0;

  [[nodiscard]] const Element* child_of(const Element& parent, std::string_view tag) const {
    const auto id = static_cast<int>(&parent - xml_.elements().data());
    for (const Element& one : xml_.elements()) {
      if (one.parent == id && one.tag == tag) return &one;
    }
    return nullptr;
  }

  XmlText xml_;

 private:
  // The element of a joint or body; a tendon, a transmission and the defaults have elements of the same tags.
  [[nodiscard]] const Element& element(const std::string& tag, const std::string& name) const {
    const Element* found = nullptr;
    for (const Element& one : xml_.elements()) {
      const XmlText::Attribute* const own = one.attribute("name");
      if (one.tag != tag || own == nullptr || own->value != name || !is_in_place(one)) continue;
      found = &one;
    }
    if (found == nullptr) {
      fail(fmt::format(
          "there is no <{} name=\"{}\"> in the file itself: give it this name, or put included files, <replicate> and "
          "<attach> in their places",
          tag, name));
    }
    return *found;
  }

  void write_joint(const std::string& name, const std::vector<const FittedNumber*>& numbers) {
    const Element& joint = element("joint", name);
    Joint& own = joint_of(name);
    std::vector<const FittedNumber*> written;
    for (const FittedNumber* number : numbers) {
      const std::string kind = NumberName(number->name).kind;
      if (attribute_of(kind) == nullptr) {
        out_.notes.push_back(
            fmt::format("warning: URDF has no place for {} = {}, which is left out", number->name, number->value));
        continue;
      }
      double& entry = kind == "damping"     ? own.damping
                      : kind == "stiffness" ? own.stiffness
                      : kind == "friction"  ? own.dry_friction
                                            : own.armature;
      entry = number->value;
      written.push_back(number);
    }
    if (!written.empty()) write_attributes(joint, written);
  }

  [[nodiscard]] Joint& joint_of(const std::string& name) {
    for (Body& body : out_.robot.bodies) {
      for (Joint& joint : body.joints) {
        if (joint.name == name) return joint;
      }
    }
    fail(fmt::format("there is no joint '{}'", name));
  }

  void write_body(const std::string& name, const std::vector<const FittedNumber*>& numbers) {
    const Element& at = element(of_bodies_, name);
    Body& body = out_.robot.bodies[static_cast<std::size_t>(out_.robot.body_index(name))];
    FittedParts parts;
    for (const FittedNumber* number : numbers) {
      const NumberName of(number->name);
      if (of.kind == "mass") {
        body.mass = number->value;
        parts.mass = true;
      } else if (of.kind == "com") {
        body.com[axis_of(of.component[0])] = number->value;
        parts.com = true;
      } else {
        const int i = axis_of(of.component[0]), j = axis_of(of.component[1]);
        body.inertia(i, j) = body.inertia(j, i) = number->value;
        parts.inertia.emplace_back(std::min(i, j), std::max(i, j));
      }
    }
    say_whether_physical(body);
    if (const Element* const inertial = child_of(at, "inertial")) {
      write_inertial(*inertial, body, parts, numbers);
    } else {
      insert_inertial(at, body, numbers);
    }
  }

  void insert_inertial(const Element& at, const Body& body, const std::vector<const FittedNumber*>& numbers) {
    const std::string inertial = inertial_text(body, numbers);
    out_.notes.push_back(
        fmt::format("{} '{}' has an <inertial> now; before, its shapes gave mass and inertia", of_bodies_, body.name));
    if (at.is_empty) {
      const std::size_t slash = at.end - 2;
      xml_.replace(slash, at.end, fmt::format(">{}</{}>", inertial, of_bodies_));
      return;
    }
    // on a line of its own, where what follows is
    const std::string& text = xml_.text();
    const std::size_t next = std::min(text.find_first_not_of(" \t\r\n", at.end), text.size());
    xml_.insert(at.end, text.substr(at.end, next - at.end) + inertial);
  }

  // A rigid body has a positive mass, positive principal moments, and none of them is larger than the sum of the others.
  void say_whether_physical(const Body& body) {
    const Vector3d moments = Eigen::SelfAdjointEigenSolver<Matrix3d>(body.inertia, Eigen::EigenvaluesOnly).eigenvalues();
    if (body.mass > 0 && moments[0] > 0 && is_of_rigid_body(body.inertia)) return;
    out_.is_physical = false;
    out_.notes.push_back(fmt::format(
        "warning: no rigid body has the mass {} and the principal moments {}, {}, {} that were fitted for {} '{}', and "
        "MuJoCo will refuse the file: hold some of them, or give them a prior",
        body.mass, moments[0], moments[1], moments[2], of_bodies_, body.name));
  }

  std::string file_;
  const char* of_bodies_;
  FittedRobot out_;
};

class MjcfWriter final : public RobotWriter {
 public:
  MjcfWriter(const std::string& text, std::string file, RobotDescription robot)
      : RobotWriter(text, std::move(file), std::move(robot), "body") {}

 private:
  [[nodiscard]] bool is_in_place(const Element& element) const override { return xml_.is_within(element, "worldbody"); }

  [[nodiscard]] const char* attribute_of(const std::string& kind) const override {
    if (kind == "damping") return "damping";
    if (kind == "stiffness") return "stiffness";
    return kind == "friction" ? "frictionloss" : "armature";
  }

  void write_attributes(const Element& joint, const std::vector<const FittedNumber*>& numbers) override {
    for (const FittedNumber* number : numbers) {
      xml_.set(joint, attribute_of(NumberName(number->name).kind), fmt::format("{}", number->value));
    }
    xml_.insert(joint.end, ' ' + comment_text(numbers));
  }

  void require_own_inertias() const override {
    for (const Element& one : xml_.elements()) {
      const XmlText::Attribute* const from_shapes = one.tag == "compiler" ? one.attribute("inertiafromgeom") : nullptr;
      if (from_shapes != nullptr && from_shapes->value == "true") {
        fail("its compiler takes masses and inertias from shapes whatever <inertial> says: set inertiafromgeom to auto");
      }
    }
  }

  // I = R diag(moments) Rᵀ; exactly, where the axes are those of the body.
  struct Axes {
    Vector3d moments;
    std::optional<Eigen::Quaterniond> turned;
  };
  static Axes axes_of(const Matrix3d& inertia) {
    if (inertia.isDiagonal(0)) return {inertia.diagonal(), std::nullopt};
    const Eigen::SelfAdjointEigenSolver<Matrix3d> solver(inertia);
    Matrix3d axes = solver.eigenvectors();
    if (axes.determinant() < 0) axes.col(0) *= -1;
    return {solver.eigenvalues(), Eigen::Quaterniond(axes)};
  }

  void write_inertial(const Element& inertial, const Body& body, const FittedParts& parts,
                      const std::vector<const FittedNumber*>& numbers) override {
    if (parts.mass) xml_.set(inertial, "mass", fmt::format("{}", body.mass));
    if (parts.com) xml_.set(inertial, "pos", vector_text(body.com));
    if (!parts.inertia.empty()) set_inertia(inertial, body.inertia);
    xml_.insert(inertial.end, ' ' + comment_text(numbers));
  }

  void set_inertia(const Element& inertial, const Matrix3d& inertia) {
    const Axes axes = axes_of(inertia);
    for (const char* other : {"fullinertia", "axisangle", "xyaxes", "zaxis", "euler"}) xml_.remove(inertial, other);
    xml_.set(inertial, "diaginertia", vector_text(axes.moments));
    if (axes.turned) {
      xml_.set(inertial, "quat", quaternion_text(*axes.turned));
    } else {
      xml_.remove(inertial, "quat");
    }
  }

  static std::string quaternion_text(const Eigen::Quaterniond& q) { return numbers_text({q.w(), q.x(), q.y(), q.z()}); }

  [[nodiscard]] std::string inertial_text(const Body& body, const std::vector<const FittedNumber*>& numbers) const override {
    const Axes axes = axes_of(body.inertia);
    return fmt::format("<inertial pos=\"{}\"{} mass=\"{}\" diaginertia=\"{}\"/> {}", vector_text(body.com),
                       axes.turned ? fmt::format(" quat=\"{}\"", quaternion_text(*axes.turned)) : "", body.mass,
                       vector_text(axes.moments), comment_text(numbers));
  }
};

class UrdfWriter final : public RobotWriter {
 public:
  UrdfWriter(const std::string& text, std::string file, RobotDescription robot)
      : RobotWriter(text, std::move(file), std::move(robot), "link") {}

 private:
  [[nodiscard]] bool is_in_place(const Element& element) const override {
    return element.parent >= 0 && xml_.elements()[static_cast<std::size_t>(element.parent)].tag == "robot";
  }

  [[nodiscard]] const char* attribute_of(const std::string& kind) const override {
    if (kind == "damping") return "damping";
    return kind == "friction" ? "friction" : nullptr;
  }

  void write_attributes(const Element& joint, const std::vector<const FittedNumber*>& numbers) override {
    std::vector<std::pair<std::string, std::string>> values;
    for (const FittedNumber* number : numbers) {
      values.emplace_back(attribute_of(NumberName(number->name).kind), fmt::format("{}", number->value));
    }
    write_child(joint, "dynamics", values, ' ' + comment_text(numbers));
  }

  void write_inertial(const Element& inertial, const Body& body, const FittedParts& parts,
                      const std::vector<const FittedNumber*>& numbers) override {
    xml_.insert(inertial.end, ' ' + comment_text(numbers));
    std::vector<std::pair<std::string, std::string>> origin, inertia;
    if (parts.com) origin.emplace_back("xyz", vector_text(body.com));
    if (!parts.inertia.empty()) {
      // about the axes of the link, where they were others all components change
      const bool is_turned = has_turned_axes(inertial);
      if (is_turned) origin.emplace_back("rpy", "0 0 0");
      for (int i = 0; i < 3; ++i) {
        for (int j = i; j < 3; ++j) {
          if (!is_turned && std::find(parts.inertia.begin(), parts.inertia.end(), std::pair(i, j)) == parts.inertia.end())
            continue;
          inertia.emplace_back(component_name(i, j), fmt::format("{}", body.inertia(i, j) + 0.0));
        }
      }
    }
    if (!origin.empty()) write_child(inertial, "origin", origin);
    if (parts.mass) write_child(inertial, "mass", {{"value", fmt::format("{}", body.mass)}});
    if (!inertia.empty()) write_child(inertial, "inertia", inertia);
  }

  [[nodiscard]] bool has_turned_axes(const Element& inertial) const {
    const Element* const origin = child_of(inertial, "origin");
    const XmlText::Attribute* const rpy = origin == nullptr ? nullptr : origin->attribute("rpy");
    return rpy != nullptr && rpy->value.find_first_of("123456789") != std::string::npos;
  }

  static std::string component_name(int i, int j) { return fmt::format("i{}{}", "xyz"[i], "xyz"[j]); }

  // Sets attributes of a child, which is made where there is none.
  void write_child(const Element& parent, const std::string& tag, const std::vector<std::pair<std::string, std::string>>& values,
                   const std::string& behind = "") {
    if (const Element* const child = child_of(parent, tag)) {
      for (const auto& [name, value] : values) xml_.set(*child, name, value);
      xml_.insert(child->end, behind);
      return;
    }
    std::string attributes;
    for (const auto& [name, value] : values) attributes += fmt::format(" {}=\"{}\"", name, value);
    xml_.insert(parent.end, fmt::format("<{}{}/>{}", tag, attributes, behind));
  }

  [[nodiscard]] std::string inertial_text(const Body& body, const std::vector<const FittedNumber*>& numbers) const override {
    std::string inertia;
    for (int i = 0; i < 3; ++i) {
      for (int j = i; j < 3; ++j) inertia += fmt::format(" {}=\"{}\"", component_name(i, j), body.inertia(i, j) + 0.0);
    }
    return fmt::format("<inertial> {}<origin xyz=\"{}\"/><mass value=\"{}\"/><inertia{}/></inertial>", comment_text(numbers),
                       vector_text(body.com), body.mass, inertia);
  }
};

}  // namespace

FittedRobot fitted_mjcf(const std::string& text, const std::string& file, RobotDescription robot,
                        const std::vector<FittedNumber>& numbers) {
  return MjcfWriter(text, file, std::move(robot)).write(numbers);
}

FittedRobot fitted_urdf(const std::string& text, const std::string& file, RobotDescription robot,
                        const std::vector<FittedNumber>& numbers) {
  return UrdfWriter(text, file, std::move(robot)).write(numbers);
}

}  // namespace gp2
