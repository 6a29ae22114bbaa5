#pragma once

#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <Eigen/Dense>

#include "decompositions.hpp"
#include "gp2/inference/likelihood.hpp"
#include "gp2/model.hpp"
#include "gp2/posterior.hpp"
#include "observations_testing.hpp"
#include "test_models.hpp"

// Small regression problems of every kind, and the textbook Gaussian process they must agree with.
namespace gp2::test {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Extended = Eigen::Matrix<long double, Eigen::Dynamic, Eigen::Dynamic>;
using ExtendedVector = Eigen::Matrix<long double, Eigen::Dynamic, 1>;
using Quantity = View::Quantity;

struct Problem {
  std::string name;
  Prior prior;
  std::vector<Observations> observations;
  ModelValues values;
  MatrixXd queries;                        // states to predict at
  std::vector<std::string> not_estimable;  // parameters the likelihood is no smooth function of
};

/// A row of the constraint that vanishes where x = 0, where the motion is free: the rank of T differs from state to state.
const Model& model_with_a_vanishing_row();

/// A cart whose mass matrix is indefinite where |x| > 1.
const Model& model_of_a_mass_that_may_be_indefinite();

/// Quadratic friction whose speed has no derivative at rest, with two latents, and a parameter everywhere.
const Model& model_with_friction();

/// Latents whose directions and features read λ₀ of two constraints, on a mass matrix and forces with parameters.
const Model& model_with_a_load();

/// The same runner, whose friction is as large as the multipliers that it changes, beside a damping that is never negative and a latent
/// that is linear: none but the last is linear.
const Model& model_that_rubs();
/// The same where both constraints are soft, and b is larger by `bank`, `turn`, 0, where t is.
const Model& model_that_rubs_softly();

/// The same on another bank, with another mass.
const Model& another_bank();

/// What a model file has before its latents.
std::string before_latents(const Model& model);

/// `text` with every `from` changed to `to`.
std::string changed(std::string text, const std::vector<std::pair<std::string, std::string>>& changes);

/// Two wheels' constraints, one of which slips, that share a length, and an exact one.
const Model& model_with_a_slipping_wheel();

/// Constraints of all levels that come and go by an input and by the state, one of which slips, and a load that reads their λ₀.
const Model& model_with_contacts();

/// Two potentials of sums of kernels, one of which reads t, friction beside them, and parameters everywhere.
const Model& model_with_potentials();

/// The same on another track, with another mass.
const Model& another_swing();

/// Another, heavier particle on another surface; m, p1 and p5 are those of models/surface.toml.
const Model& another_surface();

/// The sledge with another mass on a runner that is turned; c and k are those of model_with_friction().
const Model& another_sledge();

View under(View view, std::shared_ptr<const OtherSystem> other_system);

ModelValues random_values(const Prior& prior, const std::vector<Observations>& observations, RandomStream& random);

Observations observe(const Model& model, View view, const MatrixXd& states, RandomStream& random);

/// Problems over the models of models/ and two of our own: all rows and some, constrained, unconstrained and both, mean zero and
/// force, prior on acceleration and on force.
std::vector<Problem> problems(int n, std::uint64_t seed);

/// Mean and loadings of a view on every latent at N states by the equations as the paper writes them, in extended precision.
struct DenseView {
  ExtendedVector mean;                         // (d·N)
  std::vector<std::vector<Extended>> loading;  // [state][latent] G E diag(s)  (d × p)
  std::vector<Extended> slip;                  // [state] of soft constraints (d × nc)
  std::vector<MatrixXd> features;              // per latent (N × D)
};

Extended pseudo_inverse(const Extended& matrix);

DenseView dense_view(const Prior& home, const ModelValues& values, const View& view, const MatrixXd& states);

Extended dense_covariance(const Prior& prior, const ModelValues& values, const DenseView& x, const DenseView& y);

/// σ of each value of a group (d × N).
MatrixXd noise_of_values(const Problem& p, std::size_t g);

/// The problem with a noise of its own for each value, from a third to three times that of its row.
Problem with_noise_scale(Problem p, std::uint64_t seed);

/// The problem with random sums over its states, as many as it has values: of every group where `every`, else of the first.
Problem with_sums(Problem p, bool every, std::uint64_t seed);

/// Everything observed, state after state, group after group: y ~ N(mean, K + S).
struct DenseObservations {
  ExtendedVector residual;  // y − mean
  Extended covariance;      // K + S
  Extended noise;           // S
  Extended sums;            // what is observed as sums of the values of the views
  std::vector<DenseView> views;
};

DenseObservations dense_observations(const Problem& p);

/// −log N(y; mean, K + S).
double dense_negative_log_likelihood(const Problem& p);

/// Mean and covariance of a view at states, given the observations, by the textbook formulas.
std::pair<VectorXd, MatrixXd> dense_posterior(const Problem& p, const View& view, const MatrixXd& states);

/// Largest over smallest eigenvalue of K̃ + I, or a little more: the signal to noise ratio. Bounds the loss of accuracy.
double condition(const Problem& p);

/// ε times that, after mechanics with κ(M) of some hundreds.
double rounding(const Problem& p);

Posterior posterior_of(const Problem& p);

View every_acceleration(const Problem& p);  // ā

/// Every derivative that the likelihood has, and its value with them.
Likelihood::Options every_derivative(const Problem& p);
struct Evaluated {
  double value = 0;
  ModelGradient gradient;
};
Evaluated evaluate(const Problem& p);

}  // namespace gp2::test
