#include "inference/potential_pairs.hpp"

#include "base/parallel.hpp"
#include "base/simd.hpp"
#include "prior/gradient_columns.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

constexpr Index block_size = 16;  // samples of one task

}  // namespace

void add_potentials(const LatentRows& rows, int n_threads, Ref<MatrixXd> K, const std::atomic<bool>* stop) {
  const Reduction& reduction = *rows.reduction;
  const std::size_t n_components = reduction.count.size();
  for (const LatentRows::OfLatent& latent : rows.latents) {
    if (!latent.is_potential) continue;
    const GradientColumns columns(latent.kernel);
    const Index m = latent.n_functions, n = rows.n_samples();
    for_each_block(n, block_size, n_threads, [&](Index first_sample, Index n_of_block, int) {
      GradientColumns::Workspace w;
      VectorXd point, loading;
      for (Index j = first_sample; j < first_sample + n_of_block && !is_set(stop); ++j) {
        latent.kernel.scale(j, point);
        columns.evaluate(0, n, point, w);
        for (std::size_t right = 0; right < n_components && j < reduction.count[right]; ++right) {
          loading = latent.Z.row(j).segment(static_cast<Index>(right) * m, m).transpose();
          columns.multiply(loading, w);
          for (std::size_t left = right; left < n_components; ++left) {
            const Index first = left == right ? j : 0, below = reduction.count[left] - first;
            if (below <= 0) continue;
            auto out = K.col(reduction.offset[right] + j).segment(reduction.offset[left] + first, below).array();
            for (Index l = 0; l < m; ++l) {
              out += latent.Z.col(static_cast<Index>(left) * m + l).segment(first, below).array() *
                     w.out.col(l).segment(first, below);
            }
          }
        }
      }
    });
  }
}

namespace {

// Sums over the samples of one task.
struct TaskSums {
  VectorXd kernel, columns;
};

}  // namespace

void add_potential_gradients(const LatentRows& rows, const Ref<const MatrixXd>& P, const std::vector<GramGradientParts>& parts,
                             int n_threads, GramGradient& gradient, const std::atomic<bool>* stop) {
  const Reduction& reduction = *rows.reduction;
  const Index n = rows.n_samples(), n_components = reduction.n_components();
  const MatrixXd alpha = by_component(reduction, gradient.alpha);
  for (std::size_t a = 0; a < rows.latents.size(); ++a) {
    const LatentRows::OfLatent& latent = rows.latents[a];
    if (!latent.is_potential) continue;
    const GradientColumns columns(latent.kernel);
    const Index m = latent.n_functions;
    MatrixXd beta = MatrixXd::Zero(n, m);
    for (Index c = 0; c < n_components; ++c) {
      beta += alpha.col(c).head(n).asDiagonal() * latent.Z.middleCols(c * m, m).topRows(n);
    }
    GramGradient::OfLatent& out = gradient.latents[a];
    if (parts[a].V) out.V.setZero(simd::padded(n), latent.Z.cols());
    if (parts[a].mean) out.mean.setZero(simd::padded(n), m);
    std::vector<TaskSums> sums(static_cast<std::size_t>((n + block_size - 1) / block_size),
                               {VectorXd::Zero(latent.kernel.values().size()), VectorXd::Zero(m)});
    for_each_block(n, block_size, n_threads, [&](Index first_sample, Index n_of_block, int) {
      GradientColumns::Workspace w;
      TaskSums& sum = sums[static_cast<std::size_t>(first_sample / block_size)];
      VectorXd point, loading, V(m), S(rows.size());
      MatrixXd U(n, m);
      for (Index j = first_sample; j < first_sample + n_of_block && !is_set(stop); ++j) {
        latent.kernel.scale(j, point);
        columns.evaluate(0, n, point, w);
        if (parts[a].mean) {
          V.setZero();
          columns.add_sums(beta, V, w);
          out.mean.row(j) = V.transpose();
        }
        for (Index c = 0; c < n_components && j < reduction.count[static_cast<std::size_t>(c)]; ++c) {
          // a column of S = P − α̃α̃ᵀ, and U_i = Σ S_(i)(c, j) Z_i
          const Index row = reduction.offset[static_cast<std::size_t>(c)] + j;
          S.head(row) = P.row(row).head(row).transpose();
          S.tail(rows.size() - row) = P.col(row).tail(rows.size() - row);
          S -= gradient.alpha[row] * gradient.alpha;
          U.setZero();
          for (Index left = 0; left < n_components; ++left) {
            const Index count = reduction.count[static_cast<std::size_t>(left)];
            U.topRows(count) += S.segment(reduction.offset[static_cast<std::size_t>(left)], count).asDiagonal() *
                                latent.Z.middleCols(left * m, m).topRows(count);
          }
          loading = latent.Z.row(j).segment(c * m, m).transpose();
          V.setZero();
          columns.add_sums(U, V, w);
          sum.columns += loading.cwiseProduct(V);
          if (parts[a].V) out.V.row(j).segment(c * m, m) = V.transpose();
          if (parts[a].kernel) columns.add_gradient(U, loading, sum.kernel, w);
        }
      }
    });
    out.kernel.setZero(parts[a].kernel ? latent.kernel.values().size() : 0);
    out.columns.setZero(m);
    for (const TaskSums& sum : sums) {
      if (parts[a].kernel) out.kernel += 0.5 * sum.kernel;
      out.columns += sum.columns;
    }
  }
}

}  // namespace gp2
