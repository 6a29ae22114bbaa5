#include <gmock/gmock.h>

#include "gp2/error.hpp"
#include "gp2/fit.hpp"
#include "gp2/inference/evaluation.hpp"
#include "inference/pooled_surfaces.hpp"
#include "inference/problems.hpp"

// The same latents observed and predicted under other systems, and told apart.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::Problem;
using test::under;
using Quantity = View::Quantity;

constexpr std::uint64_t transfer_seed = 40403;

/// Problems with an observation of another system, and that system.
struct Elsewhere {
  Problem problem;
  std::shared_ptr<const OtherSystem> other_system;
};

std::vector<Elsewhere> problems_elsewhere() {
  std::vector<Elsewhere> all;
  for (Problem& p : test::problems(12, transfer_seed)) {
    for (const Observations& group : p.observations) {
      if (!group.view().other_system) continue;
      all.push_back({p, group.view().other_system});
      break;
    }
  }
  return all;
}

double size_of(const MatrixXd& matrix) { return 1 + matrix.cwiseAbs().maxCoeff(); }

TEST(TransferTest, PredictsTheAccelerationOfTheOtherConstraint) {
  int n = 0;
  for (const auto& [p, other_system] : problems_elsewhere()) {
    SCOPED_TRACE(fmt::format("{}, mean {}, seed {}", p.name, static_cast<int>(p.prior.mean), transfer_seed));
    ++n;
    const Posterior posterior(p.prior, p.observations, p.values);
    const System& there = *other_system->prior.system;
    const View ddq = under(View::all(Quantity::constrained_acceleration, there), other_system);
    const View a_bar = under(View::all(Quantity::unconstrained_acceleration, there), other_system);
    const Posterior::Joint joint = posterior.joint({{ddq, p.queries}, {a_bar, p.queries}});
    const MechanicsBatch mechanics = require_mechanics(there, p.queries, other_system->parameters(p.values.parameters));
    const Index nq = there.nq(), N = p.queries.cols();
    // [ddq; ā] of each state: ddq = L'b' + T'ā
    MatrixXd T = MatrixXd::Zero(nq * N, nq * N);
    VectorXd Lb(nq * N);
    for (Index i = 0; i < N; ++i) {
      const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
      T.block(i * nq, i * nq, nq, nq) = projection.T();
      Lb.segment(i * nq, nq) = projection.Lb();
    }
    const auto of_a_bar = joint.covariance.bottomRightCorner(nq * N, nq * N);
    const double rounding = 1e3 * test::eps * size_of(joint.covariance) * size_of(T) * size_of(T) + 1e-14 * test::condition(p);
    EXPECT_LE((joint.mean.head(nq * N) - (Lb + T * joint.mean.tail(nq * N))).cwiseAbs().maxCoeff(),
              1e3 * test::eps * size_of(joint.mean) * size_of(T));
    EXPECT_LE((joint.covariance.topLeftCorner(nq * N, nq * N) - T * of_a_bar * T.transpose()).cwiseAbs().maxCoeff(), rounding);
    EXPECT_LE(
        max_constraint_error(there, p.queries, other_system->parameters(p.values.parameters), posterior.mean(ddq, p.queries)),
        1e4 * test::eps * size_of(joint.mean) * size_of(mechanics.values.constraint_matrix));
  }
  EXPECT_GE(n, 6);
}

TEST(TransferTest, AgreesWithTheTextbookProcess) {
  for (const auto& [p, other_system] : problems_elsewhere()) {
    SCOPED_TRACE(fmt::format("{}, mean {}, seed {}", p.name, static_cast<int>(p.prior.mean), transfer_seed));
    const Posterior posterior(p.prior, p.observations, p.values);
    for (const Quantity quantity : {Quantity::constrained_acceleration, Quantity::unconstrained_acceleration,
                                    Quantity::constraint_force, Quantity::multipliers}) {
      const View view = under(View::all(quantity, *other_system->prior.system), other_system);
      const auto [mean, covariance] = test::dense_posterior(p, view, p.queries);
      const Posterior::Joint joint = posterior.joint(view, p.queries);
      const double tolerance = 1e3 * test::eps * test::condition(p);
      EXPECT_LE((joint.mean - mean).cwiseAbs().maxCoeff(), tolerance * size_of(mean));
      EXPECT_LE((joint.covariance - covariance).cwiseAbs().maxCoeff(), tolerance * size_of(covariance));
    }
  }
}

