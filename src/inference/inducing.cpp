#include "gp2/inference/inducing.hpp"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "data/evenly.hpp"
#include "gp2/error.hpp"
#include "inference/inducing_latents.hpp"
#include "inference/requirements.hpp"
#include "prior/gradient_columns.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// One latent at the candidates: what its points so far leave of its covariance there, and the factor that tells. A point of a
// potential has the E derivatives, which are taken together; of all else E = 1, for each function alike.
class Candidates {
 public:
  Candidates(const LatentRows& rows, std::size_t a)
      : latent_(rows.latents[a]), kernel_(latent_.kernel), E_(latent_.is_potential ? latent_.n_functions : 1) {
    const Index n = kernel_.n_points();
    weight_.setZero(n, E_ * E_);
    left_.setZero(n, E_ * E_);
    VectorXd point;
    const VectorXd of_gradient = latent_.is_potential ? GradientColumns(kernel_).variance() : VectorXd();
    for (Index i = 0; i < n; ++i) {
      if (latent_.is_potential) {
        const MatrixXd Gamma = latent_.Z.row(i).reshaped(E_, latent_.Z.cols() / E_).transpose();
        weight_.row(i) = (Gamma.transpose() * Gamma).reshaped().transpose();
        left_.row(i).reshaped(E_, E_).diagonal() = of_gradient;
        continue;
      }
      weight_(i, 0) = latent_.Z.row(i).squaredNorm();
      kernel_.scale(i, point);
      left_(i, 0) = kernel_.variance(point);
    }
    smallest_ = smallest_pivot * (n > 0 ? left_.maxCoeff() : 0);
  }

  [[nodiscard]] Index n_functions() const { return latent_.n_functions; }
  [[nodiscard]] double trace() const { return weight_.cwiseProduct(left_).sum(); }
  [[nodiscard]] MatrixXd points() const { return kernel_.features()(chosen_, Eigen::all); }

  // what the best candidate would take from the trace at least: its own part
  double largest() {
    const double largest = weight_.cwiseProduct(left_).rowwise().sum().maxCoeff(&next_);
    return left_.row(next_).maxCoeff() > smallest_ ? largest : 0;
  }

  void take() {
    chosen_.push_back(next_);
    for (Index taken = 0; taken < E_; ++taken) {
      Index e = 0;
      if (!(left_.row(next_).reshaped(E_, E_).diagonal().maxCoeff(&e) > smallest_)) return;
      add_column(e);
    }
  }

 private:
  void add_column(Index e) {
    const Index n = kernel_.n_points(), m = n_columns_++;
    VectorXd point;
    kernel_.scale(next_, point);
    MatrixXd k(latent_.is_potential ? n : kernel_.n_rows(), E_);
    if (latent_.is_potential) {
      const GradientColumns columns(kernel_);
      columns.evaluate(0, n, point, gradient_);
      columns.multiply(VectorXd::Unit(E_, e), gradient_);
      k = gradient_.out;
    } else {
      kernel_.evaluate(0, k.rows(), point, k.data(), workspace_);
    }
    if (factor_.cols() == m) factor_.conservativeResize(n * E_, std::max<Index>(32, 2 * m));
    VectorXd column = k.topRows(n).reshaped();
    column.noalias() -= factor_.leftCols(m) * factor_.row(e * n + next_).head(m).transpose();
    column /= std::sqrt(left_(next_, e * E_ + e));
    for (Index d = 0; d < E_; ++d) {
      for (Index c = 0; c < E_; ++c) {
        const auto product = column.segment(c * n, n).cwiseProduct(column.segment(d * n, n));
        left_.col(d * E_ + c) -= product;
        if (c == d) left_.col(d * E_ + c) = left_.col(d * E_ + c).cwiseMax(0);
      }
    }
    left_.row(next_).reshaped(E_, E_).row(e).setZero();
    left_.row(next_).reshaped(E_, E_).col(e).setZero();
    factor_.col(m) = column;
  }

