#include <functional>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <Eigen/QR>
#include <nlohmann/json.hpp>

#include "gp2/jobs/fit_problem.hpp"
#include "gp2/predictor.hpp"
#include "gp2/simulation/generate.hpp"
#include "input_error.hpp"
#include "io_testing.hpp"
#include "prior/admissible_directions.hpp"
#include "test_models.hpp"

// The small latent beside the model's one: when a fit has it, how large it is, and that a fit file keeps it.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Json = nlohmann::ordered_json;
using test::eps;
using test::input_error_of;
using test::TemporaryFolder;
using testing::ElementsAre;
using testing::HasSubstr;
using Quantity = View::Quantity;

/// A bead on a wire; what follows [noise] may be said otherwise, and a [[latent]] too.
Model bead(const std::string& latent = "directions = \"acceleration\"\n", const std::string& noise = "ddq = [0.1, 0.3]",
           const std::string& wire = "y - 0.7*x^2", const std::string& name = "bead.toml") {
  return Model::parse(fmt::format(R"toml(
coordinates = ["x", "y"]
inputs      = ["u"]
[mechanics]
mass  = [["2", "0"], ["0", "2"]]
force = ["u", "-2*9.81"]
[constraints]
position = ["{}"]
[truth]
acceleration = ["-0.3*dx", "-0.3*dy"]
[sampling]
x  = [-1, 1]
dx = [-1, 1]
u  = [-2, 2]
[noise]
{}
[[latent]]
name       = "drag"
kernel     = "se"
features   = ["x", "dx", "u"]
{}
)toml",
                                  wire, noise, latent),
                      name);
}

/// A noisy log of a model's own motion.
CsvTable log_of(const Model& model, int n = 12, std::uint64_t seed = 3) {
  const System& system = *model.system;
  const GeneratedData data = generate(model, {n, seed, VectorXd::Constant(system.nq(), 0.1)});
  const std::vector<std::string> states = system.state_names();
  std::vector<std::string> names;
  MatrixXd values(0, n);
  const auto add = [&](const std::string& name, const auto& row) {
    names.push_back(name);
    values.conservativeResize(values.rows() + 1, Eigen::NoChange);
    values.bottomRows(1) = row;
  };
  for (std::size_t k = 0; k < states.size(); ++k) {
    if (data.known[k]) add(states[k], data.states.row(static_cast<Index>(k)));
  }
  for (int j = 0; j < system.nq(); ++j) {
    add(system.coordinates()[static_cast<std::size_t>(j)].acceleration(), data.accelerations.row(j));
  }
  std::string text;
  for (std::size_t k = 0; k < names.size(); ++k) text += fmt::format("{}{}", k == 0 ? "" : ",", names[k]);
  for (int i = 0; i < n; ++i) {
    for (Index k = 0; k < values.rows(); ++k) text += fmt::format("{}{}", k == 0 ? "\n" : ",", shortest(values(k, i)));
  }
  return CsvTable::parse(text, "log.csv");
}

FitProblem problem_of(const Model& model, const FitProblemOptions& options = {}) {
  return make_fit_problem(model, log_of(model), options);
}

/// The model's hyperparameters as they start, and the data.
Posterior start_of(const FitProblem& problem) {
  return {problem.prior, problem.observations, model_values(problem.prior, problem.observations, problem.hyperparameters)};
}

/// As `gp2 fit --max-iterations 0` writes it.
FitFile file_of(const Model& model, const FitProblem& problem) {
  FitFile file;
  file.model = model;
  file.prior_options = problem.prior_options;
  file.observations = problem.observations;
  file.systems = problem.systems;
  FitOptions options;
  options.max_iterations = 0;
  file.report = fit(problem.prior, problem.observations, problem.hyperparameters, options).report;
  return file;
}

View view_of(const Prior& prior, Quantity quantity, std::optional<int> latent = {}) {
  View view = View::all(quantity, *prior.system);
  view.latent = latent;
  return view;
}

// some of them faster than the data
MatrixXd some_states(const Model& model) {
  MatrixXd states = test::draw(model, 6, 8).states;
  states.middleRows(model.system->nq(), model.system->nq()) *= 2;
  return states;
}

// ---- which fits have one

bool has_discrepancy(const Model& model, const FitProblemOptions& options = {}) {
  const FitProblem problem = problem_of(model, options);
  const bool has = problem.prior_options.discrepancy.has_value();
  EXPECT_EQ(problem.prior.latents.back().name == "discrepancy", has);
  return has;
}

