#include "inference/predictor_component.hpp"

#include <algorithm>
#include <utility>

#include "base/not_a_number.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Status = Predictor::Status;

namespace {

// dA in each entry of the state
class StateChange final : public ConstraintChange {
 public:
  explicit StateChange(const StateEvaluator& at) : at_(at) {}
  void add_product(const Ref<const MatrixXd>& x, Ref<MatrixXd> out) const override {
    for_each([&](int i, int j, int k, double value) { out(i, k) += value * x(j, x.cols() == 1 ? 0 : k); });
  }
  void subtract_transposed_product(const Ref<const MatrixXd>& y, Ref<MatrixXd> out) const override {
    for_each([&](int i, int j, int k, double value) { out(j, k) -= value * y(i, y.cols() == 1 ? 0 : k); });
  }

 private:
  template <typename Work>
  void for_each(const Work& work) const {
    const auto values = at_.derivative_values();
    for (std::size_t e = 0; e < at_.derivatives().size(); ++e) {
      const auto [quantity, i, j, k] = at_.derivatives()[e];
      if (quantity == StateEvaluator::Quantity::constraint_matrix) work(i, j, k, values[static_cast<Index>(e)]);
    }
  }
  const StateEvaluator& at_;
};

}  // namespace

Predictor::Implementation::Implementation(const Posterior::Implementation& posterior, View viewed, Options given,
                                          const View* part)
    : prior(prior_of(posterior.prior, viewed)),
      parameters(parameters_of(viewed, posterior.values.parameters)),
      view(std::move(viewed)),
      options(given),
      time_step(view.required_time_step()),
      parts(view.quantity->parts()),
      is_constrained(parts.constrained_acceleration || parts.constraint_force) {
  for (int r = 0; r < view.size(); ++r) added_entries.push_back(view.added_entry(prior.system->layout(), r));
  needs_acceleration = what_needs_acceleration(prior, view).has_value();
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    reads_multipliers = reads_multipliers || (view.has_latent(a) && prior.latents[a].reads_multipliers());
  }
  if (reads_multipliers) {
    parts.constrained_acceleration = parts.constraint_force = parts.unconstrained_acceleration = true;
    is_constrained = true;
  }
  if (reads_multipliers && !view.has_mean()) {
    View of_whole = View::multipliers(*prior.system);
    of_whole.other_system = view.other_system;
    multipliers = std::make_shared<const Implementation>(
        posterior, of_whole,
        Options{.stddev = options.stddev && view.latent, .jacobian = options.jacobian, .storage = options.storage}, &view);
  }
  n_covariance_rows = part != nullptr ? part->size() : view.size();
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    if (!view.has_latent(a)) continue;
    terms.push_back({a, posterior.latents->latents()[a].kernel, posterior.C[a], prior.latents[a].is_potential});
    if (terms.back().is_potential) terms.back().variance = GradientColumns(terms.back().kernel).variance();
    has_forced_latent = has_forced_latent || prior.latents[a].base == Latent::Base::force;
  }
  has_force = has_mean_force() || has_forced_latent;
  const bool stores_factor = options.stddev && !depends_on_others();
  if (options.storage == Storage::single_precision) {
    in_single.store(*posterior.latents, terms, stores_factor);
  } else {
    in_double.store(*posterior.latents, terms, stores_factor);
  }
}

Predictor::Workspace::Implementation::Implementation(std::shared_ptr<const Predictor::Implementation> owner)
    : predictor(std::move(owner)) {
  const Predictor::Implementation& self = *predictor;
  values = self.prior.system->make_evaluator(self.parameters, false);
  if (self.multipliers) multipliers = std::make_unique<Implementation>(self.multipliers);
  if (self.options.jacobian) values_and_derivatives = self.prior.system->make_evaluator(self.parameters, true);
  reserve_mechanics();
  for (const PredictorTerm& term : self.terms) reserve_term(term);
  coordinates.setZero(self.distance.n_coordinates());
  self.with_data(*this, [&](const auto& data, auto& memory) {
    memory = data.make_memory(self.terms, self.n_covariance_rows, self.options.stddev && !self.depends_on_others());
  });
}

