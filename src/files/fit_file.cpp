#include "gp2/files/fit_file.hpp"

#include <algorithm>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "files/fit_json.hpp"
#include "files/prior_difference.hpp"
#include "gp2/base/version.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "inference/inducing_summary.hpp"
#include "inference/requirements.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {

using namespace fit_json;
using Eigen::VectorXd;

namespace {

constexpr const char* format_name = "gp2 fit";

bool is_code(const Model& model, const Model* other) { return model.code || (other != nullptr && other->code); }

PriorAt at(const Prior& fitted, const View& view, const VectorXd& parameters) {
  return {prior_of(fitted, view), parameters_of(view, parameters)};
}

}  // namespace

FitFile::FitFile(Model fitted_model, FitPriorOptions options_of_prior, const Fit& fit,
                 std::vector<std::shared_ptr<const Model>> other_models)
    : model(std::move(fitted_model)),
      prior_options(std::move(options_of_prior)),
      observations(fit.posterior.observations()),
      systems(std::move(other_models)),
      report(fit.report) {
  const Prior made = prior();
  const VectorXd& parameters = fit.posterior.values().parameters;
  systems.resize(observations.size());
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const View& view = observations[g].view();
    std::shared_ptr<const OtherSystem> other;
    if (view.other_system && !systems[g]) {
      throw InputError(fmt::format("FitFile: the model file of the system of observations {} is not given", g + 1));
    }
    if (view.other_system) other = make_other_system(model, *systems[g], prior_options);
    const PriorAt here = {other ? other->prior : made, other ? other->parameters(parameters) : parameters};
    const PriorAt there = at(fit.posterior.prior(), view, parameters);
    const std::string differs = difference_at(observations[g], here, there);
    if (differs.empty()) continue;
    throw InputError(
        fmt::format("FitFile: model, prior_options and systems make another prior than that of the fit; what differs "
                    "at observations {}: {}",
                    g + 1, differs));
  }
  const std::vector<ModelValues> values = values_of(made, observations, report);
  bool same = static_cast<int>(values.size()) == fit.posterior.n_components();
  for (int k = 0; same && k < fit.posterior.n_components(); ++k) {
    same = are_same(values[static_cast<std::size_t>(k)], fit.posterior.component(k).values());
  }
  if (same) return;
  throw InputError("FitFile: the hyperparameters of the report are not those of the posterior");
}

namespace {

bool is_empty(const std::vector<Observations>& observations) {
  return std::ranges::all_of(observations, [](const Observations& group) { return group.n_data() == 0; });
}

}  // namespace

std::vector<std::int64_t> FitFile::n_states() const {
  if (report.inducing && report.inducing->summary) return report.inducing->summary->kept.n_states;
  std::vector<std::int64_t> n;
  for (const Observations& group : observations) n.push_back(group.n_data());
  return n;
}

bool FitFile::has_learned(const LogFile& log) const {
  return std::ranges::any_of(logs,
                             [&](const LogFile& known) { return known.checksum == log.checksum && known.bytes == log.bytes; });
}

void FitFile::take_data(const Posterior& posterior) {
  observations = posterior.observations();
  if (!report.inducing) return;
  const std::shared_ptr<const InducingSummary> before = std::exchange(report.inducing->summary, posterior.summary());
  if (!before) return;
  // scores are of the data that there were, and of what was not forgotten of them
  const KeptStates &then = before->kept, &now = report.inducing->summary->kept;
  if (then.n_states != now.n_states || then.share_of != now.share_of) report.inducing->stretches.reset();
}

Posterior FitFile::posterior() const { return posterior_of(prior(), observations, report); }

void FitFile::write(const std::filesystem::path& path) const {
  Json json;
  json["format"] = format_name;
  json["version"] = format_version;
  json["library"] = version();
  json["model"] = model_json(model);
  json["prior"] = prior_json(prior_options);
  const Prior fitted = prior();
  require_observations(fitted, observations);
  require_hyperparameters(fitted, observations, report.hyperparameters);
  const VectorXd parameters = model_values(fitted, observations, report.hyperparameters).parameters;
  json["hyperparameters"] = hyperparameters_json(report.hyperparameters, fitted);
  json["report"] = report_json(report);
  if (notes) json["report"]["notes"] = *notes;
  if (!report.actuators.empty()) json["actuators"] = actuators_json(report.actuators);
  if (!options.empty()) {
    json["options"] = Json::parse(options, nullptr, false);
    if (!json["options"].is_object())
      throw InputError(fmt::format("{}: the options of a fit must be a JSON object, got {}", path.string(), options));
  }
  json["data_source"] = data_source;
  if (!logs.empty()) json["logs"] = logs_json(logs);
  if (is_empty(observations)) throw InputError(fmt::format("{}: no observation is left to write", path.string()));
  json["observations"] = Json::array();
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const Model* other = observations[g].view().other_system && g < systems.size() ? systems[g].get() : nullptr;
    if (observations[g].view().other_system && other == nullptr) {
      throw InputError(fmt::format("{}: the model file of the system of observations {} is not given", path.string(), g + 1));
    }
    json["observations"].push_back(observations_json(observations[g], fitted, other));
    if (is_code(model, other) && observations[g].n_data() > 0)
      json["observations"].back()["code"] = code_json(at(fitted, observations[g].view(), parameters), observations[g]);
  }
  json["checksum"] = checksum_of(ParsedJson(json));
  // a path in `data_source` may hold bytes that are no text
  write_file(path, json.dump(1, ' ', false, Json::error_handler_t::replace) + "\n");
}

