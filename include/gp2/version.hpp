#pragma once

namespace gp2 {

/// The version of the library, say "0.1.0".
const char* version();

}  // namespace gp2
