#include "model/other_system.hpp"

#include <algorithm>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"

namespace gp2 {

namespace {

// what keeps the latents of `fitted` from acting in `other`, or nothing
std::string difference(const Prior& fitted, const Prior& other) {
  const auto differ = [](const std::string& what, const std::string& there, const std::string& here) {
    return there == here ? "" : fmt::format("{} {} there, but {} here", what, there, here);
  };
  const auto coordinates = [](const System& system) {
    std::vector<std::string> names;
    for (const Coordinate& coordinate : system.coordinates()) names.push_back(coordinate.name);
    return fmt::format("{}", fmt::join(names, ", "));
  };
  const auto inputs = [](const System& system) {
    return system.inputs().empty() ? "none" : fmt::format("{}", fmt::join(system.inputs(), ", "));
  };
  std::string text = differ("its coordinates are", coordinates(*other.system), coordinates(*fitted.system));
  if (text.empty()) text = differ("its inputs are", inputs(*other.system), inputs(*fitted.system));
  // matched by their places, and called the same in another order they would act for each other
  const auto names = [](const Prior& prior) {
    std::vector<std::string> all;
    for (const Latent& latent : prior.latents) {
      if (!std::ranges::count(all, latent.name)) all.push_back(latent.name);
    }
    return all;
  };
  const std::vector<std::string> here_names = names(fitted), there_names = names(other);
  if (text.empty() && std::ranges::is_permutation(here_names, there_names)) {
    text = differ("its latents are", fmt::format("{}", fmt::join(there_names, ", ")),
                  fmt::format("{}", fmt::join(here_names, ", ")));
  }
  if (text.empty()) {
    text = differ("the number of its latents is", std::to_string(other.latents.size()), std::to_string(fitted.latents.size()));
  }
  for (std::size_t a = 0; text.empty() && a < fitted.latents.size(); ++a) {
    const Latent &here = fitted.latents[a], &there = other.latents[a];
    const auto kernel = [](const Latent& latent) {
      std::string written = latent.kernel.text();
      std::erase(written, ' ');
      return written;
    };
    const auto directions = [](const Latent& latent) {
      if (latent.is_potential) return std::string("\"potential\"");
      if (latent.directions) {
        return fmt::format("{} of its own ({})", latent.size(), latent.base == Latent::Base::force ? "forces" : "accelerations");
      }
      return std::string(latent.base == Latent::Base::force ? "\"force\"" : "\"acceleration\"");
    };
    const auto features = [](const Latent& latent) { return fmt::format("{}", fmt::join(latent.feature_names, ", ")); };
    const std::string of = fmt::format("of its latent {}, '{}',", a + 1, there.name);
    text = differ(fmt::format("the kernel {} is", of), kernel(there), kernel(here));
    if (text.empty()) text = differ(fmt::format("the features {} are", of), features(there), features(here));
    if (text.empty()) text = differ(fmt::format("the directions {} are", of), directions(there), directions(here));
    const auto sign = [](const Latent& latent) { return std::string(latent.is_positive ? "positive" : "of either sign"); };
    if (text.empty()) text = differ(fmt::format("the values {} are", of), sign(there), sign(here));
  }
  return text;
}

}  // namespace

void require_same_latents(const Model& fitted, const Prior& fitted_prior, const Model& other, const Prior& there) {
  const std::string text = difference(fitted_prior, there);
  if (text.empty()) return;
  throw InputError(fmt::format("{}: another system of '{}' must have the same coordinates, inputs and latents, but {}",
                               other.name, fitted.name, text));
}

std::shared_ptr<const OtherSystem> share_parameters(const Model& fitted, const Prior& fitted_prior, const Model& other,
                                                    Prior there) {
  OtherSystem other_system{std::move(there), {}};
  const std::vector<Parameter>& parameters = other_system.prior.system->parameters();
  for (const Parameter& parameter : parameters) {
    other_system.shared.push_back(parameter.estimate ? fitted_prior.system->parameter_index(parameter.name) : -1);
  }
  for (const Latent& latent : other_system.prior.latents) {
    for (const int used : latent.feature_parameters) {
      const auto index = static_cast<std::size_t>(used);
      if (other_system.shared[index] < 0) continue;
      throw InputError(fmt::format(
          "{}: parameter '{}' is marked estimate = true, so it is that of '{}', but it stands in a feature of the "
          "latent '{}', and features hold no estimated parameters; write the feature without it, or leave out the mark",
          other.name, parameters[index].name, fitted.name, latent.name));
    }
  }
  return std::make_shared<const OtherSystem>(std::move(other_system));
}

std::vector<Actuator> shared_actuators(const std::vector<Actuator>& fitted, const Model& other) {
  std::vector<Actuator> there = other.actuators;
  for (std::size_t k = 0; k < std::min(fitted.size(), there.size()); ++k) {
    if (there[k].delay.estimate) there[k].delay = fitted[k].delay;
    if (there[k].lag.estimate) there[k].lag = fitted[k].lag;
  }
  return there;
}

std::shared_ptr<const OtherSystem> make_other_system(const Model& fitted, const Model& other, const PriorOptions& options) {
  // a discrepancy is sized for the features of the fitted system: first see whether they are the same there
  PriorOptions without_discrepancy = options;
  without_discrepancy.discrepancy.reset();
  const Prior fitted_prior = make_prior(fitted, without_discrepancy);
  require_same_latents(fitted, fitted_prior, other, make_prior(other, without_discrepancy));
  return share_parameters(fitted, fitted_prior, other, make_prior(other, options));
}

}  // namespace gp2
