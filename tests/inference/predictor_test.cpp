#include "gp2/predictor.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <thread>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "allocation_count.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/state_evaluator.hpp"
#include "inference/sampling.hpp"
#include "input_error.hpp"

// One state at a time must give what a posterior gives for many.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;
using test::largest;
using test::Problem;
using test::Quantity;
using testing::HasSubstr;
using Status = Predictor::Status;
using Storage = Predictor::Storage;

constexpr std::uint64_t predictor_seed = 50505;

const std::vector<Problem>& predictor_problems() {
  static const std::vector<Problem> all = test::problems(21, predictor_seed);
  return all;
}

// every view, with some rows and with one latent alone too, and those under other systems
std::vector<View> predicted_views_of(const Problem& p) {
  std::vector<View> views;
  const System& system = *p.prior.system;
  for (const Quantity quantity : Quantity::all()) {
    View view = View::all(quantity, system);
    if (view.size() == 0) continue;
    if (quantity->needs_time_step()) view.time_step = 0.1;
    views.push_back(view);
    View alone = view;
    alone.latent = static_cast<int>(p.prior.latents.size()) - 1;
    views.push_back(alone);
    view.rows = {view.rows.back(), 0};
    views.push_back(view);
  }
  for (const Observations& group : p.observations) {
    if (group.view().other_system) views.push_back(group.view());
  }
  return views;
}

std::string describe(const Problem& p, const View& view) {
  return fmt::format("{}, {} ({} rows, latent {}{}), seed {}", p.name, view.quantity->word(), view.size(),
                     view.latent.value_or(-1).first, view.other_system ? ", elsewhere" : "", predictor_seed);
}

MatrixXd known(const MatrixXd& states) { return states.array().isNaN().select(0, states); }

// one prediction of each kind
struct Prediction {
  VectorXd mean, stddev;
  MatrixXd covariance, jacobian;
  Status status;

  Prediction(const Predictor& predictor, const VectorXd& state, Predictor::Workspace& workspace)
      : mean(predictor.view().size()),
        stddev(mean.size()),
        covariance(mean.size(), mean.size()),
        jacobian(mean.size(), state.size()) {
    VectorXd again(mean.size());
    status = predictor.mean_and_jacobian(state, mean, jacobian, workspace);
    EXPECT_EQ(predictor.mean_and_covariance(state, again, covariance, workspace), status);
    EXPECT_EQ(predictor.mean_and_stddev(state, again, stddev, workspace), status);
    if (status == Status::ok) {
      EXPECT_EQ(again, mean);
    }
  }
};

// Noise 2e6 times below the signal, as a fit of models/duffing.toml finds it: a product with the inverse of the factor is off by 200 ε of
// the prior's variance, a fifth of a deviation.
TEST(PredictorTest, ADeviationFarBelowThePriorsIsThatOfThePosterior) {
  std::vector<Problem> problems = test::problems(60, predictor_seed);
  const auto found = std::ranges::find(problems, "duffing, every row", &Problem::name);
  ASSERT_NE(found, problems.end());
  Problem& p = *found;
  ASSERT_EQ(p.values.kernel[0].size(), 5);
  p.values.kernel[0].setConstant(1e6);
  p.values.kernel[0][1] = 7;
  p.values.signal_stddev[0] << 40, 2200;
  p.values.noise_stddev[0].setConstant(1e-3);
  const Posterior posterior(p.prior, p.observations, p.values);
  const View view = View::all(Quantity::constrained_acceleration, *p.prior.system);
  const Predictor predictor(posterior, view);
  Predictor::Workspace workspace = predictor.make_workspace();
  const MatrixXd& states = p.observations[0].states();
  const MatrixXd prior = posterior.without_data().marginal(view, states).stddev();
  for (Index i = 0; i < states.cols(); ++i) {
    const VectorXd expected = posterior.marginal(view, states.col(i)).stddev();
    const Prediction prediction(predictor, states.col(i), workspace);
    for (Index r = 0; r < view.size(); ++r) {
      EXPECT_LT(expected[r], 1e-5 * prior(r, i));
      EXPECT_NEAR(std::pow(prediction.stddev[r], 2), std::pow(expected[r], 2), 30 * eps * std::pow(prior(r, i), 2));
    }
  }
}

