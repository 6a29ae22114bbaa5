#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "gp2/base/workers.hpp"
#include "gp2/export.hpp"
#include "gp2/inference/likelihood.hpp"
#include "gp2/observations.hpp"
#include "gp2/prior.hpp"

namespace gp2 GP2_API {

class PathwiseSamples;
struct InducingSummary;
struct PathwiseOptions;

/// A view at N states: a quantity to predict, of d·N numbers.
struct ViewAt {
  View view;
  Eigen::MatrixXd states;  // (layout size × N)
};

/// A prior conditioned on observations (Geist & Trimpe 2020, eq. 6 and 7 under the prior of eq. 8, through the reduced form of
/// likelihood.hpp). Every quantity is noise-free: the latent one, not the next measurement. Projections are applied last, so
/// constrained means and samples obey A ddq = b, and covariances A Σ Aᵀ = 0, to rounding. Without observations it is the prior.
/// Immutable, cheap to copy, thread-safe. One that is given away can grow and shrink with its data: update, remove_oldest. Every
/// member function throws InputError when the posterior was moved away.
///
/// It may be a mixture, of posteriors under equally likely draws of hyperparameters (theory.md, T31): means and covariances are then
/// those of the mixture, and each sample is of one of its components.
class Posterior {
 public:
  /// @throws InputError when prior, observations and values do not fit each other; and as require_mechanics and
  /// require_prior_values, at an observed state.
  /// @throws NumericalError when the covariance cannot be factored in double precision (noise too small).
  /// @param workers  on it, where it is through inducing points
  Posterior(Prior prior, std::vector<Observations> observations, ModelValues values, const Workers& workers = {});
  /// The same, conditioned when it is first asked for more than what it was given: that call throws what the constructor throws.
  /// Through inducing points, which takes little, it is conditioned at once.
  [[nodiscard]] static Posterior lazy(Prior prior, std::vector<Observations> observations, ModelValues values);

  /// The posterior through inducing points that a summary is of.
  /// @param observations  that it still has
  /// @param values        of each component
  /// @throws InputError when they do not fit each other; NumericalError as the constructor.
  static Posterior of_summary(const Prior& prior, const std::vector<Observations>& observations,
                              const std::vector<ModelValues>& values, const InducingSummary& summary);
  /// What it knows of its observations where it is through inducing points, else null.
  [[nodiscard]] std::shared_ptr<const InducingSummary> summary() const;

  /// One component for each of several values, the first of which values() and negative_log_likelihood() tell.
  /// @throws InputError when there are none; and as the constructor.
  static Posterior mixture(const Prior& prior, const std::vector<Observations>& observations,
                           const std::vector<ModelValues>& values, const Workers& workers = {});
  [[nodiscard]] int n_components() const;
  /// @throws InputError when there is no such component.
  [[nodiscard]] Posterior component(int k) const;
  /// The mixture of these components.
  /// @throws InputError when there are none, or one of them does not exist.
  [[nodiscard]] Posterior components(const std::vector<int>& which) const;
  /// Few components, in ascending order, whose mixture is within `largest_error` of this one: a prediction costs so many times that
  /// of one component. The error is the root mean square, over the view at up to 300 of the observed states, of the difference of
  /// means and of that of standard deviations, in units of the standard deviation: at a single state it may be larger, and away from
  /// the data too. Entries without a deviation, but for rounding, do not count. Found one by one, each the one that lowers the error
  /// most; all where the error stays larger.
  /// @param view  what the few are to predict; not given: the constrained accelerations of the prior's own system
  /// @throws InputError when the error is not above 0; as marginal().
  [[nodiscard]] std::vector<int> fewest_components(double largest_error, const std::optional<View>& view = {}) const;

  /// E[view] at N states (d × N). A state's result is the same, to the bit, whatever other states are asked for and however many
  /// threads work.
  /// @param n_threads  that may work on it; 0: as many as the machine has
  /// @throws InputError as require_view, System::require_states, require_mechanics and require_prior_values; so do those below.
  [[nodiscard]] Eigen::MatrixXd mean(const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states, int n_threads = 1) const;

