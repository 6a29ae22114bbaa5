#pragma once

#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/fit.hpp"
#include "gp2/model.hpp"

namespace gp2 GP2_API {

/// A prior on ddq that knows no mechanics (Geist & Trimpe 2020, sec. 5): multi-output Gaussian processes with inputs and outputs
/// standardised by the training data (mean 0, standard deviation 1),
///
///     se   ddq_j ~ GP(0, s_j² k_SE), each output with lengthscales of its own,
///     icm  K = B₁ k_SE,
///     lmc  K = B₁ k_SE + B₂ k_bias + B₃ k_linear,    B_i = W_iW_iᵀ + diag κ_i,  W_i (nq × nq).
///
/// It is a Prior like any other: its system has unit masses and no constraints, so that ddq = ā, and the loadings of icm and lmc are free,
/// C = [W, diag √κ] (loading_entries). Observations, views and predictions need to know nothing of it.
struct Baseline {
  enum class Kind { se, icm, lmc };

  Kind kind = Kind::se;
  Eigen::VectorXd output_mean;                   // of the training ddq (nq): the prior mean
  Eigen::VectorXd feature_mean, feature_stddev;  // of the features in training (D), in which k_linear is x·x'

  static const std::vector<std::string>& words();  // "se", "icm", "lmc": the words of commands and files
  static std::string word(Kind kind);
  static std::optional<Kind> kind_of(std::string_view word);
};

/// A baseline of means 0 and standard deviations 1.
Baseline unstandardised(const Model& model, Baseline::Kind kind);

/// A baseline with the means and standard deviations of what it is to learn from.
Baseline standardised_by(const std::vector<Observations>& observations, const Prior& prior, Baseline::Kind kind);

/// The prior of a baseline over the features of all latents of a model, angles raw, and the entries of the state that its mechanics
/// read and no feature does.
/// @throws InputError when a mean or standard deviation has another size than outputs or features.
Prior make_baseline_prior(const Model& model, const Baseline& baseline);

/// What the prior of a fit is made of: the latents of its model, or a baseline instead.
struct FitPriorOptions : PriorOptions {
  FitPriorOptions() = default;
  FitPriorOptions(PriorOptions options) : PriorOptions(std::move(options)) {}

  std::optional<Baseline> baseline;  // replaces latents, mean, constraints; of the model it keeps the features, angles raw
};

/// make_prior or make_baseline_prior, make_other_system or another system that the baseline sees.
Prior make_prior(const Model& model, const FitPriorOptions& options);
std::shared_ptr<const OtherSystem> make_other_system(const Model& fitted, const Model& other, const FitPriorOptions& options);

/// An entry of a loading C = [W, diag √κ] that is tuned. Files call it by its kind and its index there.
struct LoadingEntry {
  enum class Kind { mixing /* W_jl, index j + p l */, sqrt_kappa /* √κ_j, index j */ };
  Kind kind;
  int row;     // j
  int column;  // l of W; of √κ: j
  int index;
  int index_in_loading;  // in C, column by column

  static const char* word(Kind kind);  // "mixing", "sqrt_kappa"
};

/// The entries of a latent's free loading, W first; none where it is not free.
std::vector<LoadingEntry> loading_entries(const Latent& latent);

/// What is tuned of a baseline prior, with the published starts and bounds, in units of the data's standard deviations:
/// lengthscales in [0.5, 20]; the signal of `se` in [0.1, 1]; W and κ without bounds that matter. No hyper-priors.
///
/// @param observations  of all accelerations, in order
std::vector<Hyperparameter> baseline_hyperparameters(const Prior& prior, const std::vector<Observations>& observations);

/// 30 restarts, and a coarser tolerance: baselines have many optima, so that starts count for more than digits.
FitOptions baseline_fit_options();

/// fit() of a baseline. The outputs of `se` are independent and are trained one by one: nq problems of N instead of one of nq N;
/// restart k of the report adds up the k-th best of each output.
Fit fit_baseline(Baseline::Kind kind, const Prior& prior, const std::vector<Observations>& observations,
                 const std::vector<Hyperparameter>& hyperparameters, const FitOptions& options = baseline_fit_options());

}  // namespace gp2
