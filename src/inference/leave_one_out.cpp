#include "gp2/inference/leave_one_out.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <tuple>
#include <utility>

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

// σ where a value is measured, else 1, on the diagonal of a matrix.
MatrixXd diagonal_of(const VectorXd& noise) {
  return noise.unaryExpr([](double one) { return std::isfinite(one) ? one : 1; }).asDiagonal();
}

// As which share w the likelihood of a sample counts; of less than 10⁻¹² nothing would be left beside rounding.
double share_of(const Posterior::Implementation& self, const Reduction::Sample& sample) {
  if (!self.kept || self.kept->share_of.empty()) return 1;
  return std::max(1e-12, self.kept->share_of[static_cast<std::size_t>(sample.group)][static_cast<std::size_t>(sample.index)]);
}

// The samples of each state: an Observations may measure accelerations where another measures forces. What measures the same again
// is another state.
LatentPosterior::SampleSets samples_of_states(const std::vector<Observations>& observations, const Reduction& reduction) {
  using Kind = std::tuple<const OtherSystem*, std::string, std::optional<int>, std::vector<int>>;
  using Place = std::tuple<const OtherSystem*, std::vector<double>, int>;
  std::vector<std::vector<Index>> sample_of;
  for (const Observations& group : observations) sample_of.emplace_back(static_cast<std::size_t>(group.n_data()));
  for (Index s = 0; s < reduction.n_samples(); ++s) {
    const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(s)];
    sample_of[static_cast<std::size_t>(sample.group)][static_cast<std::size_t>(sample.index)] = s;
  }
  LatentPosterior::SampleSets states;
  std::map<Place, std::size_t> known;
  std::map<std::pair<Kind, std::vector<double>>, int> n_before;
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const View& view = observations[g].view();
    const OtherSystem* const system = view.other_system.get();
    const Kind kind{system, view.quantity->word(), view.latent ? std::optional(view.latent->first) : std::nullopt, view.rows};
    for (Index i = 0; i < observations[g].n_data(); ++i) {
      const VectorXd state = observations[g].states().col(i).unaryExpr([](double x) { return std::isnan(x) ? HUGE_VAL : x; });
      std::vector<double> x(state.begin(), state.end());
      const int n = n_before[{kind, x}]++;
      const auto [at, is_new] = known.try_emplace({system, std::move(x), n}, states.size());
      if (is_new) states.emplace_back();
      states[at->second].push_back(sample_of[g][static_cast<std::size_t>(i)]);
    }
  }
  return states;
}

// Each value from all others.
// @param alpha  the sample's rows of α̃
// @param P      its block of P
void add_values(const Posterior& posterior, const Reduction::Sample& sample, const VectorXd& alpha, const MatrixXd& P,
                double share, double s2, std::vector<LeaveOneOut>& out) {
  const MatrixXd identity = MatrixXd::Identity(P.rows(), P.cols());
  // the inverse of the covariance of all whitened values, what it makes of theirs, and all that counts as noise of them
  VectorXd alpha_e = sample.Q * alpha + sample.e_out;
  MatrixXd P_e = MatrixXd::Identity(sample.Q.rows(), sample.Q.rows()) + sample.Q * (P - identity) * sample.Q.transpose();
  VectorXd noise_e = 1 + (s2 - 1) * sample.Q.rowwise().squaredNorm().array();
  const auto g = static_cast<std::size_t>(sample.group);
  const Observations& group = posterior.observations()[g];
  const VectorXd noise = group.noise_at(posterior.values().noise_stddev[g], sample.index);
  if (sample.C.size() > 0) {  // from values whitened by C to those in units of σ
    const MatrixXd to_unit = sample.C.triangularView<Eigen::Lower>().solve(diagonal_of(noise));
    alpha_e = to_unit.transpose() * alpha_e;
    P_e = to_unit.transpose() * P_e * to_unit;
    const MatrixXd C = diagonal_of(noise).diagonal().cwiseInverse().asDiagonal() * sample.C;
    noise_e = C.rowwise().squaredNorm() + (s2 - 1) * (C * sample.Q).rowwise().squaredNorm();
  }
  for (Index k = 0; k < noise.size(); ++k) {
    if (!std::isfinite(noise[k])) continue;  // not measured
    const double p = P_e(k, k);
    out[g].mean(k, sample.index) = group.values()(k, sample.index) - noise[k] * alpha_e[k] / p;
    // the noise that is 1/w times as large is no part of it
    const double of_share = (1 / share - 1) * (1 / p - noise_e[k]);
    out[g].variance(k, sample.index) = noise[k] * noise[k] * std::max(0.0, 1 / p - 1 + of_share);
  }
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
      stretch_of.push_back(stretch_of_states(states_of_stretches(group, self.prior.system->layout().t(), n_stretches)));
    }
  }
  LatentPosterior::SampleSets samples(static_cast<std::size_t>(n_stretches));
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
  const MatrixXd root = sample.C.size() > 0 ? sample.C : diagonal_of(noise);  // S^{1/2}
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

