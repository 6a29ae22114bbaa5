#include "inference/query.hpp"

#include <algorithm>

#include "gp2/error.hpp"
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
  prior = require_prior_values(there, block, parameters, mechanics);
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

std::vector<MatrixXd> Query::loadings(const Posterior::Implementation& posterior) const { return loadings(posterior, view.matrix); }

std::vector<MatrixXd> Query::loadings(const Posterior::Implementation& posterior, const MatrixXd& B) const {
  const Index nq = prior.mean.rows(), n_rows = B.rows() / nq;
  std::vector<MatrixXd> loadings;
  for (std::size_t a = 0; a < posterior.C.size(); ++a) {
    const MatrixXd& C = posterior.C[a];
    MatrixXd& of_latent = loadings.emplace_back(MatrixXd::Zero(C.cols() * n_rows, size()));
    for (int i = 0; needs(a) && i < static_cast<int>(size()); ++i) {
      const Map<const MatrixXd> of_state(B.col(i).data(), n_rows, nq);
      Map<MatrixXd>(of_latent.col(i).data(), C.cols(), n_rows) = C.transpose() * (of_state * prior.E(a, i)).transpose();
    }
  }
  return loadings;
}

Query::Fewer Query::fewer_loadings(const Posterior::Implementation& posterior) const {
  constexpr double rounding = 1e-12;  // of rows of unit norm: none that matters is lost, whatever its unit
  const Index d = n_rows(), nq = prior.mean.rows(), most = std::min(d, nq);
  Fewer out;
  MatrixXd bases = MatrixXd::Zero(nq * most, size());  // Wᵀ, zero beyond the rank
  MatrixXd rows(nq, d);
  VectorXd reflection(most);
  Eigen::VectorXi order(d);
  for (int i = 0; i < static_cast<int>(size()); ++i) {
    rows = view.G(i).transpose();
    for (auto row : rows.colwise()) {
      if (const double norm = row.stableNorm(); norm > 0) row /= norm;
    }
    const Index rank = internal::pivoted_qr(rows, reflection, order, rounding);
    auto basis = Map<MatrixXd>(bases.col(i).data(), nq, most).leftCols(rank);
    basis.setIdentity();
    internal::apply_Q(rows, reflection, rank, basis);
    out.n_rows = std::max(out.n_rows, rank);
  }
  const Index r = out.n_rows;
  out.U.resize(d * r, size());
  MatrixXd W(r * nq, size());
  for (int i = 0; i < static_cast<int>(size()); ++i) {
    const auto basis = Map<const MatrixXd>(bases.col(i).data(), nq, most).leftCols(r);
    Map<MatrixXd>(out.U.col(i).data(), d, r) = view.G(i).lazyProduct(basis);
    Map<MatrixXd>(W.col(i).data(), r, nq) = basis.transpose();
  }
  out.loadings = loadings(posterior, W);
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