void Predictor::Workspace::Implementation::reserve_mechanics() {
  const System& system = *predictor->prior.system;
  const Index nq = system.nq(), nc = system.nc(), n_state = system.layout().size(), d = predictor->n_covariance_rows;
  const Index n_rows = predictor->n_quantity_rows();
  a_bar.setZero(nq);
  force = a_of_force = a = gap = of_constraint = applied = a_bar;
  lambda.setZero(nc);
  L.setZero(nq, nc);
  d_a_bar.setZero(nq, n_state);
  d_of_rest = d_force = d_forced = d_a = d_mass_a_bar = d_of_constraint = d_applied = d_a_bar;
  d_rows.setZero(nc, n_state);
  value.setZero(n_rows, 1);
  d_value.setZero(n_rows, n_state);
  G.setZero(n_rows, nq);
  Gt.setZero(nq, d);
  M_inverse_Gt = Gt;
  covariance.setZero(d, d);
  mean.setZero(predictor->view.size());
  jacobian.setZero(predictor->view.size(), n_state);
  // rows that are all the same, so that the memory for redundant ones is there too
  const MatrixXd rows = MatrixXd::Ones(nc, nq);
  projection.compute(MatrixXd::Identity(nq, nq), rows, VectorXd::Zero(nc));
  projection.constrain(a_bar, a, refinement);
  affine_motion.evaluate(projection, MatrixXd::Identity(nq, nq), predictor->parts);
  const StateMechanics at = mechanics({rows.data(), nc, nq});
  predictor->view.quantity->evaluate(at, motion(), value, quantity);
  predictor->view.quantity->differentiate(at, motion(), dmotion(), StateChange(*values), d_value, quantity);
  if (!predictor->reads_multipliers) return;
  load.emplace(predictor->prior, predictor->parameters);
  without_load = a_bar;
  slope.setZero(nq, nc);
  G_lambda.setZero(nc, nq);
  d_lambda.setZero(nc, 1);
  GK.setZero(n_rows, nc);
  d_multipliers.setZero(nc, n_state);
  Quantity::multipliers->evaluate(at, affine_motion.linear(), G_lambda, quantity);
  Quantity::multipliers->differentiate(at, motion(), dmotion(), StateChange(*values), d_multipliers, quantity);
  solver.solve(G_lambda, d_lambda.col(0), [](const VectorXd&, VectorXd& free, MatrixXd& change) {
    free.setZero();
    change.setZero();
  });
  response.compute(slope, G_lambda);
}

void Predictor::Workspace::Implementation::reserve_term(const PredictorTerm& term) {
  const Latent& latent = predictor->latent(term);
  const Index D = latent.n_features(), p = term.size(), nq = a_bar.size();
  AtState& at = terms.emplace_back();
  at.of_features = latent.features->make_evaluator(VectorXd());
  at.features.setZero(D);
  at.point.setZero(term.kernel.n_scaled());
  at.signal.setZero(p);
  at.dsignal.setZero(D, p);
  at.E_dsignal.setZero(nq, D);
  loadings.emplace_back(MatrixXd::Zero(term.n_functions(), predictor->n_covariance_rows));
  at.dfeatures.setZero(static_cast<Index>(at.of_features->entries().size()));
  if (!latent.directions) return;
  at.directions.setZero(nq * p);
  if (latent.reads_multipliers()) {
    at.under_load = &*std::ranges::find(load->latents(), term.latent, &MotionUnderLoad::OfLatent::latent);
    return;
  }
  at.of_directions = latent.directions->make_evaluator(predictor->parameters);
  at.ddirections.setZero(static_cast<Index>(at.of_directions->entries().size()));
  if (latent.base != Latent::Base::admissible) return;
  at.of_directions->evaluate(VectorXd::Zero(predictor->prior.system->layout().size()), at.directions);
  at.admissible.emplace().compute(MatrixXd::Ones(predictor->prior.system->nc(), nq), at.directions.reshaped(nq, nq));
  at.admissible->set_functions(at.signal);
}