// Accelerations that the constraint decides tell nothing of the latents: there are states, but no rows.
TEST(PredictorTest, OfDataThatTellNothingIsThePrior) {
  const Model model = Model::parse(R"toml(
name        = "bead that is led"
coordinates = ["x"]
[mechanics]
mass  = [["2"]]
[constraints]
position = ["x - sin(t)"]
[[latent]]
kernel     = "se"
features   = ["x", "dx"]
directions = "force"
)toml",
                                   "bead that is led");
  RandomStream random(predictor_seed);
  const MatrixXd states = test::random_matrix(3, 50, random);
  const View ddq = View::constrained_acceleration(*model.system), a_bar = View::unconstrained_acceleration(*model.system);
  const std::vector<Observations> observations = {{states, ddq, MatrixXd::Zero(1, 50), VectorXd::Ones(1)}};
  const Posterior posterior(make_prior(model), observations, test::random_values(make_prior(model), observations, random));
  ASSERT_EQ(posterior.reduced_size(), 0);
  const Posterior::Marginal expected = posterior.without_data().marginal(a_bar, states);
  for (const Storage storage : {Storage::double_precision, Storage::single_precision}) {
    const Predictor predictor(posterior, a_bar, {.storage = storage});
    Predictor::Workspace workspace = predictor.make_workspace();
    VectorXd mean(1), stddev(1);
    for (Index i = 0; i < states.cols(); ++i) {
      ASSERT_EQ(predictor.mean_and_stddev(states.col(i), mean, stddev, workspace), Status::ok);
      EXPECT_EQ(mean[0], 0);
      EXPECT_NEAR(stddev[0], expected.stddev()(0, i), 1e-12 * stddev[0]);
    }
  }
}

TEST(PredictorTest, IsThePosteriorInEveryView) {
  for (const Problem& p : predictor_problems()) {
    const Posterior posterior(p.prior, p.observations, p.values);
    const MatrixXd states = known(p.queries);
    for (const Posterior& of : {posterior, posterior.without_data()}) {
      for (const View& view : predicted_views_of(p)) {
        SCOPED_TRACE(describe(p, view));
        const Predictor predictor(of, view);
        Predictor::Workspace workspace = predictor.make_workspace();
        for (Index i = 0; i < states.cols(); ++i) {
          const Posterior::Marginal expected = of.marginal(view, states.col(i));
          const Prediction prediction(predictor, states.col(i), workspace);
          ASSERT_EQ(prediction.status, Status::ok);
          EXPECT_LE(largest(prediction.mean - expected.mean), 1e4 * eps * (1 + largest(expected.mean)));
          // the variance is a difference of numbers of the size of the prior's
          const MatrixXd prior = posterior.without_data().marginal(view, states.col(i)).stddev();
          for (Index r = 0; r < view.size(); ++r) {
            EXPECT_NEAR(prediction.stddev[r] * prediction.stddev[r], expected.covariance(r * (view.size() + 1), 0),
                        1e4 * eps * (prior(r) * prior(r) + eps));
            for (int s = 0; s < view.size(); ++s) {
              EXPECT_NEAR(prediction.covariance(r, s), expected.covariance(r + s * view.size(), 0),
                          1e4 * eps * (largest(prior) * largest(prior) + eps));
            }
          }
        }
      }
    }
  }
}

TEST(PredictorTest, DifferentiatesExactly) {
  double size = 0;
  for (const Problem& p : predictor_problems()) {
    // off the constraint its rows contradict each other
    if (p.prior.system->name().find("redundant") != std::string::npos) continue;
    const Posterior posterior(p.prior, p.observations, p.values);
    for (const View& view : predicted_views_of(p)) {
      const Predictor predictor(posterior, view);
      Predictor::Workspace workspace = predictor.make_workspace();
      const bool is_zero = view.latent &&
                           p.prior.latents[static_cast<std::size_t>(view.latent->first)].base == Latent::Base::admissible &&
                           (view.quantity == Quantity::constraint_force || view.quantity == Quantity::multipliers);
      for (Index i = 0; i < 2; ++i) {
        SCOPED_TRACE(fmt::format("{}, state {}", describe(p, view), i));
        // off the constraint too
        RandomStream random(predictor_seed, static_cast<std::uint64_t>(i));
        VectorXd state = known(p.queries.col(i)) + 0.02 * test::random_vector(p.queries.rows(), random);
        const Prediction prediction(predictor, state, workspace);
        ASSERT_EQ(prediction.status, Status::ok);
        // the mean of a latent alone may be small beside the terms of its sum, which are of size one as the data are
        const double rounding = 1e3 * eps + 64 * eps / std::max(largest(prediction.mean), eps);
        for (Index k = 0; k < state.size(); ++k) {
          const auto mean_at = [&](double x) {
            VectorXd moved = state, mean(view.size());
            moved[k] = x;
            EXPECT_EQ(predictor.mean(moved, mean, workspace), Status::ok);
            return mean;
          };
          // What the constraint admits needs no force of it: rounding, and more of it in the multipliers of a row that nearly vanishes.
          if (is_zero) {
            EXPECT_LE(largest(prediction.jacobian.col(k)), 1e6 * eps);
            EXPECT_LE(largest(mean_at(state[k])), 1e6 * eps);
            continue;
          }
          EXPECT_TRUE(matches(prediction.jacobian.col(k), test::central_difference(mean_at, state[k], 0.02, rounding)))
              << "entry " << k << " of the state";
        }
        size = std::max(size, largest(prediction.jacobian));
      }
    }
  }
  EXPECT_GT(size, 1);
}