  const LatentRows::OfLatent& latent_;
  const KernelColumns& kernel_;
  Index E_;
  MatrixXd weight_, left_;  // Σ_c Γ_ic Γ_icᵀ, of all functions alike Σ_f ‖Γ_i,f‖²; k(φ_i, φ_i) − w_iᵀw_i  (n × E²)
  double smallest_ = 0;
  Index next_ = 0, n_columns_ = 0;
  std::vector<Index> chosen_;
  MatrixXd factor_;  // column j: wᵀ of every candidate for variable j, derivative after derivative
  KernelColumns::Workspace workspace_;
  GradientColumns::Workspace gradient_;
};

}  // namespace

InducingChoice choose_inducing_points(const Prior& prior, const std::vector<Observations>& observations,
                                      const ModelValues& values, const InducingOptions& options) {
  if (options.most < 1) throw InputError(fmt::format("inducing: there must be 1 point or more, got {}", options.most));
  if (!(options.left_out > 0)) throw InputError(fmt::format("inducing: left_out must be positive, got {}", options.left_out));
  if (options.n_candidates < 1)
    throw InputError(fmt::format("inducing: n_candidates must be 1 or more, got {}", options.n_candidates));
  require_observations(prior, observations);
  require_values(prior, observations, values);
  const int n_all = n_states(observations);
  const bool are_all = n_all <= options.n_candidates;
  const std::vector<Observations> some = are_all ? observations : evenly(observations, options.n_candidates);
  Linearisation about;  // where that is known; else where no latent acts
  if (values.about) about = are_all ? *values.about : take(*values.about, evenly_taken(observations, options.n_candidates));
  Reduction reduction;
  reduce(prior, some, require_models(prior, some, values.parameters, values.about ? &about : nullptr), values.noise_stddev,
         reduction);
  const LatentRows rows = latent_rows(prior, some, reduction, values);
  const Index n = rows.n_samples();
  std::vector<Candidates> latents;
  for (std::size_t a = 0; a < rows.latents.size(); ++a) latents.emplace_back(rows, a);
  const double scale = n == 0 ? 0 : static_cast<double>(n_all) / static_cast<double>(n);
  InducingChoice choice;
  for (;;) {
    choice.left_out = 0;
    Candidates* best = nullptr;
    double largest = 0;
    for (std::size_t a = 0; a < latents.size(); ++a) {
      if (is_local(prior.latents[a])) continue;  // no number of points holds it
      Candidates& latent = latents[a];
      choice.left_out += scale * latent.trace();
      if (n == 0 || choice.n_variables + latent.n_functions() > options.most) continue;
      const double part = latent.largest();
      if (part > largest) largest = part, best = &latent;
    }
    if (choice.left_out <= options.left_out || best == nullptr) break;
    best->take();
    choice.n_variables += static_cast<int>(best->n_functions());
  }
  auto points = std::make_shared<InducingPoints>();
  for (const Candidates& latent : latents) points->features.push_back(latent.points());
  choice.points = std::move(points);
  return choice;
}

VectorXd left_out_by_points(const Prior& prior, const std::vector<Observations>& observations, const ModelValues& values,
                            const Workers& workers) {
  if (!values.inducing) throw InputError("left_out_by_points: the values have no inducing points");
  require_observations(prior, observations);
  require_values(prior, observations, values);
  const lapack::SingleThread single_thread;
  const InducingLatents latents(prior, values);
  const auto add = [&](VectorSum& sum, int, const RowBlock&, const InducingBlock& block) {
    for (std::size_t f = 0; f < latents.functions().size(); ++f) {
      sum.sum[static_cast<Index>(latents.functions()[f].latent)] += block.left_out(f);
    }
  };
  const BlocksOfStates blocks(prior, observations, values, values.about.get());
  std::optional<VectorSum> all =
      sum_over_blocks(latents, blocks, false, workers, nullptr, VectorSum{VectorXd::Zero(std::ssize(prior.latents))}, add);
  if (!all) static_cast<void>(require_models(prior, observations, values.parameters, values.about.get()));  // names the state
  return std::move(all->sum);
}

}  // namespace gp2
