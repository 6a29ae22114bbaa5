#include "gp2/files/fit_file.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <iterator>
#include <limits>
#include <set>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <nlohmann/json.hpp>

#include "base/checksum.hpp"
#include "gp2/base/version.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "inference/inducing_summary.hpp"
#include "inference/requirements.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Json = nlohmann::ordered_json;  // written: keys in the order that a person reads
using ParsedJson = nlohmann::json;    // read: keys are found in no time, however many a file claims
using Kind = Hyperparameter::Kind;

namespace {

constexpr const char* format_name = "gp2 fit";

// a choice and its name in the file
template <class Choice>
using Named = std::pair<Choice, const char*>;

constexpr std::array<Named<Kind>, 5> kinds = {{{Kind::kernel, "kernel"},
                                               {Kind::signal_stddev, "signal_stddev"},
                                               {Kind::shared_signal_stddev, "shared_signal_stddev"},
                                               {Kind::noise_stddev, "noise_stddev"},
                                               {Kind::parameter, "parameter"}}};
constexpr std::array<Named<Prior::Mean>, 2> means = {{{Prior::Mean::zero, "zero"}, {Prior::Mean::force, "force"}}};
constexpr std::array<Named<std::optional<Latent::Base>>, 3> directions = {
    {{std::nullopt, "model"}, {Latent::Base::acceleration, "acceleration"}, {Latent::Base::force, "force"}}};

constexpr std::array<Named<Latent::Base>, 2> discrepancy_directions = {
    {{Latent::Base::admissible, "admissible"}, {Latent::Base::acceleration, "acceleration"}}};

template <class Choice, std::size_t n>
const char* name_of(const std::array<Named<Choice>, n>& choices, Choice choice) {
  return std::find_if(choices.begin(), choices.end(), [&](const auto& known) { return known.first == choice; })->second;
}

template <class Choice, std::size_t n>
Choice choice_from(const ParsedJson& json, const std::array<Named<Choice>, n>& choices, const char* what) {
  const auto name = json.get<std::string>();
  const auto known = std::find_if(choices.begin(), choices.end(), [&](const auto& other) { return name == other.second; });
  if (known == choices.end()) throw InputError(fmt::format("'{}' is no {}", name, what));
  return known->first;
}

// NaN and ∞ are null
Json actuators_json(const std::vector<ActuatorEstimate>& estimates) {
  Json json = Json::array();
  for (const ActuatorEstimate& one : estimates) {
    json.push_back({{"name", one.name},
                    {"value", one.value},
                    {"stddev", std::isfinite(one.stddev) ? Json(one.stddev) : Json()},
                    {"lower", one.lower},
                    {"upper", one.upper}});
  }
  return json;
}

// a value to show in a message
std::string shown(const ParsedJson& json) { return json.is_structured() ? json.type_name() : json.dump(); }

// a whole number, where Json itself would round or wrap
int integer(const ParsedJson& json) {
  constexpr auto largest = std::numeric_limits<int>::max();
  if (!json.is_number_integer()) throw InputError(fmt::format("{} stands where a whole number must", shown(json)));
  if (std::abs(json.get<double>()) > largest) throw InputError(fmt::format("{} is too large", shown(json)));
  return json.get<int>();
}

// an array, where a loop would also take other values
const ParsedJson& array(const ParsedJson& json) {
  if (!json.is_array()) throw InputError(fmt::format("{} stands where an array must", shown(json)));
  return json;
}

// No quantity, and the square of none, is beyond these: sums over data stay finite.
constexpr double largest_number = 1e100, smallest_scale = 1e-100;

double number(const ParsedJson& json) {
  if (!json.is_number()) throw InputError(fmt::format("{} stands where a number must", shown(json)));
  return json.get<double>();
}

// What reads JSON goes down a level by calling itself: a file must not make it go down without end.
constexpr int max_depth = 64;

/// @param path  stands for the file in messages
ParsedJson parse_json(std::string_view text, const std::filesystem::path& path) {
  const auto check_depth = [&](int depth, ParsedJson::parse_event_t, const ParsedJson&) {
    if (depth > max_depth) throw InputError(fmt::format("{}: nested deeper than {} levels", path.string(), max_depth));
    return true;
  };
  ParsedJson json = ParsedJson::parse(text, check_depth, false);
  if (json.is_discarded()) {
    throw InputError(
        fmt::format("{}: not valid JSON: the file is cut short or damaged; write it again with gp2 fit", path.string()));
  }
  return json;
}

// Over the compact text with sorted keys, in which only what is meant counts. It guards against damage and slips of the pen, not
// against intent, so no cryptographic digest, and no library for one, is needed: who means a change is told the checksum to write.
std::string checksum_of(const ParsedJson& json) {
  return checksum(json.dump(-1, ' ', false, ParsedJson::error_handler_t::replace));
}

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

// NaN becomes null
Json vector_json(const VectorXd& values) { return std::vector<double>(values.begin(), values.end()); }

VectorXd vector_from(const ParsedJson& json) {
  VectorXd values(static_cast<Index>(array(json).size()));
  std::transform(json.begin(), json.end(), values.begin(), number);
  return values;
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

// one named array per row, of a measured quantity: null where a value is not measured
Json measured_json(const MatrixXd& matrix, const std::vector<std::string>& names) {
  Json json = Json::object();
  for (Index k = 0; k < matrix.rows(); ++k) json[names[static_cast<std::size_t>(k)]] = vector_json(matrix.row(k));
  return json;
}

double number_or_missing(const ParsedJson& json) {
  return json.is_null() ? std::numeric_limits<double>::quiet_NaN() : number(json);
}

MatrixXd rows_from(const ParsedJson& json, const std::vector<std::string>& names, const std::vector<bool>& needed, Index n,
                   double (*entry)(const ParsedJson&) = number) {
  if (!json.is_object()) throw InputError("expected an object of named arrays");
  // sizes first: a damaged n must not ask for memory
  for (const auto& [name, values] : json.items()) {
    if (std::find(names.begin(), names.end(), name) == names.end())
      throw InputError(fmt::format("'{}' is not of this model", name));
    if (!values.is_array() || values.size() != static_cast<std::size_t>(n)) {
      throw InputError(fmt::format("'{}' has {} values, expected {}", name, values.size(), n));
    }
  }
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (needed[k] && !json.contains(names[k])) throw InputError(fmt::format("the values of '{}' are missing", names[k]));
  }
  MatrixXd matrix = MatrixXd::Constant(static_cast<Index>(names.size()), n, std::numeric_limits<double>::quiet_NaN());
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (!json.contains(names[k])) continue;
    const Json& values = json.at(names[k]);
    std::transform(values.begin(), values.end(), matrix.row(static_cast<Index>(k)).begin(), entry);
    const double largest =
        matrix.row(static_cast<Index>(k)).array().isNaN().select(0, matrix.row(static_cast<Index>(k)).cwiseAbs()).maxCoeff();
    if (largest > largest_number) {
      throw InputError(fmt::format("'{}' holds a number of the size {:.3g}; at most {:.0e} can be computed with", names[k],
                                   largest, largest_number));
    }
  }
  return matrix;
}

