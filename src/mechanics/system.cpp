#include "gp2/system.hpp"

#include <algorithm>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"

namespace gp2 {

System::System(std::string name, std::vector<Coordinate> coordinates, std::vector<std::string> inputs,
               std::vector<Parameter> parameters, std::vector<std::string> constraint_labels, Eigen::VectorXd constraint_noise,
               std::vector<std::string> constraint_conditions)
    : name_(std::move(name)),
      coordinates_(std::move(coordinates)),
      inputs_(std::move(inputs)),
      parameters_(std::move(parameters)),
      constraint_labels_(std::move(constraint_labels)),
      constraint_noise_(std::move(constraint_noise)),
      constraint_conditions_(std::move(constraint_conditions)) {
  constraint_conditions_.resize(constraint_labels_.size());
  if (constraint_noise_.size() == 0) constraint_noise_.setZero(nc());
  if (constraint_noise_.size() != nc() || !(constraint_noise_.array() >= 0).all() || !constraint_noise_.allFinite()) {
    throw InputError(fmt::format("'{}': constraint_noise must hold {} finite numbers ≥ 0, one per constraint", name_, nc()));
  }
}

bool System::has_conditional_constraints() const {
  return std::any_of(constraint_conditions_.begin(), constraint_conditions_.end(), [](const auto& one) { return !one.empty(); });
}

int System::largest_rank_of(const Eigen::Ref<const Eigen::MatrixXd>& A) const {
  int rank = largest_rank();
  if (rank == nc()) return rank;
  for (int row = 0; row < nc(); ++row) rank -= is_conditional(row) && A.row(row).isZero(0) ? 1 : 0;
  return rank;
}

std::vector<std::string> System::state_names() const {
  std::vector<std::string> names;
  for (const Coordinate& coordinate : coordinates_) names.push_back(coordinate.name);
  for (const Coordinate& coordinate : coordinates_) names.push_back(coordinate.velocity());
  names.emplace_back("t");
  names.insert(names.end(), inputs_.begin(), inputs_.end());
  return names;
}

std::vector<std::string> System::acceleration_names() const {
  std::vector<std::string> names;
  for (const Coordinate& coordinate : coordinates_) names.push_back(coordinate.acceleration());
  return names;
}

Eigen::VectorXd System::parameter_values() const {
  Eigen::VectorXd values(static_cast<Eigen::Index>(parameters_.size()));
  for (Eigen::Index k = 0; k < values.size(); ++k) values[k] = parameters_[static_cast<std::size_t>(k)].value;
  return values;
}

void System::require_states(const Eigen::Ref<const Eigen::MatrixXd>& states) const {
  if (states.rows() == layout().size()) return;
  throw InputError(fmt::format("states: a column is a state of '{}' and must have {} rows, {} (StateLayout), got {}", name_,
                               layout().size(), fmt::join(state_names(), ", "), states.rows()));
}

void System::require_parameters(const Eigen::Ref<const Eigen::VectorXd>& parameters) const {
  if (parameters.size() == static_cast<Eigen::Index>(parameters_.size())) return;
  throw InputError(fmt::format("parameters: there must be a number for each of the {} of '{}', got {}", parameters_.size(), name_,
                               parameters.size()));
}

void System::require_parameter(int index) const {
  const int n = static_cast<int>(parameters_.size());
  if (index >= 0 && index < n) return;
  throw InputError(fmt::format("'{}' has {} parameters, numbered from 0, got the number {}", name_, n, index));
}

int System::parameter_index(const std::string& name) const {
  for (std::size_t k = 0; k < parameters_.size(); ++k) {
    if (parameters_[k].name == name) return static_cast<int>(k);
  }
  return -1;
}

}  // namespace gp2
