#include <cmath>
#include <set>

#include "files/fit_json.hpp"

namespace gp2::fit_json {

using Eigen::VectorXd;
using Kind = Hyperparameter::Kind;

namespace {

constexpr std::array<Named<Kind>, 5> kinds = {{{Kind::kernel, "kernel"},
                                               {Kind::signal_stddev, "signal_stddev"},
                                               {Kind::shared_signal_stddev, "shared_signal_stddev"},
                                               {Kind::noise_stddev, "noise_stddev"},
                                               {Kind::parameter, "parameter"}}};

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
  if (!(prior.stddev > 0)) throw InputError(fmt::format("the deviation of a prior must be positive, got {}", prior.stddev));
  return prior;
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

}  // namespace

Json hyperparameters_json(const std::vector<Hyperparameter>& hyperparameters, const Prior& prior) {
  Json json = Json::array();
  for (const Hyperparameter& h : hyperparameters) json.push_back(hyperparameter_json(h, prior));
  return json;
}

std::vector<Hyperparameter> hyperparameters_from(const ParsedJson& json) {
  std::vector<Hyperparameter> hyperparameters;
  for (const ParsedJson& h : array(json)) hyperparameters.push_back(hyperparameter_from(h));
  return hyperparameters;
}

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

}  // namespace gp2::fit_json