// What a hyperparameter is called in the file. Entries of a free loading go by the names of baselines, which alone have one.
struct Label {
  std::string kind;
  int owner, index;

  auto operator<=>(const Label&) const = default;
};

std::string kind_word(const Hyperparameter& h) {
  if (h.kind != Kind::loading) return name_of(kinds, h.kind);
  return LoadingEntry::word(h.positive ? LoadingEntry::Kind::sqrt_kappa : LoadingEntry::Kind::mixing);
}

Label label_of(const Hyperparameter& h, const Prior& prior) {
  Label label{kind_word(h), h.owner, h.index};
  if (h.kind != Kind::loading) return label;
  const std::vector<LoadingEntry> entries = loading_entries(prior.latents[static_cast<std::size_t>(h.owner)]);
  const auto is_it = [&](const LoadingEntry& entry) { return entry.index_in_loading == h.index; };
  label.index = std::find_if(entries.begin(), entries.end(), is_it)->index;
  return label;
}

Json hyperprior_json(const HyperPrior& prior) {
  const bool normal = prior.form == HyperPrior::Form::normal;
  Json json = {{normal ? "mean" : "median", prior.median}, {normal ? "stddev" : "log_stddev", prior.stddev}};
  if (!prior.family.empty()) json.update({{"family", prior.family}, {"correlation", prior.correlation}});
  return json;
}

Json hyperparameter_json(const Hyperparameter& h, const Prior& prior) {
  const Label label = label_of(h, prior);
  Json json = {{"name", h.name},           {"value", h.value},   {"lower", h.lower},     {"upper", h.upper},    {"unit", h.unit},
               {"at_bound", h.at_bound()}, {"kind", label.kind}, {"owner", label.owner}, {"index", label.index}};
  if (h.column_scale.size() > 0) json["scale"] = vector_json(h.column_scale);
  if (h.size > 0) json["scale"] = Json::array({h.size});
  if (h.hyperprior.form != HyperPrior::Form::none) json["hyperprior"] = hyperprior_json(h.hyperprior);
  for (const Hyperparameter::Follower& f : h.followers)
    json["followers"].push_back({{"latent", f.latent}, {"column", f.column}, {"share", f.share}});
  return json;
}

HyperPrior hyperprior_from(const ParsedJson& json) {
  const bool normal = json.contains("mean");
  HyperPrior prior{normal ? HyperPrior::Form::normal : HyperPrior::Form::log_normal, number(json.at(normal ? "mean" : "median")),
                   number(json.at(normal ? "stddev" : "log_stddev"))};
  if (json.contains("family")) {
    json.at("family").get_to(prior.family);
    prior.correlation = number(json.at("correlation"));
  }
  return prior.stddev > 0 ? prior : HyperPrior{};
}

// The kind of a hyperparameter, and whether it is positive.
Hyperparameter of_kind(const ParsedJson& json) {
  for (const LoadingEntry::Kind kind : {LoadingEntry::Kind::mixing, LoadingEntry::Kind::sqrt_kappa}) {
    if (json != LoadingEntry::word(kind)) continue;
    Hyperparameter h = Hyperparameter::of(Kind::loading, 0, 0);
    h.positive = kind == LoadingEntry::Kind::sqrt_kappa;
    return h;
  }
  return Hyperparameter::of(choice_from(json, kinds, "kind of hyperparameter"), 0, 0);
}

// As it is labelled: locate_in_model finds the entry of a loading.
Hyperparameter hyperparameter_from(const ParsedJson& json) {
  Hyperparameter h = of_kind(json.at("kind"));
  json.at("name").get_to(h.name);
  json.at("unit").get_to(h.unit);
  h.value = number(json.at("value"));
  h.lower = number(json.at("lower"));
  h.upper = number(json.at("upper"));
  h.owner = integer(json.at("owner"));
  h.index = integer(json.at("index"));
  const VectorXd scale = json.contains("scale") ? vector_from(json.at("scale")) : VectorXd();
  const bool has_size = h.kind == Kind::loading;
  if ((h.positive && !(h.value >= smallest_scale)) || std::abs(h.value) > largest_number || !(scale.array() > 0).all() ||
      (has_size && scale.size() != 1)) {
    throw InputError(fmt::format("hyperparameter '{}' has the impossible value {}", h.name, h.value));
  }
  if (has_size) h.size = scale[0];
  if (h.kind == Kind::shared_signal_stddev) h.column_scale = scale;
  if (json.contains("hyperprior")) h.hyperprior = hyperprior_from(json.at("hyperprior"));
  if (json.contains("followers")) {
    for (const ParsedJson& follower : json.at("followers"))
      h.followers.push_back({integer(follower.at("latent")), integer(follower.at("column")), number(follower.at("share"))});
  }
  return h;
}

// Hyperparameters that a prior and its observations may have.
struct Labels {
  std::set<Label> needed, optional;

  Labels(const Prior& prior, const std::vector<Observations>& observations) {
    const auto add = [](std::set<Label>& set, Kind kind, std::size_t owner, std::size_t size) {
      for (std::size_t k = 0; k < size; ++k) set.insert({name_of(kinds, kind), static_cast<int>(owner), static_cast<int>(k)});
    };
    for (std::size_t a = 0; a < prior.latents.size(); ++a) {
      const Latent& latent = prior.latents[a];
      if (!latent.kernel_is_fixed) add(needed, Kind::kernel, a, latent.kernel.parameters().size());
      for (const LoadingEntry& entry : loading_entries(latent)) {
        needed.insert({LoadingEntry::word(entry.kind), static_cast<int>(a), entry.index});
      }
      // one signal for all is 1 where it is not told, as in files of before it was learned
      if (!latent.free_loading)
        add(latent.has_one_signal ? optional : needed, Kind::signal_stddev, a, latent.column_names.size());
    }
    for (std::size_t group = 0; group < observations.size(); ++group) {
      add(optional, Kind::noise_stddev, group, observations[group].view().rows.size());
    }
    add(optional, Kind::parameter, 0, prior.system->parameters().size());
  }