TEST(Discrepancy, StandsBesideOneLatentThatActsInEveryDirection) {
  EXPECT_TRUE(has_discrepancy(bead()));
  EXPECT_TRUE(has_discrepancy(bead("directions = \"force\"\n")));
  FitProblemOptions options;
  options.mean = Prior::Mean::force;
  options.base = Latent::Base::force;
  EXPECT_TRUE(has_discrepancy(bead(), options));
  // --prior replaces the directions that a file gives
  EXPECT_TRUE(has_discrepancy(bead("directions = [[\"-dx\"], [\"-dy\"]]\n"), options));

  const Prior prior = problem_of(bead()).prior;
  ASSERT_EQ(prior.latents.size(), 2U);
  EXPECT_EQ(prior.latents[0].name, "drag");
  EXPECT_EQ(prior.latents[0].directions, nullptr);
  EXPECT_THAT(prior.latents[1].feature_names, ElementsAre("x", "dx", "u", "distance outside the data"));
  EXPECT_EQ(view_of(prior, Quantity::unconstrained_acceleration, 1).names(*prior.system, prior.latents[1].name),
            (std::vector<std::string>{"abar_x@discrepancy", "abar_y@discrepancy"}));
}

TEST(Discrepancy, StandsBesideTheDirectionsOfTheDefaultPriorToo) {
  std::string text = bead().text;
  const std::string kernel = "kernel     = \"se\"\n";
  const Model model = Model::parse(text.erase(text.find(kernel), kernel.size()), "bead.toml");
  EXPECT_TRUE(has_discrepancy(model));
  EXPECT_EQ(problem_of(model).prior.latents.size(), 3U);
}

TEST(Discrepancy, IsLeftOutOfThePapersProtocolOfMaximumLikelihoodAndWhereAskedTo) {
  FitProblemOptions paper, maximum_likelihood, none, baseline;
  paper.protocol.name = Protocol::Name::paper;
  maximum_likelihood.protocol.hyperprior = false;
  none.discrepancy = false;
  baseline.baseline = Baseline::Kind::se;
  for (const FitProblemOptions& options : {paper, maximum_likelihood, none, baseline})
    EXPECT_FALSE(has_discrepancy(bead(), options));
}

TEST(Discrepancy, IsLeftOutWhereTheModelSaysHowItsLatentsAct) {
  EXPECT_FALSE(has_discrepancy(bead("directions = [[\"-dx\"], [\"-dy\"]]\n")));
  EXPECT_FALSE(has_discrepancy(bead("directions = [[\"1\", \"0\"], [\"0\", \"1\"]]\n"))) << "written out is structured too";
}

TEST(Discrepancy, StandsBesideSeveralLatentsOfWhichOneActsInEveryDirection) {
  const std::string drive = "[[latent]]\nname = \"drive\"\nkernel = \"se\"\nfeatures = [\"u*dx\"]\n";
  const std::string one_way = "directions = { force = [[\"1\"], [\"0\"]] }\n";
  EXPECT_FALSE(has_discrepancy(bead(one_way + drive + one_way)));
  for (const std::string& own : {std::string(), one_way}) {
    const Model model = bead(own + drive);
    EXPECT_TRUE(has_discrepancy(model));
    const FitProblem problem = problem_of(model);
    ASSERT_EQ(problem.prior.latents.size(), 3U);
    // of the entries that they read, not of features made of them
    EXPECT_THAT(problem.prior.latents[2].feature_names, ElementsAre("x", "dx", "u", "distance outside the data"));
    EXPECT_EQ(problem.prior_options.discrepancy->lengthscale,
              1.25 * default_scales(problem.prior, problem.observations).feature_stddev[0]);
  }
}

// ---- how large it is

/// The discrepancy's variance along the one free direction of a bead, in units of the noise as measured; per state.
VectorXd variance_in_noise(const FitProblem& problem, const Eigen::Vector2d& noise) {
  const View alone = view_of(problem.prior, Quantity::constrained_acceleration, 1);
  const MatrixXd& states = problem.observations.front().states();
  const MatrixXd covariance = start_of(problem).without_data().joint(alone, states).covariance;
  VectorXd variance(states.cols());
  for (Index i = 0; i < states.cols(); ++i)
    variance[i] = covariance.diagonal().segment(2 * i, 2).cwiseQuotient(noise.cwiseAbs2()).sum();
  return variance;
}

constexpr double start = Protocol::Standard::discrepancy_median;  // of the noise

TEST(Discrepancy, IsAsLargeBesideTheNoiseWhateverTheConstraintPassesOn) {
  for (const char* slope : {"0.05", "1", "30"}) {
    for (const char* noise : {"[0.1, 0.1]", "[0.1, 3]"}) {
      const FitProblem problem =
          problem_of(bead("directions = \"acceleration\"\n", fmt::format("ddq = {}", noise), fmt::format("y - {}*x", slope)));
      const VectorXd variance = variance_in_noise(problem, problem.observations.front().noise().stddev());
      EXPECT_LE((variance.array() / (start * start) - 1).abs().maxCoeff(), 1e-12) << slope << " " << noise;
    }
  }
  // where the direction of the wire changes too
  const VectorXd variance = variance_in_noise(problem_of(bead()), {0.1, 0.3});
  EXPECT_LE((variance.array() / (start * start) - 1).abs().maxCoeff(), 1e-12);
}

