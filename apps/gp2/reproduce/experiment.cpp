#include "reproduce/experiment.hpp"

#include <algorithm>
#include <memory>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/error.hpp"
#include "gp2/simulation/generate.hpp"
#include "model/toml.hpp"

namespace gp2::command {

using Eigen::VectorXd;

std::string word(Protocol::Name protocol) { return protocol == Protocol::Name::paper ? "paper" : "default"; }

// a table of a document that it keeps alive
struct Section::Node {
  std::shared_ptr<const toml::table> document;
  const toml::table* table = nullptr;

  [[nodiscard]] const toml::node* find(const std::string& key) const { return table->get(key); }
};

Section Section::read(const std::filesystem::path& path) {
  try {
    auto document = std::make_shared<const toml::table>(toml::parse(read_file(path), path.string()));
    Section section;
    section.node_ = std::make_shared<const Node>(Node{document, document.get()});
    section.where_ = path.string() + ": ";
    return section;
  } catch (const toml::parse_error& error) {
    throw InputError(fmt::format("{}:{}: {}", path.string(), error.source().begin.line, error.description()));
  }
}

namespace {

template <typename Value>
Value value_of(const toml::node* node, const std::string& where, const char* what) {
  const std::optional<Value> value = node == nullptr ? std::nullopt : node->value<Value>();
  if (!value) throw InputError(fmt::format("{} must be {}", where, what));
  return *value;
}

template <typename Value>
std::vector<Value> list_of(const toml::node* node, const std::string& where, const char* what) {
  if (node == nullptr || !node->is_array()) throw InputError(fmt::format("{} must be a list of {}", where, what));
  std::vector<Value> values;
  for (const toml::node& item : *node->as_array()) values.push_back(value_of<Value>(&item, where, what));
  return values;
}

}  // namespace

bool Section::has(const std::string& key) const { return node_->find(key) != nullptr; }

bool Section::is_list(const std::string& key) const { return has(key) && node_->find(key)->is_array(); }

std::string Section::text(const std::string& key) const {
  const toml::node* node = node_->find(key);
  if (node != nullptr && node->is_number()) return shortest(*node->value<double>());
  return value_of<std::string>(node, where_ + key, "a text");
}

std::string Section::text(const std::string& key, const std::string& otherwise) const { return has(key) ? text(key) : otherwise; }

double Section::number(const std::string& key) const { return value_of<double>(node_->find(key), where_ + key, "a number"); }

int Section::integer(const std::string& key) const {
  return static_cast<int>(value_of<std::int64_t>(node_->find(key), where_ + key, "a whole number"));
}

bool Section::flag(const std::string& key) const {
  return has(key) && value_of<bool>(node_->find(key), where_ + key, "true or false");
}

std::string Section::mean() const {
  std::string word = text("mean", "zero");
  if (word != "zero" && word != "force") throw InputError(fmt::format("{}mean must be zero or force, got '{}'", where_, word));
  return word;
}

std::vector<double> Section::numbers(const std::string& key, std::optional<std::size_t> how_many) const {
  std::vector<double> numbers = list_of<double>(node_->find(key), where_ + key, "numbers");
  if (how_many && numbers.size() != *how_many) {
    throw InputError(fmt::format("{}{} must be a list of {} numbers, got {}", where_, key, *how_many, numbers.size()));
  }
  return numbers;
}

std::vector<bool> Section::flags(const std::string& key) const {
  return list_of<bool>(node_->find(key), where_ + key, "true and false");
}

std::vector<std::string> Section::texts(const std::string& key) const {
  return list_of<std::string>(node_->find(key), where_ + key, "texts");
}

Section Section::section(const std::string& key) const {
  const toml::node* node = node_->find(key);
  if (node == nullptr || !node->is_table()) throw InputError(fmt::format("{}{} must be a table", where_, key));
  Section section;
  section.node_ = std::make_shared<const Node>(Node{node_->document, node->as_table()});
  section.where_ = fmt::format("{}{}.", where_, key);
  return section;
}

std::vector<Section> Section::sections(const std::string& key) const {
  const toml::node* node = node_->find(key);
  if (node == nullptr || !node->is_array_of_tables()) throw InputError(fmt::format("{}[[{}]] is missing", where_, key));
  std::vector<Section> sections;
  for (const toml::node& item : *node->as_array()) {
    Section& section = sections.emplace_back();
    section.node_ = std::make_shared<const Node>(Node{node_->document, item.as_table()});
    section.where_ = fmt::format("{}{}[{}].", where_, key, sections.size());
  }
  return sections;
}

std::vector<std::string> Section::keys() const {
  std::vector<std::string> keys;
  for (const auto& [key, value] : *node_->table) keys.emplace_back(key.str());
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
