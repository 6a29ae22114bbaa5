#include <algorithm>
#include <cmath>
#include <cstring>
#include <initializer_list>
#include <limits>
#include <memory>
#include <mutex>
#include <set>

#include <fmt/format.h>
#include <mujoco/mujoco.h>
#include <Eigen/Dense>

#include "gp2/base/file.hpp"
#include "gp2/error.hpp"
#include "gp2/robots/robot.hpp"
#include "robots/robot_checks.hpp"
#include "robots/robot_xml.hpp"

namespace gp2 {

using Eigen::Matrix3d;
using Eigen::Quaterniond;
using Eigen::Vector3d;
using Body = RobotDescription::Body;
using Connect = RobotDescription::Connect;
using Coupling = RobotDescription::Coupling;
using Joint = RobotDescription::Joint;

namespace {

// ---- MuJoCo as a guest: it neither prints, nor exits, nor writes MUJOCO_LOG.TXT

// What MuJoCo says while this thread loads a file; null: it does not load one.
thread_local std::vector<std::string>* said = nullptr;

// MuJoCo's handlers belong to the process. Errors of the engine during compilation do not come here: mj_loadXML catches them
// itself. What is left comes from its C++ code, through which an exception passes.
class Handlers {
 public:
  explicit Handlers(std::vector<std::string>& warnings) : lock_(mutex()), error_(mju_user_error), warning_(mju_user_warning) {
    previous_warning() = warning_;
    said = &warnings;
    mju_user_error = [](const char* text) { throw InputError(text); };
    mju_user_warning = [](const char* text) {
      if (said != nullptr) {
        said->emplace_back(text);
      } else if (previous_warning() != nullptr) {
        previous_warning()(text);
      }
    };
  }
  ~Handlers() {
    mju_user_error = error_;
    mju_user_warning = warning_;
    said = nullptr;
  }
  Handlers(const Handlers&) = delete;
  Handlers& operator=(const Handlers&) = delete;

 private:
  using Handler = void (*)(const char*);

  static std::mutex& mutex() {
    static std::mutex one;
    return one;
  }
  static Handler& previous_warning() {
    static Handler handler = nullptr;
    return handler;
  }

  std::lock_guard<std::mutex> lock_;
  Handler error_;
  Handler warning_;
};

using ModelPointer = std::unique_ptr<mjModel, void (*)(mjModel*)>;

// a file that is only in memory
class VirtualFile {
 public:
  VirtualFile(const std::string& name, const std::string& text) : files_(std::make_unique<mjVFS>()) {
    mj_defaultVFS(files_.get());
    if (mj_makeEmptyFileVFS(files_.get(), name.c_str(), static_cast<int>(text.size())) != 0) {
      throw InputError(fmt::format("{}: MuJoCo does not take a file of this name", name));
    }
    std::memcpy(files_->filedata[0], text.data(), text.size());
  }
  ~VirtualFile() { mj_deleteVFS(files_.get()); }
  VirtualFile(const VirtualFile&) = delete;
  VirtualFile& operator=(const VirtualFile&) = delete;

  [[nodiscard]] const mjVFS* get() const { return files_.get(); }

