#include "gp2/inference/online_predictor.hpp"

#include <atomic>
#include <thread>

#include <gtest/gtest.h>

#include "allocation_count.hpp"
#include "gp2/error.hpp"
#include "inference/problems.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::largest;
using test::Problem;

constexpr std::uint64_t online_seed = 70191;

Observations part_of(const Problem& p, std::size_t group, const std::vector<Index>& columns) {
  const Observations& all = p.observations[group];
  return {all.states()(Eigen::all, columns), all.view(), all.values()(Eigen::all, columns), p.values.noise_stddev[group], false};
}

// What the loop sees and what a predictor made anew says, at some states. Of variances the prior's size counts; deviations near 0
// are roots of rounding.
void expect_made_anew(OnlinePredictor& online, const MatrixXd& states, double tolerance) {
  const Posterior& grown = online.posterior();
  const Posterior anew(grown.prior(), grown.observations(), grown.values());
  const auto [predictor, workspace] = online.latest();
  const Predictor expected(anew, predictor.view(), predictor.options()), before(anew.without_data(), predictor.view());
  Predictor::Workspace of_expected = expected.make_workspace(), of_before = before.make_workspace();
  const Index d = predictor.view().size();
  VectorXd mean(d), stddev(d), mean_anew(d), stddev_anew(d), prior(d);
  MatrixXd jacobian(d, states.rows()), jacobian_anew(d, states.rows());
  for (const VectorXd state : states.colwise()) {
    ASSERT_EQ(predictor.mean_and_jacobian(state, mean, jacobian, workspace), Predictor::Status::ok);
    ASSERT_EQ(expected.mean_and_jacobian(state, mean_anew, jacobian_anew, of_expected), Predictor::Status::ok);
    EXPECT_LE(largest(mean - mean_anew), tolerance * (1 + largest(mean_anew)));
    EXPECT_LE(largest(jacobian - jacobian_anew), tolerance * (1 + largest(jacobian_anew)));
    ASSERT_EQ(predictor.mean_and_stddev(state, mean, stddev, workspace), Predictor::Status::ok);
    ASSERT_EQ(expected.mean_and_stddev(state, mean_anew, stddev_anew, of_expected), Predictor::Status::ok);
    ASSERT_EQ(before.mean_and_stddev(state, mean, prior, of_before), Predictor::Status::ok);
    EXPECT_LE(largest(stddev.cwiseAbs2() - stddev_anew.cwiseAbs2()), tolerance * (1e-12 + largest(prior.cwiseAbs2())));
    const double distance = expected.distance_from_data(state, of_expected);
    const double of_online = predictor.distance_from_data(state, workspace);
    EXPECT_TRUE(of_online == distance || std::abs(of_online - distance) <= 1e-9 * (1 + distance)) << of_online << ' ' << distance;
  }
}

TEST(OnlinePredictorTest, IsThePredictorMadeAnewAfterEveryUpdateAndRemoval) {
  std::uint64_t stream = 0;
  for (const Problem& p : test::problems(12, online_seed)) {
    for (const auto storage : {Predictor::Storage::double_precision, Predictor::Storage::single_precision}) {
      SCOPED_TRACE(fmt::format("{}, storage {}, seed {}", p.name, static_cast<int>(storage), online_seed));
      RandomStream random(online_seed, ++stream);
      const auto below = [&](Index n) { return static_cast<Index>(random.uniform() * static_cast<double>(n)); };
      const MatrixXd states = p.queries.array().isNaN().select(0, p.queries).leftCols(2);
      Predictor::Options options;
      options.storage = storage;
      OnlinePredictor online(Posterior(p.prior, p.observations, p.values), View::constrained_acceleration(*p.prior.system),
                             options);
      for (int step = 0; step < 8; ++step) {
        if (step % 3 != 2) {
          const auto group = static_cast<std::size_t>(below(std::ssize(p.observations)));
          std::vector<Index> columns;
          for (Index k = below(3); k >= 0; --k) columns.push_back(below(p.observations[group].n_data()));
          online.update(part_of(p, group, columns));
        } else {
          online.remove_oldest(static_cast<int>(below(4)));
        }
        online.publish();
        // a single state more tells floats apart by their sums alone
        expect_made_anew(online, states, storage == Predictor::Storage::double_precision ? 1e-10 : 1e-2);
      }
    }
  }
}

