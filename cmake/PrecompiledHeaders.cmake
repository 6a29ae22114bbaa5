# Parses once what nearly every file includes: the standard library, Eigen and fmt; for the tests also GoogleTest and JSON.
#
#   gp2_use_precompiled_headers(TARGET [gp2_precompiled_for_tests])
#
# A file still names every header that it uses: the preset "tidy" compiles without them. All targets are compiled as
# position-independent code, so that they can share one.
option(GP2_PRECOMPILED_HEADERS "Parse Eigen, fmt and the standard library once for all files" ${PROJECT_IS_TOP_LEVEL})

set(gp2_precompiled_headers <algorithm> <array> <atomic> <charconv> <chrono> <cmath> <cstdint> <filesystem> <fstream> <functional>
    <limits> <map> <memory> <mutex> <numbers> <numeric> <optional> <random> <set> <span> <sstream> <string> <string_view> <thread>
    <tuple> <unordered_map> <utility> <variant> <vector> <fmt/format.h> <fmt/ranges.h> <Eigen/Dense>)

# ccache must be told not to mind the times of the headers inside, and GCC to name the precompiled header to it
macro(gp2_let_ccache_know_precompiled_headers)
  if("${CMAKE_CXX_COMPILER_LAUNCHER}" MATCHES "(^|/)ccache$")
    set(CMAKE_CXX_COMPILER_LAUNCHER ${CMAKE_COMMAND} -E env
        CCACHE_SLOPPINESS=pch_defines,time_macros,include_file_mtime,include_file_ctime ${CMAKE_CXX_COMPILER_LAUNCHER})
  endif()
endmacro()

function(gp2_add_precompiled_headers name)
  set(source ${CMAKE_CURRENT_BINARY_DIR}/CMakeFiles/${name}.cpp)
  file(CONFIGURE OUTPUT ${source} CONTENT "// carries the precompiled headers\n")
  add_library(${name} OBJECT ${source})
  # the warnings too: -Wpedantic changes what is predefined
  target_link_libraries(${name} PRIVATE Eigen3::Eigen fmt::fmt gp2_warnings)
  target_compile_options(${name} PRIVATE $<$<CXX_COMPILER_ID:GNU>:-fpch-preprocess>)
  target_precompile_headers(${name} PRIVATE ${gp2_precompiled_headers} ${ARGN})
endfunction()

function(gp2_use_precompiled_headers target)
  if(NOT GP2_PRECOMPILED_HEADERS)
    return()
  endif()
  set(candidates gp2_precompiled ${ARGN})
  list(GET candidates -1 from)
  target_precompile_headers(${target} REUSE_FROM ${from})
  target_compile_options(${target} PRIVATE ${CMAKE_CXX_COMPILE_OPTIONS_PIC} $<$<CXX_COMPILER_ID:GNU>:-fpch-preprocess>)
endfunction()

if(GP2_PRECOMPILED_HEADERS)
  gp2_let_ccache_know_precompiled_headers()
  gp2_add_precompiled_headers(gp2_precompiled)
endif()
