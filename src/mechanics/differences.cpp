#include "mechanics/differences.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

const double relative_step = std::cbrt(std::numeric_limits<double>::epsilon());

// x stands first, then a pair for each entry that is moved
Index column_above(std::size_t m) { return 1 + 2 * static_cast<Index>(m); }

// over which a parameter of the value p changes what depends on it
double scale_of(const Parameter& parameter, double p) {
  const std::optional<std::pair<double, double>>& bounds = parameter.bounds;
  if (bounds && (bounds->first > 0 || bounds->second < 0) && p != 0) return std::abs(p);
  const double scale = std::max(std::abs(p), std::abs(parameter.value));
  if (scale > 0) return scale;
  const double widest = bounds ? std::max(std::abs(bounds->first), std::abs(bounds->second)) : 0;
  return widest > 0 ? widest : 1;
}

}  // namespace

StateDifferences::StateDifferences(std::vector<StateDerivatives::Entry> entries) : entries_(std::move(entries)) {
  for (const StateDerivatives::Entry& entry : entries_) {
    if (moved_.empty() || moved_.back() != entry.state_index) moved_.push_back(entry.state_index);
  }
}

const MatrixXd& StateDifferences::states_around(const Ref<const VectorXd>& state) {
  states_ = state.replicate(1, column_above(moved_.size()));
  for (std::size_t m = 0; m < moved_.size(); ++m) {
    // balances the truncation, h², against the rounding of x, which is at least that of 1
    const double rounding = std::numeric_limits<double>::epsilon() * std::max(1.0, std::abs(state[moved_[m]]));
    const double h = std::max(std::cbrt(rounding), rounding);
    states_(moved_[m], column_above(m)) += h;
    states_(moved_[m], column_above(m) + 1) -= h;
  }
  return states_;
}

void StateDifferences::differentiate(const Ref<const MatrixXd>& values, Ref<VectorXd> derivatives) const {
  std::size_t m = 0;
  Index out = 0;
  for (const StateDerivatives::Entry& entry : entries_) {
    while (moved_[m] != entry.state_index) ++m;
    const Index above = column_above(m);
    // the step as rounded
    const double step = states_(moved_[m], above) - states_(moved_[m], above + 1);
    derivatives[out++] = (values(entry.output, above) - values(entry.output, above + 1)) / step;
  }
}

ParameterStep::ParameterStep(const Parameter& parameter, double p) {
  double h = relative_step * scale_of(parameter, p);
  h = (p + h) - p;  // as rounded
  const auto allowed = [&](double value) {
    return !parameter.bounds || (parameter.bounds->first <= value && value <= parameter.bounds->second);
  };
  const bool above = allowed(p + h), below = allowed(p - h);
  if (above == below) {
    terms_ = {{p + h, 1 / (2 * h)}, {p - h, -1 / (2 * h)}};
    return;
  }
  // (−3 f(p) + 4 f(p + h) − f(p + 2h)) / 2h
  if (below) h = -h;
  terms_ = {{p, -3 / (2 * h)}, {p + h, 2 / h}, {p + 2 * h, -1 / (2 * h)}};
}

SystemValues difference_in_parameter(const System& system, const Ref<const MatrixXd>& states,
                                     const Ref<const VectorXd>& parameters, int index) {
  SystemValues sum;
  const ParameterStep step(system.parameters()[static_cast<std::size_t>(index)], parameters[index]);
  for (const auto& [value, weight] : step.terms()) {
    VectorXd moved = parameters;
    moved[index] = value;
    const SystemValues there = system.evaluate(states, moved);
    const auto add = [weight = weight](MatrixXd& to, const MatrixXd& values) {
      if (to.size() == 0) to.setZero(values.rows(), values.cols());
      to += weight * values;
    };
    add(sum.mass, there.mass);
    add(sum.constraint_matrix, there.constraint_matrix);
    add(sum.constraint_vector, there.constraint_vector);
    add(sum.force, there.force);
  }
  return sum;
}

std::vector<bool> marks_of(const std::optional<std::vector<std::string>>& read, const char* what, const System& system) {
  const std::vector<std::string> names = system.state_names();
  if (!read) return std::vector<bool>(names.size(), true);
  std::vector<bool> marks(names.size(), false);
  for (const std::string& name : *read) {
    const auto found = std::find(names.begin(), names.end(), name);
    if (found == names.end()) {
      throw InputError(fmt::format("system '{}': {}: '{}' is no entry of the state, which has {}", system.name(), what, name,
                                   fmt::join(names, ", ")));
    }
    marks[static_cast<std::size_t>(found - names.begin())] = true;
  }
  return marks;
}

bool is_known(const Ref<const VectorXd>& state, const std::vector<bool>& reads) {
  for (Index k = 0; k < state.size(); ++k) {
    if (reads[static_cast<std::size_t>(k)] && !std::isfinite(state[k])) return false;
  }
  return true;
}

}  // namespace gp2
