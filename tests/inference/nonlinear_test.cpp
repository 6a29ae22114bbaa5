#include <cmath>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "allocation_count.hpp"
#include "base/not_a_number.hpp"
#include "gp2/fit.hpp"
#include "gp2/inference/inducing.hpp"
#include "gp2/inference/inverse_dynamics.hpp"
#include "gp2/inference/leave_one_out.hpp"
#include "gp2/inference/pathwise.hpp"
#include "gp2/jobs/check_job.hpp"
#include "gp2/predictor.hpp"
#include "gp2/simulation/generate.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "inference/nonlinear_motion.hpp"
#include "inference/posterior_implementation.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"
#include "training/objective.hpp"

// Latents that act through the multipliers that they change, or by their exponential.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr std::uint64_t nonlinear_seed = 52117;

void expect_says(const std::function<void()>& work, const std::vector<std::string>& words) {
  const std::string error = test::input_error_of(work);
  for (const std::string& word : words) EXPECT_THAT(error, testing::HasSubstr(word));
}

/// A bead of unequal inertias on a wire z = h x², with friction μ |λ| |A| along it: friction presses on the wire.
Model rubbing_bead(const std::string& lambda, const std::string& kernel = "constant", const std::string& more = "") {
  return Model::parse(fmt::format(R"toml(
name        = "rubbing bead"
coordinates = ["x", "z"]
inputs      = ["push"]
[parameters]
m = 0.2
h = 0.5
[let]
v    = "sqrt(dx^2 + dz^2 + 1e-6)"
load = "abs({0}(1))*sqrt(1 + 4*h^2*x^2)"
mu   = "0.3"
[mechanics]
mass  = [["m", "0"], ["0", "m + 0.3"]]
force = ["push", "-9.81*m"]
[constraints]
position = ["z - h*x^2"]
[[latent]]
name       = "friction coefficient"
kernel     = "{1}"
features   = ["v"]
directions = {{ force = [["-load*dx/v"], ["-load*dz/v"]] }}
{2}
[sampling]
x    = [-0.8, 0.8]
dx   = [-1.5, 1.5]
push = [-1, 1]
[truth]
force = ["-mu*load*dx/v", "-mu*load*dz/v"]
)toml",
                                  lambda, kernel, more),
                      "bead");
}

TEST(Multipliers, OfATruthThatReadsThemAreThoseOfOneSlidingContact) {
  const Model model = rubbing_bead("lambda"), known = rubbing_bead("lambda0");
  const MatrixXd states = test::draw(model, 200, nonlinear_seed).states;
  const ModelMotion motion(model);
  const MatrixXd lambda = motion.multipliers(states), ddq = motion.acceleration(states);
  double largest_kappa = 0;
  for (Index i = 0; i < states.cols(); ++i) {
    // λ = λ₀/(1 − σκμ), κ = (A M⁻¹Aᵀ)⁻¹A M⁻¹S
    const double m = 0.2, x = states(0, i), dx = states(2, i), dz = states(3, i), v = std::sqrt(dx * dx + dz * dz + 1e-6);
    const VectorXd M = (VectorXd(2) << m, m + 0.3).finished(), A = (VectorXd(2) << -x, 1).finished(),
                   F = (VectorXd(2) << states(states.rows() - 1, i), -9.81 * m).finished(),
                   S = std::sqrt(1 + x * x) / v * (VectorXd(2) << dx, dz).finished();
    const double inertia = 1 / A.dot(A.cwiseQuotient(M)), lambda0 = inertia * (dx * dx - A.dot(F.cwiseQuotient(M))),
                 kappa = inertia * A.dot(S.cwiseQuotient(M)), sigma = lambda0 > 0 ? 1 : -1;
    EXPECT_NEAR(lambda(0, i), lambda0 / (1 - sigma * kappa * 0.3), 1e-12 * (1 + std::abs(lambda0)));
    largest_kappa = std::max(largest_kappa, std::abs(kappa));
    const VectorXd force = F - 0.3 * std::abs(lambda(0, i)) * S + A * lambda(0, i);
    EXPECT_LE((M.cwiseProduct(ddq.col(i)) - force).cwiseAbs().maxCoeff(), 1e-12 * (1 + force.cwiseAbs().maxCoeff()));
  }
  EXPECT_GT(largest_kappa, 0.2) << "friction hardly presses on this wire";
  EXPECT_GT((ModelMotion(known).acceleration(states) - ddq).cwiseAbs().maxCoeff(), 0.05);
}

// What is left of terms that cancel is rounded as these are: no sign of a load that has no solution.
TEST(Multipliers, AreFoundWhereTheLoadIsAboutToChangeItsSign) {
  const Model model = rubbing_bead("lambda");
  constexpr int n_loads = 400;
  MatrixXd states = test::draw(model, 1, nonlinear_seed).states.replicate(1, n_loads);
  const double m = 0.2, x = states(0, 0), dx = states(2, 0), free = -m * (dx * dx + 9.81 * m / (m + 0.3)) / x;
  for (int i = 0; i < n_loads; ++i) states(states.rows() - 1, i) = free * (1 + std::pow(10, -3 - i / 40) * (0.1 + i % 40));
  MatrixXd lambda;
  ASSERT_NO_THROW(lambda = ModelMotion(model).multipliers(states));
  for (int i = 0; i < n_loads; ++i) {
    // the load is proportional to how far the push is from the one that needs none
    const double beyond = states(states.rows() - 1, i) - free, farthest = states(states.rows() - 1, 39) - free;
    EXPECT_NEAR(lambda(0, i), lambda(0, 39) * beyond / farthest, 1e-13) << i;
  }
}

TEST(Multipliers, ThatGrowFasterThanTheForceTheyNeedAreAnErrorThatNamesTheState) {
  const Model model = Model::parse(test::changed(rubbing_bead("lambda").text, {{"\"0.3\"", "\"30\""}}), "bead");
  const MatrixXd states = test::draw(rubbing_bead("lambda"), 20, nonlinear_seed).states;
  expect_says([&] { static_cast<void>(ModelMotion(model).acceleration(states)); }, {"Painlevé", "x = "});
}

TEST(Multipliers, ThatOneSampleMakesGrowTooFastAreAnErrorThatNamesTheSample) {
  const Model model = rubbing_bead("lambda");
  const Prior prior = make_prior(model, {});
  const MatrixXd states = test::draw(model, 5, nonlinear_seed).states;
  const std::vector<Observations> observed = {{states, View::constrained_acceleration(*model.system),
                                               ModelMotion(model).acceleration(states), VectorXd::Constant(2, 0.01)}};
  ModelValues values = model_values(prior, observed, default_hyperparameters(prior, observed, {}, {}));
  values.signal_stddev[0] *= 100;
  values.noise_stddev.clear();
  const Posterior no_data(prior, {}, values);
  expect_says(
      [&] {
        static_cast<void>(no_data.sample({{observed[0].view(), states}}, 20, 1));
      },
      {"sample ", " of the prior: system 'rubbing bead': ", "Painlevé", "x = "});
}

TEST(Multipliers, ThatGiveNoFiniteForceAreAnErrorOfTheirOwn) {
  const Model model =
      Model::parse(test::changed(rubbing_bead("lambda").text, {{"abs(lambda(1))", "sqrt(-lambda(1) - 100)"}}), "bead");
  const MatrixXd states = test::draw(rubbing_bead("lambda"), 3, nonlinear_seed).states;
  expect_says([&] { static_cast<void>(ModelMotion(model).acceleration(states)); }, {"not a finite number", "x = "});
}

TEST(CheckOfALoad, SaysWhatTheKnownForceLeavesOutAndFromWhereOnTheContactJams) {
  const auto finding = [](const Model& model) {
    for (const Finding& one : check(model, nullptr, {})) {
      if (one.text.starts_with("latent 'friction coefficient'")) return one;
    }
    return Finding{};
  };
  const Model model = rubbing_bead("lambda");
  const MatrixXd states = generate(model, {100, 1, VectorXd::Zero(2)}).states;
  // |κ| of each state: D = 1 − σκμ
  double largest = 0, jam = 1e9;
  for (Index i = 0; i < states.cols(); ++i) {
    const double x = states(0, i), dx = states(2, i), dz = states(3, i), v = std::sqrt(dx * dx + dz * dz + 1e-6);
    const double inertia = 1 / (x * x / 0.2 + 1 / 0.5), kappa = inertia * std::sqrt(1 + x * x) / v * (-x * dx / 0.2 + dz / 0.5);
    const double sigma = dx * dx + x * states(states.rows() - 1, i) / 0.2 + 9.81 * 0.4 > 0 ? 1 : -1;
    largest = std::max(largest, std::abs(kappa));
    if (sigma * kappa > 0) jam = std::min(jam, 1 / (sigma * kappa));
  }
  EXPECT_EQ(finding(rubbing_bead("lambda0")).text,
            fmt::format("latent 'friction coefficient': a value of 1 changes lambda0, the load that it reads, by up to {:.2g} of "
                        "it; lambda includes this change",
                        largest));
  EXPECT_THAT(finding(model).text, testing::HasSubstr(fmt::format("coefficients of {:.3g} or more make it jam", jam)));
}

