#include "gp2/training/laplace.hpp"

#include <array>
#include <cmath>
#include <limits>

#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "gp2/error.hpp"
#include "training/curvature.hpp"
#include "training/drawn_problem.hpp"

namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::DrawnProblem;
using test::line;
using Kind = Hyperparameter::Kind;

constexpr std::uint64_t laplace_seed = 60611;

DrawnProblem laplace_problem(const Model& model, int n, const std::vector<std::string>& estimated,
                             std::uint64_t of_seed = laplace_seed, double noise_stddev = 0.3) {
  return test::drawn_problem(model, n, estimated, of_seed, noise_stddev);
}

// p and r enter by p + 2 r alone
std::string text_of_sum() { return test::changed(line().text, {{"p*x + r", "p + 2*r"}}); }

TEST(LaplaceTest, IsExactWhereTheLikelihoodIsQuadratic) {
  const DrawnProblem p = only(laplace_problem(line(), 30, {"p", "r"}), {Kind::parameter});
  const LaplaceUncertainty uncertainty = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);

  const Observations& observed = p.observations.front();
  const ModelValues values = model_values(p.prior, p.observations, p.hyperparameters);
  const Index n = observed.states().cols();
  const double s = values.signal_stddev[0][0], lengthscale = values.kernel[0][0];
  MatrixXd C(n, n), Z(n, 2);
  for (Index i = 0; i < n; ++i) {
    for (Index j = 0; j < n; ++j) {
      const double r = (observed.states()(1, i) - observed.states()(1, j)) / lengthscale;
      C(i, j) = s * s * std::exp(-0.5 * r * r) + (i == j ? 0.09 : 0);
    }
    Z.row(i) << observed.states()(0, i), 1;
  }
  const MatrixXd covariance = (Z.transpose() * C.llt().solve(Z)).inverse();
  // gradients are linear here: what differences leave is rounding over the step
  EXPECT_NEAR(uncertainty.stddev[0], std::sqrt(covariance(0, 0)), 1e-8);
  EXPECT_NEAR(uncertainty.stddev[1], std::sqrt(covariance(1, 1)), 1e-8);
  EXPECT_NEAR(uncertainty.correlation(0, 1), covariance(0, 1) / std::sqrt(covariance(0, 0) * covariance(1, 1)), 1e-7);
  EXPECT_TRUE(uncertainty.held.empty());
  EXPECT_EQ(uncertainty.undetermined.cols(), 0);
}

TEST(LaplaceTest, DistanceFromTheOptimumIsMeasuredInStandardDeviations) {
  DrawnProblem p = only(laplace_problem(line(), 30, {"p"}), {Kind::parameter});
  FitOptions options;
  options.n_restarts = 1;
  options.n_threads = 1;
  p.hyperparameters = fit(p.prior, p.observations, p.hyperparameters, options).report.hyperparameters;
  const LaplaceUncertainty at_optimum = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
  EXPECT_LT(at_optimum.distance_from_optimum, 1e-3);
  p.hyperparameters[0].value += 2.5 * at_optimum.stddev[0];
  EXPECT_NEAR(laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1).distance_from_optimum, 2.5, 2e-3);
}

TEST(LaplaceTest, TheDeviationOfALogarithmOfNoiseIsThatOfCounting) {
  // noise alone: log σ of n numbers is known to 1/√(2n)
  DrawnProblem p = laplace_problem(line(), 200, {});
  p.observations[0] = test::with_estimated_noise(p.observations[0], true);
  p.hyperparameters = default_hyperparameters(p.prior, p.observations, {}, Protocol{.hyperprior = false});
  for (Hyperparameter& h : p.hyperparameters) {
    if (h.kind == Kind::signal_stddev) h.value = h.lower = 1e-6;
  }
  FitOptions options;
  options.n_restarts = 1;
  options.n_threads = 1;
  std::erase_if(p.hyperparameters, [](const Hyperparameter& h) { return h.kind == Kind::kernel; });
  for (Hyperparameter& h : p.hyperparameters) {
    if (h.kind == Kind::signal_stddev) h.upper = 2e-6;
  }
  p.hyperparameters = fit(p.prior, p.observations, p.hyperparameters, options).report.hyperparameters;
  const LaplaceUncertainty uncertainty = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
  ASSERT_EQ(p.hyperparameters.back().kind, Kind::noise_stddev);
  EXPECT_NEAR(uncertainty.stddev[static_cast<Index>(p.hyperparameters.size()) - 1], 1 / std::sqrt(400.0), 1e-4);
}