/// E of the discrepancy at each state, side by side, under the parameters given.
MatrixXd directions_of(const Prior& prior, const MatrixXd& states, const VectorXd& parameters) {
  const MechanicsBatch mechanics = require_mechanics(*prior.system, states, parameters);
  const PriorValues values = require_prior_values(prior, states, parameters, mechanics);
  return values.directions.back().reshaped(prior.system->nq(), prior.system->nq() * states.cols());
}

/// By how much it is larger there than within the data.
VectorXd growth_of(const FitProblem& problem, const MatrixXd& states) {
  const Discrepancy& discrepancy = *problem.prior_options.discrepancy;
  const MatrixXd features = evaluate_features(problem.prior, problem.prior.latents.size() - 1, states).transpose();
  VectorXd growth(states.cols());
  for (Index i = 0; i < growth.size(); ++i) {
    double s = 0;
    for (Index d = 0; d < discrepancy.lengthscale.size(); ++d) {
      const double gap = std::abs(features(d, i) * discrepancy.lengthscale[d] - discrepancy.centre[d]);
      s += std::pow(2 * std::max(0.0, gap / discrepancy.half_range[d] - 1), 2);
    }
    growth[i] = 1 + 15 * s / (15 + s);
  }
  return growth;
}

TEST(Discrepancy, GrowsOutsideTheData) {
  const Model model = bead();
  const FitProblem problem = problem_of(model);
  const Discrepancy& discrepancy = *problem.prior_options.discrepancy;
  const StateLayout layout = model.system->layout();
  const MatrixXd& data = problem.observations.front().states();
  EXPECT_LE((growth_of(problem, data).array() - 1).maxCoeff(), 10 * eps);
  for (const auto& [feature, entry] : {std::pair(0, layout.q(0)), std::pair(1, layout.dq(0)), std::pair(2, layout.u(0))}) {
    EXPECT_EQ(discrepancy.centre[feature], data.row(entry).maxCoeff() / 2 + data.row(entry).minCoeff() / 2);
    EXPECT_NEAR(discrepancy.half_range[feature], (data.row(entry).maxCoeff() - data.row(entry).minCoeff()) / 2, 4 * eps);
  }
  // at twice the range, and so far that it hardly grows any more
  MatrixXd states = data.leftCols(2);
  states.row(layout.dq(0)) << discrepancy.centre[1] + 2 * discrepancy.half_range[1], 1e6;
  const MatrixXd covariance =
      start_of(problem).without_data().marginal(view_of(problem.prior, Quantity::constrained_acceleration, 1), states).covariance;
  for (const auto& [state, growth] : {std::pair(0, 1 + 4 / (1 + 4.0 / 15)), std::pair(1, 16.0)}) {
    const MatrixXd of_state = covariance.col(state).reshaped(2, 2);
    const double in_noise = of_state.diagonal().cwiseQuotient(discrepancy.stddev.cwiseAbs2()).sum();
    EXPECT_NEAR(std::sqrt(in_noise), growth * start, 1e-9 * growth);
  }
}

TEST(Discrepancy, OfAFileBeforeItGrewDoesNotGrow) {
  const Model model = bead();
  FitProblem problem = problem_of(model);
  problem.prior_options.discrepancy->centre.resize(0);
  problem.prior_options.discrepancy->half_range.resize(0);
  const TemporaryFolder folder;
  file_of(model, problem).write(folder / "fit.json");
  EXPECT_EQ(FitFile::read(folder / "fit.json").prior_options.discrepancy->half_range.size(), 0);
}

TEST(Discrepancy, IsDistributedAsTheNoiseIsGivenThatItObeysTheConstraint) {
  for (const char* name : {"surface", "unicycle", "slider_crank", "double_pendulum", "duffing"}) {
    SCOPED_TRACE(name);
    const Model& model = test::model(fmt::format("models/{}.toml", name));
    const FitProblem problem = problem_of(model);
    const MatrixXd states = some_states(model);
    const VectorXd parameters = model.system->parameter_values();
    const MechanicsBatch mechanics = require_mechanics(*model.system, states, parameters);
    const MatrixXd all = directions_of(problem.prior, states, parameters);
    const VectorXd growth = growth_of(problem, states);
    const Index nq = model.system->nq();
    for (int i = 0; i < states.cols(); ++i) {
      const MatrixXd N = growth[i] * MatrixXd(problem.prior_options.discrepancy->stddev.asDiagonal());
      const MatrixXd A = mechanics.values.A(i), E = all.middleCols(i * nq, nq), AN = A * N;
      // cov(ε | A ε = 0) of ε ~ N(0, N²)
      const MatrixXd conditional = N * N - N * (AN.completeOrthogonalDecomposition().pseudoInverse() * AN) * N;
      EXPECT_LE((E * E.transpose() - conditional).cwiseAbs().maxCoeff(), 100 * eps * N.squaredNorm());
      EXPECT_LE((A * E).cwiseAbs().maxCoeff(), 100 * eps * A.norm() * N.norm());
    }
  }
}