// ---------------------------------------------------------------- mean

Status Predictor::Implementation::evaluate_mechanics(StateEvaluator& at, Workspace::Implementation& w) const {
  if (!is_finite(at.M()) || !is_finite(at.A()) || !is_finite(at.b())) return Status::not_finite;
  w.projection.compute(at.M(), at.A(), at.b(), prior.system->largest_rank_of(at.A()));
  switch (w.projection.mass_kind()) {
    case UdwadiaKalaba::Mass::positive_definite:
      break;
    case UdwadiaKalaba::Mass::singular:
      if (needs_acceleration) return Status::no_unconstrained_acceleration;
      break;
    case UdwadiaKalaba::Mass::undetermined:
      return Status::motion_undetermined;
    case UdwadiaKalaba::Mass::indefinite:
      return Status::mass_not_positive_definite;
  }
  return w.projection.is_contradictory(at.F()) ? Status::contradicting_constraints : Status::ok;
}

namespace {

// B v added to sum, B (nq × p) or the identity
void add_product(const VectorXd& B, const VectorXd& v, VectorXd& sum) {
  const Index nq = sum.size();
  if (B.size() == 0) {
    for (Index i = 0; i < nq; ++i) sum[i] += v[i];
    return;
  }
  for (Index l = 0; l < v.size(); ++l) {
    for (Index i = 0; i < nq; ++i) sum[i] += B[l * nq + i] * v[l];
  }
}

}  // namespace

Status Predictor::Implementation::evaluate_prior(const Ref<const VectorXd>& state, const StateEvaluator& at,
                                                 Workspace::Implementation& w) const {
  w.a_bar.setZero();
  if (view.has_mean() && prior.mean == Prior::Mean::constant) w.a_bar = prior.constant_mean;
  w.force.setZero();
  if (has_mean_force()) w.force = at.F();
  bool all_features = true;  // are finite; without observations ā does not show it
  with_data(w, [&](const auto& data, auto& memory) {
    for (std::size_t a = 0; a < terms.size(); ++a) {
      const PredictorTerm& term = terms[a];
      const Latent& of = latent(term);
      Workspace::Implementation::AtState& here = w.terms[a];
      here.of_features->evaluate(state, here.features);
      all_features = all_features && is_finite(here.features);
      term.kernel.scale(here.features, here.point);
      data.evaluate_signal(term, a, here.point, memory, here.signal);
      if (of.is_positive) here.signal = here.signal.array().exp();
      if (here.under_load != nullptr) continue;
      if (here.of_directions) here.of_directions->evaluate(state, here.directions);
      if (here.admissible) {
        const Map<const MatrixXd> B(here.directions.data(), w.a_bar.size(), w.a_bar.size());
        here.directions = here.admissible->compute(at.A(), B, prior.system->largest_rank_of(at.A())).reshaped();
      }
      add_product(here.directions, here.signal, of.base == Latent::Base::force ? w.force : w.a_bar);
    }
  });
  if (reads_multipliers) {
    if (const Status status = evaluate_load(state, at, w); status != Status::ok) return status;
  }
  w.a_of_force = w.force;
  if (has_force) {
    w.projection.solve_mass_in_place(w.a_of_force);
    w.a_bar += w.a_of_force;
  }
  return is_finite(w.a_bar) && all_features ? Status::ok : Status::not_finite;
}

