#include "gp2/export/c_source.hpp"

#include <array>
#include <cstdlib>
#include <limits>
#include <memory>
#include <set>

#include <dlfcn.h>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "export/compiled.hpp"
#include "gp2/error.hpp"
#include "gp2/fit.hpp"
#include "gp2/mechanics/state_evaluator.hpp"
#include "gp2/predictor.hpp"
#include "gp2/prior/latent_spec.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"

// The exported C must be the Predictor.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;
using test::Exported;
using test::ExportedOf;
using test::input_error_of;
using test::largest;
using test::Problem;
using testing::HasSubstr;
using Quantity = View::Quantity;
using Status = Predictor::Status;

constexpr std::uint64_t export_seed = 191919;

// at states near the observed ones and, every fourth, far off, where a machine may be next to singular
MatrixXd random_states(const MatrixXd& observed, int n, std::uint64_t seed, double far_off = 1) {
  RandomStream random(seed);
  MatrixXd states(observed.rows(), n);
  for (Index i = 0; i < n; ++i) {
    const VectorXd from = observed.col(i % observed.cols()).array().isNaN().select(0, observed.col(i % observed.cols()));
    const double size = i % 4 == 3 ? far_off : 0.1;
    states.col(i) =
        from + size * test::random_vector(from.size(), random).cwiseProduct(VectorXd::Ones(from.size()) + from.cwiseAbs());
  }
  return states;
}

// the same numbers, and the same status; returns how many states had a prediction
// @param rounding  allowed for besides: of the state, next to a singular one, which is a pole of the mean, all that counts; and of the
//                  terms of the mean, as large as the prior where they cancel
int expect_predictor(const Posterior& posterior, const View& view, Exported& c, const MatrixXd& states, const Problem& p,
                     double rounding = 0) {
  const double tolerance = 1e-12 * std::max(1.0, 1e-3 * test::condition(p));
  const Predictor predictor(posterior, view), before(posterior.without_data(), view);
  Predictor::Workspace workspace = predictor.make_workspace(), workspace_before = before.make_workspace();
  const Index d = view.size(), n = states.rows();
  VectorXd mean(d), stddev(d), prior(d), c_mean(d), c_stddev(d);
  MatrixXd jacobian(d, n), c_jacobian(d, n);
  int n_good = 0;
  const bool had_failed = testing::Test::HasFailure();
  for (Index i = 0; i < states.cols(); ++i) {
    const VectorXd state = states.col(i);
    const Status status = predictor.mean_and_jacobian(state, mean, jacobian, workspace);
    EXPECT_EQ(c.mean_and_jacobian(state.data(), c_mean.data(), c_jacobian.data(), c.workspace()), static_cast<int>(status));
    EXPECT_EQ(predictor.mean_and_stddev(state, mean, stddev, workspace),
              c.mean_and_stddev(state.data(), c_mean.data(), c_stddev.data(), c.workspace()) == 0 ? Status::ok : status);
    if (status != Status::ok) {
      EXPECT_TRUE(std::isnan(c_mean[0]));
      continue;
    }
    ++n_good;
    static_cast<void>(before.mean_and_stddev(state, prior, prior, workspace_before));
    const double size = 1 + largest(mean), slope = largest(jacobian), moved = rounding * (1 + largest(state));
    EXPECT_LE(largest(c_mean - mean), tolerance * size + moved * slope + rounding * prior.maxCoeff());
    EXPECT_LE(largest(c_jacobian - jacobian), tolerance * (1 + slope) + moved * slope * slope / size);
    // a variance is a difference of numbers of the size of the prior's
    for (Index r = 0; r < d; ++r) {
      EXPECT_NEAR(c_stddev[r] * c_stddev[r], stddev[r] * stddev[r], tolerance * (prior.squaredNorm() + eps)) << r;
    }
    EXPECT_EQ(c.mean(state.data(), c_stddev.data(), c.workspace()), 0);
    EXPECT_EQ(c_stddev, c_mean);
    if (testing::Test::HasFailure() && !had_failed) {
      ADD_FAILURE() << "at state " << i << ": " << state.transpose();
      break;
    }
  }
  return n_good;
}

// the two compilers by turns, at a level that takes little time
std::string compiler(std::size_t turn) {
  return turn % 2 == 1 && std::system("clang --version >/dev/null 2>&1") == 0 ? "clang -O1" : "gcc -O1";
}

