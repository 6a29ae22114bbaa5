#include "gp2/predictor.hpp"

#include <algorithm>
#include <cmath>
#include <optional>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include "base/not_a_number.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/state_evaluator.hpp"
#include "inference/data_distance.hpp"
#include "inference/motion_under_load.hpp"
#include "inference/posterior_implementation.hpp"
#include "inference/predictor_data.hpp"
#include "inference/requirements.hpp"
#include "mechanics/multiplier_solver.hpp"
#include "prior/admissible_directions.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Status = Predictor::Status;

struct Predictor::Implementation {
  Prior prior;          // where the view looks
  VectorXd parameters;  // there
  View view;
  Options options;
  std::vector<PredictorTerm> terms;
  double time_step = 0;                           // Δt of the view's quantity
  MotionParts parts;                              // that it reads
  std::vector<std::optional<int>> added_entries;  // of the state, to each row of the view
  bool is_constrained = false;                    // ddq or Aᵀλ is one of them
  bool has_force = false;                         // μ or a direction that is multiplied by M⁻¹ …
  bool has_forced_latent = false;                 // … of which the deviation needs the directions
  bool needs_acceleration = false;                // ā itself, which is none where M is singular
  bool reads_multipliers = false;                 // a direction reads λ
  PredictorData<double> in_double;
  PredictorData<float> in_single;
  DataDistance distance;  // of the first component of a mixture alone

  Implementation(const Posterior::Implementation& posterior, View viewed, Options given);

  // work(data, memory) in the precision of the storage
  template <typename Work>
  void with_data(Workspace::Implementation& w, const Work& work) const;

  // the mean; NaN where the state cannot be evaluated
  Status write_mean(const Ref<const VectorXd>& state, StateEvaluator& at, Workspace::Implementation& w,
                    Ref<VectorXd>& mean) const;
  // these follow the mean at the same state
  void write_covariance(const StateEvaluator& at, Workspace::Implementation& w) const;
  void write_jacobian(const Ref<const VectorXd>& state, const StateEvaluator& at, Workspace::Implementation& w,
                      Ref<MatrixXd> jacobian) const;

  [[nodiscard]] double distance_at(const Ref<const VectorXd>& state, Workspace::Implementation& w) const;

  // λ, and what the latents that read it add to the force and to ā
  [[nodiscard]] bool evaluate_load(const Ref<const VectorXd>& state, const StateEvaluator& at,
                                   Workspace::Implementation& w) const;
  // G of every row, with what its change with λ adds, and G J D⁻¹
  void write_G(const StateEvaluator& at, Workspace::Implementation& w) const;

  [[nodiscard]] const Latent& latent(const PredictorTerm& term) const { return prior.latents[term.latent]; }
  [[nodiscard]] bool has_mean_force() const { return view.has_mean() && prior.mean == Prior::Mean::force; }
  [[nodiscard]] int n_quantity_rows() const { return view.quantity->n_rows(prior.system->nq(), prior.system->nc()); }

 private:
  // the projection at a state
  Status evaluate_mechanics(StateEvaluator& at, Workspace::Implementation& w) const;
  // ā there
  Status evaluate_prior(const Ref<const VectorXd>& state, const StateEvaluator& at, Workspace::Implementation& w) const;
  // those of F̄, ddq and Aᵀλ that the view or the Jacobian needs
  void evaluate_motion(const StateEvaluator& at, Workspace::Implementation& w) const;
  void write_loadings(Workspace::Implementation& w) const;
  void differentiate_prior(const Ref<const VectorXd>& state, const StateEvaluator& at, Workspace::Implementation& w) const;
  void differentiate_mechanics(const StateEvaluator& at, Workspace::Implementation& w) const;
  void differentiate_motion(const StateEvaluator& at, Workspace::Implementation& w) const;
};