TEST(LaplaceTest, WhatIsAtABoundIsHeld) {
  DrawnProblem p = only(laplace_problem(line(), 20, {"p", "r"}), {Kind::parameter});
  p.hyperparameters[0].value = p.hyperparameters[0].lower;
  const LaplaceUncertainty uncertainty = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
  EXPECT_EQ(uncertainty.held, std::vector<int>{0});
  EXPECT_EQ(uncertainty.stddev[0], 0);
  EXPECT_EQ(uncertainty.correlation(0, 1), 0);
  EXPECT_GT(uncertainty.stddev[1], 0);
}

TEST(LaplaceTest, ParametersThatEnterByTheirSumOnlyAreNamedUndetermined) {
  const DrawnProblem p = only(laplace_problem(Model::parse(text_of_sum(), "sum"), 20, {"p", "r"}), {Kind::parameter});
  const LaplaceUncertainty uncertainty = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
  EXPECT_TRUE(std::isinf(uncertainty.stddev[0]));
  EXPECT_TRUE(std::isinf(uncertainty.stddev[1]));
  EXPECT_TRUE(std::isnan(uncertainty.correlation(0, 1)));
  ASSERT_EQ(uncertainty.undetermined.cols(), 1);
  // p + 2 r stays as it is along (2, −1)
  EXPECT_NEAR(uncertainty.undetermined(0, 0) / uncertainty.undetermined(1, 0), -2, 1e-4);
}

// Along p + 2 r = const the one reaches its bound first: the other is no better known for it.
TEST(LaplaceTest, AParameterAtABoundByChanceIsNotHeld) {
  DrawnProblem p = only(laplace_problem(Model::parse(text_of_sum(), "sum"), 20, {"p", "r"}), {Kind::parameter});
  FitOptions once;
  once.n_restarts = once.n_threads = 1;
  p.hyperparameters = fit(p.prior, p.observations, p.hyperparameters, once).report.hyperparameters;
  Hyperparameter &at_bound = p.hyperparameters[0], &other = p.hyperparameters[1];
  other.value += (at_bound.value - at_bound.lower) / 2;
  at_bound.value = at_bound.lower;
  const LaplaceUncertainty open = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
  EXPECT_TRUE(std::isinf(open.stddev[0]));
  EXPECT_TRUE(std::isinf(open.stddev[1]));
  // where the data push it there it is
  other.value += 0.5;
  EXPECT_EQ(laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1).held, std::vector<int>{0});
}

// A direction of no curvature is one of a lengthscale, and a parameter has a part in it. Where the lengthscale leaves its box before
// the parameter has moved by its own deviation, that is known.
TEST(LaplaceTest, WhatHardlyMovesAlongAnOpenDirectionIsKnown) {
  std::vector<Hyperparameter> hyperparameters = {Hyperparameter::of(Kind::kernel, 0, 0),
                                                 Hyperparameter::of(Kind::parameter, 0, 0)};
  for (Hyperparameter& h : hyperparameters) h.value = 1, h.lower = 0.5, h.upper = 2;
  Curvature curvature;
  curvature.free = {0, 1};
  curvature.gradient = VectorXd::Zero(2);
  curvature.eigenvalues = Eigen::Vector2d(1e-12, 1);
  curvature.eigenvectors = Eigen::Rotation2Dd(std::asin(0.05)).toRotationMatrix();
  curvature.zero = 1e-7;
  constexpr double unit = 1e-6, width = 1.5;
  curvature.unit = Eigen::Vector2d(1, unit);
  const LaplaceUncertainty known = laplace_uncertainty(curvature, hyperparameters);
  EXPECT_NEAR(known.stddev[1], width * unit, 0.01 * width * unit);
  curvature.unit[0] = unit;
  const LaplaceUncertainty open = laplace_uncertainty(curvature, hyperparameters);
  EXPECT_TRUE(std::isinf(open.stddev[0]));
  EXPECT_TRUE(std::isinf(open.stddev[1]));
}

TEST(LaplaceTest, IsTheSameForAnyNumberOfThreads) {
  const DrawnProblem p = laplace_problem(line(), 20, {"p", "r"});
  const LaplaceUncertainty one = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
  const LaplaceUncertainty three = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 3);
  EXPECT_EQ(one.stddev, three.stddev);
}

