#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "allocation_count.hpp"
#include "decompositions.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/prior.hpp"
#include "gp2/view.hpp"
#include "input_error.hpp"
#include "test_models.hpp"

// Where M is singular: the motion under a force, whatever stands in for M⁻¹.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;
using testing::AllOf;
using testing::HasSubstr;
using Mass = UdwadiaKalaba::Mass;

constexpr std::uint64_t singular_mass_seed = 20601;

// M = JᵀJ with J (rank × nq), A with one redundant row where asked for, b = A ddq of some ddq
struct Problem {
  MatrixXd J, A;
  VectorXd ddq, force;

  Problem(Index nq, Index rank, Index nc, bool redundant, RandomStream& random)
      : J(test::random_matrix(rank, nq, random)), A(test::random_matrix(nc, nq, random)), ddq(nq), force(nq) {
    // coordinates of one kind: some with mass, some without any, and some that share theirs
    if (rank + 1 < nq) J.col(nq - 1).setZero();
    if (redundant) A.row(nc - 1) = 2 * A.row(0) - (nc > 2 ? MatrixXd(A.row(1)) : MatrixXd(A.row(0)));
    ddq = test::random_vector(nq, random);
    force = test::random_vector(nq, random);
  }
  [[nodiscard]] MatrixXd M() const { return J.transpose() * J; }
  [[nodiscard]] VectorXd b() const { return A * ddq; }
};

MatrixXd stacked(const MatrixXd& above, const MatrixXd& below) {
  MatrixXd rows(above.rows() + below.rows(), above.cols());
  rows << above, below;
  return rows;
}

// of a matrix of given rank
double condition_of_rank(const MatrixXd& matrix, Index rank) {
  const VectorXd sizes = Eigen::JacobiSVD<MatrixXd>(matrix).singularValues();
  return sizes[0] / sizes[rank - 1];
}

template <typename Law>
void for_every_problem(const Law& law) {
  SCOPED_TRACE(fmt::format("seed {}", singular_mass_seed));
  RandomStream random(singular_mass_seed);
  for (int trial = 0; trial < 200; ++trial) {
    for (const auto& [nq, rank, nc, redundant] : {std::tuple{2, 1, 1, false},
                                                  {3, 1, 2, false},
                                                  {4, 2, 2, false},
                                                  {4, 2, 3, false},
                                                  {5, 3, 4, true},
                                                  {6, 2, 4, false},
                                                  {3, 0, 3, false}}) {
      const Problem p(nq, rank, nc, redundant, random);
      // how well ddq is determined, by M' and by what the tests compare it with
      const MatrixXd across = MatrixXd::Identity(nq, nq) - p.A.completeOrthogonalDecomposition().pseudoInverse() * p.A;
      const VectorXd masses = p.M().diagonal();
      const double lightest = (masses.array() > 0).select(masses, test::largest(masses)).minCoeff();
      const double worst =
          std::max({lightest > 0 ? std::sqrt(test::largest(masses) / lightest) : 1, condition_of_rank(stacked(p.M(), p.A), nq),
                    condition_of_rank(stacked(across * p.M(), p.A), nq), condition_of_rank(p.A, redundant ? nc - 1 : nc)});
      if (worst > 100) continue;
      SCOPED_TRACE(fmt::format("{} coordinates, rank of M {}, {} rows, trial {}", nq, rank, nc, trial));
      const UdwadiaKalaba projection(p.M(), p.A, p.b());
      ASSERT_EQ(projection.mass_kind(), Mass::singular);
      ASSERT_TRUE(projection.motion_is_determined());
      law(p, projection, 256 * eps * worst * worst * worst);
      if (testing::Test::HasFailure()) return;
    }
  }
}

