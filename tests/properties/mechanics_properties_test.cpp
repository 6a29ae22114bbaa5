#include <algorithm>

#include <gtest/gtest.h>
#include <rapidcheck/gtest.h>

#include "gp2/mechanics/callable_system.hpp"
#include "properties/random_mechanics.hpp"

// Laws of ddq = L b + T ā where M, A and b are anything.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;
using test::Extended;
using test::ExtendedVector;
using test::largest_extended;
using test::RandomMechanics;

RandomStream stream() { return RandomStream(test::random_seed()); }

UdwadiaKalaba projection_of(const RandomMechanics& mechanics) { return {mechanics.M, mechanics.A, mechanics.b}; }

void expect_within(double value, double bound, const char* law) {
  RC_LOG() << law << ": " << value << ", allowed " << bound << '\n';
  RC_ASSERT(value <= bound);
}

RC_GTEST_PROP(MechanicsProperty, TheProjectionIsTheOneOfItsLaws, ()) {
  RandomStream random = stream();
  const RandomMechanics mechanics = test::random_mechanics(random);
  const UdwadiaKalaba projection = projection_of(mechanics);
  RC_ASSERT(projection.mass_is_positive_definite());
  RC_ASSERT(projection.rank() == mechanics.rank());
  RC_ASSERT(projection.n_zero_rows() == (mechanics.rank() == 0 ? static_cast<int>(mechanics.A.rows()) : 0));
  const test::Whitening white(mechanics.M);
  const Extended T = white.map(projection.T().cast<long double>());
  const auto [B, norms] = white.rows(mechanics.A.cast<long double>());
  // A T = 0, T² = T, M T = Tᵀ M, and trace T = n − rank: whitened, T is an orthogonal projection
  const double backward = mechanics.rounding() / mechanics.condition_of_rows;
  expect_within(largest_extended(B * T), backward, "A T = 0");
  expect_within(largest_extended(T * T - T), backward, "T² = T");
  expect_within(largest_extended(T - T.transpose()), backward, "M T = Tᵀ M");
  expect_within(std::abs(static_cast<double>(T.trace()) - static_cast<double>(mechanics.n() - mechanics.rank())),
                backward * static_cast<double>(mechanics.n()), "trace T = n − rank A");
}

RC_GTEST_PROP(MechanicsProperty, LIsAGeneralisedInverse, ()) {
  RandomStream random = stream();
  const RandomMechanics mechanics = test::random_mechanics(random, 1);
  const UdwadiaKalaba projection = projection_of(mechanics);
  const test::Whitening white(mechanics.M);
  const auto [B, norms] = white.rows(mechanics.A.cast<long double>());
  // whitened and of the unit rows, L is B⁺: as large as the rows' conditioning
  const Extended LA = Extended::Identity(mechanics.n(), mechanics.n()) - white.map(projection.T().cast<long double>());
  const Extended L_A = white.map((projection.L() * mechanics.A).cast<long double>());
  expect_within(largest_extended(L_A - LA), mechanics.rounding(), "T = I − L A");
  expect_within(largest_extended(B * L_A - B), mechanics.rounding(), "A L A = A");
  const ExtendedVector Lb = white.acceleration(projection.Lb().cast<long double>());
  const ExtendedVector b = mechanics.b.cast<long double>().cwiseQuotient(norms);
  const double size = static_cast<double>(white.acceleration(mechanics.x.cast<long double>()).norm());
  expect_within(largest_extended(B * Lb - b), mechanics.rounding() * size, "A L b = b");
  RC_ASSERT(projection.inconsistency() <= mechanics.rounding() * size);
}

