#include "input_error.hpp"

#include "gp2/error.hpp"

namespace gp2::test {

std::string input_error_of(const std::function<void()>& f) {
  try {
    f();
  } catch (const InputError& error) {
    return error.what();
  }
  return "";
}

}  // namespace gp2::test
