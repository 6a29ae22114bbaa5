# Finds MuJoCo and defines the target MuJoCo::MuJoCo. Its own package file also asks for OpenGL, which gp2 does not need.
# GP2_MUJOCO_DIR names the folder of an unpacked release, in place of what the system has.
# The target is made anew on every machine, so that an installed gp2 carries no path of the machine that built it.
if(NOT "${GP2_MUJOCO_DIR}" STREQUAL "${MuJoCo_SEARCHED_DIR}")
  unset(MuJoCo_LIBRARY CACHE)
  unset(MuJoCo_INCLUDE_DIR CACHE)
endif()
set(MuJoCo_SEARCHED_DIR "${GP2_MUJOCO_DIR}" CACHE INTERNAL "where MuJoCo_LIBRARY and MuJoCo_INCLUDE_DIR were looked for")
if(GP2_MUJOCO_DIR)
  find_library(MuJoCo_LIBRARY NAMES mujoco PATHS "${GP2_MUJOCO_DIR}" PATH_SUFFIXES lib NO_DEFAULT_PATH)
  find_path(MuJoCo_INCLUDE_DIR NAMES mujoco/mujoco.h PATHS "${GP2_MUJOCO_DIR}" PATH_SUFFIXES include NO_DEFAULT_PATH)
else()
  find_library(MuJoCo_LIBRARY NAMES mujoco)
  find_path(MuJoCo_INCLUDE_DIR NAMES mujoco/mujoco.h)
endif()
mark_as_advanced(MuJoCo_LIBRARY MuJoCo_INCLUDE_DIR)

# mjVERSION_HEADER is 222 for 2.2.2, 340 for 3.4.0 and from then on 3005000 for 3.5.0
if(MuJoCo_INCLUDE_DIR)
  file(STRINGS "${MuJoCo_INCLUDE_DIR}/mujoco/mujoco.h" MuJoCo_header REGEX "#define mjVERSION_HEADER [0-9]+")
  string(REGEX REPLACE ".*mjVERSION_HEADER ([0-9]+).*" "\\1" MuJoCo_header "${MuJoCo_header}")
  set(MuJoCo_base 10)
  if(MuJoCo_header GREATER_EQUAL 1000000)
    set(MuJoCo_base 1000)
  endif()
  math(EXPR MuJoCo_major "${MuJoCo_header} / ${MuJoCo_base} / ${MuJoCo_base}")
  math(EXPR MuJoCo_minor "${MuJoCo_header} / ${MuJoCo_base} % ${MuJoCo_base}")
  math(EXPR MuJoCo_patch "${MuJoCo_header} % ${MuJoCo_base}")
  set(MuJoCo_VERSION "${MuJoCo_major}.${MuJoCo_minor}.${MuJoCo_patch}")
endif()

include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(MuJoCo REQUIRED_VARS MuJoCo_LIBRARY MuJoCo_INCLUDE_DIR VERSION_VAR MuJoCo_VERSION
                                  HANDLE_VERSION_RANGE REASON_FAILURE_MESSAGE "On Debian: sudo apt-get install libmujoco-dev, or -DGP2_MUJOCO_DIR=FOLDER of an unpacked release")

if(MuJoCo_FOUND AND NOT TARGET MuJoCo::MuJoCo)
  add_library(MuJoCo::MuJoCo UNKNOWN IMPORTED)
  set_target_properties(MuJoCo::MuJoCo PROPERTIES IMPORTED_LOCATION "${MuJoCo_LIBRARY}"
                                                  INTERFACE_INCLUDE_DIRECTORIES "${MuJoCo_INCLUDE_DIR}")
endif()
