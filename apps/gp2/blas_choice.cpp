#include "blas_choice.hpp"

#include <cerrno>
#include <cstdlib>

#include "gp2/base/blas.hpp"

#ifdef __linux__
#include <sys/prctl.h>
#include <unistd.h>
#endif

namespace gp2::command {

namespace {

constexpr const char* kernel_variable = "OPENBLAS_CORETYPE";
// set from the first start to the second, which is thereby the last
constexpr const char* restart_variable = "GP2_BLAS_CHOSEN";

bool restarted = false;

}  // namespace

void choose_blas_kernel([[maybe_unused]] char** argv) {
#ifdef __linux__
  if (std::getenv(restart_variable) != nullptr) {
    restarted = std::getenv(kernel_variable) != nullptr;
    unsetenv(restart_variable);
    unsetenv(kernel_variable);
    prctl(PR_SET_NAME, program_invocation_short_name);  // which is "exe" by now, after the link that was started
    return;
  }
  if (std::getenv(kernel_variable) != nullptr) return;
  const std::string kernel = blas_report().fastest_kernel;
  if (kernel.empty()) return;

  setenv(kernel_variable, kernel.c_str(), 1);
  setenv(restart_variable, "1", 1);
  execv("/proc/self/exe", argv);
  unsetenv(kernel_variable);
  unsetenv(restart_variable);
#endif
}

std::string blas_kernel_chosen_by() {
  if (restarted) return "gp2";
  return std::getenv(kernel_variable) != nullptr ? kernel_variable : "OpenBLAS";
}

}  // namespace gp2::command
