#include <algorithm>
#include <cstdint>

#include "base/not_a_number.hpp"
#include "files/fit_json.hpp"
#include "inference/inducing_summary.hpp"
#include "inference/requirements.hpp"

namespace gp2::fit_json {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

Json part_json(const Evaluation::Part& part) {
  return {{"n", part.n},
          {"nrmse", part.nrmse},
          {"coverage", vector_json(Eigen::Vector3d(part.coverage50, part.coverage80, part.coverage95))},
          {"pit", vector_json(part.pit)}};
}

Evaluation::Part part_from(const ParsedJson& json) {
  const auto numbers = [&](const char* key, std::size_t n) {
    if (array(json.at(key)).size() != n)
      throw InputError(fmt::format("scores have {} {}, expected {}", json.at(key).size(), key, n));
    return vector_from(json.at(key), number_or_missing);
  };
  Evaluation::Part part;
  part.n = integer(json.at("n"));
  part.nrmse = number_or_missing(json.at("nrmse"));
  const VectorXd coverage = numbers("coverage", 3);
  part.coverage50 = coverage[0], part.coverage80 = coverage[1], part.coverage95 = coverage[2];
  part.pit = numbers("pit", Calibration::n_bins);
  part.coverage50_latent = part.coverage80_latent = part.coverage95_latent = not_a_number;
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
  Json json = {{"states", summary.kept.n_states}, {"step", summary.kept.step}, {"components", components}};
  if (!summary.kept.share_of.empty()) json["shares"] = summary.kept.share_of;
  return json;
}

// Shares of the likelihood, of each state that is kept.
std::vector<std::vector<double>> shares_from(const ParsedJson& json, const std::vector<Observations>& observations) {
  std::vector<std::vector<double>> shares;
  for (const ParsedJson& of_group : array(json)) {
    const VectorXd one = vector_from(of_group);
    if (!(one.array() >= 0 && one.array() <= 1).all()) throw InputError("shares of states must be from 0 to 1");
    shares.emplace_back(one.begin(), one.end());
  }
  const bool is_of_each = std::ranges::equal(
      shares, observations, [](const auto& one, const Observations& group) { return std::ssize(one) == group.n_data(); });
  if (!is_of_each) throw InputError("shares of some states only");
  return shares;
}

InducingSummary::Component component_from(const ParsedJson& json, const Prior& prior, const ModelValues& values) {
  std::vector<lapack::PivotedFactor> factors;
  for (const ParsedJson& of_latent : array(json.at("factors"))) {
    if (factors.size() == prior.latents.size()) throw InputError("factors of more latents than there are");
    const Latent& latent = prior.latents[factors.size()];
    const Index n_points = values.inducing->features[factors.size()].rows() * (latent.is_potential ? latent.n_features() : 1);
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

std::shared_ptr<const InducingPoints> points_from(const ParsedJson& json, const Prior& prior) {
  auto points = std::make_shared<InducingPoints>();
  for (const ParsedJson& features : array(json)) {
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
  return points;
}

}  // namespace

Json inducing_json(const InducingReport& inducing) {
  Json points = Json::array();
  for (const MatrixXd& features : inducing.points->features) points.push_back(columns_json(features));
  Json json = {{"points", points},
               {"variables", inducing.n_variables},
               {"left_out", vector_json(inducing.left_out)},
               {"start", inducing.n_start},
               {"starts", inducing.n_starts}};
  if (inducing.stretches) json["stretches"] = part_json(*inducing.stretches);
  if (inducing.summary) json["summary"] = summary_json(*inducing.summary);
  return json;
}

InducingReport inducing_from(const ParsedJson& json, const Prior& prior) {
  for (const char* key : {"points", "left_out"}) {
    const std::size_t n = array(json.at(key)).size();
    if (n != prior.latents.size()) throw InputError(fmt::format("inducing points of {} of {} latents", n, prior.latents.size()));
  }
  InducingReport inducing;
  inducing.points = points_from(json.at("points"), prior);
  inducing.n_variables = integer(json.at("variables"));
  inducing.left_out = vector_from(json.at("left_out"));
  inducing.n_start = integer(json.at("start"));
  if (json.contains("starts")) inducing.n_starts = integer(json.at("starts"));
  if (json.contains("stretches")) inducing.stretches = part_from(json.at("stretches"));
  return inducing;
}

std::shared_ptr<const InducingSummary> summary_from(const ParsedJson& json, const Prior& prior,
                                                    const std::vector<Observations>& observations, const FitReport& report) {
  const std::vector<ModelValues> values = values_of(prior, observations, report);
  for (const ModelValues& of_one : values) require_values(prior, observations, of_one);
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
  if (json.contains("shares")) summary.kept.share_of = shares_from(json.at("shares"), observations);
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

}  // namespace gp2::fit_json