TEST(OnlinePredictorTest, WhatIsRefusedLeavesItAsItWas) {
  const Problem p = test::problems(9, online_seed).front();
  const View view = View::constrained_acceleration(*p.prior.system);
  EXPECT_THROW(OnlinePredictor(Posterior(p.prior, p.observations, p.values), {.rows = {99}}), InputError);
  OnlinePredictor online(Posterior(p.prior, p.observations, p.values), view);
  const int size = online.posterior().reduced_size();
  EXPECT_THROW(online.remove_oldest(1000), InputError);
  EXPECT_THROW(online.update(test::with_states(p.observations[0], p.observations[0].states().topRows(2))), InputError);
  EXPECT_EQ(online.posterior().reduced_size(), size);
  online.replace(Posterior(p.prior, {part_of(p, 0, {0, 1})}, p.values));
  online.publish();
  EXPECT_LT(online.posterior().reduced_size(), size);
  expect_made_anew(online, p.queries.array().isNaN().select(0, p.queries).leftCols(1), 1e-10);
}

// Every prediction that a loop gets is one that was published, to the bit, and never an older one than before. Neither memory nor a
// lock is asked for by the loop: what would race shows under the thread sanitizer.
TEST(OnlinePredictorTest, ALoopAndALearnerShareItWithoutLocksOrMemory) {
  const Problem p = test::problems(20, online_seed).front();
  const VectorXd state = p.queries.col(0).array().isNaN().select(0, p.queries.col(0));
  const View view = View::constrained_acceleration(*p.prior.system);
  constexpr int n_published = 60;
  const Index d = view.size();
  MatrixXd published(2 * d, n_published), seen(2 * d, n_published);
  OnlinePredictor online(Posterior(p.prior, p.observations, p.values), view);
  const auto write_prediction = [&](const Predictor& predictor, Predictor::Workspace& workspace, Eigen::Ref<VectorXd> to) {
    return predictor.mean_and_stddev(state, to.head(d), to.tail(d), workspace);
  };
  const auto record = [&](int k) {
    const Predictor predictor(online.posterior(), view);
    Predictor::Workspace workspace = predictor.make_workspace();
    EXPECT_EQ(write_prediction(predictor, workspace, published.col(k)), Predictor::Status::ok);
  };
  record(0);

  std::atomic<bool> is_done = false;
  Index n_seen = 0;  // predictions that were not the one before
  std::size_t n_allocated = 1, n_freed = 1;
  std::thread loop([&] {
    VectorXd now(2 * d);
    const std::size_t allocated = test::n_allocations(), freed = test::n_releases();
    for (bool is_last = false; !is_last;) {
      is_last = is_done;
      const auto [predictor, workspace] = online.latest();
      static_cast<void>(write_prediction(predictor, workspace, now));
      if (n_seen == n_published || (n_seen > 0 && now == seen.col(n_seen - 1))) continue;
      seen.col(n_seen++) = now;
    }
    n_allocated = test::n_allocations() - allocated;
    n_freed = test::n_releases() - freed;
  });
  for (int k = 1; k < n_published; ++k) {
    online.update(part_of(p, 0, {k % p.observations[0].n_data()}));
    if (k % 2 == 0) online.remove_oldest(1);
    record(k);
    online.publish();
  }
  is_done = true;
  loop.join();

  EXPECT_EQ(n_allocated, 0U);
  EXPECT_EQ(n_freed, 0U);
  int k = 0;
  for (Index i = 0; i < n_seen; ++i) {
    while (k < n_published && seen.col(i) != published.col(k)) ++k;
    ASSERT_LT(k, n_published) << "was not published, or is older than what was seen before";
  }
  EXPECT_EQ(k, n_published - 1);
}

}  // namespace
}  // namespace gp2