RC_GTEST_PROP(MechanicsProperty, TheEquationsOfMotionWithMultipliersGiveTheSame, ()) {
  RandomStream random = stream();
  const RandomMechanics mechanics = test::random_mechanics(random);
  const UdwadiaKalaba projection = projection_of(mechanics);
  const test::Whitening white(mechanics.M);
  const test::ExactProjection exact = test::solve_equations_of_motion(mechanics.M, mechanics.A(mechanics.independent, Eigen::all),
                                                                      mechanics.b(mechanics.independent));
  const double size = 1 + static_cast<double>(white.acceleration(mechanics.x.cast<long double>()).norm());
  expect_within(largest_extended(white.map(projection.T().cast<long double>() - exact.T)), mechanics.rounding(), "T");
  expect_within(largest_extended(white.acceleration(projection.Lb().cast<long double>() - exact.Lb)), mechanics.rounding() * size,
                "L b");
}

RC_GTEST_PROP(MechanicsProperty, GaussPrincipleHolds, ()) {
  RandomStream random = stream();
  const RandomMechanics mechanics = test::random_mechanics(random);
  const UdwadiaKalaba projection = projection_of(mechanics);
  const test::Whitening white(mechanics.M);
  const VectorXd a_bar = mechanics.x + projection.T() * mechanics.x.cwiseAbs();
  const ExtendedVector ddq = white.acceleration(projection.constrain(a_bar).cast<long double>());
  const ExtendedVector moved = ddq - white.acceleration(a_bar.cast<long double>());
  const auto [B, norms] = white.rows(mechanics.A(mechanics.independent, Eigen::all).cast<long double>());
  const double size = static_cast<double>(ddq.norm() + white.acceleration(a_bar.cast<long double>()).norm());
  // admissible, …
  const ExtendedVector b = mechanics.b(mechanics.independent).cast<long double>().cwiseQuotient(norms);
  expect_within(largest_extended(B * ddq - b), mechanics.rounding() * size, "A ddq = b");
  // … and the step from ā, in the metric of M, is a combination of the rows: at right angles to what they leave free
  ExtendedVector free = moved;
  if (mechanics.rank() > 0) free -= B.transpose() * B.transpose().colPivHouseholderQr().solve(moved);
  expect_within(largest_extended(free), mechanics.rounding() * size, "right angles");
}

RC_GTEST_PROP(MechanicsProperty, ScalingRowsChangesTheMultipliersOnly, ()) {
  RandomStream random = stream();
  const RandomMechanics mechanics = test::random_mechanics(random, 1);
  const UdwadiaKalaba projection = projection_of(mechanics);
  VectorXd scale = test::random_scales(mechanics.A.rows(), 60, random);
  for (double& s : scale) s *= random.uniform() < 0.5 ? -1 : 1;
  const UdwadiaKalaba scaled(mechanics.M, scale.asDiagonal() * mechanics.A, scale.cwiseProduct(mechanics.b));
  RC_ASSERT(scaled.rank() == projection.rank());
  const test::Whitening white(mechanics.M);
  const double size = 1 + static_cast<double>(white.acceleration(mechanics.x.cast<long double>()).norm());
  expect_within(largest_extended(white.map((scaled.T() - projection.T()).cast<long double>())), mechanics.rounding(), "T");
  expect_within(largest_extended(white.acceleration((scaled.Lb() - projection.Lb()).cast<long double>())),
                mechanics.rounding() * size, "L b");
  // λ of independent rows is that of the rows as written: Aᵀλ is the same force
  if (mechanics.rank() < mechanics.A.rows()) return;
  const VectorXd force = mechanics.M * (projection.Lb() - mechanics.x);
  const VectorXd lambda = projection.multipliers_of_force() * force;
  const VectorXd of_scaled = scale.cwiseProduct(scaled.multipliers_of_force() * force);
  const auto [B, norms] = white.rows(mechanics.A.cast<long double>());
  // … from a force whose parts along rows at small angles to each other cancel
  expect_within(largest_extended(norms.cwiseProduct((of_scaled - lambda).cast<long double>())),
                mechanics.rounding() * mechanics.condition_of_rows * size, "λ");
}

