#include "gp2/model.hpp"

#include <algorithm>
#include <filesystem>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "mechanics/known_multipliers.hpp"
#include "model/model_reader.hpp"
#include "model/model_text.hpp"
#include "model/prior_words.hpp"
#include "model/toml.hpp"
#include "model/toml_value.hpp"
#include "prior/make_prior.hpp"
#include "robots/robot_expressions.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {

namespace {

constexpr std::size_t max_model_size = 1 << 20;

std::string read_text(const std::filesystem::path& path) {
  std::error_code unknown;  // of a pipe, say
  const auto size = std::filesystem::file_size(path, unknown);
  if (!unknown && size > max_model_size) {
    throw InputError(fmt::format("{}: {} bytes; a model file has at most {}", path.string(), size, max_model_size));
  }
  return read_file(path, max_model_size);
}

// a robot's file stands beside the model's
RobotSource beside(const std::string& model_name) {
  return
      [folder = std::filesystem::path(model_name).parent_path()](const std::string& file) { return read_robot(folder / file); };
}

}  // namespace

Model Model::read(const std::filesystem::path& path, const ModelCode& code) {
  return parse(read_text(path), path.string(), code);
}

Model Model::parse(std::string text, std::string name, const ModelCode& code) {
  const RobotSource robot = beside(name);
  return parse(std::move(text), std::move(name), robot, code);
}

Model Model::parse(std::string text, std::string name, const RobotSource& robot, const ModelCode& code) {
  Model model;
  model.code = code;
  model.name = std::move(name);
  model.text = std::move(text);
  if (model.text.size() > max_model_size) {
    throw InputError(fmt::format("{}: {} bytes; a model file has at most {}", model.name, model.text.size(), max_model_size));
  }
  const auto not_toml = [&](const char* kind) {
    throw InputError(fmt::format("{}: not valid TOML but {}: a model file is wanted here", model.name, kind));
  };
  const std::size_t first = model.text.find_first_not_of(" \t\r\n\xEF\xBB\xBF");  // a byte order mark, too
  if (first != std::string::npos && model.text[first] == '{') not_toml("JSON, as gp2 fit writes it");
  if (first != std::string::npos && model.text[first] == '<') {
    throw InputError(fmt::format("{0}: not valid TOML but XML: name a robot's description in a model file, as robot = \"{1}\"",
                                 model.name, std::filesystem::path(model.name).filename().string()));
  }
  try {
    const internal::StepLimit limit;
    require_safe(model.text, model.name);
    const toml::table root = toml::parse(model.text, model.name);
    read_model(root, robot, model);
  } catch (const toml::parse_error& error) {
    if (model.name.ends_with(".csv")) not_toml("a table, by its name");
    throw InputError(fmt::format("{}:{}: not valid TOML: {}", model.name, error.source().begin.line, error.description()));
  } catch (const LocatedError&) {
    throw;
  } catch (const InputError& error) {
    throw InputError(fmt::format("{}: {}", model.name, error.what()));
  }
  return model;
}

Model Model::from_code(std::shared_ptr<const System> system, const std::vector<LatentSpec>& latents) {
  static_cast<void>(gp2::make_prior(system, latents));  // whose words are those of code, not of lines of a file
  ModelCode code{[system](const SystemDeclaration&) { return system; }};
  for (const LatentSpec& latent : latents) {
    if (latent.feature_code || latent.direction_code) code.latents[latent.name] = {latent.feature_code, latent.direction_code};
  }
  return parse(model_text(*system, latents), system->name(), code);
}

void Model::define(const std::string& symbol, Expression value) {
  if (symbols_.emplace(symbol, value).second) symbol_names_.push_back(symbol);
}

Expression Model::parse_symbols(std::string_view written, const std::vector<Expression>& forbidden,
                                decltype(parse_expression)& parse) const {
  bool is_unknown = false;
  const auto resolve = [&](std::string_view symbol) -> std::optional<Expression> {
    if (const auto found = symbols_.find(symbol); found != symbols_.end()) return found->second;
    if (is_multiplier(symbol)) return graph->variable(symbol);
    const std::optional<Expression> of_robot =
        robot_expressions_ ? robot_expressions_->variable(std::string(symbol)) : std::nullopt;
    is_unknown = !of_robot;
    return of_robot;
  };
  constexpr std::size_t most_listed = 1000;  // nobody reads more
  const bool has_many = symbol_names_.size() > most_listed;
  if (forbidden.empty() || has_many) return parse(written, *graph, resolve, symbol_names_);
  try {
    return parse(written, *graph, resolve, {});
  } catch (const InputError&) {
    if (!is_unknown) throw;
  }
  // again, now that there is need of the names that may stand there
  std::vector<std::string> allowed;
  for (const std::string& symbol : symbol_names_) {
    const Expression value = symbols_.find(symbol)->second;
    const auto is_read = [&](const Expression& one) { return graph->depends_on(value, one); };
    if (std::none_of(forbidden.begin(), forbidden.end(), is_read)) allowed.push_back(symbol);
  }
  return parse(written, *graph, resolve, allowed);
}

Expression Model::expression(std::string_view written) const {
  const Expression value = parse_symbols(written);
  return robot_expressions_ ? robot_expressions_->expand(value) : value;
}

namespace {

std::string unit_among(const std::map<std::string, std::string>& units, std::string_view quantity) {
  const auto found = units.find(std::string(quantity.substr(0, quantity.find('@'))));
  return found == units.end() ? "" : found->second;
}

}  // namespace

std::string Model::unit_of(std::string_view quantity) const { return unit_among(units, quantity); }

std::string Model::labelled(const std::string& quantity) const {
  const std::string unit = unit_among(known_units(), quantity);
  return unit.empty() ? quantity : fmt::format("{} [{}]", quantity, unit);
}

SystemSymbols Model::symbols() const {
  require_system(system);
  return {*graph, system->coordinates(), system->inputs(), system->parameters()};
}

const SymbolicSystem* Model::symbolic_system() const {
  // code may give a system of expressions too, but of another graph
  const auto* symbolic = dynamic_cast<const SymbolicSystem*>(system.get());
  return symbolic != nullptr && symbolic->definition().graph == graph ? symbolic : nullptr;
}

const SymbolicSystem& require_symbolic_system(const Model& model) {
  require_system(model.system);
  if (const SymbolicSystem* system = model.symbolic_system()) return *system;
  throw InputError(
      fmt::format("{}: the mechanics of '{}' are code: there are no expressions of M, A, b and F; only a model file with "
                  "[mechanics] has them",
                  model.name, model.system->name()));
}

Prior make_prior(const Model& model, const PriorOptions& options) {
  require_system(model.system);
  return make_prior(model.system, model.latents, options, prior_words(model));
}

}  // namespace gp2
