#include "gp2/jobs/shoot_job.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <numbers>
#include <numeric>
#include <optional>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <Eigen/Eigenvalues>
#include <Eigen/QR>

#include "base/not_a_number.hpp"
#include "base/parallel.hpp"
#include "base/stop.hpp"
#include "data/evenly.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/pathwise.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/simulate.hpp"
#include "gp2/training/laplace.hpp"
#include "jobs/read_observations.hpp"
#include "simulation/contacts.hpp"

namespace gp2 {

namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Rows of the log, and where the motion over them starts.
struct Stretch {
  Index first = 0, size = 0;
  VectorXd start;
};

/// The motion over a stretch beside the log, and how both change.
struct Linearised {
  VectorXd residual;  // measured − predicted, row after row (compared · rows)
  MatrixXd by_theta;  // ∂ predicted / ∂x
  MatrixXd by_start;  // along `basis`
  MatrixXd basis;     // of changes of the start that keep to the constraints (2 nq × r)
};

class Shooter {
 public:
  Shooter(const FitFile& fit, const CsvTable& log, const ShootRequest& request, const std::atomic<bool>* stop)
      : fit_(fit),
        prior_(fit.prior()),
        system_(*fit.model.system),
        view_(View::constrained_acceleration(system_)),
        switching_(switching_functions(fit.model, /*of_latents=*/true)),
        n_threads_(thread_count(request.threads)),
        stop_(stop),
        hyperparameters_(fit.report.hyperparameters) {
    find_parameters();
    note_rows_that_are_gone(notes_);
    read(log, request.columns, notes_);
    cut(log, request);
  }

  ShootOutcome run() {
    drop_what_cannot_be_followed(notes_);
    ShootOutcome out;
    for (const int j : compared_) out.coordinates.push_back(system_.coordinates()[static_cast<std::size_t>(j)].name);
    std::vector<VectorXd> residuals = residuals_at(hyperparameters_, stretches_);
    out.rms_before = rms_of(residuals);
    double objective = objective_of(residuals);
    Step step;
    VectorXd weights;
    while (true) {
      weights = rms_of(residuals).cwiseInverse();
      const std::vector<Linearised> all = linearise(residuals);
      step = gauss_newton(all, weights);
      // an iteration that would change θ by a hundredth of its deviation is none
      out.converged = step.of_theta.cwiseAbs2().cwiseQuotient(step.inverse.diagonal()).maxCoeff() < 1e-4;
      if (out.converged || out.iterations == most_iterations || !advance(all, weights, step.of_theta, objective, residuals))
        break;
      ++out.iterations;
    }
    const LatentScatter by_latents = scatter_by_latents(step, weights, residuals);
    const VectorXd variance =
        has_errors() ? VectorXd(step.variance + by_latents.variance) : VectorXd::Constant(std::ssize(parameters_), not_a_number);
    out.rms_after = rms_of(residuals);
    out.duration = duration_;
    out.n_stretches = static_cast<int>(stretches_.size());
    out.notes = std::move(notes_);
    for (std::size_t a = 0; a < parameters_.size(); ++a) {
      const std::size_t k = parameters_[a];
      const Hyperparameter& before = fit_.report.hyperparameters[k];
      const Hyperparameter& after = hyperparameters_[k];
      const auto i = static_cast<Index>(a);
      out.parameters.push_back({before.name, before.unit, before.value, parameter_uncertainty(fit_.report, k).stddev, after.value,
                                std::sqrt(variance[i]) * std::abs(after.map().value_slope(after.value))});
      if (after.at_bound()) out.notes.push_back(fmt::format("warning: {} ended at a bound", after.name));
    }
    if (!out.converged) out.notes.emplace_back("warning: the last step still changed the parameters: shorter stretches may help");
    add_doubts(by_latents.rms, out);
    out.fit = fit_;
    out.fit.report.hyperparameters = hyperparameters_;
    out.fit.report.draws.reset();
    out.fit.report.uncertainty.reset();
    out.fit.notes.reset();
    const Posterior found = posterior_at(hyperparameters_);
    out.fit.report.negative_log_likelihood = found.negative_log_likelihood();
    out.fit.take_data(found);
    if (out.fit.report.inducing) out.fit.report.inducing->stretches.reset();  // which were of the parameters before
    out.fit.report.termination = "parameters by multiple shooting";
    return out;
  }

