#include "gp2/fit_file.hpp"

#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <nlohmann/json.hpp>

#include "gp2/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/version.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Json = nlohmann::ordered_json;
using Kind = Hyperparameter::Kind;

NLOHMANN_JSON_SERIALIZE_ENUM(Hyperparameter::Kind, {{Kind::kernel, "kernel"},
                                                    {Kind::signal_stddev, "signal_stddev"},
                                                    {Kind::shared_signal_stddev, "shared_signal_stddev"},
                                                    {Kind::noise_stddev, "noise_stddev"},
                                                    {Kind::parameter, "parameter"}})

namespace {

constexpr const char* format_name = "gp2 fit";

Json parse_json(const std::filesystem::path& path) {
  Json json = Json::parse(read_file(path), nullptr, false);
  if (json.is_discarded()) {
    throw InputError(fmt::format("{}: not valid JSON: the file is cut short or damaged; write it again with gp2 fit", path.string()));
  }
  return json;
}

Json vector_json(const VectorXd& values) { return std::vector<double>(values.begin(), values.end()); }

VectorXd vector_from(const Json& json) {
  const auto values = json.get<std::vector<double>>();
  return Eigen::Map<const VectorXd>(values.data(), static_cast<Index>(values.size()));
}

// one named array per row; rows that are not measured (NaN) are left out
Json rows_json(const MatrixXd& matrix, const std::vector<std::string>& names) {
  Json json = Json::object();
  for (Index k = 0; k < matrix.rows(); ++k) {
    if (matrix.row(k).hasNaN()) continue;
    json[names[static_cast<std::size_t>(k)]] = vector_json(matrix.row(k));
  }
  return json;
}

MatrixXd rows_from(const Json& json, const std::vector<std::string>& names, Index n) {
  MatrixXd matrix = MatrixXd::Constant(static_cast<Index>(names.size()), n, std::numeric_limits<double>::quiet_NaN());
  for (const auto& [name, values] : json.items()) {
    const auto row = std::find(names.begin(), names.end(), name);
    if (row == names.end()) throw InputError(fmt::format("'{}' is not of this model", name));
    const VectorXd entries = vector_from(values);
    if (entries.size() != n) throw InputError(fmt::format("'{}' has {} values, expected {}", name, entries.size(), n));
    matrix.row(row - names.begin()) = entries;
  }
  return matrix;
}

Json hyperparameter_json(const Hyperparameter& h) {
  Json json = {{"name", h.name}, {"value", h.value}, {"lower", h.lower},   {"upper", h.upper}, {"unit", h.unit},
               {"at_bound", h.at_bound()}, {"kind", h.kind},   {"owner", h.owner}, {"index", h.index}};
  if (h.scale.size() > 0) json["scale"] = vector_json(h.scale);
  if (h.log_stddev > 0) json["hyperprior"] = {{"median", h.median}, {"log_stddev", h.log_stddev}};
  return json;
}

Hyperparameter hyperparameter_from(const Json& json) {
  Hyperparameter h;
  json.at("name").get_to(h.name);
  json.at("value").get_to(h.value);
  json.at("lower").get_to(h.lower);
  json.at("upper").get_to(h.upper);
  json.at("unit").get_to(h.unit);
  json.at("kind").get_to(h.kind);
  json.at("owner").get_to(h.owner);
  json.at("index").get_to(h.index);
  if (json.contains("scale")) h.scale = vector_from(json.at("scale"));
  if (json.contains("hyperprior")) {
    json.at("hyperprior").at("median").get_to(h.median);
    json.at("hyperprior").at("log_stddev").get_to(h.log_stddev);
  }
  if (!std::isfinite(h.value) || (h.is_positive() && !(h.value > 0))) {
    throw InputError(fmt::format("hyperparameter '{}' has the impossible value {}", h.name, h.value));
  }
  return h;
}

// indices from a file must point at what the model has
void check_hyperparameter(const Hyperparameter& h, const Prior& prior, const std::vector<Observations>& observations) {
  const auto inside = [](int index, std::size_t size) { return index >= 0 && static_cast<std::size_t>(index) < size; };
  bool good = true;
  switch (h.kind) {
    case Kind::kernel:
      good = inside(h.owner, prior.latents.size()) &&
             inside(h.index, prior.latents[static_cast<std::size_t>(h.owner)].kernel.parameters().size());
      break;
    case Kind::signal_stddev:
      good = inside(h.owner, prior.latents.size()) &&
             inside(h.index, prior.latents[static_cast<std::size_t>(h.owner)].column_names.size());
      break;
    case Kind::shared_signal_stddev:
      good = inside(h.owner, prior.latents.size()) &&
             h.scale.size() == prior.latents[static_cast<std::size_t>(h.owner)].size();
      break;
    case Kind::noise_stddev:
      good = inside(h.owner, observations.size()) &&
             inside(h.index, observations[static_cast<std::size_t>(h.owner)].view.rows.size());
      break;
    case Kind::parameter:
      good = inside(h.index, prior.system->parameters().size());
      break;
  }
  if (!good) throw InputError(fmt::format("hyperparameter '{}' belongs to nothing in this model", h.name));
}

Json observations_json(const Observations& group, const System& system) {
  const bool constrained = group.view.quantity == View::Quantity::constrained_acceleration;
  return {{"view", constrained ? "constrained" : "unconstrained"},
          {"rows", group.view.rows},
          {"n", group.n_data()},
          {"noise_stddev", vector_json(group.noise_stddev)},
          {"estimate_noise", group.estimate_noise},
          {"states", rows_json(group.states, system.state_names())},
          {"values", rows_json(group.values, group.view.names(system))}};
}

Observations observations_from(const Json& json, const System& system) {
  Observations group;
  const std::string view = json.at("view").get<std::string>();
  if (view != "constrained" && view != "unconstrained") throw InputError(fmt::format("unknown view '{}'", view));
  group.view.quantity =
      view == "constrained" ? View::Quantity::constrained_acceleration : View::Quantity::unconstrained_acceleration;
  json.at("rows").get_to(group.view.rows);
  for (int row : group.view.rows) {
    if (row < 0 || row >= system.nq()) throw InputError(fmt::format("row {} of a view is outside 0 … {}", row, system.nq() - 1));
  }
  const Index n = json.at("n").get<Index>();
  group.noise_stddev = vector_from(json.at("noise_stddev"));
  if (group.noise_stddev.size() != group.view.size() || !(group.noise_stddev.array() > 0).all()) {
    throw InputError("noise_stddev must hold one positive number per row of the view");
  }
  json.at("estimate_noise").get_to(group.estimate_noise);
  if (n < 1 || n > 10'000'000) throw InputError(fmt::format("{} observations are not possible", n));
  group.states = rows_from(json.at("states"), system.state_names(), n);
  group.values = rows_from(json.at("values"), group.view.names(system), n);
  if (group.values.hasNaN()) throw InputError("values are missing");
  return group;
}

Json restart_json(const RestartReport& r) {
  return {{"objective", std::isfinite(r.objective) ? Json(r.objective) : Json()},
          {"nll", std::isfinite(r.negative_log_likelihood) ? Json(r.negative_log_likelihood) : Json()},
          {"iterations", r.iterations},
          {"evaluations", r.evaluations},
          {"failed_evaluations", r.failed_evaluations},
          {"converged", r.converged},
          {"termination", r.termination}};
}

}  // namespace