TEST(Discrepancy, FollowsTheParametersOfTheConstraintAndTheState) {
  const std::string text = bead("").text, stated = "\"y - 0.7*x^2\"";
  // once, and twice: rows that are redundant
  for (const char* wire : {"\"y - p*x^2\"", "\"y - p*x^2\", \"2*y - 2*p*x^2\""}) {
    std::string with = text;
    with.replace(with.find(stated), stated.size(), wire);
    with.insert(with.find("[mechanics]"), "[parameters]\np = 0.7\n");
    const Model model = Model::parse(with, "bead.toml");
    const FitProblem problem = problem_of(model);
    const MatrixXd states = some_states(model);
    const VectorXd p = model.system->parameter_values();
    const auto at = [&](double step) { return directions_of(problem.prior, states, p + VectorXd::Constant(1, step)); };
    const MechanicsBatch here = require_mechanics(*model.system, states, p);
    const PriorValues derivative =
        differentiate_prior(problem.prior, states, p, here, require_prior_values(problem.prior, states, p, here),
                            model.system->differentiate(states, p, 0), 0);
    // rounding over a step of 1e-5, and its square
    const MatrixXd differences = (at(1e-5) - at(-1e-5)) / 2e-5;
    EXPECT_GT(differences.cwiseAbs().maxCoeff(), 1e-3);
    EXPECT_LE((derivative.directions.back().reshaped(2, 2 * states.cols()) - differences).cwiseAbs().maxCoeff(), 1e-9);

    // of the discrepancy alone, so that nothing hides its part of the derivatives
    const Posterior posterior = start_of(problem);
    for (const Quantity quantity : {Quantity::constrained_acceleration, Quantity::unconstrained_acceleration}) {
      const View view = view_of(problem.prior, quantity, 1);
      const Predictor predictor(posterior, view, {true, true, Predictor::Storage::double_precision});
      Predictor::Workspace workspace = predictor.make_workspace();
      VectorXd mean(2), stddev(2), ahead(2), behind(2);
      MatrixXd jacobian(2, states.rows());
      for (Index i = 0; i < states.cols(); ++i) {
        const VectorXd x = states.col(i);
        ASSERT_EQ(predictor.mean_and_jacobian(x, mean, jacobian, workspace), Predictor::Status::ok);
        ASSERT_EQ(predictor.mean_and_stddev(x, mean, stddev, workspace), Predictor::Status::ok);
        EXPECT_LE((mean - posterior.mean(view, x)).norm(), 1e-12);
        const MatrixXd covariance = posterior.marginal(view, x).covariance.reshaped(2, 2);
        EXPECT_LE((stddev.cwiseAbs2() - covariance.diagonal()).norm(), 1e-14);
        for (Index k = 0; k < x.size(); ++k) {
          const VectorXd step = 1e-5 * VectorXd::Unit(x.size(), k);
          ASSERT_EQ(predictor.mean(x + step, ahead, workspace), Predictor::Status::ok);
          ASSERT_EQ(predictor.mean(x - step, behind, workspace), Predictor::Status::ok);
          EXPECT_LE((jacobian.col(k) - (ahead - behind) / 2e-5).norm(), 1e-8) << k;
        }
      }
    }
  }
}

TEST(Discrepancy, OfDeviationsThatHaveNoSquaresIsAnError) {
  const Eigen::RowVector2d A(1, 1);
  const auto of = [&](const Eigen::Vector2d& stddev) {
    return MatrixXd(AdmissibleDirections().compute(A, MatrixXd(stddev.asDiagonal())));
  };
  EXPECT_TRUE(of({1e-100, 1e-99}).allFinite());
  EXPECT_TRUE(of({1e100, 1e99}).allFinite());
  for (const double size : {1e170, 1e300}) EXPECT_THROW(of({size, size}), NumericalError);
}

TEST(Discrepancy, GoesWhereRowsOfTheLargestRankLetIt) {
  const Eigen::RowVector3d row(1, -1, 0);
  MatrixXd A(3, 3);
  A << row, 1 + 1e-6, -1, 0, 0, 0, 0;
  const MatrixXd B = Eigen::Vector3d(0.3, 2, 1).asDiagonal();
  const MatrixXd expected = AdmissibleDirections().compute(row, B);
  EXPECT_GT(test::largest(expected.leftCols(2)), 0.1);
  EXPECT_LE(test::largest(AdmissibleDirections().compute(A, B, 1) - expected), 1e-5);
  EXPECT_LE(test::largest(AdmissibleDirections().compute(A, B).leftCols(2)), 1e-9) << "independent ones";
}

