#pragma once

#include <cstddef>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "inference/latent_rows.hpp"

namespace gp2 {

/// Some observations, reduced and as the latents see them, with what they come from.
struct RowBlock {
  LatentRows rows;
  const std::vector<Observations>* observations = nullptr;
  const std::vector<ObservationModel>* models = nullptr;  // null where nothing but the rows is kept
  std::size_t first_group = 0;                            // of all Observations, that observations->front() is of
  Eigen::Index number = 0;                                // of the blocks
};

/// Observations as a solver is given them: block after block, each perhaps made when it is asked for.
class RowBlocks {
 public:
  /// What a block is made in; one per thread.
  struct Memory {
    std::vector<Observations> observations;
    std::vector<ObservationModel> models;
    Linearisation about;
    Reduction reduction;
    RowBlock block;
  };

  virtual ~RowBlocks() = default;
  [[nodiscard]] virtual Eigen::Index n_blocks() const = 0;
  /// Null where the mechanics or the prior have a fault at one of its states.
  /// @param with_derivatives  whether its models need those in the parameters
  [[nodiscard]] virtual const RowBlock* block(Eigen::Index b, bool with_derivatives, Memory& memory) const = 0;
};

/// All rows as one block, which must outlive it.
class WholeRows final : public RowBlocks {
 public:
  explicit WholeRows(const RowBlock& block) : block_(block) {}
  [[nodiscard]] Eigen::Index n_blocks() const override { return 1; }
  [[nodiscard]] const RowBlock* block(Eigen::Index, bool, Memory&) const override { return &block_; }

 private:
  const RowBlock& block_;
};

/// Blocks of few states of one Observations each, so that memory beside the observations does not grow with their number.
class BlocksOfStates final : public RowBlocks {
 public:
  static constexpr int block_size = 256;
  static constexpr std::size_t most_kept_bytes = 500'000'000;  // of which there is more is made anew each time

  /// What is made of blocks once, where parameters, or parameters and noise, stay.
  struct Kept {
    std::vector<ObservationModel> models;   // without the mechanics …
    std::optional<Reduction> reduction;     // … or in their place, without samples
    std::vector<Eigen::MatrixXd> features;  // per latent: of the states, or as sorted by the reduction

    [[nodiscard]] std::size_t bytes() const;
  };

  struct States {
    std::size_t group;
    int first, n;
  };

  /// What it is given by reference must outlive it.
  /// @param about                where a nonlinear prior is linear, at all states; null: where no latent acts
  /// @param gradient_parameters  in which the models may have derivatives
  /// @param kept                 of keep(), for the same observations; null: every block is made anew each time
  BlocksOfStates(const Prior& prior, const std::vector<Observations>& observations, const ModelValues& values,
                 const Linearisation* about, std::vector<int> gradient_parameters = {}, const std::vector<Kept>* kept = nullptr);

  [[nodiscard]] Eigen::Index n_blocks() const override { return std::ssize(states_); }
  [[nodiscard]] const RowBlock* block(Eigen::Index b, bool with_derivatives, Memory& memory) const override;

  [[nodiscard]] const States& states(Eigen::Index b) const { return states_[static_cast<std::size_t>(b)]; }
  /// Of a nonlinear prior: writes λ under the signals that `at` has, at the states of a block. Whether all of them have a motion.
  [[nodiscard]] bool solve_multipliers(Eigen::Index b, Linearisation& at) const;

  /// @param with_reduction  whether the noise stays too
  [[nodiscard]] Kept keep(const RowBlock& block, bool with_reduction) const;

 private:
  const Prior& prior_;
  const std::vector<Observations>& observations_;
  const ModelValues& values_;
  const Linearisation* about_;
  std::vector<int> gradient_parameters_;
  const std::vector<Kept>* kept_;
  std::vector<States> states_;
  std::vector<double>
      size_of_b_;  // per Observations, of some states evenly taken: what is rounding is not judged by a block alone
};

}  // namespace gp2