 private:
  [[nodiscard]] bool has_errors() const { return std::ssize(stretches_) >= least_stretches; }

  /// What speaks against the parameters: few stretches, motions farther off than errors of the log and of latents let them be, and a
  /// fit that disagrees.
  void add_doubts(const VectorXd& rms_by_latents, ShootOutcome& out) const {
    constexpr double far = 3;  // deviations
    std::vector<std::string> off, apart;
    for (std::size_t c = 0; c < stated_.size(); ++c) {
      const auto row = static_cast<Index>(c);
      const double relative = out.rms_after[row] / std::hypot(stated_[c], rms_by_latents[row]);
      if (relative > far) off.push_back(fmt::format("{}, {:.2g} times that", out.coordinates[c], relative));
    }
    for (const ShotParameter& one : out.parameters) {
      const double difference = std::abs(one.value - one.one_step) / std::hypot(one.stddev, one.one_step_stddev);
      if (difference > far) apart.push_back(fmt::format("{}, {:.2g} joint standard errors", one.name, difference));
    }
    if (!has_errors()) {
      out.notes.push_back(
          fmt::format("warning: no standard errors: they need {} stretches or more. Use a shorter `duration` or a longer log",
                      least_stretches));
    }
    if (!off.empty()) {
      out.notes.push_back(
          fmt::format("warning: the motion is farther off than errors of the log and of the latents explain: {}: an input, a "
                      "column or a force is wrong, or stretches are too long",
                      fmt::join(off, "; ")));
    }
    if (!apart.empty()) {
      out.notes.push_back(
          fmt::format("warning: the motion gives other values than the accelerations: {}: the log is not of the machine that was "
                      "fitted, smoothing changed its accelerations, or the model lacks something",
                      fmt::join(apart, "; ")));
    }
  }

  void find_parameters() {
    for (std::size_t k = 0; k < hyperparameters_.size(); ++k) {
      if (hyperparameters_[k].is_system_parameter() && !hyperparameters_[k].is_fixed()) parameters_.push_back(k);
    }
    if (parameters_.empty()) {
      throw InputError(
          fmt::format("the fit of '{}' estimates no parameter of the system; mark one by `estimate`, or by estimate = "
                      "true in the model, and fit again",
                      system_.name()));
    }
  }

  void note_rows_that_are_gone(std::vector<std::string>& notes) const {
    const std::vector<std::int64_t> n = fit_.n_states();
    const std::int64_t n_all = std::accumulate(n.begin(), n.end(), std::int64_t{0});
    if (n_all == n_states(fit_.observations)) return;
    notes.push_back(fmt::format("warning: the file of the fit holds {} of its {} rows, and latents are learned from these alone",
                                n_states(fit_.observations), n_all));
  }

  void read(const CsvTable& log, const std::map<std::string, std::string>& columns, std::vector<std::string>& notes) {
    LogReader reader = open_log(fit_.model, log, columns);
    states_ = reader.states(std::vector<bool>(static_cast<std::size_t>(system_.layout().size()), true));
    static_cast<void>(take_commands(system_, found(fit_.model.actuators), reader, std::nullopt, columns, states_, notes));
    for (int j = 0; j < system_.nq(); ++j) {
      const std::string& name = system_.coordinates()[static_cast<std::size_t>(j)].name;
      if (reader.stddev_column(name).empty()) continue;
      compared_.push_back(j);
      const MatrixXd stddevs = reader.stddevs({name});
      std::vector<double> known;
      std::ranges::copy_if(stddevs.reshaped(), std::back_inserter(known), [](double one) { return std::isfinite(one); });
      stated_.push_back(median(std::move(known)));
    }
    if (!compared_.empty()) return;
    compared_.resize(system_.coordinates().size());
    std::iota(compared_.begin(), compared_.end(), 0);
  }