TEST(CSourceTest, IsThePredictorInEveryView) {
  int n_good = 0;
  std::size_t turn = 0;
  for (const Problem& p : test::problems(21, export_seed)) {
    const Posterior posterior(p.prior, p.observations, p.values);
    View view = View::all(Quantity::all()[turn++ % Quantity::all().size()], *p.prior.system);
    if (view.size() == 0) view = View::constrained_acceleration(*p.prior.system);
    if (view.quantity->needs_time_step()) view.time_step = 0.1;
    if (turn % 7 == 3) view.latent = static_cast<int>(p.prior.latents.size()) - 1;
    if (turn % 5 == 4) view.rows = {view.rows.back(), 0};
    for (const Observations& group : p.observations) {
      if (turn % 3 == 0 && group.view().other_system) view = group.view();
    }
    SCOPED_TRACE(fmt::format("{}, {} rows of {}, seed {}", p.name, view.size(), view.quantity->word(), export_seed));
    Exported c(export_c(posterior, view), "gp2_model", compiler(turn));
    EXPECT_EQ(c.self_test(c.workspace()), 0);
    n_good += expect_predictor(posterior, view, c, random_states(p.queries, 400, export_seed), p);
  }
  EXPECT_GT(n_good, 6000);
}

// the first problem of a name
Problem problem_of(const std::string& name) {
  for (const Problem& p : test::problems(21, export_seed)) {
    if (p.name.find(name) != std::string::npos) return p;
  }
  throw std::runtime_error("no problem " + name);
}

TEST(CSourceTest, IsThePredictorOfMixturesInducingPointsAndSums) {
  RandomStream random(export_seed);
  const Problem p = problem_of("surface");
  const View view = View::constrained_acceleration(*p.prior.system);
  const MatrixXd states = random_states(p.queries, 100, export_seed);

  const std::vector<ModelValues> draws = {p.values, test::random_values(p.prior, p.observations, random),
                                          test::random_values(p.prior, p.observations, random)};
  const Posterior mixture = Posterior::mixture(p.prior, p.observations, draws);
  Exported of_mixture(export_c(mixture, view), "gp2_model", "gcc -O2");
  EXPECT_EQ(of_mixture.self_test(of_mixture.workspace()), 0);
  EXPECT_GT(expect_predictor(mixture, view, of_mixture, states, p), 0);

  ModelValues inducing = p.values;
  const auto points = std::make_shared<InducingPoints>();
  for (std::size_t a = 0; a < p.prior.latents.size(); ++a) {
    points->features.push_back(evaluate_features(p.prior, a, p.observations[0].states()).topRows(5));
  }
  inducing.inducing = points;
  const Posterior through_points(p.prior, p.observations, inducing);
  Exported of_points(export_c(through_points, view), "gp2_model", "gcc -O2");
  EXPECT_EQ(of_points.self_test(of_points.workspace()), 0);
  EXPECT_GT(expect_predictor(through_points, view, of_points, states, p), 0);

  const Problem summed = test::with_sums(p, true, export_seed);
  const Posterior of_sums = test::posterior_of(summed);
  Exported c(export_c(of_sums, view), "gp2_model", "gcc -O2");
  EXPECT_EQ(c.self_test(c.workspace()), 0);
  EXPECT_GT(expect_predictor(of_sums, view, c, states, summed), 0);
}

const Model& model_with_every_kernel() {
  static const Model model = Model::parse(R"toml(
name        = "every kernel"
coordinates = ["x", "int"]
inputs      = ["u"]
[parameters]
v1 = 1.3
[mechanics]
mass  = [["2 + sin(int)", "0.3*x"], ["0.3*x", "v1"]]
force = ["-x*abs(dx)*dx + min(x, u)", "max(int, dx)^3 - sign(x)*sqrt(1 + int^2) + x^(-2)"]
[constraints]
acceleration = ["ddx*cos(int) + x*ddint - dx*dint"]
[[latent]]
kernel     = "se*periodic + matern32*linear + rq + matern52 + constant + periodic*matern32"
features   = ["x", "dint", "u^2"]
directions = [["x", "0"], ["v1", "exp(-int^2)"]]
[[latent]]
kernel     = "linear"
features   = ["x"]
directions = "force"
)toml",
                                          "every kernel");
  return model;
}

// Latents that read λ and that are positive, beside a linear one; with a row that repeats another; and with none that reads λ.
TEST(CSourceTest, IsThePredictorOfNonlinearLatents) {
  std::string damped = test::model_that_rubs().text;
  for (std::size_t at = damped.find("lambda("); at != std::string::npos; at = damped.find("lambda(", at))
    damped.insert(at + 6, "0");
  const std::string repeated =
      test::changed(test::model_that_rubs().text, {{"0.2*y^2\"]", "0.2*y^2\", \"2*z - 2*h*x^2 - 0.4*y^2\"]"}});
  const Model models[] = {test::model_that_rubs(), Model::parse(repeated, "repeated"), Model::parse(damped, "damped")};
  std::size_t turn = 0;
  for (const Model& model : models) {
    Problem p{
        model.name, make_prior(model, {Prior::Mean::force, std::nullopt}), {}, {}, test::draw(model, 25, export_seed).states, {}};
    const MatrixXd y = ModelMotion(model).acceleration(p.queries);
    p.observations.push_back(
        {p.queries, View::constrained_acceleration(*model.system), y, VectorXd::Constant(model.system->nq(), 0.01)});
    p.values = model_values(p.prior, p.observations, default_hyperparameters(p.prior, p.observations, {}, {}));
    const Posterior posterior(p.prior, p.observations, p.values);
    // one latent alone by turns too
    std::vector<View> views;
    for (const View::Quantity quantity : Quantity::all()) {
      views.push_back(View::all(quantity, *model.system));
      if (quantity->needs_time_step()) views.back().time_step = 0.1;
      if ((turn + views.size()) % 2 == 0) continue;
      views.push_back(views.back());
      views.back().latent = static_cast<int>(views.size() % p.prior.latents.size());
    }
    for (View& view : views) {
      if (turn % 3 == 2) view.rows = {view.rows.back(), 0};
      SCOPED_TRACE(fmt::format("{}, {} rows of {}, seed {}", model.name, view.size(), view.quantity->word(), export_seed));
      Exported c(export_c(posterior, view), "gp2_model", compiler(turn++));
      EXPECT_EQ(c.self_test(c.workspace()), 0);
      EXPECT_GT(expect_predictor(posterior, view, c, random_states(p.queries, 100, export_seed), p), 50);
    }
  }
}