RC_GTEST_PROP(MechanicsProperty, ARowThatFollowsFromTheOthersChangesTheMultipliersOnly, ()) {
  RandomStream random = stream();
  const RandomMechanics mechanics = test::random_mechanics(random, 1);
  const UdwadiaKalaba projection = projection_of(mechanics);
  // weights of the unit rows, so that the new one is made of all of them
  const VectorXd weights =
      test::random_vector(mechanics.A.rows(), random).cwiseQuotient(mechanics.A.rowwise().lpNorm<Eigen::Infinity>());
  const Index m = mechanics.A.rows();
  MatrixXd A(m + 1, mechanics.n());
  A << mechanics.A, weights.transpose() * mechanics.A;
  VectorXd b(m + 1);
  b << mechanics.b, weights.dot(mechanics.b);
  const UdwadiaKalaba extended(mechanics.M, A, b);
  RC_ASSERT(extended.rank() == projection.rank());
  const test::Whitening white(mechanics.M);
  // coordinates in other units make the row a difference of large numbers: what it lost is what it is worth
  const ExtendedVector norms = white.rows(A.cast<long double>()).second;
  const double lost = static_cast<double>(weights.cwiseAbs().cast<long double>().dot(norms.head(m)) / norms[m]);
  const double size = 1 + static_cast<double>(white.acceleration(mechanics.x.cast<long double>()).norm());
  expect_within(largest_extended(white.map((extended.T() - projection.T()).cast<long double>())), lost * mechanics.rounding(),
                "T");
  expect_within(largest_extended(white.acceleration((extended.Lb() - projection.Lb()).cast<long double>())),
                lost * mechanics.rounding() * size, "L b");
}

// A motion of M, A and b along which the rank stays: A(τ) = W (R + τ R') (I + τ X), rows combined as they were.
struct Path {
  RandomMechanics start;
  MatrixXd dM, dR, weights;  // A = weights · A of the independent rows
  VectorXd dx;

  [[nodiscard]] MatrixXd M(double tau) const { return start.M + tau * dM; }
  [[nodiscard]] MatrixXd A(double tau) const { return weights * (start.A(start.independent, Eigen::all) + tau * dR); }
  [[nodiscard]] VectorXd b(double tau) const { return A(tau) * (start.x + tau * dx); }
  [[nodiscard]] MatrixXd dA() const { return weights * dR; }
  [[nodiscard]] VectorXd db() const { return dA() * start.x + A(0) * dx; }
};

Path random_path(RandomStream& random) {
  Path path{test::random_mechanics(random, 1), {}, {}, {}, {}};
  const RandomMechanics& start = path.start;
  const Index n = start.n(), m = start.A.rows(), rank = start.rank();
  // changes of the size of what changes, coordinate by coordinate and row by row
  const VectorXd unit = start.M.diagonal().cwiseSqrt();
  const MatrixXd symmetric = test::random_matrix(n, n, random);
  path.dM = unit.asDiagonal() * MatrixXd(0.5 * (symmetric + symmetric.transpose())) * unit.asDiagonal();
  const MatrixXd rows = start.A(start.independent, Eigen::all);
  path.dR = test::random_matrix(rank, n, random) * unit.asDiagonal();
  for (Index row = 0; row < rank; ++row) path.dR.row(row) *= (rows.row(row) * unit.cwiseInverse().asDiagonal()).norm();
  path.weights = test::random_matrix(m, rank, random);
  for (std::size_t k = 0; k < start.independent.size(); ++k) {
    path.weights.row(start.independent[k]).setZero();
    path.weights(start.independent[k], static_cast<Index>(k)) = 1;
  }
  path.dx = test::random_vector(n, random).cwiseQuotient(unit);
  return path;
}