  struct Marginal {
    Eigen::MatrixXd mean;        // (d × N)
    Eigen::MatrixXd covariance;  // (d·d × N): column i is the covariance at state i, column-major
    int n_clipped = 0;           // variances that rounding made negative; they are set to 0

    [[nodiscard]] Eigen::MatrixXd stddev() const;  // (d × N)
  };
  /// Mean and covariance of the view at each state by itself. The mean is that of mean(), to the bit. The covariance is the same
  /// for any number of threads; which other states are asked for may change its last digits, since triangular systems are solved
  /// for blocks of states.
  [[nodiscard]] Marginal marginal(const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states, int n_threads = 1) const;
  /// The same, to the bit, in the memory of a block of states: take(number of the first state of a block, marginal of its states),
  /// block after block.
  void for_each_marginal(const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states, int n_threads,
                         const std::function<void(Eigen::Index first, const Marginal&)>& take) const;

  /// How far states lie from the observed ones (N), in the features that the latents of the view read, each weighed by what it
  /// changes (theory.md, T30). Nineteen of twenty observed states are within 1 of those observed at other times; beyond
  /// `far_from_data` standard deviations are too small as a rule. 0 where no feature is read, infinite without observations, NaN
  /// where all of them are of one time.
  [[nodiscard]] Eigen::VectorXd distance_from_data(const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                                   int n_threads = 1) const;
  static constexpr double far_from_data = 1.5;

  struct Potential {
    Eigen::VectorXd mean;    // E[V(φ(x)) − V(φ(x₀))]  (N) [J]
    Eigen::VectorXd stddev;  // its deviation          (N) [J]
  };
  /// The energy V of a latent that is a potential, less that at a reference: accelerations say nothing of a constant in it
  /// (theory.md, T45).
  /// @param latent     numbered from 0, as in the prior
  /// @param reference  the state x₀ (layout size)
  /// @throws InputError when there is no such latent or it is no potential, or as System::require_states.
  [[nodiscard]] Potential potential(int latent, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                    const Eigen::Ref<const Eigen::VectorXd>& reference) const;

  struct Joint {
    Eigen::VectorXd mean;        // quantity after quantity, in each state after state
    Eigen::MatrixXd covariance;  // as large
  };
  /// Mean and covariance of several quantities together.
  [[nodiscard]] Joint joint(const std::vector<ViewAt>& quantities) const;
  [[nodiscard]] Joint joint(const View& view, const Eigen::Ref<const Eigen::MatrixXd>& states) const;

  /// Draws from the joint distribution of several quantities, one per column, rows as in Joint. Latent functions are drawn at the
  /// distinct states and viewed afterwards: what views have in common, ddq = L b + T ā, holds sample by sample, to rounding.
  /// Costs the factorisation of a matrix of (latent functions × states) rows; for functions of the state see pathwise.hpp.
  [[nodiscard]] Eigen::MatrixXd sample(const std::vector<ViewAt>& quantities, int n_samples, std::uint64_t seed) const;

  /// The prior under the same hyperparameters, before any observation.
  [[nodiscard]] Posterior without_data() const;

  [[nodiscard]] const Prior& prior() const;
  /// Through inducing points (ModelValues::inducing) of more than 5000 states so many, evenly taken: memory does not grow with the
  /// number of rows that are learned from.
  [[nodiscard]] const std::vector<Observations>& observations() const;
  /// Observed states, in observations() or not.
  [[nodiscard]] std::int64_t n_states() const;
  [[nodiscard]] const ModelValues& values() const;
  /// σ of Observations g; of a mixture the root mean square of those of its components.
  [[nodiscard]] Eigen::VectorXd noise_stddev(std::size_t g) const;
  [[nodiscard]] double negative_log_likelihood() const;  // −log p(y), physical units, all constants
  [[nodiscard]] int reduced_size() const;                // rows of the factored matrix