// Friction along a wire does not press on it, so that what it adds to the constraint's force is rounding, and so is its deviation.
TEST(CSourceTest, TestsItselfWhereNothingOfALatentActs) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "z"]
[mechanics]
mass  = [["0.2", "0"], ["0", "0.2"]]
force = ["0", "-1.962"]
[constraints]
position = ["z - 0.5*x^2"]
[[latent]]
features   = ["dx"]
directions = { force = [["-dx"], ["-dz"]] }
[sampling]
x  = [-1, 1]
dx = [-1, 1]
[truth]
force = ["-0.1*dx", "-0.1*dz"]
)toml",
                                   "bead");
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  const MatrixXd states = test::draw(model, 20, export_seed).states, y = true_acceleration(model, states);
  const std::vector<Observations> observations = {
      {states, View::constrained_acceleration(*model.system), y, VectorXd::Constant(2, 0.01)}};
  const Posterior posterior(prior, observations,
                            model_values(prior, observations, default_hyperparameters(prior, observations, {}, {})));
  for (const View& view : {View::constraint_force(*model.system), View::multipliers(*model.system)}) {
    Exported c(export_c(posterior, view), "gp2_model", compiler(0));
    EXPECT_EQ(c.self_test(c.workspace()), 0) << view.quantity->word();
  }
}

// Loops over one coordinate, and no constraint, are C without a warning too.
TEST(CSourceTest, IsThePredictorOfOneCoordinate) {
  const Model model = Model::parse(R"toml(
name        = "a power"
coordinates = ["x"]
[mechanics]
mass  = [["2"]]
force = ["-(1 + x^2)^1.3 - (1 + abs(x))^(0.5 + 0.1*dx)"]
[[latent]]
features   = ["x", "dx"]
directions = "force"
[truth]
force = ["-dx"]
[sampling]
x  = [-1, 1]
dx = [-1, 1]
)toml",
                                   "power");
  const View view = View::constrained_acceleration(*model.system);
  const MatrixXd states = test::draw(model, 20, export_seed).states;
  Problem p{model.name, make_prior(model, {Prior::Mean::force, std::nullopt}), {}, {}, states, {}};
  RandomStream random(export_seed);
  p.observations.push_back(test::observe(model, view, states, random));
  p.values = test::random_values(p.prior, p.observations, random);
  const Posterior posterior = test::posterior_of(p);
  for (std::size_t turn = 0; turn < 2; ++turn) {
    Exported c(export_c(posterior, view), "gp2_model", compiler(turn));
    EXPECT_GT(expect_predictor(posterior, view, c, random_states(states, 400, export_seed), p), 300);
  }
}

// No piece of the C is left without a caller.
TEST(CSourceTest, APotentialAloneWithoutDeviationsIsCWithoutAWarning) {
  const Model model = Model::parse(R"toml(
coordinates = ["x"]
[mechanics]
mass = [["2"]]
[[latent]]
directions = "potential"
[truth]
force = ["-x^3"]
[sampling]
x = [-1, 1]
)toml",
                                   "spring");
  const View view = View::constrained_acceleration(*model.system);
  Problem p{model.name, make_prior(model, {Prior::Mean::force, std::nullopt}), {}, {}, test::draw(model, 20, export_seed).states,
            {}};
  RandomStream random(export_seed);
  p.observations.push_back(test::observe(model, view, p.queries, random));
  p.values = test::random_values(p.prior, p.observations, random);
  CSourceOptions options;
  for (const bool jacobian : {false, true}) {
    options.stddev = false;
    options.jacobian = jacobian;
    Exported c(export_c(test::posterior_of(p), view, options), "gp2_model", compiler(0));
    EXPECT_EQ(c.self_test(c.workspace()), 0);
  }
}

