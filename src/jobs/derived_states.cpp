#include "jobs/derived_states.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/parallel.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/check.hpp"
#include "smoothing/constrained_states.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

/// What the measured coordinates of an episode are off the constraints among them, in the median over its rows.
struct Misfit {
  double size = 0;  // standard deviations
  VectorXd move;    // to where they meet them, as that of ConstrainedStates::Contradiction (2 nq)
  VectorXd stddev;  // usual, of the same
  int n_constraints = 0;

  /// Beyond what noise does that is twice what was found, and motions that are smoothed a little too much.
  [[nodiscard]] bool is_clear() const {
    constexpr double deviations = 4;
    return size > deviations;
  }
};

/// Says so where measured coordinates contradict the constraints among them by more than noise does.
std::optional<std::string> contradiction_of(const std::vector<Misfit>& of_episodes, const std::vector<std::string>& names) {
  const auto n_clear = std::ranges::count_if(of_episodes, &Misfit::is_clear);
  if (n_clear == 0) return std::nullopt;
  const Misfit& worst = *std::ranges::max_element(of_episodes, {}, &Misfit::size);
  // where all move together some hardly do
  std::vector<std::string> moves;
  for (Index k = 0; k < worst.move.size(); ++k) {
    if (worst.move[k] > worst.stddev[k] && worst.stddev[k] > 0)
      moves.push_back(fmt::format("{} by {:.2g}", names[static_cast<std::size_t>(k)], worst.move[k]));
  }
  const bool alone = worst.n_constraints == 1;
  return fmt::format(
      "measured coordinates contradict the constraints among them, by {:.2g} standard deviations in the median{}; to meet them "
      "{} would have to move, {}: are their units, signs and zeros, and the lengths, those of the model?",
      worst.size, of_episodes.size() > 1 ? fmt::format(", in {} of {} episodes", n_clear, of_episodes.size()) : "",
      alone ? "one" : "all", fmt::join(moves, alone ? " or " : ", "));
}

/// The rows of all episodes under the constraints, put together one after another.
class ConstrainedRows {
 public:
  ConstrainedRows(const Model& model, const std::string& log, const DeriveOptions& options, const std::vector<EpisodeRows>& rows,
                  const std::vector<std::vector<Eigen::Matrix3d>>& covariance, DerivedData& data)
      : model_(model),
        system_(*model.system),
        log_(log),
        options_(options),
        rows_(rows),
        covariance_(covariance),
        states_(model, data.measured),
        data_(data) {
    data_.completed = states_.completed();
    completed_ = names_of(data_.completed);
  }

  void apply() {
    data_.independent = data_.measured;
    data_.is_independent = DerivedData::Mask::Constant(system_.nq(), data_.states.cols(), false);
    for (const int j : data_.measured) data_.is_independent.row(j) = true;
    if (data_.states.cols() == 0) return;

    const VectorXd start = start_of_newton();
    const int redundancy = redundancy_of(started(0, start));
    note_redundancy(redundancy, redundancy > 0 ? contradiction_of(misfits(start), system_.state_names()) : std::nullopt);
    const bool conditioned = options_.hold_constraints && redundancy > 0;
    for_each_episode([&](std::size_t e) { put_together(rows_[e], conditioned, start); });
    if (!completed_.empty()) data_.notes.push_back(fmt::format("from the constraints: {}", completed_));
    if (!conditioned) {
      leave_out_dependent();
      return;
    }
    std::erase_if(data_.independent, [&](int j) { return !data_.is_independent.row(j).any(); });
  }

 private:
  [[nodiscard]] std::string names_of(const std::vector<int>& coordinates) const {
    std::vector<std::string> names;
    for (const int j : coordinates) names.push_back(system_.coordinates()[static_cast<std::size_t>(j)].name);
    return fmt::format("{}", fmt::join(names, ", "));
  }

  template <typename Work>
  void for_each_episode(const Work& work) const {
    parallel_for(static_cast<int>(rows_.size()), thread_count(options_.n_threads),
                 [&](int e, int) { work(static_cast<std::size_t>(e)); });
  }

