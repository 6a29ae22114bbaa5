#include "robots/mujoco_description.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <limits>
#include <set>

#include <fmt/format.h>
#include <Eigen/Dense>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Matrix3d;
using Eigen::Quaterniond;
using Eigen::Vector3d;
using Body = RobotDescription::Body;
using Connect = RobotDescription::Connect;
using Coupling = RobotDescription::Coupling;
using Joint = RobotDescription::Joint;

namespace {

// ---- numbers

// Angles in files have ten digits or so, and MuJoCo turns them into quaternions: where a right angle is meant, entries of the
// rotation are a little beside 0 and ±1. These are set right, which also makes the expressions of M and F much smaller.
constexpr double right_angle_tolerance = 1e-9;

// How much of that is more than rounding; it is reported.
struct Tidying {
  double largest = 0;

  double entry(double value) {
    const double nearest = std::round(value);
    const double distance = std::abs(value - nearest);
    if (distance > right_angle_tolerance) return value;
    largest = std::max(largest, distance);
    return nearest + 0.0;  // no −0
  }

  Vector3d axis(const mjtNum* numbers) {
    const Vector3d axis = Eigen::Map<const Vector3d>(numbers).unaryExpr([this](double value) { return entry(value); });
    return axis.normalized();
  }

  Matrix3d rotation(const mjtNum* quaternion) {
    const Quaterniond q(quaternion[0], quaternion[1], quaternion[2], quaternion[3]);
    Matrix3d rotation = q.normalized().toRotationMatrix().unaryExpr([this](double value) { return entry(value); });
    // orthonormal again, Gram–Schmidt: exact zeros stay
    rotation.col(0).normalize();
    rotation.col(1) -= rotation.col(0).dot(rotation.col(1)) * rotation.col(0);
    rotation.col(1).normalize();
    rotation.col(2) = rotation.col(0).cross(rotation.col(1));
    return rotation.unaryExpr([](double value) { return value + 0.0; });
  }
};

// R diag(moments) Rᵀ, symmetric to the last bit, without the dust of rounding
Matrix3d rotated_inertia(const Matrix3d& rotation, const Vector3d& moments) {
  Matrix3d inertia = rotation * moments.asDiagonal() * rotation.transpose();
  const double dust = 8 * std::numeric_limits<double>::epsilon() * moments.sum();
  inertia = inertia.unaryExpr([dust](double value) { return std::abs(value) <= dust ? 0 : value; });
  inertia.triangularView<Eigen::StrictlyLower>() = inertia.transpose();
  return inertia;
}

// ---- from MuJoCo's arrays to the description

// of an array with n numbers for each object
template <int n>
const mjtNum* row(const mjtNum* array, int id) {
  return array + std::ptrdiff_t{n} * id;
}

class Description {
 public:
  Description(const mjModel& model, const mujoco::LaterFields& later, std::string file)
      : m_(model), later_(later), file_(std::move(file)) {}

  RobotDescription make() {
    refuse_what_has_no_place();
    robot_.name = std::string(m_.names) == "MuJoCo Model" ? std::filesystem::path(file_).stem().string() : m_.names;
    name_all();
    reach_ = reach();
    if (!disabled(mjDSBL_GRAVITY)) {
      robot_.gravity = Eigen::Map<const Vector3d>(m_.opt.gravity);
    } else {
      robot_.gravity.setZero();
    }
    for (int id = 1; id < m_.nbody; ++id) robot_.bodies.push_back(body(id));
    for (int id = 0; id < m_.nsite; ++id) {
      robot_.sites.push_back({site_names_[static_cast<std::size_t>(id)], m_.site_bodyid[id] - 1,
                              position(row<3>(m_.site_pos, id)), tidying_.rotation(row<4>(m_.site_quat, id))});
    }
    for (int id = 0; id < m_.neq; ++id) add_equality(id);
    add_notes();
    return std::move(robot_);
  }

 private:
  [[noreturn]] void fail(const std::string& what) const { throw InputError(fmt::format("{}: {}", file_, what)); }
  void note(std::string text) { robot_.notes.push_back(std::move(text)); }
  [[nodiscard]] bool disabled(int flags) const { return (m_.opt.disableflags & flags) != 0; }

  // ---- what has no place

