#include <gtest/gtest.h>

#include <algorithm>

#include "gp2/error.hpp"
#include "gp2/inference/pathwise.hpp"
#include "inference/sampling.hpp"
#include "observations_testing.hpp"
#include "prior/kernel_columns.hpp"

// Posteriors that grow and shrink with their data are those built anew.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::largest;
using test::Problem;
using test::Quantity;

constexpr std::uint64_t update_seed = 40405;

// columns of one of a problem's Observations, with the noise that its values give
Observations part_of(const Problem& p, std::size_t group, const std::vector<Index>& columns) {
  const Observations& all = p.observations[group];
  return {all.states()(Eigen::all, columns), all.view(), all.values()(Eigen::all, columns), p.values.noise_stddev[group], false};
}

Posterior without_data(const Problem& p) { return Posterior(p.prior, p.observations, p.values).without_data(); }

// Mean, covariance and likelihood agree to 1e-10, relative to their largest entry. What the two may differ by is the rounding of
// K̃ + I times its condition number, below 1e5 for these problems: some 1e-11.
void expect_equal(const Posterior& grown, const Posterior& anew, const Problem& p) {
  constexpr double tolerance = 1e-10;
  EXPECT_EQ(grown.reduced_size(), anew.reduced_size());
  EXPECT_NEAR(grown.negative_log_likelihood(), anew.negative_log_likelihood(),
              tolerance * (1 + std::abs(anew.negative_log_likelihood())));
  const View view = View::all(Quantity::unconstrained_acceleration, *p.prior.system);
  const Posterior::Joint joint = grown.joint(view, p.queries), expected = anew.joint(view, p.queries);
  EXPECT_LE(largest(joint.mean - expected.mean), tolerance * (1 + largest(expected.mean)));
  EXPECT_LE(largest(joint.covariance - expected.covariance), tolerance * (1 + largest(expected.covariance)));
  EXPECT_LE(largest(grown.mean(view, p.queries).reshaped() - expected.mean), tolerance * (1 + largest(expected.mean)));
}

// The observed states of a problem, oldest first, as pairs (group, column).
using Ages = std::vector<std::pair<std::size_t, Index>>;

Posterior built_anew(const Problem& p, const Ages& ages) {
  std::vector<Observations> observations;
  for (std::size_t group = 0; group < p.observations.size(); ++group) {
    std::vector<Index> columns;
    for (const auto& [of, column] : ages) {
      if (of == group) columns.push_back(column);
    }
    observations.push_back(part_of(p, group, columns));
  }
  return {p.prior, observations, p.values};
}

TEST(UpdateTest, AnyOrderOfAddingAndRemovingGivesThePosteriorBuiltAnew) {
  std::uint64_t stream = 0;
  for (const Problem& p : test::problems(12, update_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, update_seed));
    RandomStream random(update_seed, ++stream);
    const auto below = [&](Index n) { return static_cast<Index>(random.uniform() * static_cast<double>(n)); };
    Ages ages;
    Posterior posterior = without_data(p);
    for (int step = 0; step < 14; ++step) {
      // one to four states of one group; some are observed twice
      if (step % 3 != 2) {
        const std::size_t group = static_cast<std::size_t>(below(std::ssize(p.observations)));
        std::vector<Index> columns;
        for (Index k = below(4); k >= 0; --k) columns.push_back(below(p.observations[group].n_data()));
        for (const Index column : columns) ages.emplace_back(group, column);
        posterior = update(std::move(posterior), part_of(p, group, columns));
      } else {
        const Index n = below(static_cast<Index>(std::min<std::size_t>(ages.size(), 4)) + 1);
        ages.erase(ages.begin(), ages.begin() + n);
        posterior = remove_oldest(std::move(posterior), static_cast<int>(n));
      }
      if (step % 6 == 5) expect_equal(posterior, Posterior(p.prior, posterior.observations(), posterior.values()), p);
    }
    EXPECT_GT(posterior.reduced_size(), 0) << "nothing was tested";
    expect_equal(posterior, built_anew(p, ages), p);
  }
}

