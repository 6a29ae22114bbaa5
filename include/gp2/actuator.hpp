#pragma once

#include <map>
#include <string>
#include <utility>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/system.hpp"

namespace gp2 GP2_API {

/// What acts where an input c(t) is commanded: v, which follows it by a delay τ and a lag T of first order,
///
///     T dv/dt + v = c(t − τ).
///
/// The input of a state, which M⁻¹F, b, features and directions read, is v.
struct Actuator {
  static constexpr double memory = 5;  // lags after which what was before is forgotten, to 0.7 %

  Parameter delay;  // τ ≥ 0 [s], called u.delay
  Parameter lag;    // T ≥ 0 [s], called u.lag

  /// That of an input without delay and lag.
  static Actuator direct(const std::string& input);

  /// Bounds of an estimate of one of the two: its own, else [0, 0.1] or up to twice its value.
  static std::pair<double, double> bounds(const Parameter& parameter);
  /// The largest values that they may have, estimated or not: how late the input may be.
  [[nodiscard]] double largest_delay() const { return largest(delay); }
  [[nodiscard]] double largest_lag() const { return largest(lag); }

  /// Whether the command itself acts.
  [[nodiscard]] bool is_direct() const { return delay.value == 0 && lag.value == 0; }
  [[nodiscard]] bool is_estimated() const { return delay.estimate || lag.estimate; }
  /// For how long at most what acts depends on earlier commands [s].
  [[nodiscard]] double reach() const { return largest_delay() + memory * largest_lag(); }

 private:
  static double largest(const Parameter& one) { return one.estimate ? bounds(one).second : one.value; }
};

/// Delays and lags that have another value from now on, by name; other names are of no meaning here.
void set_values(const std::map<std::string, double>& values, std::vector<Actuator>& actuators);

/// v after a time h in which the delayed command goes evenly from c0 to c1: v is exact, with a lag of 0 too. What a controller steps
/// with to know what acts, c0 and c1 being what it commanded τ ago.
/// @param v  at the start
double lagged(double v, double c0, double c1, double h, double lag);

}  // namespace gp2
