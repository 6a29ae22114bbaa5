#include <algorithm>
#include <numeric>

#include <fmt/format.h>

#include "base/lapack.hpp"
#include "gp2/error.hpp"
#include "gp2/posterior.hpp"
#include "inference/posterior_implementation.hpp"
#include "inference/requirements.hpp"

// Posteriors that grow and shrink with their data.
namespace gp2 {

using Eigen::Index;

std::shared_ptr<Posterior::Implementation> Posterior::own_implementation() const {
  static_cast<void>(implementation());  // it is conditioned
  if (implementation_.use_count() > 1) {
    auto copy = std::make_shared<Implementation>(*implementation_);
    copy->latents = implementation_->latents->clone();
    return copy;
  }
  // What another thread read through a copy that it has just let go was read before what is written now: to count down acquires
  // what it released. A fence would do, but the thread sanitizer does not know them.
  std::shared_ptr<const Implementation>(implementation_).reset();
  return std::const_pointer_cast<Implementation>(implementation_);
}

Posterior update(Posterior&& posterior, Observations added) {
  require_observations(posterior.prior(), added);
  const lapack::SingleThread single_thread;
  const auto self = posterior.own_implementation();

  // the group that has this view and noise, or one of its own
  std::size_t group = 0;
  const auto belongs = [&] {
    const Observations& there = self->observations[group];
    return there.view() == added.view() && self->values.noise_stddev[group] == added.noise().stddev() &&
           there.noise().has_scale() == added.noise().has_scale();
  };
  while (group < self->observations.size() && !belongs()) ++group;
  self->add_samples({added}, {added.noise().stddev()}, static_cast<int>(group));
  if (group < self->observations.size()) {
    self->observations[group].append(added);
  } else {
    self->values.noise_stddev.push_back(added.noise().stddev());
    self->observations.push_back(std::move(added));
  }
  posterior.implementation_.reset();
  return Posterior(self);
}

Posterior remove_oldest(Posterior&& posterior, int n) {
  const std::size_t n_samples = posterior.implementation().samples.size();
  if (n < 0 || static_cast<std::size_t>(n) > n_samples) {
    throw InputError(
        fmt::format("remove_oldest: there are {} observed states, so n must be 0 … {}, got {}", n_samples, n_samples, n));
  }
  const lapack::SingleThread single_thread;
  const auto self = posterior.own_implementation();
  std::vector<Index> gone(n_samples);
  std::iota(gone.begin(), gone.end(), Index{0});
  const auto is_older = [&](Index i, Index j) {
    return self->samples[static_cast<std::size_t>(i)].number < self->samples[static_cast<std::size_t>(j)].number;
  };
  std::partial_sort(gone.begin(), gone.begin() + n, gone.end(), is_older);
  gone.resize(static_cast<std::size_t>(n));
  std::sort(gone.begin(), gone.end());

  // in each group the oldest stand first
  std::vector<int> n_gone(self->observations.size());
  for (const Index sample : gone) ++n_gone[static_cast<std::size_t>(self->samples[static_cast<std::size_t>(sample)].group)];
  self->erase_samples(gone);
  for (std::size_t group = 0; group < n_gone.size(); ++group) self->observations[group].remove_first(n_gone[group]);
  self->erase_empty_groups();
  posterior.implementation_.reset();
  return Posterior(self);
}

void Posterior::Implementation::erase_empty_groups() {
  std::vector<int> renumbered;
  std::size_t kept = 0;
  for (std::size_t group = 0; group < observations.size(); ++group) {
    renumbered.push_back(static_cast<int>(kept));
    if (group >= n_given_groups && observations[group].n_data() == 0) continue;
    if (kept < group) {
      observations[kept] = std::move(observations[group]);
      values.noise_stddev[kept] = std::move(values.noise_stddev[group]);
    }
    ++kept;
  }
  if (kept == observations.size()) return;
  observations.erase(observations.begin() + static_cast<std::ptrdiff_t>(kept), observations.end());
  values.noise_stddev.resize(kept);
  for (Sample& sample : samples) sample.group = renumbered[static_cast<std::size_t>(sample.group)];
}

}  // namespace gp2