TEST(CSourceTest, NamesOfTheModelMayBeThoseOfFunctionsOfCAndWordsOfCpp) {
  const Model model = Model::parse(R"toml(
coordinates = ["square"]
inputs      = ["new"]
[parameters]
pow    = 2.5
fabs   = 0.3
sinf   = 0.7
FP_NAN = 0.2
[mechanics]
mass  = [["2 + sin(square)*sinf"]]
force = ["new - fabs*(square + dsquare + 1)^2 - abs(dsquare)*fabs - FP_NAN*dsquare - (square^2 + 4)^pow"]
[[latent]]
features   = ["square", "dsquare"]
directions = "force"
[truth]
force = ["-dsquare"]
[sampling]
square  = [-1, 1]
dsquare = [-1, 1]
new     = [-1, 1]
)toml",
                                   "names");
  const View view = View::constrained_acceleration(*model.system);
  Problem p{model.name, make_prior(model, {Prior::Mean::force, std::nullopt}), {}, {}, test::draw(model, 20, export_seed).states,
            {}};
  RandomStream random(export_seed);
  p.observations.push_back(test::observe(model, view, p.queries, random));
  p.values = test::random_values(p.prior, p.observations, random);
  const Posterior posterior = test::posterior_of(p);
  for (const bool portable : {false, true}) {
    CSourceOptions options;
    options.portable_math = portable;
    const CSource source = export_c(posterior, view, options);
    Exported c(source, "gp2_model", "gcc -O2 -ffp-contract=off");
    EXPECT_EQ(c.self_test(c.workspace()), 0) << portable;
    const test::TemporaryFolder folder;
    static_cast<void>(folder.write("gp2_model.h", source.header));
    const std::filesystem::path cpp = folder.write("gp2_model.cpp", source.source);
    EXPECT_EQ(std::system(("g++ -fsyntax-only '" + cpp.string() + "'").c_str()), 0) << portable;
  }
}

TEST(CSourceTest, TellsWhereAConstraintIsObeyed) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "y", "z"]
[mechanics]
mass = [["0.2", "0", "0"], ["0", "0.2", "0"], ["0", "0", "0.2"]]
[constraints]
position = [{ expr = "z - 0.5*x^2", when = "x <= 0" }]
velocity = ["dx + dy"]
[[latent]]
features   = ["dx"]
directions = "force"
)toml",
                                   "bead");
  const View view = View::constrained_acceleration(*model.system);
  RandomStream random(export_seed);
  Problem p{model.name, make_prior(model, {Prior::Mean::force, std::nullopt}), {}, {}, test::random_matrix(7, 12, random), {}};
  p.observations.push_back(test::observe(model, view, p.queries, random));
  p.values = test::random_values(p.prior, p.observations, random);
  EXPECT_THAT(export_c(test::posterior_of(p), view).header,
              HasSubstr(" * It obeys z - 0.5*x^2 = 0 where x <= 0.\n * It obeys dx + dy = 0.\n"));
}

// What is left of terms that cancel is rounded as these are.
TEST(CSourceTest, IsThePredictorWhereALoadIsAboutToChangeItsSign) {
  const Model& model = test::model("experiments/mechanisms/rubbing_bead.toml");
  Problem p{model.name, make_prior(model, {Prior::Mean::force, std::nullopt}), {}, {}, test::draw(model, 25, export_seed).states,
            {}};
  const View ddq = View::constrained_acceleration(*model.system), load = View::multipliers(*model.system);
  p.observations.push_back({p.queries, ddq, ModelMotion(model).acceleration(p.queries), VectorXd::Constant(2, 0.01)});
  p.values = model_values(p.prior, p.observations, default_hyperparameters(p.prior, p.observations, {}, {}));
  const Posterior posterior(p.prior, p.observations, p.values);
  const Predictor predictor(posterior, load);
  Predictor::Workspace workspace = predictor.make_workspace();
  // of each state the push at which nothing is left of the load, nearly
  MatrixXd states = p.queries.replicate(1, 4);
  const Index push = states.rows() - 1;
  for (Index i = 0; i < states.cols(); ++i) {
    VectorXd low = states.col(i), high = low, at(1);
    low[push] = -100;
    high[push] = 100;
    ASSERT_EQ(predictor.mean(low, at, workspace), Status::ok);
    if (at[0] > 0) low.swap(high);
    for (Index step = 0; step < 12 + 3 * (i / p.queries.cols()); ++step) {
      states.col(i) = 0.5 * (low + high);
      ASSERT_EQ(predictor.mean(states.col(i), at, workspace), Status::ok);
      (at[0] < 0 ? low : high) = states.col(i);
    }
  }
  Exported c(export_c(posterior, ddq), "gp2_model", compiler(0));
  EXPECT_EQ(expect_predictor(posterior, ddq, c, states, p), states.cols());
}

class EveryModel : public testing::TestWithParam<std::string> {};

