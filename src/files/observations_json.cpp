#include <algorithm>

#include "files/fit_json.hpp"

namespace gp2::fit_json {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// a row that is not measured is left out
Json states_json(const MatrixXd& states, const std::vector<std::string>& names) {
  Json json = Json::object();
  for (Index k = 0; k < states.rows(); ++k) {
    if (!states.row(k).hasNaN()) json[names[static_cast<std::size_t>(k)]] = vector_json(states.row(k));
  }
  return json;
}

View view_from(const ParsedJson& json, const Prior& fitted, std::shared_ptr<const OtherSystem> other_system) {
  View view;
  view.other_system = std::move(other_system);
  const Prior& prior = prior_of(fitted, view);
  const auto word = json.at("view").get<std::string>();
  const std::optional<View::Quantity> quantity = View::Quantity::of_word(word);
  if (!quantity) throw InputError(fmt::format("'{}' is no view", word));
  view.quantity = *quantity;
  const double time_step = number(json.at("time_step"));
  if ((*quantity)->needs_time_step()) {
    if (!(time_step > 0)) throw InputError(fmt::format("the time_step of {} must be positive", word));
    view.time_step = time_step;
  }
  const int latent = integer(json.at("latent")), last = static_cast<int>(prior.latents.size()) - 1;
  if (latent < -1 || latent > last) throw InputError(fmt::format("latent {} of a view is outside -1 … {}", latent, last));
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

}  // namespace

Json observations_json(const Observations& group, const Prior& fitted, const Model* other) {
  const System& system = *prior_of(fitted, group.view()).system;
  Json json = {{"view", group.view().quantity->word()},
               {"rows", group.view().rows},
               {"time_step", group.view().time_step.value_or(0)},
               {"latent", group.view().latent.value_or(-1).first},
               {"n", group.n_data()},
               {"noise_stddev", vector_json(group.noise().stddev())},
               {"estimate_noise", group.noise().is_estimated()},
               {"states", states_json(group.states(), system.state_names())},
               {"values", rows_json(group.values(), group.view().names(system))}};
  if (group.view().latent && group.view().latent->n > 1) json["n_latents"] = group.view().latent->n;
  if (group.noise().has_scale()) json["noise_scale"] = rows_json(group.noise().scale(), group.view().names(system));
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

Observations observations_from(const ParsedJson& json, const Prior& fitted, std::shared_ptr<const OtherSystem> other_system) {
  View view = view_from(json, fitted, std::move(other_system));
  const Prior& prior = prior_of(fitted, view);
  const System& system = *prior.system;
  const int n = integer(json.at("n"));
  if (n < 0) throw InputError(fmt::format("{} observations are not possible", n));
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
  for (const LogFile& log : logs) {
    json.push_back({{"name", log.name}, {"bytes", log.bytes}, {"rows", log.rows}, {"checksum", log.checksum}});
    if (log.n_learned) json.back()["learned"] = *log.n_learned;
  }
  return json;
}

std::vector<LogFile> logs_from(const ParsedJson& json) {
  std::vector<LogFile> logs;
  for (const ParsedJson& log : array(json)) {
    for (const char* key : {"bytes", "rows", "learned"}) {
      if (key == std::string_view("learned") && !log.contains(key)) continue;  // a fit without later rows, or of an older version
      if (!log.at(key).is_number_unsigned())
        throw InputError(fmt::format("{} stands where a whole number must", shown(log.at(key))));
    }
    logs.push_back({log.at("name"), log.at("bytes"), log.at("rows"), log.at("checksum")});
    if (log.contains("learned")) logs.back().n_learned = log.at("learned").get<std::int64_t>();
  }
  return logs;
}

}  // namespace gp2::fit_json