Posterior FitFile::posterior() const {
  const Prior prior_of_model = prior();
  return {prior_of_model, observations, model_values(prior_of_model, observations, report.hyperparameters)};
}

void FitFile::write(const std::filesystem::path& path) const {
  Json json;
  json["format"] = format_name;
  json["version"] = format_version;
  json["library"] = version();
  json["model"] = {{"name", model.name}, {"text", model.text}};
  json["prior"] = {{"mean", prior_options.mean == Prior::Mean::force ? "force" : "zero"},
                   {"directions", !prior_options.base                                  ? "model"
                                  : *prior_options.base == Latent::Base::force ? "force"
                                                                                       : "acceleration"},
                   {"raw_angles", prior_options.raw_angles}};
  json["hyperparameters"] = Json::array();
  for (const Hyperparameter& h : report.hyperparameters) json["hyperparameters"].push_back(hyperparameter_json(h));
  json["report"] = {{"nll", report.negative_log_likelihood},
                    {"objective", report.objective},
                    {"converged", report.converged},
                    {"termination", report.termination},
                    {"iterations", report.iterations},
                    {"best_restart", report.best_restart},
                    {"restarts", Json::array()}};
  for (const RestartReport& restart : report.restarts) json["report"]["restarts"].push_back(restart_json(restart));
  json["data_source"] = data_source;
  json["observations"] = Json::array();
  for (const Observations& group : observations) json["observations"].push_back(observations_json(group, *model.system));
  write_file(path, json.dump(1) + "\n");
}

