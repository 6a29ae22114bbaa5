#include <algorithm>
#include <string>

#include <fmt/ranges.h>
#include <gtest/gtest.h>
#include <rapidcheck/gtest.h>

#include "inference/problems.hpp"

// Laws of Gaussian processes under random mechanics, priors and mixtures of views.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::eps;
using test::Problem;
using test::Quantity;

constexpr Index n_queries = 3;

void expect_at_most(double value, double bound, const std::string& law) {
  RC_LOG() << law << ": " << value << ", allowed " << bound << '\n';
  RC_ASSERT(value <= bound);
}

bool flip(const char* what) { return *rc::gen::arbitrary<bool>().as(what); }

std::string number(RandomStream& random) { return fmt::format("({:.6f})", random.normal()); }

std::string quoted(const std::vector<std::string>& texts) { return fmt::format("[\"{}\"]", fmt::join(texts, "\", \"")); }

// a table of expressions, one row per coordinate
std::string quoted_rows(const std::vector<std::vector<std::string>>& rows) {
  std::vector<std::string> texts;
  for (const auto& row : rows) texts.push_back(quoted(row));
  return fmt::format("[{}]", fmt::join(texts, ", "));
}

// coordinates q1 …, a parameter c that stands everywhere, `rank` independent rows of A and some that follow from them
std::string random_model(int n, int rank, int n_rows, RandomStream& random) {
  std::vector<std::string> coordinates, states;
  for (int j = 1; j <= n; ++j) coordinates.push_back(fmt::format("q{}", j));
  for (const std::string& q : coordinates) states.insert(states.end(), {q, "d" + q});
  states.emplace_back("u");
  const auto any_state = [&] { return states[static_cast<std::size_t>(random.uniform() * static_cast<double>(states.size()))]; };

  // M = root rootᵀ + c I, and a diagonal that changes with the state
  const MatrixXd root = test::random_vector(n * n, random).reshaped(n, n);
  const MatrixXd product = root * root.transpose();
  std::vector<std::vector<std::string>> mass(static_cast<std::size_t>(n));
  for (int i = 0; i < n; ++i) {
    for (int j = 0; j < n; ++j) {
      mass[static_cast<std::size_t>(i)].push_back(
          fmt::format("{:.6f}{}", product(i, j), i == j ? fmt::format(" + c*(1 + 0.3*sin(q{}))", i + 1) : ""));
    }
  }
  std::vector<std::string> force, rows;
  for (int i = 0; i < n; ++i) force.push_back(fmt::format("c*{}*{} + {}*u", number(random), any_state(), number(random)));
  for (int k = 0; k < rank; ++k) {
    std::string row = fmt::format("{}*{}^2 - c*{}", number(random), any_state(), number(random));
    for (int j = 1; j <= n; ++j) row += fmt::format(" + ({} + 0.2*c*sin({}))*ddq{}", number(random), any_state(), j);
    rows.push_back(row);
  }
  for (int k = rank; k < n_rows; ++k) {
    std::string row = "0";
    for (int of = 0; of < rank; ++of) row += fmt::format(" + {}*({})", number(random), rows[static_cast<std::size_t>(of)]);
    rows.push_back(row);
  }

  std::string text = fmt::format(
      "name = \"random\"\ncoordinates = {}\ninputs = [\"u\"]\n[parameters]\nc = 1.3\n[mechanics]\nmass = {}\nforce = {}\n"
      "[constraints]\nacceleration = {}\n",
      quoted(coordinates), quoted_rows(mass), quoted(force), rows.empty() ? "[]" : quoted(rows));
  const int n_latents = *rc::gen::inRange(1, 3).as("latents");
  for (int a = 0; a < n_latents; ++a) {
    const std::string kernel =
        *rc::gen::elementOf(std::vector<std::string>{"se", "matern32", "matern52", "rq", "periodic", "linear + constant",
                                                     "se + linear*periodic", "matern52*periodic + rq", "constant + se*linear"})
             .as("kernel");
    std::vector<std::string> features;
    for (int d = 1 + static_cast<int>(random.uniform() * 3); d > 0; --d) {
      const std::string feature = random.uniform() < 0.7 ? any_state() : fmt::format("sin({})*{}", any_state(), any_state());
      if (std::find(features.begin(), features.end(), feature) == features.end()) features.push_back(feature);
    }
    const int kind = *rc::gen::inRange(0, 4).as("directions");
    std::string directions = kind == 0 ? "\"acceleration\"" : "\"force\"";
    if (kind >= 2) {
      std::vector<std::vector<std::string>> entries(static_cast<std::size_t>(n));
      const int p = 1 + static_cast<int>(random.uniform() * 2);
      for (auto& row : entries) {
        for (int l = 0; l < p; ++l) row.push_back(fmt::format("{} + 0.3*c*{}", number(random), any_state()));
      }
      directions = kind == 2 ? quoted_rows(entries) : fmt::format("{{ force = {} }}", quoted_rows(entries));
    }
    text += fmt::format("[[latent]]\nname = \"f{}\"\nkernel = \"{}\"\nfeatures = {}\ndirections = {}\n", a + 1, kernel,
                        quoted(features), directions);
  }
  return text;
}