RC_GTEST_PROP(MechanicsProperty, DerivativesAreThoseOfDifferenceQuotients, ()) {
  RandomStream random = stream();
  const Path path = random_path(random);
  const RandomMechanics& start = path.start;
  // what badly conditioned mechanics change over is too short for difference quotients
  RC_PRE(start.condition_of_mass * start.condition_of_rows < 1e4);
  const VectorXd unit = start.M.diagonal().cwiseSqrt();
  const VectorXd a_bar = test::random_vector(start.n(), random).cwiseQuotient(unit);
  // in units where masses are 1; rank ambiguity is none, since the rows stay combinations of the same
  const auto motion = [&](double tau) -> VectorXd {
    const UdwadiaKalaba projection(path.M(tau), path.A(tau), path.b(tau));
    return unit.cwiseProduct(projection.Lb() + projection.T() * a_bar);
  };
  const UdwadiaKalaba projection(path.M(0), path.A(0), path.b(0));
  const UdwadiaKalaba::Derivative d = projection.differentiate(path.dM, path.dA(), path.db());
  const VectorXd analytic = unit.cwiseProduct(d.Lb + d.T * a_bar);
  const test::Difference difference =
      test::central_difference(motion, 0, 0.1 / (start.condition_of_mass * start.condition_of_rows), start.rounding());
  const testing::AssertionResult result = test::matches(analytic, difference);
  RC_LOG() << result.message() << '\n';
  RC_ASSERT(static_cast<bool>(result));
}

// A row and the same row with noise: above the rank tolerance what follows from the conditioning holds, below the rank is lower
// and says so. There is nothing in between.
RC_GTEST_PROP(MechanicsProperty, ANearlyRedundantRowIsNeverAWrongNumber, ()) {
  RandomStream random = stream();
  RandomMechanics mechanics = test::random_mechanics(random, 1);
  RC_PRE(mechanics.rank() < mechanics.n());
  const Index n = mechanics.n(), m = mechanics.A.rows();
  const double noise = std::pow(10.0, -*rc::gen::inRange(6, 14).as("digits of the noise"));
  const VectorXd unit = mechanics.M.diagonal().cwiseSqrt();
  // a new direction of that size beside the first row
  const Index of = mechanics.independent[0];
  const double size_of_row = (mechanics.A.row(of) * unit.cwiseInverse().asDiagonal()).norm();
  const Eigen::RowVectorXd direction = size_of_row * noise * (test::random_vector(n, random).transpose() * unit.asDiagonal());
  MatrixXd A(m + 1, n);
  A << mechanics.A, mechanics.A.row(of) + direction;
  VectorXd b(m + 1);
  b << mechanics.b, A.row(m) * mechanics.x;
  const UdwadiaKalaba projection(mechanics.M, A, b);
  RC_TAG(projection.rank() - mechanics.rank());
  const test::Whitening white(mechanics.M);
  const auto [B, norms] = white.rows(A.cast<long double>());
  const Extended T = white.map(projection.T().cast<long double>());
  const double size = static_cast<double>(white.acceleration(mechanics.x.cast<long double>()).norm());
  // L is as large as the angle between the rows is small, and refines T where M is badly conditioned
  const double refined = 10 * std::numeric_limits<double>::epsilon() / noise;
  const double backward = mechanics.rounding() / mechanics.condition_of_rows + refined;
  // a projection it is, and a motion that satisfies the constraints, to what was dropped
  const double dropped = projection.rank() == mechanics.rank() ? 100 * UdwadiaKalaba::rank_tolerance : 0;
  expect_within(largest_extended(T * T - T), backward, "T² = T");
  expect_within(largest_extended(T - T.transpose()), backward, "M T = Tᵀ M");
  expect_within(largest_extended(B * T), backward + dropped, "A T = 0");
  RC_ASSERT(projection.rank() == mechanics.rank() || projection.rank() == mechanics.rank() + 1);
  // what the rank leaves unsatisfied is what is reported
  const ExtendedVector Lb = white.acceleration(projection.Lb().cast<long double>());
  const ExtendedVector residual = B * Lb - b.cast<long double>().cwiseQuotient(norms);
  const double scale = size + static_cast<double>(Lb.norm());
  expect_within(std::abs(largest_extended(residual) - projection.inconsistency()), mechanics.rounding() * scale,
                "the residual reported");
  if (projection.rank() == mechanics.rank()) {
    // what was dropped is no more than the tolerance allows: the row's distance from the span of the others
    const test::ExactProjection others =
        test::project_by_qr(mechanics.M, mechanics.A(mechanics.independent, Eigen::all), mechanics.b(mechanics.independent));
    expect_within(largest_extended(B.row(m) * white.map(others.T)),
                  10 * UdwadiaKalaba::rank_tolerance * mechanics.condition_of_rows + backward, "the row dropped");
    return;
  }
  // kept: the projection of all these rows, to what the small angle leaves of double precision
  std::vector<int> independent = mechanics.independent;
  independent.push_back(static_cast<int>(m));
  const test::ExactProjection exact = test::project_by_qr(mechanics.M, A(independent, Eigen::all), b(independent));
  const double angle = test::condition_number(B(independent, Eigen::all).cast<double>());
  const double tolerance = backward * angle;
  expect_within(largest_extended(T - white.map(exact.T)), tolerance, "T");
  expect_within(largest_extended(white.acceleration(projection.Lb().cast<long double>() - exact.Lb)), tolerance * scale, "L b");
}

