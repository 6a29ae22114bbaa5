# Finds MuJoCo and defines the target MuJoCo::MuJoCo. Its own package file also asks for OpenGL, which gp2 does not need.
# The target is made anew on every machine, so that an installed gp2 carries no path of the machine that built it.
find_library(MuJoCo_LIBRARY NAMES mujoco)
find_path(MuJoCo_INCLUDE_DIR NAMES mujoco/mujoco.h)
mark_as_advanced(MuJoCo_LIBRARY MuJoCo_INCLUDE_DIR)

# mjVERSION_HEADER is 222 for 2.2.2
if(MuJoCo_INCLUDE_DIR)
  file(STRINGS "${MuJoCo_INCLUDE_DIR}/mujoco/mujoco.h" MuJoCo_VERSION REGEX "#define mjVERSION_HEADER [0-9]+")
  string(REGEX REPLACE ".*mjVERSION_HEADER ([0-9]+)([0-9])([0-9]).*" "\\1.\\2.\\3" MuJoCo_VERSION "${MuJoCo_VERSION}")
endif()

include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(MuJoCo REQUIRED_VARS MuJoCo_LIBRARY MuJoCo_INCLUDE_DIR VERSION_VAR MuJoCo_VERSION
                                  HANDLE_VERSION_RANGE REASON_FAILURE_MESSAGE "On Debian: sudo apt-get install libmujoco-dev")

if(MuJoCo_FOUND AND NOT TARGET MuJoCo::MuJoCo)
  add_library(MuJoCo::MuJoCo UNKNOWN IMPORTED)
  set_target_properties(MuJoCo::MuJoCo PROPERTIES IMPORTED_LOCATION "${MuJoCo_LIBRARY}"
                                                  INTERFACE_INCLUDE_DIRECTORIES "${MuJoCo_INCLUDE_DIR}")
endif()
