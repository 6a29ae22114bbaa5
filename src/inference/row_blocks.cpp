#include "inference/row_blocks.hpp"

#include <algorithm>
#include <utility>

#include "data/evenly.hpp"
#include "inference/nonlinear_motion.hpp"

namespace gp2 {

using Eigen::Index;

std::size_t BlocksOfStates::Kept::bytes() const {
  Index n = reduction ? reduction->y.size() : 0;
  for (const Eigen::MatrixXd& one : features) n += one.size();
  for (const ObservationModel& model : models) {
    const auto& [view, prior] = model.values;
    n += view.matrix.size() + view.offset.size() + view.slip.size() + prior.mean.size();
    for (const Eigen::MatrixXd& one : prior.directions) n += one.size();
  }
  if (reduction) {
    for (const Eigen::MatrixXd& one : reduction->directions) n += one.size();
  }
  return static_cast<std::size_t>(n) * sizeof(double);
}

namespace {

// of some states, evenly taken
double largest_b(const Prior& prior, const Observations& group, const Eigen::VectorXd& parameters) {
  constexpr int few = 256;
  const System& system = *prior_of(prior, group.view()).system;
  if (system.nc() == 0) return 0;
  const Observations some = evenly({group}, few).front();
  double largest = 0;
  for (const UdwadiaKalaba& projection :
       evaluate_mechanics(system, some.states(), parameters_of(group.view(), parameters)).projections) {
    largest = std::max(largest, projection.size_of_b());
  }
  return largest;
}

}  // namespace

BlocksOfStates::BlocksOfStates(const Prior& prior, const std::vector<Observations>& observations, const ModelValues& values,
                               const Linearisation* about, std::vector<int> gradient_parameters, const std::vector<Kept>* kept)
    : prior_(prior),
      observations_(observations),
      values_(values),
      about_(about),
      gradient_parameters_(std::move(gradient_parameters)),
      kept_(kept) {
  const bool makes_blocks =
      kept == nullptr || std::any_of(kept->begin(), kept->end(), [](const Kept& one) { return one.features.empty(); });
  for (std::size_t g = 0; g < observations.size(); ++g) {
    const int n = observations[g].n_data();
    for (int first = 0; first < n; first += block_size) states_.push_back({g, first, std::min(block_size, n - first)});
    size_of_b_.push_back(n > block_size && makes_blocks ? largest_b(prior, observations[g], values.parameters) : 0);
  }
}

const RowBlock* BlocksOfStates::block(Index b, bool with_derivatives, Memory& memory) const {
  const auto& [group, first, n] = states_[static_cast<std::size_t>(b)];
  const Kept* kept = kept_ == nullptr ? nullptr : &(*kept_)[static_cast<std::size_t>(b)];
  if (kept != nullptr && kept->features.empty()) kept = nullptr;  // another process has kept it
  RowBlock& block = memory.block;
  block.first_group = group;
  block.number = b;
  block.observations = nullptr;
  block.models = nullptr;
  if (kept != nullptr && kept->reduction) {
    block.rows = latent_rows(prior_, kept->features, *kept->reduction, values_);
    return &block;
  }
  memory.observations.clear();
  memory.observations.push_back(observations_[group].slice(first, n));
  block.observations = &memory.observations;
  if (kept != nullptr) {
    block.models = &kept->models;
  } else {
    memory.models.resize(1);
    memory.models.front().mechanics.size_of_b_elsewhere = size_of_b_[group];
    const std::vector<int> in = with_derivatives ? gradient_parameters_ : std::vector<int>{};
    const Linearisation* about = nullptr;
    if (about_ != nullptr) {
      memory.about.groups = {slice(about_->groups[group], first, n)};
      about = &memory.about;
    }
    if (model_observations(prior_, memory.observations, values_.parameters, in, about, memory.models)) return nullptr;
    block.models = &memory.models;
  }
  reduce(prior_, memory.observations, *block.models, {values_.noise_stddev[group]}, memory.reduction);
  block.rows = kept == nullptr
                   ? latent_rows(prior_, memory.observations, memory.reduction, values_)
                   : latent_rows(prior_, sorted_features(prior_, {kept->features}, memory.reduction), memory.reduction, values_);
  return &block;
}

bool BlocksOfStates::solve_multipliers(Index b, Linearisation& at) const {
  const auto& [g, first, n] = states(b);
  const Observations& group = observations_[g];
  const Prior& there = prior_of(prior_, group.view());
  const Eigen::VectorXd parameters = parameters_of(group.view(), values_.parameters);
  const auto states = group.states().middleCols(first, n);
  MechanicsBatch mechanics;
  mechanics.size_of_b_elsewhere = size_of_b_[g];
  evaluate_mechanics(there, group.view(), states, parameters, mechanics);
  if (mechanics.fault) return false;
  PriorValues at_known_load = evaluate_prior(there, states, parameters, mechanics);
  if (at_known_load.fault) return false;
  Linearisation::OfGroup& of_group = at.groups[g];
  Linearisation::OfGroup of_block;
  for (const Eigen::MatrixXd& s : of_group.signals) of_block.signals.emplace_back(s.middleCols(first, n));
  if (NonlinearMotion(there, states, parameters, mechanics, std::move(at_known_load)).solve(of_block)) return false;
  of_group.multipliers.middleCols(first, n) = of_block.multipliers;
  return true;
}

BlocksOfStates::Kept BlocksOfStates::keep(const RowBlock& block, bool with_reduction) const {
  Kept kept;
  if (!with_reduction) {
    kept.models = *block.models;
    for (ObservationModel& model : kept.models) model.mechanics = {};
    kept.features = std::move(features_by_group(prior_, *block.observations).front());
    return kept;
  }
  kept.reduction = *block.rows.reduction;
  kept.reduction->samples = {};
  for (const LatentRows::OfLatent& latent : block.rows.latents) {
    kept.features.emplace_back(latent.kernel.features().topRows(block.rows.n_samples()));
  }
  return kept;
}

}  // namespace gp2
