#include "gp2/version.hpp"

namespace gp2 {

const char* version() { return GP2_VERSION; }

}  // namespace gp2
