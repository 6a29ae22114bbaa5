#pragma once

#include <string>

namespace gp2::c_export {

// sqrt(x) -> sqrtf(x)
void use_float_functions(std::string& source);

// sin(x) -> portable_sin(x), but not in comments, and these functions for @portable@; sinf rounds what portable_sin finds
void use_portable_functions(std::string& source, const std::string& name);

}  // namespace gp2::c_export