// Of a fit by the file's prior; of models with an even number of coordinates a mixture.
TEST_P(EveryModel, ExportedIsThePredictorAtTenThousandStates) {
  const Model& model = test::model(GetParam());
  const GeneratedData data = test::draw(model, 40, export_seed);
  RandomStream random(export_seed);
  const double size = std::sqrt(data.accelerations.array().square().mean());
  const MatrixXd noise = 0.01 * size * test::random_matrix(data.accelerations.rows(), data.accelerations.cols(), random);
  Problem p{GetParam(), make_prior(model, {Prior::Mean::force, std::nullopt}), {}, {}, data.states, {}};
  p.observations.push_back({data.states, View::constrained_acceleration(*model.system), data.accelerations + noise,
                            VectorXd::Constant(model.system->nq(), 0.01 * size)});
  FitOptions options;
  options.n_restarts = 2;
  options.n_draws = model.system->nq() % 2 == 0 ? 4 : 0;
  const Posterior posterior =
      fit(p.prior, p.observations, default_hyperparameters(p.prior, p.observations, {}, {}), options).posterior;
  p.values = posterior.values();
  const View view = View::constrained_acceleration(*model.system);
  Exported c(export_c(posterior, view), "gp2_model", compiler(static_cast<std::size_t>(model.system->nq())));
  EXPECT_EQ(c.self_test(c.workspace()), 0);
  EXPECT_GT(expect_predictor(posterior, view, c, random_states(p.queries, 10000, export_seed, 0.2), p, 64 * eps), 5000);
}
INSTANTIATE_TEST_SUITE_P(CSourceTest, EveryModel, testing::ValuesIn(test::model_files({"models", "experiments/mechanisms"})),
                         test::model_test_name);

TEST(CSourceTest, HasEveryKernelAndEveryOperation) {
  const Model& model = model_with_every_kernel();
  Problem p;
  p.name = "every kernel";
  p.prior = make_prior(model, {Prior::Mean::force, std::nullopt, false, Discrepancy{{}, Eigen::Vector2d(0.3, 0.7)}});
  RandomStream random(export_seed);
  const MatrixXd states = test::random_matrix(6, 15, random);
  p.observations = {test::observe(model, View::constrained_acceleration(*model.system), states, random)};
  p.values = test::random_values(p.prior, p.observations, random);
  const Posterior posterior = test::posterior_of(p);
  for (const std::size_t turn : {0U, 1U}) {
    Exported c(export_c(posterior, View::constrained_acceleration(*model.system)), "gp2_model", compiler(turn));
    EXPECT_EQ(c.self_test(c.workspace()), 0);
    EXPECT_GT(expect_predictor(posterior, View::constrained_acceleration(*model.system), c,
                               random_states(states, 200, export_seed), p, 64 * eps),
              150);
  }
}

TEST(CSourceTest, ObeysTheConstraint) {
  const Problem p = problem_of("double_pendulum");
  const System& system = *p.prior.system;
  const Posterior posterior = test::posterior_of(p);
  Exported c(export_c(posterior, View::constrained_acceleration(system), {.stddev = false}), "gp2_model", "gcc -O2");
  EXPECT_EQ(c.mean_and_stddev, nullptr);
  const auto at = system.make_evaluator(p.values.parameters, false);
  VectorXd ddq(system.nq());
  const MatrixXd states = random_states(p.queries, 100, export_seed);
  for (const VectorXd state : states.colwise()) {
    MatrixXd jacobian(system.nq(), state.size());
    ASSERT_EQ(c.mean_and_jacobian(state.data(), ddq.data(), jacobian.data(), c.workspace()), 0);
    at->evaluate(state);
    EXPECT_LE(largest(at->A() * ddq - at->b()), 100 * eps * (1 + largest(at->A())) * (1 + largest(ddq)));
  }
}

// a state without a prediction has the Predictor's status: an entry that is not finite, rows that contradict each other, no mass
TEST(CSourceTest, SaysWhatAStateIsLike) {
  const Model model = Model::parse(R"toml(
name        = "two on a line"
coordinates = ["x", "y"]
[mechanics]
mass  = [["x", "0"], ["0", "1"]]
force = ["0", "-y"]
[constraints]
acceleration = ["ddx - ddy", "ddx - ddy + y - 1"]
[[latent]]
kernel     = "se"
features   = ["x", "dy"]
directions = "force"
)toml",
                                   "two on a line");
  Problem p;
  p.prior = make_prior(model, {Prior::Mean::force, std::nullopt, false});
  RandomStream random(export_seed);
  MatrixXd states = test::random_matrix(5, 6, random).cwiseAbs();
  states.row(1).setOnes();
  p.observations = {{states, View::constrained_acceleration(*model.system), MatrixXd(test::random_matrix(2, 6, random)),
                     VectorXd::Constant(2, 0.3), false}};
  p.values = test::random_values(p.prior, p.observations, random);
  const Posterior posterior = test::posterior_of(p);
  const View view = View::constrained_acceleration(*model.system);
  const Predictor predictor(posterior, view);
  Predictor::Workspace workspace = predictor.make_workspace();
  Exported c(export_c(posterior, view), "gp2_model", "gcc -O2");
  const double nan = std::numeric_limits<double>::quiet_NaN();
  std::set<Status> seen;
  for (const auto& [x, y, dy] :
       std::vector<std::array<double, 3>>{{1, 1, 1}, {0, 1, 1}, {1, 5, 1}, {-9, 1, 1}, {nan, 1, 1}, {1, 1, nan}}) {
    const VectorXd state = Eigen::Vector<double, 5>(x, y, 0, dy, 0);
    VectorXd mean(2), c_mean(2);
    const Status status = predictor.mean(state, mean, workspace);
    EXPECT_EQ(c.mean(state.data(), c_mean.data(), c.workspace()), static_cast<int>(status)) << state.transpose();
    EXPECT_EQ(std::isnan(c_mean[0]), status != Status::ok);
    seen.insert(status);
  }
  EXPECT_GE(seen.size(), 4U);
}

