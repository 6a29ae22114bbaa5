#include "gp2/jobs/report_job.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <iterator>
#include <numeric>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "data/evenly.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "prior/code_function.hpp"
#include "prior/load_function.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::RowVectorXd;
using Eigen::VectorXd;

namespace {

// The row of the training data that is nearest to the medians of what the prior reads, in spreads.
VectorXd usual_state(const Prior& prior, const MatrixXd& states) {
  const std::vector<bool> reads = prior.reads();
  VectorXd distance = VectorXd::Zero(states.cols());
  for (Index k = 0; k < states.rows(); ++k) {
    if (!reads[static_cast<std::size_t>(k)]) continue;
    const auto row = states.row(k).array();
    const double middle = median({row.begin(), row.end()});
    const double spread = (row - middle).abs().mean();
    if (spread > 0) distance.array() += ((row - middle) / spread).square().transpose();
  }
  Index nearest = 0;
  distance.minCoeff(&nearest);
  return states.col(nearest);
}

// A view of what multiplies the one direction of a latent on forces: its force where this direction is 1 on the first coordinate and
// those of other latents that read a load are 0. The load, which changes with it, has no part in it.
View multiplier_of_direction(const Prior& prior, std::size_t of) {
  OtherSystem plain{prior, std::vector<int>(prior.system->parameters().size())};
  std::iota(plain.shared.begin(), plain.shared.end(), 0);
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    std::shared_ptr<const StateFunction>& directions = plain.prior.latents[a].directions;
    if (a != of && !prior.latents[a].reads_multipliers()) continue;
    const VectorXd constant = VectorXd::Unit(directions->size(), 0) * (a == of ? 1 : 0);
    StateCode code;
    code.evaluate = [constant](const StateCode::States& states, const StateCode::Parameters&) {
      return MatrixXd(constant.replicate(1, states.cols()));
    };
    code.reads = std::vector<std::string>();
    directions =
        std::make_shared<CodeFunction>(std::move(code), "the direction of a coefficient", directions->size(), prior.system);
  }
  View view = View::learned_force(*prior.system);
  view.rows = {0};
  view.latent = static_cast<int>(of);
  view.other_system = std::make_shared<const OtherSystem>(std::move(plain));
  return view;
}

// What a latent is along its one direction that knows the load, as a friction coefficient. Nothing where there is hardly a load.
std::optional<LearnedForce> coefficient_of(const Posterior& posterior, std::size_t of, const MatrixXd& states,
                                           const LearnedForce& force) {
  const Latent& latent = posterior.prior().latents[of];
  const auto* const load = dynamic_cast<const LoadFunction*>(latent.directions.get());
  if (load == nullptr || latent.size() != 1 || latent.base != Latent::Base::force) return std::nullopt;
  const VectorXd& parameters = posterior.values().parameters;
  MatrixXd directions;
  if (const StateFunction* const of_multipliers = load->of_multipliers()) {
    const MatrixXd multipliers = posterior.mean(View::multipliers(*posterior.prior().system), states);
    MatrixXd with_load(states.rows() + multipliers.rows(), states.cols());
    with_load << states, multipliers;
    directions = of_multipliers->evaluate(with_load, parameters);
  } else {
    directions = load->evaluate(states, parameters);
  }
  Index row = 0;
  directions.rowwise().norm().maxCoeff(&row);
  const VectorXd direction = directions.row(row).transpose();
  std::vector<Index> loaded;
  for (Index i = 0; i < direction.size(); ++i) {
    if (std::abs(direction[i]) > 1e-3 * direction.cwiseAbs().maxCoeff()) loaded.push_back(i);
  }
  if (2 * std::ssize(loaded) < direction.size()) return std::nullopt;
  LearnedForce out = force;
  out.names = {"coefficient" + (force.names[0].find('@') == std::string::npos ? "" : "@" + latent.name)};
  out.at = force.at(loaded);
  const Posterior::Marginal coefficient =
      posterior.marginal(multiplier_of_direction(posterior.prior(), of), states(Eigen::all, loaded));
  out.mean = coefficient.mean;
  out.stddev = coefficient.stddev();
  return out;
}