TEST(SingularMass, TheMotionIsThatOfThePseudoinverseOfUdwadiaAndPhohomsiri) {
  for_every_problem([](const Problem& p, const UdwadiaKalaba& projection, double rounding) {
    const Index nq = p.A.cols(), nc = p.A.rows();
    const MatrixXd A_pinv = p.A.completeOrthogonalDecomposition().pseudoInverse();
    const MatrixXd across = MatrixXd::Identity(nq, nq) - A_pinv * p.A;
    const MatrixXd pinv = Eigen::JacobiSVD<MatrixXd>(stacked(across * p.M(), p.A), Eigen::ComputeThinU | Eigen::ComputeThinV)
                              .solve(MatrixXd::Identity(nq + nc, nq + nc));
    const MatrixXd G = projection.T() * projection.solve_mass(MatrixXd::Identity(nq, nq));
    EXPECT_LE(test::largest(G - pinv.leftCols(nq)), rounding * (1 + pinv.squaredNorm()));
    EXPECT_LE(test::largest(projection.Lb() - pinv.rightCols(nc) * p.b()),
              rounding * (1 + test::largest(pinv)) * (1 + test::largest(p.b())));
  });
}

TEST(SingularMass, TheMotionAndTheConstraintForceSolveTheEquationsWithMultipliers) {
  for_every_problem([](const Problem& p, const UdwadiaKalaba& projection, double rounding) {
    const Index nq = p.A.cols(), nc = p.A.rows();
    const VectorXd ddq = projection.constrain(projection.solve_mass(p.force));
    const double size = 1 + test::largest(ddq) + test::largest(p.force);
    EXPECT_LE(test::largest(p.A * ddq - p.b()), 64 * eps * size * test::largest(p.A) * static_cast<double>(nq));
    // M ddq − F̄ lies in the range of Aᵀ
    const VectorXd constraint_force = p.M() * ddq - p.force;
    const VectorXd lambda = projection.multipliers_of_force() * constraint_force;
    EXPECT_LE(test::largest(p.A.transpose() * lambda - constraint_force), rounding * size * (1 + test::largest(p.M())));
    if (projection.rank() < nc) return;
    MatrixXd kkt = MatrixXd::Zero(nq + nc, nq + nc);
    kkt << p.M(), -p.A.transpose(), p.A, MatrixXd::Zero(nc, nc);
    VectorXd right(nq + nc);
    right << p.force, p.b();
    const VectorXd solution = kkt.fullPivLu().solve(right);
    const double rounding_of_both = rounding + 64 * eps * condition_of_rank(kkt, nq + nc);
    EXPECT_LE(test::largest(ddq - solution.head(nq)), rounding_of_both * size);
    EXPECT_LE(test::largest(lambda - solution.tail(nc)),
              rounding_of_both * (size + test::largest(lambda)) * (1 + test::largest(p.M())));
  });
}

TEST(SingularMass, NoAdmissibleAccelerationHasASmallerGaussCost) {
  RandomStream random(singular_mass_seed, 1);
  for_every_problem([&](const Problem& p, const UdwadiaKalaba& projection, double rounding) {
    // ½ ddqᵀM ddq − F̄ᵀddq, which is ½ (ddq − ā)ᵀM(ddq − ā) and a constant where there is an ā
    const VectorXd ddq = projection.constrain(projection.solve_mass(p.force));
    const Eigen::JacobiSVD<MatrixXd> svd(p.A, Eigen::ComputeFullV);
    const MatrixXd free = svd.matrixV().rightCols(p.A.cols() - projection.rank());
    if (free.cols() == 0) return;
    const VectorXd w = free * test::random_vector(free.cols(), random).normalized();
    EXPECT_GT(w.dot(p.M() * w), 0);
    EXPECT_LE(std::abs(w.dot(p.M() * ddq - p.force)),
              rounding * (1 + test::largest(p.M())) * (1 + test::largest(ddq) + test::largest(p.force)));
  });
}

TEST(SingularMass, UnitsOfCoordinatesAndTheScaleOfRowsChangeNothing) {
  RandomStream random(singular_mass_seed, 2);
  for_every_problem([&](const Problem& p, const UdwadiaKalaba& projection, double rounding) {
    const Index nq = p.A.cols(), nc = p.A.rows();
    // powers of two, so that nothing rounds
    VectorXd unit(nq), scale(nc);
    for (double& entry : unit) entry = std::exp2(std::round(40 * random.uniform() - 20));
    for (double& entry : scale) entry = std::exp2(std::round(40 * random.uniform() - 20));
    const UdwadiaKalaba scaled(unit.asDiagonal() * p.M() * unit.asDiagonal(), scale.asDiagonal() * p.A * unit.asDiagonal(),
                               scale.cwiseProduct(p.b()));
    ASSERT_EQ(scaled.mass_kind(), Mass::singular);
    const VectorXd ddq = projection.constrain(projection.solve_mass(p.force));
    const VectorXd other = unit.asDiagonal() * scaled.constrain(scaled.solve_mass(unit.cwiseProduct(p.force)));
    EXPECT_LE(test::largest(ddq - other), rounding * (1 + test::largest(ddq)));
  });
}