namespace {

// Out of a file, where it must be right. Formats before the sixth have none; one that is there counts all the same, so that a
// change of the version is seen too.
void take_checksum(ParsedJson& json) {
  const bool has_one = json.contains("checksum");
  if (!has_one && integer(json.at("version")) < 6) return;
  const std::string written = has_one ? shown(json.at("checksum")) : "missing";
  json.erase("checksum");
  const std::string is = '"' + checksum_of(json) + '"';
  if (written == is) return;
  throw InputError(fmt::format(
      "the file was changed after gp2 wrote it: its checksum is {}, its content has {}. If it is damaged, write it again "
      "with gp2 fit; if the change is meant, set \"checksum\": {} in the file",
      written, is, is));
}

bool is_fit(const ParsedJson& json) { return json.is_object() && json.contains("format") && json.at("format") == format_name; }

// a fit of a format that is known, as it was written
void require_fit(ParsedJson& json) {
  constexpr int format_version = FitFile::format_version;
  if (!is_fit(json)) throw InputError("not a fit written by gp2");
  const int file_version = integer(json.at("version"));
  if (file_version > format_version) {
    throw InputError(
        fmt::format("of format {}, but this gp2 ({}) reads up to {}: use a newer gp2", file_version, version(), format_version));
  }
  if (file_version < 1) throw InputError(fmt::format("format {} does not exist", file_version));
  take_checksum(json);
}

// What `read` makes of a file, which is named where something in it is wrong.
template <class Read>
auto naming(const std::filesystem::path& path, const Read& read) {
  try {
    return read();
  } catch (const Json::exception& error) {
    throw InputError(fmt::format("{}: not a whole fit file: {}", path.string(), error.what()));
  } catch (const InputError& error) {
    throw InputError(fmt::format("{}: {}", path.string(), error.what()));
  }
}

FitFile fit_from(ParsedJson& json, const ModelCode& code) {
  FitFile fit;
  require_fit(json);
  fit.model = model_from(json.at("model"), code);
  bool code_is_used = static_cast<bool>(fit.model.code);
  fit.prior_options = prior_from(json.at("prior"));
  fit.library = json.value("library", "");
  json.at("data_source").get_to(fit.data_source);
  if (json.contains("logs")) fit.logs = logs_from(json.at("logs"));
  if (json.contains("options")) {
    if (!json.at("options").is_object())
      throw InputError(fmt::format("options must be an object, got {}", shown(json.at("options"))));
    fit.options = json.at("options").dump();
  }
  const Prior prior = fit.prior();
  for (const ParsedJson& group : array(json.at("observations"))) {
    std::shared_ptr<const OtherSystem> other_system;
    std::shared_ptr<const Model>& system = fit.systems.emplace_back();
    if (group.contains("system")) {
      system = std::make_shared<const Model>(model_from(group.at("system"), code));
      code_is_used = code_is_used || system->code;
      other_system = make_other_system(fit.model, *system, fit.prior_options);
    }
    fit.observations.push_back(observations_from(group, prior, std::move(other_system)));
  }
  if (is_empty(fit.observations)) throw InputError("no observations");
  if (code && !code_is_used) throw InputError("code is given, but this fit is all text: read it without");
  fit.report.hyperparameters = hyperparameters_from(json.at("hyperparameters"));
  locate_in_model(fit.report.hyperparameters, prior, fit.observations);
  read_report(json.at("report"), prior, fit.observations, fit.report);
  const VectorXd parameters = model_values(prior, fit.observations, fit.report.hyperparameters).parameters;
  for (std::size_t g = 0; g < fit.observations.size(); ++g) {
    const ParsedJson& group = json.at("observations")[g];
    if (is_code(fit.model, fit.systems[g].get()) && group.contains("code"))  // since 0.2.0
      require_code(group.at("code"), at(prior, fit.observations[g].view(), parameters), fit.observations[g]);
  }
  if (json.at("report").contains("notes")) fit.notes = json.at("report").at("notes").get<std::vector<std::string>>();
  if (json.contains("actuators")) fit.report.actuators = actuators_from(json.at("actuators"), fit.model.actuators);
  return fit;
}

/// @param path  stands for the file in messages
FitFile read_fit(std::string_view text, const std::filesystem::path& path, const ModelCode& code) {
  const internal::StepLimit limit;  // for all its models together
  ParsedJson json = parse_json(text, path);
  return naming(path, [&] { return fit_from(json, code); });
}

}  // namespace