struct RandomProblem : Problem {
  double mechanics_condition = 1;  // worst over the states, of M and of the rows of B
};

RandomProblem random_problem() {
  RandomStream random(*rc::gen::noShrink(rc::gen::resize(rc::kNominalSize, rc::gen::arbitrary<std::uint32_t>())).as("stream"));
  const int n = *rc::gen::inRange(1, 5).as("coordinates");
  const int n_rows = *rc::gen::inRange(0, 4).as("rows");
  const int rank = n_rows == 0 ? 0 : *rc::gen::inRange(1, std::min(n, n_rows) + 1).as("rank");
  const Model model = Model::parse(random_model(n, rank, n_rows, random), "a random model");
  const System& system = *model.system;
  RandomProblem p;
  p.name = model.text;
  p.prior = make_prior(model, {flip("mean") ? Prior::Mean::force : Prior::Mean::zero, std::nullopt, false});

  const int n_groups = *rc::gen::inRange(1, 4).as("groups of observations");
  for (int g = 0; g < n_groups; ++g) {
    std::vector<Quantity> quantities = {Quantity::constrained_acceleration, Quantity::unconstrained_acceleration,
                                        Quantity::constraint_force, Quantity::next_velocity, Quantity::learned_force};
    if (n_rows > 0 && rank == n_rows) quantities.push_back(Quantity::multipliers);
    View view = View::all(*rc::gen::elementOf(quantities).as("quantity"), system);
    view.time_step = view.quantity == Quantity::next_velocity ? 0.1 : 0;
    if (random.uniform() < 0.3) view.rows = {view.rows.back()};
    if (random.uniform() < 0.2) view.latent = static_cast<int>(p.prior.latents.size()) - 1;
    MatrixXd states = test::random_vector(system.layout().size() * (1 + static_cast<int>(6 * random.uniform())), random)
                          .reshaped(system.layout().size(), Eigen::AutoSize);
    p.observations.push_back(test::observe(model, view, states, random));
  }
  p.values = test::random_values(p.prior, p.observations, random);
  p.queries = test::random_vector(system.layout().size() * n_queries, random).reshaped(system.layout().size(), n_queries);

  const auto add_conditions = [&](const MatrixXd& states) {
    const MechanicsBatch batch = require_mechanics(system, states, p.values.parameters);
    for (int i = 0; i < batch.values.n_states(); ++i) {
      const Eigen::LLT<MatrixXd> factor(batch.values.M(i));
      const double of_mass = 1 / factor.rcond();
      double of_rows = 1;
      if (n_rows > 0) {
        MatrixXd B = factor.matrixL().solve(batch.values.A(i).transpose()).transpose();
        B.rowwise().normalize();
        const VectorXd sigma = Eigen::JacobiSVD<MatrixXd>(B).singularValues();
        of_rows = sigma[0] / sigma[rank - 1];
      }
      p.mechanics_condition = std::max(p.mechanics_condition, of_mass * of_rows);
    }
  };
  for (const Observations& group : p.observations) add_conditions(group.states());
  add_conditions(p.queries);
  RC_PRE(p.mechanics_condition < 1e3);
  RC_LOG() << model.text;
  for (const Observations& group : p.observations) {
    RC_LOG() << group.view().quantity->word() << ", latent " << group.view().latent.value_or(-1).first << ", noise "
             << group.noise().stddev().transpose() << ", at\n"
             << group.states() << "\n:\n"
             << group.values() << '\n';
  }
  RC_LOG() << "queries\n" << p.queries << "\nkernel " << p.values.kernel[0].transpose() << '\n';
  return p;
}

