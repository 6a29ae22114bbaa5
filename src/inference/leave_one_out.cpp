#include "gp2/inference/leave_one_out.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <set>

#include <fmt/format.h>
#include <Eigen/Cholesky>

#include "base/lapack.hpp"
#include "base/not_a_number.hpp"
#include "gp2/error.hpp"
#include "inference/latent_sums.hpp"
#include "inference/query.hpp"
#include "inference/stretches.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

std::vector<LeaveOneOut> unknown(const std::vector<Observations>& observations) {
  std::vector<LeaveOneOut> out;
  for (const Observations& group : observations) {
    const MatrixXd none = MatrixXd::Constant(group.values().rows(), group.values().cols(), not_a_number);
    out.push_back({none, none});
  }
  return out;
}

// Each value from all others.
std::vector<LeaveOneOut> each_value(const Posterior& posterior, const Reduction& reduction,
                                    const LatentPosterior::Inverse& inverse) {
  const std::vector<Observations>& observations = posterior.observations();
  const ModelValues& values = posterior.values();
  std::vector<LeaveOneOut> out = unknown(observations);
  for (std::size_t s = 0; s < reduction.samples.size(); ++s) {
    const Reduction::Sample& sample = reduction.samples[s];
    const Index rank = sample.R.rows();
    VectorXd alpha(rank);
    for (Index c = 0; c < rank; ++c)
      alpha[c] = inverse.alpha[reduction.offset[static_cast<std::size_t>(c)] + static_cast<Index>(s)];
    // the inverse of the covariance of all whitened values, and what it makes of theirs
    VectorXd alpha_e = sample.Q * alpha + sample.e_out;
    MatrixXd P_e = MatrixXd::Identity(sample.Q.rows(), sample.Q.rows()) +
                   sample.Q * (inverse.blocks[s] - MatrixXd::Identity(rank, rank)) * sample.Q.transpose();
    const auto g = static_cast<std::size_t>(sample.group);
    const VectorXd noise = observations[g].noise_at(values.noise_stddev[g], sample.index);
    if (sample.C.size() > 0) {  // from values whitened by C to those in units of σ
      const MatrixXd to_unit = sample.C.triangularView<Eigen::Lower>().solve(
          MatrixXd(noise.unaryExpr([](double one) { return std::isfinite(one) ? one : 1; }).asDiagonal()));
      alpha_e = to_unit.transpose() * alpha_e;
      P_e = to_unit.transpose() * P_e * to_unit;
    }
    for (Index k = 0; k < noise.size(); ++k) {
      if (!std::isfinite(noise[k])) continue;  // not measured
      const double p = P_e(k, k);
      out[g].mean(k, sample.index) = observations[g].values()(k, sample.index) - noise[k] * alpha_e[k] / p;
      out[g].variance(k, sample.index) = noise[k] * noise[k] * std::max(0.0, 1 / p - 1);
    }
  }
  return out;
}

// The samples of each stretch, which is the same share of the states of every Observations.
std::vector<std::vector<Index>> samples_of_stretches(const Posterior::Implementation& self, const Reduction& reduction,
                                                     int n_stretches) {
  if (n_stretches == 0 || (self.kept && self.kept->stretch_of.empty())) return {};
  std::vector<std::vector<int>> stretch_of;  // by Observations and state
  if (self.kept) {
    stretch_of = self.kept->stretch_of;
  } else {
    for (const Observations& group : self.observations) {
      std::vector<int>& of_states = stretch_of.emplace_back(static_cast<std::size_t>(group.n_data()));
      const auto states = states_of_stretches(group, self.prior.system->layout().t(), n_stretches);
      for (std::size_t k = 0; k < states.size(); ++k) {
        for (const int i : states[k]) of_states[static_cast<std::size_t>(i)] = static_cast<int>(k);
      }
    }
  }
  std::vector<std::vector<Index>> samples(static_cast<std::size_t>(n_stretches));
  for (Index s = 0; s < reduction.n_samples(); ++s) {
    const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(s)];
    const int stretch = stretch_of[static_cast<std::size_t>(sample.group)][static_cast<std::size_t>(sample.index)];
    samples[static_cast<std::size_t>(stretch)].push_back(s);
  }
  return samples;
}

// The values of one sample, where those of its stretch say nothing.
// @param pull        its rows of P_BB⁻¹α̃_B
// @param covariance  its block of P_BB⁻¹
void add_sample(const Posterior& posterior, const Reduction::Sample& sample, const VectorXd& pull, const MatrixXd& covariance,
                std::vector<LeaveOneOut>& out) {
  const auto g = static_cast<std::size_t>(sample.group);
  const Observations& group = posterior.observations()[g];
  const VectorXd noise = group.noise_at(posterior.values().noise_stddev[g], sample.index);
  MatrixXd root = sample.C;  // S^{1/2}
  if (root.size() == 0) root = noise.unaryExpr([](double one) { return std::isfinite(one) ? one : 1; }).asDiagonal();
  const VectorXd error = root * (sample.Q * pull + sample.e_out);
  const MatrixXd rooted = root * sample.Q;
  const MatrixXd latent = rooted * (covariance - MatrixXd::Identity(pull.size(), pull.size())) * rooted.transpose();
  for (Index k = 0; k < noise.size(); ++k) {
    if (!std::isfinite(noise[k])) continue;  // not measured
    const double slip = root.row(k).squaredNorm() - noise[k] * noise[k];
    out[g].mean(k, sample.index) = group.values()(k, sample.index) - error[k];
    out[g].variance(k, sample.index) = std::max(0.0, latent(k, k) + slip);
  }
}