// the spread of estimates over data sets, and what each data set says of it
TEST(LaplaceTest, StatedDeviationsCoverTheErrorsOfManyFits) {
  constexpr int n_sets = 150;
  FitOptions options;
  options.n_restarts = 1;
  options.n_threads = 1;
  options.max_escapes = 0;
  double sum_of_squares = 0;
  for (int set = 0; set < n_sets; ++set) {
    DrawnProblem p = laplace_problem(line(), 25, {"p"}, laplace_seed + 1 + static_cast<std::uint64_t>(set));
    p.hyperparameters = fit(p.prior, p.observations, p.hyperparameters, options).report.hyperparameters;
    const LaplaceUncertainty uncertainty = laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
    for (std::size_t k = 0; k < p.hyperparameters.size(); ++k) {
      const Hyperparameter& h = p.hyperparameters[k];
      if (h.kind != Kind::parameter) continue;
      sum_of_squares += std::pow((h.value - 0.7) / uncertainty.stddev[static_cast<Index>(k)], 2);
    }
  }
  // χ² of 150 over 150: 1 ± 0.115
  EXPECT_NEAR(sum_of_squares / n_sets, 1, 0.35);
}

FitOptions one_run(bool standard_errors = true) {
  FitOptions options;
  options.n_restarts = 1;
  options.n_threads = 1;
  options.standard_errors = standard_errors;
  return options;
}

// A wheel of radius r on an inertia J, driven through one rolling contact: only r²/J moves the carriage.
const Model& rolling() {
  static const Model model = Model::parse(R"toml(
name        = "rolling"
coordinates = ["x", "a"]
[parameters]
r = { value = 0.5, bounds = [0.1, 1e4] }
J = { value = 0.3, bounds = [0.05, 5] }
[mechanics]
mass  = [["1", "0"], ["0", "J"]]
force = ["sin(3*x)", "0"]
[constraints]
velocity = ["dx - r*sin(a)*da"]
[[latent]]
kernel   = "se"
features = ["dx", "x"]
directions = "force"
[noise]
ddq = 0.01
[truth]
force = ["-0.5*dx", "0"]
[sampling]
x  = [-1, 2]
a  = [0.4, 2.6]
da = [-1, 1]
)toml",
                                          "rolling");
  return model;
}

TEST(LaplaceTest, ParametersKnownToAMillionthOfTheirBoxAreFittedToTheirOptimum) {
  // r of the model is 0.5 within [0, 1e4]: known to about 1e-7 of its box, a lengthscale to its order of magnitude
  const DrawnProblem p = laplace_problem(rolling(), 60, {"r"}, laplace_seed, 0.01);
  const FitReport report = fit(p.prior, p.observations, p.hyperparameters, one_run()).report;
  ASSERT_TRUE(report.uncertainty.has_value());
  EXPECT_LT(report.uncertainty->distance_from_optimum, 0.02);
  const auto last = static_cast<Index>(report.hyperparameters.size()) - 1;
  ASSERT_EQ(report.hyperparameters.back().name, "r");
  EXPECT_LT(report.uncertainty->stddev[last], 0.01);
  EXPECT_LT(std::abs(report.hyperparameters.back().value - 0.5), 4 * report.uncertainty->stddev[last]);
}

// With a mean of zero and M = m I the projection knows no m: what rounding makes of nothing is no curvature, and another restart is no
// better by it.
TEST(LaplaceTest, WhatNothingDependsOnIsNotKnownAndStaysAtItsStart) {
  const Model& model = test::model("models/surface.toml");
  for (const std::uint64_t seed : {laplace_seed, laplace_seed + 1, laplace_seed + 2}) {
    SCOPED_TRACE(seed);
    DrawnProblem p = laplace_problem(model, 40, {}, seed, 0.1);
    p.prior = make_prior(model, {Prior::Mean::zero, std::nullopt});
    p.hyperparameters = default_hyperparameters(p.prior, p.observations, {"m"}, {});
    FitOptions options = one_run();
    options.n_restarts = 3;
    const FitReport report = fit(p.prior, p.observations, p.hyperparameters, options).report;
    ASSERT_TRUE(report.uncertainty.has_value());
    ASSERT_EQ(report.hyperparameters.back().name, "m");
    EXPECT_TRUE(std::isinf(report.uncertainty->stddev[report.uncertainty->stddev.size() - 1]));
    EXPECT_EQ(report.hyperparameters.back().value, p.hyperparameters.back().value);
  }
}