// The features of a latent, of which nothing was learned outside their ranges in the training data.
class FeaturesOfData {
 public:
  FeaturesOfData(const Prior& prior, std::size_t latent, const MatrixXd& states)
      : prior_(prior), latent_(latent), of_data_(evaluate_features(prior, latent, states)) {
    constexpr double margin = 0.05;  // of the range: a curve may go a little beyond
    const RowVectorXd low = of_data_.colwise().minCoeff(), high = of_data_.colwise().maxCoeff();
    const RowVectorXd pad = margin * (high - low) + 1e-9 * low.cwiseAbs().cwiseMax(high.cwiseAbs());
    low_ = low - pad, high_ = high + pad;
  }

  // Ends of the stretch about a state along its entry k, of those from `low` to `high`, on which all features stay within.
  [[nodiscard]] std::pair<double, double> stretch(VectorXd state, Index k, double low, double high) const {
    const double start = state[k];
    const auto is_within = [&](double value) {
      state[k] = value;
      return holds(state);
    };
    const auto end = [&](double to) {
      constexpr int n_steps = 100, n_halvings = 30;
      double inside = start;
      for (int i = 1; i <= n_steps; ++i) {
        double outside = i == n_steps ? to : start + (to - start) * i / n_steps;
        if (is_within(outside)) {
          inside = outside;
          continue;
        }
        for (int half = 0; half < n_halvings; ++half) {
          const double middle = 0.5 * (inside + outside);
          (is_within(middle) ? inside : outside) = middle;
        }
        break;
      }
      return inside;
    };
    return {end(low), end(high)};
  }

  // The one that changes from state to state, always to the same side; none where others change too.
  [[nodiscard]] std::optional<Index> only_one_along(const MatrixXd& states, VectorXd& values) const {
    const MatrixXd features = evaluate_features(prior_, latent_, states);
    std::optional<Index> changing;
    for (Index d = 0; d < features.cols(); ++d) {
      if (!(features.col(d).maxCoeff() - features.col(d).minCoeff() > 1e-6 * (high_[d] - low_[d]))) continue;
      if (changing) return std::nullopt;
      changing = d;
    }
    if (!changing) return std::nullopt;
    values = features.col(*changing);
    const VectorXd steps = values.tail(values.size() - 1) - values.head(values.size() - 1);
    if (!(steps.array() > 0).all() && !(steps.array() < 0).all()) return std::nullopt;
    return changing;
  }

  [[nodiscard]] VectorXd of_data(Index feature) const { return of_data_.col(feature); }

 private:
  [[nodiscard]] bool holds(const VectorXd& state) const {
    try {
      const auto here = evaluate_features(prior_, latent_, state).row(0).array().eval();
      return (here >= low_.array() && here <= high_.array()).all();
    } catch (const InputError&) {  // where no data are a feature may have no value
      return false;
    }
  }

  const Prior& prior_;
  std::size_t latent_;
  MatrixXd of_data_;  // (N × D)
  RowVectorXd low_, high_;
};

// States along one entry of a usual one, where the features of a latent stay within those of the data. Where that is a small part of
// the entry's range, they are told by the one feature that changes there, if it is one.
struct StatesAlong {
  std::string along;
  VectorXd at, data;
  MatrixXd states;
};
std::optional<StatesAlong> states_along(const FeaturesOfData& features, const Latent& latent, const VectorXd& usual, Index k,
                                        const std::string& entry, const VectorXd& data) {
  constexpr Index n_points = 101;
  constexpr double small_part = 0.2;
  const auto [low, high] = features.stretch(usual, k, data.minCoeff(), data.maxCoeff());
  StatesAlong out{entry, VectorXd::LinSpaced(n_points, low, high), data, usual.replicate(1, n_points)};
  out.states.row(k) = out.at.transpose();
  if (high - low >= small_part * (data.maxCoeff() - data.minCoeff())) return out;
  const std::optional<Index> feature = features.only_one_along(out.states, out.at);
  if (!feature) return std::nullopt;
  out.along = latent.feature_names[static_cast<std::size_t>(*feature)];
  out.data = features.of_data(*feature);
  if (out.at[0] > out.at[n_points - 1]) {
    out.at.reverseInPlace();
    out.states = out.states.rowwise().reverse().eval();
  }
  return out;
}

