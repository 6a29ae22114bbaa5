#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "allocation_count.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "test_models.hpp"

// One object, one batch, from state to state: the same numbers as new ones, and no allocation.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;

constexpr std::uint64_t reuse_seed = 20301;

/// M with κ(M) of order ten, A of n_rows rows of which the last n_redundant follow from the others, and b to match.
struct ReuseProblem {
  MatrixXd M, A;
  VectorXd b;
};

ReuseProblem random_problem(Index nq, Index n_rows, Index n_redundant, RandomStream& random) {
  const MatrixXd V = test::random_matrix(nq, nq, random);
  ReuseProblem p{V * V.transpose() / static_cast<double>(nq) + MatrixXd::Identity(nq, nq),
                 test::random_matrix(n_rows, nq, random), test::random_vector(n_rows, random)};
  const Index n_free = n_rows - n_redundant;
  const MatrixXd weights = test::random_matrix(n_redundant, n_free, random);
  p.A.bottomRows(n_redundant) = weights * p.A.topRows(n_free);
  p.b.tail(n_redundant) = weights * p.b.head(n_free);
  return p;
}

struct Size {
  Index nq, n_rows, n_redundant;
};
const std::vector<Size> sizes = {{3, 1, 0}, {4, 2, 0}, {4, 3, 1},   {3, 3, 0},   {2, 5, 3},
                                 {5, 0, 0}, {9, 9, 8}, {20, 12, 2}, {60, 40, 10}};

TEST(AllocationCountTest, SeesNewAndEigen) {
  MatrixXd matrix;
  EXPECT_EQ(test::allocations_of([&] { matrix.resize(3, 3); }), 1U);
  std::vector<double> numbers;
  EXPECT_EQ(test::allocations_of([&] { numbers.resize(5); }), 1U);
  EXPECT_EQ(test::allocations_of([&] { matrix.setZero(); }), 0U);
}

TEST(UdwadiaKalabaReuse, GivesWhatTheTextbookGives) {
  SCOPED_TRACE(fmt::format("seed {}", reuse_seed));
  RandomStream random(reuse_seed);
  UdwadiaKalaba projection;
  for (const Size& size : sizes) {
    SCOPED_TRACE(fmt::format("{} coordinates, {} rows, {} redundant", size.nq, size.n_rows, size.n_redundant));
    const ReuseProblem p = random_problem(size.nq, size.n_rows, size.n_redundant, random);
    projection.compute(p.M, p.A, p.b);
    EXPECT_EQ(projection.rank(), size.n_rows - size.n_redundant);
    const MatrixXd M_inverse = p.M.inverse();
    const MatrixXd W = p.A * M_inverse * p.A.transpose();
    // forming W squares the condition of A, a few hundred at worst here
    const MatrixXd W_pinv = size.n_rows == 0 ? MatrixXd(0, 0) : MatrixXd(W.completeOrthogonalDecomposition().pseudoInverse());
    const MatrixXd L = M_inverse * p.A.transpose() * W_pinv;
    const MatrixXd T = MatrixXd::Identity(size.nq, size.nq) - L * p.A;
    const double tolerance = 1e6 * eps * static_cast<double>(size.nq);
    EXPECT_LE((projection.T() - T).cwiseAbs().maxCoeff(), tolerance);
    EXPECT_LE((projection.Lb() - L * p.b).cwiseAbs().maxCoeff(), tolerance * (1 + p.b.norm()));
    const VectorXd v = test::random_vector(size.nq, random);
    EXPECT_LE((projection.solve_mass(v) - M_inverse * v).cwiseAbs().maxCoeff(), tolerance);
    if (size.n_redundant == 0 && size.n_rows > 0) {
      EXPECT_LE((projection.L() - L).cwiseAbs().maxCoeff(), tolerance * (1 + L.norm()));
      const MatrixXd K = W_pinv * p.A * M_inverse;
      EXPECT_LE((projection.multipliers_of_force() - K).cwiseAbs().maxCoeff(), tolerance * (1 + K.norm()));
    }
  }
}