  [[nodiscard]] auto times() const { return states_.row(system_.layout().t()); }

  // where the log goes on without a break
  void cut(const CsvTable& log, const ShootRequest& request) {
    const Index n = states_.cols();
    const double usual = usual_step(times());
    if (usual == 0) throw InputError(fmt::format("{}: t never increases from one row to the next", log.name()));
    const int episode = log.find("episode");
    find_clearance();
    std::vector<std::pair<Index, Index>> parts;
    for (Index i = 0; i < n; ++i) {
      const double step = i == 0 ? 0 : times()[i] - times()[i - 1];
      const bool goes_on = step > 0 && step < most_steps * usual &&
                           (episode < 0 || log.cell(static_cast<int>(i), episode) == log.cell(static_cast<int>(i - 1), episode));
      if (!goes_on) parts.emplace_back(i, 0);
      ++parts.back().second;
    }
    Index longest = 0;
    for (const auto& [first, rows] : parts) longest = std::max(longest, rows);
    const auto most_rows = static_cast<double>(std::max(longest / 2, least_rows));
    duration_ = request.duration.value_or(std::clamp(usual_duration(parts), (least_rows - 1) * usual, (most_rows - 1) * usual));
    if (!(duration_ > 0) || !std::isfinite(duration_))
      throw InputError(fmt::format("`duration`: must be positive and finite, got {}", duration_));
    if (request.most_stretches < 1)
      throw InputError(fmt::format("`stretches`: must be at least 1, got {}", request.most_stretches));
    // one that no part holds is as good as any longer one
    const auto size = static_cast<Index>(std::min(std::floor(duration_ / usual + 1e-9), static_cast<double>(longest))) + 1;
    std::vector<Stretch> found;
    for (const auto& [first, rows] : parts) {
      for (Index i = first; i + size <= first + rows;) {
        const bool starts = can_start(i);
        if (starts) found.push_back({i, size, states_.col(i)});
        i += starts ? size - 1 : 1;  // the row where one ends is that where the next starts
      }
    }
    if (size < least_rows || found.empty()) {
      throw InputError(
          fmt::format("{}: no stretch of {:.3g} s with at least {} rows without a break; rows are {:.3g} s apart: "
                      "another `duration`, or a log of all rows in order of time",
                      log.name(), duration_, least_rows, usual));
    }
    const std::size_t n_taken = std::min(found.size(), static_cast<std::size_t>(request.most_stretches));
    for (std::size_t k = 0; k < n_taken; ++k) stretches_.push_back(found[k * found.size() / n_taken]);
    spread_.resize(2 * Index{system_.nq()});
    for (Index e = 0; e < spread_.size(); ++e) {
      const double spread = row_stddev(states_.row(e))[0];
      spread_[e] = spread > 0 ? spread : 1;
    }
  }

  [[nodiscard]] bool is_closed(const Contact& contact, Index row) const {
    return states_(system_.layout().u(contact.input), row) > 0.5;
  }

  /// How far a gap must be open for the errors of a log not to hide it: twice the largest |gap| of what is closed, or beyond 0.
  void find_clearance() {
    contacts_ = contacts_of(fit_.model, system_.parameter_values());
    clearance_.setZero(std::ssize(contacts_));
    gaps_ = gaps_of(system_, contacts_, states_, system_.parameter_values());
    for (std::size_t k = 0; k < contacts_.size(); ++k) {
      const auto contact = static_cast<Index>(k);
      for (Index i = 0; i < states_.cols(); ++i) {
        const double off = is_closed(contacts_[k], i) ? std::abs(gaps_(contact, i)) : -gaps_(contact, i);
        clearance_[contact] = std::max(clearance_[contact], 2 * off);
      }
    }
  }

