# Finds the L-BFGS-B of Zhu, Byrd, Lu and Nocedal (a Fortran library without a header) and defines the target LBFGSB::LBFGSB.
# The target is made anew on every machine, so that an installed gp2 carries no path of the machine that built it.
find_library(LBFGSB_LIBRARY NAMES lbfgsb)
mark_as_advanced(LBFGSB_LIBRARY)

include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(LBFGSB REQUIRED_VARS LBFGSB_LIBRARY
                                  REASON_FAILURE_MESSAGE "On Debian: sudo apt-get install liblbfgsb-dev")

if(LBFGSB_FOUND AND NOT TARGET LBFGSB::LBFGSB)
  add_library(LBFGSB::LBFGSB UNKNOWN IMPORTED)
  set_target_properties(LBFGSB::LBFGSB PROPERTIES IMPORTED_LOCATION "${LBFGSB_LIBRARY}")
endif()