using Extended = Eigen::Matrix<long double, Eigen::Dynamic, Eigen::Dynamic>;

// ddq by elimination in the equations with multipliers, 64 bits
VectorXd accurate_motion(const MatrixXd& M, const MatrixXd& A, const VectorXd& b, const VectorXd& force) {
  const Index nq = M.rows(), nc = A.rows();
  Extended kkt = Extended::Zero(nq + nc, nq + nc);
  kkt.topLeftCorner(nq, nq) = M.cast<long double>();
  kkt.topRightCorner(nq, nc) = A.transpose().cast<long double>();
  kkt.bottomLeftCorner(nc, nq) = A.cast<long double>();
  Extended right(nq + nc, 1);
  right << force.cast<long double>(), b.cast<long double>();
  return Extended(kkt.fullPivLu().solve(right)).topRows(nq).cast<double>();
}

// A light coordinate by itself is small by its unit; in a corner of a matrix it is lost among the rounding of the others.
TEST(SingularMass, TheMotionIsContinuousWhereMBecomesSingular) {
  const MatrixXd A = (MatrixXd(1, 2) << 1, -0.7).finished();
  const VectorXd b = VectorXd::Constant(1, 0.4);
  const Eigen::Vector2d force(0.3, 1.1);
  const Eigen::Rotation2Dd turn(0.6);
  for (const bool turned : {false, true}) {
    const MatrixXd Q = turned ? MatrixXd(turn.toRotationMatrix()) : MatrixXd::Identity(2, 2);
    const auto mass = [&](double light) -> MatrixXd {
      const MatrixXd M = Q * Eigen::Vector2d(1, light).asDiagonal() * Q.transpose();
      return (M + M.transpose()) / 2;
    };
    const VectorXd massless = accurate_motion(mass(0), A, b, force);
    for (double light = 1; light > 0; light = light < 1e-20 ? 0 : light / 10) {
      SCOPED_TRACE(fmt::format("{}, {}", turned ? "turned" : "straight", light));
      const UdwadiaKalaba projection(mass(light), A, b);
      ASSERT_TRUE(projection.motion_is_determined());
      EXPECT_EQ(projection.mass_is_singular(), turned && light < 0.2 * UdwadiaKalaba::mass_tolerance);
      // ε/√light: a vector of length 1 whose entry √light is known to ε. Turned, ε over the pivot: half of the digits at worst
      const double rounding = 32 * eps / (turned ? std::max(light, UdwadiaKalaba::mass_tolerance) : std::sqrt(light));
      const VectorXd expected = accurate_motion(mass(light), A, b, force);
      const VectorXd a_bar = projection.solve_mass(force);
      EXPECT_LE(test::largest(projection.constrain(a_bar) - expected), rounding);
      EXPECT_LE(test::largest(projection.T() * a_bar + projection.Lb() - expected), rounding);
      EXPECT_LE(test::largest(projection.constrain(a_bar) - massless), 5 * light + rounding);
    }
    const UdwadiaKalaba projection(mass(0), A, b);
    EXPECT_EQ(projection.mass_kind(), Mass::singular);
    EXPECT_LE(test::largest(projection.constrain(projection.solve_mass(force)) - massless), 64 * eps);
  }
}

TEST(SingularMass, AnIndefiniteMassMatrixStaysAnErrorWhateverTheConstraints) {
  const MatrixXd A = MatrixXd::Identity(2, 2);
  const auto kind = [&](double a, double b, double c) {
    return UdwadiaKalaba((MatrixXd(2, 2) << a, b, b, c).finished(), A, VectorXd::Zero(2)).mass_kind();
  };
  EXPECT_EQ(kind(1, 0, -1e-3), Mass::indefinite);
  EXPECT_EQ(kind(1, 0, -1e-30), Mass::indefinite);
  EXPECT_EQ(kind(1, 1e-9, 0), Mass::indefinite) << "a coordinate without mass is coupled to nothing";
  EXPECT_EQ(kind(1, 1 + 1e-9, 1), Mass::indefinite);
  EXPECT_EQ(kind(1, 1, 1), Mass::singular);
  EXPECT_EQ(kind(0, 0, 0), Mass::singular);
  EXPECT_EQ(kind(1, std::numeric_limits<double>::quiet_NaN(), 1), Mass::indefinite);
}