  /// Measured accelerations that follow from each other, as those of one sensor that is logged twice, are not all measurements.
  void leave_out_dependent() {
    const int nq = system_.nq();
    const auto independent =
        dependent_columns(system_, data_.states, system_.parameter_values(), data_.accelerations, data_.stddev.bottomRows(nq));
    if (!independent || std::ssize(data_.measured) < nq) return;
    data_.independent = *independent;
    for (int j = 0; j < nq; ++j) data_.is_independent.row(j) = std::ranges::find(*independent, j) != independent->end();
    data_.notes.push_back(
        fmt::format("the derived accelerations satisfy A ddq = b, or part of it, far more closely than noise allows: only {} of "
                    "{} are independent",
                    independent->size(), nq));
  }

  /// Where the model file wants the coordinates that are not measured to be sought: q, dq.
  [[nodiscard]] VectorXd start_of_newton() const {
    VectorXd start = VectorXd::Zero(2 * Index{system_.nq()});
    const std::vector<std::string> names = system_.state_names();
    for (Index k = 0; k < start.size(); ++k) {
      const auto given = model_.newton_start.find(names[static_cast<std::size_t>(k)]);
      if (given != model_.newton_start.end()) start[k] = given->second;
    }
    return start;
  }

  /// A row with what is not measured taken from elsewhere.
  [[nodiscard]] VectorXd started(Index i, const VectorXd& from) const {
    const StateLayout layout = system_.layout();
    VectorXd state = data_.states.col(i);
    for (const int j : data_.completed) {
      state[layout.q(j)] = from[j];
      state[layout.dq(j)] = from[layout.nq + j];
    }
    return state;
  }

  /// @param stddev  of q, dq (2 nq × N)
  [[nodiscard]] Misfit misfit_of(const EpisodeRows& rows, const VectorXd& start, const MatrixXd& stddev) const {
    const Index first = rows.first, n = rows.n();
    constexpr Index most_looked_at = 500;
    const Index step = std::max<Index>(1, n / most_looked_at);
    int n_constraints = 0;
    std::vector<double> sizes;
    std::vector<std::vector<double>> moves(static_cast<std::size_t>(stddev.rows()));
    VectorXd from = start;
    for (Index i = 0; i < n; ++i) {
      // what is solved for starts at its predecessor
      const bool looked_at = i % step == 0;
      if (!looked_at && data_.completed.empty()) continue;
      VectorXd state = started(first + i, from), acceleration = data_.accelerations.col(first + i);
      states_.approach(state, acceleration);
      from = state.head(2 * Index{system_.nq()});
      if (!looked_at) continue;
      const ConstrainedStates::Contradiction here = states_.contradiction(state, acceleration, stddev.col(first + i));
      if (!std::isfinite(here.size) || !here.move.allFinite()) continue;
      n_constraints = std::max(n_constraints, here.n_constraints);
      sizes.push_back(here.size);
      for (std::size_t k = 0; k < moves.size(); ++k) moves[k].push_back(std::abs(here.move[static_cast<Index>(k)]));
    }
    Misfit out{0, VectorXd::Zero(stddev.rows()), stddev.middleCols(first, n).rowwise().mean(), n_constraints};
    if (sizes.empty()) return out;
    out.size = median(sizes);
    for (std::size_t k = 0; k < moves.size(); ++k) out.move[static_cast<Index>(k)] = median(moves[k]);
    return out;
  }

  /// Of q, dq (2 nq × N), where measured; not below what files and models round.
  [[nodiscard]] MatrixXd stddev_of_states() const {
    constexpr double rounding = 1e-4;  // of the spread
    const Index nq = system_.nq();
    MatrixXd stddev = MatrixXd::Zero(2 * nq, data_.states.cols());
    for (const int j : data_.measured) {
      for (const EpisodeRows& rows : rows_) {
        const Index first = rows.first, n = rows.n();
        for (const Index row : {Index{j}, nq + j}) {  // q, dq stand first in a state too
          const Eigen::RowVectorXd course = data_.states.row(row).segment(first, n);
          const double spread = std::sqrt((course.array() - course.mean()).square().mean());
          stddev.row(row).segment(first, n) = data_.stddev.row(row).segment(first, n).cwiseMax(rounding * spread);
        }
      }
    }
    return stddev;
  }

  [[nodiscard]] std::vector<Misfit> misfits(const VectorXd& start) const {
    const MatrixXd stddev = stddev_of_states();
    std::vector<Misfit> out(rows_.size());
    for_each_episode([&](std::size_t e) { out[e] = misfit_of(rows_[e], start, stddev); });
    return out;
  }