TEST(PredictorTest, ObeysTheConstraintAndItsDerivativeInBothPrecisions) {
  for (const Problem& p : predictor_problems()) {
    const System& system = *p.prior.system;
    if (system.nc() == 0 || system.name().find("redundant") != std::string::npos) continue;
    SCOPED_TRACE(p.name);
    const Posterior posterior(p.prior, p.observations, p.values);
    const auto at = system.make_evaluator(p.values.parameters, true);
    for (const Storage storage : {Storage::double_precision, Storage::single_precision}) {
      const Predictor predictor(posterior, View::all(Quantity::constrained_acceleration, system), {.storage = storage});
      Predictor::Workspace workspace = predictor.make_workspace();
      const MatrixXd states = known(p.queries);
      for (const VectorXd state : states.colwise()) {
        const Prediction prediction(predictor, state, workspace);
        at->evaluate(state);
        const double scale = 1 + largest(at->A());
        EXPECT_LE(largest(at->A() * prediction.mean - at->b()), 100 * eps * scale * (1 + largest(prediction.mean)));
        // dA ddq + A dddq = db
        MatrixXd residual = at->A() * prediction.jacobian;
        MatrixXd sizes = at->A().cwiseAbs() * prediction.jacobian.cwiseAbs();
        for (std::size_t e = 0; e < at->derivatives().size(); ++e) {
          const auto [quantity, i, j, k] = at->derivatives()[e];
          const bool is_of_A = quantity == StateEvaluator::Quantity::constraint_matrix;
          if (!is_of_A && quantity != StateEvaluator::Quantity::constraint_vector) continue;
          const double added = at->derivative_values()[static_cast<Index>(e)] * (is_of_A ? prediction.mean[j] : -1);
          residual(i, k) += added;
          sizes(i, k) += std::abs(added);
        }
        // a row that vanishes at this state demands nothing of the motion, and its derivative nothing either
        for (Index row = 0; row < residual.rows(); ++row) {
          if (at->A().row(row).isZero(0)) continue;
          EXPECT_LE(largest(residual.row(row)), 1e3 * eps * (1 + largest(prediction.jacobian) + largest(sizes)) * scale);
        }
      }
    }
  }
}