struct Predictor::Workspace::Implementation {
  std::shared_ptr<const Predictor::Implementation> predictor;
  std::unique_ptr<StateEvaluator> values, values_and_derivatives;
  UdwadiaKalaba projection;
  UdwadiaKalaba::Workspace refinement;
  QuantityKind::Workspace quantity;
  AffineMotion affine_motion;

  struct AtState {
    std::unique_ptr<StateFunction::Evaluator> of_features, of_directions;
    MotionUnderLoad::OfLatent* under_load = nullptr;  // in the place of of_directions where they read λ
    VectorXd features;                                // φ (D)
    VectorXd point;                                   // scaled
    VectorXd directions;                              // B or B Π (nq·p), none where B = I
    std::optional<AdmissibleDirections> admissible;
    VectorXd dfeatures, ddirections;  // their derivatives that do not vanish
    VectorXd signal;                  // C g (p)
    MatrixXd dsignal;                 // d(C g)/dφ (D × p)
    MatrixXd E_dsignal;               // B d(C g)/dφ (nq × D)
  };
  std::vector<AtState> terms;
  VectorXd a_bar;                       // ā
  VectorXd force;                       // what is multiplied by M⁻¹ in it …
  VectorXd a_of_force;                  // … and the product
  VectorXd a;                           // ddq, or T ā of one latent alone
  VectorXd gap;                         // a − ā
  VectorXd of_constraint;               // Aᵀλ = M (a − ā)
  VectorXd applied;                     // F̄ = M ā
  VectorXd lambda;                      // λ (nc)
  MatrixXd L;                           // (nq × nc)
  MatrixXd d_of_rest;                   // of dā, what is not multiplied by M⁻¹ (nq × layout size)
  MatrixXd d_force;                     // what is
  MatrixXd d_forced;                    // … in da alone
  MatrixXd d_rows;                      // db − dA a (nc × layout size)
  MatrixXd d_a_bar, d_a;                // dā, da
  MatrixXd d_mass_a_bar;                // M dā
  MatrixXd d_of_constraint;             // dM (a − ā), then d(Aᵀλ)
  MatrixXd d_applied;                   // dM ā, then dF̄
  MatrixXd value, d_value;              // every row of the quantity (× 1), (× layout size)
  MatrixXd G;                           // every row (× nq)
  std::optional<MotionUnderLoad> load;  // where λ is read, and for it:
  MultiplierSolver solver;
  LoadResponse response;
  VectorXd without_load;               // ā without the latents that read λ
  MatrixXd slope, G_lambda, d_lambda;  // J, G_λ, d_λ
  MatrixXd GK;                         // G K of every row (× nc)
  MatrixXd d_multipliers;              // ∂(G_λ ā + d_λ)/∂x at held λ (nc × layout size)
  MatrixXd Gt, M_inverse_Gt;           // Gᵀ of the view (nq × d)
  std::vector<MatrixXd> loadings;      // ℓ, per term (F × d)
  MatrixXd covariance;                 // of the view, its lower triangle (d × d)
  VectorXd coordinates;                // of the distance from the data
  VectorXd mean;                       // of a component of a mixture (d)
  MatrixXd jacobian;                   // likewise (d × layout size)
  PredictorData<double>::Memory in_double;
  PredictorData<float>::Memory in_single;

  explicit Implementation(std::shared_ptr<const Predictor::Implementation> owner);

  [[nodiscard]] MotionColumns motion() const {
    return {columns_of(a), columns_of(a_bar), columns_of(of_constraint), columns_of(applied)};
  }
  [[nodiscard]] MotionColumns dmotion() const {
    return {columns_of(d_a), columns_of(d_a_bar), columns_of(d_of_constraint), columns_of(d_applied)};
  }
  [[nodiscard]] StateMechanics mechanics(const Map<const MatrixXd>& A) const { return {projection, A, predictor->time_step}; }

 private:
  void reserve_mechanics();
  void reserve_term(const PredictorTerm& term);
};

