#include "inference/inverse_dynamics.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include <Eigen/Cholesky>

#include "base/not_a_number.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/inverse_dynamics.hpp"
#include "gp2/mechanics/state_evaluator.hpp"
#include "gp2/mechanics/symbolic_system.hpp"
#include "inference/requirements.hpp"
#include "mechanics/describe_fault.hpp"
#include "mechanics/pivoted_qr.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Eigen::VectorXi;

namespace {

constexpr double rank_tolerance = 1e-10;  // as that of constraints
constexpr double rounding = 1e-13;        // of accelerations, beside their size
constexpr double close_enough = 1e-8;     // where rounding lets no step help any more
constexpr double last_resort = 0.1;       // of a usual effect: of an input that the data hold at 0

void require_inputs_of(const Posterior& posterior, const View& view) {
  require_view(posterior.prior(), view);
  if (!view.is_of_ddq()) throw InputError("inverse_dynamics: the view must be of the constrained acceleration ddq");
  const System& system = *prior_of(posterior.prior(), view).system;
  if (system.layout().nu == 0) throw InputError(fmt::format("inverse_dynamics: '{}' has no inputs", system.name()));
}

// Of each input the root of its mean square in the observations; 0 where it never acted there.
VectorXd usual_inputs_of(const Posterior& posterior) {
  const Index nu = posterior.prior().system->layout().nu;
  VectorXd squares = VectorXd::Zero(nu), n = squares;
  for (const Observations& group : posterior.observations()) {
    const auto inputs = group.states().bottomRows(nu).array();
    squares.array() += inputs.isFinite().select(inputs.square(), 0).rowwise().sum();
    n.array() += inputs.isFinite().cast<double>().rowwise().sum();
  }
  return (squares.array() > 0).select((squares.array() / n.array()).sqrt(), 0);
}

/// The pseudo-inverse of matrices J of one size, inputs being measured by scales D, so that their units decide nothing. With
/// J D P = Q [R; 0] and Rᵀ P' = Q' [S; 0],
///
///     (J D)⁺ = P Q' [S⁻ᵀ P'ᵀ 0; 0] Qᵀ.
///
/// The scale of an input is its usual size: of changes that do the same the least is taken, each beside what is usual, and an input
/// that does next to nothing is not asked for immense ones. One whose size is not known is weighed by its effect: where others have a
/// size, as one that does little.
class ScaledPseudoInverse {
 public:
  ScaledPseudoInverse(Index d, Index nu)
      : scaled_(d, nu), Q_transposed_(d, d), R_transposed_(nu, std::min(d, nu)), inverse_(nu, d), out_(nu, d), scale_(nu) {
    reflection_.setZero(std::min(d, nu));
    reflection2_ = reflection_;
    order_.setZero(nu);
    order2_.setZero(std::min(d, nu));
  }

  Index rank = 0;  // of what was computed last

  /// D (J D)⁺ (nu × d).
  /// @param sizes    usual ones (nu); 0: not known
  /// @param nothing  an effect of a usual size that is rounding
  const MatrixXd& compute(const MatrixXd& J, const VectorXd& sizes, double nothing) {
    write_scale(J, sizes, nothing);
    scaled_.noalias() = J * scale_.asDiagonal();
    rank = internal::pivoted_qr(scaled_, reflection_, order_, rank_tolerance);
    Q_transposed_.setIdentity();
    internal::apply_Q_transposed(scaled_, reflection_, rank, Q_transposed_);
    auto S = R_transposed_.leftCols(rank);
    for (Index k = 0; k < rank; ++k) {
      S.col(k).head(k).setZero();
      S.col(k).tail(J.cols() - k) = scaled_.row(k).tail(J.cols() - k);
    }
    internal::pivoted_qr(S, reflection2_.head(rank), order2_.head(rank), 0);
    inverse_.setZero();
    for (Index k = 0; k < rank; ++k) {
      inverse_.row(k) = Q_transposed_.row(order2_[k]);
      for (Index j = 0; j < k; ++j) inverse_.row(k) -= S(j, k) * inverse_.row(j);
      inverse_.row(k) /= S(k, k);
    }
    internal::apply_Q(S, reflection2_, rank, inverse_);
    for (Index k = 0; k < J.cols(); ++k) out_.row(order_[k]) = scale_[order_[k]] * inverse_.row(k);
    return out_;
  }

