#pragma once

#include <span>
#include <vector>

#include "gp2/symbolic/expression.hpp"

namespace gp2::internal {

/// StateDerivatives before they become a tape.
struct DerivativeExpressions {
  std::vector<StateDerivatives::Entry> entries;
  std::vector<Expression> expressions;  // one per entry
};
DerivativeExpressions state_derivatives(std::span<const Expression> expressions, std::span<const Expression> state);

}  // namespace gp2::internal