template <typename Work>
void Predictor::Implementation::with_data(Workspace::Implementation& w, const Work& work) const {
  if (options.storage == Storage::single_precision) {
    work(in_single, w.in_single);
  } else {
    work(in_double, w.in_double);
  }
}

namespace {

template <typename Numbers>
bool is_finite(const Numbers& numbers) {
  // 0·x is 0 of a finite number only
  double sum = 0;
  for (const double number : numbers.reshaped()) sum += 0 * number;
  return sum == 0;
}

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

Predictor::Implementation::Implementation(const Posterior::Implementation& posterior, View viewed, Options given)
    : prior(prior_of(posterior.prior, viewed)),
      parameters(parameters_of(viewed, posterior.values.parameters)),
      view(std::move(viewed)),
      options(given),
      time_step(view.required_time_step()),
      parts(view.quantity->parts()),
      is_constrained(parts.constrained_acceleration || parts.constraint_force) {
  for (int r = 0; r < view.size(); ++r) added_entries.push_back(view.added_entry(prior.system->layout(), r));
  needs_acceleration = what_needs_acceleration(prior, view).has_value();
  for (const Latent& latent : prior.latents) {
    reads_multipliers = reads_multipliers || (latent.directions && latent.directions->of_multipliers() != nullptr);
  }
  if (reads_multipliers) {
    parts.constrained_acceleration = parts.constraint_force = parts.unconstrained_acceleration = true;
    is_constrained = true;
  }
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    if (!view.has_latent(a)) continue;
    terms.push_back({a, posterior.latents->latents()[a].kernel, posterior.C[a], prior.latents[a].is_potential});
    if (terms.back().is_potential) terms.back().variance = GradientColumns(terms.back().kernel).variance();
    has_forced_latent = has_forced_latent || prior.latents[a].base == Latent::Base::force;
  }
  has_force = has_mean_force() || has_forced_latent;
  if (options.storage == Storage::single_precision) {
    in_single.store(*posterior.latents, terms, options.stddev);
  } else {
    in_double.store(*posterior.latents, terms, options.stddev);
  }
}

Predictor::Workspace::Implementation::Implementation(std::shared_ptr<const Predictor::Implementation> owner)
    : predictor(std::move(owner)) {
  const Predictor::Implementation& self = *predictor;
  values = self.prior.system->make_evaluator(self.parameters, false);
  if (self.options.jacobian) values_and_derivatives = self.prior.system->make_evaluator(self.parameters, true);
  reserve_mechanics();
  for (const PredictorTerm& term : self.terms) reserve_term(term);
  coordinates.setZero(self.distance.n_coordinates());
  self.with_data(*this, [&](const auto& data, auto& memory) {
    memory = data.make_memory(self.terms, self.view.size(), self.options.stddev);
  });
}

void Predictor::Workspace::Implementation::reserve_mechanics() {
  const System& system = *predictor->prior.system;
  const Index nq = system.nq(), nc = system.nc(), n_state = system.layout().size(), d = predictor->view.size();
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
  mean.setZero(d);
  jacobian.setZero(d, n_state);
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
  loadings.emplace_back(MatrixXd::Zero(term.n_functions(), predictor->view.size()));
  at.dfeatures.setZero(static_cast<Index>(at.of_features->entries().size()));
  if (!latent.directions) return;
  at.directions.setZero(nq * p);
  if (latent.directions->of_multipliers() != nullptr) {
    at.under_load = &*std::ranges::find(load->latents(), term.latent, &MotionUnderLoad::OfLatent::latent);
    return;
  }
  at.of_directions = latent.directions->make_evaluator(predictor->parameters);
  at.ddirections.setZero(static_cast<Index>(at.of_directions->entries().size()));
  if (latent.base != Latent::Base::admissible) return;
  at.of_directions->evaluate(VectorXd::Zero(predictor->prior.system->layout().size()), at.directions);
  at.admissible.emplace(Map<const MatrixXd>(at.directions.data(), nq, nq).diagonal());
  at.admissible->compute(MatrixXd::Ones(predictor->prior.system->nc(), nq));
  at.admissible->set_functions(at.signal);
}