// Each value from those of other stretches; empty where double precision cannot tell.
std::vector<LeaveOneOut> each_stretch(const Posterior& posterior, const Reduction& reduction,
                                      const LatentPosterior::Inverse& inverse, const std::vector<std::vector<Index>>& stretches) {
  if (inverse.without.empty()) return {};
  std::vector<LeaveOneOut> out = unknown(posterior.observations());
  for (std::size_t b = 0; b < stretches.size(); ++b) {
    for (std::size_t k = 0; k < stretches[b].size(); ++k) {
      const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(stretches[b][k])];
      add_sample(posterior, sample, inverse.without[b].pull[k], inverse.without[b].covariance[k], out);
    }
  }
  return out;
}

// log of w_k, but for a constant, of one value
double log_weight(double error, double variance) { return 0.5 * (error * error / variance + std::log(variance)); }

// Of one Observations, from what each component says of it.
// @param weigh  by w_k, each value; else all are equal
LeaveOneOut mixed(const Posterior& posterior, std::size_t group, const std::vector<const LeaveOneOut*>& of, bool weigh) {
  const Observations& observed = posterior.observations()[group];
  const auto n = of.size();
  std::vector<VectorXd> noise_stddev;
  for (std::size_t k = 0; k < n; ++k) {
    noise_stddev.push_back(posterior.component(static_cast<int>(k)).values().noise_stddev[group]);
  }
  LeaveOneOut out = *of.front();
  VectorXd weight(static_cast<Index>(n)), mean(weight.size()), variance(weight.size());
  for (Index i = 0; i < out.mean.cols(); ++i) {
    for (Index r = 0; r < out.mean.rows(); ++r) {
      if (std::isnan(out.mean(r, i))) continue;
      for (std::size_t k = 0; k < n; ++k) {
        const auto at = static_cast<Index>(k);
        mean[at] = of[k]->mean(r, i);
        variance[at] = of[k]->variance(r, i);
        const double noise = observed.noise_at(noise_stddev[k], static_cast<int>(i))[r];
        weight[at] = log_weight(observed.values()(r, i) - mean[at], variance[at] + noise * noise);
      }
      if (!weigh) weight.setZero();
      weight = (weight.array() - weight.maxCoeff()).exp();
      weight /= weight.sum();
      out.mean(r, i) = weight.dot(mean);
      out.variance(r, i) = weight.dot(VectorXd(variance.array() + (mean.array() - out.mean(r, i)).square()));
    }
  }
  return out;
}

// What is predicted where some of the sums over samples that are measured say nothing: with P the inverse of the covariance of the
// measured, α = P(y − mean) and c its covariance with what is predicted, the mean without those in B is less by (Pc)_Bᵀ P_BB⁻¹ α_B,
// the covariance more by (Pc)_Bᵀ P_BB⁻¹ (Pc)_B (theory.md, T36).
class WithoutSums {
 public:
  WithoutSums(const Posterior& posterior, const Posterior::Implementation& self, const Reduction& reduction)
      : posterior_(posterior), self_(self), reduction_(reduction) {
    MatrixXd X = MatrixXd::Identity(self_.latents->size(), self_.latents->size());
    self_.latents->whiten(X);
    P_.noalias() = X.triangularView<Eigen::Lower>().transpose() * X;
    alpha_ = P_ * (reduction.sums->L * reduction.y);
  }

