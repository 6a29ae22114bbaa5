#pragma once

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "gp2/prior/latent_spec.hpp"

namespace gp2 {

/// A StateFunction given by code.
class CodeFunction final : public StateFunction {
 public:
  /// @param what  stands for it in messages: latent 'contact': features
  /// @param size  how many numbers it gives
  /// @throws InputError when a name that is read is none of the state.
  CodeFunction(StateCode code, std::string what, int size, std::shared_ptr<const System> system);

  [[nodiscard]] int size() const override { return size_; }
  /// @throws InputError naming what was expected and what the code returned.
  [[nodiscard]] Eigen::MatrixXd evaluate(const States& states, const Parameters& parameters) const override;
  [[nodiscard]] Eigen::MatrixXd differentiate(const States& states, const Parameters& parameters, int index) const override;
  [[nodiscard]] bool reads(int state_index) const override { return reads_[static_cast<std::size_t>(state_index)]; }
  /// Whether what it gives a state depends on the others, as a text; nothing if not.
  [[nodiscard]] std::optional<std::string> mixed_states_text(const States& states, const Parameters& parameters) const;
  [[nodiscard]] std::unique_ptr<Evaluator> make_evaluator(const Parameters& parameters) const override;

 private:
  class DifferenceEvaluator;
  [[nodiscard]] Eigen::MatrixXd checked(Eigen::MatrixXd values, const char* of, const States& states, bool must_be_finite) const;

  StateCode code_;
  std::string what_;
  int size_;
  std::shared_ptr<const System> system_;
  std::vector<bool> reads_;
};

/// The same of the latents' features and directions, as far as they are code.
std::optional<std::string> mixed_states_text(const Prior& prior, const StateFunction::States& states,
                                             const StateFunction::Parameters& parameters);

}  // namespace gp2
