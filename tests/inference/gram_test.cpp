#include "inference/gram.hpp"

#include <functional>

#include <gtest/gtest.h>
#include <Eigen/Cholesky>

#include "inference/dense_gram.hpp"
#include "inference/latent_sums.hpp"
#include "inference/problems.hpp"

// The laws of the seam between reduced observations and inference, for the solvers behind it.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::Problem;

constexpr std::uint64_t gram_seed = 50505;
constexpr int n_gram_data = 75;  // more than one tile of pairs

// The reduced observations of a problem; the rows point into it.
struct Reduced {
  Reduction reduction;
  LatentRows rows;

  explicit Reduced(const Problem& p) : Reduced(p, p.observations) {}
  Reduced(const Problem& p, const std::vector<Observations>& observations) {
    reduce(p.prior, observations, require_models(p.prior, observations, p.values.parameters, {}), p.values.noise_stddev,
           reduction);
    rows = latent_rows(p.prior, observations, reduction, p.values);
  }
  Reduced(const Reduced&) = delete;
  Reduced& operator=(const Reduced&) = delete;
};

// several latents, functions and components; ranks that differ
std::vector<Problem> gram_problems() {
  std::vector<Problem> chosen;
  for (Problem& p : test::problems(n_gram_data, gram_seed)) {
    if (p.name.starts_with("friction, two latents") || p.name == "a row that vanishes at some states") {
      chosen.push_back(std::move(p));
    }
  }
  return chosen;
}

// K̃ + I by its definition, rows as in the reduction
MatrixXd covariance(const LatentRows& rows) {
  const Reduction& reduction = *rows.reduction;
  MatrixXd K = MatrixXd::Identity(rows.size(), rows.size());
  for (const LatentRows::OfLatent& latent : rows.latents) {
    const MatrixXd features = latent.kernel.features().topRows(rows.n_samples());
    const MatrixXd k = latent.kernel.kernel().evaluate(features, features, latent.kernel.values());
    const Index m = latent.n_functions;
    for (int c = 0; c < reduction.n_components(); ++c) {
      for (int d = 0; d < reduction.n_components(); ++d) {
        const Index n = reduction.count[static_cast<std::size_t>(c)], o = reduction.count[static_cast<std::size_t>(d)];
        K.block(reduction.offset[static_cast<std::size_t>(c)], reduction.offset[static_cast<std::size_t>(d)], n, o) +=
            k.topLeftCorner(n, o).cwiseProduct(latent.Z.block(0, c * m, n, m) * latent.Z.block(0, d * m, o, m).transpose());
      }
    }
  }
  return K;
}

double negative_log_density(const LatentRows& rows) {
  DenseGram gram;
  const std::optional<GramValue> value = gram.factorise(rows);
  EXPECT_TRUE(value.has_value());
  return value->data_fit + value->complexity;
}

std::unique_ptr<LatentPosterior> conditioned(const LatentRows& rows) {
  auto posterior = std::make_unique<DensePosterior>(rows);
  EXPECT_TRUE(posterior->append(rows));
  return posterior;
}

// [f(x + h) − f(x − h)]/2h
double slope(const std::function<double(double)>& f) {
  constexpr double h = 1e-5;
  return (f(h) - f(-h)) / (2 * h);
}

void expect_slope(double derivative, const std::function<double(double)>& f) {
  const double expected = slope(f);
  EXPECT_NEAR(derivative, expected, 1e-6 * (1 + std::abs(expected)));
}

TEST(GramTest, ItsValueIsTheDensityOfTheReducedObservations) {
  for (const Problem& p : gram_problems()) {
    SCOPED_TRACE(p.name);
    const Reduced of(p);
    const Eigen::LLT<MatrixXd> factor(covariance(of.rows));
    const VectorXd& y = of.reduction.y;
    DenseGram gram;
    const std::optional<GramValue> value = gram.factorise(of.rows);
    ASSERT_TRUE(value.has_value());
    EXPECT_NEAR(value->data_fit, 0.5 * y.dot(factor.solve(y)), 1e-9 * (1 + value->data_fit));
    EXPECT_NEAR(value->complexity, MatrixXd(factor.matrixL()).diagonal().array().log().sum(), 1e-9 * (1 + value->complexity));
  }
}

