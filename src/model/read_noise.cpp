#include <utility>

#include <fmt/format.h>

#include "model/table_readers.hpp"
#include "model/tuned.hpp"

// [noise]

namespace gp2 {

namespace {

// One value for all coordinates, or one for each.
template <class Read>
auto one_or_each(const TomlValue& node, bool is_one, std::size_t nq, const Read& read) {
  if (is_one) return std::vector(nq, read(node));
  std::vector<decltype(read(node))> values;
  for (const TomlValue& entry : node.array()) values.push_back(read(entry));
  return values;
}

void require_positive_stddev(const TomlValue& node, double value) {
  if (!(value > 0)) node.fail(fmt::format("a noise standard deviation must be positive, got {}", value));
}

std::vector<std::pair<double, double>> read_ranges(const TomlValue& node, std::size_t nq) {
  const std::vector<TomlValue> entries = node.array();
  const bool is_one = entries.empty() || !entries.front().is_array();
  const auto ranges = one_or_each(node, is_one, nq, [](const TomlValue& one) { return one.range(); });
  if (ranges.size() != nq) node.fail(fmt::format("expected one range or {}, one per coordinate, got {}", nq, ranges.size()));
  for (const auto& range : ranges) require_positive_stddev(node, range.first);
  return ranges;
}

std::vector<double> read_stddevs(const TomlValue& node, std::size_t nq) {
  const auto values = one_or_each(node, !node.is_array(), nq, [](const TomlValue& one) { return one.number(); });
  if (values.size() != nq) node.fail(fmt::format("expected one value or {}, one per coordinate, got {}", nq, values.size()));
  for (const double value : values) require_positive_stddev(node, value);
  return values;
}

}  // namespace

void read_noise(ModelReader& reader, const TomlValue& noise) {
  noise.only_keys({"ddq"});
  const std::optional<TomlValue> node = noise.get("ddq");
  if (!node) return;
  Model::Noise& out = reader.model.noise;
  if (node->is_table()) {
    if (const auto floor = node->get("floor")) out.floor = read_stddevs(*floor, reader.nq());
    if (const auto bounds = node->get("bounds")) out.bounds = read_ranges(*bounds, reader.nq());
  }
  const Tuned entry = read_tuned(*node, {"value", "initial", "bounds", "estimate", "floor"}, false);
  out.estimate = entry.estimate.value_or(false);
  if (!entry.value) {
    if (out.floor.empty() || out.estimate) node->fail("missing initial: where the estimate starts");
    return;
  }
  // complaints about it go by the key of all
  out.stddev = read_stddevs(entry.value->called(node->key()), reader.nq());
  for (std::size_t j = 0; j < out.stddev.size(); ++j) {
    if (!out.bounds.empty()) require_within(out.stddev[j], out.bounds[j], *node);
    if (out.floor.empty() || out.stddev[j] >= out.floor[j]) continue;
    node->fail(fmt::format("the value {} is below its floor {}", out.stddev[j], out.floor[j]));
  }
}

}  // namespace gp2