TEST(CheckOfALoad, WarnsOfARowWhoseShareOfItNothingTells) {
  const std::string alone = R"(["z - h*x^2"])", repeated = R"(["z - h*x^2", "2*z - 2*h*x^2"])";
  const auto warnings = [&](const std::string& text, const std::string& rows) {
    std::vector<std::string> found;
    for (const Finding& one : check(Model::parse(test::changed(text, {{alone, rows}}), "bead"), nullptr, {}))
      if (one.level == Finding::Level::warning) found.push_back(one.text);
    return found;
  };
  const std::string of_directions = rubbing_bead("lambda").text;
  const std::string of_features = test::changed(
      of_directions,
      {{R"x(["v"])x", R"x(["lambda0(1)"])x"}, {R"x({ force = [["-load*dx/v"], ["-load*dz/v"]] })x", R"x("force")x"}});
  for (const auto& [text, name] : {std::pair(of_directions, "lambda(1)"), std::pair(of_features, "lambda0(1)")}) {
    EXPECT_THAT(warnings(text, alone), testing::IsEmpty());
    EXPECT_THAT(
        warnings(text, repeated),
        testing::ElementsAre(testing::StartsWith(fmt::format("{}: the constraint 'z - h*x^2' follows from others", name))));
  }
}

// ---------------------------------------------------------------- the linear prior

struct Rubs {
  Model model;
  explicit Rubs(Model of = test::model_that_rubs()) : model(std::move(of)) {}
  Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  MatrixXd states = test::draw(model, 6, nonlinear_seed).states;
  VectorXd parameters = model.system->parameter_values();
  MechanicsBatch mechanics = evaluate_mechanics(*model.system, states, parameters);
  PriorValues values = evaluate_prior(prior, states, parameters, mechanics);

  [[nodiscard]] Linearisation::OfGroup signals(double size) const {
    RandomStream random(nonlinear_seed);
    Linearisation::OfGroup at = NonlinearMotion(prior, states, parameters, mechanics, values).without_signals();
    for (MatrixXd& s : at.signals) {
      for (double& one : s.reshaped()) one = size * random.normal();
    }
    return at;
  }
};

MatrixXd view_at(const ViewValues& view, const PriorValues& prior, const std::vector<MatrixXd>& signals) {
  MatrixXd out(view.offset.rows(), view.offset.cols());
  for (int i = 0; i < static_cast<int>(out.cols()); ++i) {
    VectorXd a_bar = prior.mean.col(i);
    for (std::size_t a = 0; a < signals.size(); ++a) a_bar += prior.E(a, i) * signals[a].col(i);
    out.col(i) = view.G(i) * a_bar + view.offset.col(i);
  }
  return out;
}

/// Views, and these of each latent alone.
std::vector<View> with_latents_alone(std::vector<View> views, const Prior& prior) {
  for (std::size_t k = 0, n = views.size(); k < n; ++k) {
    for (std::size_t a = 0; a < prior.latents.size(); ++a) {
      views.push_back(views[k]);
      views.back().latent = static_cast<int>(a);
    }
  }
  return views;
}
std::string text_of(const View& view) {
  return fmt::format("{}, latent {}", view.quantity->word(), view.latent ? view.latent->first : -1);
}

TEST(NonlinearMotion, IsTangentToTheMotionAndItsAccelerationsHoldTheConstraints) {
  const Rubs rubs;
  for (const View& view :
       with_latents_alone({View::constrained_acceleration(*rubs.model.system), View::constraint_force(*rubs.model.system),
                           View::multipliers(*rubs.model.system), View::learned_force(*rubs.model.system)},
                          rubs.prior)) {
    SCOPED_TRACE(text_of(view));
    const NonlinearMotion motion(rubs.prior, rubs.states, rubs.parameters, rubs.mechanics, rubs.values);
    const auto exact = [&](Linearisation::OfGroup at) {
      EXPECT_FALSE(motion.solve(at));
      ViewValues viewed = evaluate_view(view, rubs.mechanics, rubs.states);
      PriorValues prior;
      motion.linearise(view, at, viewed, prior);
      return view_at(viewed, prior, at.signals);
    };
    Linearisation::OfGroup at = rubs.signals(0.1);
    ASSERT_FALSE(motion.solve(at));
    ViewValues viewed = evaluate_view(view, rubs.mechanics, rubs.states);
    PriorValues prior;
    motion.linearise(view, at, viewed, prior);
    const MatrixXd value = view_at(viewed, prior, at.signals);
    if (view.quantity == View::Quantity::multipliers && !view.latent) {
      EXPECT_LE(test::largest(value - at.multipliers), 1e-12 * (1 + test::largest(value)));
    }
    // λ answers to every signal
    const Linearisation::OfGroup along = rubs.signals(0.05);
    const auto moved = [&](double t) {
      Linearisation::OfGroup there = at;
      for (std::size_t a = 0; a < there.signals.size(); ++a) there.signals[a] += t * along.signals[a];
      return there;
    };
    const double t = 1e-4;
    const MatrixXd slope = (exact(moved(t)) - exact(moved(-t))) / (2 * t),
                   linear = (view_at(viewed, prior, moved(1).signals) - value);
    EXPECT_LE(test::largest(slope - linear), 1e-7 * (1 + test::largest(linear)));
    EXPECT_GT(test::largest(linear), 1e-3);
    if (view.quantity != View::Quantity::constrained_acceleration || view.latent) continue;
    for (int i = 0; i < 6; ++i) {
      const auto A = rubs.mechanics.values.A(i);
      const double size = viewed.G(i).norm() * A.norm();
      EXPECT_LE(test::largest(A * viewed.G(i)), 1e-13 * size);
      EXPECT_LE(test::largest(A * value.col(i) - rubs.mechanics.values.b(i)), 1e-12 * (1 + A.norm() * value.col(i).norm()));
    }
  }
}

// As b grows with a slip, so do the load and what it causes.
TEST(NonlinearMotion, HasTheNoiseOfSoftConstraintsAsItChangesWithB) {
  const Rubs rubs(test::model_that_rubs_softly());
  const Linearisation::OfGroup signals = rubs.signals(0.1);
  for (const View& view : {View::constrained_acceleration(*rubs.model.system), View::constraint_force(*rubs.model.system),
                           View::multipliers(*rubs.model.system)}) {
    SCOPED_TRACE(view.quantity->word());
    const auto at_offset = [&](const char* name, double offset, ViewValues& viewed) {
      VectorXd parameters = rubs.parameters;
      parameters[rubs.model.system->parameter_index(name)] = offset;
      const MechanicsBatch mechanics = evaluate_mechanics(*rubs.model.system, rubs.states, parameters);
      const NonlinearMotion motion(rubs.prior, rubs.states, parameters, mechanics, rubs.values);
      Linearisation::OfGroup at = signals;
      EXPECT_FALSE(motion.solve(at));
      viewed = evaluate_view(view, mechanics, rubs.states);
      PriorValues prior;
      motion.linearise(view, at, viewed, prior);
      return view_at(viewed, prior, at.signals);
    };
    const double step = 1e-4;
    for (const auto& [name, column, stddev] : {std::tuple("bank", 0, 0.4), std::tuple("turn", 1, 0.3)}) {
      ViewValues viewed;
      const MatrixXd slope = (at_offset(name, step, viewed) - at_offset(name, -step, viewed)) / (2 * step);
      static_cast<void>(at_offset(name, 0, viewed));
      for (int i = 0; i < 6; ++i) {
        EXPECT_LE(test::largest(viewed.N(i).col(column) - stddev * slope.col(i)), 1e-6 * (1 + test::largest(slope)));
      }
    }
  }
}

