#pragma once

// toml++ as every part of gp2 includes it. Its parser asserts what a file need not obey (3.3 does so for "[=]"), and where NDEBUG
// is defined it lets the compiler rely on that; here such a file is refused.

#include "gp2/error.hpp"

namespace gp2 {

[[noreturn]] inline void throw_not_toml() { throw InputError("not valid TOML"); }

}  // namespace gp2

#pragma push_macro("NDEBUG")
#undef NDEBUG
#define TOML_ASSERT(condition) ((condition) ? static_cast<void>(0) : gp2::throw_not_toml())
#include <toml++/toml.h>
#pragma pop_macro("NDEBUG")
