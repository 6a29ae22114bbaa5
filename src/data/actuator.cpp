#include "gp2/actuator.hpp"

#include <algorithm>
#include <cmath>

namespace gp2 {

Actuator Actuator::direct(const std::string& input) {
  return {{input + ".delay", 0, std::nullopt}, {input + ".lag", 0, std::nullopt}};
}

std::pair<double, double> Actuator::bounds(const Parameter& parameter) {
  return parameter.bounds.value_or(std::pair(0.0, std::max(0.1, 2 * parameter.value)));
}

void set_values(const std::map<std::string, double>& values, std::vector<Actuator>& actuators) {
  for (Actuator& actuator : actuators) {
    for (Parameter* parameter : {&actuator.delay, &actuator.lag}) {
      if (const auto found = values.find(parameter->name); found != values.end()) parameter->value = found->second;
    }
  }
}

// v(s) = c(s) − m T + (v₀ − c₀ + m T) e^(−s/T), m the slope of c; written so that nothing large cancels where h ≪ T
double lagged(double v, double c0, double c1, double h, double lag) {
  if (lag == 0) return c1;
  if (h == 0) return v;
  const double forgotten = -std::expm1(-h / lag);
  return v + (c0 - v) * forgotten + (c1 - c0) * (1 - forgotten * lag / h);
}

}  // namespace gp2