TEST(UdwadiaKalabaReuse, GivesTheBitsOfANewObjectWhateverCameBefore) {
  SCOPED_TRACE(fmt::format("seed {}", reuse_seed));
  RandomStream random(reuse_seed, 1);
  UdwadiaKalaba reused;
  for (int trial = 0; trial < 3; ++trial) {
    for (const Size& size : sizes) {
      const ReuseProblem p = random_problem(size.nq, size.n_rows, size.n_redundant, random);
      reused.compute(p.M, p.A, p.b);
      const UdwadiaKalaba fresh(p.M, p.A, p.b);
      EXPECT_EQ(reused.rank(), fresh.rank());
      EXPECT_EQ(reused.inconsistency(), fresh.inconsistency());
      EXPECT_EQ(reused.T(), fresh.T());
      EXPECT_EQ(reused.Lb(), fresh.Lb());
      EXPECT_EQ(reused.L(), fresh.L());
      // what fails leaves no trace
      reused.compute(-p.M, p.A, p.b);
      EXPECT_FALSE(reused.mass_is_positive_definite());
    }
  }
}

TEST(UdwadiaKalabaReuse, AllocatesNothingWhereTheSizesAreThoseOfTheCallBefore) {
  SCOPED_TRACE(fmt::format("seed {}", reuse_seed));
  RandomStream random(reuse_seed, 2);
  for (const Size& size : sizes) {
    SCOPED_TRACE(fmt::format("{} coordinates, {} rows, {} redundant", size.nq, size.n_rows, size.n_redundant));
    const ReuseProblem p = random_problem(size.nq, size.n_rows, size.n_redundant, random);
    const ReuseProblem other = random_problem(size.nq, size.n_rows, size.n_redundant == 0 ? 0 : size.n_redundant - 1, random);
    const VectorXd a_bar = test::random_vector(size.nq, random);
    MatrixXd K;
    VectorXd ddq(size.nq);
    UdwadiaKalaba projection;
    UdwadiaKalaba::Workspace workspace;
    const auto use = [&] {
      for (const ReuseProblem* problem : {&p, &other}) {
        projection.compute(problem->M, problem->A, problem->b);
        projection.constrain(a_bar, ddq, workspace);
        projection.solve_mass_in_place(ddq);
        projection.write_multipliers_of_force(K, workspace);
      }
    };
    use();
    EXPECT_EQ(test::allocations_of(use), 0U);
  }
}

class BatchReuse : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(EveryModel, BatchReuse, testing::ValuesIn(test::every_model()), test::model_test_name);

TEST_P(BatchReuse, GivesTheBitsOfANewBatchAndAllocatesNothing) {
  const System& system = *test::model(GetParam()).system;
  const VectorXd parameters = system.parameter_values();
  const MatrixXd first = test::draw(test::model(GetParam()), 100, reuse_seed).states;
  const MatrixXd second = test::draw(test::model(GetParam()), 100, reuse_seed + 1).states;
  MechanicsBatch reused;
  evaluate_mechanics(system, first, parameters, reused);
  EXPECT_EQ(test::allocations_of([&] { evaluate_mechanics(system, second, parameters, reused); }), 0U);
  const MechanicsBatch fresh = evaluate_mechanics(system, second, parameters);
  EXPECT_EQ(reused.values.mass, fresh.values.mass);
  EXPECT_EQ(reused.values.constraint_matrix, fresh.values.constraint_matrix);
  ASSERT_EQ(reused.projections.size(), fresh.projections.size());
  for (std::size_t i = 0; i < fresh.projections.size(); ++i) {
    EXPECT_EQ(reused.projections[i].T(), fresh.projections[i].T());
    EXPECT_EQ(reused.projections[i].Lb(), fresh.projections[i].Lb());
  }
}

TEST(BatchReuseTest, AFaultIsForgottenAtTheNextStates) {
  const Model model = Model::parse(R"(
name = "indefinite"
coordinates = ["x"]
[mechanics]
mass = [["x"]]
force = ["0"]
[constraints]
acceleration = ["ddx - 1"]
[[latent]]
kernel = "se"
features = ["x"]
directions = "acceleration"
)",
                                   "indefinite.toml");
  MechanicsBatch batch;
  evaluate_mechanics(*model.system, Eigen::Vector3d(-1, 0, 0), VectorXd(), batch);
  ASSERT_TRUE(batch.fault);
  EXPECT_EQ(batch.fault->text, "the mass matrix M is not positive definite");
  evaluate_mechanics(*model.system, Eigen::Vector3d(1, 0, 0), VectorXd(), batch);
  EXPECT_FALSE(batch.fault);
  EXPECT_EQ(batch.projections[0].Lb()[0], 1);
}

}  // namespace
}  // namespace gp2