// of anything computed once from the mechanics and K̃ + I
double rounding(const RandomProblem& p) { return 1e3 * eps * p.mechanics_condition * test::condition(p); }

Index n_values(const Problem& p) {
  Index n = 0;
  for (const Observations& group : p.observations) n += group.values().size();
  return n;
}

RC_GTEST_PROP(GpProperty, TheReducedLikelihoodIsTheDenseOne, ()) {
  const RandomProblem p = random_problem();
  Likelihood::Workspace workspace;
  const double reduced = Likelihood(p.prior, p.observations, p.values, {}).evaluate(p.values, nullptr, workspace);
  const double dense = test::dense_negative_log_likelihood(p);
  expect_at_most(std::abs(reduced - dense), rounding(p) * (static_cast<double>(n_values(p)) + std::abs(dense)), "−log p(y)");
}

RC_GTEST_PROP(GpProperty, ThePosteriorIsTheTextbookOne, ()) {
  const RandomProblem p = random_problem();
  const Posterior posterior(p.prior, p.observations, p.values);
  for (const Quantity quantity :
       {Quantity::constrained_acceleration, Quantity::unconstrained_acceleration, Quantity::constraint_force}) {
    const View view = View::all(quantity, *p.prior.system);
    const auto [mean, covariance] = test::dense_posterior(p, view, p.queries);
    const Posterior::Joint joint = posterior.joint(view, p.queries);
    expect_at_most(test::largest(joint.mean - mean), rounding(p) * (1 + test::largest(mean)), quantity->word() + ", mean");
    expect_at_most(test::largest(joint.covariance - covariance), rounding(p) * (1 + test::largest(covariance)),
                   quantity->word() + ", covariance");
  }
}

RC_GTEST_PROP(GpProperty, MeansSamplesAndCovariancesObeyTheConstraints, ()) {
  const RandomProblem p = random_problem();
  const System& system = *p.prior.system;
  const int n = system.nq();
  const View ddq = View::all(Quantity::constrained_acceleration, system);
  const Posterior posterior(p.prior, p.observations, p.values);
  const Posterior::Joint joint = posterior.joint(ddq, p.queries);
  const Posterior::Marginal marginal = posterior.marginal(ddq, p.queries);
  const MatrixXd samples = posterior.sample({{ddq, p.queries}}, 5, 1);
  const MechanicsBatch mechanics = require_mechanics(system, p.queries, p.values.parameters);
  for (int i = 0; i < n_queries; ++i) {
    const MatrixXd A = mechanics.values.A(i);
    const VectorXd b = mechanics.values.b(i);
    // T and L b are applied last: rounding is that of the mechanics alone, whatever the condition of K̃ + I
    const double tolerance = 1e2 * eps * p.mechanics_condition * (1 + test::largest(A));
    const auto obeys = [&](const VectorXd& acceleration, const std::string& what) {
      if (A.rows() > 0) expect_at_most(test::largest(A * acceleration - b), tolerance * (1 + test::largest(acceleration)), what);
    };
    obeys(joint.mean.segment(i * n, n), "A μ = b");
    obeys(marginal.mean.col(i), "A μ = b, marginal");
    for (Index s = 0; s < samples.cols(); ++s) obeys(samples.col(s).segment(i * n, n), "A sample = b");
    const MatrixXd covariance = joint.covariance.middleRows(i * n, n);
    expect_at_most(test::largest(A * covariance), tolerance * (1 + test::largest(joint.covariance)), "A Σ = 0");
    const MatrixXd of_state = marginal.covariance.col(i).reshaped(n, n);
    expect_at_most(test::largest(A * of_state * A.transpose()),
                   tolerance * (1 + test::largest(A)) * (1 + test::largest(of_state)), "A Σ Aᵀ = 0");
  }
}

