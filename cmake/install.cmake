# Installs the library, its headers, the command, the models, the experiments, the documentation with its examples, and the package
# that find_package(gp2) reads.
option(GP2_INSTALL "Install gp2 along with the project" ${PROJECT_IS_TOP_LEVEL})
if(NOT GP2_INSTALL)
  return()
endif()

include(CMakePackageConfigHelpers)
include(GNUInstallDirs)
set(gp2_cmake_dir ${CMAKE_INSTALL_LIBDIR}/cmake/gp2)

install(TARGETS gp2 gp2_predict EXPORT gp2Targets)
install(DIRECTORY ${PROJECT_SOURCE_DIR}/include/gp2 DESTINATION ${CMAKE_INSTALL_INCLUDEDIR} FILES_MATCHING PATTERN "*.hpp")
install(DIRECTORY ${PROJECT_SOURCE_DIR}/models/ DESTINATION ${CMAKE_INSTALL_DATADIR}/gp2/models FILES_MATCHING PATTERN "*.toml"
        PATTERN "*.xml")
install(DIRECTORY ${PROJECT_SOURCE_DIR}/experiments/ DESTINATION ${CMAKE_INSTALL_DATADIR}/gp2/experiments
        FILES_MATCHING PATTERN "*.toml" PATTERN "*.xml" PATTERN "*.gp")
install(FILES ${PROJECT_SOURCE_DIR}/LICENSE ${PROJECT_SOURCE_DIR}/THIRD_PARTY.md ${PROJECT_SOURCE_DIR}/README.md
              ${PROJECT_SOURCE_DIR}/CHANGELOG.md
        DESTINATION ${CMAKE_INSTALL_DOCDIR})
install(DIRECTORY ${PROJECT_SOURCE_DIR}/docs DESTINATION ${CMAKE_INSTALL_DOCDIR} FILES_MATCHING PATTERN "*.md")
install(DIRECTORY ${PROJECT_SOURCE_DIR}/examples DESTINATION ${CMAKE_INSTALL_DOCDIR})
if(TARGET gp2_command)
  set_target_properties(gp2_command PROPERTIES INSTALL_RPATH "$ORIGIN/../${CMAKE_INSTALL_LIBDIR}")
  install(TARGETS gp2_command)
endif()

install(EXPORT gp2Targets NAMESPACE gp2:: DESTINATION ${gp2_cmake_dir})
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
        DESTINATION ${gp2_cmake_dir})