// ---------------------------------------------------------------- mean

Status Predictor::Implementation::evaluate_mechanics(StateEvaluator& at, Workspace::Implementation& w) const {
  if (!is_finite(at.M()) || !is_finite(at.A()) || !is_finite(at.b())) return Status::not_finite;
  w.projection.compute(at.M(), at.A(), at.b());
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
      if (here.admissible) {
        here.directions = here.admissible->compute(at.A()).reshaped();
      } else if (here.of_directions) {
        here.of_directions->evaluate(state, here.directions);
      }
      add_product(here.directions, here.signal, of.base == Latent::Base::force ? w.force : w.a_bar);
    }
  });
  if (reads_multipliers && !evaluate_load(state, at, w)) return Status::not_finite;
  w.a_of_force = w.force;
  if (has_force) {
    w.projection.solve_mass_in_place(w.a_of_force);
    w.a_bar += w.a_of_force;
  }
  return is_finite(w.a_bar) && all_features ? Status::ok : Status::not_finite;
}

bool Predictor::Implementation::evaluate_load(const Ref<const VectorXd>& state, const StateEvaluator& at,
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
  if (!w.solver.solve(w.G_lambda, w.d_lambda.col(0), motion)) return false;
  motion(w.solver.lambda(), w.a_of_force, w.slope);
  for (Workspace::Implementation::AtState& here : w.terms) {
    if (here.under_load == nullptr) continue;
    here.directions = here.under_load->B;
    add_product(here.directions, here.signal, here.under_load->acts_on_forces ? w.force : w.a_bar);
  }
  return true;
}