 private:
  void write_scale(const MatrixXd& J, const VectorXd& sizes, double nothing) {
    double largest = 0;
    for (Index k = 0; k < J.cols(); ++k) {
      const double effect = sizes[k] * J.col(k).norm();
      scale_[k] = effect > nothing ? sizes[k] : 0;
      if (scale_[k] > 0) largest = std::max(largest, effect);
    }
    for (Index k = 0; k < J.cols(); ++k) {
      const double slope = J.col(k).norm();
      if (sizes[k] == 0 && slope > 0) scale_[k] = (largest > 0 ? last_resort * largest : 1) / slope;
    }
  }

  MatrixXd scaled_, Q_transposed_, R_transposed_, inverse_, out_;
  VectorXd scale_, reflection_, reflection2_;
  VectorXi order_, order2_;
};

}  // namespace

Eigen::Array<bool, Eigen::Dynamic, 1> inputs_of_sensors(const System& system) {
  const StateLayout layout = system.layout();
  Eigen::Array<bool, Eigen::Dynamic, 1> out = Eigen::Array<bool, Eigen::Dynamic, 1>::Constant(layout.nu, false);
  const auto* symbolic = dynamic_cast<const SymbolicSystem*>(&system);
  if (symbolic == nullptr) return out;
  const std::vector<bool> of_force = system.reads(SystemPart::force);
  for (const ConstraintRow& row : symbolic->definition().constraints) {
    if (row.contact) out[row.contact->input] = true;
    if (row.condition.empty()) continue;
    for (const Expression& entry : row.A) {
      // an entry is its condition times what it is where that holds
      const Expression condition = entry.operation() == Operation::multiply_or_zero ? entry.left() : entry;
      const std::vector<std::string> read = entry.graph().variables_of(condition);
      for (int k = 0; k < layout.nu; ++k) {
        const bool is_read = std::binary_search(read.begin(), read.end(), system.inputs()[static_cast<std::size_t>(k)]);
        out[k] = out[k] || (is_read && !of_force[static_cast<std::size_t>(layout.u(k))]);
      }
    }
  }
  return out;
}

struct InverseDynamicsSolver::Implementation {
  Prior prior;                                     // where the view looks
  VectorXd parameters;                             // there
  VectorXd usual_inputs;                           // how large each was as a rule; 0 where that is not known
  Eigen::Array<bool, Eigen::Dynamic, 1> is_given;  // whether an input is a sensor's, which stays where it is
  Options options;
  Predictor predictor;
  Predictor without_data;

  Implementation(const Posterior& posterior, const View& view, Options given)
      : prior(prior_of(posterior.prior(), view)),
        parameters(parameters_of(view, posterior.values().parameters)),
        usual_inputs(usual_inputs_of(posterior)),
        is_given(inputs_of_sensors(*prior.system)),
        options(given),
        predictor(posterior, view, {.stddev = options.covariance, .jacobian = true, .storage = options.storage}),
        without_data(posterior.without_data(), view, {.stddev = true, .jacobian = false}) {}

  [[nodiscard]] Index nu() const { return prior.system->layout().nu; }
  // whether the data hold some inputs at 0, and others not
  [[nodiscard]] bool has_idle_inputs() const { return (usual_inputs.array() > 0).any() && !(usual_inputs.array() > 0).all(); }
};