// One state of many where the constraints contradict each other.
RC_GTEST_PROP(MechanicsProperty, AContradictionAtOneStateOfManyIsFoundThere, ()) {
  RandomStream random = stream();
  const RandomMechanics mechanics = test::random_mechanics(random, 1);
  RC_PRE(mechanics.rank() < mechanics.A.rows());
  const int n_states = *rc::gen::inRange(1, 30).as("states");
  const int wrong = *rc::gen::inRange(0, n_states).as("the wrong one");
  const double amount = std::pow(10.0, -*rc::gen::inRange(0, 5).as("digits of the contradiction"));
  const UdwadiaKalaba projection = projection_of(mechanics);
  // a right-hand side that no combination of the columns reaches, relative to each row
  const test::Whitening white(mechanics.M);
  const auto [B, norms] = white.rows(mechanics.A.cast<long double>());
  const Eigen::JacobiSVD<MatrixXd> svd(B.cast<double>(), Eigen::ComputeFullU);
  const double size = std::max(projection.size_of_b(), 1e-3);
  const VectorXd outside =
      amount * size * svd.matrixU().rightCols(1).cwiseProduct(norms.cast<double>().cwiseMax(std::numeric_limits<double>::min()));

  CallableSystem::Definition definition;
  definition.declaration.name = "random";
  for (Index j = 0; j < mechanics.n(); ++j) definition.declaration.coordinates.push_back({fmt::format("q{}", j + 1)});
  for (Index k = 0; k < mechanics.A.rows(); ++k) definition.constraints.push_back({fmt::format("row {}", k + 1)});
  definition.evaluate = [&](const auto& states, const auto&) {
    const Index N = states.cols();
    SystemValues values{mechanics.M.reshaped().replicate(1, N), mechanics.A.reshaped().replicate(1, N),
                        mechanics.b.replicate(1, N), MatrixXd::Zero(mechanics.n(), N)};
    for (Index i = 0; i < N; ++i) {
      if (states(0, i) == wrong) values.constraint_vector.col(i) += outside;
    }
    return values;
  };
  const CallableSystem system(definition);
  MatrixXd states = MatrixXd::Zero(system.layout().size(), n_states);
  states.row(0).setLinSpaced(0, n_states - 1);
  const MechanicsBatch batch = evaluate_mechanics(system, states, VectorXd());
  RC_ASSERT(batch.fault.has_value());
  RC_ASSERT(batch.fault->state == wrong);
  states.row(0).array() += n_states;
  RC_ASSERT(!evaluate_mechanics(system, states, VectorXd()).fault);
}

}  // namespace
}  // namespace gp2