// one row that says the same as another everywhere
TEST(PredictorTest, DifferentiatesUnderRedundantRows) {
  const auto predict = [](const std::string& constraints, Quantity quantity) {
    const Model model = Model::parse(fmt::format(R"toml(
name        = "two in a groove"
coordinates = ["x", "y"]
[mechanics]
mass  = [["2 + sin(y)", "0.3*x"], ["0.3*x", "1"]]
force = ["-x*dx", "y"]
[constraints]
acceleration = [{}]
[[latent]]
kernel     = "se"
features   = ["x", "dy"]
directions = "force"
)toml",
                                                 constraints),
                                     "two in a groove");
    RandomStream random(predictor_seed);
    const MatrixXd states = test::random_matrix(5, 12, random), values = test::random_matrix(2, 12, random);
    const View a_bar = View::all(Quantity::unconstrained_acceleration, *model.system);
    const VectorXd noise = VectorXd::Constant(2, 0.3);
    const Posterior posterior(make_prior(model, {Prior::Mean::force, std::nullopt, false}),
                              {{states, a_bar, values, noise, false}},
                              {{VectorXd::Ones(2)}, {VectorXd::Ones(2)}, {}, {noise}, VectorXd()});
    const Predictor predictor(posterior, View::all(quantity, *model.system));
    Predictor::Workspace workspace = predictor.make_workspace();
    return Prediction(predictor, test::random_vector(5, random), workspace);
  };
  const std::string row = "\"ddx*cos(y) + x*ddy - dx*dy\"";
  const std::string rows = row + ", \"3*(ddx*cos(y) + x*ddy - dx*dy)\"";
  for (const Quantity quantity : {Quantity::constrained_acceleration, Quantity::constraint_force, Quantity::multipliers}) {
    SCOPED_TRACE(quantity->word());
    const Prediction once = predict(row, quantity), twice = predict(rows, quantity);
    ASSERT_EQ(once.status, Status::ok);
    ASSERT_EQ(twice.status, Status::ok);
    // Aᵀλ = a λ₁ = a (λ₁ + 3 λ₂) with λ₁² + λ₂² least
    MatrixXd of_once = MatrixXd::Identity(2, 2);
    if (quantity == Quantity::multipliers) of_once = Eigen::Vector2d(0.1, 0.3);
    EXPECT_LE(largest(twice.mean - of_once * once.mean), 1e3 * eps * (1 + largest(once.mean)));
    EXPECT_LE(largest(twice.stddev - of_once * once.stddev), 1e3 * eps * (1 + largest(once.stddev)));
    EXPECT_LE(largest(twice.jacobian - of_once * once.jacobian), 1e3 * eps * (1 + largest(once.jacobian)));
  }
}

// States off the constraints, as measured ones are, where only a row that comes and goes is independent of the first
TEST(PredictorTest, RedundantRowsAreNoneBesideAConditionalOne) {
  const auto model_of = [](const std::string& redundant) {
    return Model::parse(fmt::format(R"toml(
name        = "carts"
coordinates = ["x", "y", "z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1", "0", "0"], ["0", "2", "0"], ["0", "0", "1"]]
force = ["-x", "1", "-9.81"]
[constraints]
position = ["x - y"{}, {{ expr = "z - 0.1*x", contact = "touch" }}]
[[latent]]
kernel     = "se"
features   = ["dx", "dz"]
directions = "acceleration"
)toml",
                                    redundant),
                        "carts");
  };
  const Model once = model_of(""), twice = model_of(", \"sin(x) - sin(y)\"");
  RandomStream random(predictor_seed);
  MatrixXd states(8, 12);  // x y z dx dy dz t touch
  for (double& entry : states.reshaped()) entry = 2 * random.uniform() - 1;
  states.row(1) = states.row(0);
  states.row(4) = states.row(3);
  for (Index i = 0; i < states.cols(); ++i) {
    states(7, i) = static_cast<double>(i % 2);
    if (i % 2 == 0) continue;
    states(2, i) = 0.1 * states(0, i);
    states(5, i) = 0.1 * states(3, i);
  }
  const auto learn = [&](const Model& model) {
    const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt, false, Discrepancy{{}, VectorXd::Constant(3, 0.3)}});
    RandomStream same(predictor_seed);
    const std::vector<Observations> observations = {
        test::observe(model, View::constrained_acceleration(*model.system), states, same)};
    return Posterior(prior, observations, test::random_values(prior, observations, same));
  };
  const Posterior of_once = learn(once), of_twice = learn(twice);
  for (const Quantity quantity : {Quantity::constrained_acceleration, Quantity::constraint_force}) {
    const View view = View::all(quantity, *once.system);
    const Predictor predictor(of_once, view), other(of_twice, view);
    Predictor::Workspace workspace = predictor.make_workspace(), workspace_of_other = other.make_workspace();
    double largest_stddev = 0;
    for (const double error : {1e-6, 1e-5, 1e-4}) {
      SCOPED_TRACE(fmt::format("{}, states off by {}, seed {}", quantity->word(), error, predictor_seed));
      MatrixXd measured = states;
      for (double& entry : measured.topRows(6).reshaped()) entry += error * (2 * random.uniform() - 1);
      for (Index i = 0; i < measured.cols(); ++i) {
        const VectorXd state = measured.col(i);
        const Prediction expected(predictor, state, workspace), got(other, state, workspace_of_other);
        ASSERT_EQ(expected.status, Status::ok);
        ASSERT_EQ(got.status, Status::ok);
        EXPECT_LE(largest(got.mean - expected.mean), 100 * error * (1 + largest(expected.mean)));
        EXPECT_LE(largest(got.stddev - expected.stddev), 100 * error * (1 + largest(expected.stddev)));
        EXPECT_LE(largest(of_twice.mean(view, state) - got.mean), 1e-9 * (1 + largest(got.mean)));
        largest_stddev = std::max(largest_stddev, largest(got.stddev));
      }
    }
    EXPECT_GT(largest_stddev, 0.1);
  }
}