/// The search at one state after another.
struct InverseDynamicsSolver::Workspace::Implementation {
  std::shared_ptr<const InverseDynamicsSolver::Implementation> solver;
  Predictor::Workspace memory, memory_without_data;
  std::unique_ptr<StateEvaluator> mechanics;
  UdwadiaKalaba projection;
  Eigen::LLT<MatrixXd> llt, damped_llt;
  ScaledPseudoInverse inverse;
  VectorXd state;                // its inputs are those found so far
  VectorXd wanted;               // (d)
  VectorXd mean;                 // of ddq under these inputs (d)
  MatrixXd jacobian;             // (d × layout size)
  VectorXd missed;               // (d)
  VectorXd usual;                // how large accelerations are, beside which rounding is judged (d)
  VectorXd usual_mean;           // of the prior (d)
  MatrixXd metric;               // M' of the view's rows (d × d)
  MatrixXd root;                 // of the metric, upper triangular (d × d)
  MatrixXd J;                    // ∂v/∂u in the metric (d × nu)
  VectorXd weighted;             // root times a vector (d)
  VectorXd change;               // of the inputs (nu)
  VectorXd start;                // of a step (nu)
  VectorXd pull;                 // M' of what is missed (d)
  VectorXd slope;                // of −½ |missed|² (nu)
  VectorXd largest;              // effect of each input so far (nu)
  VectorXd weights;              // of the inputs where steps are damped (nu)
  MatrixXd curvature;            // of ½ |missed|² (nu × nu)
  MatrixXd damped;               // with more on its diagonal (nu × nu)
  bool is_nearest = false;       // no inputs about these miss less
  Index most_rank = 0;           // of J in this search
  double nothing = 0;            // an effect of an input's usual size that is rounding, in the metric
  MatrixXd covariance;           // of the view (d × d)
  MatrixXd weighted_covariance;  // (nu × d)
  MatrixXd J_inverse;            // J⁺ of v itself (nu × d)
  Eigen::LLT<MatrixXd> mass_llt;
  VectorXd sizes;        // usual ones of the inputs (nu); 0: not known
  VectorXd force_slope;  // ∂F/∂u_k (nq)

  explicit Implementation(std::shared_ptr<const InverseDynamicsSolver::Implementation> owner)
      : solver(std::move(owner)),
        memory(solver->predictor.make_workspace()),
        memory_without_data(solver->without_data.make_workspace()),
        mechanics(solver->prior.system->make_evaluator(solver->parameters, solver->has_idle_inputs())),
        llt(solver->predictor.view().size()),
        damped_llt(solver->nu()),
        inverse(solver->predictor.view().size(), solver->nu()),
        mass_llt(solver->prior.system->nq()) {
    const Index d = solver->predictor.view().size(), nu = solver->nu(), n_state = solver->prior.system->layout().size();
    state.setZero(n_state);
    wanted.setZero(d);
    mean = missed = usual = usual_mean = weighted = pull = wanted;
    jacobian.setZero(d, n_state);
    metric.setZero(d, d);
    root = covariance = metric;
    J.setZero(d, nu);
    change.setZero(nu);
    start = slope = largest = weights = sizes = change;
    force_slope.setZero(solver->prior.system->nq());
    curvature.setZero(nu, nu);
    damped = curvature;
    J_inverse.setZero(nu, d);
    weighted_covariance = J_inverse;
    // rows that are all the same, so that the memory for redundant ones is there too
    const Index nq = solver->prior.system->nq(), nc = solver->prior.system->nc();
    projection.compute(MatrixXd::Identity(nq, nq), MatrixXd::Ones(nc, nq), VectorXd::Zero(nc));
  }

  [[nodiscard]] Status run(const Ref<const VectorXd>& at, const Ref<const VectorXd>& accelerations) {
    state = at;
    for (double& input : state.tail(solver->nu())) input = std::isnan(input) ? 0 : input;
    wanted = accelerations;
    missed.setConstant(not_a_number);
    if (!wanted.allFinite()) return Status::not_finite;
    if (!evaluate() ||
        solver->without_data.mean_and_stddev(state, usual_mean, usual, memory_without_data) != Predictor::Status::ok) {
      return Status::no_prediction;
    }
    write_root();
    const double expected = size_of(usual) + size_of(mean);
    nothing = rank_tolerance * expected;
    write_sizes(expected);
    const double size = size_of(usual) + size_of(wanted);
    begin_beside_turns(size);
    most_rank = 0;
    if (search(size)) {
      // about a turn the inputs are known by the curvature there, of which the covariance of v does not tell
      if (inverse.rank < most_rank) J_inverse.setConstant(not_a_number);
      return Status::ok;
    }
    missed.setConstant(not_a_number);
    return Status::not_found;
  }

