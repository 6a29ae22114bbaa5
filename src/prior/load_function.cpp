#include "prior/load_function.hpp"

#include <utility>

#include "gp2/mechanics/state_evaluator.hpp"
#include "mechanics/known_multipliers.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::MatrixXi;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

VectorXd parameters_of(const System& system, const StateFunction::Parameters& given) {
  return given.size() == 0 ? system.parameter_values() : VectorXd(given);
}

// ∂f/∂λ₀ v where f does not change with λ₀ is 0, whatever v
void add_product(double slope, double change, double& sum) {
  if (slope != 0) sum += slope * change;
}

}  // namespace

LoadFunction::LoadFunction(std::shared_ptr<const StateFunction> function, std::shared_ptr<const System> system, bool is_of_motion)
    : function_(std::move(function)),
      system_(std::move(system)),
      lambda0_reads_(system_->reads(SystemPart::mechanics)),
      is_of_motion_(is_of_motion) {
  const std::vector<bool> force = system_->reads(SystemPart::force);
  for (std::size_t k = 0; k < force.size(); ++k) lambda0_reads_[k] = lambda0_reads_[k] || force[k];
}

bool LoadFunction::reads(int state_index) const {
  return function_->reads(state_index) || lambda0_reads_[static_cast<std::size_t>(state_index)];
}

MatrixXd LoadFunction::evaluate(const States& states, const Parameters& parameters) const {
  return function_->evaluate(with_known_multipliers(*system_, states, parameters_of(*system_, parameters)), parameters);
}

MatrixXd LoadFunction::differentiate(const States& states, const Parameters& parameters, int index) const {
  using Quantity = KnownMultipliers::Quantity;
  const VectorXd theta = parameters_of(*system_, parameters);
  const SystemValues values = system_->evaluate(states, theta), d = system_->differentiate(states, theta, index);
  const std::unique_ptr<Evaluator> evaluator = function_->make_evaluator(parameters);
  const std::vector<StateDerivatives::Entry>& entries = evaluator->entries();
  const Index n_state = states.rows(), nq = system_->nq(), nc = system_->nc();
  MatrixXd x(n_state + nc, states.cols());
  x.topRows(n_state) = states;
  MatrixXd through_lambda0 = MatrixXd::Zero(size(), states.cols());
  VectorXd slopes(std::ssize(entries));
  KnownMultipliers lambda0;
  for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
    lambda0.compute(values.M(i), values.A(i), values.b(i), values.F(i), system_->largest_rank_of(values.A(i)));
    lambda0.start_derivatives(1);
    for (Index column = 0; column < nq; ++column) {
      for (Index row = 0; row < nq; ++row) lambda0.add_derivative(Quantity::mass, row, column, 0, d.M(i)(row, column));
      for (Index row = 0; row < nc; ++row)
        lambda0.add_derivative(Quantity::constraint_matrix, row, column, 0, d.A(i)(row, column));
      lambda0.add_derivative(Quantity::force, column, 0, 0, d.F(i)[column]);
    }
    for (Index row = 0; row < nc; ++row) lambda0.add_derivative(Quantity::constraint_vector, row, 0, 0, d.b(i)[row]);
    const MatrixXd& dlambda0 = lambda0.derivatives();
    x.col(i).tail(nc) = lambda0.values();
    evaluator->differentiate(x.col(i), slopes);
    for (std::size_t e = 0; e < entries.size(); ++e) {
      const Index row = entries[e].state_index - n_state;
      if (row >= 0) add_product(slopes[static_cast<Index>(e)], dlambda0(row, 0), through_lambda0(entries[e].output, i));
    }
  }
  return function_->differentiate(x, parameters, index) + through_lambda0;
}