TEST(Multipliers, OfATruthAnswerToASlip) {
  const Model& model = test::model_that_rubs_softly();
  const MatrixXd states = test::draw(model, 20, nonlinear_seed).states;
  const MatrixXd slip = MatrixXd::Constant(2, 1, 0.7).replicate(1, states.cols());
  const std::string moved = test::changed(model.text, {{"bank = 0", "bank = 0.28"}, {"turn = 0", "turn = 0.21"}});
  const MatrixXd expected = ModelMotion(Model::parse(moved, "moved")).acceleration(states);
  EXPECT_LE(test::largest(ModelMotion(model).acceleration(states, slip) - expected), 1e-11 * (1 + test::largest(expected)));
}

// ---------------------------------------------------------------- the posterior

// One unknown number: Laplace's approximation is that of a function of one variable.
TEST(NonlinearPosterior, OfOneNumberIsLaplacesApproximation) {
  for (const int kind : {0, 1, 2, 3, 4, 5}) {
    const bool is_positive = kind % 2 == 1, is_soft = kind / 2 == 1, has_sums = kind / 2 == 2;
    SCOPED_TRACE(
        fmt::format("{}{}{}", is_positive ? "positive" : "of the multiplier", is_soft ? ", soft" : "", has_sums ? ", sums" : ""));
    const std::string hard = rubbing_bead("lambda", "constant", is_positive ? "positive = true" : "").text,
                      soft = "[{ expr = \"z - h*x^2\", noise = 0.6 }]";
    const Model model = Model::parse(is_soft ? test::changed(hard, {{"[\"z - h*x^2\"]", soft}}) : hard, "bead");
    const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
    const MatrixXd states = test::draw(model, 25, nonlinear_seed).states;
    const View view = View::constrained_acceleration(*model.system);
    const double sigma = 0.2, s = is_positive ? 1.1 : 0.4;
    RandomStream random(nonlinear_seed);
    MatrixXd y = ModelMotion(model).acceleration(states);
    for (double& one : y.reshaped()) one += sigma * random.normal();
    std::vector<Observations> observations{Observations(states, view, y, VectorXd::Constant(2, sigma))};
    // of both rows at each state but the last: 0.8 of its value less 0.3 of the next one's
    MatrixXd D = MatrixXd::Identity(50, 50);
    if (has_sums) {
      D.setZero(48, 50);
      std::vector<WeightedSum> sums;
      for (int k = 0; k < 48; ++k) {
        D(k, k) = 0.8;
        D(k, k + 2) = -0.3;
        sums.push_back({k % 2, k / 2, Eigen::Vector2d(0.8, -0.3), D.row(k).dot(y.reshaped()), VectorXd::Ones(1)});
      }
      observations[0] = observations[0].with_sums(sums);
    }
    ModelValues values{
        {VectorXd()}, {VectorXd::Constant(1, s)}, {}, {VectorXd::Constant(2, sigma)}, model.system->parameter_values()};
    values.kernel[0] = VectorXd::Ones(std::ssize(prior.latents[0].kernel.parameters()));

    const MechanicsBatch mechanics = evaluate_mechanics(*model.system, states, values.parameters);
    const NonlinearMotion motion(prior, states, values.parameters, mechanics,
                                 evaluate_prior(prior, states, values.parameters, mechanics));
    ViewValues viewed;
    const auto ddq = [&](double signal) {
      Linearisation::OfGroup at = motion.without_signals();
      at.signals[0].setConstant(signal);
      EXPECT_FALSE(motion.solve(at));
      viewed = evaluate_view(view, mechanics, states);
      PriorValues linear;
      motion.linearise(view, at, viewed, linear);
      return view_at(viewed, linear, at.signals);
    };
    // S, which follows the signal where constraints are soft
    Eigen::LLT<MatrixXd> S;
    const auto set_noise = [&](double signal) {
      static_cast<void>(ddq(signal));
      MatrixXd noise = sigma * sigma * MatrixXd::Identity(D.rows(), D.rows());
      for (int i = 0; is_soft && i < 25; ++i) noise.block(2 * i, 2 * i, 2, 2) += viewed.N(i) * viewed.N(i).transpose();
      S.compute(noise);
    };
    const auto whitened = [&](const MatrixXd& of) { return VectorXd(S.matrixL().solve(D * of.reshaped())); };
    const auto objective = [&](double signal) {
      return 0.5 * std::pow(signal / s, 2) + 0.5 * whitened(y - ddq(signal)).squaredNorm();
    };
    double best = 0;
    for (int round = 0; round < (is_soft ? 12 : 1); ++round) {
      set_noise(best);
      // golden section, from a bracket
      double low = -3, high = 0.9;
      for (int step = 0; step < 90; ++step) {
        const double left = high - 0.618034 * (high - low), right = low + 0.618034 * (high - low);
        (objective(left) < objective(right) ? high : low) = objective(left) < objective(right) ? right : left;
      }
      best = 0.5 * (low + high);
    }
    set_noise(best);
    const double step = 1e-5;
    const MatrixXd slope_there = (ddq(best + step) - ddq(best - step)) / (2 * step);
    const double curvature = 1 / (s * s) + whitened(slope_there).squaredNorm();
    const double laplace = objective(best) + 0.5 * std::log(curvature * s * s) + S.matrixLLT().diagonal().array().log().sum() +
                           0.5 * static_cast<double>(D.rows()) * std::log(2 * std::numbers::pi);

    const Posterior posterior(prior, observations, values);
    EXPECT_NEAR(posterior.negative_log_likelihood(), laplace, 1e-6 * (1 + std::abs(laplace)));
    const MatrixXd elsewhere = test::draw(model, 25, nonlinear_seed).states;
    EXPECT_LE(test::largest(posterior.mean(view, elsewhere) - ddq(best)), 2e-6);
    const auto marginal = posterior.marginal(view, elsewhere);
    EXPECT_LE(test::largest(marginal.stddev() - slope_there.cwiseAbs() / std::sqrt(curvature)), 1e-6);
  }
}

// Data that want less than no friction: the best is a load of 0, where |λ| has a kink and no step of a linear prior ends.
TEST(NonlinearPosterior, IsFoundInAWeakKinkAndAStrongOneIsToldAsWhatItIs) {
  const Model model = rubbing_bead("lambda", "constant", R"toml(positive = true
[[latent]]
name       = "lift"
kernel     = "constant"
features   = ["v"]
directions = { force = [["0"], ["1"]] }
)toml");
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  View ddx = View::constrained_acceleration(*model.system);
  ddx.rows = {0};
  VectorXd bottom = VectorXd::Zero(model.system->layout().size());
  bottom[2] = 1;
  const double sigma = 0.1, lift = 5;
  ModelValues values{{VectorXd(), VectorXd()},
                     {VectorXd::Ones(1), VectorXd::Constant(1, lift)},
                     {},
                     {VectorXd::Constant(1, sigma)},
                     model.system->parameter_values()};
  for (std::size_t a = 0; a < 2; ++a) values.kernel[a] = VectorXd::Ones(std::ssize(prior.latents[a].kernel.parameters()));
  const auto posterior = [&](double too_fast) {
    return Posterior(prior, {Observations(bottom, ddx, MatrixXd::Constant(1, 1, too_fast), VectorXd::Constant(1, sigma))},
                     values);
  };
  EXPECT_NEAR(posterior(0.01).mean(View::multipliers(*model.system), bottom)(0, 0), 0, 0.2 * sigma);
  try {
    static_cast<void>(posterior(0.15));
    FAIL() << "a posterior in a kink";
  } catch (const NumericalError& error) {
    EXPECT_THAT(error.what(), testing::HasSubstr("go back and forth: where a load changes its sign"));
  }
}

// the accelerations of n drawn states with noise
Observations measured(const Model& model, int n, std::uint64_t seed, double noise) {
  const MatrixXd states = test::draw(model, n, seed).states;
  MatrixXd y = ModelMotion(model).acceleration(states);
  RandomStream random(seed);
  for (double& one : y.reshaped()) one += noise * random.normal();
  return {states, View::constrained_acceleration(*model.system), y, VectorXd::Constant(model.system->nq(), noise)};
}

struct Fitted {
  Model model;
  Prior prior;
  std::vector<Observations> observations;
  explicit Fitted(Model of, int n)
      : model(std::move(of)),
        prior(make_prior(model, {Prior::Mean::force, std::nullopt})),
        observations{measured(model, n, nonlinear_seed, 0.01)} {}
  [[nodiscard]] std::vector<Hyperparameter> start() const { return default_hyperparameters(prior, observations, {}, {}); }
  [[nodiscard]] ModelValues values() const { return model_values(prior, observations, start()); }
  [[nodiscard]] Posterior posterior() const { return Posterior(prior, observations, values()); }
  [[nodiscard]] Fit fit(const FitOptions& options = {}) const { return gp2::fit(prior, observations, start(), options); }
};