// √r has no value left of r = 0: nothing to take differences of
TEST(LaplaceTest, AFitAtTheEdgeOfItsModelSaysThatItHasNoStandardErrors) {
  const std::string text = test::changed(line().text, {{"p*x + r", "p*x + sqrt(r)"}, {"value = 0.2", "value = 1e-7"}});
  DrawnProblem p = laplace_problem(Model::parse(text, "edge"), 20, {"r"});
  try {
    laplace_uncertainty(p.prior, p.observations, p.hyperparameters, 1);
    FAIL() << "no error";
  } catch (const NumericalError& error) {
    EXPECT_STREQ(error.what(), "the likelihood is not finite near the fitted value of 'r': no standard errors");
  }
  // r alone, between 1e-7 and what it can hardly leave
  p = only(std::move(p), {Kind::parameter});
  FitOptions options = one_run();
  options.max_iterations = 1;
  options.gradient_tolerance = 1e300;
  const FitReport report = fit(p.prior, p.observations, p.hyperparameters, options).report;
  EXPECT_FALSE(report.uncertainty.has_value());
  EXPECT_NE(report.termination.find("; the likelihood is not finite near the fitted value of 'r': no standard errors"),
            std::string::npos)
      << report.termination;
}

TEST(LaplaceTest, NoFitWithoutParametersPaysForStandardErrors) {
  const DrawnProblem p = laplace_problem(line(), 20, {});
  EXPECT_FALSE(fit(p.prior, p.observations, p.hyperparameters, one_run()).report.uncertainty.has_value());
  const DrawnProblem with = laplace_problem(line(), 20, {"p"});
  EXPECT_FALSE(fit(with.prior, with.observations, with.hyperparameters, one_run(false)).report.uncertainty.has_value());
}

TEST(LaplaceTest, NotesSayWhichParametersAreKnownOnlyTogether) {
  const DrawnProblem p = laplace_problem(Model::parse(text_of_sum(), "sum"), 20, {"p", "r"});
  const FitReport report = fit(p.prior, p.observations, p.hyperparameters, one_run()).report;
  const std::vector<UncertaintyNote> notes = uncertainty_notes(report);
  ASSERT_EQ(notes.size(), 1U);
  EXPECT_TRUE(notes[0].is_warning);
  EXPECT_NE(notes[0].text.find("the data determine p, r only together: changing"), std::string::npos) << notes[0].text;
}

TEST(LaplaceTest, APriorDeterminesWhatDataDoNot) {
  const std::string text =
      test::changed(text_of_sum(), {{"r = { value = 0.2,", "r = { value = 0.2, prior = { mean = 0.1, stddev = 0.05 },"}});
  const DrawnProblem p = laplace_problem(Model::parse(text, "sum"), 20, {"p", "r"});
  const FitReport report = fit(p.prior, p.observations, p.hyperparameters, one_run()).report;
  ASSERT_TRUE(report.uncertainty.has_value());
  const auto r = static_cast<Index>(report.hyperparameters.size()) - 1;
  // nothing else speaks of r by itself: the posterior of it is its prior
  EXPECT_NEAR(report.hyperparameters.back().value, 0.1, 1e-3);
  EXPECT_NEAR(report.uncertainty->stddev[r], 0.05, 1e-3);
  EXPECT_LE(uncertainty_notes(report).size(), 2U) << "of the prior, and of the single start";
  for (const UncertaintyNote& note : uncertainty_notes(report)) EXPECT_FALSE(note.is_warning) << note.text;
}

TEST(LaplaceTest, StandardErrorsOfASingleStartAreSaidToBe) {
  const DrawnProblem p = laplace_problem(line(), 20, {"p"});
  const auto says_so = [&](int n_restarts) {
    FitOptions options = one_run();
    options.n_restarts = n_restarts;
    const FitReport report = fit(p.prior, p.observations, p.hyperparameters, options).report;
    const std::vector<UncertaintyNote> notes = uncertainty_notes(report);
    return std::ranges::any_of(notes, [](const UncertaintyNote& note) {
      return !note.is_warning && note.text == "the standard errors are those about the optimum of a single start";
    });
  };
  EXPECT_TRUE(says_so(1));
  EXPECT_FALSE(says_so(2));
}