FitFile FitFile::parse(std::string_view text, const std::string& name) { return read_fit(text, name, {}); }

FitFile FitFile::read(const std::filesystem::path& path, const ModelCode& code) { return read_fit(read_file(path), path, code); }

namespace {

// Of a fit that needs code the hyperparameters alone are read: there is no model to hold them against.
std::vector<Hyperparameter> hyperparameters_of(const std::filesystem::path& path, ParsedJson& json) {
  const auto model = json.find("model");
  const bool with_code =
      model != json.end() && model->is_object() && (model->contains("mechanics") || model->contains("latents"));
  if (!with_code) return FitFile::read(path).report.hyperparameters;
  return naming(path, [&] {
    require_fit(json);
    return hyperparameters_from(json.at("hyperparameters"));
  });
}

std::vector<Hyperparameter>::iterator find_named(std::vector<Hyperparameter>& hyperparameters, const std::string& name) {
  return std::find_if(hyperparameters.begin(), hyperparameters.end(), [&](const auto& known) { return known.name == name; });
}

}  // namespace

std::map<std::string, double> read_start_values(const std::filesystem::path& path, std::vector<Hyperparameter>& hyperparameters,
                                                const std::vector<std::string>& others) {
  ParsedJson json = parse_json(read_file(path), path);
  std::map<std::string, double> values, left_out;
  if (is_fit(json)) {
    // a fit may have had more to tune than this one; a hand-written value must mean something
    const std::vector<Hyperparameter> of_fit = hyperparameters_of(path, json);
    for (const Hyperparameter& h : of_fit) {
      if (find_named(hyperparameters, h.name) != hyperparameters.end()) {
        values[h.name] = h.value;
      } else if (h.is_system_parameter()) {
        left_out[h.name] = h.value;
      }
    }
    if (json.contains("actuators")) {
      naming(path, [&] {
        for (const ParsedJson& one : json.at("actuators"))
          left_out[one.at("name").get<std::string>()] = one.at("value").get<double>();
      });
    }
    if (values.empty() && !of_fit.empty() && !hyperparameters.empty()) {
      throw InputError(fmt::format("{}: none of its hyperparameters, '{}' and so on, is one of this fit, '{}' and so on",
                                   path.string(), of_fit.front().name, hyperparameters.front().name));
    }
  } else if (json.is_object()) {
    for (const auto& [name, value] : json.items()) {
      if (!value.is_number())
        throw InputError(fmt::format("{}: '{}' is not a number but {}", path.string(), name, value.type_name()));
      (std::ranges::find(others, name) == others.end() ? values : left_out)[name] = value.get<double>();
    }
  } else {
    throw InputError(fmt::format("{}: expected {{\"name\": value, …}} or a file written by gp2 fit", path.string()));
  }
  set_start_values(values, path.string(), hyperparameters, others);
  return left_out;
}

void set_start_values(const std::map<std::string, double>& values, const std::string& source,
                      std::vector<Hyperparameter>& hyperparameters, const std::vector<std::string>& others) {
  std::vector<Hyperparameter> started = hyperparameters;
  for (const auto& [name, value] : values) {
    const auto h = find_named(started, name);
    if (h == started.end()) {
      std::vector<std::string> known;
      for (const Hyperparameter& other : started) known.push_back(other.name);
      known.insert(known.end(), others.begin(), others.end());
      throw InputError(fmt::format("{}: unknown hyperparameter '{}'; this fit has: {}", source, name, fmt::join(known, ", ")));
    }
    // a value printed with a few digits less may lie a rounding outside
    const double tolerance = 1e-9 * (h->positive ? std::abs(value) : h->upper - h->lower);
    if (!(value >= h->lower - tolerance && value <= h->upper + tolerance)) {
      throw InputError(fmt::format("{}: {} = {} is outside its bounds [{}, {}]", source, name, value, h->lower, h->upper));
    }
    h->value = std::clamp(value, h->lower, h->upper);
  }
  hyperparameters = std::move(started);
}

}  // namespace gp2
