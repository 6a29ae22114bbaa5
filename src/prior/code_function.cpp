#include "prior/code_function.hpp"

#include <utility>

#include <fmt/format.h>

#include "base/mixed_states.hpp"
#include "gp2/error.hpp"
#include "mechanics/differences.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

CodeFunction::CodeFunction(StateCode code, std::string what, int size, std::shared_ptr<const System> system)
    : code_(std::move(code)),
      what_(std::move(what)),
      size_(size),
      system_(std::move(system)),
      reads_(marks_of(code_.reads, what_.c_str(), *system_)) {}

MatrixXd CodeFunction::checked(MatrixXd values, const char* of, const States& states, bool must_be_finite) const {
  if (values.rows() != size_ || values.cols() != states.cols()) {
    throw InputError(fmt::format("{}: {} returned the shape {} × {}, expected {} × {} for {} states", what_, of, values.rows(),
                                 values.cols(), size_, states.cols(), states.cols()));
  }
  for (Index i = 0; must_be_finite && i < states.cols(); ++i) {
    if (values.col(i).allFinite() || !is_known(states.col(i), reads_)) continue;
    throw InputError(fmt::format("{}: {} returned a number that is not finite at state {}, where all that is read is finite",
                                 what_, of, i + 1));
  }
  return values;
}

MatrixXd CodeFunction::evaluate(const States& states, const Parameters& parameters) const {
  // at other parameters a fit may be on the way through: the likelihood is +∞ there
  const bool own = parameters.size() == 0 || parameters == system_->parameter_values();
  return checked(code_.evaluate(states, parameters), "evaluate", states, own);
}

MatrixXd CodeFunction::differentiate(const States& states, const Parameters& parameters, int index) const {
  if (code_.differentiate) return checked(code_.differentiate(states, parameters, index), "differentiate", states, true);
  MatrixXd sum = MatrixXd::Zero(size_, states.cols());
  const Parameter& parameter = system_->parameters()[static_cast<std::size_t>(index)];
  const ParameterStep step(parameter, parameters[index]);
  for (const auto& [value, weight] : step.terms()) {
    VectorXd moved = parameters;
    moved[index] = value;
    sum += weight * evaluate(states, moved);
  }
  return checked(std::move(sum), "the difference of evaluate", states, true);
}

std::optional<std::string> CodeFunction::mixed_states_text(const States& states, const Parameters& parameters) const {
  return gp2::mixed_states_text(
      what_, [&](const MatrixXd& some) { return std::vector<MatrixXd>{evaluate(some, parameters)}; }, states);
}

std::optional<std::string> mixed_states_text(const Prior& prior, const StateFunction::States& states,
                                             const StateFunction::Parameters& parameters) {
  for (const Latent& latent : prior.latents) {
    const auto* const features = dynamic_cast<const CodeFunction*>(latent.features.get());
    const auto* const directions = dynamic_cast<const CodeFunction*>(latent.directions.get());
    std::optional<std::string> text;
    if (features != nullptr) text = features->mixed_states_text(states, VectorXd());
    if (!text && directions != nullptr) text = directions->mixed_states_text(states, parameters);
    if (text) return text;
  }
  return std::nullopt;
}

class CodeFunction::DifferenceEvaluator final : public Evaluator {
 public:
  DifferenceEvaluator(const CodeFunction& function, VectorXd parameters, std::vector<StateDerivatives::Entry> entries)
      : function_(function), parameters_(std::move(parameters)), differences_(std::move(entries)) {}

  void evaluate(const Ref<const VectorXd>& state, Ref<VectorXd> values) override { values = values_at(state); }
  [[nodiscard]] const std::vector<StateDerivatives::Entry>& entries() const override { return differences_.entries(); }
  void differentiate(const Ref<const VectorXd>& state, Ref<VectorXd> derivatives) override {
    differences_.differentiate(values_at(differences_.states_around(state)), derivatives);
  }

 private:
  // A state may have no prediction, of which a control loop is told by a Status.
  [[nodiscard]] MatrixXd values_at(const MatrixXd& states) const {
    return function_.checked(function_.code_.evaluate(states, parameters_), "evaluate", states, /*must_be_finite=*/false);
  }

  const CodeFunction& function_;
  VectorXd parameters_;
  StateDifferences differences_;
};

std::unique_ptr<StateFunction::Evaluator> CodeFunction::make_evaluator(const Parameters& parameters) const {
  std::vector<StateDerivatives::Entry> entries;
  for (int k = 0; k < system_->layout().size(); ++k) {
    for (int i = 0; reads(k) && i < size_; ++i) entries.push_back({i, k});
  }
  return std::make_unique<DifferenceEvaluator>(*this, parameters, std::move(entries));
}

}  // namespace gp2