TEST(SingularMass, AMassThatIsIllConditionedAndThatAConstraintDoesNotCompleteIsUsedAsItIs) {
  const MatrixXd M = (MatrixXd(2, 2) << 1, 1, 1, 1 + 1e-11).finished();
  EXPECT_EQ(UdwadiaKalaba(M, MatrixXd(0, 2), VectorXd(0)).mass_kind(), Mass::positive_definite);
  EXPECT_EQ(UdwadiaKalaba(M, MatrixXd::Ones(1, 2), VectorXd::Zero(1)).mass_kind(), Mass::positive_definite);
  EXPECT_EQ(UdwadiaKalaba(M, Eigen::RowVector2d(1, 0), VectorXd::Zero(1)).mass_kind(), Mass::singular);
}

// M, A, b that change smoothly while the ranks stay; against differences
TEST(SingularMassDerivatives, AreThoseOfTheMotion) {
  RandomStream random(singular_mass_seed, 3);
  double size = 0;
  for_every_problem([&](const Problem& p, const UdwadiaKalaba& projection, double /*rounding*/) {
    const MatrixXd dJ = test::random_matrix(p.J.rows(), p.J.cols(), random).array() * (p.J.array() != 0).cast<double>();
    const Index nq = p.A.cols(), nc = p.A.rows();
    MatrixXd dA = test::random_matrix(nc, nq, random);
    const VectorXd dddq = test::random_vector(nq, random);
    if (projection.rank() < nc) dA = 0.3 * p.A;  // rows stay dependent
    const auto moved = [&](double x) {
      Problem there = p;
      there.J += x * dJ;
      there.A += x * dA;
      there.ddq += x * dddq;
      return UdwadiaKalaba(there.M(), there.A, there.b());
    };
    const MatrixXd dM = dJ.transpose() * p.J + p.J.transpose() * dJ;
    const VectorXd db = dA * p.ddq + p.A * dddq;
    const UdwadiaKalaba::Derivative d = projection.differentiate(dM, dA, db);
    const auto all = [](const MatrixXd& T, const VectorXd& Lb) {
      VectorXd numbers(T.size() + Lb.size());
      numbers << T.reshaped(), Lb;
      return numbers;
    };
    const test::Difference difference = test::central_difference(
        [&](double x) -> VectorXd {
          const UdwadiaKalaba there = moved(x);
          return all(there.T(), there.Lb());
        },
        0, 0.003, 1e5 * eps);
    EXPECT_TRUE(test::matches(all(d.T, d.Lb), difference));
    size = std::max(size, test::largest(d.T));

    // G = T M'⁻¹ with Σ held, as a prior on forces has it
    const MatrixXd inverse = projection.solve_mass(MatrixXd::Identity(nq, nq));
    const MatrixXd dG = d.T * inverse - projection.T() * inverse * projection.differentiate_mass(dM, dA) * inverse;
    const test::Difference G_difference = test::central_difference(
        [&](double x) -> VectorXd {
          const UdwadiaKalaba there = moved(x);
          return (there.T() * there.solve_mass(MatrixXd::Identity(nq, nq))).reshaped();
        },
        0, 0.003, 1e5 * eps);
    EXPECT_TRUE(test::matches(dG.reshaped(), G_difference));
  });
  EXPECT_GT(size, 0.1);
}

