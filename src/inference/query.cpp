#include "inference/query.hpp"

#include <algorithm>
#include <cmath>

#include "gp2/error.hpp"
#include "inference/latent_sums.hpp"
#include "mechanics/describe_fault.hpp"
#include "mechanics/pivoted_qr.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

void Query::evaluate(const Posterior::Implementation& posterior, const View& viewed, const Ref<const MatrixXd>& states,
                     Index first, Index n) {
  const Prior& there = prior_of(posterior.prior, viewed);
  const VectorXd parameters = parameters_of(viewed, posterior.values.parameters);
  const auto block = states.middleCols(first, n);
  evaluate_mechanics(there, viewed, block, parameters, mechanics);
  // the error counts the state among all, and what is rounding is judged over all
  if (mechanics.fault) static_cast<void>(require_mechanics(there, viewed, states, parameters));
  view = evaluate_view(viewed, mechanics, block);
  prior = evaluate_prior(there, block, parameters, mechanics);
  if (prior.fault) {
    static_cast<void>(require_prior_values(there, states, parameters, require_mechanics(there, viewed, states, parameters)));
  }
  needed = there.is_nonlinear() ? std::nullopt : viewed.latent;
  nonlinear_.reset();
  if (there.is_nonlinear()) {
    const auto nonlinear = std::make_shared<Nonlinear>();
    nonlinear->mechanics = std::move(mechanics);
    nonlinear->motion = std::make_unique<NonlinearMotion>(there, block, parameters, nonlinear->mechanics, prior);
    nonlinear->view = view;
    nonlinear->of = viewed;
    nonlinear->first = first;
    nonlinear_ = nonlinear;
  }
  keep_viewed(viewed, prior);
  features.resize(there.latents.size());
  for (std::size_t a = 0; a < features.size(); ++a) features[a] = features_of_block(there, a, states, first, n);
}

MatrixXd features_of_block(const Prior& prior, std::size_t a, const Ref<const MatrixXd>& states, Index first, Index n) {
  try {
    return evaluate_features(prior, a, states.middleCols(first, n));
  } catch (const InputError&) {
    static_cast<void>(evaluate_features(prior, a, states));
    throw;
  }
}

void Query::linearise(const Posterior::Implementation& posterior, const std::vector<MatrixXd>& f) {
  if (!nonlinear_) return;
  Linearisation::OfGroup at;
  for (std::size_t a = 0; a < f.size(); ++a) at.signals.push_back(posterior.C[a] * f[a]);
  std::optional<MechanicsBatch::Fault> fault = nonlinear_->motion->solve(at);
  if (!fault) {
    view = nonlinear_->view;
    nonlinear_->motion->linearise(nonlinear_->of, at, view, prior);
    fault = prior.fault;
  }
  if (!fault) return;
  throw InputError(internal::describe_fault(*prior_of(posterior.prior, nonlinear_->of).system, nonlinear_->motion->states(),
                                            *fault, nonlinear_->first));
}

void Query::linearise_at_mean(const Posterior::Implementation& posterior) {
  if (!nonlinear_) return;
  LatentSums sums(*posterior.latents);
  sums.evaluate(features, needed);
  linearise(posterior, sums.mean());
}

void Query::view_of(const Posterior::Implementation& posterior, const std::vector<MatrixXd>& f, Ref<MatrixXd> values) const {
  VectorXd a_bar, signal;
  for (int i = 0; i < static_cast<int>(size()); ++i) {
    a_bar = prior.mean.col(i);
    for (std::size_t a = 0; a < f.size(); ++a) {
      if (!needs(a)) continue;
      signal.noalias() = posterior.C[a].lazyProduct(f[a].col(i));
      a_bar.noalias() += prior.E(a, i).lazyProduct(signal);
    }
    values.col(i).noalias() = view.G(i).lazyProduct(a_bar);
    values.col(i) += view.offset.col(i);
  }
}

std::vector<MatrixXd> Query::loadings(const Posterior::Implementation& posterior) const {
  std::vector<MatrixXd> loadings;
  for (std::size_t a = 0; a < posterior.C.size(); ++a) {
    const MatrixXd& C = posterior.C[a];
    MatrixXd& of_latent = loadings.emplace_back(MatrixXd::Zero(C.cols() * n_rows(), size()));
    for (int i = 0; needs(a) && i < static_cast<int>(size()); ++i) {
      Map<MatrixXd>(of_latent.col(i).data(), C.cols(), n_rows()) = C.transpose() * (view.G(i) * prior.E(a, i)).transpose();
    }
  }
  return loadings;
}

