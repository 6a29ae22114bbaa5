#include "files/prior_difference.hpp"

#include <algorithm>

#include <fmt/format.h>

namespace gp2 {

using Eigen::MatrixXd;

namespace {

bool are_same(const MatrixXd& a, const MatrixXd& b) {
  return a.rows() == b.rows() && a.cols() == b.cols() &&
         (a.array() == b.array() || (a.array().isNaN() && b.array().isNaN())).all();
}

template <class Matrix>
bool are_same(const std::vector<Matrix>& a, const std::vector<Matrix>& b) {
  return std::equal(a.begin(), a.end(), b.begin(), b.end(), [](const auto& x, const auto& y) { return are_same(x, y); });
}

bool are_same(const std::shared_ptr<const InducingPoints>& a, const std::shared_ptr<const InducingPoints>& b) {
  return a && b ? are_same(a->features, b->features) : a == b;
}

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

}  // namespace

bool are_same(const ModelValues& a, const ModelValues& b) {
  const bool all_but_loadings = are_same(a.kernel, b.kernel) && are_same(a.signal_stddev, b.signal_stddev) &&
                                are_same(a.noise_stddev, b.noise_stddev) && are_same(a.parameters, b.parameters) &&
                                are_same(a.inducing, b.inducing);
  for (std::size_t k = 0; all_but_loadings && k < a.kernel.size(); ++k) {
    if (!are_same(a.loading(k), b.loading(k))) return false;
  }
  return all_but_loadings;
}

std::string difference_at(const Observations& group, const PriorAt& made, const PriorAt& fitted) {
  const System &mine = *made.prior.system, &its = *fitted.prior.system;
  if (mine.state_names() != its.state_names()) return "the coordinates and inputs";
  if (mine.parameters().size() != its.parameters().size() || !are_same(made.parameters, fitted.parameters)) {
    return "the parameters of the system";
  }
  const std::string latents = difference_of_latents(made.prior, fitted.prior);
  if (!latents.empty()) return latents;
  const std::vector<PriorPart> here = parts_at(made, group.states()), there = parts_at(fitted, group.states());
  const auto [mine_differs, its_differs] =
      std::ranges::mismatch(here, there, [](const PriorPart& x, const PriorPart& y) { return are_same(x.values, y.values); });
  return its_differs == there.end() ? "" : its_differs->what;
}

std::vector<PriorPart> parts_at(const PriorAt& at, const Eigen::Ref<const MatrixXd>& states) {
  MechanicsBatch mechanics;
  evaluate_mechanics(*at.prior.system, states, at.parameters, mechanics);
  PriorValues prior = evaluate_prior(at.prior, states, at.parameters, mechanics);
  SystemValues& values = mechanics.values;
  std::vector<PriorPart> parts = {{"M", std::move(values.mass)},
                                  {"A", std::move(values.constraint_matrix)},
                                  {"b", std::move(values.constraint_vector)},
                                  {"the prior mean", std::move(prior.mean)}};
  for (std::size_t a = 0; a < at.prior.latents.size(); ++a) {
    const std::string& name = at.prior.latents[a].name;
    parts.push_back({fmt::format("the directions of the latent '{}'", name), std::move(prior.directions[a])});
    parts.push_back({fmt::format("the features of the latent '{}'", name), evaluate_features(at.prior, a, states).transpose()});
  }
  return parts;
}

}  // namespace gp2
