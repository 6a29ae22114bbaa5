#include "gp2/mechanics/state_evaluator.hpp"

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "mechanics/differences.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Derivative = StateEvaluator::Derivative;
using Part = StateEvaluator::Quantity;

namespace {

// of the numbers of M, A, b, F, each column-major, the one at `index`
Derivative derivative_of(int index, int nq, int nc, int state_index) {
  if (index < nq * nq) return {Part::mass, index % nq, index / nq, state_index};
  index -= nq * nq;
  if (index < nc * nq) return {Part::constraint_matrix, index % nc, index / nc, state_index};
  index -= nc * nq;
  if (index < nc) return {Part::constraint_vector, index, 0, state_index};
  return {Part::force, index - nc, 0, state_index};
}

}  // namespace

StateEvaluator::StateEvaluator(const System& system, const Ref<const VectorXd>& parameters,
                               std::span<const StateDerivatives::Entry> entries)
    : nq_(system.nq()), nc_(system.nc()), n_state_(system.layout().size()) {
  if (parameters.size() != static_cast<Index>(system.parameters().size())) {
    throw InputError(fmt::format("make_evaluator: '{}' has {} parameters, got {}", system.name(), system.parameters().size(),
                                 parameters.size()));
  }
  for (const StateDerivatives::Entry& entry : entries) {
    derivatives_.push_back(derivative_of(entry.output, system.nq(), system.nc(), entry.state_index));
  }
  values_.setZero(n_values() + static_cast<Index>(entries.size()));
}

void StateEvaluator::evaluate(const Ref<const VectorXd>& state) {
  if (state.size() != n_state_) {
    throw InputError(fmt::format("StateEvaluator: a state has {} entries, got {}", n_state_, state.size()));
  }
  evaluate_all(state);
}

namespace {

// the numbers of a state that may depend on x_k, as System::reads has it
std::vector<StateDerivatives::Entry> entries_of(const System& system) {
  const int nq = system.nq();
  const int n_mechanics = nq * (nq + system.nc()) + system.nc();
  const std::vector<bool> mechanics = system.reads(SystemPart::mechanics), force = system.reads(SystemPart::force);
  std::vector<StateDerivatives::Entry> entries;
  for (int k = 0; k < system.layout().size(); ++k) {
    const int first = mechanics[static_cast<std::size_t>(k)] ? 0 : n_mechanics;
    const int last = force[static_cast<std::size_t>(k)] ? n_mechanics + nq : n_mechanics;
    for (int i = first; i < last; ++i) entries.push_back({i, k});
  }
  return entries;
}

// of a System that has only batches: all states of the differences in one
class DifferenceEvaluator final : public StateEvaluator {
 public:
  DifferenceEvaluator(const System& system, const Ref<const VectorXd>& parameters, bool derivatives)
      : DifferenceEvaluator(system, parameters, derivatives ? entries_of(system) : std::vector<StateDerivatives::Entry>()) {}

 private:
  DifferenceEvaluator(const System& system, const Ref<const VectorXd>& parameters,
                      const std::vector<StateDerivatives::Entry>& entries)
      : StateEvaluator(system, parameters, entries), system_(system), parameters_(parameters), differences_(entries) {}

  void evaluate_all(const Ref<const VectorXd>& state) override {
    const MatrixXd& states = differences_.states_around(state);
    system_.evaluate_into(states, parameters_, batch_);
    values_.resize(n_values(), states.cols());
    values_ << batch_.mass, batch_.constraint_matrix, batch_.constraint_vector, batch_.force;
    all_values().head(n_values()) = values_.col(0);
    differences_.differentiate(values_, all_values().tail(all_values().size() - n_values()));
  }

  const System& system_;
  VectorXd parameters_;
  StateDifferences differences_;
  MatrixXd values_;
  SystemValues batch_;
};

}  // namespace

std::unique_ptr<StateEvaluator> System::make_evaluator(const Ref<const VectorXd>& parameters, bool derivatives) const {
  return std::make_unique<DifferenceEvaluator>(*this, parameters, derivatives);
}

void System::evaluate_into(const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters, SystemValues& values) const {
  values = evaluate(states, parameters);
}

}  // namespace gp2