  void refuse_what_has_no_place() const {
    for (int id = 0; id < m_.njnt; ++id) {
      if (!has_quaternion(id) || no_springs() || m_.jnt_stiffness[id] == 0) continue;
      fail(fmt::format(
          "joint {} of body {} is a ball or free joint with stiffness = {}, whose spring is not known: set it to 0 and "
          "write it as mechanics.force",
          shown(mjOBJ_JOINT, id), shown(mjOBJ_BODY, m_.jnt_bodyid[id]), m_.jnt_stiffness[id]));
    }
    if (m_.njnt == 0) fail("it has no joint: nothing can move");
    if (m_.opt.density != 0 || m_.opt.viscosity != 0) {
      fail(
          fmt::format("its option sets density = {} and viscosity = {}, but forces of a fluid are not known: set both to 0 (a "
                      "latent can learn them)",
                      m_.opt.density, m_.opt.viscosity));
    }
    for (int id = 0; id < m_.ntendon; ++id) refuse_forces_of_tendon(id);
    refuse_later_forces();
  }

  [[nodiscard]] bool has_quaternion(int id) const { return m_.jnt_type[id] == mjJNT_BALL || m_.jnt_type[id] == mjJNT_FREE; }
  [[nodiscard]] bool no_springs() const { return disabled(mujoco::springs_off); }
  [[nodiscard]] bool no_dampers() const { return disabled(mujoco::dampers_off); }

  void refuse_forces_of_tendon(int id) const {
    const std::string tendon = fmt::format("tendon {}", shown(mjOBJ_TENDON, id));
    const bool pulls = !no_springs() && m_.tendon_stiffness[id] != 0;
    const bool damps = !no_dampers() && m_.tendon_damping[id] != 0;
    const bool rubs = !disabled(mjDSBL_FRICTIONLOSS | mjDSBL_CONSTRAINT) && m_.tendon_frictionloss[id] != 0;
    if (pulls || damps || rubs) {
      fail(
          fmt::format("{} has stiffness = {}, damping = {}, frictionloss = {}, but forces of tendons are not known: set them "
                      "to 0 and write them as force or let a latent learn them",
                      tendon, m_.tendon_stiffness[id], m_.tendon_damping[id], m_.tendon_frictionloss[id]));
    }
    if (given(later_.tendon_armature, id)) {
      fail(fmt::format("{} has armature = {}, but inertias of tendons are not known: set it to 0", tendon,
                       later_.tendon_armature[id]));
    }
    refuse_polynomial(tendon, "stiffness", no_springs() ? nullptr : later_.tendon_stiffnesspoly, id);
    refuse_polynomial(tendon, "damping", no_dampers() ? nullptr : later_.tendon_dampingpoly, id);
  }

  // Forces and inertias that only later versions know. Each changes M or F, so that none may be left out.
  void refuse_later_forces() const {
    if (later_.n_flexes > 0) fail("it has soft bodies (flex), which no joint coordinates describe: remove them");
    const bool lifts = !disabled(mjDSBL_GRAVITY) && !(no_springs() && no_dampers());
    for (int id = 1; id < m_.nbody; ++id) {
      const std::string body = fmt::format("body {}", shown(mjOBJ_BODY, id));
      if (lifts && given(later_.body_gravcomp, id)) {
        fail(
            fmt::format("{} has gravcomp = {}, but a force against gravity is not known: set it to 0 and write it as "
                        "mechanics.force",
                        body, later_.body_gravcomp[id]));
      }
      if (later_.body_plugin != nullptr && later_.body_plugin[id] >= 0) {
        fail(fmt::format("{} has a plugin, whose forces are not known: remove it", body));
      }
    }
    for (int id = 0; id < m_.njnt; ++id) {
      const std::string joint = fmt::format("joint {}", shown(mjOBJ_JOINT, id));
      refuse_polynomial(joint, "stiffness", no_springs() ? nullptr : later_.jnt_stiffnesspoly, id);
      refuse_polynomial(joint, "damping", no_dampers() ? nullptr : later_.dof_dampingpoly, m_.jnt_dofadr[id]);
    }
    for (int id = 0; id < later_.n_actuators; ++id) {
      const std::string actuator = fmt::format("actuator {}", shown(mjOBJ_ACTUATOR, id));
      const bool damps = !no_dampers() && given(later_.actuator_damping, id);
      if (given(later_.actuator_armature, id) || damps) {
        fail(
            fmt::format("{} has an armature or a damping of its own, but actuators are left out: give them to its joint, times "
                        "the square of gear",
                        actuator));
      }
      refuse_polynomial(actuator, "damping", no_dampers() ? nullptr : later_.actuator_dampingpoly, id);
    }
  }