  /// A motion starts where each contact is surely closed or open: not at an impact, nor where its gap is lost in noise.
  [[nodiscard]] bool can_start(Index row) const {
    for (std::size_t k = 0; k < contacts_.size(); ++k) {
      const bool closed = is_closed(contacts_[k], row);
      if (row + 1 < states_.cols() && closed != is_closed(contacts_[k], row + 1)) return false;
      if (!closed && !(gaps_(static_cast<Index>(k), row) > clearance_[static_cast<Index>(k)])) return false;
    }
    return true;
  }

  /// 2/ω of the middle coordinate, the best of 1, 2, 4 on simulated logs: rms of its velocity over that of its changes in velocity.
  [[nodiscard]] double usual_duration(const std::vector<std::pair<Index, Index>>& parts) const {
    std::vector<double> durations;
    for (const int j : compared_) {
      const auto dq = states_.row(system_.layout().dq(j));
      double velocity = 0, acceleration = 0;
      for (const auto& [first, rows] : parts) {
        for (Index i = first + 1; i < first + rows; ++i) {
          velocity += dq[i] * dq[i];
          acceleration += std::pow((dq[i] - dq[i - 1]) / (times()[i] - times()[i - 1]), 2);
        }
      }
      if (acceleration > 0) durations.push_back(std::sqrt(velocity / acceleration));
    }
    constexpr double factor = 2;
    return durations.empty() ? not_a_number : factor * median(std::move(durations));
  }

  [[nodiscard]] Posterior posterior_at(const std::vector<Hyperparameter>& hyperparameters) const {
    require_not_stopped(stop_);
    ModelValues values = model_values(prior_, fit_.observations, hyperparameters);
    if (fit_.report.inducing) values.inducing = fit_.report.inducing->points;
    return {prior_, fit_.observations, std::move(values)};
  }

  /// Measured less predicted positions, row after row; nothing where the motion does not reach the end.
  [[nodiscard]] std::optional<VectorXd> residual(const Posterior& posterior, const Stretch& stretch,
                                                 const VectorXd& start) const {
    const auto mean = [&](const View& view, const Eigen::Ref<const MatrixXd>& x) { return posterior.mean(view, x); };
    return residual(mean, posterior.values().parameters, stretch, start);
  }
  template <typename Function>
  [[nodiscard]] std::optional<VectorXd> residual(const Function& function, const VectorXd& parameters, const Stretch& stretch,
                                                 const VectorXd& start) const {
    const Acceleration acceleration = [&](const Eigen::Ref<const VectorXd>& x) -> VectorXd {
      require_not_stopped(stop_);
      return function(view_, x).col(0);
    };
    SimulateOptions options;
    options.times = times().segment(stretch.first, stretch.size).transpose();
    options.relative_tolerance = 1e-8;
    options.absolute_tolerance = 1e-11;
    options.max_steps = most_steps_per_row * static_cast<int>(stretch.size);  // a motion that runs away takes ever more
    options.switching = switching_;
    options.contacts = contacts_of(fit_.model, parameters);
    if (!options.contacts.empty()) options.pushed = pushed_acceleration(prior_, view_, function);
    const MatrixXd gaps = gaps_of(system_, contacts_, start, parameters);
    for (std::size_t k = 0; k < contacts_.size(); ++k) {
      if (!is_closed(contacts_[k], stretch.first) && !(gaps(static_cast<Index>(k), 0) > 0)) return std::nullopt;
    }
    const StateLayout layout = system_.layout();
    if (layout.nu > 0) options.inputs = {options.times, states_.block(layout.u(0), stretch.first, layout.nu, stretch.size)};
    MatrixXd off(compared_.size(), stretch.size);
    try {
      const Trajectory motion = simulate(system_, parameters, acceleration, start, options);
      for (std::size_t c = 0; c < compared_.size(); ++c) {
        const int j = compared_[c];
        for (Index i = 0; i < stretch.size; ++i) {
          const double here = states_(layout.q(j), stretch.first + i) - motion.states(layout.q(j), i);
          off(static_cast<Index>(c), i) =
              system_.coordinates()[static_cast<std::size_t>(j)].angle ? std::remainder(here, 2 * std::numbers::pi) : here;
        }
      }
    } catch (const NumericalError&) {
      require_not_stopped(stop_);
      return std::nullopt;
    }
    if (!off.allFinite()) return std::nullopt;
    return VectorXd(off.reshaped());
  }

