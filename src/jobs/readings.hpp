#pragma once

#include <memory>
#include <vector>

#include <Eigen/Core>

#include "gp2/model.hpp"

namespace gp2 {

/// The system that a log was taken on, as its observations see it.
struct LoggedSystem {
  const Model& model;
  std::shared_ptr<const Model> other;               // null: the model that is fitted
  std::shared_ptr<const OtherSystem> other_system;  // null: the system that is fitted
  const Prior& prior;
  Eigen::VectorXd parameters;
  std::vector<Actuator> actuators;  // of its inputs; `estimate` says what this fit estimates

  [[nodiscard]] const System& system() const { return *prior.system; }
};

/// The rows of a log before their noise is known.
struct Readings {
  View view;
  Eigen::MatrixXd states;         // (layout size × N)
  Eigen::MatrixXd values;         // (d × N), NaN where not measured
  Eigen::MatrixXd stated_stddev;  // (d × N), NaN where not stated; empty where the log states none

  [[nodiscard]] bool states_noise() const { return stated_stddev.size() > 0; }
  [[nodiscard]] bool states_noise(Eigen::Index k) const { return states_noise() && !stated_stddev.row(k).array().isNaN().all(); }

  /// Leaves these rows, in this order.
  void keep(const std::vector<int>& rows) {
    states = Eigen::MatrixXd(states(Eigen::all, rows));
    values = Eigen::MatrixXd(values(Eigen::all, rows));
    if (states_noise()) stated_stddev = Eigen::MatrixXd(stated_stddev(Eigen::all, rows));
  }
};

}  // namespace gp2
