#include <algorithm>
#include <map>
#include <set>
#include <utility>

#include <fmt/format.h>

#include "base/suggestion.hpp"
#include "gp2/error.hpp"
#include "model/table_readers.hpp"

// [truth], [sampling] and [motion]: what data are generated from

namespace gp2 {

void read_truth(ModelReader& reader, const TomlValue& truth) {
  truth.only_keys({"acceleration", "force", "force_on"});
  if (truth.n_entries() == 0) truth.fail("missing acceleration = [ … ] or force = [ … ]");
  Model& model = reader.model;
  model.truth.assign(reader.nq(), reader.definition.graph->constant(0));
  std::string multiplier;
  model.truth_force = read_forces(reader, truth, &multiplier);
  const std::optional<TomlValue> acceleration = truth.get("acceleration");
  if (!acceleration) return;
  const std::vector<TomlValue> entries = acceleration->array();
  if (entries.size() != reader.nq()) {
    acceleration->fail(fmt::format("expected {} entries, one per coordinate, got {}", reader.nq(), entries.size()));
  }
  for (std::size_t j = 0; j < entries.size(); ++j)
    model.truth[j] = reader.expression_with_multipliers(entries[j], multiplier, "the true acceleration may not depend on itself");
}

namespace {

// where coordinates and velocities begin
std::map<std::string, double> read_start(const ModelReader& reader, const TomlValue& start) {
  const std::vector<Coordinate>& coordinates = reader.definition.coordinates;
  std::map<std::string, double> values;
  for (const auto& [name, value] : start.entries()) {
    const bool known = std::any_of(coordinates.begin(), coordinates.end(),
                                   [&name = name](const Coordinate& c) { return c.name == name || c.velocity() == name; });
    if (!known) value.fail(fmt::format("'{}' is neither a coordinate nor a velocity of this model", name));
    values[name] = value.number();
  }
  return values;
}

}  // namespace

void read_sampling(ModelReader& reader, const TomlValue& sampling) {
  std::vector<std::pair<std::string, TomlValue>> entries = sampling.entries();
  const auto is_start = [](const auto& entry) { return entry.first == "start"; };
  const ExpressionGraph& graph = *reader.definition.graph;
  // names that are not of the state are auxiliary draws, visible to expressions here only
  std::set<std::string> drawable;
  for (Expression symbol : reader.symbols->state()) drawable.insert(symbol.variable_name());
  const auto visible = reader.defined();
  const auto visible_names = reader.suggested_names();
  for (const auto& entry : entries) {
    if (is_start(entry) || drawable.contains(entry.first)) continue;
    reader.declare(entry.first, entry.second);
    reader.define(entry.first, reader.definition.graph->variable(entry.first));
  }

  std::vector<Model::SamplingRule> rules;
  std::vector<std::vector<std::string>> words;
  for (const auto& entry : entries) {
    const auto& [name, value] = entry;
    if (is_start(entry)) {
      reader.model.newton_start = read_start(reader, value);
      continue;
    }
    Model::SamplingRule& rule = rules.emplace_back(Model::SamplingRule{name, std::nullopt, {}, value.line()});
    if (value.is_array()) {
      rule.range = value.range();
      words.emplace_back();
    } else {
      rule.value = reader.expression_without(value, reader.symbols->ddq, "a sample may not depend on accelerations");
      words.push_back(graph.variables_of(rule.value));
    }
  }
  reader.defined() = visible;
  reader.suggested_names() = visible_names;
  // each rule after those it uses
  std::erase_if(entries, is_start);
  for (const std::size_t k : positions_by_use(entries, words, "drawn in terms of itself"))
    reader.model.sampling.push_back(std::move(rules[k]));
}

namespace {

// a function y(q) of the coordinates, twice differentiated along the motion as a constraint is
Model::Motion::Target read_target(const ModelReader& reader, const TomlValue& at, const std::string& text) {
  try {
    const Expression y = reader.parsed(text);
    reader.refuse_multipliers(at, y);
    return {text, reader.derive(ConstraintRow::Level::position, y, text), std::nullopt};
  } catch (const LocatedError&) {
    throw;
  } catch (const InputError& error) {
    at.fail(fmt::format("\"{}\" must be a function of the coordinates: {}", shortened(text), error.what()));
  }
}

/// @param otherwise  what it is where the table has none; 0: it must have one
double read_positive_number(const TomlValue& table, const std::string& name, double otherwise) {
  const std::optional<TomlValue> entry = table.get(name);
  if (!entry && otherwise > 0) return otherwise;
  if (!entry) table.fail(fmt::format("missing {} = …", name));
  const double value = entry->number();
  if (!(value > 0)) entry->fail(fmt::format("must be positive, got {}", value));
  return value;
}

}  // namespace

void read_motion(ModelReader& reader, const TomlValue& table) {
  table.only_keys({"rate", "segment", "profile", "natural_frequency", "damping_ratio", "targets", "hold", "start"});
  if (reader.file.has("sampling")) {
    table.fail("states are drawn by [sampling] or met on the way by [motion]: remove one of the two");
  }
  if (reader.model.code.mechanics) table.fail("only a model with its mechanics as text can be driven: remove it");
  if (reader.definition.inputs.empty()) table.fail("a model without inputs cannot be driven; give inputs, or use [sampling]");
  Model::Motion motion;
  motion.rate = read_positive_number(table, "rate", 0);
  motion.natural_frequency = read_positive_number(table, "natural_frequency", 10);
  motion.damping_ratio = read_positive_number(table, "damping_ratio", 1);
  const std::optional<TomlValue> segment = table.get("segment");
  if (!segment) table.fail("missing segment = [shortest, longest], how long a line takes in s");
  motion.segment = segment->range();
  if (!(motion.segment.first > 0)) segment->fail("a line takes a positive time");
  if (const auto profile = table.get("profile")) {
    const std::string word = profile->text();
    if (word != "smooth" && word != "trapezoid") {
      profile->fail(fmt::format(R"(expected "smooth" or "trapezoid", got "{}")", shortened(word)));
    }
    if (word == "trapezoid") motion.profile = Model::Motion::Profile::trapezoid;
  }
  const std::optional<TomlValue> targets = table.get("targets");
  if (!targets) table.fail("missing targets = { q1 = [lower, upper], … }");
  for (const auto& [name, entry] : targets->entries()) {
    motion.targets.push_back(read_target(reader, entry, name));
    motion.targets.back().range = entry.range();
  }
  if (motion.targets.empty()) targets->fail("a motion needs at least one target");
  if (const auto hold = table.get("hold")) {
    for (const TomlValue& entry : hold->array()) motion.targets.push_back(read_target(reader, entry, entry.text()));
  }
  if (const auto start = table.get("start")) motion.start = read_start(reader, *start);
  reader.model.motion = std::move(motion);
}

}  // namespace gp2
