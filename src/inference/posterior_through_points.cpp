#include <cmath>
#include <numeric>
#include <utility>

#include <fmt/format.h>

#include "data/evenly.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/leave_one_out.hpp"
#include "inference/inducing_gram.hpp"
#include "inference/posterior_implementation.hpp"
#include "inference/stretches.hpp"

// Posteriors through inducing points: sums over all observations, of which some are kept.
namespace gp2 {

using Eigen::VectorXd;

namespace {

/// @throws InputError as require_models
InducingStatistics require_statistics(const Prior& prior, const std::vector<Observations>& observations,
                                      const ModelValues& values, const Linearisation* about, const InducingLatents& latents,
                                      const Workers& workers) {
  std::optional<InducingStatistics> statistics =
      InducingStatistics::of(latents, BlocksOfStates(prior, observations, values, about), workers);
  if (!statistics) static_cast<void>(require_models(prior, observations, values.parameters, about));  // names the state
  return *std::move(statistics);
}

// Of each state, in every Observations: those of every second state stay.
template <typename Value>
void keep_every_second(std::vector<std::vector<Value>>& of_states) {
  for (std::vector<Value>& values : of_states) {
    for (std::size_t k = 0; 2 * k < values.size(); ++k) values[k] = values[2 * k];
    values.resize((values.size() + 1) / 2);
  }
}

// Every second of the states that are kept, until they are few.
void keep_some(std::vector<Observations>& observations, KeptStates& kept) {
  while (n_states(observations) > KeptStates::most) {
    kept.step *= 2;
    for (Observations& group : observations) {
      std::vector<int> states;
      for (int i = 0; i < group.n_data(); i += 2) states.push_back(i);
      group = group.take(states);
    }
    keep_every_second(kept.stretch_of);
    keep_every_second(kept.share_of);
  }
}

}  // namespace

void Posterior::Implementation::condition_through_points(const Workers& workers) {
  constexpr std::size_t n_stretches = LeftOut::n_stretches;
  const std::shared_ptr<const Linearisation> linearisation =
      prior.is_nonlinear() ? linearisation_of(prior, observations, values, workers) : nullptr;
  KeptStates all;
  std::vector<std::vector<std::vector<int>>> states;  // by Observations and stretch
  for (const Observations& group : observations) {
    all.n_states.push_back(group.n_data());
    states.push_back(states_of_stretches(group, prior.system->layout().t(), n_stretches));
    all.stretch_of.push_back(stretch_of_states(states.back()));
  }
  InducingLatents inducing(prior, values);
  std::vector<InducingStatistics> stretches;
  for (std::size_t k = 0; k < n_stretches; ++k) {
    std::vector<Observations> stretch;
    std::vector<std::vector<int>> of_stretch;
    for (std::size_t g = 0; g < observations.size(); ++g) {
      stretch.push_back(observations[g].take(states[g][k]));
      of_stretch.push_back(states[g][k]);
    }
    const Linearisation of_rows = linearisation ? take(*linearisation, of_stretch) : Linearisation();
    stretches.push_back(require_statistics(prior, stretch, values, linearisation ? &of_rows : nullptr, inducing, workers));
  }
  auto through = std::make_shared<InducingPosterior>(std::move(inducing), std::move(stretches));
  if (!through->factorise()) throw_not_definite();
  latents = std::move(through);
  kept = std::move(all);
  keep_some(observations, *kept);
  linearise_kept(workers);
}

void Posterior::Implementation::forget(double share) {
  latents->forget(share);
  std::vector<std::vector<double>>& shares = kept->share_of;
  if (shares.empty()) {
    for (const Observations& group : observations) shares.emplace_back(static_cast<std::size_t>(group.n_data()), 1);
  }
  for (std::vector<double>& of_group : shares) {
    for (double& one : of_group) one *= share;
  }
  linearise_kept(1);
}

void Posterior::Implementation::linearise_kept(const Workers& workers) {
  if (!prior.is_nonlinear()) return;
  const auto& through = static_cast<const InducingPosterior&>(*latents);
  about = linearise_through_points(prior, observations, values, through.inducing(), through.mean(), workers.n_threads);
  if (about) return;
  throw NumericalError(
      "at a state that was observed there is no motion under the posterior mean of the latents: the load grows with the force "
      "that it makes");
}

namespace {

// Of more observations, at the posterior mean of all: rows about it move it, and about where it has moved they are others.
// Returns the latents given all.
std::shared_ptr<LatentPosterior> nonlinear_with(const InducingPosterior& before, const Prior& prior,
                                                const std::vector<Observations>& added, const ModelValues& values) {
  constexpr int most = 50;
  constexpr double enough = 1e-7;  // of the size of the latents, as of the first fit
  VectorXd mean = before.mean();
  for (int step = 0; step < most; ++step) {
    const auto about = linearise_through_points(prior, added, values, before.inducing(), mean, 1);
    if (!about) {
      static_cast<void>(require_models(prior, added, values.parameters, nullptr));  // names the state
      break;
    }
    auto all = std::make_shared<InducingPosterior>(before);
    if (!all->append(BlocksOfStates(prior, added, values, about.get()))) throw_not_definite();
    const double distance = (all->mean() - mean).norm() / std::sqrt(1 + mean.squaredNorm());
    if (distance <= enough) return all;
    mean = all->mean();
  }
  throw NumericalError(
      "update: the posterior of latents that enter nonlinearly was not found from the sums of the observations before: fit all "
      "observations together");
}

}  // namespace

void Posterior::Implementation::add_through_points(const Observations& more, std::size_t group) {
  const std::vector<Observations> added = {more};
  ModelValues under = values;
  under.noise_stddev = {more.noise().stddev()};
  if (prior.is_nonlinear()) {
    latents = nonlinear_with(static_cast<const InducingPosterior&>(*latents), prior, added, under);
  } else if (!latents->append(BlocksOfStates(prior, added, under, nullptr))) {
    static_cast<void>(require_models(prior, added, values.parameters, nullptr));  // names the state
    throw_not_definite();
  }
  const bool is_new = group == observations.size();
  if (is_new) kept->n_states.push_back(0);
  kept->stretch_of.clear();  // what is new is of none
  // every k-th of all
  std::int64_t& n_states = kept->n_states[group];
  std::vector<int> states;
  for (int i = 0; i < more.n_data(); ++i, ++n_states) {
    if (n_states % kept->step == 0) states.push_back(i);
  }
  if (!kept->share_of.empty()) {
    kept->share_of.resize(kept->n_states.size());
    kept->share_of[group].insert(kept->share_of[group].end(), states.size(), 1);
  }
  if (is_new) {
    observations.push_back(more.take(states));
    values.noise_stddev.push_back(more.noise().stddev());
  } else if (!states.empty()) {
    observations[group].append(more.take(states));
  }
  keep_some(observations, *kept);
  linearise_kept(1);
}

Posterior Posterior::of_summary(const Prior& prior, const std::vector<Observations>& observations,
                                const std::vector<ModelValues>& values, const InducingSummary& summary) {
  const lapack::SingleThread single_thread;
  if (values.empty() || values.size() != summary.components.size()) {
    throw InputError(
        fmt::format("Posterior::of_summary: sums of {} components, values of {}", summary.components.size(), values.size()));
  }
  Components components;
  for (std::size_t k = 0; k < values.size(); ++k) {
    auto self = std::make_shared<Implementation>(prior, observations, values[k]);
    auto through = std::make_shared<InducingPosterior>(summary.components[k].latents, std::vector{summary.components[k].all});
    if (!through->factorise()) throw_not_definite();
    self->latents = std::move(through);
    self->kept = summary.kept;
    self->linearise_kept(1);
    components.push_back(std::move(self));
  }
  return Posterior(std::move(components));
}

std::shared_ptr<const InducingSummary> Posterior::summary() const {
  if (!held().front()->kept) return nullptr;
  auto summary = std::make_shared<InducingSummary>();
  summary->kept = *held().front()->kept;
  summary->kept.stretch_of.clear();  // its sums are of all stretches together
  for (const auto& component : held()) {
    const auto& through = static_cast<const InducingPosterior&>(*component->latents);
    summary->components.push_back({through.inducing(), through.all()});
  }
  return summary;
}

std::int64_t Posterior::n_states() const {
  const Implementation& self = *held().front();
  return self.kept ? std::accumulate(self.kept->n_states.begin(), self.kept->n_states.end(), std::int64_t{0})
                   : gp2::n_states(self.observations);
}

}  // namespace gp2
