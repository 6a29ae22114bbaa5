#include <fmt/ranges.h>

#include "files/fit_json.hpp"

namespace gp2::fit_json {

namespace {

constexpr std::array<Named<Prior::Mean>, 2> means = {{{Prior::Mean::zero, "zero"}, {Prior::Mean::force, "force"}}};
constexpr std::array<Named<std::optional<Latent::Base>>, 3> directions = {
    {{std::nullopt, "model"}, {Latent::Base::acceleration, "acceleration"}, {Latent::Base::force, "force"}}};

constexpr std::array<Named<Latent::Base>, 2> discrepancy_directions = {
    {{Latent::Base::admissible, "admissible"}, {Latent::Base::acceleration, "acceleration"}}};

constexpr const char* left_to_code = "code";

bool is_code(const ParsedJson& model, const char* part) {
  if (!model.contains(part)) return false;
  if (model.at(part) != left_to_code) throw InputError(fmt::format("{} as {} are not known", part, shown(model.at(part))));
  return true;
}

Json baseline_json(const Baseline& baseline) {
  return {{"kind", Baseline::word(baseline.kind)},
          {"output_mean", vector_json(baseline.output_mean)},
          {"feature_mean", vector_json(baseline.feature_mean)},
          {"feature_stddev", vector_json(baseline.feature_stddev)}};
}

Baseline baseline_from(const ParsedJson& json) {
  const auto word = json.at("kind").get<std::string>();
  const std::optional<Baseline::Kind> kind = Baseline::kind_of(word);
  if (!kind) throw InputError(fmt::format("'{}' is no baseline; there is: {}", word, fmt::join(Baseline::words(), ", ")));
  Baseline baseline{*kind, vector_from(json.at("output_mean")), vector_from(json.at("feature_mean")),
                    vector_from(json.at("feature_stddev"))};
  if (!(baseline.feature_stddev.array() > 0).all()) throw InputError("feature_stddev of a baseline must be positive");
  return baseline;
}

Json discrepancy_json(const Discrepancy& discrepancy) {
  Json json = {{"lengthscale", vector_json(discrepancy.lengthscale)},
               {"stddev", vector_json(discrepancy.stddev)},
               {"directions", name_of(discrepancy_directions, discrepancy.base)}};
  if (discrepancy.half_range.size() > 0) {
    json["centre"] = vector_json(discrepancy.centre);
    json["half_range"] = vector_json(discrepancy.half_range);
  }
  return json;
}

Discrepancy discrepancy_from(const ParsedJson& json) {
  Discrepancy discrepancy{vector_from(json.at("lengthscale")), vector_from(json.at("stddev")), Latent::Base::acceleration};
  if (json.contains("directions")) {  // since format 11
    discrepancy.base = choice_from(json.at("directions"), discrepancy_directions, "direction of a discrepancy");
  }
  const auto are_scales = [](const Eigen::VectorXd& values) {
    return (values.array() >= smallest_scale && values.array() <= largest_number).all();
  };
  if (json.contains("half_range")) {  // since format 12
    discrepancy.centre = vector_from(json.at("centre"));
    discrepancy.half_range = vector_from(json.at("half_range"));
  }
  if (discrepancy.lengthscale.size() == 0 || !are_scales(discrepancy.lengthscale) || !are_scales(discrepancy.stddev) ||
      !are_scales(discrepancy.half_range)) {
    throw InputError(fmt::format("lengthscale, stddev and half_range of the discrepancy must be from {} to {}", smallest_scale,
                                 largest_number));
  }
  return discrepancy;
}

}  // namespace

Json model_json(const Model& model) {
  Json json = {{"name", model.name}, {"text", model.text}};
  if (model.code.mechanics) json["mechanics"] = left_to_code;
  if (!model.code.latents.empty()) json["latents"] = left_to_code;
  if (model.robot) json["robot"] = Json::parse(to_json(*model.robot));
  return json;
}

Model model_from(const ParsedJson& json, const ModelCode& given) {
  const bool mechanics = is_code(json, "mechanics"), latents = is_code(json, "latents");
  if ((mechanics && !given.mechanics) || (latents && given.latents.empty())) {
    throw InputError(
        fmt::format("the {} of its model '{}' are code, which a file cannot hold: read it where that code is, with "
                    "FitFile::read(path, code) or gp2.load(path, system=…)",
                    mechanics && !given.mechanics ? "mechanics" : "latents", json.at("name").get<std::string>()));
  }
  if (mechanics)
    return Model::parse(json.at("text"), json.at("name"), {given.mechanics, latents ? given.latents : decltype(given.latents)()});
  // a fit is whole in itself: its text must not make it read other files
  const RobotSource robot = [&](const std::string& file) {
    if (!json.contains("robot")) throw InputError(fmt::format("the fit does not hold the robot of '{}'", file));
    return robot_from_json(json.at("robot").dump());
  };
  return Model::parse(json.at("text"), json.at("name"), robot, {{}, latents ? given.latents : decltype(given.latents)()});
}

Json prior_json(const FitPriorOptions& options) {
  Json json = {{"mean", name_of(means, options.mean)},      {"directions", name_of(directions, options.base)},
               {"raw_angles", options.raw_angles},          {"kernel", options.kernel},
               {"kernel_along", options.kernel_along},      {"per_direction", options.per_direction},
               {"feature_centres", options.feature_centres}};
  if (options.baseline) json["baseline"] = baseline_json(*options.baseline);
  if (options.discrepancy) json["discrepancy"] = discrepancy_json(*options.discrepancy);
  return json;
}

FitPriorOptions prior_from(const ParsedJson& json) {
  FitPriorOptions options;
  options.mean = choice_from(json.at("mean"), means, "prior mean");
  options.base = choice_from(json.at("directions"), directions, "choice of directions");
  json.at("raw_angles").get_to(options.raw_angles);
  // until format 6 a latent without a kernel had this one
  options.kernel = "se";
  options.per_direction = false;
  if (json.contains("kernel")) {
    json.at("kernel").get_to(options.kernel);
    json.at("per_direction").get_to(options.per_direction);
  }
  options.kernel_along = json.value("kernel_along", options.kernel);  // since format 13
  if (json.contains("feature_centres")) {
    if (!json.at("feature_centres").is_object()) throw InputError("feature_centres must be an object of numbers");
    for (const auto& [feature, centre] : json.at("feature_centres").items()) {
      options.feature_centres.emplace(feature, number(centre));
    }
  }
  if (json.contains("discrepancy")) options.discrepancy = discrepancy_from(json.at("discrepancy"));
  if (json.contains("baseline")) options.baseline = baseline_from(json.at("baseline"));
  return options;
}

}  // namespace gp2::fit_json