// df/dx = ∂f/∂x + ∂f/∂λ₀ dλ₀/dx
class LoadFunction::ChainEvaluator final : public Evaluator {
 public:
  ChainEvaluator(const LoadFunction& of, const Parameters& parameters)
      : of_system_(*of.system_),
        n_state_(of.system_->layout().size()),
        function_(of.function_->make_evaluator(parameters)),
        system_(of.system_->make_evaluator(parameters_of(*of.system_, parameters), false)),
        system_and_derivatives_(of.system_->make_evaluator(parameters_of(*of.system_, parameters), true)),
        x_(n_state_ + of.system_->nc()),
        slopes_(std::ssize(function_->entries())) {
    MatrixXi depends = MatrixXi::Zero(of.size(), n_state_);
    for (const StateDerivatives::Entry& entry : function_->entries()) {
      if (entry.state_index < n_state_) depends(entry.output, entry.state_index) = 1;
      if (entry.state_index < n_state_) continue;
      for (Index k = 0; k < n_state_; ++k) {
        if (of.lambda0_reads_[static_cast<std::size_t>(k)]) depends(entry.output, k) = 1;
      }
    }
    position_.setConstant(of.size(), n_state_, -1);
    for (int k = 0; k < static_cast<int>(n_state_); ++k) {
      for (int output = 0; output < of.size(); ++output) {
        if (depends(output, k) == 0) continue;
        position_(output, k) = static_cast<int>(entries_.size());
        entries_.push_back({output, k});
      }
    }
    reserve(of.system_->nq(), of.system_->nc());
  }

  void evaluate(const Ref<const VectorXd>& state, Ref<VectorXd> values) override {
    take(state, *system_);
    function_->evaluate(x_, values);
  }
  [[nodiscard]] Tapes tapes() const override {
    Tapes tapes = function_->tapes();
    tapes.n_loads = static_cast<int>(x_.size() - n_state_);
    return tapes;
  }
  [[nodiscard]] const std::vector<StateDerivatives::Entry>& entries() const override { return entries_; }
  void differentiate(const Ref<const VectorXd>& state, Ref<VectorXd> derivatives) override {
    const StateEvaluator& at = *system_and_derivatives_;
    take(state, *system_and_derivatives_);
    lambda0_.start_derivatives(n_state_);
    for (std::size_t e = 0; e < at.derivatives().size(); ++e) {
      const auto [quantity, row, column, k] = at.derivatives()[e];
      lambda0_.add_derivative(quantity, row, column, k, at.derivative_values()[static_cast<Index>(e)]);
    }
    const MatrixXd& dlambda0 = lambda0_.derivatives();
    function_->differentiate(x_, slopes_);
    derivatives.setZero();
    for (std::size_t e = 0; e < function_->entries().size(); ++e) {
      const auto [output, k] = function_->entries()[e];
      const double slope = slopes_[static_cast<Index>(e)];
      if (k < n_state_) derivatives[position_(output, k)] += slope;
      for (Index j = 0; k >= n_state_ && j < n_state_; ++j) {
        if (position_(output, j) >= 0) add_product(slope, dlambda0(k - n_state_, j), derivatives[position_(output, j)]);
      }
    }
  }

 private:
  void take(const Ref<const VectorXd>& state, StateEvaluator& at) {
    at.evaluate(state);
    lambda0_.compute(at.M(), at.A(), at.b(), at.F(), of_system_.largest_rank_of(at.A()));
    x_.head(n_state_) = state;
    x_.tail(x_.size() - n_state_) = lambda0_.values();
  }

  // so that the first call allocates nothing: rows that are all the same have memory for redundant ones too
  void reserve(Index nq, Index nc) {
    lambda0_.compute(MatrixXd::Identity(nq, nq), MatrixXd::Ones(nc, nq), VectorXd::Zero(nc), VectorXd::Zero(nq));
    lambda0_.start_derivatives(n_state_);
    static_cast<void>(lambda0_.derivatives());
  }

  const System& of_system_;
  Index n_state_;
  std::unique_ptr<Evaluator> function_;
  std::unique_ptr<StateEvaluator> system_, system_and_derivatives_;
  KnownMultipliers lambda0_;
  VectorXd x_, slopes_;
  MatrixXi position_;  // of the derivative of each number in each entry of the state among entries_; −1: it vanishes
  std::vector<StateDerivatives::Entry> entries_;
};

std::unique_ptr<StateFunction::Evaluator> LoadFunction::make_evaluator(const Parameters& parameters) const {
  return std::make_unique<ChainEvaluator>(*this, parameters);
}

}  // namespace gp2