RC_GTEST_PROP(GpProperty, TheGradientIsThatOfDifferenceQuotients, ()) {
  const RandomProblem p = random_problem();
  Likelihood::Options options;
  options.noise_gradient = true;
  options.gradient_parameters = {0};
  const Likelihood likelihood(p.prior, p.observations, p.values, options);
  Likelihood::Workspace workspace;
  ModelGradient gradient;
  const double value = likelihood.evaluate(p.values, &gradient, workspace);
  RC_ASSERT(std::isfinite(value));
  const double precision = 64 * eps * p.mechanics_condition * (1 + test::condition(p) / 100);
  const auto compare = [&](const std::string& name, double analytic, const auto& member, bool positive) {
    const double start = member(p.values);
    const auto at = [&](double x) -> VectorXd {
      ModelValues moved = p.values;
      member(moved) = positive ? std::exp(x) : x;
      return VectorXd::Constant(1, likelihood.evaluate(moved, nullptr, workspace));
    };
    const double scale = positive ? 0.5 : 0.05 * start;
    const test::Difference difference = test::central_difference(at, positive ? std::log(start) : start, scale, precision);
    const testing::AssertionResult result = test::matches(VectorXd::Constant(1, analytic), difference);
    RC_LOG() << name << ": " << analytic << ", by differences " << difference.value << " ± " << difference.error << '\n';
    RC_ASSERT(static_cast<bool>(result));
  };
  for (std::size_t a = 0; a < p.prior.latents.size(); ++a) {
    for (Index k = 0; k < p.values.kernel[a].size(); ++k) {
      compare(
          "kernel", gradient.log_kernel[a][k], [&](auto& v) -> auto& { return v.kernel[a][k]; }, true);
    }
    for (Index l = 0; l < p.values.signal_stddev[a].size(); ++l) {
      compare(
          "signal", gradient.log_signal_stddev[a][l], [&](auto& v) -> auto& { return v.signal_stddev[a][l]; }, true);
    }
  }
  for (std::size_t g = 0; g < p.observations.size(); ++g) {
    for (Index k = 0; k < p.values.noise_stddev[g].size(); ++k) {
      compare(
          "noise", gradient.log_noise_stddev[g][k], [&](auto& v) -> auto& { return v.noise_stddev[g][k]; }, true);
    }
  }
  compare(
      "c", gradient.parameters[0], [&](auto& v) -> auto& { return v.parameters[0]; }, false);
}

RC_GTEST_PROP(GpProperty, MoreDataAddedIsTheSameAsConditioningAnew, ()) {
  const RandomProblem p = random_problem();
  const Posterior all(p.prior, p.observations, p.values);
  Posterior grown = all.without_data();
  for (std::size_t g = 0; g < p.observations.size(); ++g) {
    grown = update(std::move(grown), test::with_stddev(p.observations[g], p.values.noise_stddev[g]));
  }
  const View view = View::all(Quantity::unconstrained_acceleration, *p.prior.system);
  const auto compare = [&](const Posterior& one, const Posterior& other) {
    const Posterior::Joint joint = one.joint(view, p.queries), expected = other.joint(view, p.queries);
    RC_ASSERT(one.reduced_size() == other.reduced_size());
    expect_at_most(test::largest(joint.mean - expected.mean), rounding(p) * (1 + test::largest(expected.mean)), "mean");
    expect_at_most(test::largest(joint.covariance - expected.covariance), rounding(p) * (1 + test::largest(expected.covariance)),
                   "covariance");
    expect_at_most(std::abs(one.negative_log_likelihood() - other.negative_log_likelihood()),
                   rounding(p) * (static_cast<double>(n_values(p)) + std::abs(other.negative_log_likelihood())), "−log p(y)");
  };
  compare(grown, all);
  int n_states = 0;
  for (const Observations& group : p.observations) n_states += group.n_data();
  grown = remove_oldest(std::move(grown), *rc::gen::inRange(0, n_states + 1).as("states removed"));
  compare(grown, Posterior(p.prior, grown.observations(), grown.values()));
}

}  // namespace
}  // namespace gp2