// Through inducing points one run follows those that few rows were fitted with.
TEST(LaplaceTest, OfAFitThroughInducingPointsTheStartsOfItsFirstRowsCount) {
  const DrawnProblem p = laplace_problem(line(), 20, {"p"});
  FitReport report = fit(p.prior, p.observations, p.hyperparameters, one_run()).report;
  const auto mend_of = [&](int n_start, int n_starts) -> std::string {
    report.inducing.emplace();
    report.inducing->n_start = n_start;
    report.inducing->n_starts = n_starts;
    for (const UncertaintyNote& note : uncertainty_notes(report)) {
      if (note.text == "the standard errors are those about the optimum of a single start") return note.mend;
    }
    return "";
  };
  EXPECT_EQ(mend_of(400, 5), "");
  EXPECT_EQ(mend_of(400, 1), "Other starts may lead to a better one: fit with more `restarts`");
  EXPECT_EQ(mend_of(0, 1), "Other starts may lead to a better one: fit exactly (`inducing=none`), with several `restarts`");
}

TEST(LaplaceTest, NotesNameASingleOpenParameterManyCombinationsAndFitsThatStoppedEarly) {
  FitReport report;
  report.hyperparameters.resize(3);
  const std::array<const char*, 3> names = {"m", "R", "Ic"};
  for (std::size_t k = 0; k < 3; ++k) {
    report.hyperparameters[k] = Hyperparameter::of(Kind::parameter, 0, k);
    report.hyperparameters[k].name = names[k];
    report.hyperparameters[k].value = 1;
  }
  constexpr double infinity = std::numeric_limits<double>::infinity();
  LaplaceUncertainty& u = report.uncertainty.emplace();
  u.correlation = MatrixXd::Identity(3, 3);
  u.stddev = Eigen::Vector3d(infinity, 1, 1);
  u.undetermined = Eigen::Vector3d(1, 0, 0);
  EXPECT_EQ(uncertainty_notes(report).at(0).text, "the data do not determine m");
  u.stddev.setConstant(infinity);
  u.undetermined = MatrixXd::Identity(3, 2);
  EXPECT_EQ(uncertainty_notes(report).at(0).text, "of the 3 parameters m, R, Ic the data leave 2 combinations open");
  EXPECT_EQ(uncertainty_notes(report).at(0).mend, "Hold 2 of them at known values, or give them priors");
  u.stddev.setOnes();
  u.undetermined.resize(3, 0);
  u.distance_from_optimum = 1.5;
  EXPECT_EQ(uncertainty_notes(report).at(0).text,
            "the standard errors are rough: the optimiser stopped 1.5 standard deviations before the optimum");
  u.distance_from_optimum = infinity;
  EXPECT_EQ(uncertainty_notes(report).at(0).text,
            "the standard errors are rough: the optimiser stopped where no optimum is near");
  u.distance_from_optimum = 0;
  u.correlation(0, 2) = u.correlation(2, 0) = -0.991;
  ASSERT_EQ(uncertainty_notes(report).size(), 1U);
  EXPECT_FALSE(uncertainty_notes(report)[0].is_warning);
  EXPECT_EQ(uncertainty_notes(report)[0].text,
            "m and Ic are known much better together than each by itself (correlation -0.9910)");
  // on the way to an optimum all seems open
  u.stddev[0] = u.distance_from_optimum = infinity;
  u.undetermined = Eigen::Vector3d(1, 0, 0);
  report.termination = "the limit of iterations was reached";
  EXPECT_EQ(uncertainty_notes(report).at(0).mend, "Fit with a larger `max_iterations`, or `start` from this fit");
  report.termination.clear();
  // along what is open no optimum is near
  u.stddev[0] = u.distance_from_optimum = infinity;
  u.undetermined = Eigen::Vector3d(1, 0, 0);
  EXPECT_EQ(uncertainty_notes(report).at(0).mend, "Know first what the data do not determine: along it no optimum is reached");
}

FitReport report_of_one(const HyperPrior& prior, double value) {
  FitReport report;
  Hyperparameter& g = report.hyperparameters.emplace_back(Hyperparameter::of(Kind::parameter, 0, 0));
  g.name = "g";
  g.value = value;
  g.lower = 5;
  g.upper = 15;
  g.hyperprior = prior;
  LaplaceUncertainty& u = report.uncertainty.emplace();
  u.correlation = MatrixXd::Identity(1, 1);
  u.stddev = VectorXd::Constant(1, g.at_bound() ? 0 : 0.05);
  return report;
}

