#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include <gtest/gtest.h>

#include "gp2/inference/pathwise.hpp"
#include "gp2/posterior.hpp"
#include "inference/problems.hpp"

// What samples of any kind must show.
namespace gp2::test {

/// The acceleration with and without the constraint, together.
std::vector<ViewAt> both_accelerations(const System& system, const MatrixXd& states);

/// Mean and covariance over samples (one per column) are those of the distribution, within six standard errors of each entry.
void expect_moments(const MatrixXd& samples, const Posterior::Joint& joint);

/// ddq = L b + T ā in each sample of `both_accelerations`, one per column, to rounding.
void expect_gauss_principle(const MatrixXd& samples, const MechanicsBatch& mechanics);

/// Every quantity of every path, one path per column.
MatrixXd evaluate_all(const PathwiseSamples& paths, const std::vector<ViewAt>& quantities);

/// At the queries of p a predictor sees the posterior, and 400 paths have its moments.
void expect_predictor_and_paths(const Posterior& posterior, const Problem& p, const PathwiseOptions& options);

/// The particle on a surface, learned from 30 noisy states.
Posterior surface_posterior(std::uint64_t seed, double noise = 0.1);

}  // namespace gp2::test