  void drop_what_cannot_be_followed(std::vector<std::string>& notes) {
    const Posterior posterior = posterior_at(hyperparameters_);
    std::vector<char> followed(stretches_.size());
    parallel_for(static_cast<int>(stretches_.size()), n_threads_, [&](int k, int) {
      const Stretch& stretch = stretches_[static_cast<std::size_t>(k)];
      followed[static_cast<std::size_t>(k)] = residual(posterior, stretch, stretch.start).has_value() ? 1 : 0;
    });
    std::vector<Stretch> kept;
    for (std::size_t k = 0; k < stretches_.size(); ++k) {
      if (followed[k] != 0) kept.push_back(stretches_[k]);
    }
    if (kept.empty()) throw NumericalError("no stretch of the log can be followed by the motion of the fit");
    if (kept.size() < stretches_.size()) {
      notes.push_back(fmt::format("warning: {} of {} stretches are left out: the motion of the fit does not reach their end",
                                  stretches_.size() - kept.size(), stretches_.size()));
    }
    stretches_ = std::move(kept);
  }

  /// Empty where a motion cannot be followed.
  [[nodiscard]] std::vector<VectorXd> residuals_at(const std::vector<Hyperparameter>& hyperparameters,
                                                   const std::vector<Stretch>& stretches) const {
    const Posterior posterior = posterior_at(hyperparameters);
    std::vector<VectorXd> residuals(stretches.size());
    parallel_for(static_cast<int>(stretches.size()), n_threads_, [&](int k, int) {
      const Stretch& stretch = stretches[static_cast<std::size_t>(k)];
      residuals[static_cast<std::size_t>(k)] = residual(posterior, stretch, stretch.start).value_or(VectorXd());
    });
    const bool all = std::none_of(residuals.begin(), residuals.end(), [](const VectorXd& one) { return one.size() == 0; });
    return all ? residuals : std::vector<VectorXd>();
  }

  [[nodiscard]] VectorXd rms_of(const std::vector<VectorXd>& residuals) const {
    VectorXd sum = VectorXd::Zero(static_cast<Index>(compared_.size()));
    double n = 0;
    for (const VectorXd& one : residuals) {
      sum += one.reshaped(sum.size(), one.size() / sum.size()).rowwise().squaredNorm();
      n += static_cast<double>(one.size() / sum.size());
    }
    VectorXd rms = (sum / n).cwiseSqrt();
    constexpr double rounding = 1e-12;
    for (std::size_t c = 0; c < compared_.size(); ++c) {
      double& one = rms[static_cast<Index>(c)];
      one = std::max(one, rounding * spread_[compared_[c]]);
    }
    return rms;
  }

  [[nodiscard]] double objective_of(const std::vector<VectorXd>& residuals) const {
    return residuals.empty() ? std::numeric_limits<double>::infinity() : rms_of(residuals).array().log().sum();
  }

  /// Changes of a start that keep to the constraints, in units of the spreads in the log: what is left of changes of each entry by
  /// itself once they are projected.
  [[nodiscard]] MatrixXd tangents(const VectorXd& parameters, const VectorXd& start) const {
    if (system_.nc() == 0) return spread_.asDiagonal();
    const auto n = spread_.size();
    const VectorXd at = project_onto_constraints(system_, parameters, start);
    MatrixXd changes(n, n);
    for (Index e = 0; e < n; ++e) {
      VectorXd moved = at;
      moved[e] += relative_width * spread_[e];
      changes.col(e) =
          (project_onto_constraints(system_, parameters, moved) - at).head(n).cwiseQuotient(spread_) / relative_width;
    }
    Eigen::ColPivHouseholderQR<MatrixXd> qr(changes);
    qr.setThreshold(0.03);  // beyond what curvature leaves of a change that the constraints forbid
    return spread_.asDiagonal() * MatrixXd(qr.householderQ()).leftCols(qr.rank());
  }