  static bool given(const mjtNum* array, int id) { return array != nullptr && array[id] != 0; }

  void refuse_polynomial(const std::string& of, const char* what, const mjtNum* polynomials, int id) const {
    if (polynomials == nullptr) return;
    const mjtNum* const first = polynomials + std::ptrdiff_t{later_.n_poly} * id;
    if (std::all_of(first, first + later_.n_poly, [](mjtNum number) { return number == 0; })) return;
    fail(
        fmt::format("{} has a {} of more than one number, a polynomial, which is not known: give one number and write the rest "
                    "as mechanics.force",
                    of, what));
  }

  [[nodiscard]] std::string shown(mjtObj type, int id) const {
    const char* name = mj_id2name(&m_, type, id);
    return name != nullptr ? fmt::format("'{}'", name) : fmt::format("{} (without a name)", id);
  }

  // ---- names

  void name_all() {
    body_names_ = names_of(mjOBJ_BODY, m_.nbody, "body");
    joint_names_ = names_of(mjOBJ_JOINT, m_.njnt, "joint");
    site_names_ = names_of(mjOBJ_SITE, m_.nsite, "site");
    equality_names_ = names_of(mjOBJ_EQUALITY, m_.neq, "equality");
  }

  [[nodiscard]] std::vector<std::string> names_of(mjtObj type, std::ptrdiff_t n, const char* kind) const {
    std::set<std::string> given;
    for (int id = 0; id < n; ++id) {
      if (const char* name = mj_id2name(&m_, type, id)) given.insert(name);
    }
    std::vector<std::string> names;
    for (int id = 0; id < n; ++id) {
      const char* own = mj_id2name(&m_, type, id);
      std::string name = own != nullptr ? own : fmt::format("{}_{}", kind, id);
      // a made name must not be another's
      while (own == nullptr && given.count(name) > 0) name += '_';
      names.push_back(std::move(name));
    }
    return names;
  }

  // ---- bodies and joints

  // the size of the robot, by which the dust of rounding in a position is told
  [[nodiscard]] double reach() const {
    double sum = 0;
    for (int id = 1; id < m_.nbody; ++id) sum += Eigen::Map<const Vector3d>(row<3>(m_.body_pos, id)).norm();
    return sum;
  }

  [[nodiscard]] Vector3d position(const mjtNum* numbers) const {
    const double dust = 4 * std::numeric_limits<double>::epsilon() * reach_;
    return Eigen::Map<const Vector3d>(numbers).unaryExpr([dust](double value) { return std::abs(value) <= dust ? 0 : value; });
  }

  Body body(int id) {
    Body body;
    body.name = body_names_[static_cast<std::size_t>(id)];
    body.parent = m_.body_parentid[id] - 1;
    body.position = position(row<3>(m_.body_pos, id));
    body.rotation = tidying_.rotation(row<4>(m_.body_quat, id));
    body.mass = m_.body_mass[id];
    body.com = position(row<3>(m_.body_ipos, id));
    const Eigen::Map<const Vector3d> moments(row<3>(m_.body_inertia, id));
    // equal moments have no axes
    const bool is_round = moments[0] == moments[1] && moments[1] == moments[2];
    body.inertia =
        is_round ? Matrix3d(moments.asDiagonal()) : rotated_inertia(tidying_.rotation(row<4>(m_.body_iquat, id)), moments);
    for (int k = 0; k < m_.body_jntnum[id]; ++k) body.joints.push_back(joint(m_.body_jntadr[id] + k));
    if (!body.joints.empty() && body.joints.front().type == Joint::Type::free) {  // which says alone where the body is
      body.position.setZero();
      body.rotation.setIdentity();
    }
    return body;
  }