TEST(NonlinearPosterior, MeansSamplesAndPathsHoldTheConstraintsAndTheFixedPoint) {
  const Fitted fitted(test::model_that_rubs(), 25);
  ModelValues values = fitted.values();
  const Posterior posterior(fitted.prior, fitted.observations, values);
  const MatrixXd states = test::draw(fitted.model, 15, nonlinear_seed + 1).states;
  const System& system = *fitted.model.system;
  const View ddq = View::constrained_acceleration(system), force = View::constraint_force(system),
             multipliers = View::multipliers(system), learned = View::learned_force(system);
  const MechanicsBatch mechanics = evaluate_mechanics(system, states, values.parameters);
  const auto expect_motion = [&](const MatrixXd& a, const MatrixXd& lambda, const MatrixXd& fc, const MatrixXd& fl) {
    for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
      const auto A = mechanics.values.A(i);
      const double size = 1 + A.norm() * a.col(i).norm();
      EXPECT_LE(test::largest(A * a.col(i) - mechanics.values.b(i)), 1e-12 * size);
      const double of_force = 1 + fc.col(i).norm() + mechanics.values.F(i).norm();
      EXPECT_LE(test::largest(A.transpose() * lambda.col(i) - fc.col(i)), 1e-11 * of_force);
      EXPECT_LE(test::largest(mechanics.values.M(i) * a.col(i) - mechanics.values.F(i) - fl.col(i) - fc.col(i)),
                1e-11 * of_force);
    }
  };
  expect_motion(posterior.mean(ddq, states), posterior.mean(multipliers, states), posterior.mean(force, states),
                posterior.mean(learned, states));
  const PathwiseSamples paths = sample_paths(posterior, 3, {.seed = 3});
  for (int s = 0; s < 3; ++s) {
    expect_motion(paths.evaluate(s, ddq, states), paths.evaluate(s, multipliers, states), paths.evaluate(s, force, states),
                  paths.evaluate(s, learned, states));
  }
  const MatrixXd samples = posterior.sample({{ddq, states}, {multipliers, states}, {force, states}, {learned, states}}, 4, 5);
  for (Index s = 0; s < samples.cols(); ++s) {
    Index row = 0;
    const auto next = [&](const View& view) {
      const MatrixXd one = samples.col(s).segment(row, view.size() * states.cols()).reshaped(view.size(), states.cols());
      row += one.size();
      return one;
    };
    const MatrixXd a = next(ddq), lambda = next(multipliers), fc = next(force), fl = next(learned);
    expect_motion(a, lambda, fc, fl);
  }
  // the mean and deviation of many samples of what is nearly linear are those of the marginal
  for (const View& view : with_latents_alone({ddq, learned}, fitted.prior)) {
    SCOPED_TRACE(text_of(view));
    const MatrixXd many = posterior.sample({{view, states}}, 4000, 7);
    const auto marginal = posterior.marginal(view, states);
    const VectorXd mean = many.rowwise().mean();
    for (Index r = 0; r < many.rows(); ++r) {
      const double stddev = marginal.stddev().reshaped()[r];
      const double sampled = std::sqrt((many.row(r).array() - mean[r]).square().mean());
      EXPECT_NEAR(mean[r], marginal.mean.reshaped()[r], 0.5 * stddev + 1e-9);
      EXPECT_NEAR(sampled, stddev, 0.5 * stddev + 1e-9);
    }
  }
}

TEST(NonlinearPredictor, IsThePosteriorWithItsJacobianAndAllocatesNothing) {
  for (const Fitted& fitted : {Fitted(test::model_that_rubs(), 25), Fitted(rubbing_bead("lambda", "se + constant"), 25),
                               Fitted(rubbing_bead("lambda0", "se + constant", "positive = true"), 25)}) {
    SCOPED_TRACE(fitted.model.text);
    const Posterior posterior = fitted.posterior();
    const MatrixXd states = test::draw(fitted.model, 12, nonlinear_seed + 1).states;
    const System& system = *fitted.model.system;
    for (const View& view :
         with_latents_alone({View::constrained_acceleration(system), View::multipliers(system), View::constraint_force(system),
                             View::unconstrained_acceleration(system), View::learned_force(system)},
                            fitted.prior)) {
      SCOPED_TRACE(text_of(view));
      const Predictor predictor(posterior, view);
      auto memory = predictor.make_workspace();
      const auto marginal = posterior.marginal(view, states);
      VectorXd mean(view.size()), stddev(view.size()), above = mean, below = mean;
      MatrixXd jacobian(view.size(), states.rows());
      EXPECT_EQ(predictor.mean_and_stddev(states.col(0), mean, stddev, memory), Predictor::Status::ok);
      EXPECT_EQ(predictor.mean_and_jacobian(states.col(0), mean, jacobian, memory), Predictor::Status::ok);
      for (Index i = 0; i < states.cols(); ++i) {
        const std::size_t n_allocations = test::allocations_of([&] {
          EXPECT_EQ(predictor.mean_and_stddev(states.col(i), mean, stddev, memory), Predictor::Status::ok);
          EXPECT_EQ(predictor.mean_and_jacobian(states.col(i), mean, jacobian, memory), Predictor::Status::ok);
        });
        EXPECT_EQ(n_allocations, 0U);
        const double size = 1 + mean.norm();
        EXPECT_LE(test::largest(mean - marginal.mean.col(i)), 1e-11 * size);
        EXPECT_LE(test::largest(stddev - marginal.stddev().col(i)), 1e-8 * size);
        for (Index k = 0; k < states.rows(); ++k) {
          const double step = 1e-5;
          VectorXd there = states.col(i);
          there[k] += step;
          static_cast<void>(predictor.mean(there, above, memory));
          there[k] -= 2 * step;
          static_cast<void>(predictor.mean(there, below, memory));
          EXPECT_LE(test::largest(jacobian.col(k) - (above - below) / (2 * step)), 1e-6 * (size + jacobian.norm()));
        }
      }
    }
  }
}

TEST(NonlinearInverseDynamics, FindsInputsWhoseForceChangesTheFriction) {
  for (const Fitted& fitted : {Fitted(test::model_that_rubs(), 25), Fitted(rubbing_bead("lambda", "se + constant"), 25)}) {
    SCOPED_TRACE(fitted.model.name);
    const Posterior posterior = fitted.posterior();
    const View view = View::constrained_acceleration(*fitted.model.system);
    const MatrixXd states = test::draw(fitted.model, 20, nonlinear_seed + 2).states;
    MatrixXd start = states;
    start.bottomRows(1).setConstant(not_a_number);
    const MatrixXd wanted = posterior.mean(view, states);
    const InverseDynamics found = inverse_dynamics(posterior, view, start, wanted);
    EXPECT_LE(test::largest(found.missed), 1e-10 * (1 + test::largest(wanted)));
    MatrixXd there = states;
    there.bottomRows(1) = found.inputs;
    EXPECT_LE(test::largest(posterior.mean(view, there) - wanted), 1e-10 * (1 + test::largest(wanted)));
    EXPECT_TRUE((found.stddev().array() > 0).all());
    const InverseDynamicsSolver solver(posterior, view);
    auto memory = solver.make_workspace();
    VectorXd inputs(1);
    for (Index i = 0; i < states.cols(); ++i) {
      const std::size_t n_allocations = test::allocations_of(
          [&] { EXPECT_EQ(solver.inputs(start.col(i), wanted.col(i), inputs, memory), InverseDynamicsSolver::Status::ok); });
      EXPECT_EQ(n_allocations, 0U);
      EXPECT_NEAR(inputs[0], found.inputs(0, i), 1e-9 * (1 + std::abs(inputs[0])));
    }
  }
}

// 1000 samples, each at states all over the region of the data and beyond
TEST(PositiveLatent, AlongMinusTheVelocityFeedsNoEnergyInInAnySample) {
  const Fitted fitted(rubbing_bead("lambda", "se + constant", "positive = true"), 30);
  const Posterior posterior = fitted.posterior();
  MatrixXd states = test::draw(fitted.model, 20, nonlinear_seed + 1).states;
  states.middleRows(2, 2).rightCols(10) *= 1.5;
  const View learned = View::learned_force(*fitted.model.system);
  const MatrixXd samples = posterior.sample({{learned, states}}, 1000, 3);
  for (Index s = 0; s < samples.cols(); ++s) {
    const MatrixXd force = samples.col(s).reshaped(2, states.cols());
    EXPECT_LE(force.cwiseProduct(states.middleRows(2, 2)).colwise().sum().maxCoeff(), 0);
  }
}

