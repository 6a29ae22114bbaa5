#include "inference/sampling.hpp"

#include "gp2/predictor.hpp"

namespace gp2::test {

std::vector<ViewAt> both_accelerations(const System& system, const MatrixXd& states) {
  return {{View::all(Quantity::constrained_acceleration, system), states},
          {View::all(Quantity::unconstrained_acceleration, system), states}};
}

void expect_moments(const MatrixXd& samples, const Posterior::Joint& joint) {
  ASSERT_EQ(samples.rows(), joint.mean.size());
  const double n = static_cast<double>(samples.cols());
  const MatrixXd centred = samples.colwise() - joint.mean;
  // where the constraint decides all, what is left is rounding
  const double rounding = 1e-9 * (1 + largest(samples));
  for (Index i = 0; i < samples.rows(); ++i) {
    const double stddev = std::sqrt(std::max(0.0, joint.covariance(i, i)));
    EXPECT_NEAR(centred.row(i).mean(), 0, 6 * stddev / std::sqrt(n) + rounding) << "row " << i;
    for (Index j = 0; j <= i; ++j) {
      const Eigen::ArrayXd products = centred.row(i).cwiseProduct(centred.row(j));
      const double error = std::sqrt((products - products.mean()).square().mean() / n);
      EXPECT_NEAR(products.mean(), joint.covariance(i, j), 6 * error + rounding * (1 + largest(centred)))
          << "rows " << i << " and " << j;
    }
  }
}

void expect_gauss_principle(const MatrixXd& samples, const MechanicsBatch& mechanics) {
  const Index n_states = mechanics.values.n_states(), nq = mechanics.values.force.rows();
  for (Index i = 0; i < n_states; ++i) {
    const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
    const MatrixXd ddq = samples.middleRows(i * nq, nq), a_bar = samples.middleRows((n_states + i) * nq, nq);
    const MatrixXd expected = (projection.T() * a_bar).colwise() + projection.Lb();
    EXPECT_LE(largest(ddq - expected), 100 * eps * (1 + largest(projection.T())) * (1 + largest(a_bar) + largest(ddq)));
  }
}

MatrixXd evaluate_all(const PathwiseSamples& paths, const std::vector<ViewAt>& quantities) {
  Index n_rows = 0;
  for (const ViewAt& at : quantities) n_rows += at.view.size() * at.states.cols();
  MatrixXd samples(n_rows, paths.n_samples());
  for (int s = 0; s < paths.n_samples(); ++s) {
    Index row = 0;
    for (const ViewAt& at : quantities) {
      const MatrixXd values = paths.evaluate(s, at.view, at.states);
      samples.col(s).segment(row, values.size()) = values.reshaped();
      row += values.size();
    }
  }
  return samples;
}

void expect_predictor_and_paths(const Posterior& posterior, const Problem& p, const PathwiseOptions& options) {
  const View view = View::constrained_acceleration(*p.prior.system);
  const Posterior::Marginal marginal = posterior.marginal(view, p.queries);
  const Predictor predictor(posterior, view);
  Predictor::Workspace workspace = predictor.make_workspace();
  const double tolerance = rounding(p);
  for (Index i = 0; i < p.queries.cols(); ++i) {
    VectorXd mean(view.size()), stddev(view.size());
    ASSERT_EQ(predictor.mean_and_stddev(p.queries.col(i).array().isNaN().select(0, p.queries.col(i)), mean, stddev, workspace),
              Predictor::Status::ok);
    EXPECT_LE(largest(mean - marginal.mean.col(i)), tolerance * (1 + largest(marginal.mean)));
    EXPECT_LE(largest(stddev.cwiseAbs2() - marginal.stddev().col(i).cwiseAbs2()),
              tolerance * (1 + largest(marginal.stddev().cwiseAbs2())));
  }
  const auto quantities = both_accelerations(*p.prior.system, p.queries);
  expect_moments(evaluate_all(sample_paths(posterior, 400, options), quantities), posterior.joint(quantities));
}

Posterior surface_posterior(std::uint64_t seed, double noise) {
  const Model& surface = model("models/surface.toml");
  const GeneratedData data = generate(surface, {30, seed, VectorXd::Constant(3, noise)});
  const View ddq = View::all(Quantity::constrained_acceleration, *surface.system);
  const Prior prior = make_prior(surface);
  std::vector<Observations> observations{{data.states, ddq, data.accelerations, VectorXd::Constant(3, noise), false}};
  RandomStream random(seed);
  ModelValues values = random_values(prior, observations, random);
  values.signal_stddev[0] *= row_stddev(data.accelerations).maxCoeff();
  return {prior, observations, values};
}

}  // namespace gp2::test
