#include <boost/multiprecision/cpp_bin_float.hpp>
#include <boost/multiprecision/eigen.hpp>

#include <gtest/gtest.h>

#include "gp2/inference/inducing.hpp"
#include "inference/problems.hpp"

// The likelihood and its gradient in double precision against 50 digits, up to condition numbers of 1e12.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;
using test::Problem;
using Real = boost::multiprecision::cpp_bin_float_50;
using RealMatrix = Eigen::Matrix<Real, Eigen::Dynamic, Eigen::Dynamic>;
using RealVector = Eigen::Matrix<Real, Eigen::Dynamic, 1>;

constexpr std::uint64_t likelihood_precision_seed = 20270;

// Everything that can be tuned, in 50 digits: logarithms of lengthscales, signal and noise standard deviations.
struct Tuned {
  RealVector lengthscale, signal, noise;

  explicit Tuned(const ModelValues& values)
      : lengthscale(logarithms(values.kernel[0])),
        signal(logarithms(values.signal_stddev[0])),
        noise(logarithms(values.noise_stddev[0])) {}

 private:
  static RealVector logarithms(const VectorXd& v) { return v.cast<Real>().array().log(); }
};

// −log N(y; L b, T K Tᵀ + S) of a prior on the acceleration with one se kernel, as the paper writes it: dense, with M⁻¹, in 50
// digits of the M, A and b that double precision gives
class Reference {
 public:
  explicit Reference(const Problem& p) {
    const Observations& group = p.observations[0];
    const Index nq = p.prior.system->nq();
    features_ = evaluate_features(p.prior, 0, group.states()).cast<Real>();
    const SystemValues values = p.prior.system->evaluate(group.states(), p.values.parameters);
    residual_.resize(group.values().size());
    for (int i = 0; i < values.n_states(); ++i) {
      const RealMatrix A = values.A(i).cast<Real>();
      const RealMatrix M_inverse_At = values.M(i).cast<Real>().partialPivLu().solve(A.transpose().eval());
      const RealMatrix L = (A * M_inverse_At).partialPivLu().solve(M_inverse_At.transpose().eval()).transpose();
      T_.push_back(RealMatrix::Identity(nq, nq) - L * A);
      residual_.segment(i * nq, nq) = group.values().col(i).cast<Real>() - L * values.b(i).cast<Real>();
    }
  }

  [[nodiscard]] Real evaluate(const Tuned& tuned) const {
    const Index N = features_.rows(), nq = tuned.signal.size();
    const RealVector weight = (Real(-2) * tuned.lengthscale).array().exp();
    const RealVector variance = (Real(2) * tuned.signal).array().exp();
    const RealVector noise = (Real(2) * tuned.noise).array().exp();
    RealMatrix covariance(N * nq, N * nq);
    for (Index i = 0; i < N; ++i) {
      for (Index j = 0; j <= i; ++j) {
        Real r2 = 0;
        for (Index d = 0; d < features_.cols(); ++d) {
          const Real difference = features_(i, d) - features_(j, d);
          r2 += weight[d] * difference * difference;
        }
        covariance.block(i * nq, j * nq, nq, nq) = exp(-r2 / 2) * (T_[static_cast<std::size_t>(i)] * variance.asDiagonal() *
                                                                   T_[static_cast<std::size_t>(j)].transpose());
      }
      covariance.diagonal().segment(i * nq, nq) += noise;
    }
    const Eigen::LLT<RealMatrix, Eigen::Lower> factor(covariance);
    const RealVector alpha = factor.solve(residual_);
    Real value = residual_.dot(alpha) / 2 + log(boost::math::constants::two_pi<Real>()) * (N * nq) / 2;
    for (Index k = 0; k < N * nq; ++k) value += log(factor.matrixLLT()(k, k));
    return value;
  }

 private:
  RealMatrix features_;
  std::vector<RealMatrix> T_;
  RealVector residual_;
};