TEST(UpdateTest, RemovesInTheOrderOfAdding) {
  for (const Problem& p : test::problems(9, update_seed)) {
    if (p.observations.size() < 2) continue;
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, update_seed));
    // the constructor's observations group after group, whatever their rank; then those of the first group again, in one of their own
    Ages ages;
    for (std::size_t group = 0; group < p.observations.size(); ++group) {
      for (Index column = 0; column < p.observations[group].n_data(); ++column) ages.emplace_back(group, column);
    }
    Posterior posterior(p.prior, p.observations, p.values);
    ages.emplace_back(0, 1);
    ages.emplace_back(0, 0);
    posterior = update(std::move(posterior), part_of(p, 0, {1, 0}));
    const int n_first = p.observations[0].n_data();
    for (int n : {1, n_first, 1}) {
      posterior = remove_oldest(std::move(posterior), n);
      ages.erase(ages.begin(), ages.begin() + n);
      expect_equal(posterior, built_anew(p, ages), p);
    }
    EXPECT_EQ(posterior.observations().back().n_data(), 2);
  }
}

// most of them: what is left is conditioned anew, and keeps its order and the numbers by which the next go
TEST(UpdateTest, RemovesMostInTheOrderOfAddingToo) {
  for (const Problem& p : test::problems(9, update_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, update_seed));
    Ages ages;
    for (std::size_t group = 0; group < p.observations.size(); ++group) {
      for (Index column = 0; column < p.observations[group].n_data(); ++column) ages.emplace_back(group, column);
    }
    if (ages.size() < 4) continue;
    Posterior posterior(p.prior, p.observations, p.values);
    const Posterior held = posterior;
    const double before = held.negative_log_likelihood();
    for (const int n : {static_cast<int>(ages.size()) - 2, 1, 2}) {
      const Index column = n % p.observations[0].n_data();
      posterior = remove_oldest(std::move(posterior), n);
      ages.erase(ages.begin(), ages.begin() + n);
      expect_equal(posterior, built_anew(p, ages), p);
      posterior = update(std::move(posterior), part_of(p, 0, {column}));
      ages.emplace_back(0, column);
      expect_equal(posterior, built_anew(p, ages), p);
    }
    EXPECT_EQ(held.negative_log_likelihood(), before);
  }
}

TEST(UpdateTest, AWindowThatMovesForLongDoesNotDrift) {
  const Problem p = test::problems(30, update_seed).front();
  ASSERT_EQ(p.observations.size(), 1U);
  Posterior posterior = without_data(p);
  Ages ages;
  for (Index step = 0; step < 500; ++step) {
    const Index column = step % p.observations[0].n_data();
    posterior = update(std::move(posterior), part_of(p, 0, {column}));
    ages.emplace_back(0, column);
    if (step < 20) continue;
    posterior = remove_oldest(std::move(posterior), 1);
    ages.erase(ages.begin());
  }
  expect_equal(posterior, built_anew(p, ages), p);
}

TEST(UpdateTest, AWindowWhoseNoiseVariesHoldsNoGroupsWithoutStates) {
  const Problem p = test::problems(30, update_seed).front();
  Posterior posterior(p.prior, p.observations, p.values);
  const int n_given = p.observations[0].n_data();
  std::vector<Observations> added;
  for (int step = 0; step < 60; ++step) {
    const Index column = step % n_given;
    added.push_back(test::with_stddev(part_of(p, 0, {column}), (1.5 + 0.01 * step) * p.values.noise_stddev[0]));
    posterior = update(std::move(posterior), added.back());
    posterior = remove_oldest(std::move(posterior), 1);
    const auto n_added = std::min<std::size_t>(added.size(), 30);
    ASSERT_EQ(posterior.observations().size(), 1 + n_added) << step;
    ASSERT_EQ(posterior.values().noise_stddev.size(), 1 + n_added);
  }
  // hyperparameters call the group of the constructor by its number: it stays
  EXPECT_EQ(posterior.observations()[0].n_data(), 0);
  for (std::size_t k = 0; k < 30; ++k) {
    EXPECT_EQ(posterior.observations()[k + 1].states(), added[added.size() - 30 + k].states());
    EXPECT_EQ(posterior.values().noise_stddev[k + 1], added[added.size() - 30 + k].noise().stddev());
  }
  expect_equal(posterior, Posterior(p.prior, posterior.observations(), posterior.values()), p);
  posterior = remove_oldest(std::move(posterior), 30);
  EXPECT_EQ(posterior.observations().size(), 1U);
}