// Without a constraint, positive latents are all that is not linear.
TEST(PositiveLatent, DampsAFreePendulum) {
  const Model model = Model::parse(R"toml(
name = "pendulum"
coordinates = ["q"]
[mechanics]
mass = [["1"]]
force = ["-9.81*sin(q)"]
[[latent]]
name = "damping"
kernel = "se + constant"
features = ["q"]
positive = true
directions = { force = [["-0.3*dq"]] }
[sampling]
q = [-2, 2]
dq = [-3, 3]
[truth]
force = ["-(0.2 + 0.1*q^2)*dq"]
)toml",
                                   "pendulum");
  const Fitted fitted(model, 50);
  const Fit found = fitted.fit();
  const MatrixXd states = test::draw(model, 100, nonlinear_seed + 1).states;
  const View view = View::constrained_acceleration(*model.system);
  EXPECT_LE(test::largest(found.posterior.mean(view, states) - ModelMotion(model).acceleration(states)), 0.03);
  const Predictor predictor(found.posterior);
  auto memory = predictor.make_workspace();
  VectorXd mean(1);
  EXPECT_EQ(predictor.mean(states.col(0), mean, memory), Predictor::Status::ok);
  EXPECT_NEAR(mean[0], found.posterior.mean(view, states.leftCols(1))(0, 0), 1e-11);
}

// The spring of a bead that rubs: its energy and the coefficient of friction together.
TEST(NonlinearPosterior, LearnsAPotentialBesideAFriction) {
  const std::string text =
      test::changed(rubbing_bead("lambda", "se + constant").text,
                    {{"[sampling]", "[[latent]]\nname = \"spring\"\nfeatures = [\"x\"]\ndirections = \"potential\"\n[sampling]"},
                     {"[\"-mu*load*dx/v\"", "[\"-mu*load*dx/v - 2*sin(2*x)\""}});
  const Fitted fitted(Model::parse(text, "bead on a spring"), 80);
  const Fit found = fitted.fit();
  const MatrixXd states = test::draw(fitted.model, 100, nonlinear_seed + 1).states;
  const View view = View::constrained_acceleration(*fitted.model.system);
  const MatrixXd truth = ModelMotion(fitted.model).acceleration(states);
  EXPECT_LE((found.posterior.mean(view, states) - truth).norm(), 0.01 * truth.norm());
  const VectorXd energy = found.posterior.potential(1, states, states.col(0)).mean;
  // V = 1 − cos 2x
  for (Index i = 0; i < states.cols(); ++i) {
    EXPECT_NEAR(energy[i], std::cos(2 * states(0, 0)) - std::cos(2 * states(0, i)), 0.02);
  }
}

TEST(NonlinearPosterior, GoesToAnotherSystem) {
  const Fitted fitted(rubbing_bead("lambda", "se + constant"), 60);
  const Fit found = fitted.fit();
  const Model heavier = Model::parse(test::changed(fitted.model.text, {{"m = 0.2", "m = 0.4"}}), "heavier");
  const View view = test::under(View::constrained_acceleration(*heavier.system),
                                make_other_system(fitted.model, heavier, {Prior::Mean::force, std::nullopt}));
  const MatrixXd states = test::draw(heavier, 100, nonlinear_seed + 1).states;
  const MatrixXd truth = ModelMotion(heavier).acceleration(states);
  EXPECT_LE((found.posterior.mean(view, states) - truth).norm(), 0.01 * truth.norm());
}

TEST(NonlinearPosterior, FindsANamedRowWhereverAnotherSystemHasIt) {
  const std::string ladder = test::model("experiments/mechanisms/ladder.toml").text;
  const std::string floor = R"toml({ expr = "z - l*cos(a)", name = "ground" })toml",
                    wall = R"toml({ expr = "x - l*sin(a)", name = "side" })toml";
  const auto with = [&](const std::string& rows) {
    const std::string unnamed = R"toml("z - l*cos(a)", "x - l*sin(a)")toml";
    return Model::parse(test::changed(ladder, {{"lambda(1)", "lambda(ground)"}, {"lambda(2)", "lambda(side)"}, {unnamed, rows}}),
                        "ladder");
  };
  const Fitted fitted(with(floor + ", " + wall), 30);
  const Model turned = with(wall + ", " + floor);
  const Posterior posterior = fitted.posterior();
  const View own = View::constrained_acceleration(*fitted.model.system);
  const View other = test::under(View::constrained_acceleration(*turned.system),
                                 make_other_system(fitted.model, turned, {Prior::Mean::force, std::nullopt}));
  const MatrixXd states = test::draw(fitted.model, 20, nonlinear_seed + 1).states;
  const MatrixXd mean = posterior.mean(own, states);
  EXPECT_LE((posterior.mean(other, states) - mean).norm(), 1e-11 * mean.norm());
}

TEST(NonlinearFit, FindsACoefficientThatKnownMultipliersGetWrong) {
  const std::string kernel = "constant + matern32";
  const Fitted own(rubbing_bead("lambda", kernel), 60), known(rubbing_bead("lambda0", kernel), 60);
  const MatrixXd states = test::draw(own.model, 300, nonlinear_seed + 1).states;
  const MatrixXd truth = ModelMotion(own.model).acceleration(states);
  const auto error = [&](const Fitted& of) {
    const std::vector<Observations>& observations = own.observations;
    FitOptions options;
    options.n_restarts = 2;
    const Fit found = fit(of.prior, observations, default_hyperparameters(of.prior, observations, {}, {}), options);
    const View view = View::constrained_acceleration(*of.model.system);
    const auto marginal = found.posterior.marginal(view, states);
    EXPECT_NEAR(found.report.negative_log_likelihood, found.posterior.negative_log_likelihood(), 1e-9);
    return std::pair((marginal.mean - truth).norm() / std::sqrt(static_cast<double>(truth.size())),
                     ((marginal.mean - truth).array().abs() <= 2 * marginal.stddev().array() + 1e-12).cast<double>().mean());
  };
  const auto [of_own, coverage] = error(own);
  EXPECT_LT(of_own, 0.01);
  EXPECT_GT(coverage, 0.8);
  EXPECT_LT(of_own, 0.2 * error(known).first);
}

// Known forces tell little of the load: about it a fit takes friction for a force that changes from place to place, and at good hyperparameters
// Gauss–Newton steps end far from the data.
TEST(NonlinearFit, FindsALoadAndTheCoefficientOfItsFriction) {
  const Model model = Model::parse(R"toml(
name        = "bead on a wire, with a magnet below"
coordinates = ["x", "z"]
inputs      = ["push"]
[parameters]
m = 0.2
h = 0.5
[let]
v    = "sqrt(dx^2 + dz^2 + 1e-4)"
load = "sqrt(lambda(1)^2*(1 + 4*h^2*x^2) + 0.01)"
mu   = "0.15 + 0.25*exp(-(v/0.4)^2)"
[mechanics]
mass  = [["m", "0"], ["0", "m"]]
force = ["push", "-9.81*m"]
[constraints]
position = ["z - h*x^2"]
[[latent]]
name       = "magnet"
kernel     = "constant + matern52"
features   = ["x"]
directions = { force = [["0"], ["1"]] }
[[latent]]
name       = "coefficient"
kernel     = "constant + matern32"
features   = ["exp(-v/0.3)"]
directions = { force = [["-load*dx/v"], ["-load*dz/v"]] }
[noise]
ddq = 0.05
[truth]
force = ["-mu*load*dx/v", "-6*sin(2*x) - mu*load*dz/v"]
[sampling]
x    = [-0.8, 0.8]
dx   = [-1.5, 1.5]
push = [-1, 1]
)toml",
                                   "magnet");
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  const View view = View::constrained_acceleration(*model.system);
  for (const std::uint64_t seed : {15U, 17U, 18U, 19U, 25U, 26U}) {
    const MatrixXd elsewhere = test::draw(model, 200, seed + 1000).states;
    const std::vector<Observations> observations = {measured(model, 60, seed, 0.05)};
    FitOptions options;
    options.standard_errors = false;
    const Fit found = fit(prior, observations, default_hyperparameters(prior, observations, {}, Protocol()), options);
    EXPECT_NE(found.report.termination, FitReport::unsettled) << "seed " << seed;
    const MatrixXd error = found.posterior.mean(view, elsewhere) - ModelMotion(model).acceleration(elsewhere);
    EXPECT_LT(std::sqrt(error.array().square().mean()), 0.05) << "seed " << seed;
  }
}