// What is said of the observations under one set of hyperparameters.
struct OfComponent {
  LeftOut left_out;
  std::vector<VectorXd> log_density;  // per Observations: of all that is measured at each state, given all else; 0 of sums
};

// The reduced rows of a state. Samples that count as a share w are known as if the variance of their noise, and of what counts as
// noise, were 1/w times as large: P = D_s⁻¹(I − D_wΨB⁻¹ΨᵀD_w)D_s⁻¹, with √w and s on the diagonals (theory.md, T37 and T38).
struct StateRows {
  VectorXd share, s2;  // w and s² of each
  VectorXd alpha;      // α̃
  MatrixXd P;
};

StateRows rows_of_state(const Posterior::Implementation& self, const Reduction& reduction,
                        const LatentPosterior::Inverse& inverse, const std::vector<Index>& samples, const MatrixXd& block) {
  StateRows of{VectorXd(block.rows()), VectorXd(block.rows()), inverse.alpha(rows_of_samples(reduction, samples)), block};
  Index first = 0;
  for (const Index s : samples) {
    const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(s)];
    of.share.segment(first, sample.R.rows()).setConstant(share_of(self, sample));
    of.s2.segment(first, sample.R.rows()).setConstant(inverse.noise[s]);
    first += sample.R.rows();
  }
  if ((of.share.array() != 1).any()) {
    const VectorXd root = of.share.cwiseSqrt();
    of.P.array() *= (root * root.transpose()).array();
    of.P.diagonal().array() += (1 - of.share.array()) / of.s2.array();
  }
  return of;
}

// The values of a state from those of other states. One value alone is left out as a value is.
void add_row(const Posterior& posterior, const Reduction& reduction, const std::vector<Index>& samples, const StateRows& of,
             OfComponent& out) {
  const auto sample_of = [&](Index s) -> const Reduction::Sample& { return reduction.samples[static_cast<std::size_t>(s)]; };
  const auto group_of = [](const Reduction::Sample& sample) { return static_cast<std::size_t>(sample.group); };
  const Eigen::LLT<MatrixXd> factor(of.P);
  if (factor.info() != Eigen::Success) return;
  const VectorXd root = of.share.cwiseSqrt(), weighed = root.cwiseProduct(of.alpha), pull = factor.solve(weighed);
  const MatrixXd covariance = factor.solve(MatrixXd::Identity(of.P.rows(), of.P.cols()));
  double log_density = factor.matrixLLT().diagonal().array().log().sum() - 0.5 * pull.dot(weighed);
  Index n_measured = 0;
  for (const Index s : samples) {
    const Reduction::Sample& sample = sample_of(s);
    log_density -= sample.constant;
    n_measured += posterior.observations()[group_of(sample)].values().col(sample.index).array().isFinite().count();
  }
  Index first = 0;
  for (const Index s : samples) {
    const Reduction::Sample& sample = sample_of(s);
    const std::size_t g = group_of(sample);
    const Index rank = sample.R.rows();
    out.log_density[g][sample.index] = log_density;
    LeaveOneOut& row = out.left_out.rows[g];
    if (n_measured == 1) {
      row.mean.col(sample.index) = out.left_out.values[g].mean.col(sample.index);
      row.variance.col(sample.index) = out.left_out.values[g].variance.col(sample.index);
    } else if (rank == 0) {
      add_sample(posterior, sample, VectorXd(0), MatrixXd(0, 0), out.left_out.rows);
    } else {
      const double share = of.share[first], s2 = of.s2[first];
      MatrixXd total = covariance.block(first, first, rank, rank) / share;
      total.diagonal().array() += s2 * (1 - 1 / share);
      add_sample(posterior, sample, pull.segment(first, rank) / root[first], total, out.left_out.rows);
    }
    first += rank;
  }
}