TEST(SingularMass, ReuseGivesTheBitsOfANewObjectAndAllocatesNothing) {
  RandomStream random(singular_mass_seed, 4);
  for (const Index nq : {3, 6, 20}) {
    const Problem p(nq, nq / 2, nq - 1, false, random), other(nq, nq / 2, nq - 1, false, random);
    const MatrixXd M = p.M(), regular = M + MatrixXd::Identity(nq, nq), indefinite = -M, M2 = other.M();
    const VectorXd b = p.b(), b2 = other.b();
    UdwadiaKalaba reused;
    UdwadiaKalaba::Workspace workspace;
    MatrixXd K;
    VectorXd ddq = p.ddq;
    const auto use = [&] {
      reused.compute(regular, p.A, b);
      reused.compute(indefinite, p.A, b);
      reused.compute(M2, other.A, b2);
      reused.write_multipliers_of_force(K, workspace);
      reused.compute(M, p.A, b);
      reused.constrain(p.force, ddq, workspace);
      reused.solve_mass_in_place(ddq);
    };
    use();
    EXPECT_EQ(test::allocations_of(use), 0U);
    // the first singular state too
    UdwadiaKalaba other_kind(regular, p.A, b);
    EXPECT_EQ(test::allocations_of([&] { other_kind.compute(M, p.A, b); }), 0U);
    const UdwadiaKalaba fresh(M, p.A, b);
    EXPECT_TRUE(fresh.mass_is_singular());
    EXPECT_EQ(reused.T(), fresh.T());
    EXPECT_EQ(reused.Lb(), fresh.Lb());
    EXPECT_EQ(reused.mass(), fresh.mass());
  }
}

// ---- systems -----------------------------------------------------------------------------------------------------------------

const Model& rod() { return test::model("models/massless_rod.toml"); }

Model points(const std::string& mass, const std::string& constraints) {
  return Model::parse(fmt::format(R"toml(
name        = "points"
coordinates = ["x", "y", "z"]
[mechanics]
mass  = {}
force = ["1", "0", "0"]
[constraints]
acceleration = [{}]
[[latent]]
features   = ["x"]
directions = "force"
)toml",
                                  mass, constraints),
                      "points");
}

std::string fault_of(const Model& model) {
  return test::input_error_of([&] { require_mechanics(*model.system, VectorXd::Ones(7), VectorXd()); });
}

TEST(SingularMassFaults, ADirectionThatNothingDeterminesIsNamed) {
  const std::string light = R"([["1", "0", "0"], ["0", "0", "0"], ["0", "0", "0"]])";
  EXPECT_THAT(
      fault_of(points(light, R"("ddy + ddz - x")")),
      AllOf(HasSubstr("system 'points': the mass matrix M is singular, and nothing determines ddq along 0.71 y − 0.71 z: "),
            HasSubstr("only a constraint that acts there, or a mass, does at state 1 (x = 1, ")));
  EXPECT_THAT(fault_of(points(light, R"("ddx - ddz")")), HasSubstr("nothing determines ddq along y:"));
  EXPECT_EQ(fault_of(points(light, R"("ddx - ddz", "ddy + 2*ddz")")), "");
  EXPECT_EQ(fault_of(points(light, R"("x*ddx - 1e-7*ddz", "ddy + 2*ddz")")), "") << "z is a matter of units";
  // two coordinates for one point, and a constraint that says nothing of how they share it
  const std::string shared = R"([["1", "1", "0"], ["1", "1", "0"], ["0", "0", "4"]])";
  EXPECT_THAT(fault_of(points(shared, R"("ddx + ddy - ddz")")), HasSubstr("along 0.71 x − 0.71 y:"));
  EXPECT_EQ(fault_of(points(shared, R"("ddx - 3*ddy")")), "");
  EXPECT_THAT(fault_of(points(light, R"("ddx - ddz", "ddy + sqrt(-x)*ddz")")), HasSubstr("A or b is not a finite number"));
  EXPECT_THAT(fault_of(points(R"([["1", "0", "0"], ["0", "1", "0"], ["0", "0", "-1"]])", R"("ddx - ddz")")),
              HasSubstr("the mass matrix M is not positive definite"));
}