Status Predictor::Implementation::evaluate_load(const Ref<const VectorXd>& state, const StateEvaluator& at,
                                                Workspace::Implementation& w) const {
  w.affine_motion.evaluate(w.projection, at.M(), parts);
  Quantity::multipliers->evaluate(w.mechanics(at.A()), w.affine_motion.linear(), w.G_lambda, w.quantity);
  Quantity::multipliers->evaluate(w.mechanics(at.A()), w.affine_motion.constant(), w.d_lambda, w.quantity);
  w.without_load = w.force;
  if (has_force) w.projection.solve_mass_in_place(w.without_load);
  w.without_load += w.a_bar;
  for (Workspace::Implementation::AtState& here : w.terms) {
    if (here.under_load != nullptr) here.under_load->c = here.signal;
  }
  w.load->move_to(state, w.projection, w.without_load);
  const auto motion = [&](const VectorXd& lambda, VectorXd& a_bar, MatrixXd& slope) { w.load->evaluate(lambda, a_bar, slope); };
  if (multipliers) {
    Workspace::Implementation& whole = *w.multipliers;
    Ref<VectorXd> lambda = whole.mean;
    const Status status = multipliers->write_mean(state, *whole.values, whole, lambda);
    if (status != Status::ok) return status;
  } else if (!w.solver.solve(w.G_lambda, w.d_lambda.col(0), motion)) {
    return Status::not_finite;
  }
  motion(multipliers ? w.multipliers->mean : w.solver.lambda(), w.a_of_force, w.slope);
  for (Workspace::Implementation::AtState& here : w.terms) {
    if (here.under_load == nullptr) continue;
    here.directions = here.under_load->B;
    add_product(here.directions, here.signal, here.under_load->acts_on_forces ? w.force : w.a_bar);
  }
  return Status::ok;
}

void Predictor::Implementation::write_G(const StateEvaluator& at, Workspace::Implementation& w) const {
  w.affine_motion.evaluate(w.projection, at.M(), parts);
  view.quantity->evaluate(w.mechanics(at.A()), w.affine_motion.linear(), w.G, w.quantity);
}

void Predictor::Implementation::add_response(Workspace::Implementation& w) const {
  w.response.compute(w.slope, w.G_lambda);
  w.GK.noalias() = w.G.lazyProduct(w.response.K());
  w.G.noalias() += w.GK.lazyProduct(w.G_lambda);
}

void Predictor::Implementation::evaluate_motion(const StateEvaluator& at, Workspace::Implementation& w) const {
  if (parts.applied_force) {
    w.applied = w.force;
    w.applied.noalias() += at.M() * w.a_bar;
    w.applied.noalias() -= at.M() * w.a_of_force;
  }
  if (!is_constrained) return;
  if (view.has_mean()) {
    w.projection.constrain(w.a_bar, w.a, w.refinement);
  } else {
    w.a.noalias() = w.projection.T() * w.a_bar;
  }
  if (!parts.constraint_force && !options.jacobian) return;
  // where M is singular ā has nothing but a_of_force, of M', and so drops out
  w.gap = w.a - w.a_bar;
  w.of_constraint = -w.force;
  w.of_constraint.noalias() += at.M() * w.gap;
  w.of_constraint.noalias() += at.M() * w.a_of_force;
}

Status Predictor::Implementation::write_mean(const Ref<const VectorXd>& state, StateEvaluator& at, Workspace::Implementation& w,
                                             Ref<VectorXd>& mean) const {
  at.evaluate(state);
  Status status = evaluate_mechanics(at, w);
  if (status == Status::ok) status = evaluate_prior(state, at, w);
  if (status == Status::ok) {
    evaluate_motion(at, w);
    view.quantity->evaluate(w.mechanics(at.A()), w.motion(), w.value, w.quantity);
    for (std::size_t r = 0; r < view.rows.size(); ++r) {
      double& entry = mean[static_cast<Index>(r)];
      entry = w.value(view.rows[r], 0);
      if (added_entries[r]) entry += state[*added_entries[r]];
    }
    if (!is_finite(mean)) status = Status::not_finite;
  }
  if (status != Status::ok) mean.setConstant(not_a_number);
  return status;
}

// ---------------------------------------------------------------- covariance