// @param stretch  of the lengthscales: long ones bring the smallest eigenvalues of K̃ down to nothing, and those of K̃ + I to 1
Problem stretched_surface_problem(double stretch, double signal) {
  const Model& model = test::model("models/surface.toml");
  RandomStream random(likelihood_precision_seed);
  Problem p{"surface", make_prior(model), {}, {}, {}, {}};
  const MatrixXd states = test::draw(model, 14, likelihood_precision_seed).states;
  p.observations = {test::observe(model, View::all(View::Quantity::constrained_acceleration, *model.system), states, random)};
  p.values = test::random_values(p.prior, p.observations, random);
  p.values.kernel[0] *= stretch;
  p.values.signal_stddev[0] *= signal;
  return p;
}

// ‖K̃ + I‖, whose smallest eigenvalue is 1 or a little more
double largest_eigenvalue(const Problem& p) {
  const test::DenseObservations dense = test::dense_observations(p);
  const VectorXd whitening = p.values.noise_stddev[0].cwiseInverse().replicate(p.observations[0].n_data(), 1);
  const MatrixXd white = whitening.asDiagonal() * dense.covariance.cast<double>() * whitening.asDiagonal();
  return Eigen::SelfAdjointEigenSolver<MatrixXd>(white, Eigen::EigenvaluesOnly).eigenvalues().maxCoeff();
}

// The Cholesky factor is that of K̃ + I + δ, ‖δ‖ ≤ c n ε ‖K̃ + I‖ (Higham 2002, ch. 10), as are the entries of K̃ themselves, and
//
//     dNLL = ½ ⟨P − α̃α̃ᵀ, δ⟩ ≤ ½ ‖δ‖ (tr P + |α̃|²) ≤ c n² ε κ,    P = (K̃ + I)⁻¹, tr P ≤ n, |α̃|² about n,
//
// if all roundings conspire. They are n² independent ones, so that ε κ is what to expect of their sum; the gradient
// ½ ⟨P − α̃α̃ᵀ, ∂K̃⟩ loses the same, since P ∂K̃ is of order one.
TEST(LikelihoodPrecisionTest, IsWhatFiftyDigitsSayToRoundingTimesTheConditionNumber) {
  for (const auto& [stretch, target] : std::vector<std::pair<double, double>>{{1, 1e2},
                                                                              {1, 1e6},
                                                                              {1, 1e12},
                                                                              {30, 1e4},
                                                                              {30, 1e8},
                                                                              {1e3, 1e2},
                                                                              {1e3, 1e4},
                                                                              {1e3, 1e6},
                                                                              {1e3, 1e8},
                                                                              {1e3, 1e10},
                                                                              {1e3, 1e12}}) {
    const double signal = std::sqrt(target / largest_eigenvalue(stretched_surface_problem(stretch, 1)));
    const Problem p = stretched_surface_problem(stretch, signal);
    const double kappa = largest_eigenvalue(p);
    SCOPED_TRACE(
        fmt::format("lengthscales {} times as long, condition {:.1e}, seed {}", stretch, kappa, likelihood_precision_seed));
    EXPECT_NEAR(std::log10(kappa), std::log10(target), 0.5);

    Likelihood::Options options;
    options.noise_gradient = true;
    const Likelihood likelihood(p.prior, p.observations, p.values, options);
    Likelihood::Workspace workspace;
    ModelGradient gradient;
    const double value = likelihood.evaluate(p.values, &gradient, workspace);

    const Reference reference(p);
    const Tuned tuned(p.values);
    const Real exact = reference.evaluate(tuned);
    const double tolerance = 16 * eps * (kappa + std::abs(value));
    const double error = std::abs(static_cast<double>(Real(value) - exact));
    EXPECT_LE(error, tolerance);

    // derivatives in 50 digits by differences: truncated at h², rounded at 1e-50/h
    const Real h = 1e-15;
    double worst = 0, largest_slope = 0;
    const auto compare = [&](double analytic, RealVector Tuned::*member, Index k) {
      Tuned above = tuned, below = tuned;
      (above.*member)[k] += h;
      (below.*member)[k] -= h;
      const Real slope = (reference.evaluate(above) - reference.evaluate(below)) / (2 * h);
      worst = std::max(worst, std::abs(static_cast<double>(Real(analytic) - slope)));
      largest_slope = std::max(largest_slope, std::abs(static_cast<double>(slope)));
    };
    for (Index k = 0; k < tuned.lengthscale.size(); ++k) compare(gradient.log_kernel[0][k], &Tuned::lengthscale, k);
    for (Index k = 0; k < tuned.signal.size(); ++k) compare(gradient.log_signal_stddev[0][k], &Tuned::signal, k);
    for (Index k = 0; k < tuned.noise.size(); ++k) compare(gradient.log_noise_stddev[0][k], &Tuned::noise, k);
    EXPECT_LE(worst, 4 * tolerance);
    EXPECT_GT(largest_slope, 1) << "nothing was tested";
    RecordProperty(fmt::format("stretch_{}_condition_{:.0e}", stretch, target),
                   fmt::format("κ {:.1e}: value off by {:.1e}, gradient by {:.1e}; relative {:.1e}, {:.1e}; allowed {:.1e}",
                               kappa, error, worst, error / std::abs(value), worst / largest_slope, tolerance));
  }
}