 private:
  std::unique_ptr<mjVFS> files_;
};

// MuJoCo's words in one line, without what they say where they know no line
std::string one_line(std::string text) {
  while (!text.empty() && text.back() == '\n') text.pop_back();
  for (const std::string prefix : {"Error: ", "XML Error: "}) {
    if (text.rfind(prefix, 0) == 0) text.erase(0, prefix.size());
  }
  for (std::size_t at = text.find('\n'); at != std::string::npos; at = text.find('\n')) text.replace(at, 1, "; ");
  return text.substr(0, text.find(", column = -1"));
}

// what to do about some of MuJoCo's refusals
std::string mend_of(const std::string& refusal) {
  struct Mend {
    const char* words;
    const char* mend;
  };
  for (const Mend& known :
       {Mend{"larger than mjMINVAL", "A body that moves needs a mass and an inertia: give it <inertial> or a geom"},
        Mend{"A + B >= C", "No rigid body has such an inertia: correct it"},
        Mend{"Could not open", "The file of a mesh, height field or texture is missing: put it there or remove the geom"},
        Mend{"could not open", "The file of a mesh, height field or texture is missing: put it there or remove the geom"}}) {
    if (refusal.find(known.words) != std::string::npos) return fmt::format(". {}", known.mend);
  }
  return "";
}

/// @param warnings  what MuJoCo says to a file that it accepts
ModelPointer load(const std::filesystem::path& path, const RobotXml& xml, std::vector<std::string>& warnings) {
  std::array<char, 1024> refusal = {};
  mjModel* model = nullptr;
  try {
    const Handlers handlers(warnings);
    const std::unique_ptr<VirtualFile> file = xml.is_urdf ? std::make_unique<VirtualFile>(path.string(), xml.text) : nullptr;
    model = mj_loadXML(path.c_str(), file ? file->get() : nullptr, refusal.data(), static_cast<int>(refusal.size()));
    mj_freeLastXML();
  } catch (const std::exception& error) {
    throw InputError(fmt::format("{}: MuJoCo {} refuses it: {}", path.string(), mj_versionString(), one_line(error.what())));
  }
  if (model == nullptr) {
    std::string words = one_line(refusal.data());
    // the lines are those of the rewritten text
    if (xml.is_urdf) words = words.substr(0, words.rfind("; Element '"));
    throw InputError(fmt::format("{}: MuJoCo {} refuses it: {}{}", path.string(), mj_versionString(), words, mend_of(words)));
  }
  if (refusal[0] != '\0') warnings.emplace_back(refusal.data());
  return {model, mj_deleteModel};
}

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
  Description(const mjModel& model, std::string file) : m_(model), file_(std::move(file)) {}

  RobotDescription make(const RobotXml& xml, const std::vector<std::string>& warnings) {
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
    for (const RobotXml::Mimic& mimic : xml.mimics) add_mimic(mimic);
    for (const std::string& warning : warnings) note(fmt::format("MuJoCo warns: {}", one_line(warning)));
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
      const int type = m_.jnt_type[id];
      if (type == mjJNT_HINGE || type == mjJNT_SLIDE) continue;
      const bool is_ball = type == mjJNT_BALL;
      fail(
          fmt::format("joint {} of body {} is a {} joint, which has a quaternion; only hinge and slide joints can be "
                      "coordinates: {}",
                      shown(mjOBJ_JOINT, id), shown(mjOBJ_BODY, m_.jnt_bodyid[id]), is_ball ? "ball" : "free",
                      is_ball ? "write three hinges in its place"
                              : "remove it if the body is fixed, or write three slides and three hinges in its place"));
    }
    if (m_.njnt == 0) fail("it has no joint: nothing can move");
    if (m_.opt.density != 0 || m_.opt.viscosity != 0) {
      fail(
          fmt::format("its option sets density = {} and viscosity = {}, but forces of a fluid are not known: set both to 0 (a "
                      "latent can learn them)",
                      m_.opt.density, m_.opt.viscosity));
    }
    for (int id = 0; id < m_.ntendon; ++id) {
      const std::string tendon = fmt::format("tendon {}", shown(mjOBJ_TENDON, id));
      const bool passive = !disabled(mjDSBL_PASSIVE) && (m_.tendon_stiffness[id] != 0 || m_.tendon_damping[id] != 0);
      const bool rubs = !disabled(mjDSBL_FRICTIONLOSS | mjDSBL_CONSTRAINT) && m_.tendon_frictionloss[id] != 0;
      if (passive || rubs) {
        fail(
            fmt::format("{} has stiffness = {}, damping = {}, frictionloss = {}, but forces of tendons are not known: set them "
                        "to 0 and write them as force or let a latent learn them",
                        tendon, m_.tendon_stiffness[id], m_.tendon_damping[id], m_.tendon_frictionloss[id]));
      }
    }
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

  [[nodiscard]] std::vector<std::string> names_of(mjtObj type, int n, const char* kind) const {
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
    return body;
  }

  Joint joint(int id) {
    const int dof = m_.jnt_dofadr[id];
    Joint joint;
    joint.name = joint_names_[static_cast<std::size_t>(id)];
    joint.type = m_.jnt_type[id] == mjJNT_HINGE ? Joint::Type::hinge : Joint::Type::slide;
    joint.axis = tidying_.axis(row<3>(m_.jnt_axis, id));
    joint.anchor = position(row<3>(m_.jnt_pos, id));
    joint.reference = m_.qpos0[m_.jnt_qposadr[id]];
    joint.armature = m_.dof_armature[dof];
    if (!disabled(mjDSBL_PASSIVE)) {
      joint.damping = m_.dof_damping[dof];
      joint.stiffness = m_.jnt_stiffness[id];
    }
    joint.spring_reference = m_.qpos_spring[m_.jnt_qposadr[id]];
    if (!disabled(mjDSBL_FRICTIONLOSS | mjDSBL_CONSTRAINT)) joint.dry_friction = m_.dof_frictionloss[dof];
    return joint;
  }