TEST(Discrepancy, HasAUsableDeviationInEveryModel) {
  for (const char* name : {"surface", "unicycle", "slider_crank", "double_pendulum", "duffing"}) {
    const Model& model = test::model(fmt::format("models/{}.toml", name));
    const VectorXd stddev = problem_of(model).prior_options.discrepancy.value().stddev;
    EXPECT_TRUE(stddev.allFinite() && (stddev.array() > 0).all()) << name << ": " << stddev.transpose();
  }
}

TEST(Discrepancy, HasOneSizeThatIsLearned) {
  const FitProblem problem = problem_of(bead());
  const Hyperparameter& size = problem.hyperparameters.back();
  EXPECT_EQ(size.name, "discrepancy.size");
  EXPECT_EQ(size.value, start);
  const ModelValues values = model_values(problem.prior, problem.observations, problem.hyperparameters);
  EXPECT_EQ(values.signal_stddev.back(), VectorXd::Constant(2, start));
}

TEST(Discrepancy, HasAShareOfTheSpreadOfEachFeature) {
  const Model model = bead();
  const FitProblem problem = problem_of(model);
  const Discrepancy& discrepancy = *problem.prior_options.discrepancy;
  // the features are entries of the state
  const MatrixXd& states = problem.observations.front().states();
  const StateLayout layout = model.system->layout();
  ASSERT_EQ(discrepancy.lengthscale.size(), 3);
  for (const auto& [feature, entry] : {std::pair(0, layout.q(0)), std::pair(1, layout.dq(0)), std::pair(2, layout.u(0))}) {
    const VectorXd x = states.row(entry);
    const double spread = std::sqrt((x.array() - x.mean()).square().mean());
    EXPECT_NEAR(discrepancy.lengthscale[feature], 1.25 * spread, 20 * eps * spread);
  }
}

TEST(Discrepancy, IsASquaredExponentialOfTheseSizes) {
  const Model model = bead("directions = \"force\"\n");  // the discrepancy acts on the acceleration all the same
  const FitProblem problem = problem_of(model);
  const Discrepancy& discrepancy = *problem.prior_options.discrepancy;
  const MatrixXd states = some_states(model);
  const View alone = view_of(problem.prior, Quantity::unconstrained_acceleration, 1);
  const MatrixXd covariance = start_of(problem).without_data().joint(alone, states).covariance;
  const StateLayout layout = model.system->layout();
  const std::vector<int> features = {layout.q(0), layout.dq(0), layout.u(0)};
  const VectorXd root = growth_of(problem, states).cwiseSqrt();
  EXPECT_GT(root.maxCoeff(), 1);
  const MatrixXd E = directions_of(problem.prior, states, model.system->parameter_values());
  for (Index i = 0; i < states.cols(); ++i) {
    for (Index k = 0; k < states.cols(); ++k) {
      const VectorXd distance = (states.col(i) - states.col(k))(features).cwiseQuotient(discrepancy.lengthscale);
      const MatrixXd wanted = start * start * std::exp(-0.5 * (distance.squaredNorm() + std::pow(6 * (root[i] - root[k]), 2))) *
                              E.middleCols(2 * i, 2) * E.middleCols(2 * k, 2).transpose();
      EXPECT_LE((covariance.block(2 * i, 2 * k, 2, 2) - wanted).cwiseAbs().maxCoeff(), 20 * eps);
    }
  }
}

TEST(Discrepancy, TakesTheNoiseThatIsKnown) {
  FitProblemOptions stated;
  stated.noise_stddev = 0.5;
  const VectorXd variance = variance_in_noise(problem_of(bead(), stated), {0.5, 0.5});
  EXPECT_LE((variance.array() / (start * start) - 1).abs().maxCoeff(), 1e-12);
}

// Rows that hardly say anything change nothing.
TEST(Discrepancy, IsOfTheRowsThatSaySomething) {
  const auto with = [](double second) {
    const CsvTable log = log_of(bead());
    std::vector<double> stddev(static_cast<std::size_t>(log.n_rows()), 0.02);
    for (std::size_t i = 1; i < stddev.size(); i += 2) stddev[i] = second;
    std::vector<CsvTable::Column> columns = {{"ddx_std", stddev}, {"ddy_std", stddev}};
    for (const std::string& name : log.header()) {
      CsvTable::Column& column = columns.emplace_back(CsvTable::Column{name, {}});
      for (int i = 0; i < log.n_rows(); ++i) column.numbers.push_back(log.number(i, log.find(name)));
    }
    const FitProblem problem = make_fit_problem(bead(), CsvTable::from_columns("log.csv", std::move(columns)), {});
    return problem.prior_options.discrepancy->stddev;
  };
  const VectorXd good = with(0.02), poor = with(1e6);
  EXPECT_LE((poor.array() / (std::sqrt(2) * good.array()) - 1).abs().maxCoeff(), 1e-12);
}

