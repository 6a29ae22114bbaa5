#include "model/other_system.hpp"

#include <algorithm>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"

namespace gp2 {

namespace {

// what keeps the latents of `home` from acting in `other`, or nothing
std::string difference(const Prior& home, const Prior& other) {
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
  std::string text = differ("its coordinates are", coordinates(*other.system), coordinates(*home.system));
  if (text.empty()) text = differ("its inputs are", inputs(*other.system), inputs(*home.system));
  if (text.empty()) {
    text = differ("the number of its latents is", std::to_string(other.latents.size()), std::to_string(home.latents.size()));
  }
  for (std::size_t a = 0; text.empty() && a < home.latents.size(); ++a) {
    const Latent &here = home.latents[a], &there = other.latents[a];
    const auto kernel = [](const Latent& latent) {
      std::string written = latent.kernel.text();
      std::erase(written, ' ');
      return written;
    };
    const auto directions = [](const Latent& latent) {
      if (latent.is_potential) return std::string("\"potential\"");
      if (latent.directions) return fmt::format("{} of its own", latent.size());
      return std::string(latent.base == Latent::Base::force ? "\"force\"" : "\"acceleration\"");
    };
    const auto features = [](const Latent& latent) { return fmt::format("{}", fmt::join(latent.feature_names, ", ")); };
    const std::string of = fmt::format("of its latent {}, '{}',", a + 1, there.name);
    text = differ(fmt::format("the kernel {} is", of), kernel(there), kernel(here));
    if (text.empty()) text = differ(fmt::format("the features {} are", of), features(there), features(here));
    if (text.empty()) text = differ(fmt::format("the directions {} are", of), directions(there), directions(here));
  }
  return text;
}

}  // namespace

void require_same_latents(const Model& home, const Prior& at_home, const Model& other, const Prior& there) {
  const std::string text = difference(at_home, there);
  if (text.empty()) return;
  throw InputError(fmt::format("{}: another system of '{}' must have the same coordinates, inputs and latents, but {}",
                               other.name, home.name, text));
}

std::shared_ptr<const OtherSystem> share_parameters(const Model& home, const Prior& at_home, const Model& other, Prior there) {
  OtherSystem other_system{std::move(there), {}};
  const std::vector<Parameter>& parameters = other_system.prior.system->parameters();
  for (const Parameter& parameter : parameters) {
    other_system.shared.push_back(parameter.estimate ? at_home.system->parameter_index(parameter.name) : -1);
  }
  for (const Latent& latent : other_system.prior.latents) {
    for (const int used : latent.feature_parameters) {
      const auto index = static_cast<std::size_t>(used);
      if (other_system.shared[index] < 0) continue;
      throw InputError(fmt::format(
          "{}: parameter '{}' is marked estimate = true, so it is that of '{}', but it stands in a feature of the "
          "latent '{}', and features hold no estimated parameters; write the feature without it, or leave out the mark",
          other.name, parameters[index].name, home.name, latent.name));
    }
  }
  return std::make_shared<const OtherSystem>(std::move(other_system));
}

std::vector<Actuator> shared_actuators(const std::vector<Actuator>& home, const Model& other) {
  std::vector<Actuator> there = other.actuators;
  for (std::size_t k = 0; k < std::min(home.size(), there.size()); ++k) {
    if (there[k].delay.estimate) there[k].delay = home[k].delay;
    if (there[k].lag.estimate) there[k].lag = home[k].lag;
  }
  return there;
}

std::shared_ptr<const OtherSystem> make_other_system(const Model& home, const Model& other, const PriorOptions& options) {
  // a discrepancy is sized for the features at home: first see whether they are the same there
  PriorOptions without_discrepancy = options;
  without_discrepancy.discrepancy.reset();
  const Prior at_home = make_prior(home, without_discrepancy);
  require_same_latents(home, at_home, other, make_prior(other, without_discrepancy));
  return share_parameters(home, at_home, other, make_prior(other, options));
}

}  // namespace gp2