TEST(UpdateTest, AGrownPosteriorIsDescribedByItsObservationsAndValues) {
  const Problem p = test::problems(9, update_seed).front();
  Posterior posterior(p.prior, p.observations, p.values);
  const Index n = p.observations[0].n_data();
  // the same view and noise: the same group
  posterior = update(std::move(posterior), part_of(p, 0, {2, 3}));
  ASSERT_EQ(posterior.observations().size(), 1U);
  EXPECT_EQ(posterior.observations()[0].states().rightCols(2), p.observations[0].states().middleCols(2, 2));
  EXPECT_EQ(posterior.observations()[0].values().rightCols(2), p.observations[0].values().middleCols(2, 2));
  // another noise, and another view
  const Observations noisy = test::with_stddev(part_of(p, 0, {0}), 2 * p.values.noise_stddev[0]);
  posterior = update(std::move(posterior), noisy);
  const Observations both_rows = part_of(p, 0, {1});
  View first_row = both_rows.view();
  first_row.rows = {0};
  const Observations one_row(both_rows.states(), first_row, both_rows.values().topRows(1), both_rows.noise().stddev().head(1));
  posterior = update(std::move(posterior), one_row);
  ASSERT_EQ(posterior.observations().size(), 3U);
  EXPECT_EQ(posterior.values().noise_stddev[1], noisy.noise().stddev());
  EXPECT_EQ(posterior.values().noise_stddev[2], one_row.noise().stddev());
  expect_equal(posterior, Posterior(p.prior, posterior.observations(), posterior.values()), p);
  // of the first group nothing is left but its noise
  posterior = remove_oldest(std::move(posterior), static_cast<int>(n) + 2);
  ASSERT_EQ(posterior.observations().size(), 3U);
  EXPECT_EQ(posterior.observations()[0].n_data(), 0);
  EXPECT_EQ(posterior.observations()[0].states().rows(), p.observations[0].states().rows());
  EXPECT_EQ(posterior.values().noise_stddev[0], p.values.noise_stddev[0]);
  expect_equal(posterior, Posterior(p.prior, posterior.observations(), posterior.values()), p);
  posterior = update(std::move(posterior), part_of(p, 0, {4}));
  EXPECT_EQ(posterior.observations().back().states(), p.observations[0].states().col(4)) << "the youngest is the last";
  expect_equal(posterior, Posterior(p.prior, posterior.observations(), posterior.values()), p);
}

TEST(UpdateTest, WithoutItsDataIsThePriorAndLearnsAgain) {
  for (const Problem& p : test::problems(9, update_seed)) {
    SCOPED_TRACE(fmt::format("{}, seed {}", p.name, update_seed));
    Posterior posterior(p.prior, p.observations, p.values);
    int n = 0;
    for (const Observations& group : p.observations) n += group.n_data();
    posterior = remove_oldest(std::move(posterior), n);
    EXPECT_EQ(posterior.reduced_size(), 0);
    EXPECT_EQ(posterior.negative_log_likelihood(), 0);
    expect_equal(posterior, posterior.without_data(), p);
    posterior = update(std::move(posterior), p.observations.back());
    expect_equal(posterior,
                 Posterior(p.prior, {p.observations.back()},
                           [&] {
                             ModelValues values = p.values;
                             values.noise_stddev = {p.observations.back().noise().stddev()};
                             return values;
                           }()),
                 p);
  }
}