TEST(SingularMassFaults, WhatSpeaksOfTheUnconstrainedAccelerationIsRefused) {
  const MatrixXd states = test::draw(rod(), 3, singular_mass_seed).states;
  const VectorXd parameters = rod().system->parameter_values();
  const auto fault = [&](const PriorOptions& options, View::Quantity quantity) {
    const Prior prior = make_prior(rod(), options);
    return test::input_error_of([&] { require_mechanics(prior, View::all(quantity, *rod().system), states, parameters); });
  };
  using Quantity = View::Quantity;
  EXPECT_EQ(fault({}, Quantity::constrained_acceleration), "");
  EXPECT_EQ(fault({Prior::Mean::force, std::nullopt}, Quantity::constraint_force), "");
  EXPECT_THAT(fault({}, Quantity::unconstrained_acceleration),
              AllOf(HasSubstr("the mass matrix M is singular, so that there is no M⁻¹, but the view is of the unconstrained "
                              "acceleration ā at state 1 (x = ")));
  EXPECT_THAT(fault({Prior::Mean::zero, Latent::Base::acceleration}, Quantity::constrained_acceleration),
              AllOf(HasSubstr("the latent 'unknown force' acts on the unconstrained acceleration ā"),
                    HasSubstr("directions = \"force\" or { force = … }")));
  Prior constant = make_prior(rod());
  constant.mean = Prior::Mean::constant;
  constant.constant_mean = VectorXd::Ones(3);
  EXPECT_THAT(test::input_error_of([&] {
                require_mechanics(constant, View::all(Quantity::constrained_acceleration, *rod().system), states, parameters);
              }),
              HasSubstr("but the prior's mean is an acceleration"));
}

TEST(SingularMassFaults, ATrueAccelerationIsRefusedUnlessItIsZero) {
  const auto with = [](const std::string& truth) {
    std::string text = rod().text;
    const std::string force = "force = [\"0\", \"0\", \"-0.3*tanh(10*dtheta) - 0.05*dtheta\"]";
    text.replace(text.find(force), force.size(), truth);
    return Model::parse(text, "rod");
  };
  EXPECT_EQ(test::input_error_of([&] { test::draw(with(R"(acceleration = ["0", "0", "0"])"), 2, 1); }), "");
  EXPECT_THAT(test::input_error_of([&] { test::draw(with(R"(acceleration = ["0", "0", "1"])"), 2, 1); }),
              AllOf(HasSubstr("[truth] acceleration cannot be added to M⁻¹F: write it as [truth] force at state 1 ("),
                    HasSubstr("theta = ")));
}

// m l² θ̈ = −m g l sin θ + u1 + friction, the whole motion and the force of the rod from θ
TEST(SingularMassModel, MovesAsTheOneWithoutTheRedundantCoordinatesDoes) {
  const GeneratedData data = test::draw(rod(), 50, singular_mass_seed);
  const double m = 0.5, l = 0.6, g = 9.81;
  const Prior prior = make_prior(rod(), {Prior::Mean::force, std::nullopt});
  const VectorXd parameters = rod().system->parameter_values();
  const View force = View::all(View::Quantity::constraint_force, *rod().system);
  const View lambda = View::all(View::Quantity::multipliers, *rod().system);
  const MechanicsBatch mechanics = require_mechanics(prior, force, data.states, parameters);
  EXPECT_EQ(mechanics.first_singular(), 0);
  const ViewValues forces = evaluate_view(force, mechanics, data.states),
                   multipliers = evaluate_view(lambda, mechanics, data.states);
  const PriorValues values = evaluate_prior(prior, data.states, parameters, mechanics);
  for (int i = 0; i < 50; ++i) {
    const double theta = data.states(2, i), speed = data.states(5, i), u = data.states(7, i);
    const auto ddtheta = [&](double torque) { return (torque - m * g * l * std::sin(theta)) / (m * l * l); };
    const auto ball = [&](double angular) -> Eigen::Vector2d {
      const double tangential = l * angular, centripetal = l * speed * speed;
      return {tangential * std::cos(theta) - centripetal * std::sin(theta),
              tangential * std::sin(theta) + centripetal * std::cos(theta)};
    };
    const double truth = ddtheta(u - 0.3 * std::tanh(10 * speed) - 0.05 * speed);
    const double rounding = 64 * eps * (1 + std::abs(truth) + 10 * speed * speed) * 10;
    EXPECT_NEAR(data.accelerations(2, i), truth, rounding);
    EXPECT_LE(test::largest(data.accelerations.col(i).head(2) - ball(truth)), rounding);

    // without friction: what the rod does to the ball, and the ball to the rod
    Eigen::Vector3d expected;
    expected.head(2) = m * ball(ddtheta(u)) + Eigen::Vector2d(0, m * g);
    expected[2] = -u;
    const VectorXd got = forces.G(i) * values.mean.col(i) + forces.offset.col(i);
    EXPECT_LE(test::largest(got - expected), 10 * rounding);
    EXPECT_LE(
        test::largest(mechanics.values.A(i).transpose() * (multipliers.G(i) * values.mean.col(i) + multipliers.offset.col(i)) -
                      expected),
        10 * rounding);
  }
}