TEST(Discrepancy, StaysAShareOfTheNoiseThatIsEstimated) {
  FitProblemOptions options;
  options.estimate_noise = true;
  for (const char* observed : {"", "ddy"}) {
    if (*observed != 0) options.observe = {observed};
    FitProblem problem = problem_of(bead("", "ddq = { estimate = true, initial = [0.2, 0.4] }"), options);
    std::vector<double> factor;
    for (Hyperparameter& h : problem.hyperparameters) {
      if (h.kind == Hyperparameter::Kind::noise_stddev) h.value *= factor.emplace_back(factor.empty() ? 3 : 0.25);
    }
    ASSERT_EQ(factor.size(), *observed != 0 ? 1U : 2U);
    const ModelValues values = model_values(problem.prior, problem.observations, problem.hyperparameters);
    // what is not observed goes with what is
    EXPECT_TRUE(values.signal_stddev.back().isApprox(start * Eigen::Vector2d(factor.front(), factor.back()), 4 * eps))
        << observed;

    // the gradient in the logarithm of a noise is that of the noise and of what follows it
    const Likelihood likelihood(problem.prior, problem.observations, values, {{}, true});
    Likelihood::Workspace workspace;
    ModelGradient gradient;
    likelihood.evaluate(values, &gradient, workspace);
    for (const Hyperparameter& h : problem.hyperparameters) {
      if (h.kind != Hyperparameter::Kind::noise_stddev && h.name != "discrepancy.size") continue;
      const auto at = [&](double step) {
        std::vector<Hyperparameter> moved = problem.hyperparameters;
        moved[static_cast<std::size_t>(&h - problem.hyperparameters.data())].value *= std::exp(step);
        return likelihood.evaluate(model_values(problem.prior, problem.observations, moved), nullptr, workspace);
      };
      const double slope = h.likelihood_slope(gradient);
      // rounding of 1e-13 × 1e3 over a step of 1e-5, and its square
      EXPECT_NEAR(slope, (at(1e-5) - at(-1e-5)) / 2e-5, 1e-5 * (1 + std::abs(slope))) << h.name;
    }
  }
}

TEST(Discrepancy, OfAnAccelerationThatNothingTellsOfHasTheShareOfItsSpreadThatOthersHave) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "y"]
[mechanics]
mass  = [["2", "0"], ["0", "8"]]
force = ["0", "0"]
[truth]
acceleration = ["-0.3*dx", "-0.3*dy"]
[sampling]
x  = [-1, 1]
y  = [-1, 1]
dx = [-1, 1]
dy = [-1, 1]
[noise]
ddq = 0.1
[[latent]]
features   = ["x", "dx"]
)toml",
                                   "two.toml");
  FitProblemOptions options;
  options.observe = {"ddx"};
  const FitProblem problem = problem_of(model, options);
  const VectorXd spread = default_scales(problem.prior, problem.observations).acceleration_stddev;
  const VectorXd& stddev = problem.prior_options.discrepancy->stddev;
  EXPECT_NEAR(stddev[0], 0.1, 8 * eps);
  EXPECT_NEAR(stddev[1], 0.1 / spread[0] * spread[1], 8 * eps);
}

TEST(Discrepancy, ThatDoesNotFitThePriorIsRefused) {
  const auto refused = [](Index n_lengthscales, Index n_stddevs) {
    PriorOptions options;
    options.discrepancy = Discrepancy{VectorXd::Ones(n_lengthscales), VectorXd::Ones(n_stddevs)};
    return input_error_of([&] { make_prior(bead(), options); });
  };
  EXPECT_EQ(refused(3, 2), "");
  EXPECT_EQ(refused(2, 2), "a discrepancy must hold 3 lengthscales and 2 standard deviations, got 2 and 2");
  EXPECT_EQ(refused(3, 1), "a discrepancy must hold 3 lengthscales and 2 standard deviations, got 3 and 1");
}

// ---- what it does

TEST(Discrepancy, HasNothingElseToTuneAndLeavesTheNamesAsTheyAre) {
  FitProblemOptions without;
  without.discrepancy = false;
  const FitProblem a = problem_of(bead()), b = problem_of(bead(), without);
  std::vector<std::string> names;
  ASSERT_EQ(a.hyperparameters.size(), b.hyperparameters.size() + 1);
  for (std::size_t k = 0; k < b.hyperparameters.size(); ++k) {
    const Hyperparameter &with = a.hyperparameters[k], &alone = b.hyperparameters[k];
    names.push_back(with.name);
    EXPECT_EQ(std::tie(with.name, with.unit, with.value, with.lower, with.upper, with.hyperprior.median, with.hyperprior.stddev),
              std::tie(alone.name, alone.unit, alone.value, alone.lower, alone.upper, alone.hyperprior.median,
                       alone.hyperprior.stddev));
  }
  EXPECT_THAT(names,
              ElementsAre("lengthscale(x)", "lengthscale(dx)", "lengthscale(u)", "signal_stddev(ddx)", "signal_stddev(ddy)"));
}