  [[nodiscard]] std::vector<Linearised> linearise(const std::vector<VectorXd>& residuals) const {
    const Posterior here = posterior_at(hyperparameters_);
    std::vector<std::pair<Posterior, Posterior>> beside;
    std::vector<double> widths;
    for (const std::size_t k : parameters_) {
      const Hyperparameter& h = hyperparameters_[k];
      const double x = h.coordinate();
      const double width =
          h.map().is_logarithm
              ? relative_width
              : relative_width * std::max(std::abs(h.value), relative_width * (h.upper - h.lower)) / h.map().unit;
      // a difference to one side where a bound, as that of a restitution, forbids the other
      const double more = std::min(x + width, h.upper_coordinate()), less = std::max(x - width, h.lower_coordinate());
      const auto moved = [&](double to) {
        std::vector<Hyperparameter> all = hyperparameters_;
        all[k].value = h.map().value(to);
        return posterior_at(all);
      };
      beside.emplace_back(moved(more), moved(less));
      widths.push_back((more - less) / 2);
    }
    std::vector<Linearised> all(stretches_.size());
    parallel_for(static_cast<int>(stretches_.size()), n_threads_, [&](int k, int) {
      const Stretch& stretch = stretches_[static_cast<std::size_t>(k)];
      Linearised& out = all[static_cast<std::size_t>(k)];
      out.residual = residuals[static_cast<std::size_t>(k)];
      const auto slope = [&](const Posterior& more, const VectorXd& start_more, const Posterior& less, const VectorXd& start_less,
                             double width) -> VectorXd {
        const std::optional<VectorXd> a = residual(more, stretch, start_more), b = residual(less, stretch, start_less);
        // one that cannot be followed beside here says nothing of its slope
        if (!a || !b) return VectorXd::Zero(out.residual.size());
        return (*b - *a) / (2 * width);
      };
      out.by_theta.resize(out.residual.size(), static_cast<Index>(parameters_.size()));
      for (std::size_t a = 0; a < parameters_.size(); ++a)
        out.by_theta.col(static_cast<Index>(a)) =
            slope(beside[a].first, stretch.start, beside[a].second, stretch.start, widths[a]);
      out.basis = tangents(here.values().parameters, stretch.start);
      out.by_start.resize(out.residual.size(), out.basis.cols());
      for (Index e = 0; e < out.basis.cols(); ++e) {
        VectorXd more = stretch.start, less = stretch.start;
        more.head(spread_.size()) += relative_width * out.basis.col(e);
        less.head(spread_.size()) -= relative_width * out.basis.col(e);
        out.by_start.col(e) = slope(here, more, here, less, relative_width);
      }
    });
    return all;
  }

  [[nodiscard]] static VectorXd row_weights(const VectorXd& weights, Index size) {
    return weights.replicate(size / weights.size(), 1);
  }

  struct Step {
    std::vector<MatrixXd> starts;  // per stretch: orthonormal, what its start explains, weighed
    std::vector<MatrixXd> J;       // per stretch: weighed derivatives by θ, without that
    MatrixXd inverse;              // A⁻¹, A = Σ JᵀJ
    VectorXd variance;             // by errors that stretches do not share
    VectorXd of_theta;
  };

  /// What an orthonormal basis does not explain.
  [[nodiscard]] static MatrixXd without(const MatrixXd& basis, const MatrixXd& values) {
    return values - basis * (basis.transpose() * values);
  }

