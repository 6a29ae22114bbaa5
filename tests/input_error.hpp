#pragma once

#include <functional>
#include <string>

namespace gp2::test {

/// What f throws as InputError, or "" when it does not throw.
std::string input_error_of(const std::function<void()>& f);

}  // namespace gp2::test