  // Which inputs the null space of J reaches: row k of 1 − J⁺J is not 0. About a turn there is none to tell, nor of sensors.
  [[nodiscard]] Eigen::Array<bool, Eigen::Dynamic, 1> open_inputs() const {
    constexpr double none = 1e-6;  // of 1, the diagonal entry of a projection, where the rank has been decided
    const Index nu = solver->nu();
    if (inverse.rank == nu) return Eigen::Array<bool, Eigen::Dynamic, 1>::Constant(nu, false);
    return 1 - J_inverse.cwiseProduct(jacobian.rightCols(nu).transpose()).rowwise().sum().array() > none && !solver->is_given;
  }

  // J⁺ Σ J⁺ᵀ, where Σ is the view's
  void write_covariance(const Ref<const MatrixXd>& of_view, Ref<MatrixXd> of_inputs) {
    weighted_covariance.noalias() = J_inverse.lazyProduct(of_view);
    of_inputs.noalias() = weighted_covariance.lazyProduct(J_inverse.transpose());
  }

 private:
  [[nodiscard]] bool evaluate() {
    const bool is_ok = solver->predictor.mean_and_jacobian(state, mean, jacobian, memory) == Predictor::Status::ok;
    for (Index k = 0; k < solver->nu(); ++k) {
      if (solver->is_given[k]) jacobian.rightCols(solver->nu()).col(k).setZero();
    }
    missed = wanted - mean;
    return is_ok;
  }

  void write_root() {
    mechanics->evaluate(state);
    projection.compute(mechanics->M(), mechanics->A(), mechanics->b(), solver->prior.system->largest_rank_of(mechanics->A()));
    const std::vector<int>& rows = solver->predictor.view().rows;
    for (std::size_t i = 0; i < rows.size(); ++i) {
      for (std::size_t j = 0; j < rows.size(); ++j) {
        metric(static_cast<Index>(i), static_cast<Index>(j)) = projection.mass()(rows[i], rows[j]);
      }
    }
    llt.compute(metric);
    root = llt.matrixU();
  }

  // The data tell no size of an input that they hold at 0. It is given the one at which its force alone makes a part of the accelerations
  // that are expected: its column of J may be no more than what a latent makes of data without it.
  void write_sizes(double expected) {
    sizes = solver->usual_inputs;
    if (!solver->has_idle_inputs()) return;
    mass_llt.compute(projection.mass());
    for (int k = 0; k < sizes.size(); ++k) {
      if (sizes[k] > 0) continue;
      force_slope.setZero();
      for (std::size_t i = 0; i < mechanics->derivatives().size(); ++i) {
        const StateEvaluator::Derivative& one = mechanics->derivatives()[i];
        if (one.quantity != StateEvaluator::Quantity::force || one.state_index != solver->prior.system->layout().u(k)) continue;
        force_slope[one.row] = mechanics->derivative_values()[static_cast<Index>(i)];
      }
      mass_llt.matrixL().solveInPlace(force_slope);
      const double effect = force_slope.norm();
      if (effect > 0) sizes[k] = last_resort * expected / effect;
    }
  }