TEST(Discrepancy, AndTheModelsLatentTogetherAreThePosterior) {
  const Model model = bead();
  const FitProblem problem = problem_of(model);
  const Posterior posterior = start_of(problem);
  const MatrixXd states = some_states(model);
  for (const Quantity quantity : {Quantity::constrained_acceleration, Quantity::unconstrained_acceleration}) {
    const View all = view_of(problem.prior, quantity), first = view_of(problem.prior, quantity, 0),
               second = view_of(problem.prior, quantity, 1);
    const Posterior::Joint whole = posterior.joint(all, states);
    const Posterior::Joint parts = posterior.joint({{first, states}, {second, states}});
    const Index n = whole.mean.size();
    const auto block = [&](Index i, Index k) { return parts.covariance.block(i * n, k * n, n, n); };
    const double scale = block(0, 0).cwiseAbs().maxCoeff();
    EXPECT_LE((block(0, 0) + block(0, 1) + block(1, 0) + block(1, 1) - whole.covariance).cwiseAbs().maxCoeff(), 1e-12 * scale);
    // the data cannot tell them apart wholly
    EXPECT_GT(block(0, 1).cwiseAbs().maxCoeff(), 1e-6 * scale);
    // zero mean: what is left of the whole is L b
    const Posterior::Joint prior = posterior.without_data().joint(all, states);
    const VectorXd latents = parts.mean.head(n) + parts.mean.tail(n);
    EXPECT_LE((whole.mean - prior.mean - latents).cwiseAbs().maxCoeff(), 1e-12 * whole.mean.cwiseAbs().maxCoeff());
    // before data they are independent
    const Posterior::Joint before = posterior.without_data().joint({{first, states}, {second, states}});
    EXPECT_EQ(before.covariance.topRightCorner(n, n).cwiseAbs().maxCoeff(), 0);
  }
}

TEST(Discrepancy, NeverLowersAVarianceUnderTheSameHyperparameters) {
  const Model model = bead();
  FitProblemOptions options;
  options.discrepancy = false;
  const Posterior without = start_of(problem_of(model, options)), with = start_of(problem_of(model));
  const MatrixXd states = some_states(model);
  double largest = 0;
  for (const Quantity quantity : {Quantity::constrained_acceleration, Quantity::unconstrained_acceleration}) {
    const View view = view_of(with.prior(), quantity);
    const MatrixXd a = without.marginal(view, states).covariance, b = with.marginal(view, states).covariance;
    for (const Index entry : {0, 3}) {  // the variances
      EXPECT_GE((b - a).row(entry).minCoeff(), -1e-12 * a.row(entry).maxCoeff());
      largest = std::max(largest, (b - a).row(entry).maxCoeff());
    }
  }
  EXPECT_GT(largest, 1e-6);
}

TEST(Discrepancy, ActsUnderTheSystemsOfAllLogs) {
  const Model model = bead();
  const auto other = std::make_shared<const Model>(bead("", "ddq = [0.1, 0.3]", "y - sin(x)", "other.toml"));
  const FitProblem problem = make_fit_problem(model, {{log_of(model)}, {log_of(*other), other}}, {}, {});
  const std::shared_ptr<const OtherSystem>& other_system = problem.observations[1].view().other_system;
  ASSERT_NE(other_system, nullptr);
  ASSERT_EQ(other_system->prior.latents.size(), 2U);
  EXPECT_EQ(other_system->prior.latents[1].name, "discrepancy");
  // what the model's latent adds to ā before data is the same function in both systems
  const Posterior posterior = start_of(problem);
  View here = view_of(problem.prior, Quantity::unconstrained_acceleration, 0), there = here;
  there.other_system = other_system;
  const MatrixXd states = some_states(model);
  const Posterior::Joint joint = posterior.without_data().joint({{here, states}, {there, states}});
  const Index n = joint.mean.size() / 2;
  const double scale = joint.covariance.maxCoeff();
  EXPECT_LE((joint.covariance.topLeftCorner(n, n) - joint.covariance.topRightCorner(n, n)).cwiseAbs().maxCoeff(),
            8 * eps * scale);
  // the discrepancy obeys the constraint of each
  there.latent = 1;
  const MatrixXd covariance = posterior.without_data().joint(there, states).covariance;
  const MechanicsBatch mechanics = require_mechanics(*other->system, states, other->system->parameter_values());
  for (int i = 0; i < states.cols(); ++i)
    EXPECT_LE((mechanics.values.A(i) * covariance.block(2 * i, 2 * i, 2, 2)).cwiseAbs().maxCoeff(), 20 * eps * scale);

  const TemporaryFolder folder;
  file_of(model, problem).write(folder / "fit.json");
  const FitFile read = FitFile::read(folder / "fit.json");
  ASSERT_NE(read.observations[1].view().other_system, nullptr);
  EXPECT_EQ(read.observations[1].view().other_system->prior.latents.size(), 2U);
  const View ddq = view_of(problem.prior, Quantity::constrained_acceleration);
  EXPECT_EQ(read.posterior().marginal(ddq, states).covariance, posterior.marginal(ddq, states).covariance);
}

