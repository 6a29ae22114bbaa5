#include <algorithm>
#include <set>
#include <tuple>
#include <utility>

#include <fmt/format.h>

#include "base/suggestion.hpp"
#include "gp2/error.hpp"
#include "model/table_readers.hpp"
#include "model/tuned.hpp"
#include "prior/gradient_columns.hpp"
#include "prior/make_prior.hpp"

// [[latent]]

namespace gp2 {

namespace {

// ---------------------------------------------------------------- what code gives

// { code = [names] }: one name for each number or column that code gives
std::vector<std::string> names_of_code(const TomlValue& node) {
  node.only_keys({"code"});
  const std::optional<TomlValue> code = node.get("code");
  if (!code) node.fail(R"(expected { code = ["name", …] })");
  std::vector<std::string> names;
  for (const TomlValue& name : code->array()) names.push_back(name.text());
  return names;
}

StateCode code_of(const ModelReader& reader, const TomlValue& at, const std::string& latent,
                  StateCode ModelCode::OfLatent::*part) {
  const auto& latents = reader.model.code.latents;
  const auto found = latents.find(latent);
  if (found != latents.end() && found->second.*part) return found->second.*part;
  at.fail(fmt::format("those of '{}' are code, and none is given: read the file where that code is", latent));
}

// what code gives, the file must leave to it
void require_all_code_is_used(const Model& model) {
  for (const auto& [name, code] : model.code.latents) {
    const auto found = std::find_if(model.latents.begin(), model.latents.end(),
                                    [&name = name](const LatentSpec& one) { return one.name == name; });
    if (found == model.latents.end()) throw InputError(fmt::format("code is given for the latent '{}', but there is none", name));
    if (code.features && !found->feature_code)
      throw InputError(fmt::format("code is given for the features of the latent '{}', but the file has them", name));
    if (code.directions && !found->direction_code)
      throw InputError(fmt::format("code is given for the directions of the latent '{}', but the file has them", name));
  }
}

// ---------------------------------------------------------------- features and directions

// [expressions], or { code = [names] }
void read_features(const ModelReader& reader, const TomlValue& node, LatentSpec& latent) {
  std::set<std::string> expanded;
  const auto add = [&](const TomlValue& entry, const std::string& feature, const std::vector<std::string>& names) {
    latent.features.push_back(feature);
    // lengthscales go by the names of features
    for (const std::string& name : names) {
      if (!expanded.insert(name).second) entry.fail(fmt::format("'{}' stands twice; remove one", name));
    }
  };
  if (node.is_table()) {
    for (const std::string& name : names_of_code(node)) add(node, name, {name});
    latent.feature_code = code_of(reader, node, latent.name, &ModelCode::OfLatent::features);
  } else {
    for (const TomlValue& entry : node.array()) {
      const Expression value = reader.feature(entry);
      const std::string feature = ModelReader::text_of(entry, value);
      add(entry, feature, expand_angle(feature, reader.definition.coordinates));
    }
  }
  if (latent.features.empty()) node.fail("a latent needs at least one feature");
}

// "acceleration", "force", "potential", [[…], …] (nq rows), or { force = [[…], …] }
void read_directions(const ModelReader& reader, const TomlValue& node, LatentSpec& latent) {
  if (node.is_text()) {
    const std::string value = node.text();
    if (value != "acceleration" && value != "force" && value != "potential") {
      node.fail(fmt::format(R"(expected "acceleration", "force", "potential" or a matrix of expressions [[…], …], got "{}")",
                            shortened(value)));
    }
    latent.is_potential = value == "potential";
    latent.base = value != "acceleration" ? Latent::Base::force : Latent::Base::acceleration;
    return;
  }
  TomlValue matrix = node;
  if (node.is_table() && !node.has("code")) {
    node.only_keys({"force", "acceleration"});
    if (node.n_entries() != 1) node.fail("expected { force = [[…], …] } or { acceleration = [[…], …] }");
    latent.base = node.has("force") ? Latent::Base::force : Latent::Base::acceleration;
    matrix = node.entries().front().second.called(node.key());
  }
  if (matrix.is_table()) {
    latent.direction_names = names_of_code(matrix);
    latent.direction_code = code_of(reader, matrix, latent.name, &ModelCode::OfLatent::directions);
    if (latent.direction_names.empty()) matrix.fail("directions that are code need a name for each column");
    return;
  }
  const std::vector<TomlValue> rows = reader.rows_per_coordinate(matrix);
  std::string multiplier;
  for (const TomlValue& row : rows) {
    const std::vector<TomlValue> entries = row.array();
    if (entries.empty() || entries.size() != rows.front().array().size()) {
      row.fail("every row needs the same number of entries, at least one");
    }
    latent.directions.emplace_back();
    for (const TomlValue& entry : entries) {
      const Expression value =
          reader.expression_with_multipliers(entry, multiplier, "a direction may not depend on accelerations");
      latent.directions.back().push_back(ModelReader::text_of(entry, value));
    }
  }
}

void read_positive(const TomlValue& node, LatentSpec& latent) {
  latent.is_positive = node.boolean();
  if (!latent.is_positive || !latent.directions.empty() || latent.direction_code) return;
  node.fail("a positive latent needs directions of its own, which it acts along: directions = { force = [[…], …] }");
}

Kernel kernel_of(const TomlValue& at, const LatentSpec& latent) {
  try {
    return Kernel::parse(latent.kernel, latent.features);
  } catch (const InputError& error) {
    at.fail(error.what());
  }
}

// V(φ(q, t)), which the force −Jᵀ∇V is of
void require_potential(const ModelReader& reader, const TomlValue& entry, const LatentSpec& latent) {
  const TomlValue features = entry.get("features").value_or(entry.called(entry.key() + ".features"));
  if (latent.feature_code) {
    features.fail("a potential needs features that are expressions, so that they can be differentiated");
  }
  if (features.is_array()) {
    for (const TomlValue& feature : features.array()) {
      const Expression value = reader.feature(feature);
      reader.refuse_multipliers(feature, value);
      reader.allow_only(feature, value, reader.of_motion(), "a potential depends on coordinates and t alone");
    }
  }
  const std::optional<TomlValue> kernel = entry.get("kernel");
  if (!kernel || has_gradient(kernel_of(*kernel, latent))) return;
  kernel->fail(
      fmt::format("the kernel of a potential is a sum of se, matern52, rq and linear, got \"{}\"", shortened(latent.kernel)));
}

// ---------------------------------------------------------------- hyperparameters

// Equal bounds hold it at their value.
/// @param relative  whether its values are factors of a default scale; else they are a lengthscale
Latent::Range read_range(const TomlValue& node, bool relative) {
  const Tuned entry = read_tuned(node, {"value", "initial", "bounds", "estimate", "prior"});
  const auto require_positive = [&](const TomlValue& at, double value) {
    if (value > 0) return;
    if (!relative) at.fail(fmt::format("a lengthscale must be positive, got {}", value));
    at.fail(fmt::format("values are factors of the default scale and must be positive, got {}", value));
  };
  Latent::Range out;
  if (entry.bounds) {
    std::tie(out.lower, out.upper) = *entry.bounds;
    require_positive(node.called(node.key() + ".bounds"), out.lower);
  }
  if (entry.value) {
    out.initial = entry.value->number();
    require_positive(*entry.value, out.initial);
    require_within(out.initial, entry.bounds, node);
  }
  if (entry.prior) std::tie(out.median, out.log_stddev) = std::pair(entry.prior->median, entry.prior->stddev);
  if (node.is_table() && entry.estimate.value_or(true)) return out;
  const bool is_held = out.upper > 0 && out.lower == out.upper;
  if (out.initial == 0 && !is_held) node.fail("estimate = false needs the value to hold: { value = 1, estimate = false }");
  if (out.initial > 0) out.lower = out.upper = out.initial;
  return out;
}

// Factors of a default scale.
Latent::Range read_relative_range(const TomlValue& latent, const std::string& name) {
  const std::optional<TomlValue> range = latent.get(name);
  if (!range) return {};
  if (!range->is_table()) {
    range->fail(fmt::format("expected a table such as {{ initial = 1, bounds = [0.1, 10] }}, got {}", range->written()));
  }
  return read_range(*range, true);
}

// "per direction", "shared", or { dx = 0.5, dz = { value = 2, bounds = [1, 4] } }, in the units of the features
void read_lengthscales(const TomlValue& node, const std::vector<Coordinate>& coordinates, LatentSpec& latent) {
  if (node.is_text()) {
    const std::string word = node.text();
    if (word != "shared" && word != "per direction") {
      node.fail(
          fmt::format(R"(expected "shared", "per direction" or a table such as {{ dx = 0.5 }}, got "{}")", shortened(word)));
    }
    latent.per_direction = word == "per direction";
    return;
  }
  std::vector<std::string> features;
  for (const std::string& feature : latent.features) {
    const std::vector<std::string> names =
        latent.feature_code ? std::vector<std::string>{feature} : expand_angle(feature, coordinates);
    features.insert(features.end(), names.begin(), names.end());
  }
  const Kernel kernel = Kernel::parse(latent.kernel.empty() ? PriorOptions().kernel : latent.kernel, features);
  for (const auto& [name, entry] : node.entries()) {
    latent.lengthscales.emplace_back(name, read_range(entry, false));
    try {
      static_cast<void>(lengthscales_of(latent, kernel, features, coordinates));
    } catch (const InputError& error) {
      entry.fail(error.what());
    }
  }
}

// ---------------------------------------------------------------- a latent

LatentSpec read_latent(const ModelReader& reader, const TomlValue& entry, std::set<std::string>& names) {
  entry.only_keys({"name", "kernel", "features", "directions", "positive", "lengthscale", "lengthscales", "signal_stddev"});
  const auto name = entry.get("name"), kernel = entry.get("kernel"), lengthscales = entry.get("lengthscales");
  const std::vector<Coordinate>& coordinates = reader.definition.coordinates;
  LatentSpec latent;
  latent.name = name ? name->text() : fmt::format("latent {}", reader.model.latents.size() + 1);
  const TomlValue at_name = entry.called("latent.name");
  if (!names.insert(latent.name).second) at_name.fail(fmt::format("'{}' is taken already", latent.name));
  if (latent.name == "discrepancy") at_name.fail("'discrepancy' is the name of the latent that gp2 adds; take another");
  latent.kernel = kernel ? kernel->text() : "";
  if (const auto features = entry.get("features")) read_features(reader, *features, latent);
  if (const auto directions = entry.get("directions")) read_directions(reader, *directions, latent);
  if (const auto positive = entry.get("positive")) read_positive(*positive, latent);
  if (latent.features.empty()) {
    if (!latent.is_potential) entry.fail(R"(missing features = ["q1", …])");
    for (const Coordinate& coordinate : coordinates) latent.features.push_back(coordinate.name);
  }
  if (latent.is_potential) require_potential(reader, entry, latent);
  latent.lengthscale = read_relative_range(entry, "lengthscale");
  latent.signal_stddev = read_relative_range(entry, "signal_stddev");
  if (kernel) static_cast<void>(kernel_of(*kernel, latent));
  if (lengthscales) read_lengthscales(*lengthscales, coordinates, latent);
  if (latent.is_potential && latent.per_direction.value_or(false)) {
    lengthscales->fail("a potential is one function, whose lengthscales all directions share; leave \"per direction\" out");
  }
  return latent;
}

// one on the acceleration, over everything a state has but the time and what says that there is contact
LatentSpec default_latent(const ModelReader& reader) {
  std::set<std::string> left_out = {reader.symbols->t.variable_name()};
  for (const ConstraintRow& row : reader.definition.constraints) {
    if (row.contact) left_out.insert(reader.definition.inputs[static_cast<std::size_t>(row.contact->input)]);
  }
  LatentSpec latent;
  latent.name = "unconstrained acceleration";
  for (Expression symbol : reader.symbols->state()) {
    if (!left_out.contains(symbol.variable_name())) latent.features.push_back(symbol.variable_name());
  }
  return latent;
}

}  // namespace

void read_latents(ModelReader& reader) {
  std::vector<LatentSpec>& latents = reader.model.latents;
  if (const auto all = reader.file.get("latent")) {
    if (all->is_table()) all->fail("write [[latent]], with two brackets: there may be several");
    std::set<std::string> names;
    for (const TomlValue& entry : all->array()) latents.push_back(read_latent(reader, entry, names));
  }
  if (latents.empty()) latents.push_back(default_latent(reader));
  require_all_code_is_used(reader.model);
}

}  // namespace gp2