TEST(TransferTest, ToTheSameSystemIsThePlainPredictionBitByBit) {
  for (const std::string& file : test::library_models()) {
    SCOPED_TRACE(file);
    const Model& model = test::model(file);
    for (const Problem& p : test::problems(9, transfer_seed)) {
      if (p.name != test::stem(file) + ", force as mean") continue;
      const Posterior posterior(p.prior, p.observations, p.values);
      PriorOptions options;
      options.mean = p.prior.mean;
      // read anew, as a command does
      const auto same = make_other_system(model, Model::parse(model.text, model.name), options);
      for (const Quantity quantity :
           {Quantity::constrained_acceleration, Quantity::unconstrained_acceleration, Quantity::multipliers}) {
        const View view = View::all(quantity, *model.system);
        EXPECT_EQ(posterior.mean(under(view, same), p.queries), posterior.mean(view, p.queries));
        EXPECT_EQ(posterior.marginal(under(view, same), p.queries).covariance, posterior.marginal(view, p.queries).covariance);
      }
    }
  }
}

TEST(TransferTest, AFittedParameterGoesAlongWhereItIsShared) {
  const Model& home = test::model("models/surface.toml");
  const auto other_system = make_other_system(home, test::another_surface());
  Problem p = [] {
    for (Problem& problem : test::problems(9, transfer_seed)) {
      if (problem.name == "surface, every row") return problem;
    }
    throw std::logic_error("no such problem");
  }();
  p.values.parameters[home.system->parameter_index("p5")] = 2.7;   // shared
  p.values.parameters[home.system->parameter_index("p4")] = 0.19;  // not
  const Posterior posterior(p.prior, p.observations, p.values);
  const View ddq = under(View::all(Quantity::constrained_acceleration, *home.system), other_system);
  VectorXd expected = test::another_surface().system->parameter_values();
  expected[test::another_surface().system->parameter_index("p5")] = 2.7;
  EXPECT_LE(max_constraint_error(*other_system->prior.system, p.queries, expected, posterior.mean(ddq, p.queries)), 1e-11);
  EXPECT_EQ(expected[test::another_surface().system->parameter_index("p4")], 0.15);
}

TEST(EvaluationTest, MeasuresTheConstraintOfTheOtherSystem) {
  const Model& home = test::model("models/surface.toml");
  const auto other_system = make_other_system(home, test::another_surface());
  for (const Problem& p : test::problems(9, transfer_seed)) {
    if (p.name != "surface, every row") continue;
    const Posterior posterior(p.prior, p.observations, p.values);
    const MatrixXd targets = MatrixXd::Random(3, p.queries.cols());
    const Evaluation there = evaluate_predictions(posterior, p.queries, {0, 1, 2}, targets, {other_system});
    EXPECT_LE(there.max_constraint_error, 1e-11);
    EXPECT_LE(there.max_constraint_error_fitted, 1e-11);
    EXPECT_GT((there.rmse - evaluate_predictions(posterior, p.queries, {0, 1, 2}, targets).rmse).norm(), 1e-3);
  }
}

TEST(EvaluationTest, NormalisesByTheSpreadOfAllLogs) {
  for (const Problem& p : test::problems(12, transfer_seed)) {
    if (p.name != "surface, pooled with another surface") continue;
    const Posterior posterior(p.prior, p.observations, p.values);
    MatrixXd all(3, p.observations[0].n_data() + p.observations[1].n_data());
    all << p.observations[0].values(), p.observations[1].values();
    const Evaluation e = evaluate_predictions(posterior, p.queries, {0, 1, 2}, MatrixXd::Random(3, p.queries.cols()));
    EXPECT_NEAR(e.rmse_normalised, e.rmse.cwiseQuotient(row_stddev(all)).mean(), 1e-12 * e.rmse_normalised);
  }
}

// ---- several latents at once