// ---- in a fit file

TEST(Discrepancy, ComesBackFromAFitFileBitForBit) {
  int n_tried = 0;
  for (const std::string& file : test::library_models()) {
    SCOPED_TRACE(file);
    const Model& model = test::model(file);
    const FitProblem problem = problem_of(model);
    const FitFile written = file_of(model, problem);
    const TemporaryFolder folder;
    written.write(folder / "fit.json");
    const FitFile read = FitFile::read(folder / "fit.json");
    ASSERT_EQ(read.prior_options.discrepancy.has_value(), problem.prior_options.discrepancy.has_value());
    if (!read.prior_options.discrepancy) continue;
    ++n_tried;
    EXPECT_EQ(read.prior_options.discrepancy->lengthscale, problem.prior_options.discrepancy->lengthscale);
    EXPECT_EQ(read.prior_options.discrepancy->stddev, problem.prior_options.discrepancy->stddev);
    const Posterior before = written.posterior(), after = read.posterior();
    EXPECT_EQ(before.negative_log_likelihood(), after.negative_log_likelihood());
    const MatrixXd states = some_states(model);
    for (const std::optional<int>& latent : {std::optional<int>(), std::optional(0), std::optional(1)}) {
      const View view = view_of(before.prior(), Quantity::unconstrained_acceleration, latent);
      EXPECT_EQ(before.mean(view, states), after.mean(view, states));
      EXPECT_EQ(before.marginal(view, states).covariance, after.marginal(view, states).covariance);
    }
    read.write(folder / "again.json");
    EXPECT_EQ(read_file(folder / "again.json"), read_file(folder / "fit.json"));
  }
  EXPECT_GE(n_tried, 3);
}

TEST(Discrepancy, ThatIsNoneInAFitFileIsRefused) {
  const TemporaryFolder folder;
  file_of(bead(), problem_of(bead())).write(folder / "fit.json");
  const Json whole = test::without_checksum(Json::parse(read_file(folder / "fit.json")));
  const auto error_after = [&](const std::function<void(Json&)>& damage) {
    Json json = whole;
    damage(json["prior"]["discrepancy"]);
    const auto path = folder.write("damaged.json", json.dump());
    const std::string error = input_error_of([&] { FitFile::read(path); });
    const std::string prefix = path.string() + ": ";
    EXPECT_TRUE(error.empty() || error.starts_with(prefix)) << error;
    return error.substr(std::min(prefix.size(), error.size()));
  };
  EXPECT_EQ(error_after([](Json&) {}), "");
  EXPECT_EQ(error_after([](Json& of) { of["lengthscale"].erase(0); }),
            "a discrepancy must hold 3 lengthscales and 2 standard deviations, got 2 and 2");
  EXPECT_EQ(error_after([](Json& of) { of["lengthscale"] = Json::array(); }),
            "lengthscale, stddev and half_range of the discrepancy must be from 1e-100 to 1e+100");
  EXPECT_EQ(error_after([](Json& of) { of["stddev"].push_back(1); }),
            "a discrepancy must hold 3 lengthscales and 2 standard deviations, got 3 and 3");
  EXPECT_EQ(error_after([](Json& of) { of["stddev"] = Json::array(); }),
            "a discrepancy must hold 3 lengthscales and 2 standard deviations, got 3 and 0");
  for (const char* key : {"lengthscale", "stddev", "half_range"}) {
    for (const double value : {0.0, -0.1, 1e-320, 1e300}) {
      EXPECT_EQ(error_after([&](Json& of) { of[key][1] = value; }),
                "lengthscale, stddev and half_range of the discrepancy must be from 1e-100 to 1e+100");
    }
    EXPECT_EQ(error_after([&](Json& of) { of[key][1] = nullptr; }), "null stands where a number must");
    EXPECT_EQ(error_after([&](Json& of) { of[key] = 1; }), "1 stands where an array must");
  }
  for (const char* key : {"lengthscale", "stddev", "centre"})
    EXPECT_THAT(error_after([&](Json& of) { of.erase(key); }), HasSubstr(key));
  EXPECT_EQ(error_after([](Json& of) { of["centre"].erase(0); }),
            "a discrepancy must hold as many centres and half ranges as lengthscales, 3, or none, got 2 and 3");
  EXPECT_THAT(error_after([](Json& of) { of = "some"; }), HasSubstr("not a whole fit file"));
}

}  // namespace
}  // namespace gp2
