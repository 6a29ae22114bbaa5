#pragma once

#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "gp2/fit.hpp"
#include "gp2/inference/evaluation.hpp"
#include "inference/problems.hpp"

// What data of one surface, or pooled from two, say about the motion on a third.
namespace gp2::test {

/// The published particle on a surface of other parameters p1 … p7.
inline Model surface_of(const std::vector<double>& p, const std::string& name) {
  std::string text = model("experiments/surface_published.toml").text;
  const std::size_t first = text.find("[parameters]"), end = text.find("[let]");
  std::string parameters = "[parameters]\n";
  for (std::size_t k = 0; k < p.size(); ++k) parameters += fmt::format("p{} = {}\n", k + 1, shortest(p[k]));
  return Model::parse(text.replace(first, end - first, parameters + "\n"), name);
}

/// Root mean square error of predicted accelerations on a third surface [m/s²], by what was trained on.
struct PooledScore {
  double first = 0, second = 0;            // n points of one surface
  double half_first = 0, half_second = 0;  // n/2 points of one surface
  double pooled = 0;                       // n/2 points of each

  PooledScore& operator+=(const PooledScore& other) {
    first += other.first;
    second += other.second;
    half_first += other.half_first;
    half_second += other.half_second;
    pooled += other.pooled;
    return *this;
  }
};

/// The third surface is drawn: none is chosen to suit.
inline PooledScore score_pooling(int n, std::uint64_t seed) {
  const Model first = surface_of({0.08, 0.05, 0.05, 0, 0, 0.1, 3}, "first surface");
  const Model second = surface_of({0, 0, 0, 0.1, -0.15, -0.1, 3}, "second surface");
  RandomStream random(seed, 77);
  std::vector<double> p;
  for (const double size : {0.1, 0.1, 0.1, 0.15, 0.15, 0.1}) p.push_back(size * (2 * random.uniform() - 1));
  p.push_back(2 + 2 * random.uniform());
  const Model third = surface_of(p, "third surface");
  const Prior prior = make_prior(first);
  const View ddq = View::all(Quantity::constrained_acceleration, *first.system);
  const auto measured = [&](const Model& surface, std::uint64_t of) {
    const GeneratedData data = generate(surface, {n, 100 * seed + of, VectorXd::Constant(3, 0.1)});
    const View view = &surface == &first ? ddq : under(ddq, make_other_system(first, surface));
    return Observations{data.states, view, data.accelerations, VectorXd::Constant(3, 0.1), false};
  };
  const Observations a = measured(first, 1), b = measured(second, 2);
  const auto half = [&](const Observations& group) {
    return Observations{group.states().leftCols(n / 2), group.view(), group.values().leftCols(n / 2), group.noise().stddev(),
                        false};
  };
  const GeneratedData truth = draw(third, 400, 100 * seed + 3);
  const auto there = make_other_system(first, third);
  const auto rmse = [&](const std::vector<Observations>& observations) {
    FitOptions options;
    options.n_restarts = 2;
    options.n_threads = 2;
    options.seed = seed;
    const Posterior posterior = fit(prior, observations, default_hyperparameters(prior, observations, {}, {}), options).posterior;
    const Evaluation e = evaluate_predictions(posterior, truth.states, {0, 1, 2}, truth.accelerations, {there});
    return e.rmse.norm() / std::sqrt(3.0);
  };
  return {rmse({a}), rmse({b}), rmse({half(a)}), rmse({half(b)}), rmse({half(a), half(b)})};
}

}  // namespace gp2::test
