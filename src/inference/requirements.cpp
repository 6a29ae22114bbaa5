#include "inference/requirements.hpp"

#include <algorithm>
#include <cmath>
#include <string>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

void require_observations(const Prior& prior, const Observations& observations) {
  require_view(prior, observations.view());
  const System& system = *prior_of(prior, observations.view()).system;
  system.require_states(observations.states());
  if (observations.has_sums() && system.has_constraint_noise()) {
    throw InputError("sums over states cannot be of a system whose constraints are soft");
  }
}

void require_observations(const Prior& prior, const std::vector<Observations>& observations) {
  require_prior(prior);
  for (std::size_t g = 0; g < observations.size(); ++g) {
    try {
      require_observations(prior, observations[g]);
    } catch (const InputError& error) {
      throw InputError(fmt::format("observations {}: {}", g + 1, error.what()));
    }
  }
}

void require_measured(const std::vector<Observations>& observations, const char* function) {
  const auto is_measured = [](const Observations& group) { return !group.values().array().isNaN().all(); };
  if (std::any_of(observations.begin(), observations.end(), is_measured)) return;
  throw InputError(fmt::format("{}: there is nothing to learn from: {}", function,
                               observations.empty() ? "no observations are given" : "every value is NaN, not measured"));
}

namespace {

enum class Sign { any, not_negative, positive };

bool has_sign(double value, Sign sign) {
  return std::isfinite(value) && (sign == Sign::any || value > 0 || (sign == Sign::not_negative && value == 0));
}

// @param of  gives "kernel of latent 'f'"
template <typename Of>
void require_numbers(const VectorXd& values, Index size, Sign sign, const Of& of) {
  if (values.size() != size) throw InputError(fmt::format("values: {} must have {} numbers, got {}", of(), size, values.size()));
  for (const double value : values) {
    if (has_sign(value, sign)) continue;
    throw InputError(fmt::format("values: {} must be finite{}, got {}", of(),
                                 sign == Sign::any        ? ""
                                 : sign == Sign::positive ? " and positive"
                                                          : " and not negative",
                                 value));
  }
}

void require_count(const char* member, std::size_t got, std::size_t wanted, const char* owners) {
  if (got != wanted) throw InputError(fmt::format("values: {} is of {} {}, there are {}", member, got, owners, wanted));
}

void require_inducing(const Prior& prior, const std::vector<Observations>& observations, const InducingPoints& points) {
  require_count("inducing", points.features.size(), prior.latents.size(), "latents");
  for (std::size_t a = 0; a < points.features.size(); ++a) {
    const MatrixXd& features = points.features[a];
    if (features.cols() == prior.latents[a].n_features() && features.allFinite()) continue;
    throw InputError(fmt::format("values: inducing points of latent '{}' must be finite and have {} features, got {}",
                                 prior.latents[a].name, prior.latents[a].n_features(), features.cols()));
  }
  for (const Observations& group : observations) {
    if (group.has_sums()) throw InputError("values: sums over states are not learned through inducing points");
  }
}

}  // namespace

void require_values(const Prior& prior, const std::vector<Observations>& observations, const ModelValues& values) {
  const std::size_t n_latents = prior.latents.size();
  require_count("kernel", values.kernel.size(), n_latents, "latents");
  require_count("signal_stddev", values.signal_stddev.size(), n_latents, "latents");
  for (std::size_t a = 0; a < n_latents; ++a) {
    const Latent& latent = prior.latents[a];
    const auto of = [&](const char* what) {
      return [&latent, what] { return fmt::format("{} of latent '{}'", what, latent.name); };
    };
    require_numbers(values.kernel[a], std::ssize(latent.kernel.parameters()), Sign::positive, of("kernel"));
    require_numbers(values.signal_stddev[a], latent.size(), Sign::not_negative, of("signal_stddev"));
    if (latent.is_potential && (values.signal_stddev[a].array() != values.signal_stddev[a][0]).any()) {
      throw InputError(fmt::format("values: {} must be one number for all, that of its potential", of("signal_stddev")()));
    }
    const Index n_functions = latent.free_loading.value_or(0), n_rows = n_functions > 0 ? latent.size() : 0;
    const MatrixXd none;
    const MatrixXd& C = values.has_free_loading(a) ? values.free_loading[a] : none;
    if (C.rows() != n_rows || C.cols() != n_functions) {
      throw InputError(
          fmt::format("values: {} must be {} × {}, got {} × {}", of("free_loading")(), n_rows, n_functions, C.rows(), C.cols()));
    }
    if (!C.allFinite()) throw InputError(fmt::format("values: {} has a number that is not finite", of("free_loading")()));
  }
  require_count("noise_stddev", values.noise_stddev.size(), observations.size(), "observations");
  for (std::size_t g = 0; g < observations.size(); ++g) {
    require_numbers(values.noise_stddev[g], observations[g].view().size(), Sign::positive,
                    [g] { return fmt::format("noise_stddev of observations {}", g + 1); });
  }
  if (values.inducing) require_inducing(prior, observations, *values.inducing);
  require_numbers(values.parameters, std::ssize(prior.system->parameters()), Sign::any,
                  [&] { return fmt::format("parameters of '{}'", prior.system->name()); });
}

void require_learnable(const Prior& prior, const std::vector<Observations>& observations) {
  if (!prior.is_nonlinear()) return;
  const auto fail = [](const std::string& text) {
    throw InputError(fmt::format("a latent that is positive or reads lambda is not linear: {}", text));
  };
  for (const Observations& group : observations) {
    if (group.view().latent || !group.view().quantity->has_mean()) fail("it is learned from the whole motion, not from a part");
  }
  for (const Latent& latent : prior.latents) {
    if (latent.free_loading) fail("its loadings are not free");
  }
}

void require_size(const char* type, const char* what, Index got, Index wanted) {
  if (got != wanted) throw InputError(fmt::format("{}: {} is of size {}, got {}", type, what, wanted, got));
}

void throw_moved(const char* type) {
  throw InputError(fmt::format("{}: it was moved away; use the one that it was moved to", type));
}

}  // namespace gp2