/// A sledge on a wavy track: drag that grows with the speed, and a motor of unknown curve.
const Model& sledge_with_motor() {
  static const Model model = Model::parse(R"toml(
coordinates = ["x", "y"]
inputs      = ["u"]
[let]
drag = "0.4 + 0.2*(dx^2 + dy^2)"
[mechanics]
mass  = [[2, 0], [0, 2]]
force = ["0", "-2*9.81"]
[constraints]
position = ["0.3*sin(2*x) - y"]
[[latent]]
name       = "friction"
kernel     = "se"
features   = ["dx", "dy"]
directions = { force = [["-dx"], ["-dy"]] }
[[latent]]
name       = "drive"
kernel     = "se"
features   = ["u"]
directions = { force = [["1"], ["0"]] }
[noise]
ddq = 0.02
[truth]
acceleration = ["(-drag*dx + 3*tanh(u))/2", "-drag*dy/2"]
[sampling]
x  = [-2, 2]
dx = [-2, 2]
u  = [-3, 3]
)toml",
                                          "sledge with motor");
  return model;
}

TEST(SeveralLatents, AreToldApartWhereTheirDirectionsAndFeaturesDiffer) {
  const Model& model = sledge_with_motor();
  const Prior prior = make_prior(model, {Prior::Mean::force, std::nullopt});
  const VectorXd noise = VectorXd::Constant(2, 0.02);
  const GeneratedData data = generate(model, {80, transfer_seed, noise});
  const std::vector<Observations> observations = {
      {data.states, View::all(Quantity::constrained_acceleration, *model.system), data.accelerations, noise, false}};
  FitOptions fit_options;
  fit_options.n_restarts = 2;
  const Posterior posterior =
      fit(prior, observations, default_hyperparameters(prior, observations, {}, {}), fit_options).posterior;

  const MatrixXd states = test::draw(model, 200, transfer_seed + 1).states;
  const StateLayout layout = model.system->layout();
  MatrixXd friction(2, states.cols()), drive = MatrixXd::Zero(2, states.cols());
  for (Index i = 0; i < states.cols(); ++i) {
    const auto dq = states.col(i).segment(layout.dq(0), 2);
    friction.col(i) = -(0.4 + 0.2 * dq.squaredNorm()) * dq / 2;
    drive(0, i) = 3 * std::tanh(states(layout.u(0), i)) / 2;
  }
  View a_bar = View::all(Quantity::unconstrained_acceleration, *model.system);
  const MatrixXd all = posterior.mean(a_bar, states);
  a_bar.latent = 0;
  const MatrixXd of_friction = posterior.mean(a_bar, states);
  const MatrixXd friction_stddev = posterior.marginal(a_bar, states).stddev();
  a_bar.latent = 1;
  const MatrixXd of_drive = posterior.mean(a_bar, states);

  const auto relative_error = [](const MatrixXd& predicted, const MatrixXd& truth) {
    return (predicted - truth).norm() / truth.norm();
  };
  EXPECT_LT(relative_error(of_friction, friction), 0.03);
  EXPECT_LT(relative_error(of_drive, drive), 0.03);
  EXPECT_TRUE(of_drive.row(1).isZero(0)) << "the drive acts along x";
  // and it knows how well
  const double covered = ((of_friction - friction).cwiseAbs().array() <= 1.96 * friction_stddev.array()).cast<double>().mean();
  EXPECT_GT(covered, 0.85);
  // together with μ they are ā
  const MatrixXd mu = Eigen::Vector2d(0, -9.81).replicate(1, states.cols());
  EXPECT_LE((mu + of_friction + of_drive - all).cwiseAbs().maxCoeff(), 1e3 * test::eps * size_of(all));
}

// ---- pooled logs

// over twenty seeds, and against as many points of one surface: pooled_surfaces_test.cpp
TEST(PooledSurfaces, TeachMoreAboutAThirdThanHalfAsManyPointsOfEither) {
  test::PooledScore sum;
  for (std::uint64_t of = 1; of <= 3; ++of) sum += test::score_pooling(40, of);
  EXPECT_LT(sum.pooled, sum.half_first);
  EXPECT_LT(sum.pooled, sum.half_second);
}

}  // namespace
}  // namespace gp2