// Of each value what all others say, and what those of other states say.
OfComponent leave_out_states(const Posterior& posterior, const Posterior::Implementation& self, const Reduction& reduction,
                             const LatentPosterior::Inverse& inverse, const LatentPosterior::SampleSets& states) {
  const std::vector<Observations>& observations = posterior.observations();
  OfComponent out{{unknown(observations), unknown(observations), {}}, {}};
  for (const Observations& group : observations) out.log_density.emplace_back(VectorXd::Zero(group.n_data()));
  for (std::size_t k = 0; k < states.size(); ++k) {
    const StateRows of = rows_of_state(self, reduction, inverse, states[k], inverse.blocks[k]);
    Index first = 0;
    for (const Index s : states[k]) {
      const Reduction::Sample& sample = reduction.samples[static_cast<std::size_t>(s)];
      const Index rank = sample.R.rows();
      add_values(posterior, sample, of.alpha.segment(first, rank), of.P.block(first, first, rank, rank), share_of(self, sample),
                 inverse.noise[s], out.left_out.values);
      first += rank;
    }
    add_row(posterior, reduction, states[k], of, out);
  }
  return out;
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

// Of one Observations, from what each component says of it.
// @param log_weight  of component k, of the value of row r at state i, but for what all have
LeaveOneOut mixed(const std::vector<const LeaveOneOut*>& of,
                  const std::function<double(std::size_t k, Index r, Index i)>& log_weight) {
  const auto n = of.size();
  LeaveOneOut out = *of.front();
  VectorXd weight(static_cast<Index>(n)), mean(weight.size()), variance(weight.size());
  for (Index i = 0; i < out.mean.cols(); ++i) {
    for (Index r = 0; r < out.mean.rows(); ++r) {
      if (std::isnan(out.mean(r, i))) continue;
      for (std::size_t k = 0; k < n; ++k) {
        const auto at = static_cast<Index>(k);
        mean[at] = of[k]->mean(r, i);
        variance[at] = of[k]->variance(r, i);
        weight[at] = log_weight(k, r, i);
      }
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
      : posterior_(posterior), reduction_(reduction) {
    MatrixXd X = MatrixXd::Identity(self.latents->size(), self.latents->size());
    self.latents->whiten(X);
    P_.noalias() = X.triangularView<Eigen::Lower>().transpose() * X;
    alpha_ = P_ * (reduction.sums->L * reduction.y);
    for (const Observations& group : posterior.observations()) {
      Query query = make_query(self, group.view(), group.states());
      query.linearise_at_mean(self);
      const std::vector<MatrixXd> loadings = query.loadings(self);
      MatrixXd cross(self.latents->size(), query.n_rows() * query.size());
      LatentSums(*self.latents).evaluate(query.features, query.needed, &loadings, &cross);
      all_.push_back({posterior.marginal(group.view(), group.states()), P_ * cross});
    }
  }

  /// @param sets  of samples, of each of which all is predicted from what is no sum over any of them
  [[nodiscard]] std::vector<LeaveOneOut> leave_out(const std::vector<std::vector<Index>>& sets) const {
    std::vector<LeaveOneOut> out = unknown(posterior_.observations());
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
        const MatrixXd Pc = all_[g].P_cross.middleCols(d * sample.index, d)(B, Eigen::all), white = factor.matrixL().solve(Pc);
        for (Index k = 0; k < d; ++k) {
          if (std::isnan(group.values()(k, sample.index))) continue;
          out[g].mean(k, sample.index) = all_[g].marginal.mean(k, sample.index) - Pc.col(k).dot(pull);
          out[g].variance(k, sample.index) =
              std::max(0.0, all_[g].marginal.covariance(k * (d + 1), sample.index) + white.col(k).squaredNorm());
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

  const Posterior& posterior_;
  const Reduction& reduction_;
  std::vector<Prediction> all_;  // at the states of every Observations
  MatrixXd P_;
  VectorXd alpha_;
};

OfComponent leave_out_of(const Posterior& posterior, const Posterior::Implementation& self, int n_stretches) {
  const Prior& prior = posterior.prior();
  const std::vector<Observations>& observations = posterior.observations();
  const ModelValues& values = posterior.values();
  Reduction reduction;
  reduce(prior, observations, require_models(prior, observations, values.parameters, self.about.get()), values.noise_stddev,
         reduction);
  const LatentPosterior::SampleSets states = samples_of_states(observations, reduction),
                                    stretches = samples_of_stretches(self, reduction, n_stretches);
  if (reduction.sums) {  // a value that only sums know goes with all sums over its state
    LatentPosterior::SampleSets each;
    for (Index s = 0; s < reduction.n_samples(); ++s) each.push_back({s});
    const WithoutSums without(posterior, self, reduction);
    std::vector<LeaveOneOut> of_samples = without.leave_out(each), of_stretches;
    std::vector<LeaveOneOut> rows = states.size() == each.size() ? of_samples : without.leave_out(states);
    if (n_stretches > 0) of_stretches = without.leave_out(stretches);
    OfComponent out{{std::move(of_samples), std::move(rows), std::move(of_stretches)}, {}};
    for (const Observations& group : observations) out.log_density.emplace_back(VectorXd::Zero(group.n_data()));
    return out;
  }
  const LatentPosterior::Inverse inverse =
      self.latents->invert(latent_rows(prior, observations, reduction, values), states, stretches);
  OfComponent out = leave_out_states(posterior, self, reduction, inverse, states);
  if (!stretches.empty()) out.left_out.stretches = each_stretch(posterior, reduction, inverse, stretches);
  return out;
}

// Of draws of the hyperparameters, given all data: those count more under which what is left out is less likely.
LeftOut mixture_of(const Posterior& posterior, const std::vector<OfComponent>& components) {
  LeftOut out;
  for (std::size_t g = 0; g < posterior.observations().size(); ++g) {
    const Observations& observed = posterior.observations()[g];
    std::vector<const LeaveOneOut*> values, rows, stretches;
    std::vector<MatrixXd> noise;
    for (std::size_t k = 0; k < components.size(); ++k) {
      const LeftOut& one = components[k].left_out;
      values.push_back(&one.values[g]);
      rows.push_back(&one.rows[g]);
      if (!one.stretches.empty()) stretches.push_back(&one.stretches[g]);
      noise.push_back(observed.noise_of_values(posterior.component(static_cast<int>(k)).values().noise_stddev[g]));
    }
    out.values.push_back(mixed(values, [&](std::size_t k, Index r, Index i) {
      const double error = observed.values()(r, i) - values[k]->mean(r, i);
      const double variance = values[k]->variance(r, i) + noise[k](r, i) * noise[k](r, i);
      return 0.5 * (error * error / variance + std::log(variance));
    }));
    out.rows.push_back(mixed(rows, [&](std::size_t k, Index, Index i) { return -components[k].log_density[g][i]; }));
    if (stretches.size() == components.size()) out.stretches.push_back(mixed(stretches, [](auto...) { return 0.0; }));
  }
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
  std::vector<OfComponent> components;
  for (int k = 0; k < posterior.n_components(); ++k) {
    components.push_back(
        leave_out_of(posterior.component(k), *posterior.conditioned()[static_cast<std::size_t>(k)], n_stretches));
  }
  return components.size() == 1 ? std::move(components.front().left_out) : mixture_of(posterior, components);
}

std::vector<LeaveOneOut> leave_one_out(const Posterior& posterior) { return leave_out(posterior, 0).values; }

}  // namespace gp2
