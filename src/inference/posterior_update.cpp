#include <algorithm>
#include <numeric>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "gp2/error.hpp"
#include "gp2/posterior.hpp"
#include "inference/posterior_implementation.hpp"
#include "inference/requirements.hpp"
#include "prior/padded_rows.hpp"

// Posteriors that grow and shrink with their data.
namespace gp2 {

using Eigen::Index;

namespace {

// `samples` say which observations there are, no matter in what order. Conditioning numbers them 0, 1, … group after group; they keep
// the numbers that they had.
void condition_anew(Posterior::Implementation& self) {
  std::vector<std::pair<int, std::int64_t>> numbers;
  for (const Posterior::Implementation::Sample& sample : self.samples) numbers.emplace_back(sample.group, sample.number);
  std::ranges::sort(numbers);
  self.samples.clear();
  self.next_number = 0;
  self.latents = nullptr;
  self.about = nullptr;
  if (numbers.empty()) return self.add_samples({}, {}, 0);  // the prior, whose groups may stay
  self.condition(1);
  for (Posterior::Implementation::Sample& sample : self.samples) {
    sample.number = numbers[static_cast<std::size_t>(sample.number)].second;
    self.next_number = std::max(self.next_number, sample.number + 1);
  }
}

// The group that has this view and noise, or one of its own. The noise of a mixture is that of its components only in the mean: each
// has its own for what is added to the group.
std::size_t group_of(const Posterior& posterior, const Observations& added) {
  const std::vector<Observations>& groups = posterior.observations();
  // where the oldest may have to go, what is added joins the last group alone: a file has its states group after group, the oldest first
  std::size_t group = posterior.summary() || groups.empty() ? 0 : groups.size() - 1;
  const auto belongs = [&] {
    const Observations& there = groups[group];
    if (there.has_sums() || there.view() != added.view() || there.noise().has_scale() != added.noise().has_scale()) return false;
    constexpr double rounding = 1e-12;
    const Eigen::VectorXd stddev = posterior.noise_stddev(group);
    return ((added.noise().stddev() - stddev).array().abs() <= rounding * stddev.array()).all();
  };
  while (group < groups.size() && !belongs()) ++group;
  return group;
}

void add(Posterior::Implementation& self, Observations added, std::size_t group) {
  if (group < self.observations.size()) {
    added = added.with_noise(Noise(self.values.noise_stddev[group], added.noise().is_estimated(), added.noise().scale()));
  }
  if (self.kept) {
    self.add_through_points(added, group);
    return;
  }
  const bool is_linear = !self.prior.is_nonlinear();
  for (int i = 0; i < added.n_data() && !is_linear; ++i) self.samples.push_back({static_cast<int>(group), self.next_number + i});
  if (is_linear) self.add_samples({added}, {added.noise().stddev()}, static_cast<int>(group));
  if (group < self.observations.size()) {
    self.observations[group].append(added);
  } else {
    self.values.noise_stddev.push_back(added.noise().stddev());
    self.observations.push_back(added);
  }
  // where a nonlinear prior is linearised moves with every observation
  if (!is_linear) condition_anew(self);
}

void remove_oldest_of(Posterior::Implementation& self, int n, bool conditions_anew) {
  std::vector<Index> gone(self.samples.size());
  std::iota(gone.begin(), gone.end(), Index{0});
  const auto is_older = [&](Index i, Index j) {
    return self.samples[static_cast<std::size_t>(i)].number < self.samples[static_cast<std::size_t>(j)].number;
  };
  std::partial_sort(gone.begin(), gone.begin() + n, gone.end(), is_older);
  gone.resize(static_cast<std::size_t>(n));
  std::sort(gone.begin(), gone.end());

  // in each group the oldest stand first
  std::vector<int> n_gone(self.observations.size());
  for (const Index sample : gone) ++n_gone[static_cast<std::size_t>(self.samples[static_cast<std::size_t>(sample)].group)];
  self.samples.resize(static_cast<std::size_t>(close_gaps(self.samples.data(), std::ssize(self.samples), gone)));
  if (!conditions_anew) self.latents->erase(gone);
  for (std::size_t group = 0; group < n_gone.size(); ++group) self.observations[group].remove_first(n_gone[group]);
  self.erase_empty_groups();
  if (conditions_anew) condition_anew(self);
}

}  // namespace

std::vector<std::shared_ptr<Posterior::Implementation>> Posterior::own_components(bool conditions_anew) const {
  std::vector<std::shared_ptr<Implementation>> own;
  for (const auto& component : conditioned()) {
    // of several, one that fails must leave the others as they were; what is conditioned anew must stay if it fails
    const bool is_anew = conditions_anew || component->prior.is_nonlinear();
    if (components_.size() > 1 || component.use_count() > 1 || is_anew) {
      own.push_back(std::make_shared<Implementation>(*component));
      if (!is_anew || component->kept) own.back()->latents = component->latents->clone();
      continue;
    }
    // What another thread read through a copy that it has just let go was read before what is written now: to count down acquires
    // what it released. A fence would do, but the thread sanitizer does not know them.
    std::shared_ptr<const Implementation>(component).reset();
    own.push_back(std::const_pointer_cast<Implementation>(component));
  }
  return own;
}

Posterior update(Posterior&& posterior, Observations added) {
  require_observations(posterior.prior(), added);
  require_learnable(posterior.prior(), {added});
  added.require_no_sums();
  if (added.n_data() == 0) return std::move(posterior);
  const lapack::SingleThread single_thread;
  const std::size_t group = group_of(posterior, added);
  const auto own = posterior.own_components();
  for (const auto& component : own) add(*component, added, group);
  posterior.components_.clear();
  return Posterior(Posterior::Components(own.begin(), own.end()));
}

void set_prior(Posterior& posterior, const Prior& prior) {
  const auto own = posterior.own_components();
  for (const auto& component : own) component->prior = prior;
  posterior.components_.assign(own.begin(), own.end());
}

Posterior forget(Posterior&& posterior, double share) {
  if (!(share > 0 && share <= 1)) throw InputError(fmt::format("`forget`: a share is above 0 and at most 1, got {}", share));
  if (!posterior.implementation().kept) {
    throw InputError("`forget`: observations of an exact fit are known one by one: the oldest go by `window`");
  }
  const lapack::SingleThread single_thread;
  const auto own = posterior.own_components();
  for (const auto& component : own) component->forget(share);
  posterior.components_.clear();
  return Posterior(Posterior::Components(own.begin(), own.end()));
}

Posterior remove_oldest(Posterior&& posterior, int n) {
  if (posterior.implementation().kept) {
    throw InputError(
        "remove_oldest: what was learned through inducing points cannot be taken away, since the observations themselves are not "
        "kept; `forget` discounts it");
  }
  const std::size_t n_samples = posterior.implementation().samples.size();
  if (n < 0 || static_cast<std::size_t>(n) > n_samples) {
    throw InputError(
        fmt::format("remove_oldest: there are {} observed states, so n must be 0 … {}, got {}", n_samples, n_samples, n));
  }
  for (const Observations& group : posterior.observations()) group.require_no_sums();
  const lapack::SingleThread single_thread;
  // to take most rows from a factor costs more than to factor what is left
  const bool conditions_anew = posterior.prior().is_nonlinear() || static_cast<std::size_t>(n) > n_samples / 2;
  const auto own = posterior.own_components(conditions_anew);
  for (const auto& component : own) remove_oldest_of(*component, n, conditions_anew);
  posterior.components_.clear();
  return Posterior(Posterior::Components(own.begin(), own.end()));
}

void Posterior::Implementation::erase_empty_groups() {
  std::vector<int> renumbered;
  std::size_t n_kept = 0;
  for (std::size_t group = 0; group < observations.size(); ++group) {
    renumbered.push_back(static_cast<int>(n_kept));
    if (group >= n_given_groups && observations[group].n_data() == 0) continue;
    if (n_kept < group) {
      observations[n_kept] = std::move(observations[group]);
      values.noise_stddev[n_kept] = std::move(values.noise_stddev[group]);
    }
    ++n_kept;
  }
  if (n_kept == observations.size()) return;
  observations.erase(observations.begin() + static_cast<std::ptrdiff_t>(n_kept), observations.end());
  values.noise_stddev.resize(n_kept);
  for (Sample& sample : samples) sample.group = renumbered[static_cast<std::size_t>(sample.group)];
}

}  // namespace gp2
