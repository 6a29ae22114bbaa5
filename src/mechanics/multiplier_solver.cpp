#include "mechanics/multiplier_solver.hpp"

namespace gp2 {

MechanicsBatch::Fault MultiplierSolver::fault(int state) const {
  MechanicsBatch::Fault fault{state, {}};
  if (!is_finite_) {
    fault.text = "a force that reads lambda, or its change with lambda, is not a finite number";
    return fault;
  }
  fault.text =
      "a force that grows with the load of the constraints makes more load than it needs: there is no motion, or more than one "
      "(Painlevé's paradox); its coefficient is too large here";
  return fault;
}

}  // namespace gp2
