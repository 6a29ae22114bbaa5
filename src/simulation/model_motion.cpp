#include "gp2/simulation/model_motion.hpp"

#include <fmt/format.h>

#include "base/shape.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/quantity.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/view.hpp"
#include "mechanics/describe_fault.hpp"
#include "mechanics/known_multipliers.hpp"
#include "mechanics/multiplier_solver.hpp"
#include "mechanics/pushed_system.hpp"
#include "prior/make_prior.hpp"

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

Eigen::Index n_soft_rows(const System& system) { return (system.constraint_noise().array() > 0).count(); }

}  // namespace

void require_truth(const Model& model) {
  if (model.truth.empty()) {
    throw InputError(
        fmt::format("{}: missing [truth] acceleration = [ … ]: what is added to M⁻¹ force, \"0\" where nothing is", model.name));
  }
}

ModelMotion::ModelMotion(const Model& model) : system_(model.system) {
  require_system(system_);
  parameters_ = system_->parameter_values();
  std::vector<Expression> all = model.truth;
  all.insert(all.end(), model.truth_force.begin(), model.truth_force.end());
  const Multipliers load = multipliers_in(all, *system_);
  const std::vector<Expression> inputs = model.symbols().state_and_parameters(load.variables);
  truth_ = Tape(model.truth, inputs);
  truth_force_ = Tape(model.truth_force, inputs);
  if (load.variables.empty()) return;
  load_ = load.are_of_motion ? Load::of_motion : Load::known;
  if (load_ == Load::known) return;
  const int n_states = system_->layout().size() + system_->nc();
  truth_slopes_ = StateDerivatives(model.truth, inputs, n_states);
  truth_force_slopes_ = StateDerivatives(model.truth_force, inputs, n_states);
}

ModelMotion ModelMotion::pushed(const VectorXd& push) const {
  require_shape("ModelMotion::pushed: push", push, system_->nc(), 1);
  ModelMotion motion = *this;
  motion.system_ = std::make_shared<const PushedSystem>(system_, push);
  return motion;
}

// [states; λ]
MatrixXd ModelMotion::with_load(const Eigen::Ref<const MatrixXd>& states, const MechanicsBatch& mechanics, const MatrixXd& slip,
                                Eigen::Index first) const {
  const Eigen::Index n_state = states.rows(), nq = system_->nq(), nc = system_->nc();
  const ViewValues multipliers = evaluate_view(View::multipliers(*system_), mechanics, states);
  MatrixXd x(n_state + nc, states.cols());
  x.topRows(n_state) = states;
  MultiplierSolver solver;
  for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
    const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
    VectorXd at = x.col(i);
    // what of a truth, or of its change with λ, tapes give at this state
    const auto values = [&](const Tape& tape, Eigen::Index n) {
      MatrixXd out = MatrixXd::Zero(n, 1);
      if (tape.n_outputs() > 0) tape.evaluate(at, parameters_, out);
      return out;
    };
    const auto slopes = [&](const StateDerivatives& of) {
      const MatrixXd derivatives = values(of.tape, 0);
      MatrixXd slope = MatrixXd::Zero(nq, nc);
      for (std::size_t e = 0; e < of.entries.size(); ++e) {
        const Eigen::Index row = of.entries[e].state_index - n_state;
        if (row >= 0) slope(of.entries[e].output, row) = derivatives(static_cast<Eigen::Index>(e), 0);
      }
      return slope;
    };
    const auto motion = [&](const VectorXd& lambda, VectorXd& a_bar, MatrixXd& slope) {
      at.tail(nc) = lambda;
      a_bar = projection.solve_mass(mechanics.values.F(i) + values(truth_force_, nq)) + values(truth_, nq);
      slope = projection.solve_mass(slopes(truth_force_slopes_)) + slopes(truth_slopes_);
    };
    VectorXd d = multipliers.offset.col(i);
    if (slip.size() > 0) d += multipliers.N(i) * slip.col(i);
    if (!solver.solve(multipliers.G(i), d, motion)) {
      throw InputError(internal::describe_fault(*system_, states, solver.fault(i), first));
    }
    x.col(i).tail(nc) = solver.lambda();
  }
  return x;
}