namespace {

struct IndependentColumns {
  std::vector<int> columns;  // rising
  MatrixXd U;                // all are these times Uᵀ  (d × r)
};

// Those of a matrix of d columns, each in a unit of its own, that the others depend on.
IndependentColumns independent_columns(MatrixXd X) {
  constexpr double rounding = 1e-12;  // of columns of unit norm
  constexpr double smallest = 1e-150;
  const Index d = X.cols();
  VectorXd norms(d), reflection(std::min(X.rows(), d));
  for (Index k = 0; k < d; ++k) norms[k] = X.col(k).stableNorm();
  // a column whose square vanishes, alone or beside that of the largest, has no variance, and no other is a multiple of it
  const double largest = norms.lpNorm<Eigen::Infinity>();
  const double least = std::isfinite(largest) ? smallest * std::max(1.0, largest) : 0;
  for (Index k = 0; k < d; ++k) {
    if (norms[k] <= least) {
      X.col(k).setZero();
    } else {
      X.col(k) /= norms[k];
    }
  }
  Eigen::VectorXi order(d);
  const Index r = internal::pivoted_qr(X, reflection, order, rounding);
  IndependentColumns out{{order.begin(), order.begin() + r}, MatrixXd::Zero(d, r)};
  std::ranges::sort(out.columns);
  const auto place = [&](int column) { return std::ranges::lower_bound(out.columns, column) - out.columns.begin(); };
  for (Index j = 0; j < r; ++j) out.U(order[j], place(order[j])) = 1;
  for (Index k = r; k < d; ++k) {
    const VectorXd of_chosen = X.topLeftCorner(r, r).triangularView<Eigen::Upper>().solve(X.col(k).head(r));
    for (Index j = 0; j < r; ++j) out.U(order[k], place(order[j])) = of_chosen[j] * norms[order[k]] / norms[order[j]];
  }
  return out;
}

}  // namespace

Query::Fewer Query::fewer_loadings(const Posterior::Implementation& posterior) const {
  const std::vector<MatrixXd> all = loadings(posterior);
  const Index d = n_rows(), n = size();
  if (d == 0) return {0, MatrixXd(0, n), all};
  Index n_stacked = 0;
  for (const MatrixXd& C : posterior.C) n_stacked += C.cols();
  std::vector<IndependentColumns> of_state;
  Fewer out;
  for (Index i = 0; i < n; ++i) {
    Index first = 0;
    MatrixXd stacked(n_stacked, d);
    for (const MatrixXd& of_latent : all) {
      const Map<const MatrixXd> loading(of_latent.col(i).data(), of_latent.rows() / d, d);
      stacked.middleRows(first, loading.rows()) = loading;
      first += loading.rows();
    }
    of_state.push_back(independent_columns(std::move(stacked)));
    out.n_rows = std::max(out.n_rows, of_state.back().U.cols());
  }
  const Index r = out.n_rows;
  out.U = MatrixXd::Zero(d * r, n);
  for (const MatrixXd& of_latent : all) out.loadings.emplace_back(MatrixXd::Zero(of_latent.rows() / d * r, n));
  for (Index i = 0; i < n; ++i) {
    const auto& [chosen, U] = of_state[static_cast<std::size_t>(i)];
    out.U.col(i).head(U.size()) = U.reshaped();
    for (std::size_t a = 0; a < all.size(); ++a) {
      const Map<const MatrixXd> loading(all[a].col(i).data(), all[a].rows() / d, d);
      out.loadings[a].col(i).head(loading.rows() * U.cols()) = loading(Eigen::all, chosen).reshaped();
    }
  }
  return out;
}

void require_query(const Posterior::Implementation& posterior, const View& view, const Ref<const MatrixXd>& states) {
  require_view(posterior.prior, view);
  prior_of(posterior.prior, view).system->require_states(states);
}

void require_finite(const System& system, const Ref<const MatrixXd>& states, const Ref<const MatrixXd>& computed, Index first) {
  for (int i = 0; i < static_cast<int>(computed.cols()); ++i) {
    if (computed.col(i).allFinite()) continue;
    MechanicsBatch::Fault fault{i, {}};
    fault.text = "the prediction overflows double precision (correct the state, or leave it out)";
    throw InputError(internal::describe_fault(system, states, fault, first));
  }
}

Query make_query(const Posterior::Implementation& posterior, const View& view, const Ref<const MatrixXd>& states) {
  require_query(posterior, view, states);
  Query query;
  query.evaluate(posterior, view, states, 0, states.cols());
  return query;
}

}  // namespace gp2
