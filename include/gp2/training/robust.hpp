#pragma once

#include <vector>

#include "gp2/export.hpp"
#include "gp2/fit.hpp"
#include "gp2/inference/leave_one_out.hpp"

namespace gp2 GP2_API {

/// The observations without values that lie farther than 10 robust standard deviations (1.48 times the median distance) from the
/// median of their row, or are above 1e100 in size: scales and starting points are not to be set by a sensor that lost contact.
std::vector<Observations> without_gross_errors(std::vector<Observations> observations);
/// Of values (d × N) alone: NaN takes the place of those.
Eigen::MatrixXd without_gross_errors(const Eigen::MatrixXd& values);

struct RobustOptions {
  double threshold = 4;  // distance from which on a value is distrusted; of Gaussian values 6 in 100 000 are so far
  int max_rounds = 8;
};

/// fit() of observations some of which are wrong. A value is distrusted when it lies more than `threshold` standard deviations,
/// of the noise and the prediction, from what all others predict: r² > threshold² (v + σ²) by leave_one_out. Its noise is then
/// taken to be √(r² − v), under which its likelihood is largest (as in the relevance pursuit of Ament et al. 2024), its weight in
/// the fit being that much smaller. Hyperparameters and the choice of values are found in turns until choice and noise stay, from two
/// starts: outliers hide behind each other where a fit explains them all. The lower objective wins, plus what distrusting a value
/// at the threshold lowers it by, for each. What all others say of a value does not depend on its own noise, so one wrongly
/// distrusted is readmitted. Where more than half of a row's values are farther off than noise should be, distances are relative
/// to theirs: a noise that is stated too small makes no outliers. A value above 1e100 in size, whose square no sum holds, is left
/// out.
///
/// @returns the fit; its posterior's observations hold it as scale of their Noise, and report.distrusted lists the values.
/// @throws  as fit().
Fit fit_robust(const Prior& prior, const std::vector<Observations>& observations,
               const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options = {},
               const RobustOptions& robust = {});

}  // namespace gp2
