#include "model/model_text.hpp"

#include <algorithm>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"

namespace gp2 {

namespace {

std::string quoted(const std::string& text) {
  std::string out = "\"";
  for (const char c : text) {
    const auto code = static_cast<unsigned char>(c);
    if (c == '"' || c == '\\') {
      out += {'\\', c};
    } else if (code < 0x20 || code == 0x7f) {
      out += fmt::format("\\u{:04x}", code);
    } else {
      out += c;
    }
  }
  return out + '"';
}

std::string list(const std::vector<std::string>& written) { return fmt::format("[{}]", fmt::join(written, ", ")); }

std::string quoted_list(const std::vector<std::string>& texts) {
  std::vector<std::string> written;
  for (const std::string& text : texts) written.push_back(quoted(text));
  return list(written);
}

std::string table(const std::vector<std::string>& entries) { return fmt::format("{{ {} }}", fmt::join(entries, ", ")); }

std::string belief_text(const char* centre, double value, const char* spread, double stddev) {
  return fmt::format("prior = {{ {} = {}, {} = {} }}", centre, value, spread, stddev);
}

std::string parameter_text(const Parameter& parameter) {
  std::vector<std::string> entries = {fmt::format("value = {}", parameter.value)};
  if (parameter.bounds) entries.push_back(fmt::format("bounds = [{}, {}]", parameter.bounds->first, parameter.bounds->second));
  if (parameter.estimate) entries.emplace_back("estimate = true");
  if (parameter.prior) {
    const Parameter::Belief& prior = *parameter.prior;
    entries.push_back(prior.of_logarithm ? belief_text("median", prior.median, "log_stddev", prior.stddev)
                                         : belief_text("mean", prior.median, "stddev", prior.stddev));
  }
  return fmt::format("{} = {}\n", quoted(parameter.name), table(entries));
}

std::string range_text(const std::string& name, const Latent::Range& range) {
  std::vector<std::string> entries;
  if (range.initial > 0) entries.push_back(fmt::format("initial = {}", range.initial));
  if (range.upper > 0) entries.push_back(fmt::format("bounds = [{}, {}]", range.lower, range.upper));
  if (range.log_stddev > 0) {
    entries.push_back(belief_text("median", range.median, "log_stddev", range.log_stddev));
  }
  return entries.empty() ? "" : fmt::format("{} = {}", name, table(entries));
}

// @throws InputError where the text would say less than the spec.
void require_words_for(const LatentSpec& spec) {
  const auto fail = [&](const std::string& what) { throw InputError(fmt::format("latent '{}': {}", spec.name, what)); };
  if (spec.base == Latent::Base::admissible && !spec.is_potential) {
    fail("a model has no word for the base admissible; make the prior alone, by make_prior, or take another base");
  }
  const auto require_both_ends = [&](const std::string& name, const Latent::Range& range) {
    if ((range.lower > 0) == (range.upper > 0)) return;
    fail(fmt::format("a model holds both bounds or none, but {} has the {} one alone; give both", name,
                     range.lower > 0 ? "lower" : "upper"));
  };
  require_both_ends("lengthscale", spec.lengthscale);
  require_both_ends("signal_stddev", spec.signal_stddev);
  for (const auto& [feature, range] : spec.lengthscales)
    require_both_ends(fmt::format("the lengthscale of '{}'", feature), range);
  // beside single lengthscales whether directions share them follows from the kernel
  const bool is_default = !spec.per_direction || (!spec.kernel.empty() && !*spec.per_direction);
  const bool has_single =
      std::ranges::any_of(spec.lengthscales, [](const auto& one) { return !range_text(one.first, one.second).empty(); });
  if (!has_single || spec.is_potential || is_default) return;
  fail(
      fmt::format("a model cannot hold per_direction = {} beside lengthscales of single features; leave one of them out, or make "
                  "the prior alone, by make_prior",
                  *spec.per_direction));
}

std::string ranges_text(const LatentSpec& spec) {
  std::vector<std::string> lines = {range_text("lengthscale", spec.lengthscale), range_text("signal_stddev", spec.signal_stddev)};
  std::vector<std::string> each;
  for (const auto& [feature, range] : spec.lengthscales) each.push_back(range_text(quoted(feature), range));
  std::erase(each, "");
  if (!each.empty()) lines.push_back("lengthscales = " + table(each));
  if (each.empty() && spec.per_direction) {
    lines.push_back(fmt::format("lengthscales = {}", quoted(*spec.per_direction ? "per direction" : "shared")));
  }
  std::string text;
  for (const std::string& line : lines) text += line.empty() ? "" : line + "\n";
  return text;
}

std::string directions_text(const LatentSpec& spec) {
  const char* base = spec.base == Latent::Base::force ? "force" : "acceleration";
  if (spec.direction_code) {
    return fmt::format("directions = {{ {} = {{ code = {} }} }}\n", base, quoted_list(spec.direction_names));
  }
  if (spec.is_potential) return "directions = \"potential\"\n";
  if (spec.directions.empty()) return fmt::format("directions = \"{}\"\n", base);
  std::vector<std::string> rows;
  for (const std::vector<std::string>& row : spec.directions) rows.push_back(quoted_list(row));
  return fmt::format("directions = {{ {} = {} }}\n", base, list(rows));
}

std::string latent_text(const LatentSpec& spec) {
  require_words_for(spec);
  const std::string features = quoted_list(spec.features);
  return fmt::format("\n[[latent]]\nname = {}\n{}features = {}\n", quoted(spec.name),
                     spec.kernel.empty() ? "" : fmt::format("kernel = {}\n", quoted(spec.kernel)),
                     spec.feature_code ? fmt::format("{{ code = {} }}", features) : features) +
         directions_text(spec) + (spec.is_positive ? "positive = true\n" : "") + ranges_text(spec);
}

}  // namespace

std::string model_text(const System& system, const std::vector<LatentSpec>& latents) {
  std::vector<std::string> coordinates;
  for (const Coordinate& coordinate : system.coordinates()) {
    coordinates.push_back(table({"name = " + quoted(coordinate.name), fmt::format("angle = {}", coordinate.angle)}));
  }
  std::string text = fmt::format("name = {}\ncoordinates = {}\ninputs = {}\n", quoted(system.name()), list(coordinates),
                                 quoted_list(system.inputs()));
  if (!system.parameters().empty()) text += "\n[parameters]\n";
  for (const Parameter& parameter : system.parameters()) text += parameter_text(parameter);
  for (const LatentSpec& latent : latents) text += latent_text(latent);
  return text;
}

}  // namespace gp2