  // whether a label was there, and not taken before
  bool take(const Label& label) { return needed.erase(label) + optional.erase(label) == 1; }

  bool take_columns(const Hyperparameter& shared, const Prior& prior) {
    bool good = shared.owner >= 0 && shared.owner < static_cast<int>(prior.latents.size()) &&
                shared.column_scale.size() == prior.latents[static_cast<std::size_t>(shared.owner)].size();
    for (int k = 0; good && k < shared.column_scale.size(); ++k) {
      good = take({name_of(kinds, Kind::signal_stddev), shared.owner, k});
    }
    return good;
  }
};

int index_in_loading(const Label& label, const Latent& latent) {
  const std::vector<LoadingEntry> entries = loading_entries(latent);
  const auto is_it = [&](const LoadingEntry& e) { return label.kind == LoadingEntry::word(e.kind) && label.index == e.index; };
  return std::find_if(entries.begin(), entries.end(), is_it)->index_in_loading;
}

// every hyperparameter belongs to something the model has, once, and every kernel and signal has its values
void locate_in_model(std::vector<Hyperparameter>& hyperparameters, const Prior& prior,
                     const std::vector<Observations>& observations) {
  Labels labels(prior, observations);
  for (Hyperparameter& h : hyperparameters) {
    const Label label{kind_word(h), h.owner, h.index};
    const bool good = h.kind == Kind::shared_signal_stddev ? labels.take_columns(h, prior) : labels.take(label);
    if (!good) throw InputError(fmt::format("hyperparameter '{}' belongs to nothing in this model, or stands twice", h.name));
    if (h.kind == Kind::loading) h.index = index_in_loading(label, prior.latents[static_cast<std::size_t>(h.owner)]);
  }
  if (labels.needed.empty()) return;
  const auto& [kind, owner, index] = *labels.needed.begin();
  throw InputError(
      fmt::format("{} {} of latent '{}' has no value", kind, index + 1, prior.latents[static_cast<std::size_t>(owner)].name));
}

constexpr const char* left_to_code = "code";

Json model_json(const Model& model) {
  Json json = {{"name", model.name}, {"text", model.text}};
  if (model.code.mechanics) json["mechanics"] = left_to_code;
  if (!model.code.latents.empty()) json["latents"] = left_to_code;
  if (model.robot) json["robot"] = Json::parse(to_json(*model.robot));
  return json;
}

bool is_code(const ParsedJson& model, const char* part) {
  if (!model.contains(part)) return false;
  if (model.at(part) != left_to_code) throw InputError(fmt::format("{} as {} are not known", part, shown(model.at(part))));
  return true;
}