// Rows whose proportion changes with the state: multipliers of minimum norm have a derivative there too
TEST(PredictorTest, DifferentiatesMultipliersOfRedundantRows) {
  const Model model = Model::parse(R"toml(
name        = "two in a groove, said differently"
coordinates = ["x", "y"]
[mechanics]
mass  = [["2 + sin(y)", "0.3*x"], ["0.3*x", "1"]]
force = ["-x*dx", "y"]
[constraints]
acceleration = ["ddx*cos(y) + x*ddy - dx*dy", "(2 + sin(x))*(ddx*cos(y) + x*ddy - dx*dy)", "ddx*cos(y) + x*ddy - dx*dy"]
[[latent]]
kernel     = "se"
features   = ["x", "dy"]
directions = "force"
)toml",
                                   "two in a groove");
  RandomStream random(predictor_seed);
  const MatrixXd states = test::random_matrix(5, 12, random), values = test::random_matrix(2, 12, random);
  const VectorXd noise = VectorXd::Constant(2, 0.3);
  const Posterior posterior(make_prior(model, {Prior::Mean::force, std::nullopt, false}),
                            {{states, View::unconstrained_acceleration(*model.system), values, noise, false}},
                            {{VectorXd::Ones(2)}, {VectorXd::Ones(2)}, {}, {noise}, VectorXd()});
  const Predictor predictor(posterior, View::multipliers(*model.system));
  Predictor::Workspace workspace = predictor.make_workspace();
  const VectorXd state = test::random_vector(5, random);
  const Prediction prediction(predictor, state, workspace);
  ASSERT_EQ(prediction.status, Status::ok);
  for (Index k = 0; k < state.size(); ++k) {
    const auto mean_at = [&](double x) {
      VectorXd moved = state, mean(3);
      moved[k] = x;
      EXPECT_EQ(predictor.mean(moved, mean, workspace), Status::ok);
      return mean;
    };
    EXPECT_TRUE(matches(prediction.jacobian.col(k), test::central_difference(mean_at, state[k], 0.02, 1e3 * eps)))
        << "entry " << k << " of the state";
  }
  EXPECT_GT(largest(prediction.jacobian), 0.1);
}

TEST(PredictorTest, AllocatesNothing) {
  for (const Problem& p : predictor_problems()) {
    const Posterior posterior(p.prior, p.observations, p.values);
    for (const View& view : predicted_views_of(p)) {
      for (const Storage storage : {Storage::double_precision, Storage::single_precision}) {
        SCOPED_TRACE(describe(p, view));
        const Predictor predictor(posterior, view, {.storage = storage});
        Predictor::Workspace workspace = predictor.make_workspace();
        const MatrixXd states = known(p.queries);
        VectorXd mean(view.size()), stddev(view.size());
        MatrixXd covariance(view.size(), view.size()), jacobian(view.size(), states.rows());
        int n_good = 0;
        const std::size_t n_allocations = test::allocations_of([&] {
          for (Index i = 0; i < states.cols(); ++i) {
            n_good += predictor.mean_and_jacobian(states.col(i), mean, jacobian, workspace) == Status::ok ? 1 : 0;
            n_good += predictor.mean_and_stddev(states.col(i), mean, stddev, workspace) == Status::ok ? 1 : 0;
            n_good += predictor.mean_and_covariance(states.col(i), mean, covariance, workspace) == Status::ok ? 1 : 0;
            n_good += predictor.mean(states.col(i), mean, workspace) == Status::ok ? 1 : 0;
          }
        });
        EXPECT_EQ(n_allocations, 0U);
        EXPECT_EQ(n_good, 4 * states.cols());
      }
    }
  }
}

