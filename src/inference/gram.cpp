#include "inference/gram.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

void LatentPosterior::subtract_explained(MatrixXd c, MatrixXd& covariance) const {
  if (c.size() == 0) return;  // Eigen would divide by 0
  whiten(c);
  covariance.selfadjointView<Eigen::Lower>().rankUpdate(c.transpose(), -1);
}

std::vector<MatrixXd> LatentPosterior::latent_weights(const VectorXd& alpha) const {
  std::vector<MatrixXd> all;
  for (const Basis& latent : latents_) {
    const Index n_functions = latent.n_functions;
    MatrixXd& weights = all.emplace_back(MatrixXd::Zero(latent.kernel.n_rows(), n_functions));
    for (std::size_t c = 0; c < row_of_.size(); ++c) {
      const auto Z = latent.Z.middleCols(static_cast<Index>(c) * n_functions, n_functions);
      for (std::size_t j = 0; j < row_of_[c].size(); ++j) {
        if (row_of_[c][j] < 0) continue;
        const Index row = static_cast<Index>(j);
        for (Index l = 0; l < n_functions; ++l) weights(row, l) += Z(row, l) * alpha[row_of_[c][j]];
      }
    }
  }
  return all;
}

void LatentPosterior::subtract_functions(const std::vector<MatrixXd>& f, VectorXd& rows) const {
  for (std::size_t a = 0; a < latents_.size(); ++a) {
    const Index n_functions = latents_[a].n_functions;
    for (std::size_t c = 0; c < row_of_.size(); ++c) {
      for (std::size_t j = 0; j < row_of_[c].size(); ++j) {
        const Index row = row_of_[c][j], point = static_cast<Index>(j);
        if (row < 0) continue;
        rows[row] -= latents_[a].Z.row(point).segment(static_cast<Index>(c) * n_functions, n_functions) * f[a].col(point);
      }
    }
  }
}

}  // namespace gp2