  [[nodiscard]] Step gauss_newton(const std::vector<Linearised>& all, const VectorXd& weights) const {
    const auto p = static_cast<Index>(parameters_.size());
    Step step;
    MatrixXd A = MatrixXd::Zero(p, p), gradients(p, std::ssize(all));
    for (const Linearised& one : all) {
      const VectorXd w = row_weights(weights, one.residual.size());
      const Eigen::ColPivHouseholderQR<MatrixXd> qr(w.asDiagonal() * one.by_start);
      step.starts.emplace_back(qr.householderQ() * MatrixXd::Identity(w.size(), qr.rank()));
      MatrixXd J = without(step.starts.back(), w.asDiagonal() * one.by_theta);
      A += J.transpose() * J;
      gradients.col(std::ssize(step.J)) = J.transpose() * w.cwiseProduct(one.residual);
      step.J.push_back(std::move(J));
    }
    const VectorXd unit = A.diagonal().cwiseSqrt();
    if (!(unit.minCoeff() > 0))
      throw NumericalError(fmt::format("the motions do not determine separately: {}", fmt::join(names(), ", ")));
    const auto scaled = unit.cwiseInverse().asDiagonal();
    const MatrixXd correlation = scaled * A * scaled;
    constexpr double determined = 1e-10;
    if (!(Eigen::SelfAdjointEigenSolver<MatrixXd>(correlation).eigenvalues()[0] > determined))
      throw NumericalError(fmt::format("the motions do not determine separately: {}", fmt::join(names(), ", ")));
    step.inverse = scaled * correlation.inverse() * scaled;
    // the jackknife; of what one stretch alone says it knows nothing
    VectorXd scatter = VectorXd::Zero(p);
    for (std::size_t k = 0; k < step.J.size(); ++k) {
      const MatrixXd others = A - step.J[k].transpose() * step.J[k];
      scatter += others.completeOrthogonalDecomposition().solve(gradients.col(static_cast<Index>(k))).cwiseAbs2();
    }
    const auto K = static_cast<double>(all.size());
    step.variance = ((K - 1) / K * scatter).cwiseMax(step.inverse.diagonal());
    step.of_theta = step.inverse * gradients.rowwise().sum();
    return step;
  }

  /// What is not known of the latents bends the motions of all stretches alike.
  struct LatentScatter {
    VectorXd variance;  // of the steps that motions of functions drawn from the posterior would ask for
    VectorXd rms;       // of these motions about that of the mean, per coordinate, without what starts explain
  };
  [[nodiscard]] LatentScatter scatter_by_latents(const Step& step, const VectorXd& weights,
                                                 const std::vector<VectorXd>& residuals) const {
    const Posterior posterior = posterior_at(hyperparameters_);
    const PathwiseSamples samples = sample_paths(posterior, n_samples, {.seed = 1});
    std::vector<MatrixXd> asked(stretches_.size(), MatrixXd::Zero(static_cast<Index>(parameters_.size()), n_samples));
    std::vector<VectorXd> squares(stretches_.size(), VectorXd::Zero(weights.size()));
    parallel_for(static_cast<int>(stretches_.size()), n_threads_, [&](int k, int) {
      const auto at = static_cast<std::size_t>(k);
      const VectorXd w = row_weights(weights, residuals[at].size());
      for (int s = 0; s < n_samples; ++s) {
        const auto drawn = [&](const View& view, const Eigen::Ref<const MatrixXd>& x) { return samples.evaluate(s, view, x); };
        const std::optional<VectorXd> there =
            residual(drawn, posterior.values().parameters, stretches_[at], stretches_[at].start);
        if (!there) continue;
        const VectorXd change = without(step.starts[at], w.cwiseProduct(*there - residuals[at]));
        asked[at].col(s) = step.J[at].transpose() * change;
        squares[at] += change.cwiseQuotient(w).reshaped(weights.size(), w.size() / weights.size()).rowwise().squaredNorm();
      }
    });
    MatrixXd sum = MatrixXd::Zero(static_cast<Index>(parameters_.size()), n_samples);
    VectorXd square = VectorXd::Zero(weights.size());
    double n_rows = 0;
    for (std::size_t k = 0; k < stretches_.size(); ++k) {
      sum += asked[k];
      square += squares[k];
      n_rows += static_cast<double>(residuals[k].size() / weights.size());
    }
    return {(step.inverse * sum).rowwise().squaredNorm() / n_samples, (square / (n_samples * n_rows)).cwiseSqrt()};
  }