TEST(PredictorTest, GivesTheSameBitsOnSeveralThreadsAndOutlivesItsPosterior) {
  const Problem& p = predictor_problems().front();
  const View view = View::all(Quantity::constrained_acceleration, *p.prior.system);
  std::optional<Posterior> posterior(Posterior(p.prior, p.observations, p.values));
  const Predictor predictor(*posterior, view);
  const MatrixXd expected = posterior->mean(view, p.observations[0].states());
  posterior.reset();
  constexpr int n_threads = 4;
  std::vector<MatrixXd> results(n_threads);
  std::vector<std::thread> threads;
  for (MatrixXd& result : results) {
    threads.emplace_back([&predictor, &result, &states = p.observations[0].states()] {
      Predictor::Workspace workspace = Predictor(predictor).make_workspace();
      for (int repeat = 0; repeat < 20; ++repeat) {
        result.resize(0, 0);
        for (const VectorXd state : states.colwise()) {
          const Prediction prediction(predictor, state, workspace);
          result.conservativeResize(predictor.view().size(), result.cols() + 2 + state.size());
          result.rightCols(2 + state.size()) << prediction.mean, prediction.stddev, prediction.jacobian;
        }
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  for (const MatrixXd& result : results) EXPECT_EQ(result, results.front());
  const Index stride = 2 + p.queries.rows();
  for (Index i = 0; i < expected.cols(); ++i) {
    EXPECT_LE(largest(results.front().col(i * stride) - expected.col(i)), 1e4 * eps * (1 + largest(expected)));
  }
}

TEST(PredictorTest, InSinglePrecisionIsOffByNoMoreThanItSays) {
  std::optional<Problem> found;
  for (const Problem& p : test::problems(61, predictor_seed)) {
    if (p.name == "surface, every row") found = p;
  }
  ASSERT_TRUE(found);
  const Problem& p = *found;
  const Posterior posterior(p.prior, p.observations, p.values);
  const View view = View::all(Quantity::unconstrained_acceleration, *p.prior.system);
  const Predictor exact(posterior, view), rounded(posterior, view, {.storage = Storage::single_precision});
  Predictor::Workspace of_exact = exact.make_workspace(), of_rounded = rounded.make_workspace();

  // β of f_1 … f_3 from the textbook
  const test::DenseObservations dense = test::dense_observations(p);
  const test::ExtendedVector alpha = Eigen::LLT<test::Extended>(dense.covariance).solve(dense.residual);
  const VectorXd lengthscale = p.values.kernel[0];
  const MatrixXd points = dense.views[0].features[0] * lengthscale.cwiseInverse().asDiagonal();
  const Eigen::RowVectorXd centre = points.colwise().mean();
  const double N = static_cast<double>(points.rows()), D = static_cast<double>(points.cols());
  const double e = std::numeric_limits<float>::epsilon() / 2;
  const Posterior prior = posterior.without_data();
  for (const VectorXd state : p.queries.colwise()) {
    const Eigen::RowVectorXd point = evaluate_features(p.prior, 0, state) * lengthscale.cwiseInverse().asDiagonal();
    double R = (point - centre).norm();
    for (Index j = 0; j < points.rows(); ++j) R = std::max(R, (points.row(j) - centre).norm());
    VectorXd bound = VectorXd::Zero(3);
    for (Index j = 0; j < points.rows(); ++j) {
      const double r2 = (points.row(j) - point).squaredNorm();
      const VectorXd beta =
          (dense.views[0].loading[static_cast<std::size_t>(j)][0].transpose() * alpha.segment(3 * j, 3)).cast<double>();
      bound += e * std::exp(-r2 / 2) * beta.cwiseAbs() * (N / 8 + 16 + r2 * (D + 4) + 4 * std::sqrt(r2) * R);
    }
    bound = bound.cwiseProduct(p.values.signal_stddev[0]);
    const Prediction in_double(exact, state, of_exact), in_single(rounded, state, of_rounded);
    const MatrixXd prior_stddev = prior.marginal(view, state).stddev();
    for (Index r = 0; r < 3; ++r) {
      EXPECT_NEAR(in_single.mean[r], in_double.mean[r], bound[r]);
      EXPECT_LE(bound[r], 1e-4 * prior_stddev(r));
      const double off = in_single.stddev[r] * in_single.stddev[r] - in_double.stddev[r] * in_double.stddev[r];
      EXPECT_LE(std::abs(off), std::sqrt(3 * N) * 4 * e * prior_stddev(r) * prior_stddev(r));
      EXPECT_LE(largest(in_single.jacobian.row(r) - in_double.jacobian.row(r)), 1e-4 * (1 + largest(in_double.jacobian)));
    }
    EXPECT_NE(in_single.mean, in_double.mean);
  }
}

TEST(PredictorTest, InSinglePrecisionIsThePosteriorUnderEveryKernel) {
  for (const Problem& p : predictor_problems()) {
    const Posterior posterior(p.prior, p.observations, p.values);
    const View view = View::all(Quantity::unconstrained_acceleration, *p.prior.system);
    SCOPED_TRACE(p.name);
    const Predictor exact(posterior, view), rounded(posterior, view, {.storage = Storage::single_precision});
    Predictor::Workspace of_exact = exact.make_workspace(), of_rounded = rounded.make_workspace();
    const MatrixXd states = known(p.queries);
    for (const VectorXd state : states.colwise()) {
      const Prediction in_double(exact, state, of_exact), in_single(rounded, state, of_rounded);
      EXPECT_LE(largest(in_single.mean - in_double.mean), 1e-4 * (1 + largest(in_double.mean) + largest(in_double.stddev)));
      EXPECT_LE(largest(in_single.stddev - in_double.stddev), 1e-3 * (1 + largest(in_double.stddev)));
      EXPECT_LE(largest(in_single.jacobian - in_double.jacobian), 1e-4 * (1 + largest(in_double.jacobian)));
    }
  }
}

Posterior prior_of_one_point(const std::string& mass, const std::string& constraints, bool with_discrepancy = false) {
  const Model model = Model::parse(fmt::format(R"toml(
name        = "a point"
coordinates = ["x", "y"]
[mechanics]
mass  = [["{}", "0"], ["0", "1"]]
force = ["0", "0"]
[constraints]
acceleration = [{}]
[[latent]]
kernel     = "se"
features   = ["x"]
directions = "acceleration"
)toml",
                                               mass, constraints),
                                   "a point");
  if (!with_discrepancy) return {make_prior(model), {}, {{VectorXd::Ones(1)}, {VectorXd::Ones(2)}, {}, {}, VectorXd()}};
  const VectorXd one = VectorXd::Ones(1);
  PriorOptions options;
  options.discrepancy = Discrepancy{one, VectorXd::Ones(2), Latent::Base::admissible, one, one};
  return {make_prior(model, options), {}, {{one, VectorXd::Ones(2)}, {VectorXd::Ones(2), VectorXd::Ones(2)}, {}, {}, VectorXd()}};
}

TEST(PredictorTest, TellsWhatIsWrongWithAStateAndGoesOn) {
  const auto expect = [](const Posterior& posterior, const VectorXd& bad, Status status) {
    const Predictor predictor(posterior);
    Predictor::Workspace workspace = predictor.make_workspace();
    VectorXd mean(2), stddev(2);
    MatrixXd covariance(2, 2), jacobian(2, 5);
    const VectorXd good = VectorXd::Ones(5);
    EXPECT_EQ(predictor.mean(good, mean, workspace), Status::ok);
    const VectorXd before = mean;
    const std::size_t n_allocations = test::allocations_of([&] {
      EXPECT_EQ(predictor.mean(bad, mean, workspace), status);
      EXPECT_TRUE(mean.array().isNaN().all());
      mean.setZero();
      EXPECT_EQ(predictor.mean_and_stddev(bad, mean, stddev, workspace), status);
      EXPECT_EQ(predictor.mean_and_covariance(bad, mean, covariance, workspace), status);
      EXPECT_TRUE(mean.array().isNaN().all() && stddev.array().isNaN().all() && covariance.array().isNaN().all());
      mean.setZero();
      EXPECT_EQ(predictor.mean_and_jacobian(bad, mean, jacobian, workspace), status);
      EXPECT_TRUE(mean.array().isNaN().all() && jacobian.array().isNaN().all());
    });
    EXPECT_EQ(n_allocations, 0U);
    EXPECT_EQ(predictor.mean(good, mean, workspace), Status::ok);
    EXPECT_EQ(mean, before);
  };
  const VectorXd zero = VectorXd::Zero(5);
  VectorXd unknown = VectorXd::Ones(5);
  unknown[0] = std::numeric_limits<double>::quiet_NaN();
  expect(prior_of_one_point("x", "\"ddx - y\""), -VectorXd::Ones(5), Status::mass_not_positive_definite);
  expect(prior_of_one_point("x", "\"ddx - y\""), zero, Status::no_unconstrained_acceleration);
  expect(prior_of_one_point("1", "\"ddx - x\", \"ddx - 1\""), zero, Status::contradicting_constraints);
  expect(prior_of_one_point("x", "\"ddx - y\""), unknown, Status::not_finite);
  expect(prior_of_one_point("1", "\"ddy - x\"", /*with_discrepancy=*/true), unknown, Status::not_finite);
  expect(prior_of_one_point("1", "\"ddx - 1/x\""), zero, Status::not_finite);
  expect(prior_of_one_point("1", "\"ddy - y\""), unknown, Status::not_finite);

  // the mean is known where its derivative is not
  const Predictor predictor(prior_of_one_point("1", "\"ddx - y^0.5\""));
  Predictor::Workspace workspace = predictor.make_workspace();
  VectorXd mean(2);
  MatrixXd jacobian(2, 5);
  EXPECT_EQ(predictor.mean(zero, mean, workspace), Status::ok);
  EXPECT_EQ(predictor.mean_and_jacobian(zero, mean, jacobian, workspace), Status::not_finite);
  EXPECT_TRUE(mean.array().isNaN().all() && jacobian.array().isNaN().all());
}

TEST(PredictorTest, NamesWhatIsWrongWithAnArgument) {
  const Posterior posterior = test::surface_posterior(predictor_seed);
  const System& system = *posterior.prior().system;
  EXPECT_EQ(test::input_error_of([&] { Predictor(posterior, View::all(Quantity::next_velocity, system)); }),
            "view 'next-velocity' needs a time step");
  EXPECT_THAT(test::input_error_of([&] { Predictor(posterior, {.rows = {3}}); }), HasSubstr("there are the rows 0 … 2, got 3"));
  EXPECT_THAT(test::input_error_of([&] { Predictor(posterior, {.rows = {0}, .latent = 1}); }),
              HasSubstr("1 latents, numbered from 0"));
  const Predictor bare(posterior, View::all(Quantity::constrained_acceleration, system), {.stddev = false, .jacobian = false});
  const Predictor other(posterior);
  Predictor::Workspace workspace = bare.make_workspace();
  VectorXd state = VectorXd::Zero(system.layout().size()), mean(3), stddev(3), two(2), short_state(2);
  MatrixXd jacobian(3, state.size()), narrow(3, 2), low(2, state.size());
  const auto ignore = [](Status) {};
  EXPECT_THAT(test::input_error_of([&] { ignore(bare.mean_and_stddev(state, mean, stddev, workspace)); }),
              HasSubstr("made without standard deviations"));
  EXPECT_THAT(test::input_error_of([&] { ignore(bare.mean_and_jacobian(state, mean, jacobian, workspace)); }),
              HasSubstr("made without its Jacobian"));
  EXPECT_THAT(test::input_error_of([&] { ignore(other.mean(state, mean, workspace)); }),
              HasSubstr("the workspace is of another predictor"));
  EXPECT_THAT(test::input_error_of([&] { ignore(bare.mean(short_state, mean, workspace)); }),
              HasSubstr("a state is of size 10, got 2"));
  EXPECT_THAT(test::input_error_of([&] { ignore(bare.mean(state, two, workspace)); }), HasSubstr("the mean is of size 3, got 2"));
  Predictor::Workspace full = other.make_workspace();
  EXPECT_THAT(test::input_error_of([&] { ignore(other.mean_and_stddev(state, mean, two, full)); }),
              HasSubstr("the standard deviation is of size 3, got 2"));
  MatrixXd low_square(2, 3), narrow_square(3, 2);
  EXPECT_THAT(test::input_error_of([&] { ignore(other.mean_and_covariance(state, mean, low_square, full)); }),
              HasSubstr("a column of the covariance is of size 3, got 2"));
  EXPECT_THAT(test::input_error_of([&] { ignore(other.mean_and_covariance(state, mean, narrow_square, full)); }),
              HasSubstr("a row of the covariance is of size 3, got 2"));
  EXPECT_THAT(test::input_error_of([&] { ignore(other.mean_and_jacobian(state, mean, low, full)); }),
              HasSubstr("a column of the Jacobian is of size 3, got 2"));
  EXPECT_THAT(test::input_error_of([&] { ignore(other.mean_and_jacobian(state, mean, narrow, full)); }),
              HasSubstr("a row of the Jacobian is of size 10, got 2"));
  workspace = std::move(full);
  EXPECT_EQ(other.mean(state, mean, workspace), Status::ok);
  EXPECT_TRUE(other.options().stddev);
}

}  // namespace
}  // namespace gp2
