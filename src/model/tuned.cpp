#include "model/tuned.hpp"

#include <algorithm>
#include <array>

#include <fmt/format.h>

namespace gp2 {

namespace {

// { mean = 2, stddev = 0.1 } of a parameter, or { median = 2, log_stddev = 0.1 } of one that is positive
Parameter::Belief read_belief(const TomlValue& entry, bool normal_too) {
  Parameter::Belief out;
  out.of_logarithm = !entry.has("mean") || !normal_too;
  const std::array<const char*, 2> keys = {out.of_logarithm ? "median" : "mean", out.of_logarithm ? "log_stddev" : "stddev"};
  entry.only_keys({keys[0], keys[1]});
  for (const char* name : keys) {
    if (entry.has(name)) continue;
    entry.fail(fmt::format("missing {}; write {}{{ median = 2.0, log_stddev = 0.1 }}, the second of its logarithm", name,
                           normal_too ? "{ mean = 2.0, stddev = 0.1 }, or, of a positive one, " : ""));
  }
  out.median = entry.get(keys[0])->number();
  out.stddev = entry.get(keys[1])->number();
  if (!(out.stddev > 0)) entry.fail(fmt::format("{} must be positive, got {}", keys[1], out.stddev));
  if (out.of_logarithm && !(out.median > 0)) entry.fail(fmt::format("median must be positive, got {}", out.median));
  return out;
}

}  // namespace

Tuned read_tuned(const TomlValue& entry, const std::vector<std::string>& keys, bool has_one_range) {
  if (!entry.is_table()) return {entry};
  entry.only_keys(keys);
  const bool is_positive = std::find(keys.begin(), keys.end(), "initial") != keys.end();
  Tuned out;
  for (const char* word : {"value", "initial"}) {
    const std::optional<TomlValue> value = entry.get(word);
    if (value && out.value) entry.fail("value and initial are two words for one number: leave out one");
    if (value) out.value = value;
  }
  if (const auto bounds = entry.get("bounds"); bounds && has_one_range) out.bounds = bounds->range(is_positive);
  if (const auto estimate = entry.get("estimate")) out.estimate = estimate->boolean();
  if (out.bounds && out.bounds->first == out.bounds->second && out.estimate.value_or(false)) {
    entry.fail(fmt::format("its bounds [{0}, {0}] hold it: widen them, or leave out estimate = true", out.bounds->first));
  }
  if (const auto prior = entry.get("prior")) out.prior = read_belief(*prior, !is_positive);
  return out;
}

void require_within(double value, const Tuned::Bounds& bounds, const TomlValue& at) {
  if (!bounds || (value >= bounds->first && value <= bounds->second)) return;
  at.fail(fmt::format("the value {} is outside its bounds [{}, {}]", value, bounds->first, bounds->second));
}

}  // namespace gp2