// What is found where no latent acts may have no posterior mean.
TEST(NonlinearFit, GoesOnFromWhereThereIsAPosteriorMean) {
  const Model model = Model::parse(R"toml(
name        = "rubbing bead on a spring"
coordinates = ["x", "z"]
inputs      = ["push"]
[parameters]
m = { value = 0.2, bounds = [0.1, 0.4], estimate = true }
[let]
v    = "sqrt(dx^2 + dz^2 + 1e-6)"
load = "abs(lambda(1))*sqrt(1 + x^2)"
mu   = "0.15 + 0.25*exp(-(v/0.4)^2)"
[mechanics]
mass  = [["m", "0"], ["0", "m + 0.3"]]
force = ["push", "-9.81*(m + 0.3)"]
[constraints]
position = ["z - 0.5*x^2"]
[[latent]]
name       = "coefficient"
kernel     = "constant + matern32"
features   = ["exp(-v/0.3)"]
directions = { force = [["-0.2*load*dx/v"], ["-0.2*load*dz/v"]] }
positive   = true
[[latent]]
name       = "spring"
features   = ["x"]
directions = "potential"
[noise]
ddq = 0.05
[truth]
force = ["-mu*load*dx/v - 5*x", "-mu*load*dz/v"]
[sampling]
x    = [-0.8, 0.8]
dx   = [-1.5, 1.5]
push = [-1, 1]
)toml",
                                   "spring");
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  FitOptions options;
  options.standard_errors = false;
  for (const std::uint64_t seed : {2U, 4U}) {
    const std::vector<Observations> observations = {measured(model, 60, seed, 0.05)};
    const FitReport report =
        fit(prior, observations, default_hyperparameters(prior, observations, {"m"}, Protocol()), options).report;
    EXPECT_LT(report.negative_log_likelihood, -120) << "seed " << seed;
  }
}

// Under nearly exact data what the restarts find has a mean here and none there.
TEST(NonlinearFit, HyperparametersWithoutAPosteriorGiveWayToThoseThatHaveOne) {
  const Model model = Model::parse(R"toml(
name        = "ladder that rubs"
coordinates = ["x", "z", "th"]
inputs      = ["u"]
[parameters]
a = 0.8
[let]
vf = "dx - a*sin(th)*dth"
vt = "dz + a*cos(th)*dth"
Nf = "abs(lambda(floor))"
Nw = "abs(lambda(wall))"
sf = "tanh(vf/0.05)"
sw = "tanh(vt/0.05)"
mu = "0.15 + 0.2*exp(-abs(vf)/0.3)"
[mechanics]
mass  = [["3", "0", "0"], ["0", "3", "0"], ["0", "0", "0.4"]]
force = ["0", "-9.81*3", "u"]
[constraints]
position = [{expr = "z - a*sin(th)", name = "floor"}, {expr = "x - a*cos(th)", name = "wall"}]
[[latent]]
name       = "floor friction"
kernel     = "constant + matern32"
features   = ["exp(-abs(vf)/0.3)"]
directions = { force = [["-Nf*sf"], ["0"], ["Nf*sf*a*sin(th)"]] }
[[latent]]
name       = "wall friction"
kernel     = "constant"
features   = ["vt"]
directions = { force = [["0"], ["-Nw*sw"], ["-Nw*sw*a*cos(th)"]] }
[truth]
force = ["-mu*Nf*sf", "-0.25*Nw*sw", "mu*Nf*sf*a*sin(th) - 0.25*Nw*sw*a*cos(th)"]
[sampling]
th  = [0.6, 1.3]
dth = [-0.6, 0.6]
u   = [-2, 1]
)toml",
                                   "ladder");
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  FitOptions options;
  options.n_restarts = 2;
  options.max_escapes = 0;
  for (const std::uint64_t seed : {6U, 11U}) {
    const std::vector<Observations> observations = {
        measured(model, 30, seed, 1e-6).with_noise(Noise(VectorXd::Constant(3, 0.05), /*is_estimated=*/true))};
    const FitReport report = fit(prior, observations, default_hyperparameters(prior, observations, {}, {}), options).report;
    EXPECT_LT(report.negative_log_likelihood, -800) << "seed " << seed;
  }
}

TEST(NonlinearFit, TellsTheLikelihoodOfTheHyperparametersThatItTellsAndNotOfADraw) {
  const Fitted fitted(rubbing_bead("lambda", "constant + matern32"), 40);
  const std::vector<Observations>& observations = fitted.observations;
  FitOptions options;
  options.n_restarts = 1;
  options.n_draws = 3;
  const FitReport report = fitted.fit(options).report;
  ASSERT_TRUE(report.draws);
  const Posterior optimum(fitted.prior, observations, model_values(fitted.prior, observations, report.hyperparameters));
  EXPECT_NEAR(report.negative_log_likelihood, optimum.negative_log_likelihood(), 1e-9);
}

// Training leaves out how the evidence moves with the posterior mean itself: what a Newton step in each hyperparameter would gain.
TEST(NonlinearFit, EndsWhereLaplacesEvidenceHasNothingToGain) {
  for (const Fitted& fitted : {Fitted(rubbing_bead("lambda", "constant + matern32"), 60), Fitted(test::model_that_rubs(), 60)}) {
    SCOPED_TRACE(fitted.model.name);
    const std::vector<Observations>& observations = fitted.observations;
    const Fit found = fitted.fit();
    const auto objective = [&](const std::vector<Hyperparameter>& at) {
      const Posterior posterior(fitted.prior, observations, model_values(fitted.prior, observations, at));
      return posterior.negative_log_likelihood() + negative_log_hyperpriors(at, nullptr);
    };
    const std::vector<Hyperparameter>& best = found.report.hyperparameters;
    const double here = objective(best);
    double gain = 0;
    for (std::size_t k = 0; k < best.size(); ++k) {
      const double step = 0.05;
      std::vector<Hyperparameter> above = best, below = best;
      above[k].value = best[k].value * (1 + step), below[k].value = best[k].value / (1 + step);
      if (above[k].value > best[k].upper || below[k].value < best[k].lower) continue;
      const double up = objective(above), down = objective(below), curvature = up + down - 2 * here;
      if (curvature > 0) gain += 0.125 * (up - down) * (up - down) / curvature;
    }
    EXPECT_LT(gain, 2);
  }
}

TEST(NonlinearPosterior, OfDataThatComeAndGoIsTheOneOfThoseThatAreThere) {
  const Fitted fitted(test::model_that_rubs(), 40);
  const Observations& all = fitted.observations.front();
  const ModelValues values = fitted.values();
  const auto rows = [&](Index first, Index n) {
    return Observations(all.states().middleCols(first, n), all.view(), all.values().middleCols(first, n), all.noise().stddev());
  };
  const auto of = [&](Index first, Index n) { return Posterior(fitted.prior, {rows(first, n)}, values); };
  const std::vector<int> first_and_last = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 20, 21, 22, 23, 24};
  const View view = View::constrained_acceleration(*fitted.model.system);
  const MatrixXd states = test::draw(fitted.model, 10, nonlinear_seed + 1).states;
  // as near as Gauss–Newton steps come to the posterior mean
  const auto expect_same = [&](const Posterior& grown, const Posterior& whole) {
    const Posterior::Marginal a = grown.marginal(view, states), b = whole.marginal(view, states);
    EXPECT_LE((a.mean - b.mean).norm(), 1e-6 * b.mean.norm());
    EXPECT_LE((a.covariance - b.covariance).norm(), 1e-5 * b.covariance.norm());
    EXPECT_NEAR(grown.negative_log_likelihood(), whole.negative_log_likelihood(), 1e-6);
  };
  const Posterior first = of(0, 25), before = first;
  const Posterior grown = update(Posterior(first), rows(25, 15));
  EXPECT_EQ(grown.n_states(), 40);
  expect_same(grown, of(0, 40));
  expect_same(remove_oldest(Posterior(grown), 10), of(10, 30));
  expect_same(first, before);
  // of two groups, by their noise, to which data were added by turns
  const auto noisier = [&](Index from, Index n) {
    return Observations(all.states().middleCols(from, n), all.view(), all.values().middleCols(from, n), 2 * all.noise().stddev());
  };
  const Posterior two = update(update(Posterior(of(0, 10)), noisier(10, 10)), rows(20, 5));
  ModelValues of_both = values;
  of_both.noise_stddev.push_back(2 * all.noise().stddev());
  expect_same(two, Posterior(fitted.prior,
                             {Observations(all.states()(Eigen::all, first_and_last), all.view(),
                                           all.values()(Eigen::all, first_and_last), all.noise().stddev()),
                              noisier(10, 10)},
                             of_both));
  expect_same(remove_oldest(Posterior(two), 15), Posterior(fitted.prior, {rows(20, 5), noisier(15, 5)}, of_both));
  expect_same(remove_oldest(remove_oldest(Posterior(two), 12), 3), remove_oldest(Posterior(two), 15));
  // where all go that were added to the prior it is the prior again
  const Posterior prior = first.without_data(), emptied = remove_oldest(update(Posterior(prior), rows(0, 15)), 15);
  EXPECT_EQ(emptied.mean(view, states), prior.mean(view, states));
  EXPECT_EQ(emptied.marginal(view, states).covariance, prior.marginal(view, states).covariance);
}