  // An input that does nothing where it starts, while not all is produced, may be one whose effect is even, as that of a propeller at
  // rest: it begins beside. One that does nothing there either stays, and one that the data hold at 0 though its force is not even.
  void begin_beside_turns(double size) {
    auto inputs = state.tail(solver->nu());
    auto effects = jacobian.rightCols(solver->nu());
    if (size_of(missed) <= close_enough * size) return;
    start = inputs;
    for (Index k = 0; k < start.size(); ++k) {
      const double usual_input = solver->usual_inputs[k];
      if (!effects.col(k).isZero(0) || solver->is_given[k] || (usual_input == 0 && sizes[k] > 0)) continue;
      inputs[k] += usual_input > 0 ? usual_input : 1;
    }
    if (inputs == start) return;
    if (evaluate()) {
      for (Index k = 0; k < start.size(); ++k) {
        if (effects.col(k).isZero(0)) inputs[k] = start[k];
      }
    } else {
      inputs = start;
    }
    static_cast<void>(evaluate());
  }

  // |v| in the metric, and v as it is there in `weighted`
  double size_of(const VectorXd& v) {
    weighted.noalias() = root.lazyProduct(v);
    return weighted.norm();
  }

  // An input is weighed by the largest effect that any has had, over its own usual size; one without by the largest effect that it has had
  // itself (Moré 1978).
  void write_damping_weights() {
    const double of_usual = sizes.cwiseProduct(largest).maxCoeff();
    for (Index k = 0; k < solver->nu(); ++k) {
      weights[k] = sizes[k] > 0 ? of_usual / sizes[k] : largest[k];
      if (weights[k] == 0) weights[k] = 1;
    }
  }

  // size: of accelerations, beside which rounding is judged
  [[nodiscard]] bool search(double size) {
    constexpr int most_steps = 100, most_trials = 30;
    const Index nu = solver->nu();
    largest.setZero();
    double gain_before = std::numeric_limits<double>::infinity();
    for (int step = 0; step < most_steps; ++step) {
      size = std::max(size, size_of(mean));
      if (!std::isfinite(size)) return false;  // beside which anything would pass for rounding
      J.noalias() = root.lazyProduct(jacobian.rightCols(nu));
      const MatrixXd& pseudo_inverse = inverse.compute(J, sizes, nothing);
      J_inverse.noalias() = pseudo_inverse.lazyProduct(root);
      most_rank = std::max(most_rank, inverse.rank);
      const double before = size_of(missed);
      change.noalias() = pseudo_inverse.lazyProduct(weighted);
      weighted.noalias() = J.lazyProduct(change);
      const double gain = weighted.norm();
      // a Newton step that leaves half of what the one before gained was one of rounding
      const bool is_close = gain <= close_enough * size;
      if (gain <= rounding * size || (is_close && gain > gain_before / 2)) return true;
      gain_before = gain;
      largest = largest.cwiseMax(J.colwise().norm().transpose());
      write_damping_weights();
      if (!improve(before, size, is_close ? 1 : most_trials)) return is_close || is_nearest;
    }
    return false;
  }

  // The first step that misses less than before by a part of what its slope promises: that of Gauss and Newton, then Newton's own and
  // shorter ones (Levenberg 1944), inputs being told apart by `weights`. False where none does: the state stays. Where the promise of
  // the last one is rounding, these inputs come nearest to what is wanted, as where an input turns around what it does and J vanishes.
  [[nodiscard]] bool improve(double before, double size, int n) {
    constexpr double part = 0.25;
    auto inputs = state.tail(solver->nu());
    start = inputs;
    pull.noalias() = metric.lazyProduct(missed);
    slope.noalias() = jacobian.rightCols(solver->nu()).transpose().lazyProduct(pull);
    double damping = 0;
    is_nearest = false;
    for (int k = 0; k < n && !is_nearest; ++k) {
      if (k == 1) write_curvature(size);
      if (k > 0) {
        damped = curvature;
        damped.diagonal().array() += damping * weights.array().square();
        damping = std::max(5 * damping, 1e-3);
        damped_llt.compute(damped);
        if (damped_llt.info() != Eigen::Success) continue;
        change = slope;
        damped_llt.solveInPlace(change);
      }
      inputs = start + change;
      const bool is_predicted = evaluate();
      const double promised = 2 * slope.dot(change), after = size_of(missed);
      if (is_predicted && (before - after) * (before + after) > (n == 1 ? 0 : part * promised)) return true;
      is_nearest = is_predicted && promised <= rounding * before * before;
    }
    inputs = start;
    static_cast<void>(evaluate());
    return false;
  }