// The variance is a square, and overflows before the mean does.
TEST(CSourceTest, AnOverflowOfTheDeviationAloneIsAStatus) {
  const Model model = Model::parse(R"toml(
name        = "cart"
coordinates = ["x"]
[mechanics]
mass = [["1"]]
[[latent]]
kernel     = "linear"
features   = ["x"]
directions = "force"
)toml",
                                   "cart");
  Problem p;
  p.prior = make_prior(model, {});
  RandomStream random(export_seed);
  p.observations = {{test::random_matrix(3, 6, random), View::constrained_acceleration(*model.system),
                     MatrixXd(test::random_matrix(1, 6, random)), VectorXd::Constant(1, 0.3), false}};
  p.values = test::random_values(p.prior, p.observations, random);
  Exported c(export_c(test::posterior_of(p), View::constrained_acceleration(*model.system)), "gp2_model", "gcc -O2");
  const VectorXd state = Eigen::Vector3d(1e200, 0, 0);
  double mean = 0, stddev = 0;
  EXPECT_EQ(c.mean(state.data(), &mean, c.workspace()), static_cast<int>(Status::ok));
  EXPECT_EQ(c.mean_and_stddev(state.data(), &mean, &stddev, c.workspace()), static_cast<int>(Status::not_finite));
  EXPECT_TRUE(std::isnan(mean) && std::isnan(stddev));
}

TEST(CSourceTest, TestsItself) {
  Problem p = problem_of("surface");
  const View view = View::constrained_acceleration(*p.prior.system);
  // weights that cancel are no fault of the compiler …
  for (VectorXd& noise : p.values.noise_stddev) noise *= 1e-4;
  CSource c = export_c(test::posterior_of(p), view);
  Exported sound(c, "gp2_model", compiler(1) + " -ffp-contract=fast");
  EXPECT_EQ(sound.self_test(sound.workspace()), 0);
  // … and one that is another is seen
  const std::size_t weights = c.source.find("{\n  ", c.source.find("real weights_0_0["));
  c.source.insert(weights + 4, "1.0 + ");
  Exported broken(c, "gp2_model", "gcc -O2");
  EXPECT_NE(broken.self_test(broken.workspace()), 0);
}

