#pragma once

#include <string>

namespace gp2::command {

/// Makes sure that OpenBLAS computes with the kernel that is fastest on this processor (gp2/base/blas.hpp). To be called first in
/// main.
///
/// OpenBLAS chooses when it is loaded, before main, and takes a kernel's name from OPENBLAS_CORETYPE alone. Where that is not set
/// and another kernel is better, this sets it and starts the program over in the same process, once: same arguments, files,
/// process id. The second start takes the variable out of the environment again, so that programs called by it find what the user
/// had. Where OPENBLAS_CORETYPE is set, to whatever it be and be it to nothing, the user has chosen, and all stays as it is. So
/// it does when starting over fails.
void choose_blas_kernel(char** argv);

/// Who chose the kernel in use: "OPENBLAS_CORETYPE", "gp2" or "OpenBLAS".
std::string blas_kernel_chosen_by();

}  // namespace gp2::command
