#include "gp2/model.hpp"

#include <algorithm>
#include <filesystem>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "model/latent_tapes.hpp"
#include "model/model_reader.hpp"
#include "model/toml.hpp"
#include "model/toml_reader.hpp"
#include "robots/robot_expressions.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {

namespace {

constexpr std::size_t max_model_size = 1 << 20;

}  // namespace

std::vector<std::string> expand_angle(const std::string& feature, const std::vector<Coordinate>& coordinates) {
  const bool angle =
      std::any_of(coordinates.begin(), coordinates.end(), [&](const Coordinate& c) { return c.angle && c.name == feature; });
  if (!angle) return {feature};
  return {fmt::format("sin({})", feature), fmt::format("cos({})", feature)};
}

namespace {

std::string read_text(const std::filesystem::path& path) {
  std::error_code unknown;  // of a pipe, say
  const auto size = std::filesystem::file_size(path, unknown);
  if (!unknown && size > max_model_size) {
    throw InputError(fmt::format("{}: {} bytes; a model file has at most {}", path.string(), size, max_model_size));
  }
  return read_file(path, max_model_size);
}

/// @param mechanics  null: they stand in the text
Model parse_model(std::string text, std::string name, const MechanicsSource* mechanics, const RobotSource& robot) {
  Model model;
  model.name = std::move(name);
  model.text = std::move(text);
  if (model.text.size() > max_model_size) {
    throw InputError(fmt::format("{}: {} bytes; a model file has at most {}", model.name, model.text.size(), max_model_size));
  }
  try {
    const internal::StepLimit limit;
    require_safe(model.text, model.name);
    const toml::table root = toml::parse(model.text, model.name);
    read_model(root, mechanics, robot, model);
  } catch (const toml::parse_error& error) {
    throw InputError(fmt::format("{}:{}: not valid TOML: {}", model.name, error.source().begin.line, error.description()));
  } catch (const LocatedError&) {
    throw;
  } catch (const InputError& error) {
    throw InputError(fmt::format("{}: {}", model.name, error.what()));
  }
  return model;
}

}  // namespace

Model Model::read(const std::filesystem::path& path) { return parse(read_text(path), path.string()); }

Model Model::read(const std::filesystem::path& path, const MechanicsSource& mechanics) {
  return parse(read_text(path), path.string(), mechanics);
}

namespace {

// a robot's file stands beside the model's
RobotSource beside(const std::string& model_name) {
  return
      [folder = std::filesystem::path(model_name).parent_path()](const std::string& file) { return read_robot(folder / file); };
}

}  // namespace

Model Model::parse(std::string text, std::string name) {
  const RobotSource robot = beside(name);
  return parse_model(std::move(text), std::move(name), nullptr, robot);
}

Model Model::parse(std::string text, std::string name, const RobotSource& robot) {
  return parse_model(std::move(text), std::move(name), nullptr, robot);
}

Model Model::parse(std::string text, std::string name, const MechanicsSource& mechanics) {
  return parse_model(std::move(text), std::move(name), &mechanics, {});
}

void Model::define(const std::string& symbol, Expression value) {
  if (symbols_.emplace(symbol, value).second) symbol_names_.push_back(symbol);
}

Expression Model::parse_symbols(std::string_view written) const {
  return parse_expression(
      written, *graph,
      [&](std::string_view symbol) -> std::optional<Expression> {
        const auto found = symbols_.find(symbol);
        if (found != symbols_.end()) return found->second;
        return robot_expressions_ ? robot_expressions_->variable(std::string(symbol)) : std::nullopt;
      },
      symbol_names_);
}

Expression Model::expression(std::string_view written) const {
  const Expression value = parse_symbols(written);
  return robot_expressions_ ? robot_expressions_->expand(value) : value;
}

SystemSymbols Model::symbols() const { return {*graph, system->coordinates(), system->inputs(), system->parameters()}; }

const SymbolicSystem* Model::symbolic_system() const {
  // code may give a system of expressions too, but of another graph
  const auto* symbolic = dynamic_cast<const SymbolicSystem*>(system.get());
  return symbolic != nullptr && symbolic->definition().graph == graph ? symbolic : nullptr;
}

const SymbolicSystem& require_symbolic_system(const Model& model) {
  if (const SymbolicSystem* system = model.symbolic_system()) return *system;
  throw InputError(
      fmt::format("{}: the mechanics of '{}' are code: there are no expressions of M, A, b and F; only a model file with "
                  "[mechanics] has them",
                  model.name, model.system->name()));
}