// ℓ = Cᵀ Bᵀ Gᵀ, or with M⁻¹, and the prior's covariance
void Predictor::Implementation::write_loadings(const View& of, const Workspace::Implementation& viewed,
                                               Workspace::Implementation& w) const {
  const Index nq = w.Gt.rows();
  w.covariance.setZero();
  for (std::size_t a = 0; a < terms.size(); ++a) {
    const PredictorTerm& term = terms[a];
    const VectorXd& B = w.terms[a].directions;
    const Workspace::Implementation& from = of.has_latent(term.latent) ? viewed : w;
    const MatrixXd& Gt = latent(term).base == Latent::Base::force ? from.M_inverse_Gt : from.Gt;
    const double k = term.is_potential ? 0 : term.kernel.variance(w.terms[a].point);
    // (Bᵀ Gᵀ)_lr
    const auto along = [&](Index l, Index r) {
      if (B.size() == 0) return Gt(l, r);
      double sum = 0;
      for (Index i = 0; i < nq; ++i) sum += B[l * nq + i] * Gt(i, r);
      return sum;
    };
    MatrixXd& loading = w.loadings[a];
    loading.setZero();
    for (Index r = 0; r < loading.cols(); ++r) {
      for (Index l = 0; l < term.size(); ++l) {
        const double value = along(l, r) * (latent(term).is_positive ? w.terms[a].signal[l] : 1);
        for (Index f = 0; f < term.n_functions(); ++f) loading(f, r) += term.C(l, f) * value;
      }
      for (Index s = 0; s <= r; ++s) {
        if (term.is_potential) {
          for (Index f = 0; f < term.n_functions(); ++f) w.covariance(r, s) += term.variance[f] * loading(f, r) * loading(f, s);
        } else {
          w.covariance(r, s) += k * loading.col(r).dot(loading.col(s));
        }
      }
    }
  }
}

void Predictor::Implementation::write_covariance(const StateEvaluator& at, Workspace::Implementation& w) const {
  write_G(at, w);
  if (reads_multipliers && !view.latent) add_response(w);
  for (int r = 0; r < view.size(); ++r) w.Gt.col(r) = w.G.row(view.rows[static_cast<std::size_t>(r)]);
  const Implementation& whole = depends_on_others() ? *multipliers : *this;
  Workspace::Implementation& all = depends_on_others() ? *w.multipliers : w;
  if (depends_on_others()) {
    // G J_S D⁻¹G_λ of every latent
    w.response.compute(all.slope, all.G_lambda, w.slope);
    w.GK.noalias() = w.G.lazyProduct(w.response.K());
    for (int r = 0; r < view.size(); ++r) {
      all.Gt.col(r).noalias() =
          all.G_lambda.transpose().lazyProduct(w.GK.row(view.rows[static_cast<std::size_t>(r)]).transpose());
    }
    w.Gt += all.Gt;
  }
  const auto solve_mass = [&](Workspace::Implementation& one) {
    one.M_inverse_Gt = one.Gt;
    w.projection.solve_mass_in_place(one.M_inverse_Gt);
  };
  if (whole.has_forced_latent) solve_mass(w);
  if (whole.has_forced_latent && depends_on_others()) solve_mass(all);
  whole.write_loadings(view, w, all);
  whole.with_data(
      all, [&](const auto& data, auto& memory) { data.subtract_explained(whole.terms, all.loadings, memory, all.covariance); });
  if (depends_on_others()) w.covariance = all.covariance;
}

// ---------------------------------------------------------------- Jacobian

// With a = T ā + L b, b = 0 for one latent alone:
//
//     dā = P + M⁻¹(R − dM a_of_force),    P, R: the changes of what stands without and with M⁻¹ in ā
//     da = T (P + M⁻¹(R + dM (ā − a − a_of_force) + dAᵀλ)) + L (db − dA a)
//
// Where M is singular P = 0 and ā = a_of_force: the second line is then M ddq = F̄ + Aᵀλ, differentiated, with T M'⁻¹ and L of M'.
// Derivatives are few: each entry of dM, dA, db, dF is added where it belongs.