  // of ½ |missed|²: JᵀJ − (w − v)ᵀ M' ∂²v/∂u², the latter by differences of the slope, which need only be good enough for a step
  void write_curvature(double size) {
    auto inputs = state.tail(solver->nu());
    curvature.noalias() = J.transpose().lazyProduct(J);
    for (Index k = 0; k < solver->nu(); ++k) {
      if (!(largest[k] > 0)) continue;
      const double h = 1e-6 * (sizes[k] > 0 ? sizes[k] : size / largest[k]);
      inputs = start;
      inputs[k] += h;
      if (!evaluate()) continue;
      change.noalias() = jacobian.rightCols(solver->nu()).transpose().lazyProduct(pull);
      curvature.col(k) -= (change - slope) / h;
    }
    damped = curvature.transpose();
    curvature = 0.5 * (curvature + damped);
  }
};

// ---------------------------------------------------------------- many states

MatrixXd InverseDynamics::stddev() const {
  MatrixXd stddev(inputs.rows(), inputs.cols());
  for (Index k = 0; k < inputs.rows(); ++k) {
    const auto variance = covariance.row(k * (inputs.rows() + 1)).array();
    stddev.row(k) = (variance < 0).select(0, variance).sqrt();  // NaN stays NaN
  }
  return stddev;
}

InverseDynamics inverse_dynamics(const Posterior& posterior, const View& view, const Ref<const MatrixXd>& states,
                                 const Ref<const MatrixXd>& accelerations) {
  require_inputs_of(posterior, view);
  const System& system = *prior_of(posterior.prior(), view).system;
  const Index nu = system.layout().nu, d = view.size(), n = states.cols();
  if (accelerations.rows() != d || accelerations.cols() != n) {
    throw InputError(fmt::format("inverse_dynamics: expected accelerations of {} rows at {} states, got {} × {}", d, n,
                                 accelerations.rows(), accelerations.cols()));
  }
  system.require_states(states);
  MatrixXd found = states;
  found.bottomRows(nu) = states.bottomRows(nu).array().isNaN().select(0, states.bottomRows(nu));
  static_cast<void>(posterior.mean(view, found));  // names a state without a prediction

  InverseDynamics out{MatrixXd(nu, n), MatrixXd(nu * nu, n), MatrixXd(d, n), {}};
  out.open.resize(nu, n);
  std::vector<MatrixXd> inverses;
  InverseDynamicsSolver::Workspace::Implementation search(std::make_shared<const InverseDynamicsSolver::Implementation>(
      posterior, view, InverseDynamicsSolver::Options{.covariance = false}));
  for (Index i = 0; i < n; ++i) {
    const auto fail = [&](const char* text) { return internal::describe_fault(system, found, {static_cast<int>(i), text}); };
    switch (search.run(found.col(i), accelerations.col(i))) {
      case InverseDynamicsSolver::Status::ok:
        break;
      case InverseDynamicsSolver::Status::not_finite:
        throw InputError(fail("inverse_dynamics: an acceleration that is wanted is not a finite number"));
      case InverseDynamicsSolver::Status::no_prediction:
      case InverseDynamicsSolver::Status::not_found:
        throw NumericalError(
            fail("inverse_dynamics: no inputs are found that produce the accelerations, or come nearest to them"));
    }
    found.col(i) = search.state;
    out.missed.col(i) = search.missed;
    out.open.col(i) = search.open_inputs();
    inverses.push_back(search.J_inverse);
  }
  out.inputs = found.bottomRows(nu);
  const Posterior::Marginal marginal = posterior.marginal(view, found);
  for (Index i = 0; i < n; ++i) {
    search.J_inverse = inverses[static_cast<std::size_t>(i)];
    search.write_covariance(marginal.covariance.col(i).reshaped(d, d), out.covariance.col(i).reshaped(nu, nu));
  }
  return out;
}