// constraint force, λ and ddq of μ, whose M'⁻¹ alone has no meaning, in every parameter
TEST(SingularMassModel, ViewsOfThePriorHaveExactDerivativesInTheParameters) {
  const Prior prior = make_prior(rod(), {Prior::Mean::force, std::nullopt});
  const System& system = *rod().system;
  const MatrixXd states = test::draw(rod(), 5, singular_mass_seed).states;
  const VectorXd parameters = system.parameter_values();
  for (const View::Quantity quantity : {View::Quantity::constrained_acceleration, View::Quantity::constraint_force,
                                        View::Quantity::multipliers, View::Quantity::next_velocity}) {
    View view = View::all(quantity, system);
    view.time_step = 0.1;
    // of every entry of G μ + d and G E
    const auto numbers = [&](const ViewValues& v, const PriorValues& p) {
      std::vector<double> all;
      for (int i = 0; i < 5; ++i) {
        const MatrixXd GE = v.G(i) * p.E(0, i);
        const VectorXd mean = v.G(i) * p.mean.col(i) + v.offset.col(i);
        all.insert(all.end(), GE.reshaped().begin(), GE.reshaped().end());
        all.insert(all.end(), mean.begin(), mean.end());
      }
      return VectorXd(Eigen::Map<VectorXd>(all.data(), static_cast<Index>(all.size())));
    };
    const auto at = [&](const VectorXd& theta) -> VectorXd {
      const MechanicsBatch mechanics = require_mechanics(prior, view, states, theta);
      return numbers(evaluate_view(view, mechanics, states), evaluate_prior(prior, states, theta, mechanics));
    };
    const MechanicsBatch mechanics = require_mechanics(prior, view, states, parameters);
    const ViewValues v = evaluate_view(view, mechanics, states);
    const PriorValues p = evaluate_prior(prior, states, parameters, mechanics);
    for (int k = 0; k < 2; ++k) {
      SCOPED_TRACE(fmt::format("{}, {}", quantity->word(), system.parameters()[static_cast<std::size_t>(k)].name));
      const SystemValues ds = system.differentiate(states, parameters, k);
      const ViewValues dv = differentiate_view(view, mechanics, ds);
      const PriorValues dp = differentiate_prior(prior, states, parameters, mechanics, p, ds, k);
      const ViewValues shift{v.matrix, dv.offset, {}};  // G dμ + dd, then dG μ
      ViewValues turn{dv.matrix, 0 * dv.offset, {}};
      const VectorXd exact = numbers(shift, dp) + numbers(turn, p);
      const test::Difference difference = test::central_difference(
          [&](double value) {
            VectorXd theta = parameters;
            theta[k] = value;
            return at(theta);
          },
          parameters[k], 0.1, 1000 * eps);
      EXPECT_TRUE(test::matches(exact, difference));
      EXPECT_GT(exact.norm(), 1e-3);
    }
  }
}

TEST(SingularMassModel, CheckSaysThatMIsSingularAndWhatFollows) {
  std::string all;
  for (const Finding& finding : check_system(*rod().system, test::draw(rod(), 20, 1).states, rod().system->parameter_values())) {
    EXPECT_EQ(finding.level, Finding::Level::good) << finding.text;
    all += finding.text + "\n";
  }
  EXPECT_THAT(all,
              HasSubstr("mass matrix: singular at 20 of 20 states, rank 2 of 3; the constraints determine the motion all the "
                        "same, and the latents must act on forces: directions = \"force\"\n"));
  // regular at x ≠ 0
  const Model sometimes = points(R"([["1", "0", "0"], ["0", "x", "0"], ["0", "0", "1"]])", R"("ddx - ddy", "ddz")");
  MatrixXd states = MatrixXd::Ones(7, 3);
  states(0, 1) = 0;
  EXPECT_THAT(check_system(*sometimes.system, states, VectorXd()).front().text,
              HasSubstr("singular at 1 of 3 states, rank 2 of 3; elsewhere positive definite, condition number up to 1;"));
}

}  // namespace
}  // namespace gp2
