#include "inference/gram.hpp"

namespace gp2 {

void LatentPosterior::subtract_explained(Eigen::MatrixXd c, Eigen::MatrixXd& covariance) const {
  if (c.size() == 0) return;  // Eigen would divide by 0
  whiten(c);
  covariance.selfadjointView<Eigen::Lower>().rankUpdate(c.transpose(), -1);
}

}  // namespace gp2