void Predictor::Implementation::write_G(const StateEvaluator& at, Workspace::Implementation& w) const {
  w.affine_motion.evaluate(w.projection, at.M(), parts);
  view.quantity->evaluate(w.mechanics(at.A()), w.affine_motion.linear(), w.G, w.quantity);
  if (!reads_multipliers) return;
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
void Predictor::Implementation::write_loadings(Workspace::Implementation& w) const {
  const Index nq = w.Gt.rows();
  w.covariance.setZero();
  for (std::size_t a = 0; a < terms.size(); ++a) {
    const PredictorTerm& term = terms[a];
    const VectorXd& B = w.terms[a].directions;
    const MatrixXd& Gt = latent(term).base == Latent::Base::force ? w.M_inverse_Gt : w.Gt;
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
  for (int r = 0; r < view.size(); ++r) w.Gt.col(r) = w.G.row(view.rows[static_cast<std::size_t>(r)]);
  if (has_forced_latent) {
    w.M_inverse_Gt = w.Gt;
    w.projection.solve_mass_in_place(w.M_inverse_Gt);
  }
  write_loadings(w);
  with_data(w, [&](const auto& data, auto& memory) { data.subtract_explained(terms, w.loadings, memory, w.covariance); });
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
      continue;
    }
    // dB C g, at held λ where it is read
    const auto add = [&](const StateFunction::Evaluator& directions, const VectorXd& dB) {
      for (std::size_t e = 0; e < directions.entries().size(); ++e) {
        const StateDerivatives::Entry& entry = directions.entries()[e];
        if (entry.state_index >= sum.cols()) break;  // in λ, which follows the state
        sum(entry.output % nq, entry.state_index) += dB[static_cast<Index>(e)] * here.signal[entry.output / nq];
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
  if (reads_multipliers) {
    // dv = ∂v/∂x + G J dλ, D dλ = ∂(G_λ ā + d_λ)/∂x
    write_G(at, w);
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

// ---------------------------------------------------------------- the public class

Predictor::Predictor(const Posterior& posterior)
    : Predictor(posterior, View::constrained_acceleration(*posterior.prior().system)) {}
Predictor::Predictor(const Posterior& posterior, View view) : Predictor(posterior, std::move(view), Options()) {}
Predictor::Predictor(const Posterior& posterior, View view, Options options) {
  require_view(posterior.prior(), view);
  if (view.latent || !view.has_mean()) require_linear(prior_of(posterior.prior(), view), "Predictor of a part of the motion");
  for (const auto& component : posterior.conditioned()) {
    const auto own = std::make_shared<Implementation>(*component, view, options);
    if (components_.empty()) own->distance = DataDistance(*component, view);
    components_.push_back(own);
  }
}

Predictor::Workspace::Workspace(const Predictor& predictor) {
  static_cast<void>(predictor.implementation());  // it was not moved away
  for (const auto& component : predictor.components_) components_.push_back(std::make_unique<Implementation>(component));
}
Predictor::Workspace::~Workspace() = default;
Predictor::Workspace::Workspace(Workspace&&) noexcept = default;
Predictor::Workspace& Predictor::Workspace::operator=(Workspace&&) noexcept = default;

const Predictor::Implementation& Predictor::implementation() const {
  if (components_.empty()) throw_moved("Predictor");
  return *components_.front();
}
const View& Predictor::view() const { return implementation().view; }
const Predictor::Options& Predictor::options() const { return implementation().options; }

namespace {

using WorkspaceParts = std::vector<std::unique_ptr<Predictor::Workspace::Implementation>>;

void check_arguments(const Predictor::Implementation& predictor, const Ref<const VectorXd>& state,
                     const WorkspaceParts& workspace) {
  if (workspace.empty() || workspace.front()->predictor.get() != &predictor) {
    throw InputError("Predictor: the workspace is of another predictor; use make_workspace() of this one");
  }
  require_size("Predictor", "a state", state.size(), predictor.prior.system->layout().size());
}
void check_arguments(const Predictor::Implementation& predictor, const Ref<const VectorXd>& state, const Ref<VectorXd>& mean,
                     const WorkspaceParts& workspace) {
  check_arguments(predictor, state, workspace);
  require_size("Predictor", "the mean", mean.size(), predictor.view.size());
}

// of rows r and s ≤ r of the view: of one component, or of their mixture, whose mean is given
double covariance_of(const WorkspaceParts& components, const Ref<VectorXd>& mean, Index r, Index s) {
  double sum = 0;
  for (const auto& w : components) {
    sum += w->covariance(r, s);
    if (components.size() > 1) sum += (w->mean[r] - mean[r]) * (w->mean[s] - mean[s]);
  }
  return r == s && sum < 0 ? 0 : sum / static_cast<double>(components.size());
}

// NaN in the place of numbers of which one overflowed
Status finite_or_none(Ref<VectorXd> mean, Ref<MatrixXd> uncertainty) {
  if (is_finite(mean) && is_finite(uncertainty)) return Status::ok;
  mean.setConstant(not_a_number);
  uncertainty.setConstant(not_a_number);
  return Status::not_finite;
}

}  // namespace

// evaluate(component, its memory, its mean) of each, and the mean of their means; NaN where one has none
template <typename Evaluate>
Status Predictor::for_each_component(Workspace& workspace, Ref<VectorXd>& mean, const Evaluate& evaluate) const {
  if (components_.size() == 1) return evaluate(*components_.front(), *workspace.components_.front(), mean);
  mean.setZero();
  for (std::size_t k = 0; k < components_.size(); ++k) {
    Workspace::Implementation& w = *workspace.components_[k];
    const Status status = evaluate(*components_[k], w, w.mean);
    if (status != Status::ok) {
      mean.setConstant(not_a_number);
      return status;
    }
    mean += w.mean;
  }
  mean /= static_cast<double>(components_.size());
  return Status::ok;
}

Status Predictor::mean(const Ref<const VectorXd>& state, Ref<VectorXd> mean, Workspace& workspace) const {
  check_arguments(implementation(), state, mean, workspace.components_);
  return for_each_component(workspace, mean, [&](const Implementation& self, Workspace::Implementation& w, Ref<VectorXd> mean_k) {
    return self.write_mean(state, *w.values, w, mean_k);
  });
}

Status Predictor::evaluate_covariance(const Ref<const VectorXd>& state, Ref<VectorXd>& mean, Workspace& workspace) const {
  if (!options().stddev) throw InputError("Predictor: it was made without Options::stddev");
  check_arguments(implementation(), state, mean, workspace.components_);
  return for_each_component(workspace, mean, [&](const Implementation& self, Workspace::Implementation& w, Ref<VectorXd> mean_k) {
    const Status status = self.write_mean(state, *w.values, w, mean_k);
    if (status == Status::ok) self.write_covariance(*w.values, w);
    return status;
  });
}

Status Predictor::mean_and_stddev(const Ref<const VectorXd>& state, Ref<VectorXd> mean, Ref<VectorXd> stddev,
                                  Workspace& workspace) const {
  require_size("Predictor", "the standard deviation", stddev.size(), view().size());
  const Status status = evaluate_covariance(state, mean, workspace);
  if (status != Status::ok) {
    stddev.setConstant(not_a_number);
    return status;
  }
  for (Index r = 0; r < stddev.size(); ++r) stddev[r] = std::sqrt(covariance_of(workspace.components_, mean, r, r));
  return finite_or_none(mean, stddev);
}

Status Predictor::mean_and_covariance(const Ref<const VectorXd>& state, Ref<VectorXd> mean, Ref<MatrixXd> covariance,
                                      Workspace& workspace) const {
  require_size("Predictor", "a column of the covariance", covariance.rows(), view().size());
  require_size("Predictor", "a row of the covariance", covariance.cols(), view().size());
  const Status status = evaluate_covariance(state, mean, workspace);
  if (status != Status::ok) {
    covariance.setConstant(not_a_number);
    return status;
  }
  for (Index r = 0; r < covariance.rows(); ++r) {
    for (Index s = 0; s <= r; ++s) covariance(r, s) = covariance(s, r) = covariance_of(workspace.components_, mean, r, s);
  }
  return finite_or_none(mean, covariance);
}

Status Predictor::mean_and_jacobian(const Ref<const VectorXd>& state, Ref<VectorXd> mean, Ref<MatrixXd> jacobian,
                                    Workspace& workspace) const {
  if (!options().jacobian) throw InputError("Predictor: it was made without Options::jacobian");
  check_arguments(implementation(), state, mean, workspace.components_);
  require_size("Predictor", "a column of the Jacobian", jacobian.rows(), view().size());
  require_size("Predictor", "a row of the Jacobian", jacobian.cols(), state.size());
  const bool is_mixture = components_.size() > 1;
  if (is_mixture) jacobian.setZero();
  Status status =
      for_each_component(workspace, mean, [&](const Implementation& self, Workspace::Implementation& w, Ref<VectorXd> mean_k) {
        StateEvaluator& at = *w.values_and_derivatives;
        const Status of_one = self.write_mean(state, at, w, mean_k);
        if (of_one != Status::ok) return of_one;
        self.write_jacobian(state, at, w, is_mixture ? Ref<MatrixXd>(w.jacobian) : jacobian);
        if (is_mixture) jacobian += w.jacobian / static_cast<double>(components_.size());
        return is_finite(jacobian) ? Status::ok : Status::not_finite;
      });
  if (status == Status::ok) return status;
  mean.setConstant(not_a_number);
  jacobian.setConstant(not_a_number);
  return status;
}

double Predictor::distance_from_data(const Ref<const VectorXd>& state, Workspace& workspace) const {
  check_arguments(implementation(), state, workspace.components_);
  return implementation().distance_at(state, *workspace.components_.front());
}

}  // namespace gp2