// ---------------------------------------------------------------- one state at a time

InverseDynamicsSolver::InverseDynamicsSolver(const Posterior& posterior)
    : InverseDynamicsSolver(posterior, View::constrained_acceleration(*posterior.prior().system)) {}
InverseDynamicsSolver::InverseDynamicsSolver(const Posterior& posterior, const View& view)
    : InverseDynamicsSolver(posterior, view, Options()) {}
InverseDynamicsSolver::InverseDynamicsSolver(const Posterior& posterior, const View& view, Options options) {
  require_inputs_of(posterior, view);
  implementation_ = std::make_shared<const Implementation>(posterior, view, options);
}

const InverseDynamicsSolver::Implementation& InverseDynamicsSolver::implementation() const {
  return require_held(implementation_, "InverseDynamicsSolver");
}
const View& InverseDynamicsSolver::view() const { return implementation().predictor.view(); }
const InverseDynamicsSolver::Options& InverseDynamicsSolver::options() const { return implementation().options; }

InverseDynamicsSolver::Workspace::Workspace(const InverseDynamicsSolver& solver) {
  static_cast<void>(solver.implementation());  // it was not moved away
  implementation_ = std::make_unique<Implementation>(solver.implementation_);
}
InverseDynamicsSolver::Workspace::~Workspace() = default;
InverseDynamicsSolver::Workspace::Workspace(Workspace&&) noexcept = default;
InverseDynamicsSolver::Workspace& InverseDynamicsSolver::Workspace::operator=(Workspace&&) noexcept = default;

const VectorXd& InverseDynamicsSolver::Workspace::missed() const {
  return require_held(implementation_, "InverseDynamicsSolver::Workspace").missed;
}

InverseDynamicsSolver::Status InverseDynamicsSolver::inputs(const Ref<const VectorXd>& state,
                                                            const Ref<const VectorXd>& accelerations, Ref<VectorXd> inputs,
                                                            Workspace& workspace) const {
  const Implementation& self = implementation();
  if (!workspace.implementation_ || workspace.implementation_->solver.get() != &self) {
    throw InputError("InverseDynamicsSolver: the workspace is of another solver; use make_workspace() of this one");
  }
  require_size("InverseDynamicsSolver", "a state", state.size(), self.prior.system->layout().size());
  require_size("InverseDynamicsSolver", "the vector of accelerations", accelerations.size(), view().size());
  require_size("InverseDynamicsSolver", "the vector of inputs", inputs.size(), self.nu());
  Workspace::Implementation& search = *workspace.implementation_;
  const Status status = search.run(state, accelerations);
  if (status == Status::ok) {
    inputs = search.state.tail(self.nu());
  } else {
    inputs.setConstant(not_a_number);
  }
  return status;
}

InverseDynamicsSolver::Status InverseDynamicsSolver::inputs_and_covariance(const Ref<const VectorXd>& state,
                                                                           const Ref<const VectorXd>& accelerations,
                                                                           Ref<VectorXd> inputs, Ref<MatrixXd> covariance,
                                                                           Workspace& workspace) const {
  if (!options().covariance) throw InputError("InverseDynamicsSolver: it was made without covariances");
  require_size("InverseDynamicsSolver", "a column of the covariance", covariance.rows(), implementation().nu());
  require_size("InverseDynamicsSolver", "a row of the covariance", covariance.cols(), implementation().nu());
  const Status status = this->inputs(state, accelerations, inputs, workspace);
  if (status != Status::ok) {
    covariance.setConstant(not_a_number);
    return status;
  }
  Workspace::Implementation& search = *workspace.implementation_;
  // at the state that the search has just evaluated, so that there is a prediction
  static_cast<void>(implementation().predictor.mean_and_covariance(search.state, search.mean, search.covariance, search.memory));
  search.write_covariance(search.covariance, covariance);
  return status;
}

}  // namespace gp2
