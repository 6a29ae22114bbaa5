// Loaded before OpenBLAS (LD_PRELOAD), plays one that takes the kernel Haswell by itself, as older ones do on processors that
// came after them; with STUBBORN_BLAS in the environment also when told otherwise. Writes a line to the file DIARY
// whenever a program starts, with its argv[0], and when it ends, with the environment that it would hand on.
#include <cerrno>
#include <cstdlib>
#include <fstream>

#include <dlfcn.h>

namespace {

// as the variables are when OpenBLAS reads them
struct Start {
  bool obeys = std::getenv("OPENBLAS_CORETYPE") != nullptr && std::getenv("STUBBORN_BLAS") == nullptr;
  Start() { note(program_invocation_name); }
  ~Start() {
    const bool has_either = std::getenv("OPENBLAS_CORETYPE") != nullptr || std::getenv("GP2_BLAS_CHOSEN") != nullptr;
    note(has_either ? "ended, variables set" : "ended, variables not set");
  }
  Start(const Start&) = delete;
  Start& operator=(const Start&) = delete;

  static void note(const char* text) {
    if (const char* file = std::getenv("DIARY")) std::ofstream(file, std::ios::app) << text << '\n';
  }
};
const Start start;

}  // namespace

extern "C" char* openblas_get_corename() {
  static char haswell[] = "Haswell";
  if (!start.obeys) return haswell;
  const auto real = reinterpret_cast<char* (*)()>(dlsym(RTLD_NEXT, "openblas_get_corename"));
  return real();
}