  Joint joint(int id) {
    const int dof = m_.jnt_dofadr[id];
    Joint joint;
    joint.name = joint_names_[static_cast<std::size_t>(id)];
    joint.armature = m_.dof_armature[dof];
    if (!no_dampers()) joint.damping = m_.dof_damping[dof];
    if (!disabled(mjDSBL_FRICTIONLOSS | mjDSBL_CONSTRAINT)) joint.dry_friction = m_.dof_frictionloss[dof];
    if (m_.jnt_type[id] == mjJNT_FREE) {
      joint.type = Joint::Type::free;
      return joint;
    }
    joint.anchor = position(row<3>(m_.jnt_pos, id));
    if (m_.jnt_type[id] == mjJNT_BALL) {
      joint.type = Joint::Type::ball;
      return joint;
    }
    joint.type = m_.jnt_type[id] == mjJNT_HINGE ? Joint::Type::hinge : Joint::Type::slide;
    joint.axis = tidying_.axis(row<3>(m_.jnt_axis, id));
    joint.reference = m_.qpos0[m_.jnt_qposadr[id]];
    if (!no_springs()) joint.stiffness = m_.jnt_stiffness[id];
    joint.spring_reference = m_.qpos_spring[m_.jnt_qposadr[id]];
    return joint;
  }

  // ---- what closes loops

  void add_equality(int id) {
    const std::string& name = equality_names_[static_cast<std::size_t>(id)];
    if (!mujoco::equality_is_active(m_, id) || disabled(mjDSBL_EQUALITY | mjDSBL_CONSTRAINT)) {
      note(fmt::format("equality '{}' is switched off in the file and left out", name));
      return;
    }
    switch (m_.eq_type[id]) {
      case mjEQ_CONNECT:
        robot_.connects.push_back(connect(id));
        break;
      case mjEQ_WELD:
        add_weld(id);
        break;
      case mjEQ_JOINT:
        add_coupling(id, [this](int joint) { return joint_length(joint); });
        break;
      case mjEQ_TENDON:
        add_coupling(id, [this](int tendon) { return tendon_length(tendon); });
        break;
      default:
        fail(fmt::format("equality '{}' is of a kind that is not known; there is: connect, weld, joint, tendon", name));
    }
  }

  template <class Length>
  void add_coupling(int id, Length length) {
    Coupling coupling{equality_names_[static_cast<std::size_t>(id)], length(m_.eq_obj1id[id]), {}, {}};
    if (m_.eq_obj2id[id] >= 0) coupling.x.push_back(length(m_.eq_obj2id[id]));
    std::copy_n(row<mjNEQDATA>(m_.eq_data, id), coupling.polynomial.size(), coupling.polynomial.begin());
    robot_.couplings.push_back(std::move(coupling));
  }

  [[nodiscard]] bool is_of_sites(int id) const { return later_.eq_objtype != nullptr && later_.eq_objtype[id] == mjOBJ_SITE; }

  // Two sites coincide, or two bodies have an anchor each, which a weld gives for the second body first.
  [[nodiscard]] Connect connect(int id) const {
    Connect connect{equality_names_[static_cast<std::size_t>(id)], {}, {}};
    const std::array<int, 2> ends = {m_.eq_obj1id[id], m_.eq_obj2id[id]};
    const bool second_first = m_.eq_type[id] == mjEQ_WELD;
    for (std::size_t k = 0; k < 2; ++k) {
      if (is_of_sites(id)) {
        connect.bodies.at(k) = m_.site_bodyid[ends.at(k)] - 1;
        connect.anchors.at(k) = position(row<3>(m_.site_pos, ends.at(k)));
      } else {
        connect.bodies.at(k) = ends.at(k) - 1;
        const bool is_first = (k == 0) != second_first;
        connect.anchors.at(k) = position(row<mjNEQDATA>(m_.eq_data, id) + (is_first ? 0 : 3));
      }
    }
    return connect;
  }

  // A torque scale of 0 leaves the orientations free.
  void add_weld(int id) {
    Connect held = connect(id);
    const mjtNum* const data = row<mjNEQDATA>(m_.eq_data, id);
    const double torque_scale = data[10];
    if (torque_scale == 0) {
      robot_.connects.push_back(std::move(held));
      return;
    }
    if (torque_scale != 1) note(fmt::format("the torquescale of weld '{}' is left out: the weld is rigid", held.name));
    robot_.welds.push_back({std::move(held), is_of_sites(id) ? rotation_between_sites(id) : tidying_.rotation(data + 6)});
  }