// what the latents add to P and R
void Predictor::Implementation::differentiate_prior(const Ref<const VectorXd>& state, const StateEvaluator& at,
                                                    Workspace::Implementation& w) const {
  const Index nq = w.a_bar.size();
  w.d_of_rest.setZero();
  w.d_force.setZero();
  for (std::size_t a = 0; a < terms.size(); ++a) {
    const PredictorTerm& term = terms[a];
    const Latent& of = latent(term);
    Workspace::Implementation::AtState& here = w.terms[a];
    with_data(w, [&](const auto& data, auto& memory) { data.differentiate_signal(term, a, here.point, memory, here.dsignal); });
    if (of.is_positive) here.dsignal *= here.signal.asDiagonal();
    MatrixXd& sum = of.base == Latent::Base::force ? w.d_force : w.d_of_rest;
    // B d(C g)/dφ, then along the features
    if (here.directions.size() == 0) {
      here.E_dsignal = here.dsignal.transpose();
    } else {
      here.E_dsignal.noalias() =
          Map<const MatrixXd>(here.directions.data(), nq, term.size()).lazyProduct(here.dsignal.transpose());
    }
    here.of_features->differentiate(state, here.dfeatures);
    for (std::size_t e = 0; e < here.of_features->entries().size(); ++e) {
      const StateDerivatives::Entry& entry = here.of_features->entries()[e];
      const double value = here.dfeatures[static_cast<Index>(e)];
      for (Index i = 0; i < nq; ++i) sum(i, entry.state_index) += here.E_dsignal(i, entry.output) * value;
    }
    // dE C g
    if (here.admissible) {
      here.admissible->set_functions(here.signal);
      for (std::size_t e = 0; e < at.derivatives().size(); ++e) {
        const auto [quantity, i, j, k] = at.derivatives()[e];
        if (quantity != StateEvaluator::Quantity::constraint_matrix) continue;
        here.admissible->add_change(i, j, at.derivative_values()[static_cast<Index>(e)], sum.col(k));
      }
    }
    // dB C g, at held λ where it is read; T dB C g of what the constraint leaves
    const auto add = [&](const StateFunction::Evaluator& directions, const VectorXd& dB) {
      for (std::size_t e = 0; e < directions.entries().size(); ++e) {
        const StateDerivatives::Entry& entry = directions.entries()[e];
        if (entry.state_index >= sum.cols()) break;  // in λ, which follows the state
        const double change = dB[static_cast<Index>(e)] * here.signal[entry.output / nq];
        if (here.admissible) {
          sum.col(entry.state_index) += change * here.admissible->projector().col(entry.output % nq);
        } else {
          sum(entry.output % nq, entry.state_index) += change;
        }
      }
    };
    if (here.under_load != nullptr) add(*here.under_load->directions, here.under_load->dB);
    if (!here.of_directions) continue;
    here.of_directions->differentiate(state, here.ddirections);
    add(*here.of_directions, here.ddirections);
  }
}

// R − dM a_of_force, dAᵀλ, dM (a − ā), dM ā, db − dA a
void Predictor::Implementation::differentiate_mechanics(const StateEvaluator& at, Workspace::Implementation& w) const {
  if (is_constrained) {
    w.projection.write_L(w.L);
    w.lambda.noalias() = w.L.transpose() * w.of_constraint;
  }
  w.d_forced.setZero();
  w.d_rows.setZero();
  w.d_of_constraint.setZero();
  w.d_applied.setZero();
  const auto values = at.derivative_values();
  for (std::size_t e = 0; e < at.derivatives().size(); ++e) {
    const auto [quantity, i, j, k] = at.derivatives()[e];
    const double value = values[static_cast<Index>(e)];
    switch (quantity) {
      case StateEvaluator::Quantity::mass:
        w.d_force(i, k) -= value * w.a_of_force[j];
        w.d_of_constraint(i, k) += value * w.gap[j];
        w.d_applied(i, k) += value * w.a_bar[j];
        break;
      case StateEvaluator::Quantity::constraint_matrix:
        w.d_forced(j, k) += value * w.lambda[i];
        w.d_rows(i, k) -= value * w.a[j];
        break;
      case StateEvaluator::Quantity::constraint_vector:
        if (view.has_mean()) w.d_rows(i, k) += value;
        break;
      case StateEvaluator::Quantity::force:
        if (has_mean_force()) w.d_force(i, k) += value;
        break;
    }
  }
}