Model model_from(const ParsedJson& json, const ModelCode& given) {
  const bool mechanics = is_code(json, "mechanics"), latents = is_code(json, "latents");
  if ((mechanics && !given.mechanics) || (latents && given.latents.empty())) {
    throw InputError(
        fmt::format("the {} of its model '{}' are code, which a file cannot hold: read it where that code is, with "
                    "FitFile::read(path, code)",
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

Json baseline_json(const Baseline& baseline) {
  return {{"kind", Baseline::word(baseline.kind)},
          {"output_mean", vector_json(baseline.output_mean)},
          {"feature_mean", vector_json(baseline.feature_mean)},
          {"feature_stddev", vector_json(baseline.feature_stddev)}};
}

Discrepancy discrepancy_from(const ParsedJson& json) {
  Discrepancy discrepancy{vector_from(json.at("lengthscale")), vector_from(json.at("stddev")), Latent::Base::acceleration};
  if (json.contains("directions")) {  // since format 11
    discrepancy.base = choice_from(json.at("directions"), discrepancy_directions, "direction of a discrepancy");
  }
  const auto are_scales = [](const VectorXd& values) {
    return (values.array() >= smallest_scale && values.array() <= largest_number).all();
  };
  if (discrepancy.lengthscale.size() == 0 || !are_scales(discrepancy.lengthscale) || !are_scales(discrepancy.stddev)) {
    throw InputError(
        fmt::format("lengthscale and stddev of the discrepancy must be from {} to {}", smallest_scale, largest_number));
  }
  return discrepancy;
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

/// @param other  the model of its view's other system; null: none
Json observations_json(const Observations& group, const Prior& home, const Model* other) {
  const System& system = *prior_of(home, group.view()).system;
  Json json = {{"view", group.view().quantity->word()},
               {"rows", group.view().rows},
               {"time_step", group.view().time_step.value_or(0)},
               {"latent", group.view().latent.value_or(-1).first},
               {"n", group.n_data()},
               {"noise_stddev", vector_json(group.noise().stddev())},
               {"estimate_noise", group.noise().is_estimated()},
               {"states", rows_json(group.states(), system.state_names())},
               {"values", measured_json(group.values(), group.view().names(system))}};
  if (group.view().latent && group.view().latent->n > 1) json["n_latents"] = group.view().latent->n;
  if (group.noise().has_scale()) json["noise_scale"] = measured_json(group.noise().scale(), group.view().names(system));
  if (other != nullptr) json["system"] = model_json(*other);
  for (const WeightedSum& sum : group.sums()) {
    json["sums"].push_back({{"row", sum.row},
                            {"first", sum.first},
                            {"weights", vector_json(sum.weights)},
                            {"value", sum.value},
                            {"noise", vector_json(sum.noise)}});
  }
  return json;
}

View view_from(const ParsedJson& json, const Prior& home, std::shared_ptr<const OtherSystem> other_system) {
  View view;
  view.other_system = std::move(other_system);
  const Prior& prior = prior_of(home, view);
  const auto word = json.at("view").get<std::string>();
  const std::optional<View::Quantity> quantity = View::Quantity::of_word(word);
  if (!quantity) throw InputError(fmt::format("'{}' is no view", word));
  view.quantity = *quantity;
  const double time_step = number(json.at("time_step"));
  if ((*quantity)->needs_time_step()) {
    if (!(time_step > 0)) throw InputError(fmt::format("the time_step of {} must be positive", word));
    view.time_step = time_step;
  }
  const int latent = integer(json.at("latent"));
  if (latent < -1 || latent >= static_cast<int>(prior.latents.size())) {
    throw InputError(fmt::format("latent {} of a view is outside -1 … {}", latent, prior.latents.size() - 1));
  }
  if (latent >= 0) view.latent = {latent, json.contains("n_latents") ? integer(json.at("n_latents")) : 1};
  const int n_rows = View::all(*quantity, *prior.system).size();
  for (const ParsedJson& row : array(json.at("rows"))) {
    const int index = integer(row);
    if (index < 0 || index >= n_rows) throw InputError(fmt::format("row {} of a view is outside 0 … {}", index, n_rows - 1));
    if (std::find(view.rows.begin(), view.rows.end(), index) != view.rows.end()) {
      throw InputError(fmt::format("row {} of a view stands twice", index));
    }
    view.rows.push_back(index);
  }
  if (view.rows.empty()) throw InputError("a view without rows");
  return view;
}

Observations observations_from(const ParsedJson& json, const Prior& home, std::shared_ptr<const OtherSystem> other_system) {
  View view = view_from(json, home, std::move(other_system));
  const Prior& prior = prior_of(home, view);
  const System& system = *prior.system;
  const int n = integer(json.at("n"));
  if (n < 1) throw InputError(fmt::format("{} observations are not possible", n));
  VectorXd noise_stddev = vector_from(json.at("noise_stddev"));
  if (noise_stddev.size() != view.size() || !(noise_stddev.array() >= smallest_scale).all() ||
      !(noise_stddev.array() <= largest_number).all()) {
    throw InputError("noise_stddev must hold one positive number per row of the view");
  }
  const auto estimate_noise = json.at("estimate_noise").get<bool>();
  // values come first: they bound what a damaged n can claim
  const std::vector<bool> every(view.rows.size(), true);
  MatrixXd values = rows_from(json.at("values"), view.names(system), every, n, number_or_missing);
  MatrixXd noise_scale;
  if (json.contains("noise_scale")) {
    noise_scale = rows_from(json.at("noise_scale"), view.names(system), every, n, number_or_missing);
  }
  std::vector<bool> reads = prior.reads();
  const std::vector<bool> of_view = view.reads(system);
  for (std::size_t k = 0; k < reads.size(); ++k) reads[k] = reads[k] || of_view[k];
  MatrixXd states = rows_from(json.at("states"), system.state_names(), reads, n);
  const Observations observations(std::move(states), std::move(view), std::move(values), std::move(noise_stddev), estimate_noise,
                                  std::move(noise_scale));
  if (!json.contains("sums")) return observations;
  std::vector<WeightedSum> sums;
  for (const ParsedJson& sum : array(json.at("sums"))) {
    sums.push_back({integer(sum.at("row")), integer(sum.at("first")), vector_from(sum.at("weights")), number(sum.at("value")),
                    vector_from(sum.at("noise"))});
  }
  return observations.with_sums(std::move(sums));
}

Json logs_json(const std::vector<LogFile>& logs) {
  Json json = Json::array();
  for (const LogFile& log : logs)
    json.push_back({{"name", log.name}, {"bytes", log.bytes}, {"rows", log.rows}, {"checksum", log.checksum}});
  return json;
}

std::vector<LogFile> logs_from(const ParsedJson& json) {
  std::vector<LogFile> logs;
  for (const ParsedJson& log : array(json)) {
    for (const char* key : {"bytes", "rows"}) {
      if (!log.at(key).is_number_unsigned())
        throw InputError(fmt::format("{} stands where a whole number must", shown(log.at(key))));
    }
    logs.push_back({log.at("name"), log.at("bytes"), log.at("rows"), log.at("checksum")});
  }
  return logs;
}

// a restart without a finite start has the objective ∞, which JSON has not: null
Json number_or_null(double value) { return std::isfinite(value) ? Json(value) : Json(); }

double number_or_infinity(const ParsedJson& json) {
  return json.is_null() ? std::numeric_limits<double>::infinity() : number(json);
}

Json restart_json(const RestartReport& r) {
  return {{"objective", number_or_null(r.objective)},
          {"nll", number_or_null(r.negative_log_likelihood)},
          {"iterations", r.iterations},
          {"evaluations", r.evaluations},
          {"failed_evaluations", r.failed_evaluations},
          {"converged", r.converged},
          {"termination", r.termination}};
}

// numbers that may be ∞ or NaN: null
Json numbers_or_null(const Eigen::Ref<const VectorXd>& values) {
  Json json = Json::array();
  for (const double value : values) json.push_back(number_or_null(value));
  return json;
}

Json columns_json(const MatrixXd& matrix) {
  Json json = Json::array();
  for (Index k = 0; k < matrix.cols(); ++k) json.push_back(numbers_or_null(matrix.col(k)));
  return json;
}

Json uncertainty_json(const LaplaceUncertainty& uncertainty) {
  return {{"stddev", numbers_or_null(uncertainty.stddev)},
          {"held", uncertainty.held},
          {"correlation", columns_json(uncertainty.correlation)},
          {"undetermined", columns_json(uncertainty.undetermined)},
          {"distance_from_optimum", number_or_null(uncertainty.distance_from_optimum)}};
}

/// @param n  hyperparameters
LaplaceUncertainty uncertainty_from(const ParsedJson& json, std::size_t n) {
  const auto column = [n](const ParsedJson& values, double null) {
    if (array(values).size() != n) throw InputError(fmt::format("standard errors of {} of {} hyperparameters", values.size(), n));
    VectorXd out(static_cast<Index>(n));
    std::transform(values.begin(), values.end(), out.begin(),
                   [null](const ParsedJson& value) { return value.is_null() ? null : number(value); });
    return out;
  };
  const auto columns = [&](const ParsedJson& values) {
    MatrixXd out(static_cast<Index>(n), static_cast<Index>(array(values).size()));
    for (Index k = 0; k < out.cols(); ++k) {
      out.col(k) = column(values[static_cast<std::size_t>(k)], std::numeric_limits<double>::quiet_NaN());
    }
    return out;
  };
  LaplaceUncertainty out;
  out.stddev = column(json.at("stddev"), std::numeric_limits<double>::infinity());
  for (const ParsedJson& k : array(json.at("held"))) {
    const int index = integer(k);
    if (index < 0 || index >= static_cast<int>(n)) throw InputError(fmt::format("{} is no hyperparameter", index));
    out.held.push_back(index);
  }
  out.correlation = columns(json.at("correlation"));
  if (out.correlation.cols() != out.correlation.rows()) throw InputError("correlations that are not square");
  out.undetermined = columns(json.at("undetermined"));
  out.distance_from_optimum = number_or_infinity(json.at("distance_from_optimum"));
  return out;
}

Json draws_json(const HyperparameterDraws& draws) {
  return {{"values", columns_json(draws.values)},
          {"mean", vector_json(draws.mean)},
          {"stddev", vector_json(draws.stddev)},
          {"lower", vector_json(draws.lower)},
          {"upper", vector_json(draws.upper)},
          {"r_hat", vector_json(draws.r_hat)},
          {"effective_size", vector_json(draws.effective_size)},
          {"correlation", columns_json(draws.correlation)},
          {"n_chains", draws.n_chains},
          {"evaluations", draws.evaluations},
          {"acceptance", draws.acceptance}};
}

HyperparameterDraws draws_from(const ParsedJson& json, const std::vector<Hyperparameter>& hyperparameters) {
  const auto column = [&](const ParsedJson& values) {
    if (array(values).size() != hyperparameters.size()) {
      throw InputError(fmt::format("draws of {} of {} hyperparameters", values.size(), hyperparameters.size()));
    }
    VectorXd out = vector_from(values);
    if (!(out.cwiseAbs().array() <= largest_number).all()) throw InputError("draws hold a number that is too large");
    return out;
  };
  const auto columns = [&](const ParsedJson& values) {
    MatrixXd out(std::ssize(hyperparameters), static_cast<Index>(array(values).size()));
    for (Index k = 0; k < out.cols(); ++k) out.col(k) = column(values[static_cast<std::size_t>(k)]);
    return out;
  };
  // each is a matrix to factor
  constexpr std::size_t most = 1000;
  if (array(json.at("values")).empty() || json.at("values").size() > most) {
    throw InputError(fmt::format("{} draws of hyperparameters, expected 1 … {}", json.at("values").size(), most));
  }
  HyperparameterDraws out;
  out.values = columns(json.at("values"));
  for (Index k = 0; k < out.values.rows(); ++k) {
    const Hyperparameter& h = hyperparameters[static_cast<std::size_t>(k)];
    if (!h.positive || out.values.row(k).minCoeff() >= smallest_scale) continue;
    throw InputError(
        fmt::format("a draw of hyperparameter '{}' has the impossible value {}", h.name, out.values.row(k).minCoeff()));
  }
  out.mean = column(json.at("mean"));
  out.stddev = column(json.at("stddev"));
  out.lower = column(json.at("lower"));
  out.upper = column(json.at("upper"));
  out.r_hat = column(json.at("r_hat"));
  out.effective_size = column(json.at("effective_size"));
  out.correlation = columns(json.at("correlation"));
  if (out.correlation.cols() != out.correlation.rows()) throw InputError("correlations that are not square");
  out.n_chains = integer(json.at("n_chains"));
  out.evaluations = integer(json.at("evaluations"));
  out.acceptance = number(json.at("acceptance"));
  return out;
}

// Doubles to the bit, sixteen hexadecimal digits each: matrices are read in no time.
std::string bits_of(const Eigen::Ref<const VectorXd>& values) {
  std::string text;
  text.reserve(16 * static_cast<std::size_t>(values.size()));
  for (const double value : values) fmt::format_to(std::back_inserter(text), "{:016x}", std::bit_cast<std::uint64_t>(value));
  return text;
}

/// @param n  numbers expected
VectorXd bits_from(const ParsedJson& json, Index n) {
  const auto& text = json.get_ref<const std::string&>();
  if (std::ssize(text) != 16 * n) throw InputError(fmt::format("{} hexadecimal digits, expected {}", text.size(), 16 * n));
  VectorXd values(n);
  for (Index k = 0; k < n; ++k) {
    const char* const first = text.data() + 16 * k;
    std::uint64_t bits = 0;
    const auto [end, error] = std::from_chars(first, first + 16, bits, 16);
    values[k] = std::bit_cast<double>(bits);
    if (end != first + 16 || error != std::errc() || !std::isfinite(values[k])) {
      throw InputError(
          fmt::format("'{}' is not a finite number in hexadecimal digits", text.substr(16 * static_cast<std::size_t>(k), 16)));
    }
  }
  return values;
}

// column by column
std::string triangle_bits(const MatrixXd& L) {
  std::string text;
  for (Index k = 0; k < L.cols(); ++k) text += bits_of(L.col(k).tail(L.rows() - k));
  return text;
}

MatrixXd triangle_from(const ParsedJson& json, Index n) {
  const VectorXd values = bits_from(json, n * (n + 1) / 2);
  MatrixXd L = MatrixXd::Zero(n, n);
  for (Index k = 0, at = 0; k < n; at += n - k, ++k) L.col(k).tail(n - k) = values.segment(at, n - k);
  return L;
}

Json part_json(const Evaluation::Part& part) {
  return {{"n", part.n},
          {"nrmse", number_or_null(part.nrmse)},
          {"coverage", numbers_or_null(Eigen::Vector3d(part.coverage50, part.coverage80, part.coverage95))},
          {"pit", numbers_or_null(part.pit)}};
}

Evaluation::Part part_from(const ParsedJson& json) {
  const auto numbers = [&](const char* key, std::size_t n) {
    if (array(json.at(key)).size() != n)
      throw InputError(fmt::format("scores have {} {}, expected {}", json.at(key).size(), key, n));
    VectorXd values(static_cast<Index>(n));
    std::transform(json.at(key).begin(), json.at(key).end(), values.begin(), number_or_missing);
    return values;
  };
  Evaluation::Part part;
  part.n = integer(json.at("n"));
  part.nrmse = number_or_missing(json.at("nrmse"));
  const VectorXd coverage = numbers("coverage", 3);
  part.coverage50 = coverage[0], part.coverage80 = coverage[1], part.coverage95 = coverage[2];
  part.pit = numbers("pit", Calibration::n_bins);
  part.coverage50_latent = part.coverage80_latent = part.coverage95_latent = std::numeric_limits<double>::quiet_NaN();
  return part;
}

// B, c, … of all observations, and the factors they are whitened by: what another processor rounds otherwise
Json summary_json(const InducingSummary& summary) {
  Json components = Json::array();
  for (const auto& [latents, all] : summary.components) {
    Json factors = Json::array();
    for (const InducingLatents::OfLatent& latent : latents.latents()) {
      factors.push_back({{"points", latent.chosen}, {"L", triangle_bits(latent.L)}});
    }
    components.push_back({{"factors", factors},
                          {"B", triangle_bits(all.B)},
                          {"c", bits_of(all.c)},
                          {"yy", all.yy},
                          {"trace", all.trace},
                          {"constant", all.constant},
                          {"weight", vector_json(all.weight)}});
  }
  return {{"states", summary.kept.n_states}, {"step", summary.kept.step}, {"components", components}};
}

InducingSummary::Component component_from(const ParsedJson& json, const Prior& prior, const ModelValues& values) {
  std::vector<lapack::PivotedFactor> factors;
  for (const ParsedJson& of_latent : array(json.at("factors"))) {
    if (factors.size() == prior.latents.size()) throw InputError("factors of more latents than there are");
    const Index n_points = values.inducing->features[factors.size()].rows();
    lapack::PivotedFactor factor;
    for (const ParsedJson& point : array(of_latent.at("points"))) {
      factor.rows.push_back(integer(point));
      if (factor.rows.back() < 0 || factor.rows.back() >= n_points)
        throw InputError(fmt::format("{} is no inducing point", factor.rows.back()));
    }
    factor.L = triangle_from(of_latent.at("L"), std::ssize(factor.rows));
    if (!(factor.L.diagonal().array() > 0).all()) throw InputError("a factor of inducing points is not positive");
    factors.push_back(std::move(factor));
  }
  if (factors.size() != prior.latents.size())
    throw InputError(fmt::format("factors of {} of {} latents", factors.size(), prior.latents.size()));
  InducingSummary::Component component{InducingLatents(prior, values, std::move(factors)), {}};
  const Index M = component.latents.size();
  component.all.B = triangle_from(json.at("B"), M);
  component.all.c = bits_from(json.at("c"), M);
  component.all.yy = number(json.at("yy"));
  component.all.trace = number(json.at("trace"));
  component.all.constant = number(json.at("constant"));
  component.all.weight = vector_from(json.at("weight"));
  if (component.all.weight.size() != std::ssize(prior.latents)) throw InputError("weights of some latents only");
  return component;
}

std::shared_ptr<const InducingSummary> summary_from(const ParsedJson& json, const Prior& prior,
                                                    const std::vector<ModelValues>& values,
                                                    const std::vector<Observations>& observations) {
  InducingSummary summary;
  summary.kept.step = integer(json.at("step"));
  if (summary.kept.step < 1) throw InputError(fmt::format("a step of {} states is not possible", summary.kept.step));
  for (const ParsedJson& n : array(json.at("states"))) {
    if (!n.is_number_unsigned()) throw InputError(fmt::format("{} stands where a number of states must", shown(n)));
    summary.kept.n_states.push_back(n.get<std::int64_t>());
  }
  if (summary.kept.n_states.size() != observations.size()) {
    throw InputError(
        fmt::format("numbers of states of {} of {} observations", summary.kept.n_states.size(), observations.size()));
  }
  if (!json.contains("components")) {  // of one, before version 11
    summary.components.push_back(component_from(json, prior, values.front()));
  } else {
    const ParsedJson& components = array(json.at("components"));
    if (components.size() != values.size())
      throw InputError(fmt::format("sums of {} components of {}", components.size(), values.size()));
    for (const ParsedJson& component : components)
      summary.components.push_back(component_from(component, prior, values[summary.components.size()]));
  }
  return std::make_shared<InducingSummary>(std::move(summary));
}

Json inducing_json(const InducingReport& inducing) {
  Json points = Json::array();
  for (const MatrixXd& features : inducing.points->features) points.push_back(columns_json(features));
  Json json = {{"points", points},
               {"variables", inducing.n_variables},
               {"left_out", vector_json(inducing.left_out)},
               {"start", inducing.n_start}};
  if (inducing.stretches) json["stretches"] = part_json(*inducing.stretches);
  if (inducing.summary) json["summary"] = summary_json(*inducing.summary);
  return json;
}

InducingReport inducing_from(const ParsedJson& json, const Prior& prior) {
  auto points = std::make_shared<InducingPoints>();
  for (const char* key : {"points", "left_out"}) {
    const std::size_t n = array(json.at(key)).size();
    if (n != prior.latents.size()) throw InputError(fmt::format("inducing points of {} of {} latents", n, prior.latents.size()));
  }
  for (const ParsedJson& features : array(json.at("points"))) {
    const std::size_t n = array(features).empty() ? 0 : array(features.front()).size();
    const int n_features = prior.latents[points->features.size()].n_features();
    if (std::ssize(features) != n_features) {
      throw InputError(fmt::format("inducing points of {} of {} features", features.size(), n_features));
    }
    MatrixXd& of_latent = points->features.emplace_back(static_cast<Index>(n), n_features);
    for (Index d = 0; d < of_latent.cols(); ++d) {
      const VectorXd feature = vector_from(features[static_cast<std::size_t>(d)]);
      if (feature.size() != of_latent.rows()) throw InputError("inducing points whose features differ in number");
      if (!(feature.cwiseAbs().array() <= largest_number).all())
        throw InputError("inducing points hold a number that is too large");
      of_latent.col(d) = feature;
    }
  }
  InducingReport inducing;
  inducing.points = std::move(points);
  inducing.n_variables = integer(json.at("variables"));
  inducing.left_out = vector_from(json.at("left_out"));
  inducing.n_start = integer(json.at("start"));
  if (json.contains("stretches")) inducing.stretches = part_from(json.at("stretches"));
  return inducing;
}

RestartReport restart_from(const ParsedJson& json) {
  return {number_or_infinity(json.at("objective")), number_or_infinity(json.at("nll")),     integer(json.at("iterations")),
          integer(json.at("evaluations")),          integer(json.at("failed_evaluations")), json.at("converged").get<bool>(),
          json.at("termination").get<std::string>()};
}

}  // namespace

namespace {

bool are_same(const MatrixXd& a, const MatrixXd& b) {
  return a.rows() == b.rows() && a.cols() == b.cols() &&
         (a.array() == b.array() || (a.array().isNaN() && b.array().isNaN())).all();
}

bool are_same(const std::vector<VectorXd>& a, const std::vector<VectorXd>& b) {
  return std::equal(a.begin(), a.end(), b.begin(), b.end(), [](const auto& x, const auto& y) { return are_same(x, y); });
}

bool are_same(const std::shared_ptr<const InducingPoints>& a, const std::shared_ptr<const InducingPoints>& b) {
  if (!a || !b) return a == b;
  return std::equal(a->features.begin(), a->features.end(), b->features.begin(), b->features.end(),
                    [](const MatrixXd& x, const MatrixXd& y) { return are_same(x, y); });
}

bool are_same(const ModelValues& a, const ModelValues& b) {
  const bool all_but_loadings = are_same(a.kernel, b.kernel) && are_same(a.signal_stddev, b.signal_stddev) &&
                                are_same(a.noise_stddev, b.noise_stddev) && are_same(a.parameters, b.parameters) &&
                                are_same(a.inducing, b.inducing);
  for (std::size_t k = 0; all_but_loadings && k < a.kernel.size(); ++k) {
    if (!are_same(a.loading(k), b.loading(k))) return false;
  }
  return all_but_loadings;
}

// A prior, and the parameters of its system.
struct PriorAt {
  const Prior& prior;
  VectorXd parameters;
};

// what differs between the latents of two priors, or nothing
std::string difference_of_latents(const Prior& made, const Prior& fitted) {
  if (made.latents.size() != fitted.latents.size()) {
    return fmt::format("it has {} latents, the fit {}", made.latents.size(), fitted.latents.size());
  }
  for (std::size_t a = 0; a < made.latents.size(); ++a) {
    const Latent &mine = made.latents[a], &its = fitted.latents[a];
    const auto differ = [&](const char* what) { return fmt::format("{} of the latent '{}'", what, its.name); };
    if (mine.kernel.text() != its.kernel.text()) return differ("the kernel");
    if (mine.feature_names != its.feature_names) return differ("the features");
    if (mine.base != its.base || mine.column_names != its.column_names || mine.free_loading != its.free_loading ||
        mine.is_potential != its.is_potential) {
      return differ("the directions");
    }
    if (mine.kernel_is_fixed != its.kernel_is_fixed || mine.has_one_signal != its.has_one_signal) {
      return differ("what is fixed");
    }
  }
  return "";
}

// and in what they are at the states of observations
std::string difference_at(const Observations& group, const PriorAt& made, const PriorAt& fitted) {
  const System &mine = *made.prior.system, &its = *fitted.prior.system;
  if (mine.state_names() != its.state_names()) return "the coordinates and inputs";
  if (mine.parameters().size() != its.parameters().size() || !are_same(made.parameters, fitted.parameters)) {
    return "the parameters of the system";
  }
  const std::string latents = difference_of_latents(made.prior, fitted.prior);
  if (!latents.empty()) return latents;
  const auto evaluate = [&](const PriorAt& at) {
    MechanicsBatch mechanics;
    evaluate_mechanics(*at.prior.system, group.states(), at.parameters, mechanics);
    return mechanics;
  };
  const MechanicsBatch here = evaluate(made), there = evaluate(fitted);
  const SystemValues &a = here.values, &b = there.values;
  if (!are_same(a.mass, b.mass) || !are_same(a.constraint_matrix, b.constraint_matrix) ||
      !are_same(a.constraint_vector, b.constraint_vector)) {
    return "M, A or b";
  }
  const PriorValues x = evaluate_prior(made.prior, group.states(), made.parameters, here);
  const PriorValues y = evaluate_prior(fitted.prior, group.states(), fitted.parameters, there);
  if (!are_same(x.mean, y.mean)) return "the prior mean";
  for (std::size_t k = 0; k < x.directions.size(); ++k) {
    const std::string& name = fitted.prior.latents[k].name;
    if (!are_same(x.directions[k], y.directions[k])) return fmt::format("the directions of the latent '{}'", name);
    if (!are_same(evaluate_features(made.prior, k, group.states()), evaluate_features(fitted.prior, k, group.states()))) {
      return fmt::format("the features of the latent '{}'", name);
    }
  }
  return "";
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
    const PriorAt there = {prior_of(fit.posterior.prior(), view), parameters_of(view, parameters)};
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
  // scores are of the data that there were
  if (before && before->kept.n_states != report.inducing->summary->kept.n_states) report.inducing->stretches.reset();
}

Posterior FitFile::posterior() const { return posterior_of(prior(), observations, report); }

void FitFile::write(const std::filesystem::path& path) const {
  Json json;
  json["format"] = format_name;
  json["version"] = format_version;
  json["library"] = version();
  json["model"] = model_json(model);
  json["prior"] = {{"mean", name_of(means, prior_options.mean)},   {"directions", name_of(directions, prior_options.base)},
                   {"raw_angles", prior_options.raw_angles},       {"kernel", prior_options.kernel},
                   {"per_direction", prior_options.per_direction}, {"feature_centres", prior_options.feature_centres}};
  if (prior_options.baseline) json["prior"]["baseline"] = baseline_json(*prior_options.baseline);
  if (prior_options.discrepancy) {
    json["prior"]["discrepancy"] = {{"lengthscale", vector_json(prior_options.discrepancy->lengthscale)},
                                    {"stddev", vector_json(prior_options.discrepancy->stddev)},
                                    {"directions", name_of(discrepancy_directions, prior_options.discrepancy->base)}};
  }
  json["hyperparameters"] = Json::array();
  const Prior home = prior();
  require_observations(home, observations);
  require_hyperparameters(home, observations, report.hyperparameters);
  for (const Hyperparameter& h : report.hyperparameters) json["hyperparameters"].push_back(hyperparameter_json(h, home));
  json["report"] = {{"nll", report.negative_log_likelihood},
                    {"objective", report.objective},
                    {"converged", report.converged},
                    {"termination", report.termination},
                    {"iterations", report.iterations},
                    {"best_restart", report.best_restart},
                    {"restarts", Json::array()}};
  for (const RestartReport& restart : report.restarts) json["report"]["restarts"].push_back(restart_json(restart));
  if (report.uncertainty) json["report"]["uncertainty"] = uncertainty_json(*report.uncertainty);
  if (report.draws) json["report"]["draws"] = draws_json(*report.draws);
  if (report.inducing) json["report"]["inducing"] = inducing_json(*report.inducing);
  if (!report.actuators.empty()) json["actuators"] = actuators_json(report.actuators);
  if (!options.empty()) json["options"] = Json::parse(options);
  json["data_source"] = data_source;
  if (!logs.empty()) json["logs"] = logs_json(logs);
  json["observations"] = Json::array();
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const Model* other = observations[g].view().other_system && g < systems.size() ? systems[g].get() : nullptr;
    if (observations[g].view().other_system && other == nullptr) {
      throw InputError(fmt::format("{}: the model file of the system of observations {} is not given", path.string(), g + 1));
    }
    if (observations[g].n_data() == 0) {
      throw InputError(
          fmt::format("{}: none of the observations {} of '{}' is left, and the file keeps their noise: leave one at "
                      "least (a larger window), or fit anew to the others",
                      path.string(), g + 1, (other != nullptr ? *other : model).name));
    }
    json["observations"].push_back(observations_json(observations[g], home, other));
  }
  json["checksum"] = checksum_of(ParsedJson(json));
  // a path in `data_source` may hold bytes that are no text
  write_file(path, json.dump(1, ' ', false, Json::error_handler_t::replace) + "\n");
}

namespace {

// delays and lags by name, where they are not those of the text
void read_actuators(const ParsedJson& json, FitFile& fit) {
  std::map<std::string, double> values;
  for (const ParsedJson& one : array(json)) {
    ActuatorEstimate estimate;
    one.at("name").get_to(estimate.name);
    estimate.value = number(one.at("value"));
    if (!(estimate.value >= 0)) throw InputError(fmt::format("{} must not be negative, got {}", estimate.name, estimate.value));
    const bool is_known = std::ranges::any_of(fit.model.actuators, [&](const Actuator& actuator) {
      return actuator.delay.name == estimate.name || actuator.lag.name == estimate.name;
    });
    if (!is_known) throw InputError(fmt::format("'{}' is not of this model", estimate.name));
    values.emplace(estimate.name, estimate.value);
    estimate.lower = number(one.at("lower"));
    estimate.upper = number(one.at("upper"));
    estimate.stddev = one.at("stddev").is_null() ? std::numeric_limits<double>::quiet_NaN() : number(one.at("stddev"));
    fit.report.actuators.push_back(std::move(estimate));
  }
  set_values(values, fit.model.actuators);
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

/// @param path  stands for the file in messages
FitFile read_fit(std::string_view text, const std::filesystem::path& path, const ModelCode& code) {
  const internal::StepLimit limit;  // for all its models together
  ParsedJson json = parse_json(text, path);
  FitFile fit;
  try {
    require_fit(json);
    fit.model = model_from(json.at("model"), code);
    bool code_is_used = static_cast<bool>(fit.model.code);
    const ParsedJson& prior_json = json.at("prior");
    fit.prior_options.mean = choice_from(prior_json.at("mean"), means, "prior mean");
    fit.prior_options.base = choice_from(prior_json.at("directions"), directions, "choice of directions");
    prior_json.at("raw_angles").get_to(fit.prior_options.raw_angles);
    // until format 6 a latent without a kernel had this one
    fit.prior_options.kernel = "se";
    fit.prior_options.per_direction = false;
    if (prior_json.contains("kernel")) {
      prior_json.at("kernel").get_to(fit.prior_options.kernel);
      prior_json.at("per_direction").get_to(fit.prior_options.per_direction);
    }
    if (prior_json.contains("feature_centres")) {
      if (!prior_json.at("feature_centres").is_object()) throw InputError("feature_centres must be an object of numbers");
      for (const auto& [feature, centre] : prior_json.at("feature_centres").items()) {
        fit.prior_options.feature_centres.emplace(feature, number(centre));
      }
    }
    if (prior_json.contains("discrepancy")) fit.prior_options.discrepancy = discrepancy_from(prior_json.at("discrepancy"));
    if (prior_json.contains("baseline")) fit.prior_options.baseline = baseline_from(prior_json.at("baseline"));
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
    if (fit.observations.empty()) throw InputError("no observations");
    if (code && !code_is_used) throw InputError("code is given, but this fit is all text: read it without");
    for (const ParsedJson& h : array(json.at("hyperparameters"))) fit.report.hyperparameters.push_back(hyperparameter_from(h));
    locate_in_model(fit.report.hyperparameters, prior, fit.observations);
    const ParsedJson& report = json.at("report");
    fit.report.negative_log_likelihood = number(report.at("nll"));
    fit.report.objective = number(report.at("objective"));
    report.at("converged").get_to(fit.report.converged);
    report.at("termination").get_to(fit.report.termination);
    fit.report.iterations = integer(report.at("iterations"));
    fit.report.best_restart = integer(report.at("best_restart"));
    for (const ParsedJson& restart : array(report.at("restarts"))) fit.report.restarts.push_back(restart_from(restart));
    if (report.contains("uncertainty")) {
      fit.report.uncertainty = uncertainty_from(report.at("uncertainty"), fit.report.hyperparameters.size());
    }
    if (json.contains("actuators")) read_actuators(json.at("actuators"), fit);
    if (report.contains("draws")) fit.report.draws = draws_from(report.at("draws"), fit.report.hyperparameters);
    if (report.contains("inducing")) {
      const ParsedJson& inducing = report.at("inducing");
      fit.report.inducing = inducing_from(inducing, prior);
      if (inducing.contains("summary")) {
        const std::vector<ModelValues> values = values_of(prior, fit.observations, fit.report);
        for (const ModelValues& of_one : values) require_values(prior, fit.observations, of_one);
        fit.report.inducing->summary = summary_from(inducing.at("summary"), prior, values, fit.observations);
      }
    }
  } catch (const Json::exception& error) {
    throw InputError(fmt::format("{}: not a whole fit file: {}", path.string(), error.what()));
  } catch (const InputError& error) {
    throw InputError(fmt::format("{}: {}", path.string(), error.what()));
  }
  return fit;
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
  std::vector<Hyperparameter> hyperparameters;
  try {
    require_fit(json);
    for (const ParsedJson& h : array(json.at("hyperparameters"))) hyperparameters.push_back(hyperparameter_from(h));
  } catch (const Json::exception& error) {
    throw InputError(fmt::format("{}: not a whole fit file: {}", path.string(), error.what()));
  } catch (const InputError& error) {
    throw InputError(fmt::format("{}: {}", path.string(), error.what()));
  }
  return hyperparameters;
}

std::vector<Hyperparameter>::iterator find_named(std::vector<Hyperparameter>& hyperparameters, const std::string& name) {
  return std::find_if(hyperparameters.begin(), hyperparameters.end(), [&](const auto& known) { return known.name == name; });
}

}  // namespace

void read_start_values(const std::filesystem::path& path, std::vector<Hyperparameter>& hyperparameters) {
  ParsedJson json = parse_json(read_file(path), path);
  std::map<std::string, double> values;
  if (is_fit(json)) {
    // a fit may have had more to tune than this one; a hand-written value must mean something
    for (const Hyperparameter& h : hyperparameters_of(path, json)) {
      if (find_named(hyperparameters, h.name) != hyperparameters.end()) values[h.name] = h.value;
    }
  } else if (json.is_object()) {
    for (const auto& [name, value] : json.items()) {
      if (!value.is_number())
        throw InputError(fmt::format("{}: '{}' is not a number but {}", path.string(), name, value.type_name()));
      values[name] = value.get<double>();
    }
  } else {
    throw InputError(fmt::format("{}: expected {{\"name\": value, …}} or a file written by gp2 fit", path.string()));
  }
  set_start_values(values, path.string(), hyperparameters);
}

void set_start_values(const std::map<std::string, double>& values, const std::string& source,
                      std::vector<Hyperparameter>& hyperparameters) {
  std::vector<Hyperparameter> started = hyperparameters;
  for (const auto& [name, value] : values) {
    const auto h = find_named(started, name);
    if (h == started.end()) {
      std::vector<std::string> known;
      for (const Hyperparameter& other : started) known.push_back(other.name);
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