TEST(GramTest, ItsGradientIsThatOfItsValue) {
  for (const Problem& p : gram_problems()) {
    SCOPED_TRACE(p.name);
    Reduced of(p);
    DenseGram gram;
    ASSERT_TRUE(gram.factorise(of.rows).has_value());
    const std::vector<GramGradientParts> everything(of.rows.latents.size(), {.kernel = true, .V = true, .mean = true});
    const GramGradient gradient = gram.differentiate(of.rows, everything);
    for (Index row = 0; row < of.rows.size(); row += 31) {
      double& y = of.reduction.y[row];
      const double before = y;
      expect_slope(gradient.alpha[row], [&](double h) {
        y = before + h;
        const double value = negative_log_density(of.rows);
        y = before;
        return value;
      });
    }
    for (std::size_t a = 0; a < of.rows.latents.size(); ++a) {
      LatentRows::OfLatent& latent = of.rows.latents[a];
      const GramGradient::OfLatent& of_latent = gradient.latents[a];
      const VectorXd values = latent.kernel.values();
      for (Index v = 0; v < values.size(); ++v) {
        expect_slope(of_latent.kernel[v], [&](double h) {
          VectorXd moved = values;
          moved[v] *= std::exp(h);
          latent.kernel.set_parameters(moved);
          const double value = negative_log_density(of.rows);
          latent.kernel.set_parameters(values);
          return value;
        });
      }
      for (Index column = 0; column < latent.Z.cols(); ++column) {
        const Index sample = 7 * (column + 1);
        if (latent.Z(sample, column) == 0) continue;  // it may have no such component
        double& z = latent.Z(sample, column);
        const double before = z;
        expect_slope(of_latent.V(sample, column), [&](double h) {
          z = before + h;
          const double value = negative_log_density(of.rows);
          z = before;
          return value;
        });
      }
      // a factor of a column of C scales that column of every component of Z
      VectorXd columns = VectorXd::Zero(latent.n_functions);
      for (Index column = 0; column < latent.Z.cols(); ++column) {
        columns[column % latent.n_functions] += latent.Z.col(column).dot(of_latent.V.col(column));
      }
      EXPECT_LE((of_latent.columns - columns).norm(), 1e-9 * (1 + columns.norm()));
    }
  }
}

TEST(GramTest, ItsInverseHoldsTheBlocksOfEachSample) {
  for (const Problem& p : gram_problems()) {
    SCOPED_TRACE(p.name);
    const Reduced of(p);
    DenseGram gram;
    ASSERT_TRUE(gram.factorise(of.rows).has_value());
    LatentPosterior::SampleSets each;
    for (Index s = 0; s < of.rows.n_samples(); ++s) each.push_back({s});
    const LatentPosterior::Inverse inverse = gram.invert(of.rows, each, {{2, 0}});
    const MatrixXd P = covariance(of.rows).inverse();
    EXPECT_LE((inverse.alpha - P * of.reduction.y).norm(), 1e-9 * inverse.alpha.norm());
    ASSERT_EQ(inverse.blocks.size(), of.reduction.samples.size());
    for (std::size_t s = 0; s < inverse.blocks.size(); ++s) {
      std::vector<Index> rows;
      for (Index c = 0; c < of.reduction.samples[s].R.rows(); ++c) {
        rows.push_back(of.reduction.offset[static_cast<std::size_t>(c)] + static_cast<Index>(s));
      }
      EXPECT_LE((inverse.blocks[s] - P(rows, rows)).norm(), 1e-9);
    }
    const std::vector<Index> of_both = rows_of_samples(of.reduction, {2, 0});
    const MatrixXd of_set = MatrixXd(P(of_both, of_both)).inverse();
    const VectorXd pull = of_set * (P * of.reduction.y)(of_both);
    ASSERT_EQ(inverse.without.size(), 1u);
    Index first = 0;
    for (std::size_t k = 0; k < 2; ++k) {
      const Index rank = of.reduction.samples[k == 0 ? 2 : 0].R.rows();
      EXPECT_LE((inverse.without[0].pull[k] - pull.segment(first, rank)).norm(), 1e-9 * (1 + pull.norm()));
      EXPECT_LE((inverse.without[0].covariance[k] - of_set.block(first, first, rank, rank)).norm(), 1e-9 * of_set.norm());
      first += rank;
    }
  }
}