// As many states as is asked for, measured values drawn from the prior, with noise so much below the signal.
Problem drawn_from_its_prior(int n, double stretch, double noise_to_signal) {
  Problem p = stretched_surface_problem(stretch, 1);
  const Model& model = test::model("models/surface.toml");
  RandomStream random(likelihood_precision_seed);
  const MatrixXd states = test::draw(model, n, likelihood_precision_seed).states;
  const View view = View::all(View::Quantity::constrained_acceleration, *model.system);
  p.values.noise_stddev = {noise_to_signal * p.values.signal_stddev[0]};
  const Posterior prior = Posterior(p.prior, {test::observe(model, view, states, random)}, p.values).without_data();
  const VectorXd drawn = prior.sample({{view, states}}, 1, likelihood_precision_seed);
  MatrixXd values = drawn.reshaped(view.size(), n);
  for (Index i = 0; i < values.cols(); ++i) {
    for (Index k = 0; k < values.rows(); ++k) values(k, i) += p.values.noise_stddev[0][k] * random.normal();
  }
  p.observations = {{states, view, values, p.values.noise_stddev[0], false}};
  return p;
}

// Elsewhere a jitter is added to k(Z, Z) here. The factor with pivots takes what double precision holds, and needs none. At n = 300
// the bound is off by 5e-7, 0.005 and 0.4 nats.
TEST(LikelihoodPrecisionTest, ThroughInducingPointsIsWhatFiftyDigitsSayHoweverSmallTheNoise) {
  constexpr int n = 60;
  for (const double stretch : {3.0, 1e3}) {
    for (const auto& [noise_to_signal, allowed] :
         std::vector<std::pair<double, double>>{{1e-3, 0.01}, {1e-5, 0.01}, {1e-6, 0.5}}) {
      SCOPED_TRACE(fmt::format("lengthscales {} times as long, noise {} of the signal, seed {}", stretch, noise_to_signal,
                               likelihood_precision_seed));
      Problem p = drawn_from_its_prior(n, stretch, noise_to_signal);
      const InducingChoice choice = choose_inducing_points(p.prior, p.observations, p.values, {.most = 3 * n, .left_out = 1e-12});
      p.values.inducing = choice.points;
      const double bound = test::evaluate(p).value;
      const double exact = static_cast<double>(Reference(p).evaluate(Tuned(p.values)));
      EXPECT_NEAR(bound, exact, allowed);
      RecordProperty(fmt::format("stretch_{}_noise_{:.0e}", stretch, noise_to_signal),
                     fmt::format("{} of {} variables, off by {:.1e} nats", choice.n_variables, 3 * n, bound - exact));
    }
  }
}

}  // namespace
}  // namespace gp2
