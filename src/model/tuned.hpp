#pragma once

#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "gp2/system.hpp"
#include "model/toml_value.hpp"

namespace gp2 {

/// A number that a fit may adjust, or several that go together, as the file states it: alone, or as a table.
struct Tuned {
  using Bounds = std::optional<std::pair<double, double>>;
  std::optional<TomlValue> value;  // none: not given
  Bounds bounds = std::nullopt;
  std::optional<bool> estimate = std::nullopt;
  std::optional<Parameter::Belief> prior = std::nullopt;
};

/// @param keys  that its table may have; "initial", where it is among them, is another word for "value", bounds may be equal and
///   priors are of logarithms
/// @param has_one_range  of bounds; else the caller reads them
Tuned read_tuned(const TomlValue& entry, const std::vector<std::string>& keys, bool has_one_range = true);

/// Complains of a value outside its bounds.
void require_within(double value, const Tuned::Bounds& bounds, const TomlValue& at);

}  // namespace gp2
