#include "reproduce/experiment.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/error.hpp"
#include "gp2/simulation/generate.hpp"

namespace gp2::command {

using Eigen::VectorXd;

std::string word(Protocol::Name protocol) { return protocol == Protocol::Name::paper ? "paper" : "default"; }

struct Section::Document {
  std::string name;
  toml::table root;
};

Section Section::read(const std::filesystem::path& path) {
  try {
    auto document = std::make_shared<Document>(Document{path.string(), toml::parse(read_file(path), path.string())});
    TomlValue root(document->name, document->root, "");
    return {std::move(document), std::move(root)};
  } catch (const toml::parse_error& error) {
    throw InputError(fmt::format("{}:{}: {}", path.string(), error.source().begin.line, error.description()));
  }
}

TomlValue Section::value(const std::string& key) const {
  std::optional<TomlValue> value = table_.get(key);
  if (!value) table_.fail_at(table_.line(), table_.key().empty() ? key : table_.key() + "." + key, "is missing");
  return *std::move(value);
}

bool Section::has(const std::string& key) const { return table_.has(key); }

bool Section::is_list(const std::string& key) const { return has(key) && value(key).is_array(); }

std::string Section::text(const std::string& key) const {
  const TomlValue found = value(key);
  return found.is_number() ? shortest(found.number()) : found.text();
}

std::string Section::text(const std::string& key, const std::string& otherwise) const { return has(key) ? text(key) : otherwise; }

double Section::number(const std::string& key) const { return value(key).number(); }

int Section::integer(const std::string& key) const {
  const TomlValue found = value(key);
  const double number = found.number();
  if (number != std::trunc(number) || std::abs(number) > std::numeric_limits<int>::max())
    found.fail(fmt::format("expected a whole number, got {}", found.written()));
  return static_cast<int>(number);
}

bool Section::flag(const std::string& key) const { return has(key) && value(key).boolean(); }

std::string Section::mean() const {
  std::string word = text("mean", "zero");
  if (word != "zero" && word != "force") value("mean").fail(fmt::format("must be zero or force, got '{}'", word));
  return word;
}

std::vector<double> Section::numbers(const std::string& key, std::optional<std::size_t> how_many) const {
  std::vector<double> numbers;
  for (const TomlValue& element : value(key).array()) numbers.push_back(element.number());
  if (how_many && numbers.size() != *how_many)
    value(key).fail(fmt::format("must be a list of {} numbers, got {}", *how_many, numbers.size()));
  return numbers;
}

std::vector<bool> Section::flags(const std::string& key) const {
  std::vector<bool> flags;
  for (const TomlValue& element : value(key).array()) flags.push_back(element.boolean());
  return flags;
}

std::vector<std::string> Section::texts(const std::string& key) const {
  std::vector<std::string> texts;
  for (const TomlValue& element : value(key).array()) texts.push_back(element.text());
  return texts;
}

Section Section::section(const std::string& key) const { return {document_, value(key)}; }

std::vector<Section> Section::sections(const std::string& key) const {
  std::vector<Section> sections;
  for (TomlValue& table : value(key).array()) sections.push_back({document_, std::move(table)});
  return sections;
}

std::vector<std::string> Section::keys() const {
  std::vector<std::string> keys;
  for (const auto& [name, value] : table_.entries()) keys.push_back(name);
  std::ranges::sort(keys);
  return keys;
}

namespace {

std::map<std::string, int> grid_of(const Section& section) {
  std::map<std::string, int> grid;
  for (const std::string& range : section.keys()) grid[range] = section.integer(range);
  return grid;
}

}  // namespace

ExperimentSystem::ExperimentSystem(const Section& section, const std::filesystem::path& experiments,
                                   const std::vector<Method>& methods)
    : name(section.text("name")), model(Model::read(experiments / section.text("model"))) {
  for (const Method& method : methods) {
    if (method.estimate) parameters[method.mean] = section.section("parameters").texts(method.mean);
  }
  GenerateOptions options;
  options.noise_stddev = VectorXd::Zero(model.system->nq());
  options.grid = grid_of(section.section("grid"));
  GeneratedData grid = generate(model, options);
  grid_states = std::move(grid.states);
  grid_truth = std::move(grid.accelerations);
}

namespace {

std::filesystem::path published(const std::filesystem::path& data, const std::string& pattern, int run) {
  std::string name = pattern;
  if (const std::size_t place = name.find("{}"); place != std::string::npos) name.replace(place, 2, std::to_string(run));
  return data / name;
}

}  // namespace

CsvTable observations_of(const Model& model, const std::string& pattern, const std::optional<std::filesystem::path>& data,
                         int run, int n) {
  if (data) return CsvTable::read(published(*data, pattern, run));
  GenerateOptions options;
  options.n = n;
  options.seed = static_cast<std::uint64_t>(run) + 1;
  options.noise_stddev = Eigen::Map<const VectorXd>(model.noise.stddev.data(), model.system->nq());
  return as_table(generate(model, options), *model.system, fmt::format("{}, generated run {}", model.system->name(), run));
}

Line line_of(const Section& line, const Model& model) {
  // what the model draws is given instead, ranges first: expressions may use them
  std::vector<Model::SamplingRule> ranges, values;
  GenerateOptions options;
  Line out;
  for (const Model::SamplingRule& drawn : model.sampling) {
    const std::vector<std::string> states = model.system->state_names();
    if (std::find(states.begin(), states.end(), drawn.name) == states.end()) continue;
    Model::SamplingRule rule{drawn.name, std::nullopt, model.expression("0"), 0};
    if (line.is_list(drawn.name)) {
      const std::vector<double> ends = line.numbers(drawn.name, 2);
      rule.range = std::pair(ends[0], ends[1]);
      options.grid[drawn.name] = line.integer("points");
      out.name = drawn.name;
      ranges.push_back(std::move(rule));
      continue;
    }
    if (line.has(drawn.name)) rule.value = model.expression(line.text(drawn.name));
    values.push_back(std::move(rule));
  }
  Model along = model;
  along.sampling = std::move(ranges);
  along.sampling.insert(along.sampling.end(), values.begin(), values.end());
  options.noise_stddev = VectorXd::Zero(model.system->nq());
  GeneratedData data = generate(along, options);
  out.states = std::move(data.states);
  out.truth = std::move(data.accelerations);
  return out;
}

int number_of_runs(const std::string& pattern, const std::optional<std::filesystem::path>& data, std::optional<int> asked,
                   int defined) {
  if (asked && *asked < 1) throw InputError(fmt::format("--runs: must be positive, got {}", *asked));
  if (!data) return asked.value_or(defined);
  if (pattern.find("{}") == std::string::npos) {
    throw InputError(fmt::format("'{}', of published observations, must hold {{}} for the number of the run", pattern));
  }
  int present = 0;
  while (std::filesystem::exists(published(*data, pattern, present))) ++present;
  if (present == 0) {
    throw InputError(fmt::format("--data: there is no {}: expected the folder of the published observations",
                                 published(*data, pattern, 0).string()));
  }
  if (asked && *asked > present) {
    throw InputError(fmt::format("--runs {}: {} holds only {} runs of {}", *asked, data->string(), present, pattern));
  }
  return asked.value_or(std::min(present, defined));
}

}  // namespace gp2::command