  [[nodiscard]] std::vector<std::string> names() const {
    std::vector<std::string> out;
    for (const std::size_t k : parameters_) out.push_back(hyperparameters_[k].name);
    return out;
  }

  /// Goes along a step as far as that brings the motions nearer. @return false where nothing does
  bool advance(const std::vector<Linearised>& all, const VectorXd& weights, const VectorXd& step, double& objective,
               std::vector<VectorXd>& residuals) {
    double length = 1;
    for (int halving = 0; halving < most_halvings; ++halving, length /= 2) {
      std::vector<Hyperparameter> there = hyperparameters_;
      for (std::size_t a = 0; a < parameters_.size(); ++a) {
        Hyperparameter& h = there[parameters_[a]];
        h.value = h.value_at(h.coordinate() + length * step[static_cast<Index>(a)]);
      }
      std::vector<Stretch> stretches = stretches_;
      for (std::size_t k = 0; k < all.size(); ++k) {
        const VectorXd w = row_weights(weights, all[k].residual.size());
        const VectorXd left = all[k].residual - all[k].by_theta * step;
        const VectorXd change = (w.asDiagonal() * all[k].by_start).colPivHouseholderQr().solve(w.asDiagonal() * left);
        stretches[k].start.head(spread_.size()) += length * all[k].basis * change;
      }
      std::vector<VectorXd> moved = residuals_at(there, stretches);
      if (const double value = objective_of(moved); value < objective) {
        objective = value;
        residuals = std::move(moved);
        hyperparameters_ = std::move(there);
        stretches_ = std::move(stretches);
        return true;
      }
    }
    return false;
  }

  static constexpr Index least_rows = 8;     // of a stretch
  static constexpr int least_stretches = 4;  // for standard errors
  static constexpr double most_steps = 5;    // usual ones, beyond which the log does not go on
  static constexpr int most_steps_per_row = 50;
  static constexpr double relative_width = 1e-3;  // of differences: in a logarithm, or in units of a size
  static constexpr int n_samples = 16;            // of the posterior, for standard deviations
  static constexpr int most_iterations = 20, most_halvings = 8;

  const FitFile& fit_;
  Prior prior_;
  const System& system_;
  View view_;
  SwitchingFunctions switching_;
  int n_threads_;
  const std::atomic<bool>* stop_;
  std::vector<Hyperparameter> hyperparameters_;
  std::vector<std::size_t> parameters_;  // that are estimated, among the hyperparameters
  std::vector<int> compared_;            // coordinates
  std::vector<double> stated_;           // the median deviation that the log states of each of them; empty where it states none
  MatrixXd states_;                      // of the log
  VectorXd spread_;                      // of q and dq over it (2 nq)
  std::vector<Contact> contacts_;        // at the parameters where the search starts
  MatrixXd gaps_;                        // of them in the log (contacts × rows)
  VectorXd clearance_;                   // beyond which they are surely open
  double duration_ = 0;
  std::vector<Stretch> stretches_;
  std::vector<std::string> notes_;
};

}  // namespace

std::vector<Option> options(ShootRequest& request) {
  return {{"duration", &request.duration, "S", "duration of a stretch [s]",
           "twice the time in which velocities change by their own size; at least 8 rows, at most half of the longest part of "
           "the log"},
          {"stretches", &request.most_stretches, "K", "maximum number of stretches, evenly spaced"},
          columns_option(request.columns),
          threads_option(request.threads)};
}

ShootOutcome shoot(const FitFile& fit, const CsvTable& log, const ShootRequest& request, const std::atomic<bool>* stop) {
  require_threads(request.threads);
  return Shooter(fit, log, request, stop).run();
}

}  // namespace gp2