TEST(LaplaceTest, NotesTellOfPriorsThatTheDataContradict) {
  const HyperPrior prior{HyperPrior::Form::normal, 9.81, 0.1};
  EXPECT_TRUE(uncertainty_notes(report_of_one(prior, 9.6)).empty());
  EXPECT_TRUE(uncertainty_notes(report_of_one({}, 12)).empty());
  const std::vector<UncertaintyNote> far = uncertainty_notes(report_of_one(prior, 10.67));
  ASSERT_EQ(far.size(), 1U);
  EXPECT_TRUE(far[0].is_warning);
  EXPECT_EQ(far[0].text, "g = 10.67 lies 8.6 deviations of its prior from the middle of that, 9.81");
  const std::vector<UncertaintyNote> outside = uncertainty_notes(report_of_one({HyperPrior::Form::normal, 20, 0.1}, 15));
  ASSERT_EQ(outside.size(), 1U);
  EXPECT_EQ(outside[0].text, "g = 15 lies 50 deviations of its prior from the middle of that, 20, which its bounds forbid");
  const HyperPrior of_logarithm{HyperPrior::Form::log_normal, 9.81, 0.01};
  EXPECT_EQ(uncertainty_notes(report_of_one(of_logarithm, 10.67)).size(), 1U);
}

// x of Laplace's approximation is the logarithm of what is positive by nature; people read the unit of the log.
TEST(LaplaceTest, TheErrorOfANoiseIsInItsUnit) {
  FitReport report;
  Hyperparameter& noise = report.hyperparameters.emplace_back(Hyperparameter::of(Kind::noise_stddev, 0, 0));
  noise.lower = 1e-3;
  noise.upper = 1e3;
  report.uncertainty.emplace().stddev = VectorXd::Constant(1, 0.05);
  for (const double value : {0.01, 10.0}) {
    noise.value = value;
    EXPECT_DOUBLE_EQ(parameter_uncertainty(report, 0).stddev, 0.05 * value);
  }
}

TEST(LaplaceTest, NotesSayWhichParametersStandardErrorsHoldAtABound) {
  FitReport report = report_of_one({}, 15);
  EXPECT_TRUE(uncertainty_notes(report).empty()) << "no other has an error";
  Hyperparameter& k = report.hyperparameters.emplace_back(Hyperparameter::of(Kind::parameter, 0, 1));
  k.name = "k";
  k.lower = -1;
  k.upper = 1;
  k.value = 0.5;
  report.uncertainty->stddev = Eigen::Vector2d(0, 0.01);
  report.uncertainty->correlation = MatrixXd::Identity(2, 2);
  const std::vector<UncertaintyNote> notes = uncertainty_notes(report);
  ASSERT_EQ(notes.size(), 1U);
  EXPECT_FALSE(notes[0].is_warning);
  EXPECT_EQ(notes[0].text, "the standard errors hold g at the bound");
}

// draws would tell the width of the bounds
TEST(LaplaceTest, DrawsGiveNoErrorToWhatTheDataLeaveOpenOrAtABound) {
  FitReport report;
  for (const char* name : {"open", "at bound", "known"}) {
    Hyperparameter& h =
        report.hyperparameters.emplace_back(Hyperparameter::of(Kind::parameter, 0, report.hyperparameters.size()));
    h.name = name;
    h.lower = 0;
    h.upper = h.value = 1;
  }
  report.hyperparameters[0].value = report.hyperparameters[2].value = 0.5;
  LaplaceUncertainty& uncertainty = report.uncertainty.emplace();
  uncertainty.stddev = Eigen::Vector3d(std::numeric_limits<double>::infinity(), 0, 0.1);
  uncertainty.correlation = MatrixXd::Identity(3, 3);
  HyperparameterDraws& draws = report.draws.emplace();
  draws.mean = Eigen::Vector3d(0.4, 0.9, 0.5);
  draws.stddev = Eigen::Vector3d(0.01, 0.02, 0.2);
  draws.lower = draws.mean - 2 * draws.stddev;
  draws.upper = draws.mean + 2 * draws.stddev;
  draws.correlation = MatrixXd::Identity(3, 3);
  EXPECT_TRUE(std::isinf(parameter_uncertainty(report, 0).stddev));
  EXPECT_FALSE(parameter_uncertainty(report, 0).is_of_draws);
  EXPECT_TRUE(std::isnan(parameter_uncertainty(report, 1).stddev));
  EXPECT_EQ(parameter_uncertainty(report, 2).stddev, 0.2);
  EXPECT_TRUE(parameter_uncertainty(report, 2).is_of_draws);
  EXPECT_TRUE(std::isnan(parameter_correlation(report, 0, 2)));
}

}  // namespace
}  // namespace gp2