namespace {

// features in units of the lengthscales, directions of the standard deviations: nothing is left to tune
Latent make_discrepancy(const Model& model, const SystemSymbols& symbols, const Latent& beside, std::vector<Expression> features,
                        const Discrepancy& discrepancy) {
  const System& system = *model.system;
  ExpressionGraph& graph = *model.graph;
  if (discrepancy.lengthscale.size() != beside.n_features() || discrepancy.stddev.size() != system.nq()) {
    throw InputError(fmt::format("a discrepancy must hold {} lengthscales and {} standard deviations, got {} and {}",
                                 beside.n_features(), system.nq(), discrepancy.lengthscale.size(), discrepancy.stddev.size()));
  }
  Latent latent;
  latent.name = "discrepancy";
  latent.feature_names = beside.feature_names;
  latent.feature_parameters = beside.feature_parameters;
  for (std::size_t d = 0; d < features.size(); ++d) {
    features[d] = features[d] / graph.constant(discrepancy.lengthscale[static_cast<Eigen::Index>(d)]);
  }
  set_features(latent, features, symbols);
  latent.kernel = Kernel::parse("se", latent.feature_names);
  latent.kernel_is_fixed = latent.signal_is_fixed = true;
  const auto nq = static_cast<std::size_t>(system.nq());
  std::vector<Expression> directions(nq * nq, graph.constant(0));
  latent.direction_derivatives.assign(system.parameters().size(), Tape(directions, symbols.state_and_parameters()));
  for (std::size_t j = 0; j < nq; ++j) {
    latent.column_names.push_back(system.coordinates()[j].acceleration());
    directions[j * nq + j] = graph.constant(discrepancy.stddev[static_cast<Eigen::Index>(j)]);
  }
  set_directions(latent, directions, symbols);
  return latent;
}

}  // namespace

Prior make_prior(const Model& model, const PriorOptions& options) {
  const internal::StepLimit limit;
  const System& system = *model.system;
  ExpressionGraph& graph = *model.graph;
  const SystemSymbols symbols = model.symbols();
  if (options.base && model.latents.size() > 1) {
    throw InputError(
        fmt::format("{}: `prior` replaces the directions of the one [[latent]], but this model has {}: edit the model "
                    "file instead",
                    model.name, model.latents.size()));
  }

  // features keep the parameters' own values: kernels would otherwise have to be differentiated in θ
  std::map<std::string, Expression> parameter_values;
  for (const Parameter& parameter : system.parameters())
    parameter_values.emplace(parameter.name, graph.constant(parameter.value));

  std::optional<Latent> discrepancy;
  Prior prior{model.system, {}, options.mean, {}};
  for (const Model::LatentText& text : model.latents) {
    Latent latent;
    latent.name = text.name;
    latent.base = options.base.value_or(text.base);
    latent.lengthscale = text.lengthscale;
    latent.signal_stddev = text.signal_stddev;
    std::vector<Expression> features;
    for (const std::string& feature : text.features) {
      for (const std::string& expression :
           options.raw_angles ? std::vector<std::string>{feature} : expand_angle(feature, system.coordinates())) {
        latent.feature_names.push_back(expression);
        const Expression feature_value = model.expression(expression);
        for (std::size_t k = 0; k < symbols.parameters.size(); ++k) {
          if (graph.depends_on(feature_value, symbols.parameters[k])) latent.feature_parameters.push_back(static_cast<int>(k));
        }
        features.push_back(graph.substitute(feature_value, parameter_values));
      }
    }
    set_features(latent, features, symbols);
    latent.kernel = Kernel::parse(text.kernel, latent.feature_names);

    if (options.discrepancy && &text == &model.latents.front()) {
      discrepancy = make_discrepancy(model, symbols, latent, features, *options.discrepancy);
    }

    latent.directions_are_identity = text.directions.empty() || options.base.has_value();
    if (latent.directions_are_identity) {
      for (const Coordinate& coordinate : system.coordinates()) {
        latent.column_names.push_back(latent.base == Latent::Base::force ? "force_" + coordinate.name
                                                                         : coordinate.acceleration());
      }
    } else {
      std::vector<Expression> entries;
      for (std::size_t column = 0; column < text.directions.front().size(); ++column) {
        latent.column_names.push_back(fmt::format("direction {}", column + 1));
        for (const std::vector<Expression>& row : text.directions) entries.push_back(row[column]);
      }
      set_directions(latent, entries, symbols);
      for (Expression parameter : symbols.parameters) {
        std::vector<Expression> derivatives;
        for (Expression entry : entries) derivatives.push_back(graph.differentiate(entry, parameter));
        latent.direction_derivatives.emplace_back(derivatives, symbols.state_and_parameters());
      }
    }
    prior.latents.push_back(std::move(latent));
  }
  if (discrepancy) prior.latents.push_back(std::move(*discrepancy));
  return prior;
}

}  // namespace gp2
