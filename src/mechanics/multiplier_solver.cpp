#include "mechanics/multiplier_solver.hpp"

namespace gp2 {

MechanicsBatch::Fault no_multipliers(int state) {
  MechanicsBatch::Fault fault{state, {}};
  fault.text =
      "a force that grows with the load of the constraints makes more load than it needs: there is no motion, or more than one "
      "(Painlevé's paradox); its coefficient is too large here";
  return fault;
}

}  // namespace gp2