FitFile FitFile::read(const std::filesystem::path& path) {
  const Json json = parse_json(path);
  FitFile fit;
  try {
    if (!json.is_object() || !json.contains("format") || json.at("format") != format_name) {
      throw InputError("not a fit written by gp2");
    }
    const int file_version = json.at("version").get<int>();
    if (file_version > format_version) {
      throw InputError(fmt::format("of format {}, but this gp2 ({}) reads up to {}: use a newer gp2", file_version, version(),
                                   format_version));
    }
    if (file_version < 1) throw InputError(fmt::format("format {} does not exist", file_version));
    fit.model = ModelFile::parse(json.at("model").at("text"), json.at("model").at("name"));
    const Json& prior_json = json.at("prior");
    fit.prior_options.mean = prior_json.at("mean") == "force" ? Prior::Mean::force : Prior::Mean::zero;
    if (prior_json.at("directions") != "model") {
      fit.prior_options.base = prior_json.at("directions") == "force" ? Latent::Base::force : Latent::Base::acceleration;
    }
    prior_json.at("raw_angles").get_to(fit.prior_options.raw_angles);
    json.at("data_source").get_to(fit.data_source);
    for (const Json& group : json.at("observations")) fit.observations.push_back(observations_from(group, *fit.model.system));
    if (fit.observations.empty()) throw InputError("no observations");
    const Prior prior = fit.prior();
    for (const Json& h : json.at("hyperparameters")) {
      fit.report.hyperparameters.push_back(hyperparameter_from(h));
      check_hyperparameter(fit.report.hyperparameters.back(), prior, fit.observations);
    }
    const Json& report = json.at("report");
    report.at("nll").get_to(fit.report.negative_log_likelihood);
    report.at("objective").get_to(fit.report.objective);
    report.at("converged").get_to(fit.report.converged);
    report.at("termination").get_to(fit.report.termination);
    report.at("iterations").get_to(fit.report.iterations);
    report.at("best_restart").get_to(fit.report.best_restart);
    for (const Json& r : report.at("restarts")) {
      const auto number = [&](const char* key) {
        return r.at(key).is_null() ? std::numeric_limits<double>::infinity() : r.at(key).get<double>();
      };
      fit.report.restarts.push_back({number("objective"), number("nll"), r.at("iterations"), r.at("evaluations"),
                                     r.at("failed_evaluations"), r.at("converged"), r.at("termination")});
    }
  } catch (const Json::exception& error) {
    throw InputError(fmt::format("{}: not a whole fit file: {}", path.string(), error.what()));
  } catch (const InputError& error) {
    throw InputError(fmt::format("{}: {}", path.string(), error.what()));
  }
  return fit;
}

void read_start_values(const std::filesystem::path& path, std::vector<Hyperparameter>& hyperparameters) {
  const Json json = parse_json(path);
  std::vector<std::pair<std::string, double>> values;
  const bool is_fit = json.is_object() && json.contains("format") && json.at("format") == format_name;
  if (is_fit) {
    for (const Hyperparameter& h : FitFile::read(path).report.hyperparameters) values.emplace_back(h.name, h.value);
  } else if (json.is_object()) {
    for (const auto& [name, value] : json.items()) {
      if (!value.is_number()) throw InputError(fmt::format("{}: '{}' is not a number", path.string(), name));
      values.emplace_back(name, value.get<double>());
    }
  } else {
    throw InputError(fmt::format("{}: expected {{\"name\": value, …}} or a file written by gp2 fit", path.string()));
  }

  for (const auto& [name, value] : values) {
    const auto h = std::find_if(hyperparameters.begin(), hyperparameters.end(), [&](const auto& known) { return known.name == name; });
    if (h == hyperparameters.end()) {
      // a fit may have had more to tune than this one; a hand-written value must mean something
      if (is_fit) continue;
      std::vector<std::string> known;
      for (const Hyperparameter& other : hyperparameters) known.push_back(other.name);
      throw InputError(fmt::format("{}: unknown hyperparameter '{}'; this fit has: {}", path.string(), name, fmt::join(known, ", ")));
    }
    const double tolerance = 1e-9 * (h->is_positive() ? std::abs(value) : h->upper - h->lower);
    if (!(value >= h->lower - tolerance && value <= h->upper + tolerance)) {
      throw InputError(fmt::format("{}: {} = {} is outside its bounds [{}, {}]", path.string(), name, value, h->lower, h->upper));
    }
    h->value = std::min(std::max(value, h->lower), h->upper);
  }
}

}  // namespace gp2