  struct Implementation;  // posterior.cpp

 private:
  friend class Predictor;
  friend class OnlinePredictor;
  friend PathwiseSamples sample_paths(const Posterior& posterior, int n_samples, const PathwiseOptions& options);
  friend Posterior update(Posterior&& posterior, Observations added);
  friend struct LeftOut leave_out(const Posterior& posterior, int n_stretches);
  friend struct CSource export_c(const Posterior& posterior, const View& view, const struct CSourceOptions& options);
  friend void set_prior(Posterior& posterior, const Prior& prior);
  friend Posterior remove_oldest(Posterior&& posterior, int n);
  friend Posterior forget(Posterior&& posterior, double share);

  using Components = std::vector<std::shared_ptr<const Implementation>>;

  explicit Posterior(Components components);
  [[nodiscard]] const Components& held() const;                // throws when it was moved away
  [[nodiscard]] const Components& conditioned() const;         // those, conditioned
  [[nodiscard]] const Implementation& implementation() const;  // the first component; throws likewise
  // those of this one where nobody else holds them, else copies
  // @param conditions_anew  whether their latents are going to be conditioned anew: then they are copies without these
  [[nodiscard]] std::vector<std::shared_ptr<Implementation>> own_components(bool conditions_anew = false) const;

  Components components_;
};

/// The posterior of more observations, by extending its factor: O(n²) operations for each new number, where the reduced size is n
/// and a posterior built anew takes O(n³). The same as that one to rounding. Hyperparameters and parameters of the system are
/// held, and with them all scales. A nonlinear prior is conditioned anew, or through inducing points what was there stays linearised.
///
///     posterior = update(std::move(posterior), {x, ddq, y, sigma});
///
/// The noise of new observations is their own, or where they join a group that of each component; of earlier ones values().noise_stddev.
/// Where both view and noise_stddev(g) are those of the last group of observations() (through inducing points, of any) the new ones
/// join it behind its last, if both have a noise of each value or neither has; else they are a new group, with its noise in values().
/// So Posterior(prior(), observations(), values()) is always the posterior built anew, in which what comes first is the oldest.
///
/// In place where no copy of `posterior` is held, by PathwiseSamples either; else a copy is changed and the others
/// stay what they are. Memory is drawn for the factor only when what was set aside is full, and then for half as many rows again.
///
/// @throws InputError when the states are not as large as those of the system, and as the constructor; it and
/// NumericalError leave `posterior` as it was. Otherwise it is empty, as after any move.
[[nodiscard]] Posterior update(Posterior&& posterior, Observations added);

/// Gives a posterior another prior whose latents differ only at states where nothing was observed, as the discrepancy does whose range
/// grows (T23): nothing is conditioned anew. That they are the same at the observed states is not checked. In place as update.
void set_prior(Posterior& posterior, const Prior& prior);

/// The posterior in which the likelihood of all observations so far counts as its power `share`, 0 < share ≤ 1: before each update
/// what is old fades, as where a machine wears. Through inducing points only; O(M³). In place and otherwise as update.
/// @throws InputError when the share is out of range, or observations are known one by one: those go by remove_oldest.
[[nodiscard]] Posterior forget(Posterior&& posterior, double share);

/// The posterior without the n observed states that were added first; those given to the constructor count in their order, group
/// after group. Rows leave the factor by plane rotations, O(n²) operations each, as stable as a posterior built anew, which it is
/// where more than half of them go. A group that
/// update() added goes with its last state; one that was given to the constructor stays, without states, and keeps its noise,
/// since hyperparameters call it by its number. In place and otherwise as update.
/// @throws InputError when there are fewer, or what was learned went through inducing points; `posterior` is left as it was.
[[nodiscard]] Posterior remove_oldest(Posterior&& posterior, int n);

}  // namespace gp2