MatrixXd ModelMotion::unconstrained(const Eigen::Ref<const MatrixXd>& states, const MechanicsBatch& mechanics,
                                    const MatrixXd& slip, Eigen::Index first) const {
  MatrixXd truth = MatrixXd::Zero(system_->nq(), states.cols()), truth_force = truth;
  const auto evaluate = [&](const Eigen::Ref<const MatrixXd>& x) {
    if (truth_.n_outputs() > 0) truth_.evaluate(x, parameters_, truth);
    if (truth_force_.n_outputs() > 0) truth_force_.evaluate(x, parameters_, truth_force);
  };
  switch (load_) {
    case Load::none:
      evaluate(states);
      break;
    case Load::known:
      evaluate(with_known_multipliers(*system_, states, parameters_));
      break;
    case Load::of_motion:
      evaluate(with_load(states, mechanics, slip, first));
      break;
  }
  MatrixXd accelerations(system_->nq(), states.cols());
  for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
    const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
    if (projection.mass_is_singular() && !truth.col(i).isZero(0)) {
      MechanicsBatch::Fault fault{i, {}};
      fault.text =
          "the mass matrix M is singular, so that [truth] acceleration cannot be added to M⁻¹F: write it as [truth] force";
      throw InputError(internal::describe_fault(*system_, states, fault, first));
    }
    accelerations.col(i) = projection.solve_mass(mechanics.values.F(i) + truth_force.col(i)) + truth.col(i);
  }
  return accelerations;
}

MatrixXd ModelMotion::unconstrained_acceleration(const Eigen::Ref<const MatrixXd>& states) const {
  return unconstrained(states, require_mechanics(*system_, states, parameters_));
}

MatrixXd ModelMotion::acceleration(const Eigen::Ref<const MatrixXd>& states, const MatrixXd& slip) const {
  if (slip.size() > 0) require_shape("ModelMotion::acceleration: slip", slip, n_soft_rows(*system_), states.cols());
  MatrixXd accelerations(system_->nq(), states.cols());
  const auto fault = for_each_mechanics(
      *system_, states, parameters_, /*n_threads=*/1, [&](Eigen::Index first, const MechanicsBatch& mechanics) {
        const Eigen::Index n = mechanics.values.n_states();
        const auto some = states.middleCols(first, n);
        const MatrixXd slips = slip.size() > 0 ? slip.middleCols(first, n) : MatrixXd();
        const MatrixXd free = unconstrained(some, mechanics, slips, first);
        for (Eigen::Index i = 0; i < n; ++i) {
          accelerations.col(first + i) = mechanics.projections[static_cast<std::size_t>(i)].constrain(free.col(i));
        }
        if (slips.size() == 0) return;
        const ViewValues view = evaluate_view(View::constrained_acceleration(*system_), mechanics, some);
        for (int i = 0; i < static_cast<int>(n); ++i) accelerations.col(first + i) += view.N(i) * slips.col(i);
      });
  if (fault) throw InputError(internal::describe_fault(*system_, states, *fault));
  return accelerations;
}

MatrixXd ModelMotion::multipliers(const Eigen::Ref<const MatrixXd>& states) const {
  const MechanicsBatch mechanics = require_mechanics(*system_, states, parameters_);
  const MatrixXd a_bar = unconstrained(states, mechanics);
  MatrixXd multipliers(system_->nc(), states.cols());
  QuantityKind::Workspace workspace;
  for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
    const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
    const Eigen::VectorXd ddq = projection.constrain(a_bar.col(i)), free = a_bar.col(i),
                          force = mechanics.values.M(i) * ddq - projection.mass() * free;
    Quantity::multipliers->evaluate({projection, mechanics.values.A(i)},
                                    {columns_of(ddq), columns_of(free), columns_of(force), columns_of(free)}, multipliers.col(i),
                                    workspace);
  }
  return multipliers;
}

MatrixXd true_acceleration(const Model& model, const Eigen::Ref<const MatrixXd>& states, const MatrixXd& slip) {
  require_truth(model);
  if (slip.size() > 0) {
    require_shape("true_acceleration: slip", slip, n_soft_rows(*model.system), states.cols());
  }
  MatrixXd accelerations = ModelMotion(model).acceleration(states, slip);
  for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
    if (!accelerations.col(i).allFinite()) {
      throw InputError(fmt::format("{}: the true acceleration is not a finite number at sample {}", model.name, i + 1));
    }
  }
  return accelerations;
}

}  // namespace gp2
