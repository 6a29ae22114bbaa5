#include "gp2/inference/inducing.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>
#include <optional>

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
  /// @param counts  of states for which each candidate stands
  Candidates(const LatentRows& rows, std::size_t a, const VectorXd& counts)
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
    weight_.array().colwise() *= counts.array();
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

// Which states of each Observations are looked at, and for how many each of them stands.
struct Some {
  std::vector<std::vector<int>> states;
  std::vector<VectorXd> counts;
};

Some even(const std::vector<Observations>& observations, int n) {
  Some some{evenly_taken(observations, n), {}};
  std::ptrdiff_t taken = 0;
  for (const std::vector<int>& states : some.states) taken += std::ssize(states);
  const double count = static_cast<double>(n_states(observations)) / static_cast<double>(taken);
  for (const std::vector<int>& states : some.states) some.counts.emplace_back(VectorXd::Constant(std::ssize(states), count));
  return some;
}

// Each added state stands for itself alone.
void add(const BlocksOfStates::States& block, Some& some) {
  std::vector<int>& states = some.states[block.group];
  VectorXd& counts = some.counts[block.group];
  std::map<int, double> all;
  for (std::size_t k = 0; k < states.size(); ++k) all[states[k]] = counts[static_cast<Index>(k)];
  for (int i = block.first; i < block.first + block.n; ++i) all.emplace(i, 1);
  states.clear();
  counts.resize(std::ssize(all));
  for (const auto& [state, count] : all) {
    counts[std::ssize(states)] = count;
    states.push_back(state);
  }
}

InducingChoice chosen_among(const Some& some, const Prior& prior, const std::vector<Observations>& observations,
                            const ModelValues& values, const InducingOptions& options) {
  std::vector<Observations> candidates;
  for (std::size_t g = 0; g < observations.size(); ++g) candidates.push_back(observations[g].take(some.states[g]));
  Linearisation about;  // where that is known; else where no latent acts
  if (values.about) about = take(*values.about, some.states);
  Reduction reduction;
  reduce(prior, candidates, require_models(prior, candidates, values.parameters, values.about ? &about : nullptr),
         values.noise_stddev, reduction);
  const LatentRows rows = latent_rows(prior, candidates, reduction, values);
  VectorXd counts(rows.n_samples());
  for (Index i = 0; i < counts.size(); ++i) {
    const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(i)];
    counts[i] = some.counts[static_cast<std::size_t>(sample.group)][sample.index];
  }
  std::vector<Candidates> latents;
  for (std::size_t a = 0; a < rows.latents.size(); ++a) latents.emplace_back(rows, a, counts);
  InducingChoice choice;
  // of the latents that are local or of those that are not, until they leave no more than `enough`, which is returned
  const auto take_points = [&](bool of_local, int most, double enough) {
    for (;;) {
      double left_out = 0, largest = 0;
      Candidates* best = nullptr;
      for (std::size_t a = 0; a < latents.size(); ++a) {
        if (is_local(prior.latents[a]) != of_local) continue;
        Candidates& latent = latents[a];
        left_out += latent.trace();
        if (counts.size() == 0 || choice.n_variables + latent.n_functions() > most) continue;
        const double part = latent.largest();
        if (part > largest) largest = part, best = &latent;
      }
      if (left_out <= enough || best == nullptr) return left_out;
      best->take();
      choice.n_variables += static_cast<int>(best->n_functions());
    }
  };
  choice.left_out = take_points(false, options.most, options.left_out);
  take_points(true, std::min(options.most, choice.n_variables + options.of_discrepancy), 0);
  auto points = std::make_shared<InducingPoints>();
  for (const Candidates& latent : latents) points->features.push_back(latent.points());
  choice.points = std::move(points);
  return choice;
}

// t by latent and block; nothing where a block has a fault.
std::optional<MatrixXd> left_out_of_blocks(const Prior& prior, const BlocksOfStates& blocks, const ModelValues& values,
                                           const Workers& workers) {
  const lapack::SingleThread single_thread;
  const InducingLatents latents(prior, values);
  const Index n_latents = std::ssize(prior.latents);
  const auto add = [&](VectorSum& sum, int, const RowBlock& rows, const InducingBlock& block) {
    for (std::size_t f = 0; f < latents.functions().size(); ++f) {
      sum.sum[rows.number * n_latents + static_cast<Index>(latents.functions()[f].latent)] += block.left_out(f);
    }
  };
  std::optional<VectorSum> all =
      sum_over_blocks(latents, blocks, false, workers, nullptr, VectorSum{VectorXd::Zero(n_latents * blocks.n_blocks())}, add);
  if (!all) return std::nullopt;
  return all->sum.reshaped(n_latents, blocks.n_blocks());
}

}  // namespace

InducingChoice choose_inducing_points(const Prior& prior, const std::vector<Observations>& observations,
                                      const ModelValues& values, const InducingOptions& options, const Workers& workers) {
  if (options.most < 1) throw InputError(fmt::format("inducing: there must be 1 point or more, got {}", options.most));
  if (!(options.left_out > 0)) throw InputError(fmt::format("inducing: left_out must be positive, got {}", options.left_out));
  if (options.n_candidates < 1)
    throw InputError(fmt::format("inducing: n_candidates must be 1 or more, got {}", options.n_candidates));
  require_observations(prior, observations);
  require_values(prior, observations, values);
  Some some = even(observations, std::min(n_states(observations), options.n_candidates));
  InducingChoice choice = chosen_among(some, prior, observations, values, options);
  if (n_states(observations) <= options.n_candidates) return choice;
  // What is seldom, as a fast move among hours of slow ones, is not among few states that are taken evenly.
  ModelValues through = values;
  through.inducing = choice.points;
  const BlocksOfStates blocks(prior, observations, through, values.about.get());
  const std::optional<MatrixXd> left_out = left_out_of_blocks(prior, blocks, through, workers);
  if (!left_out) return choice;
  const VectorXd of_block = left_out->colwise().sum();
  constexpr double as_expected = 1.5;
  if (!(of_block.sum() > as_expected * choice.left_out + options.left_out)) return choice;
  std::vector<Index> worst(static_cast<std::size_t>(of_block.size()));
  std::iota(worst.begin(), worst.end(), 0);
  std::stable_sort(worst.begin(), worst.end(), [&](Index a, Index b) { return of_block[a] > of_block[b]; });
  const Index n_more = std::max(1, options.n_candidates / (2 * BlocksOfStates::block_size));
  for (Index k = 0; k < std::min(n_more, of_block.size()); ++k) add(blocks.states(worst[static_cast<std::size_t>(k)]), some);
  return chosen_among(some, prior, observations, values, options);
}

VectorXd left_out_by_points(const Prior& prior, const std::vector<Observations>& observations, const ModelValues& values,
                            const Workers& workers) {
  if (!values.inducing) throw InputError("left_out_by_points: the values have no inducing points");
  require_observations(prior, observations);
  require_values(prior, observations, values);
  const BlocksOfStates blocks(prior, observations, values, values.about.get());
  const std::optional<MatrixXd> left_out = left_out_of_blocks(prior, blocks, values, workers);
  if (!left_out)
    static_cast<void>(require_models(prior, observations, values.parameters, values.about.get()));  // names the state
  return left_out->rowwise().sum();
}

}  // namespace gp2