// Those along the entries of the state that do most.
void move_largest(std::vector<LearnedForce>& some, std::vector<LearnedForce>& all) {
  constexpr std::ptrdiff_t most = 6;
  constexpr double worth_a_look = 0.02;  // of what the entry does that does most
  const auto effect = [](const LearnedForce& one) {
    return (one.mean.rowwise().maxCoeff() - one.mean.rowwise().minCoeff()).norm();
  };
  std::ranges::stable_sort(some, std::greater(), effect);
  const auto is_small = [&](const LearnedForce& one) { return !(effect(one) > worth_a_look * effect(some.front())); };
  const std::ptrdiff_t n = std::min(most, std::ranges::find_if(some, is_small) - some.begin());
  std::move(some.begin(), some.begin() + n, std::back_inserter(all));
}

// Where the fitted system was observed: by its accelerations, or else by what else is known.
MatrixXd own_states(const Posterior& posterior) {
  MatrixXd states(posterior.prior().system->layout().size(), 0);
  for (const bool of_ddq : {true, false}) {
    if (states.cols() > 0) break;
    for (const Observations& group : posterior.observations()) {
      if (group.view().other_system || group.view().is_of_ddq() != of_ddq) continue;
      states.conservativeResize(Eigen::NoChange, states.cols() + group.n_data());
      states.rightCols(group.n_data()) = group.states();
    }
  }
  return states;
}

}  // namespace

std::vector<LearnedForce> learned_forces(const Posterior& posterior, std::vector<std::string>* notes) {
  const Prior& prior = posterior.prior();
  const MatrixXd states = own_states(posterior);
  if (prior.reference || states.cols() == 0) return {};
  const VectorXd usual = usual_state(prior, states);
  const std::vector<std::string> entries = prior.system->state_names();
  const bool has_several = std::ranges::any_of(
      prior.latents, [&](const Latent& latent) { return !latent.kernel_is_fixed && latent.name != prior.latents[0].name; });
  std::vector<LearnedForce> all;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    if (latent.kernel_is_fixed || (a > 0 && prior.latents[a - 1].name == latent.name)) continue;  // one for each direction
    View view = View::learned_force(*prior.system);
    const std::vector<std::string> whole_names = view.names(*prior.system);
    view.latent = latents_called(prior, latent.name, "latent");
    const std::vector<std::string> names = has_several ? view.names(*prior.system, latent.name) : whole_names;
    const FeaturesOfData features(prior, a, states);
    std::vector<LearnedForce> of_latent, coefficients;
    std::vector<std::string> left_out;
    for (std::size_t k = 0; k < entries.size(); ++k) {
      const auto row = states.row(static_cast<Index>(k));
      if (!latent.features->reads(static_cast<int>(k)) || !(row.maxCoeff() > row.minCoeff())) continue;
      const std::optional<StatesAlong> path =
          states_along(features, latent, usual, static_cast<Index>(k), entries[k], row.transpose());
      if (!path) {
        left_out.push_back(entries[k]);
        continue;
      }
      const auto is_drawn = [&](const LearnedForce& one) { return one.along == path->along; };
      if (std::ranges::any_of(of_latent, is_drawn)) continue;  // by another entry that the feature reads
      try {
        const Posterior::Marginal marginal = posterior.marginal(view, path->states);
        of_latent.push_back({latent.name, path->along, names, path->at, marginal.mean, marginal.stddev(), path->data, true});
        if (auto one = coefficient_of(posterior, a, path->states, of_latent.back())) coefficients.push_back(*std::move(one));
      } catch (const InputError&) {  // where no data are a direction may have no value
      }
    }
    if (notes != nullptr && !left_out.empty()) {
      notes->push_back(
          fmt::format("what '{}' has learned is not drawn along {}: moved alone, {} features of the latent away from the data",
                      latent.name, fmt::join(left_out, ", "), left_out.size() == 1 ? "it takes" : "they take"));
    }
    move_largest(of_latent, all);
    move_largest(coefficients, all);
  }
  const bool are_all_rows = posterior.n_states() == n_states(posterior.observations());
  for (LearnedForce& one : all) one.are_all_rows = are_all_rows;
  return all;
}

}  // namespace gp2