TEST(UpdateTest, ManyAtOnceAreAsGoodAsOneAfterAnother) {
  const Problem p = test::problems(60, update_seed).front();
  Posterior at_once = update(without_data(p), p.observations[0]);
  Posterior halves = update(Posterior(p.prior, {part_of(p, 0, {0, 1, 2})}, p.values),
                            {p.observations[0].states().rightCols(57), p.observations[0].view(),
                             p.observations[0].values().rightCols(57), p.values.noise_stddev[0], false});
  const Posterior anew(p.prior, p.observations, p.values);
  expect_equal(at_once, anew, p);
  expect_equal(halves, anew, p);
}

TEST(UpdateTest, NothingAddedOrRemovedChangesNothing) {
  const Problem p = test::problems(9, update_seed).front();
  const Posterior before(p.prior, p.observations, p.values);
  Posterior posterior = before;
  posterior = update(std::move(posterior), part_of(p, 0, {}));
  posterior = remove_oldest(std::move(posterior), 0);
  EXPECT_EQ(posterior.negative_log_likelihood(), before.negative_log_likelihood());
  EXPECT_EQ(posterior.observations()[0].states(), before.observations()[0].states());
}

TEST(UpdateTest, HappensInPlaceUnlessAnotherHoldsThePosterior) {
  const Problem p = test::problems(9, update_seed).front();
  Posterior posterior(p.prior, p.observations, p.values);
  const Prior* where = &posterior.prior();
  posterior = update(std::move(posterior), part_of(p, 0, {0}));
  posterior = remove_oldest(std::move(posterior), 1);
  EXPECT_EQ(&posterior.prior(), where);

  const Posterior held = posterior;
  const View view = View::all(Quantity::constrained_acceleration, *p.prior.system);
  const MatrixXd mean = held.mean(view, p.queries);
  posterior = update(std::move(posterior), part_of(p, 0, {1}));
  EXPECT_NE(&posterior.prior(), where);
  EXPECT_EQ(&held.prior(), where);
  EXPECT_EQ(held.mean(view, p.queries), mean);
  EXPECT_NE(posterior.mean(view, p.queries), mean);

  const PathwiseSamples paths = sample_paths(posterior, 1, {100, update_seed});
  const MatrixXd path = paths.evaluate(0, view, p.queries);
  posterior = remove_oldest(std::move(posterior), 3);
  EXPECT_EQ(paths.evaluate(0, view, p.queries), path);
}

TEST(UpdateTest, SamplesOfAGrownPosteriorHaveItsMoments) {
  const Model& surface = test::model("models/surface.toml");
  const GeneratedData data = generate(surface, {40, update_seed, VectorXd::Constant(3, 0.1)});
  const View ddq = View::all(Quantity::constrained_acceleration, *surface.system);
  Posterior posterior = test::surface_posterior(update_seed);
  posterior = update(std::move(posterior), {data.states, ddq, data.accelerations, VectorXd::Constant(3, 0.2), false});
  posterior = remove_oldest(std::move(posterior), 11);
  const std::vector<ViewAt> quantities =
      test::both_accelerations(*surface.system, test::draw(surface, 2, update_seed + 1).states);
  const Posterior::Joint joint = posterior.joint(quantities);
  test::expect_moments(posterior.sample(quantities, 4000, update_seed), joint);
  const PathwiseSamples paths = sample_paths(posterior, 1000, {200, update_seed});
  MatrixXd values(joint.mean.size(), paths.n_samples());
  for (int s = 0; s < paths.n_samples(); ++s) {
    Index row = 0;
    for (const ViewAt& quantity : quantities) {
      const MatrixXd at = paths.evaluate(s, quantity.view, quantity.states);
      values.col(s).segment(row, at.size()) = at.reshaped();
      row += at.size();
    }
  }
  test::expect_moments(values, joint);
}

