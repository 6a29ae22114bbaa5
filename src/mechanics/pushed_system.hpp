#pragma once

#include <memory>
#include <utility>

#include "gp2/system.hpp"

namespace gp2 {

/// A system under A ddq = b + push.
class PushedSystem final : public System {
 public:
  /// @param push  (nc), 0 of rows that are not there
  PushedSystem(std::shared_ptr<const System> system, Eigen::VectorXd push)
      : System(system->name(), system->coordinates(), system->inputs(), system->parameters(), system->constraint_labels(),
               system->constraint_noise(), system->constraint_conditions()),
        system_(std::move(system)),
        push_(std::move(push)) {}

  [[nodiscard]] SystemValues evaluate(const Eigen::Ref<const Eigen::MatrixXd>& states,
                                      const Eigen::Ref<const Eigen::VectorXd>& parameters) const override {
    SystemValues values = system_->evaluate(states, parameters);
    values.constraint_vector.colwise() += push_;
    return values;
  }
  [[nodiscard]] SystemValues differentiate(const Eigen::Ref<const Eigen::MatrixXd>& states,
                                           const Eigen::Ref<const Eigen::VectorXd>& parameters, int index) const override {
    return system_->differentiate(states, parameters, index);
  }
  [[nodiscard]] Eigen::MatrixXd residuals(const Eigen::Ref<const Eigen::MatrixXd>& states,
                                          const Eigen::Ref<const Eigen::VectorXd>& parameters) const override {
    return system_->residuals(states, parameters);
  }
  [[nodiscard]] const std::vector<Residual>& residual_labels() const override { return system_->residual_labels(); }
  [[nodiscard]] std::vector<bool> reads(SystemPart part) const override { return system_->reads(part); }
  [[nodiscard]] bool depends_on_parameter(int index) const override { return system_->depends_on_parameter(index); }
  [[nodiscard]] int largest_rank() const override { return system_->largest_rank(); }

 private:
  std::shared_ptr<const System> system_;
  Eigen::VectorXd push_;
};

}  // namespace gp2