  // With R₁ S₁ = R₂ S₂ the second body's axes in the first's frame are R₁ᵀ R₂ = S₁ S₂ᵀ.
  Matrix3d rotation_between_sites(int id) {
    const Matrix3d first = tidying_.rotation(row<4>(m_.site_quat, m_.eq_obj1id[id]));
    return first * tidying_.rotation(row<4>(m_.site_quat, m_.eq_obj2id[id])).transpose();
  }

  [[nodiscard]] Coupling::Length joint_length(int id) const {
    return {{{joint_names_[static_cast<std::size_t>(id)], 1.0}}, {}, m_.qpos0[m_.jnt_qposadr[id]]};
  }

  [[nodiscard]] Coupling::Length tendon_length(int id) const {
    Coupling::Length length;
    length.reference = m_.tendon_length0[id];
    double divisor = 1;
    int previous = -1;  // the site before
    for (int k = m_.tendon_adr[id]; k < m_.tendon_adr[id] + m_.tendon_num[id]; ++k) {
      const int object = m_.wrap_objid[k];
      switch (m_.wrap_type[k]) {
        case mjWRAP_JOINT:
          length.joints.emplace_back(joint_names_[static_cast<std::size_t>(object)], m_.wrap_prm[k]);
          break;
        case mjWRAP_PULLEY:
          divisor = m_.wrap_prm[k];
          previous = -1;
          if (divisor == 0) fail(fmt::format("tendon {} has a pulley with divisor 0", shown(mjOBJ_TENDON, id)));
          break;
        case mjWRAP_SITE:
          if (previous >= 0 && previous != object) length.segments.push_back({previous, object, 1 / divisor});
          previous = object;
          break;
        default:
          fail(
              fmt::format("tendon {} wraps around geom {}, which is not known for a tendon that an equality holds: lead it "
                          "through sites alone",
                          shown(mjOBJ_TENDON, id), shown(mjOBJ_GEOM, object)));
      }
    }
    return length;
  }

  // ---- notes

  void add_notes() {
    // what is more than rounding of a double
    if (tidying_.largest > 1e-14) {
      note(fmt::format("angles within {:g} rad of a right angle are taken as right angles; the farthest was {:.1e} off",
                       right_angle_tolerance, tidying_.largest));
    }
    if (any(m_.jnt_limited, m_.njnt) || any(m_.tendon_limited, m_.ntendon)) {
      note("limits of joints and tendons are left out");
    }
    if (geoms_can_touch()) note("contacts between geoms are left out");
    if (later_.n_actuators > 0) note("actuators are left out: inputs of the model are forces at the joints");
    if (m_.nsensor > 0) note("sensors are left out");
    if (later_.n_plugins > 0) note("plugins are left out");
    if (m_.nmocap > 0) note("mocap bodies stand still");
  }

  // bytes, or bool since 3.9.0
  template <class Flag>
  static bool any(const Flag* flags, std::ptrdiff_t n) {
    return std::any_of(flags, flags + n, [](Flag flag) { return flag != 0; });
  }

  [[nodiscard]] bool geoms_can_touch() const {
    if (disabled(mjDSBL_CONTACT | mjDSBL_CONSTRAINT)) return false;
    if (m_.npair > 0) return true;
    for (int i = 0; i < m_.ngeom; ++i) {
      for (int j = i + 1; j < m_.ngeom; ++j) {
        const bool match =
            (m_.geom_contype[i] & m_.geom_conaffinity[j]) != 0 || (m_.geom_contype[j] & m_.geom_conaffinity[i]) != 0;
        if (match && m_.body_weldid[m_.geom_bodyid[i]] != m_.body_weldid[m_.geom_bodyid[j]]) return true;
      }
    }
    return false;
  }

  const mjModel& m_;
  const mujoco::LaterFields& later_;
  std::string file_;
  RobotDescription robot_;
  Tidying tidying_;
  double reach_ = 0;  // [m]
  std::vector<std::string> body_names_, joint_names_, site_names_, equality_names_;
};

}  // namespace

RobotDescription describe(const mjModel& model, const mujoco::LaterFields& later, std::string file) {
  return Description(model, later, std::move(file)).make();
}

}  // namespace gp2