  // ---- what closes loops

  void add_equality(int id) {
    const std::string& name = equality_names_[static_cast<std::size_t>(id)];
    if (m_.eq_active[id] == 0 || disabled(mjDSBL_EQUALITY | mjDSBL_CONSTRAINT)) {
      note(fmt::format("equality '{}' is switched off in the file and left out", name));
      return;
    }
    const mjtNum* data = row<mjNEQDATA>(m_.eq_data, id);
    const int first = m_.eq_obj1id[id];
    const int second = m_.eq_obj2id[id];
    if (m_.eq_type[id] == mjEQ_CONNECT) {
      robot_.connects.push_back({name, {first - 1, second - 1}, {position(data), position(data + 3)}});
    } else if (m_.eq_type[id] == mjEQ_WELD) {
      add_weld(name, first, second, data);
    } else {
      // of joints or tendons: MuJoCo itself refuses the one other kind, the distance of two geoms
      const bool of_joints = m_.eq_type[id] == mjEQ_JOINT;
      Coupling coupling{name, of_joints ? joint_length(first) : tendon_length(first), {}, {}};
      if (second >= 0) coupling.x.push_back(of_joints ? joint_length(second) : tendon_length(second));
      std::copy_n(data, coupling.polynomial.size(), coupling.polynomial.begin());
      robot_.couplings.push_back(std::move(coupling));
    }
  }

  // MuJoCo puts the anchor in the second body first; a torque scale of 0 leaves the orientations free
  void add_weld(const std::string& name, int first, int second, const mjtNum* data) {
    Connect connect{name, {first - 1, second - 1}, {position(data + 3), position(data)}};
    const double torque_scale = data[10];
    if (torque_scale == 0) {
      robot_.connects.push_back(std::move(connect));
      return;
    }
    robot_.welds.push_back({std::move(connect), tidying_.rotation(data + 6)});
    if (torque_scale != 1) note(fmt::format("the torquescale of weld '{}' is left out: the weld is rigid", name));
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

  void add_mimic(const RobotXml::Mimic& mimic) {
    robot_.couplings.push_back({fmt::format("{} mimics {}", mimic.joint, mimic.followed),
                                {{{mimic.joint, 1.0}}, {}, 0},
                                {{{{mimic.followed, 1.0}}, {}, 0}},
                                {mimic.offset, mimic.multiplier, 0, 0, 0}});
  }

  // ---- notes

  void add_notes() {
    // what is more than rounding of a double
    if (tidying_.largest > 1e-14) {
      note(fmt::format("angles within {:g} rad of a right angle are taken as right angles; the farthest was {:.1e} off",
                       right_angle_tolerance, tidying_.largest));
    }
    if (const auto n = count(m_.jnt_limited, m_.njnt) + count(m_.tendon_limited, m_.ntendon); n > 0) {
      note("limits of joints and tendons are left out");
    }
    if (geoms_can_touch()) note("contacts between geoms are left out");
    if (m_.nu > 0) note("actuators are left out: inputs of the model are forces at the joints");
    if (m_.nsensor > 0) note("sensors are left out");
    if (m_.nmocap > 0) note("mocap bodies stand still");
  }

  static std::ptrdiff_t count(const mjtByte* flags, int n) {
    return std::count_if(flags, flags + n, [](mjtByte flag) { return flag != 0; });
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
  std::string file_;
  RobotDescription robot_;
  Tidying tidying_;
  double reach_ = 0;  // [m]
  std::vector<std::string> body_names_, joint_names_, site_names_, equality_names_;
};

}  // namespace

bool can_read_robots() { return true; }

RobotDescription read_robot(const std::filesystem::path& path) {
  const RobotXml xml = read_robot_xml(read_file(path), path);
  std::vector<std::string> warnings;
  const ModelPointer model = load(path, xml, warnings);
  RobotDescription robot = Description(*model, path.string()).make(xml, warnings);
  try {
    check_robot(robot);
  } catch (const InputError& error) {
    throw InputError(fmt::format("{}: {}", path.string(), error.what()));
  }
  return robot;
}

}  // namespace gp2