  /// @param sets  of samples, of each of which all is predicted from what is no sum over any of them
  [[nodiscard]] std::vector<LeaveOneOut> leave_out(const std::vector<std::vector<Index>>& sets) const {
    std::vector<LeaveOneOut> out = unknown(posterior_.observations());
    const std::vector<Prediction> all = predictions();
    std::vector<std::vector<Index>> sums_of_row(static_cast<std::size_t>(reduction_.size()));
    const auto& D = reduction_.sums->D;
    for (Index r = 0; r < D.rows(); ++r) {
      for (std::decay_t<decltype(D)>::InnerIterator entry(D, r); entry; ++entry) {
        if (entry.value() != 0) sums_of_row[static_cast<std::size_t>(entry.col())].push_back(r);
      }
    }
    for (const std::vector<Index>& set : sets) {
      std::set<Index> left_out;
      for (const Index row : rows_of_samples(reduction_, set)) {
        const std::vector<Index>& sums = sums_of_row[static_cast<std::size_t>(row)];
        left_out.insert(sums.begin(), sums.end());
      }
      const std::vector<Index> B(left_out.begin(), left_out.end());
      const Eigen::LLT<MatrixXd> factor(P_(B, B));
      const VectorXd pull = factor.solve(alpha_(B));
      for (const Index s : set) {
        const Reduction::Sample& sample = reduction_.samples[static_cast<std::size_t>(s)];
        const auto g = static_cast<std::size_t>(sample.group);
        const Observations& group = posterior_.observations()[g];
        const Index d = group.view().size();
        const MatrixXd Pc = all[g].P_cross.middleCols(d * sample.index, d)(B, Eigen::all), white = factor.matrixL().solve(Pc);
        for (Index k = 0; k < d; ++k) {
          if (std::isnan(group.values()(k, sample.index))) continue;
          out[g].mean(k, sample.index) = all[g].marginal.mean(k, sample.index) - Pc.col(k).dot(pull);
          out[g].variance(k, sample.index) =
              std::max(0.0, all[g].marginal.covariance(k * (d + 1), sample.index) + white.col(k).squaredNorm());
        }
      }
    }
    return out;
  }

 private:
  struct Prediction {
    Posterior::Marginal marginal;
    MatrixXd P_cross;
  };

  // at the states of every Observations
  [[nodiscard]] std::vector<Prediction> predictions() const {
    std::vector<Prediction> out;
    for (const Observations& group : posterior_.observations()) {
      const Query query = make_query(self_, group.view(), group.states());
      const std::vector<MatrixXd> loadings = query.loadings(self_);
      MatrixXd cross(self_.latents->size(), query.n_rows() * query.size());
      LatentSums(*self_.latents).evaluate(query.features, query.needed, &loadings, &cross);
      out.push_back({posterior_.marginal(group.view(), group.states()), P_ * cross});
    }
    return out;
  }

  const Posterior& posterior_;
  const Posterior::Implementation& self_;
  const Reduction& reduction_;
  MatrixXd P_;
  VectorXd alpha_;
};

// under one set of hyperparameters
LeftOut leave_out_of(const Posterior& posterior, const Posterior::Implementation& self, int n_stretches) {
  const Prior& prior = posterior.prior();
  const std::vector<Observations>& observations = posterior.observations();
  const ModelValues& values = posterior.values();
  Reduction reduction;
  reduce(prior, observations, require_models(prior, observations, values.parameters, self.about.get()), values.noise_stddev,
         reduction);
  const std::vector<std::vector<Index>> stretches = samples_of_stretches(self, reduction, n_stretches);
  if (reduction.sums) {
    std::vector<std::vector<Index>> each;
    for (Index s = 0; s < reduction.n_samples(); ++s) each.push_back({s});
    const WithoutSums without(posterior, self, reduction);
    return {without.leave_out(each), n_stretches > 0 ? without.leave_out(stretches) : std::vector<LeaveOneOut>{}};
  }
  const LatentPosterior::Inverse inverse = self.latents->invert(latent_rows(prior, observations, reduction, values), stretches);
  LeftOut out{each_value(posterior, reduction, inverse), {}};
  if (!stretches.empty()) out.stretches = each_stretch(posterior, reduction, inverse, stretches);
  return out;
}

}  // namespace

LeftOut leave_out(const Posterior& posterior, int n_stretches) {
  if (n_stretches < 0) throw InputError(fmt::format("leave_out: n_stretches must not be negative, got {}", n_stretches));
  if (posterior.values().inducing && n_stretches != 0 && n_stretches != LeftOut::n_stretches) {
    throw InputError(
        fmt::format("leave_out: n_stretches must be 0 or {} through inducing points, got {}", LeftOut::n_stretches, n_stretches));
  }
  const lapack::SingleThread single_thread;
  std::vector<LeftOut> of_components;
  for (int k = 0; k < posterior.n_components(); ++k) {
    of_components.push_back(
        leave_out_of(posterior.component(k), *posterior.conditioned()[static_cast<std::size_t>(k)], n_stretches));
  }
  if (of_components.size() == 1) return std::move(of_components.front());
  const auto all = [&](std::vector<LeaveOneOut> LeftOut::*part, bool weigh) {
    std::vector<LeaveOneOut> out;
    for (std::size_t g = 0; g < posterior.observations().size(); ++g) {
      std::vector<const LeaveOneOut*> of_group;
      for (const LeftOut& component : of_components) {
        if ((component.*part).empty()) return std::vector<LeaveOneOut>{};
        of_group.push_back(&(component.*part)[g]);
      }
      out.push_back(mixed(posterior, g, of_group, weigh));
    }
    return out;
  };
  return {all(&LeftOut::values, true), all(&LeftOut::stretches, false)};
}

std::vector<LeaveOneOut> leave_one_out(const Posterior& posterior) { return leave_out(posterior, 0).values; }

}  // namespace gp2
