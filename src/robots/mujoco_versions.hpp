#pragma once

// What differs between the headers of MuJoCo 2.2.2 and 3.x, in one place. A field that only some versions have is looked for in the
// type of the model, so that each line below holds for every version in which its field exists.

#include <cstddef>
#include <cstring>
#include <memory>
#include <string>
#include <type_traits>

#include <mujoco/mujoco.h>

namespace gp2::mujoco {

static_assert(std::is_same_v<mjtNum, double>, "gp2 needs a MuJoCo that computes in double precision");

// 3.3.6 has two flags where one was before; gravity compensation and forces of plugins are off where both are set.
#if mjVERSION_HEADER >= 336
inline constexpr int springs_off = mjDSBL_SPRING, dampers_off = mjDSBL_DAMPER;
#else
inline constexpr int springs_off = mjDSBL_PASSIVE, dampers_off = mjDSBL_PASSIVE;
#endif

struct DeleteFiles {
  void operator()(mjVFS* files) const {
    mj_deleteVFS(files);
    delete files;
  }
};
using Files = std::unique_ptr<mjVFS, DeleteFiles>;

/// Adds a text as a file that is only in memory. @return whether MuJoCo takes a file of this name
template <class VirtualFiles>
bool add_file(VirtualFiles& files, const std::string& name, const std::string& text) {
  if constexpr (requires { files.filedata; }) {
    if (mj_makeEmptyFileVFS(&files, name.c_str(), static_cast<int>(text.size())) != 0) return false;
    std::memcpy(files.filedata[0], text.data(), text.size());
    return true;
  } else {  // 3.2.0
    return mj_addBufferVFS(&files, name.c_str(), text.data(), static_cast<int>(text.size())) == 0;
  }
}

/// What only some versions of a model have. In the others its arrays are null and its numbers 0.
struct LaterFields {
  const int* eq_objtype = nullptr;               // 3.2.3: connect and weld by sites
  const mjtNum* body_gravcomp = nullptr;         // 2.3.1
  const int* body_plugin = nullptr;              // 2.3.0: −1 for none
  const mjtNum* jnt_stiffnesspoly = nullptr;     // 3.7.0: n_poly numbers each, as all that end so
  const mjtNum* dof_dampingpoly = nullptr;       //
  const mjtNum* tendon_stiffnesspoly = nullptr;  //
  const mjtNum* tendon_dampingpoly = nullptr;    //
  const mjtNum* tendon_armature = nullptr;       // 3.3.1
  const mjtNum* actuator_armature = nullptr;     // 3.7.0
  const mjtNum* actuator_damping = nullptr;      //
  const mjtNum* actuator_dampingpoly = nullptr;  //
  std::ptrdiff_t n_actuators = 0;
  std::ptrdiff_t n_flexes = 0;   // 3.0.0
  std::ptrdiff_t n_plugins = 0;  // 2.3.0
  int n_poly = 0;
};

template <class Model>
LaterFields later_fields(const Model& m) {
  LaterFields later;
  if constexpr (requires { m.eq_objtype; }) later.eq_objtype = m.eq_objtype;
  if constexpr (requires { m.body_gravcomp; }) later.body_gravcomp = m.body_gravcomp;
  if constexpr (requires { m.body_plugin; }) later.body_plugin = m.body_plugin;
  if constexpr (requires { m.jnt_stiffnesspoly; }) later.jnt_stiffnesspoly = m.jnt_stiffnesspoly;
  if constexpr (requires { m.dof_dampingpoly; }) later.dof_dampingpoly = m.dof_dampingpoly;
  if constexpr (requires { m.tendon_stiffnesspoly; }) later.tendon_stiffnesspoly = m.tendon_stiffnesspoly;
  if constexpr (requires { m.tendon_dampingpoly; }) later.tendon_dampingpoly = m.tendon_dampingpoly;
  if constexpr (requires { m.tendon_armature; }) later.tendon_armature = m.tendon_armature;
  if constexpr (requires { m.actuator_armature; }) later.actuator_armature = m.actuator_armature;
  if constexpr (requires { m.actuator_damping; }) later.actuator_damping = m.actuator_damping;
  if constexpr (requires { m.actuator_dampingpoly; }) later.actuator_dampingpoly = m.actuator_dampingpoly;
  // 3.11.0 counts controls in nu
  if constexpr (requires { m.nactuator; }) {
    later.n_actuators = m.nactuator;
  } else {
    later.n_actuators = m.nu;
  }
  if constexpr (requires { m.nflex; }) later.n_flexes = m.nflex;
  if constexpr (requires { m.nplugin; }) later.n_plugins = m.nplugin;
#ifdef mjNPOLY
  later.n_poly = mjNPOLY;
#endif
  return later;
}

template <class Model>
bool equality_is_active(const Model& model, int id) {
  if constexpr (requires { model.eq_active0; }) {  // 3.0.0
    return model.eq_active0[id] != 0;
  } else {
    return model.eq_active[id] != 0;
  }
}

}  // namespace gp2::mujoco