// dā, dF̄ = dM ā + M dā, da and d(Aᵀλ) = dM (a − ā) + M da − M dā, those that the view needs
void Predictor::Implementation::differentiate_motion(const StateEvaluator& at, Workspace::Implementation& w) const {
  if (parts.unconstrained_acceleration) {
    w.d_a_bar = w.d_force;
    w.projection.solve_mass_in_place(w.d_a_bar);
    w.d_a_bar += w.d_of_rest;
  }
  if (parts.constraint_force || parts.applied_force) {
    w.d_mass_a_bar = w.d_force;
    w.d_mass_a_bar.noalias() += at.M().lazyProduct(w.d_of_rest);
  }
  if (parts.applied_force) w.d_applied += w.d_mass_a_bar;
  if (!is_constrained) return;
  w.d_force += w.d_forced - w.d_of_constraint;
  w.projection.solve_mass_in_place(w.d_force);
  w.d_of_rest += w.d_force;
  w.d_a.noalias() = w.projection.T().lazyProduct(w.d_of_rest);
  w.d_a.noalias() += w.L.lazyProduct(w.d_rows);
  if (parts.constraint_force) {
    w.d_of_constraint.noalias() += at.M().lazyProduct(w.d_a);
    w.d_of_constraint -= w.d_mass_a_bar;
  }
}

void Predictor::Implementation::write_jacobian(const Ref<const VectorXd>& state, const StateEvaluator& at,
                                               Workspace::Implementation& w, Ref<MatrixXd> jacobian) const {
  differentiate_prior(state, at, w);
  differentiate_mechanics(at, w);
  differentiate_motion(at, w);
  view.quantity->differentiate(w.mechanics(at.A()), w.motion(), w.dmotion(), StateChange(at), w.d_value, w.quantity);
  if (multipliers) {
    Workspace::Implementation& whole = *w.multipliers;
    Ref<VectorXd> lambda = whole.mean;
    static_cast<void>(multipliers->write_mean(state, *whole.values_and_derivatives, whole, lambda));
    multipliers->write_jacobian(state, *whole.values_and_derivatives, whole, whole.jacobian);
    write_G(at, w);
    w.GK.noalias() = w.G.lazyProduct(w.slope);
    w.d_value.noalias() += w.GK.lazyProduct(whole.jacobian);
  } else if (reads_multipliers) {
    // dv = ∂v/∂x + G J dλ, D dλ = ∂(G_λ ā + d_λ)/∂x
    write_G(at, w);
    add_response(w);
    Quantity::multipliers->differentiate(w.mechanics(at.A()), w.motion(), w.dmotion(), StateChange(at), w.d_multipliers,
                                         w.quantity);
    w.d_value.noalias() += w.GK.lazyProduct(w.d_multipliers);
  }
  for (std::size_t r = 0; r < view.rows.size(); ++r) {
    jacobian.row(static_cast<Index>(r)) = w.d_value.row(view.rows[r]);
    if (added_entries[r]) jacobian(static_cast<Index>(r), *added_entries[r]) += 1;
  }
}

double Predictor::Implementation::distance_at(const Ref<const VectorXd>& state, Workspace::Implementation& w) const {
  for (Workspace::Implementation::AtState& here : w.terms) {
    here.of_features->evaluate(state, here.features);
    if (!is_finite(here.features)) return not_a_number;
  }
  distance.write_coordinates(
      [&](std::size_t latent) -> const VectorXd& {
        std::size_t a = 0;
        while (terms[a].latent != latent) ++a;
        return w.terms[a].features;
      },
      w.coordinates);
  return distance.at(w.coordinates);
}

}  // namespace gp2
