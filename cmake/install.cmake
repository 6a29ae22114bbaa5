# Installs the library, its headers, the command, the models, the experiments, the documentation with its examples, and what
# find_package(gp2) and pkg-config read. Its components library, development, command and python are the packages of cmake/package.cmake.
option(GP2_INSTALL "Install gp2 along with the project" ${PROJECT_IS_TOP_LEVEL})
if(NOT GP2_INSTALL)
  return()
endif()

include(CMakePackageConfigHelpers)
include(GNUInstallDirs)
set(gp2_cmake_dir ${CMAKE_INSTALL_LIBDIR}/cmake/gp2)

set(CMAKE_INSTALL_DEFAULT_COMPONENT_NAME command)
install(TARGETS gp2 gp2_predict EXPORT gp2Targets
        LIBRARY COMPONENT library NAMELINK_COMPONENT development
        ARCHIVE COMPONENT development)
install(DIRECTORY ${PROJECT_SOURCE_DIR}/include/gp2 DESTINATION ${CMAKE_INSTALL_INCLUDEDIR} COMPONENT development
        FILES_MATCHING PATTERN "*.hpp")
install(DIRECTORY ${PROJECT_SOURCE_DIR}/models/ DESTINATION ${CMAKE_INSTALL_DATADIR}/gp2/models FILES_MATCHING PATTERN "*.toml"
        PATTERN "*.xml")
install(DIRECTORY ${PROJECT_SOURCE_DIR}/experiments/ DESTINATION ${CMAKE_INSTALL_DATADIR}/gp2/experiments
        FILES_MATCHING PATTERN "*.toml" PATTERN "*.xml" PATTERN "*.gp")
install(FILES ${PROJECT_SOURCE_DIR}/LICENSE ${PROJECT_SOURCE_DIR}/THIRD_PARTY.md ${PROJECT_SOURCE_DIR}/README.md
              ${PROJECT_SOURCE_DIR}/CHANGELOG.md
        DESTINATION ${CMAKE_INSTALL_DOCDIR})
install(DIRECTORY ${PROJECT_SOURCE_DIR}/docs DESTINATION ${CMAKE_INSTALL_DOCDIR} FILES_MATCHING PATTERN "*.md"
        PATTERN "*.svg" PATTERN "site" EXCLUDE)
install(DIRECTORY ${PROJECT_SOURCE_DIR}/examples DESTINATION ${CMAKE_INSTALL_DOCDIR})
if(TARGET gp2_command)
  if(NOT CMAKE_INSTALL_PREFIX STREQUAL /usr)
    set_target_properties(gp2_command PROPERTIES INSTALL_RPATH "$ORIGIN/../${CMAKE_INSTALL_LIBDIR}")
  endif()
  install(TARGETS gp2_command)
  if(gp2_share_dir)
    install(DIRECTORY ${gp2_share_dir}/ DESTINATION ${CMAKE_INSTALL_DATADIR})
  endif()
endif()

install(EXPORT gp2Targets NAMESPACE gp2:: DESTINATION ${gp2_cmake_dir} COMPONENT development)
# a static gp2 leaves linking MuJoCo to its users
get_target_property(gp2_type gp2 TYPE)
set(gp2_needs_mujoco FALSE)
if(gp2_has_mujoco AND gp2_type STREQUAL "STATIC_LIBRARY")
  set(gp2_needs_mujoco TRUE)
endif()
configure_package_config_file(${CMAKE_CURRENT_LIST_DIR}/gp2Config.cmake.in ${PROJECT_BINARY_DIR}/gp2Config.cmake
                              INSTALL_DESTINATION ${gp2_cmake_dir})
write_basic_package_version_file(${PROJECT_BINARY_DIR}/gp2ConfigVersion.cmake COMPATIBILITY SameMinorVersion)
install(FILES ${PROJECT_BINARY_DIR}/gp2Config.cmake ${PROJECT_BINARY_DIR}/gp2ConfigVersion.cmake
              ${CMAKE_CURRENT_LIST_DIR}/FindOpenBLAS.cmake ${CMAKE_CURRENT_LIST_DIR}/FindMuJoCo.cmake
        DESTINATION ${gp2_cmake_dir} COMPONENT development)

# for pkg-config; what a static gp2 needs is linked by its users
file(RELATIVE_PATH gp2_pc_prefix /${CMAKE_INSTALL_LIBDIR}/pkgconfig /)
set(gp2_pc_flags "")
set(gp2_pc_libraries "-lfmt -lopenblas -lpthread")
if(gp2_needs_mujoco)
  string(APPEND gp2_pc_libraries " -lmujoco")
endif()
if(gp2_type STREQUAL "SHARED_LIBRARY")
  set(gp2_pc_flags "-DGP2_SHARED")
  set(gp2_pc_libraries "")
endif()
if(gp2_eigen_uses_malloc)
  string(APPEND gp2_pc_flags " -DEIGEN_MALLOC_ALREADY_ALIGNED=1")
endif()
configure_file(${CMAKE_CURRENT_LIST_DIR}/gp2.pc.in ${PROJECT_BINARY_DIR}/gp2.pc @ONLY)
install(FILES ${PROJECT_BINARY_DIR}/gp2.pc DESTINATION ${CMAKE_INSTALL_LIBDIR}/pkgconfig COMPONENT development)

include(${CMAKE_CURRENT_LIST_DIR}/package.cmake)
