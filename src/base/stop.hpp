#pragma once

#include <atomic>

#include "base/parallel.hpp"
#include "gp2/error.hpp"

namespace gp2 {

/// @throws NumericalError where a stop was requested.
inline void require_not_stopped(const std::atomic<bool>* stop) {
  if (is_set(stop)) throw NumericalError("stopped on request");
}

}  // namespace gp2
