#include "export/mjcf.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <Eigen/Dense>

#include "export/xml_text.hpp"
#include "gp2/error.hpp"

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

class MjcfWriter {
 public:
  MjcfWriter(const std::string& text, std::string file, RobotDescription robot) : xml_(text, file), file_(std::move(file)) {
    out_.robot = std::move(robot);
  }

  FittedMjcf write(const std::vector<FittedNumber>& numbers) {
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

 private:
  [[noreturn]] void fail(const std::string& what) const { throw InputError(fmt::format("{}: {}", file_, what)); }

  // The element of a joint or body; a tendon and the defaults have elements of the same tags.
  [[nodiscard]] const Element& element(const std::string& tag, const std::string& name) const {
    const Element* found = nullptr;
    for (const Element& one : xml_.elements()) {
      const XmlText::Attribute* const own = one.attribute("name");
      if (one.tag != tag || own == nullptr || own->value != name || !xml_.is_within(one, "worldbody")) continue;
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
    for (const FittedNumber* number : numbers) {
      const std::string kind = NumberName(number->name).kind;
      double& entry = kind == "damping"     ? own.damping
                      : kind == "stiffness" ? own.stiffness
                      : kind == "friction"  ? own.dry_friction
                                            : own.armature;
      entry = number->value;
      xml_.set(joint, kind == "friction" ? "frictionloss" : kind, fmt::format("{}", number->value));
    }
    xml_.insert(joint.end, ' ' + comment_text(numbers));
  }

  [[nodiscard]] Joint& joint_of(const std::string& name) {
    for (Body& body : out_.robot.bodies) {
      for (Joint& joint : body.joints) {
        if (joint.name == name) return joint;
      }
    }
    fail(fmt::format("there is no joint '{}'", name));
  }

  void require_own_inertias() const {
    for (const Element& one : xml_.elements()) {
      const XmlText::Attribute* const from_shapes = one.tag == "compiler" ? one.attribute("inertiafromgeom") : nullptr;
      if (from_shapes != nullptr && from_shapes->value == "true") {
        fail("its compiler takes masses and inertias from shapes whatever <inertial> says: set inertiafromgeom to auto");
      }
    }
  }

  void write_body(const std::string& name, const std::vector<const FittedNumber*>& numbers) {
    const Element& at = element("body", name);
    Body& body = out_.robot.bodies[static_cast<std::size_t>(out_.robot.body_index(name))];
    bool is_moved = false, is_turned = false, is_heavier = false;
    for (const FittedNumber* number : numbers) {
      const NumberName parts(number->name);
      if (parts.kind == "mass") {
        body.mass = number->value;
        is_heavier = true;
      } else if (parts.kind == "com") {
        body.com[axis_of(parts.component[0])] = number->value;
        is_moved = true;
      } else {
        const int i = axis_of(parts.component[0]), j = axis_of(parts.component[1]);
        body.inertia(i, j) = body.inertia(j, i) = number->value;
        is_turned = true;
      }
    }
    say_whether_physical(body);
    if (const Element* const inertial = inertial_of(at)) {
      if (is_heavier) xml_.set(*inertial, "mass", fmt::format("{}", body.mass));
      if (is_moved) xml_.set(*inertial, "pos", numbers_text({body.com.x(), body.com.y(), body.com.z()}));
      if (is_turned) set_inertia(*inertial, body.inertia);
      xml_.insert(inertial->end, ' ' + comment_text(numbers));
    } else {
      insert_inertial(at, body, numbers);
    }
  }

  [[nodiscard]] const Element* inertial_of(const Element& body) const {
    const auto id = static_cast<int>(&body - xml_.elements().data());
    for (const Element& one : xml_.elements()) {
      if (one.parent == id && one.tag == "inertial") return &one;
    }
    return nullptr;
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

  void set_inertia(const Element& inertial, const Matrix3d& inertia) {
    const Axes axes = axes_of(inertia);
    for (const char* other : {"fullinertia", "axisangle", "xyaxes", "zaxis", "euler"}) xml_.remove(inertial, other);
    xml_.set(inertial, "diaginertia", numbers_text({axes.moments.x(), axes.moments.y(), axes.moments.z()}));
    if (axes.turned) {
      xml_.set(inertial, "quat", quaternion_text(*axes.turned));
    } else {
      xml_.remove(inertial, "quat");
    }
  }

  static std::string quaternion_text(const Eigen::Quaterniond& q) { return numbers_text({q.w(), q.x(), q.y(), q.z()}); }

  void insert_inertial(const Element& at, const Body& body, const std::vector<const FittedNumber*>& numbers) {
    const Axes axes = axes_of(body.inertia);
    const std::string inertial = fmt::format(
        "<inertial pos=\"{}\"{} mass=\"{}\" diaginertia=\"{}\"/> {}", numbers_text({body.com.x(), body.com.y(), body.com.z()}),
        axes.turned ? fmt::format(" quat=\"{}\"", quaternion_text(*axes.turned)) : "", body.mass,
        numbers_text({axes.moments.x(), axes.moments.y(), axes.moments.z()}), comment_text(numbers));
    out_.notes.push_back(fmt::format("body '{}' has an <inertial> now; before, its shapes gave mass and inertia", body.name));
    if (at.is_empty) {
      const std::size_t slash = at.end - 2;
      xml_.replace(slash, at.end, fmt::format(">{}</body>", inertial));
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
    if (body.mass > 0 && moments[0] > 0 && moments[2] <= moments[0] + moments[1]) return;
    out_.is_physical = false;
    out_.notes.push_back(fmt::format(
        "warning: no rigid body has the mass {} and the principal moments {}, {}, {} that were fitted for body '{}', and "
        "MuJoCo will refuse the file: hold some of them, or give them a prior",
        body.mass, moments[0], moments[1], moments[2], body.name));
  }

  XmlText xml_;
  std::string file_;
  FittedMjcf out_;
};

}  // namespace

FittedMjcf fitted_mjcf(const std::string& text, const std::string& file, RobotDescription robot,
                       const std::vector<FittedNumber>& numbers) {
  return MjcfWriter(text, file, std::move(robot)).write(numbers);
}

}  // namespace gp2