  // a first row that is solved as well as it can be, to look at
  [[nodiscard]] int redundancy_of(VectorXd state) const {
    VectorXd acceleration = data_.accelerations.col(0);
    states_.approach(state, acceleration);
    return states_.redundancy(state);
  }

  /// Says what the constraints mean for measured coordinates alone, and throws where noise would contradict them.
  /// @param contradicted  by what, beyond noise
  void note_redundancy(int redundancy, const std::optional<std::string>& contradicted) {
    if (redundancy > 0 && !options_.hold_constraints) {
      const std::string fact = fmt::format("{} of the constraints hold{} among the measured coordinates alone", redundancy,
                                           redundancy == 1 ? "s" : "");
      if (!completed_.empty() && contradicted) {
        throw InputError(fmt::format("{}: {} cannot be solved for: {}", log_, completed_, *contradicted));
      }
      if (!completed_.empty()) {
        throw InputError(fmt::format(
            "{}: {}, which noise contradicts, so that {} cannot be solved for; hold the constraints (`hold_constraints`)", log_,
            fact, completed_));
      }
      if (!contradicted) data_.notes.push_back(fact + ": `hold_constraints` makes use of that");
    }
    if (contradicted) data_.notes.push_back(fmt::format("warning: {}: {}", log_, *contradicted));
    // a fit of a raw log holds what there is
    if (options_.hold_constraints && !options_.keep_positions && redundancy == 0 && system_.nc() > 0)
      data_.notes.emplace_back("no constraint holds among the measured coordinates alone: there is nothing to hold");
  }

  // rows of an episode follow one another: each starts at its predecessor
  void put_together(const EpisodeRows& rows, bool conditioned, VectorXd from) {
    for (Index row = rows.first; row < rows.first + rows.n(); ++row) {
      VectorXd state = started(row, from);
      if (conditioned) {
        hold_constraints(row, state);
      } else {
        complete(row, state);
      }
      data_.states.col(row) = state;
      from = state.head(2 * system_.nq());
    }
  }

  /// @throws NumericalError naming the log and what to log, where the constraints do not give what was not measured.
  void complete(Index row, VectorXd& state) {
    try {
      states_.complete(state, data_.accelerations.col(row));
    } catch (const NumericalError& error) {
      throw NumericalError(fmt::format(
          "{}: near t = {:.6g} the constraints do not determine {} from {}: a dead centre, or positions that no posture has "
          "({}). Log {} too, or another coordinate",
          log_, data_.states(system_.layout().t(), row), completed_, names_of(data_.measured), error.what(), completed_));
    }
  }

  void hold_constraints(Index row, VectorXd& state) {
    const Index nq = system_.nq();
    const std::vector<int>& measured = data_.measured;
    std::vector<Eigen::Matrix3d> covariance;
    for (const int j : measured) covariance.push_back(covariance_[static_cast<std::size_t>(j)][static_cast<std::size_t>(row)]);
    states_.condition(state, data_.accelerations.col(row), covariance);
    for (std::size_t k = 0; k < measured.size(); ++k) {
      const Eigen::Vector3d stddev = covariance[k].diagonal().cwiseMax(0).cwiseSqrt();
      for (int d = 0; d < 3; ++d) data_.stddev(d * nq + measured[k], row) = stddev[d];
    }
    // some accelerations say all others now: which may change along the motion
    VectorXd stddev(static_cast<Index>(measured.size()));
    for (Index k = 0; k < stddev.size(); ++k) {
      stddev[k] = std::max(data_.stddev(2 * nq + measured[static_cast<std::size_t>(k)], row), std::numeric_limits<double>::min());
    }
    data_.is_independent.col(row) = false;
    for (const int j : states_.independent_accelerations(state, stddev)) data_.is_independent(j, row) = true;
  }

  const Model& model_;
  const System& system_;
  const std::string& log_;
  const DeriveOptions& options_;
  const std::vector<EpisodeRows>& rows_;
  const std::vector<std::vector<Eigen::Matrix3d>>& covariance_;
  const ConstrainedStates states_;
  DerivedData& data_;
  std::string completed_;  // names of what was not measured
};

}  // namespace

void apply_constraints(const Model& model, const std::string& log, const DeriveOptions& options,
                       const std::vector<EpisodeRows>& rows, const std::vector<std::vector<Eigen::Matrix3d>>& covariance,
                       DerivedData& data) {
  ConstrainedRows(model, log, options, rows, covariance, data).apply();
}

}  // namespace gp2