TEST(NonlinearPosterior, LeavesOutAStateOfSumsAsOneOfValues) {
  const Fitted fitted(test::model_that_rubs(), 25);
  const Observations& alone = fitted.observations.front();
  std::vector<WeightedSum> sums;
  for (int k = 0; k < alone.view().size(); ++k) {
    for (int i = 0; i < alone.n_data(); ++i) sums.push_back({k, i, VectorXd::Ones(1), alone.values()(k, i), VectorXd::Ones(1)});
  }
  const ModelValues values = fitted.values();
  const LeaveOneOut of_sums = leave_one_out(Posterior(fitted.prior, {alone.with_sums(sums)}, values)).front(),
                    of_values = leave_out(Posterior(fitted.prior, {alone}, values), alone.n_data()).stretches.front();
  EXPECT_LE(test::largest(of_sums.mean - of_values.mean), 1e-4 * test::largest(of_values.mean));
  EXPECT_LE(test::largest(of_sums.variance - of_values.variance), 1e-4 * test::largest(of_values.variance));
}

// ---------------------------------------------------------------- through inducing points

/// The same at the start of a fit, exactly and with points among the observed states.
struct ThroughPoints {
  Fitted fitted;
  ModelValues exact, values;

  explicit ThroughPoints(Fitted of, int most = 100'000) : fitted(std::move(of)) {
    exact = fitted.values();
    values = exact;
    values.inducing = choose_inducing_points(fitted.prior, fitted.observations, exact, {.most = most, .left_out = 1e-12}).points;
  }
  [[nodiscard]] Posterior posterior(const Workers& workers = {}) const {
    return Posterior(fitted.prior, fitted.observations, values, workers);
  }
  [[nodiscard]] View ddq() const { return View::constrained_acceleration(*fitted.model.system); }
};

std::vector<Fitted> that_are_nonlinear(int n) {
  return {Fitted(test::model_that_rubs(), n), Fitted(rubbing_bead("lambda", "se + constant"), n),
          Fitted(rubbing_bead("lambda", "matern32 + constant", "positive = true"), n)};
}

// Both take the same steps, so that only rounding is between them: 1e-15 of what is left of k(φ, φ), in units of the noise.
TEST(NonlinearInducing, PointsAtEveryStateChangeNothing) {
  for (const Fitted& fitted : that_are_nonlinear(30)) {
    SCOPED_TRACE(fitted.model.name);
    const ThroughPoints p(fitted);
    const Posterior exact(fitted.prior, fitted.observations, p.exact), through = p.posterior();
    const double nll = exact.negative_log_likelihood();
    EXPECT_NEAR(through.negative_log_likelihood(), nll, 1e-9 * std::abs(nll));
    const System& system = *fitted.model.system;
    const MatrixXd states = test::draw(fitted.model, 20, nonlinear_seed + 1).states;
    for (const View& view : {p.ddq(), View::multipliers(system), View::learned_force(system)}) {
      SCOPED_TRACE(view.quantity->word());
      const Posterior::Joint got = through.joint(view, states), wanted = exact.joint(view, states);
      EXPECT_LE(test::largest(got.mean - wanted.mean), 1e-8 * (1 + test::largest(wanted.mean)));
      EXPECT_LE(test::largest(got.covariance - wanted.covariance), 1e-8 * (1 + test::largest(wanted.covariance)));
    }
    const LeftOut got = leave_out(through, LeftOut::n_stretches), wanted = leave_out(exact, LeftOut::n_stretches);
    for (const auto part : {&LeaveOneOut::mean, &LeaveOneOut::variance}) {
      EXPECT_LE(test::largest(got.values[0].*part - wanted.values[0].*part), 1e-6 * (1 + test::largest(wanted.values[0].*part)));
      // a row is told by less than a value is, and rounding counts by the square of that
      EXPECT_LE(test::largest(got.rows[0].*part - wanted.rows[0].*part), 2e-5 * (1 + test::largest(wanted.rows[0].*part)));
      EXPECT_LE(test::largest(got.stretches[0].*part - wanted.stretches[0].*part),
                1e-6 * (1 + test::largest(wanted.stretches[0].*part)));
    }
    // the likelihood there, with its gradient
    ModelValues at_mean = p.exact, through_points = p.values;
    at_mean.about = linearisation_of(fitted.prior, fitted.observations, p.exact);
    through_points.about = linearisation_of(fitted.prior, fitted.observations, p.values);
    const auto evaluate = [&](const ModelValues& values, ModelGradient& gradient) {
      Likelihood::Options options;
      options.noise_gradient = true;
      options.gradient_parameters = {0};
      const Likelihood likelihood(fitted.prior, fitted.observations, values, options);
      Likelihood::Workspace workspace;
      return likelihood.evaluate(values, &gradient, workspace);
    };
    ModelGradient of_exact, of_points;
    EXPECT_NEAR(evaluate(at_mean, of_exact), nll, 1e-9 * std::abs(nll));
    EXPECT_NEAR(evaluate(through_points, of_points), nll, 1e-9 * std::abs(nll));
    for (std::size_t a = 0; a < of_exact.log_kernel.size(); ++a) {
      EXPECT_LE(test::largest(of_points.log_kernel[a] - of_exact.log_kernel[a]), 1e-6 * std::abs(nll));
      EXPECT_LE(test::largest(of_points.log_signal_stddev[a] - of_exact.log_signal_stddev[a]), 1e-6 * std::abs(nll));
    }
    EXPECT_LE(test::largest(of_points.log_noise_stddev[0] - of_exact.log_noise_stddev[0]), 1e-6 * std::abs(nll));
    EXPECT_NEAR(of_points.parameters[0], of_exact.parameters[0], 1e-6 * (std::abs(nll) + std::abs(of_exact.parameters[0])));
    EXPECT_NE(of_points.parameters[0], 0);
  }
}

// A discrepancy that no two states share is a larger noise, of the nonlinear steps too.
TEST(NonlinearInducing, WhatPointsLeaveOutOfADiscrepancyIsNoise) {
  Fitted fitted(test::model_that_rubs(), 25);
  PriorOptions options;
  options.mean = Prior::Mean::force;
  options.discrepancy = Discrepancy{};
  options.discrepancy->stddev = VectorXd::Constant(fitted.model.system->nq(), 0.01);
  fitted.prior = make_prior(fitted.model, options);
  ThroughPoints p(fitted);
  for (ModelValues* values : {&p.exact, &p.values}) {
    values->kernel.back().setConstant(1e-3);
    values->signal_stddev.back().setConstant(0.7);
  }
  auto points = std::make_shared<InducingPoints>(*p.values.inducing);
  points->features.back().conservativeResize(0, Eigen::NoChange);
  p.values.inducing = points;
  const Posterior exact(fitted.prior, fitted.observations, p.exact), through = p.posterior();
  const double nll = exact.negative_log_likelihood();
  EXPECT_NEAR(through.negative_log_likelihood(), nll, 1e-8 * std::abs(nll));
  const MatrixXd states = test::draw(fitted.model, 20, nonlinear_seed + 1).states;
  const Posterior::Joint got = through.joint(p.ddq(), states), wanted = exact.joint(p.ddq(), states);
  EXPECT_LE(test::largest(got.mean - wanted.mean), 1e-7 * (1 + test::largest(wanted.mean)));
  EXPECT_LE(test::largest(got.covariance - wanted.covariance), 1e-7 * (1 + test::largest(wanted.covariance)));
}

