# Debian packages by CPack, one for each component that this build has:  scripts/package
#   libgp2-0      the shared library; a static one is in libgp2-dev
#   libgp2-dev    headers, and what find_package(gp2) and pkg-config read
#   gp2           the command, its man pages and completions, models, documentation
#   python3-gp2   the Python package
set(CPACK_GENERATOR DEB)
set(GP2_PACKAGE_CONTACT "the authors of gp2 <gp2@localhost>" CACHE STRING "Who answers for Debian packages: NAME <MAIL>")
set(CPACK_PACKAGE_CONTACT ${GP2_PACKAGE_CONTACT})
set(CPACK_PRE_BUILD_SCRIPTS ${CMAKE_CURRENT_LIST_DIR}/debian_files.cmake)
set(CPACK_PACKAGING_INSTALL_PREFIX /usr)
set(CPACK_STRIP_FILES ON)
set(CPACK_PACKAGE_DIRECTORY ${PROJECT_BINARY_DIR}/packages)
set(CPACK_DEB_COMPONENT_INSTALL ON)
set(CPACK_DEBIAN_FILE_NAME DEB-DEFAULT)
set(CPACK_DEBIAN_PACKAGE_SHLIBDEPS ON)
set(CPACK_DEBIAN_PACKAGE_GENERATE_SHLIBS ON)
set(CPACK_DEBIAN_PACKAGE_SHLIBDEPS_PRIVATE_DIRS ${PROJECT_BINARY_DIR}/src)
# of a line each, which Debian wants below 80 characters
string(JOIN "\n" gp2_extended_description
  "gp2 learns the part of a robot's dynamics that nobody has a formula for,"
  "mostly friction, from measured accelerations, with a Gaussian process whose"
  "predictions obey the known constraints to rounding.")

set(CPACK_COMPONENTS_ALL development command)
set(needs_library "")
if(gp2_type STREQUAL "SHARED_LIBRARY")
  list(PREPEND CPACK_COMPONENTS_ALL library)
  set(needs_library "libgp2-0 (= ${PROJECT_VERSION})")
endif()

function(gp2_package component name section description)
  string(TOUPPER ${component} COMPONENT)
  list(JOIN ARGN ", " needs)
  set(CPACK_DEBIAN_${COMPONENT}_PACKAGE_NAME ${name} PARENT_SCOPE)
  set(CPACK_DEBIAN_${COMPONENT}_PACKAGE_SECTION ${section} PARENT_SCOPE)
  set(CPACK_DEBIAN_${COMPONENT}_PACKAGE_DEPENDS "${needs}" PARENT_SCOPE)
  set(CPACK_DEBIAN_${COMPONENT}_DESCRIPTION "${description}\n${gp2_extended_description}" PARENT_SCOPE)
  install(FILES ${PROJECT_SOURCE_DIR}/LICENSE DESTINATION ${CMAKE_INSTALL_DATADIR}/doc/${name} RENAME copyright
          COMPONENT ${component} EXCLUDE_FROM_ALL)
  install(FILES ${PROJECT_SOURCE_DIR}/THIRD_PARTY.md DESTINATION ${CMAKE_INSTALL_DATADIR}/doc/${name}
          COMPONENT ${component} EXCLUDE_FROM_ALL)
endfunction()

if(needs_library)
  gp2_package(library libgp2-0 libs "The shared libraries.")
endif()
set(needs_for_development libeigen3-dev libfmt-dev libopenblas-dev ${needs_library})
if(gp2_needs_mujoco)
  list(APPEND needs_for_development libmujoco-dev)
endif()
gp2_package(development libgp2-dev libdevel "C++ headers, and what CMake and pkg-config read." ${needs_for_development})
gp2_package(command gp2 science "The command." ${needs_library})
if(GP2_BUILD_PYTHON)
  list(APPEND CPACK_COMPONENTS_ALL python)
  find_package(Python 3.9 REQUIRED COMPONENTS Interpreter)
  math(EXPR next_minor "${Python_VERSION_MINOR} + 1")
  gp2_package(python python3-gp2 python "The Python package." python3-numpy "python3 (>= 3.${Python_VERSION_MINOR})"
              "python3 (<< 3.${next_minor})" ${needs_library})
endif()
include(CPack)
