#pragma once

#include <memory>
#include <vector>

#include "gp2/base/workers.hpp"
#include "gp2/export.hpp"
#include "gp2/inference/model_values.hpp"
#include "gp2/observations.hpp"
#include "gp2/prior.hpp"

namespace gp2 GP2_API {

struct InducingOptions {
  int most = 1000;         // inducing variables of all latents together
  int of_discrepancy = 0;  // at most, of these, of a discrepancy
  double left_out = 1;     // t at which no more points are taken
  int n_candidates =
      5000;  // observed states that are looked at, spread evenly; half as many more where these do not stand for all
};

struct InducingChoice {
  std::shared_ptr<const InducingPoints> points;
  double left_out = 0;  // t of all observations, estimated from the candidates
  int n_variables = 0;  // M
};

/// Inducing points among the observed states, one after another: the latent and the state that reduce t of the bound most (greedy
/// pivoted Cholesky factorisation; theory.md, T37), until t is small, nothing is left in double precision, or there are enough. A discrepancy
/// has no part in t (T38), and gets its points after all others. Of more states than candidates t is taken of all of them; where it is far more than the
/// candidates tell, the stretches of which most is left out are candidates too.
/// @throws InputError where the options make no sense; and as Likelihood.
InducingChoice choose_inducing_points(const Prior& prior, const std::vector<Observations>& observations,
                                      const ModelValues& values, const InducingOptions& options = {},
                                      const Workers& workers = {});

/// t of the bound, per latent: what its points leave of its variance at all observed states, in units of the noise. The exact log
/// likelihood is higher than the bound, by about half of their sum where that is small.
/// @throws InputError  where values have no inducing points; and as Likelihood.
Eigen::VectorXd left_out_by_points(const Prior& prior, const std::vector<Observations>& observations, const ModelValues& values,
                                   const Workers& workers = {});

}  // namespace gp2