TEST(NonlinearInducing, FewPointsHoldTheConstraintsInMeansSamplesPathsAndThePredictor) {
  const ThroughPoints p(Fitted(test::model_that_rubs(), 300), 40);
  const Posterior posterior = p.posterior();
  const System& system = *p.fitted.model.system;
  const MatrixXd states = test::draw(p.fitted.model, 12, nonlinear_seed + 1).states;
  const MechanicsBatch mechanics = evaluate_mechanics(system, states, p.values.parameters);
  const auto expect_constraint = [&](const MatrixXd& ddq) {
    for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
      const auto A = mechanics.values.A(i);
      EXPECT_LE(test::largest(A * ddq.col(i) - mechanics.values.b(i)), 1e-12 * (1 + A.norm() * ddq.col(i).norm()));
    }
  };
  const Posterior::Marginal marginal = posterior.marginal(p.ddq(), states);
  expect_constraint(marginal.mean);
  const PathwiseSamples paths = sample_paths(posterior, 3, {.seed = 3});
  for (int s = 0; s < 3; ++s) expect_constraint(paths.evaluate(s, p.ddq(), states));
  const MatrixXd samples = posterior.sample({{p.ddq(), states}}, 3, 5);
  for (Index s = 0; s < 3; ++s) expect_constraint(samples.col(s).reshaped(system.nq(), states.cols()));
  const Predictor predictor(posterior, p.ddq());
  auto memory = predictor.make_workspace();
  VectorXd mean(system.nq()), stddev(system.nq());
  for (Index i = 0; i < states.cols(); ++i) {
    ASSERT_EQ(predictor.mean_and_stddev(states.col(i), mean, stddev, memory), Predictor::Status::ok);
    EXPECT_LE(test::largest(mean - marginal.mean.col(i)), 1e-10 * (1 + mean.norm()));
    EXPECT_LE(test::largest(stddev - marginal.stddev().col(i)), 1e-7 * (1 + mean.norm()));
  }
}

TEST(NonlinearInducing, ManyStatesAreLearnedFromInBlocksWithTheSameBitsForAnyNumberOfThreads) {
  const ThroughPoints p(Fitted(rubbing_bead("lambda", "se + constant"), 5'200), 20);
  const Posterior posterior = p.posterior();
  EXPECT_EQ(posterior.n_states(), 5'200);
  EXPECT_EQ(posterior.observations().front().n_data(), 2600);
  const MatrixXd states = test::draw(p.fitted.model, 50, nonlinear_seed + 1).states;
  const Posterior::Marginal marginal = posterior.marginal(p.ddq(), states);
  EXPECT_EQ(p.posterior(3).marginal(p.ddq(), states).covariance, marginal.covariance);
  // the coefficient is 0.3 everywhere
  EXPECT_LE(test::largest(marginal.mean - ModelMotion(p.fitted.model).acceleration(states)), 2e-3);
  // what is kept of a fit
  const Posterior again = Posterior::of_summary(p.fitted.prior, posterior.observations(), {p.values}, *posterior.summary());
  EXPECT_EQ(again.marginal(p.ddq(), states).covariance, marginal.covariance);
  EXPECT_EQ(leave_one_out(again)[0].mean, leave_one_out(posterior)[0].mean);
}

// The rows that were there before stay linear where they were, which is near where all rows together are.
TEST(NonlinearInducing, MoreObservationsAddToTheSums) {
  const ThroughPoints p(Fitted(rubbing_bead("lambda", "se + constant"), 400), 20);
  const Observations& all = p.fitted.observations.front();
  const Posterior first(p.fitted.prior, {all.slice(0, 300)}, p.values), anew = p.posterior();
  const MatrixXd states = test::draw(p.fitted.model, 20, nonlinear_seed + 1).states;
  const MatrixXd before = first.mean(p.ddq(), states);
  const Posterior grown = update(Posterior(first), all.slice(300, 100));
  EXPECT_EQ(grown.n_states(), 400);
  const Posterior::Marginal got = grown.marginal(p.ddq(), states), wanted = anew.marginal(p.ddq(), states);
  EXPECT_LE(test::largest(got.mean - wanted.mean), 0.02 * test::largest(before - wanted.mean));
  EXPECT_LE(test::largest(got.stddev() - wanted.stddev()), 0.02 * test::largest(wanted.stddev()));
  EXPECT_EQ(first.mean(p.ddq(), states), before);
  static_cast<void>(forget(Posterior(grown), 0.5));
  EXPECT_EQ(grown.marginal(p.ddq(), states).covariance, got.covariance);
}

TEST(NonlinearInducing, AStateThatIsAddedWithoutMechanicsIsNamed) {
  const Model model =
      Model::parse(test::changed(rubbing_bead("lambda", "se + constant").text, {{"m + 0.3", "m + 0.3 - 0.1*z"}}), "bead");
  const ThroughPoints p(Fitted(model, 60), 20);
  const Observations& all = p.fitted.observations.front();
  MatrixXd states = all.states().leftCols(2);
  states(1, 1) = 50;
  const Observations wrong(states, all.view(), all.values().leftCols(2), all.noise().stddev());
  expect_says([&] { static_cast<void>(update(p.posterior(), wrong)); },
              {"the mass matrix M is not positive definite at state 2 (x = "});
}

void expect_nearly_exact(const Fitted& fitted) {
  FitOptions options;
  options.n_restarts = 1;
  const Fit exact = fitted.fit(options);
  options.n_inducing = 60;
  const Fit through = fitted.fit(options);
  ASSERT_TRUE(through.report.inducing.has_value());
  EXPECT_LE(through.report.inducing->left_out.sum(), 2);
  EXPECT_NEAR(through.report.objective, exact.report.objective, 3);
  const View view = View::constrained_acceleration(*fitted.model.system);
  const MatrixXd states = test::draw(fitted.model, 100, nonlinear_seed + 1).states;
  const Posterior::Marginal got = through.posterior.marginal(view, states), wanted = exact.posterior.marginal(view, states);
  EXPECT_LE(test::largest(got.mean - wanted.mean), 0.5 * test::largest(wanted.stddev()));
}

TEST(NonlinearInducing, AFitIsNearlyTheExactOne) {
  expect_nearly_exact(Fitted(rubbing_bead("lambda", "constant + matern32"), 500));
}

TEST(NonlinearInducing, AFitStoppedAnywhereHasWhatWasFoundExactlyToo) {
  const Fitted fitted(rubbing_bead("lambda", "constant + matern32"), 120);
  for (const int n_inducing : {0, 20}) {
    FitOptions options;
    options.n_restarts = 1;
    options.n_threads = 1;
    options.n_inducing = n_inducing;
    int n_calls = 0;
    options.progress = [&](const Progress&) { ++n_calls; };
    static_cast<void>(fitted.fit(options));
    for (const int call : {1, n_calls / 2, n_calls - 1}) {
      SCOPED_TRACE(fmt::format("{} points, after {} of {}", n_inducing, call, n_calls));
      std::atomic<bool> stop = false;
      int n = 0;
      options.stop = &stop;
      options.progress = [&](const Progress&) { stop = ++n >= call; };
      const Fit found = fitted.fit(options);
      EXPECT_EQ(found.report.termination, FitReport::interrupted);
      EXPECT_FALSE(found.report.converged);
      EXPECT_TRUE(std::isfinite(found.report.objective));
      const Observations& group = fitted.observations.front();
      EXPECT_TRUE(found.posterior.mean(group.view(), group.states()).allFinite());
    }
  }
}

// Points are chosen by how strongly the latent acts where it is: here 30 times as strongly as where nothing is known.
TEST(NonlinearInducing, AFitOfAPositiveLatentFarFromOneIsNearlyTheExactOne) {
  std::string text = rubbing_bead("lambda", "constant + matern32", "positive = true").text;
  for (const char* row : {"\"-load*dx/v\"", "\"-load*dz/v\""}) {
    text.insert(text.find(row) + 2, "0.01*");
  }
  expect_nearly_exact(Fitted(Model::parse(text, "bead"), 500));
}

TEST(NonlinearPrior, IsRefusedByNameWhereItCannotBe) {
  const std::string latent = "[[latent]]\nname = \"x\"\nfeatures = ";
  expect_says([&] { static_cast<void>(make_prior(rubbing_bead("lambda", "constant", latent + "[\"lambda(1)\"]"))); },
              {"only directions"});
  expect_says([&] { rubbing_bead("lambda", "constant", latent + "[\"x\"]\npositive = true"); }, {"directions of its own"});
  // a part of the motion is no observation, of a posterior that grows either
  const Fitted fitted(test::model_that_rubs(), 25);
  const Observations& all = fitted.observations.front();
  const Posterior posterior = fitted.posterior();
  View part = all.view();
  part.latent = 0;
  expect_says([&] { static_cast<void>(update(Posterior(posterior), all.with_view(part))); }, {"from the whole motion"});
}

}  // namespace
}  // namespace gp2