// the call fails with a text that holds `text`, and leaves the posterior usable
template <typename Error, typename Call>
void expect_update_refused(Posterior& posterior, const std::string& text, const Call& call) {
  const double before = posterior.negative_log_likelihood();
  const int size = posterior.reduced_size();
  try {
    call(posterior);
    ADD_FAILURE() << "no error: " << text;
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what()).find(text), std::string::npos) << error.what();
  }
  EXPECT_EQ(posterior.negative_log_likelihood(), before);
  EXPECT_EQ(posterior.reduced_size(), size);
}

TEST(UpdateTest, RefusesWhatDoesNotFitAndKeepsThePosterior) {
  const Problem p = test::problems(9, update_seed).front();
  Posterior posterior(p.prior, p.observations, p.values);
  const Observations added = part_of(p, 0, {0, 1});
  expect_update_refused<InputError>(posterior, "states: a column is a state of", [&](Posterior& it) {
    it = update(std::move(it), test::with_states(added, added.states().topRows(3)));
  });
  for (int n : {-1, 10}) {
    expect_update_refused<InputError>(posterior,
                                      fmt::format("remove_oldest: there are 9 observed states, so n must be 0 … 9, got {}", n),
                                      [&](Posterior& it) { it = remove_oldest(std::move(it), n); });
  }
  expect_equal(posterior, Posterior(p.prior, p.observations, p.values), p);
}

TEST(UpdateTest, RefusesStatesWithoutMechanicsAndKeepsThePosterior) {
  const Model& model = test::model_of_a_mass_that_may_be_indefinite();
  const View view = View::all(Quantity::constrained_acceleration, *model.system);
  Posterior posterior(make_prior(model), {}, {{VectorXd::Ones(1)}, {VectorXd::Ones(2)}, {}, {}, VectorXd()});
  Observations added{MatrixXd::Zero(5, 1), view, MatrixXd::Zero(2, 1), VectorXd::Ones(2), false};
  posterior = update(std::move(posterior), added);
  MatrixXd singular = added.states();
  singular(0, 0) = 2;
  added = test::with_states(added, singular);
  expect_update_refused<InputError>(posterior, "mass matrix", [&](Posterior& it) { it = update(std::move(it), added); });
}

TEST(UpdateTest, RefusesNoiseTooSmallForDoublePrecisionAndKeepsThePosterior) {
  const Problem p = test::problems(9, update_seed).front();
  Posterior posterior(p.prior, p.observations, p.values);
  // the same state over and over, known to 1e-12 of its size
  const Observations added = test::with_stddev(part_of(p, 0, {0, 0, 0, 0, 0, 0, 0, 0}), 1e-12 * p.values.noise_stddev[0]);
  expect_update_refused<NumericalError>(posterior, "cannot be factored in double precision",
                                        [&](Posterior& it) { it = update(std::move(it), added); });
  posterior = update(std::move(posterior), part_of(p, 0, {0}));
  expect_equal(posterior, Posterior(p.prior, posterior.observations(), posterior.values()), p);
}

TEST(KernelColumnsTest, PointsComeAndGo) {
  const std::vector<std::string> names = {"x", "y"};
  const Kernel kernel = Kernel::parse("se*periodic + matern32 + linear", names);
  RandomStream random(update_seed);
  const MatrixXd features = test::random_vector(80, random).reshaped(40, 2);
  const VectorXd values = VectorXd::Constant(static_cast<Index>(kernel.parameters().size()), 1.3);
  KernelColumns columns(kernel, features.topRows(5), values);
  columns.append(features.middleRows(5, 3));   // whole vectors
  columns.append(features.middleRows(8, 12));  // more of them
  columns.erase({0, 3, 4, 19});
  columns.append(features.middleRows(20, 1));
  const std::vector<Index> kept = {1, 2, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 20};
  const KernelColumns anew(kernel, features(kept, Eigen::all), values);
  EXPECT_EQ(columns.n_points(), anew.n_points());
  EXPECT_EQ(columns.scaled(), anew.scaled());
  EXPECT_EQ(columns.features(), anew.features());
}

}  // namespace
}  // namespace gp2