TEST(CSourceTest, RunsUnderTheSanitizers) {
  const Problem p = problem_of("unicycle");
  const CSource c = export_c(test::posterior_of(p), View::all(Quantity::multipliers, *p.prior.system));
  const test::TemporaryFolder folder;
  static_cast<void>(folder.write("gp2_model.h", c.header));
  static_cast<void>(folder.write("gp2_model.c", c.source));
  static_cast<void>(folder.write("main.c", R"c(#include "gp2_model.h"
static gp2_model_workspace w;
int main(void)
{
  return gp2_model_self_test(&w);
}
)c"));
  const std::string build =
      "cd '" + folder.path().string() +
      "' && gcc -std=c99 -O1 -g -fsanitize=address,undefined -fno-sanitize-recover=all *.c -lm -o run && ./run";
  EXPECT_EQ(std::system(build.c_str()), 0);
}

TEST(CSourceTest, InSinglePrecisionIsRefusedWhereItWouldShow) {
  Problem p = problem_of("surface");
  const View view = View::constrained_acceleration(*p.prior.system);
  CSourceOptions options;
  options.single_precision = true;
  const Posterior posterior = test::posterior_of(p);
  ExportedOf<float> c(export_c(posterior, view, options), "gp2_model", "gcc -O2");
  EXPECT_EQ(c.self_test(c.workspace()), 0);
  const Predictor predictor(posterior, view);
  Predictor::Workspace workspace = predictor.make_workspace();
  VectorXd mean(view.size());
  Eigen::VectorXf c_mean(view.size());
  for (const VectorXd state : p.observations[0].states().colwise()) {
    ASSERT_EQ(predictor.mean(state, mean, workspace), Status::ok);
    const Eigen::VectorXf single = state.cast<float>();
    ASSERT_EQ(c.mean(single.data(), c_mean.data(), c.workspace()), 0);
    EXPECT_LE(largest(c_mean.cast<double>() - mean), 1e-4 * (1 + largest(mean)));
  }

  for (VectorXd& noise : p.values.noise_stddev) noise *= 1e-4;
  for (VectorXd& kernel : p.values.kernel) kernel *= 5;
  EXPECT_THAT(input_error_of([&] { static_cast<void>(export_c(test::posterior_of(p), view, options)); }),
              testing::AllOf(HasSubstr("export to C: in single precision the mean would be off by up to "),
                             HasSubstr(" cancel. Fewer rows or a larger noise help, or leave `float` out")));
}

// What was observed is the prior's mean, so that there are no weights that could cancel.
TEST(CSourceTest, InSinglePrecisionIsRefusedWhereTheVarianceWouldBeRounding) {
  Problem p = problem_of("surface");
  const View view = View::constrained_acceleration(*p.prior.system);
  const MatrixXd states = p.observations[0].states();
  p.observations = {
      {states, view, test::posterior_of(p).without_data().mean(view, states), VectorXd::Constant(view.size(), 0.3)}};
  RandomStream random(export_seed);
  p.values = test::random_values(p.prior, p.observations, random);
  for (VectorXd& noise : p.values.noise_stddev) noise *= 1e-4;
  CSourceOptions options;
  options.single_precision = true;
  const Posterior posterior = test::posterior_of(p);
  EXPECT_THAT(input_error_of([&] { static_cast<void>(export_c(posterior, view, options)); }),
              testing::AllOf(HasSubstr("export to C: in single precision the variance would be off by up to "),
                             HasSubstr("leave the standard deviation or `float` out")));
  options.stddev = false;
  EXPECT_EQ(input_error_of([&] { static_cast<void>(export_c(posterior, view, options)); }), "");
}

// seven digits hold no second of a Unix time
TEST(CSourceTest, InSinglePrecisionIsRefusedWhereStatesAreTooCoarse) {
  const Model model = Model::parse(R"toml(
name        = "cart that is shaken"
coordinates = ["x"]
[mechanics]
mass  = [["1"]]
force = ["cos(2*t)"]
[[latent]]
kernel   = "se"
features = ["x"]
)toml",
                                   "cart that is shaken");
  CSourceOptions options;
  options.single_precision = true;
  const auto error_at = [&](double start) {
    Problem p;
    p.prior = make_prior(model, {Prior::Mean::force, std::nullopt, false});
    RandomStream random(export_seed);
    MatrixXd states = test::random_matrix(3, 6, random);
    states.row(2) = Eigen::RowVectorXd::LinSpaced(6, start, start + 5);
    p.observations = {{states, View::constrained_acceleration(*model.system), MatrixXd(test::random_matrix(1, 6, random)),
                       VectorXd::Constant(1, 0.3), false}};
    p.values = test::random_values(p.prior, p.observations, random);
    const Posterior posterior = test::posterior_of(p);
    return input_error_of(
        [&] { static_cast<void>(export_c(posterior, View::constrained_acceleration(*model.system), options)); });
  };
  EXPECT_EQ(error_at(0), "");
  EXPECT_THAT(error_at(1.7e9), HasSubstr("in single precision the states themselves are too coarse"));
}

// The last row follows from the others only where x and y are on the circle to all digits.
TEST(CSourceTest, InSinglePrecisionIsRefusedWhereRedundantRowsBecomeIndependent) {
  const Model model = Model::parse(R"toml(
name        = "bead on a wheel"
coordinates = ["x", "y", "phi"]
[mechanics]
mass = [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "2"]]
[constraints]
position = ["x - cos(phi)", "y - sin(phi)"]
velocity = ["x*dx + y*dy"]
[[latent]]
features   = ["dphi"]
directions = "force"
)toml",
                                   "bead on a wheel");
  Problem p;
  p.prior = make_prior(model, {});
  RandomStream random(export_seed);
  MatrixXd states = test::random_matrix(7, 6, random);
  states.row(0) = states.row(2).array().cos();
  states.row(1) = states.row(2).array().sin();
  states.row(3) = -states.row(1).cwiseProduct(states.row(5));
  states.row(4) = states.row(0).cwiseProduct(states.row(5));
  const View view = View::constrained_acceleration(*model.system);
  p.observations = {{states, view, MatrixXd(test::random_matrix(3, 6, random)), VectorXd::Constant(3, 0.3), false}};
  p.values = test::random_values(p.prior, p.observations, random);
  CSourceOptions options;
  options.single_precision = true;
  EXPECT_THAT(
      input_error_of([&] { static_cast<void>(export_c(test::posterior_of(p), view, options)); }),
      HasSubstr("export to C: in single precision redundant constraints are no longer redundant: rounding a state takes the "
                "rank of A from 2 to 3. Leave out rows that follow from others, or leave `float` out"));
}