TEST(GramTest, ItsGradientAndThePosteriorAgreeOnTheMeanOfTheLatents) {
  for (const Problem& p : gram_problems()) {
    SCOPED_TRACE(p.name);
    const Reduced of(p);
    DenseGram gram;
    ASSERT_TRUE(gram.factorise(of.rows).has_value());
    const GramGradient gradient =
        gram.differentiate(of.rows, std::vector<GramGradientParts>(of.rows.latents.size(), {.mean = true}));
    const std::unique_ptr<LatentPosterior> posterior = conditioned(of.rows);
    std::vector<MatrixXd> features;
    for (const LatentRows::OfLatent& latent : of.rows.latents) {
      features.emplace_back(latent.kernel.features().topRows(of.rows.n_samples()));
    }
    LatentSums sums(*posterior);
    sums.evaluate(features, std::nullopt);
    for (std::size_t a = 0; a < features.size(); ++a) {
      const MatrixXd mean = gradient.latents[a].mean.topRows(of.rows.n_samples());
      EXPECT_LE((sums.mean()[a].transpose() - mean).norm(), 1e-9 * (1 + mean.norm()));
    }
  }
}

TEST(LatentPosteriorTest, ItsWhiteningIsATriangleThatMakesTheCovarianceOfTheBasisOne) {
  for (const Problem& p : gram_problems()) {
    SCOPED_TRACE(p.name);
    const Reduced of(p);
    const std::unique_ptr<LatentPosterior> posterior = conditioned(of.rows);
    const Index n = posterior->size();
    MatrixXd X = MatrixXd::Identity(n, n);
    posterior->whiten(X);
    ASSERT_TRUE(posterior->whitens_by_factor());
    for (Index first = 0; first < n; first += 40) {
      const Index m = std::min<Index>(40, n - first);
      MatrixXd rows = posterior->triangle_rows(first, m);
      for (Index i = 0; i < m; ++i) rows(i, first + i) = 1 / rows(i, first + i);
      MatrixXd L = MatrixXd::Zero(m, n);
      for (Index i = 0; i < m; ++i) L.row(i).head(first + i + 1) = rows.row(i).head(first + i + 1);
      EXPECT_LE((L * X - MatrixXd::Identity(n, n).middleRows(first, m)).norm(), 1e-11 * L.norm() * X.norm());
      EXPECT_EQ(X.block(0, first, first, m).norm(), 0);
    }
    EXPECT_LE((X * covariance(of.rows) * X.transpose() - MatrixXd::Identity(n, n)).norm(), 1e-9);
  }
}

TEST(LatentPosteriorTest, SamplesThatCameAndWentLeaveItAsItWas) {
  for (const Problem& p : gram_problems()) {
    SCOPED_TRACE(p.name);
    const Reduced of(p);
    const std::unique_ptr<LatentPosterior> before = conditioned(of.rows);
    const std::unique_ptr<LatentPosterior> after = before->clone();
    const RowBlock block{of.rows};
    ASSERT_TRUE(after->append(WholeRows(block)));
    EXPECT_EQ(after->size(), 2 * before->size());
    EXPECT_EQ(before->size(), of.rows.size()) << "a clone is of its own";
    std::vector<Index> first_half;
    for (Index sample = 0; sample < of.rows.n_samples(); ++sample) first_half.push_back(sample);
    after->erase(first_half);
    ASSERT_EQ(after->size(), before->size());
    EXPECT_NEAR(after->value().data_fit, before->value().data_fit, 1e-8 * before->value().data_fit);
    EXPECT_NEAR(after->value().complexity, before->value().complexity, 1e-8 * before->value().complexity);
    for (std::size_t a = 0; a < before->latents().size(); ++a) {
      const MatrixXd& beta = before->latents()[a].beta;
      EXPECT_LE((after->latents()[a].beta - beta).norm(), 1e-6 * beta.norm());
    }
  }
}

}  // namespace
}  // namespace gp2
