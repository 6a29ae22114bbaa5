# Makes L-BFGS-B 3.0 of Zhu, Byrd, Lu, Nocedal and Morales (Fortran) a silent part of a target:
#
#   gp2_add_quiet_lbfgsb(TARGET)
#
# Whatever iprint says, L-BFGS-B prints to standard output when its line search meets an ascent direction. So its static archive is
# linked into one object in which
#   - the calls into the Fortran runtime go to src/training/lbfgsb_runtime.cpp instead: nothing is printed, libgfortran not needed;
#   - the only global symbol is gp2_setulb_: no clash with another L-BFGS-B in the same process (SciPy has one).
find_library(GP2_LBFGSB_ARCHIVE NAMES liblbfgsb.a)
mark_as_advanced(GP2_LBFGSB_ARCHIVE)
if(NOT GP2_LBFGSB_ARCHIVE)
  message(FATAL_ERROR "gp2 needs the static library of L-BFGS-B, liblbfgsb.a, which was not found. "
                      "On Debian: sudo apt-get install liblbfgsb-dev. Elsewhere: cmake -DGP2_LBFGSB_ARCHIVE=/path/to/liblbfgsb.a")
endif()
if(NOT CMAKE_OBJCOPY OR NOT CMAKE_NM)
  message(FATAL_ERROR "gp2 needs objcopy and nm, which were not found. On Debian: sudo apt-get install binutils")
endif()

function(gp2_add_quiet_lbfgsb target)
  set(object ${CMAKE_CURRENT_BINARY_DIR}/gp2_lbfgsb.o)
  set(draft ${CMAKE_CURRENT_BINARY_DIR}/CMakeFiles/gp2_lbfgsb.o)
  set_property(DIRECTORY APPEND PROPERTY CMAKE_CONFIGURE_DEPENDS ${GP2_LBFGSB_ARCHIVE})
  execute_process(COMMAND ${CMAKE_CXX_COMPILER} -r -nostdlib -Wl,--whole-archive ${GP2_LBFGSB_ARCHIVE} -o ${draft}
                  COMMAND_ERROR_IS_FATAL ANY)
  set(renames --redefine-sym setulb_=gp2_setulb_)
  foreach(name st_write st_write_done transfer_array_write transfer_character_write transfer_integer_write transfer_real_write
               compare_string cpu_time_4)
    list(APPEND renames --redefine-sym _gfortran_${name}=gp2_lbfgsb_${name})
  endforeach()
  execute_process(COMMAND ${CMAKE_OBJCOPY} ${renames} ${draft} COMMAND_ERROR_IS_FATAL ANY)
  execute_process(COMMAND ${CMAKE_OBJCOPY} --keep-global-symbol gp2_setulb_ ${draft} COMMAND_ERROR_IS_FATAL ANY)

  # an archive built by another compiler may call more of the Fortran runtime
  execute_process(COMMAND ${CMAKE_NM} -u ${draft} OUTPUT_VARIABLE undefined COMMAND_ERROR_IS_FATAL ANY)
  string(REGEX MATCHALL "_(gfortran|F)[A-Za-z0-9_]+" unknown "${undefined}")
  if(unknown)
    message(FATAL_ERROR "${GP2_LBFGSB_ARCHIVE} calls functions of the Fortran runtime that gp2 does not replace: ${unknown}. "
                        "Add them to cmake/QuietLBFGSB.cmake and src/training/lbfgsb_runtime.cpp")
  endif()

  file(COPY_FILE ${draft} ${object} ONLY_IF_DIFFERENT)
  target_sources(${target} PRIVATE training/lbfgsb_runtime.cpp ${object})
endfunction()