// Measured states, where the second row seems to be independent of the first, and the third comes and goes.
TEST(CSourceTest, KnowsRedundantRowsBesideAConditionalOne) {
  const Model model = Model::parse(R"toml(
coordinates = ["x", "y", "z"]
inputs      = ["touch"]
[mechanics]
mass  = [["1", "0", "0"], ["0", "2", "0"], ["0", "0", "1"]]
force = ["-x", "1", "-9.81"]
[constraints]
position = ["x - y", "sin(x) - sin(y)", { expr = "z - 0.1*x", contact = "touch" }]
[[latent]]
kernel     = "se"
features   = ["dx", "dz"]
directions = "force"
)toml",
                                   "carts");
  RandomStream random(export_seed);
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
  const View view = View::constrained_acceleration(*model.system);
  Problem p{model.name, make_prior(model, {Prior::Mean::force, std::nullopt, false}), {}, {}, states, {}};
  p.observations.push_back(test::observe(model, view, states, random));
  p.values = test::random_values(p.prior, p.observations, random);
  const Posterior posterior = test::posterior_of(p);
  const CSource source = export_c(posterior, view);
  EXPECT_THAT(source.source, HasSubstr("w->rank > 1 + (w->row_scale[2] != 0);"));
  Exported c(source, "gp2_model", "gcc -O1");
  EXPECT_EQ(c.self_test(c.workspace()), 0);
  MatrixXd measured = states.replicate(1, 8);
  for (double& entry : measured.topRows(6).reshaped()) entry += 1e-4 * (2 * random.uniform() - 1);
  EXPECT_EQ(expect_predictor(posterior, view, c, measured, p), measured.cols());
}

TEST(CSourceTest, IsNotCompiledWithoutNaN) {
  const CSource c = export_c(test::posterior_of(problem_of("surface")), problem_of("surface").observations[0].view());
  for (const char* const option : {"-ffast-math", "-ffinite-math-only"}) {
    std::string error;
    try {
      const Exported compiled(c, "gp2_model", std::string("gcc -O1 ") + option);
    } catch (const std::runtime_error& refused) {
      error = refused.what();
    }
    EXPECT_THAT(error, HasSubstr("compile without -ffast-math and -ffinite-math-only")) << option;
  }
}

TEST(CSourceTest, SaysWhyNoStateHasAPrediction) {
  const Model model = Model::parse(R"toml(
name        = "massless"
coordinates = ["x", "y"]
[mechanics]
mass  = [["1", "0"], ["0", "0"]]
force = ["-x", "0"]
[constraints]
position = ["y - x"]
[[latent]]
features   = ["x", "dx"]
directions = "force"
)toml",
                                   "massless");
  Problem p;
  p.prior = make_prior(model, {Prior::Mean::force, std::nullopt, false});
  RandomStream random(export_seed);
  MatrixXd states = test::random_matrix(5, 6, random);
  states.row(1) = states.row(0);
  states.row(3) = states.row(2);
  p.observations = {{states, View::constrained_acceleration(*model.system), MatrixXd(test::random_matrix(2, 6, random)),
                     VectorXd::Constant(2, 0.3), false}};
  p.values = test::random_values(p.prior, p.observations, random);
  const View view = View::all(Quantity::unconstrained_acceleration, *model.system);
  EXPECT_THAT(
      input_error_of([&] { static_cast<void>(export_c(test::posterior_of(p), view)); }),
      testing::AllOf(HasSubstr("no observed state has a prediction of this view, so that there is nothing to test it by: "),
                     HasSubstr("the mass matrix M is singular")));
}

TEST(CSourceTest, SaysWhatCannotBeWritten) {
  const Problem p = problem_of("surface");
  const View view = View::constrained_acceleration(*p.prior.system);
  CSourceOptions options;
  for (const char* const name : {"double", "evaluate"}) {
    options.name = name;
    EXPECT_THAT(input_error_of([&] { static_cast<void>(export_c(test::posterior_of(p), view, options)); }),
                HasSubstr(fmt::format(
                    "`name`: must be a name of C, of letters, digits and _, that the code does not use itself, got '{}'", name)));
  }
  EXPECT_THAT(input_error_of([&] { static_cast<void>(export_c(test::posterior_of(p).without_data(), view)); }),
              HasSubstr("export to C: nothing was observed"));

  const Model& model = test::model("models/surface.toml");
  LatentSpec code;
  code.name = "from code";
  code.kernel = "se";
  code.features = {"x"};
  code.feature_code.evaluate = [](const auto& states, const auto& /*parameters*/) { return MatrixXd(states.topRows(1)); };
  Problem coded;
  coded.prior = make_prior(model.system, {code});
  RandomStream random(export_seed);
  coded.observations = {test::observe(model, view, p.queries, random)};
  coded.values = test::random_values(coded.prior, coded.observations, random);
  EXPECT_THAT(input_error_of([&] { static_cast<void>(export_c(test::posterior_of(coded), view)); }),
              HasSubstr("export to C: features of latent 'from code' are code, which has no text"));
}

}  // namespace
}  // namespace gp2
