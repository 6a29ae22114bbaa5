#include "gp2/smoothing/smoother.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "smoothing/matern_motion.hpp"
#include "smoothing/smooth_each.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;

namespace {

constexpr int n_outputs = 3;  // q, dq, ddq

/// Moments in time, each with its measurements; the steps between them, the equal ones told once.
struct Timeline {
  struct Moment {
    double time = 0;
    int interval = -1;        // the step that leads here, among `intervals`; −1 at the first
    int first = 0, last = 0;  // its measurements are [first, last)
  };
  std::vector<Moment> moments;
  std::vector<double> intervals;  // [s]
};

/// @param times  further moments, increasing
Timeline timeline_of(const std::vector<Measurement>& measurements, const Eigen::Ref<const VectorXd>& times = VectorXd()) {
  // stamps of one clock differ in their last digits
  constexpr double same_interval = 1e-9;
  Timeline line;
  std::vector<double> all(times.begin(), times.end());
  for (const Measurement& one : measurements) all.push_back(one.time);
  std::sort(all.begin(), all.end());
  all.erase(std::unique(all.begin(), all.end()), all.end());
  int measurement = 0;
  for (const double time : all) {
    const int first = measurement;
    while (measurement < std::ssize(measurements) && measurements[static_cast<std::size_t>(measurement)].time <= time)
      ++measurement;
    line.moments.push_back({time, -1, first, measurement});
  }

  std::vector<std::pair<double, std::size_t>> steps;
  steps.reserve(line.moments.size());
  for (std::size_t k = 1; k < line.moments.size(); ++k) steps.emplace_back(line.moments[k].time - line.moments[k - 1].time, k);
  std::sort(steps.begin(), steps.end());
  for (const auto& [interval, k] : steps) {
    if (line.intervals.empty() || interval > line.intervals.back() * (1 + same_interval)) line.intervals.push_back(interval);
    line.moments[k].interval = static_cast<int>(line.intervals.size()) - 1;
  }
  return line;
}

/// The Kalman filter of one model on one timeline. States are in units of q's size and of the lengthscale's time.
///
/// What it finds at each moment of a long log would take more memory than the log: that of one block of moments is kept, and a block
/// is filtered again when it is asked for.
template <int D>
class Filter {
 public:
  using Motion = MaternMotion<D>;
  using Vector = typename Motion::Vector;
  using Matrix = typename Motion::Matrix;

  Filter(const SmootherModel& model, const std::vector<Measurement>& measurements, const Timeline& line)
      : model_(model), measurements_(measurements), line_(line), rate_(std::sqrt(2.0 * D - 1) / model.lengthscale) {
    for (int d = 0; d < n_outputs; ++d) unit_[static_cast<std::size_t>(d)] = model.signal_stddev * std::pow(rate_, d);
    steps_.resize(std::min(line.intervals.size(), most_steps));
    run();
  }

  [[nodiscard]] double log_likelihood() const { return log_likelihood_; }

  /// With r = ∂ log p/∂x and N = −∂² log p/∂x² of the predicted mean x at a moment, found from the last to the first, the
  /// derivative by its covariance is ½(r rᵀ − N) (de Jong 1989; Koopman & Shephard 1992), and the rest the chain rule.
  [[nodiscard]] VectorXd gradient() {
    // by log rate, log size, log noise, log velocity noise, log τ
    VectorXd gradient = VectorXd::Zero(SmootherModel::n_parameters);
    VectorXd by_interval = VectorXd::Zero(std::ssize(line_.intervals));
    Vector r = Vector::Zero();
    Matrix N = Matrix::Zero();
    for (std::size_t k = line_.moments.size(); k-- > 0;) {
      const Timeline::Moment& moment = line_.moments[k];
      require_block_of(k);
      for (int m = moment.last; m-- > moment.first;) {
        const Update& update = update_of(m);
        const double along = update.residual / update.variance - update.gain.dot(r);
        const Vector N_gain = N * update.gain;
        const double precision = 1 / update.variance + update.gain.dot(N_gain);
        const double by_log_noise = update.noise_variance * (along * along - precision);
        gradient[2 + update.derivative] += (1 - update.time_share) * by_log_noise;
        gradient[4] += update.time_share * by_log_noise;
        // in its unit a value shrinks as the unit grows, and so does its noise
        const double by_log_unit = along * update.value - by_log_noise - 1;
        gradient[0] += update.derivative * by_log_unit;
        gradient[1] += by_log_unit;
        // r ← H v/F + (I − K H)ᵀ r,   N ← HᵀH/F + (I − K H)ᵀ N (I − K H)
        r[update.derivative] += along;
        N.row(update.derivative) -= N_gain.transpose();
        N.col(update.derivative) -= N_gain;
        N(update.derivative, update.derivative) += precision;
      }
      if (moment.interval < 0) break;
      const Belief before = updated(k - 1);
      const typename Motion::Step& step = step_to(moment);
      // of x ← Φ x, P ← Φ P Φᵀ + Q with dΦ = F Φ dτ and dQ = g gᵀ dτ
      const Matrix by_covariance = 0.5 * (r * r.transpose() - N);
      const Matrix moved = step.transition * before.root;
      const Vector mean = step.transition * before.mean;
      by_interval[moment.interval] += r.dot(motion_.F() * mean) +
                                      2 * (by_covariance * moved).cwiseProduct(motion_.F() * moved).sum() +
                                      step.impulse.dot(by_covariance * step.impulse);
      r = (step.transition.transpose() * r).eval();
      N = (step.transition.transpose() * N * step.transition).eval();
    }
    for (std::size_t k = 0; k < line_.intervals.size(); ++k) {
      gradient[0] += by_interval[static_cast<Index>(k)] * rate_ * line_.intervals[k];
    }
    gradient[0] = -gradient[0];  // the rate falls as the lengthscale grows
    return gradient;
  }

  /// Rauch–Tung–Striebel: P_k|n = (I − J Φ) P_k (I − J Φ)ᵀ + J Q Jᵀ + J P_k+1|n Jᵀ, a sum of squares.
  /// @param write  called with each moment's number, mean and covariance, from the last to the first
  template <typename Write>
  void smooth(const Write& write) {
    Belief smoothed = updated(line_.moments.size() - 1);
    for (std::size_t k = line_.moments.size(); k-- > 0;) {
      if (k + 1 < line_.moments.size()) {
        const Belief next = predicted(k + 1);
        const Belief here = updated(k);
        const typename Motion::Step& step = step_to(line_.moments[k + 1]);
        // J = P Φᵀ (S Sᵀ)⁻¹ with S the root of the predicted covariance
        const Matrix moved = step.transition * here.root;
        const auto S = next.root.template triangularView<Eigen::Lower>();
        Matrix J_transposed = moved * here.root.transpose();
        S.solveInPlace(J_transposed);
        S.transpose().solveInPlace(J_transposed);
        const Matrix J = J_transposed.transpose();
        Eigen::Matrix<double, D, 3 * D> columns;
        columns << here.root - J * moved, J * step.noise_factor, J * smoothed.root;
        smoothed.mean = (here.mean + J * (smoothed.mean - next.mean)).eval();
        smoothed.root = triangular_root<D, 3 * D>(columns);
      }
      const Eigen::Matrix3Xd root = smoothed.root.template topRows<n_outputs>();
      const Eigen::Map<const Eigen::Vector3d> unit(unit_.data());
      const Eigen::Matrix3d covariance = root * root.transpose();
      write(k, smoothed.mean.template head<n_outputs>().cwiseProduct(unit), unit.asDiagonal() * covariance * unit.asDiagonal());
    }
  }

 private:
  /// N(mean, root rootᵀ).
  struct Belief {
    Vector mean;
    Matrix root;
  };
  /// What a measurement did.
  struct Update {
    int derivative = 0;  // 0: of q, 1: of dq
    double value = 0, residual = 0, variance = 0, noise_variance = 0;
    double time_share = 0;  // of noise_variance that is due to τ
    Vector gain;
  };

  struct KeptStep {
    int interval = -1;
    typename Motion::Step step;
  };

  static constexpr std::size_t block_size = std::size_t{1} << 15;  // moments
  static constexpr std::size_t most_steps = 2 * block_size;

  void run() {
    Belief belief{Vector::Zero(), motion_.stationary_root()};
    for (std::size_t first = 0; first < line_.moments.size(); first += block_size) {
      begins_.push_back(belief);
      run_block(first, belief);
      for (const Update& update : updates_) {
        log_likelihood_ -=
            0.5 * (update.residual * update.residual / update.variance + std::log(2 * std::numbers::pi * update.variance)) +
            std::log(unit_[static_cast<std::size_t>(update.derivative)]);
      }
    }
  }

  /// @param belief  of the moment before the block, then of its last
  void run_block(std::size_t first, Belief& belief) {
    first_ = first;
    predicted_.clear();
    updates_.clear();
    const std::size_t end = std::min(first + block_size, line_.moments.size());
    for (std::size_t k = first; k < end; ++k) {
      const Timeline::Moment& moment = line_.moments[k];
      if (moment.interval >= 0) {
        const typename Motion::Step& step = step_to(moment);
        Eigen::Matrix<double, D, 2 * D> columns;
        columns << step.transition * belief.root, step.noise_factor;
        belief.root = triangular_root<D, 2 * D>(columns);
        belief.mean = (step.transition * belief.mean).eval();
      }
      predicted_.push_back(belief);
      for (int m = moment.first; m < moment.last; ++m)
        updates_.push_back(take_in(measurements_[static_cast<std::size_t>(m)], belief));
    }
  }

  void require_block_of(std::size_t k) {
    const std::size_t block = k / block_size;
    if (first_ == block * block_size) return;
    Belief belief = begins_[block];
    run_block(block * block_size, belief);
  }

  /// The step that leads to a moment. Where hardly two are equal they are too many to keep: each takes the place of an earlier one.
  const typename Motion::Step& step_to(const Timeline::Moment& moment) {
    const auto interval = static_cast<std::size_t>(moment.interval);
    KeptStep& kept = steps_[interval % steps_.size()];
    if (kept.interval != moment.interval) kept = {moment.interval, motion_.step(rate_ * line_.intervals[interval])};
    return kept.step;
  }

  // what is believed of a moment before its measurements, and after: less to find again than to keep
  [[nodiscard]] const Belief& predicted(std::size_t k) {
    require_block_of(k);
    return predicted_[k - first_];
  }
  [[nodiscard]] Belief updated(std::size_t k) {
    Belief belief = predicted(k);
    for (int m = line_.moments[k].first; m < line_.moments[k].last; ++m) apply(update_of(m), belief);
    return belief;
  }

  /// @param m  of a moment in the block
  [[nodiscard]] const Update& update_of(int m) const {
    return updates_[static_cast<std::size_t>(m - line_.moments[first_].first)];
  }

  // Potter's update: P − P Hᵀ H P / F = S (I − f fᵀ/F) Sᵀ with f = Sᵀ Hᵀ, and I − f fᵀ/F = (I − γ f fᵀ)², γ = 1/(F + √(F R))
  static void apply(const Update& update, Belief& belief) {
    const Vector f = belief.root.row(update.derivative).transpose();
    belief.mean += update.gain * update.residual;
    belief.root -= update.gain / (1 + std::sqrt(update.noise_variance / update.variance)) * f.transpose();
  }

  [[nodiscard]] Update take_in(const Measurement& measurement, Belief& belief) const {
    Update update;
    update.derivative = measurement.velocity ? 1 : 0;
    const double unit = unit_[static_cast<std::size_t>(update.derivative)];
    const double read = measurement.noise_factor * (measurement.velocity ? model_.velocity_noise_stddev : model_.noise_stddev);
    const double late = measurement.velocity ? 0 : model_.time_stddev * measurement.rate;
    const double noise = std::hypot(read, late) / unit;
    update.value = measurement.value / unit;
    update.noise_variance = noise * noise;
    update.time_share = late * late / (read * read + late * late);
    update.variance = belief.root.row(update.derivative).squaredNorm() + update.noise_variance;
    update.residual = update.value - belief.mean[update.derivative];
    update.gain = belief.root * belief.root.row(update.derivative).transpose() / update.variance;
    apply(update, belief);
    return update;
  }

  const SmootherModel& model_;
  const std::vector<Measurement>& measurements_;
  const Timeline& line_;
  Motion motion_;
  double rate_;                           // dτ/dt
  std::array<double, n_outputs> unit_{};  // of q, dq, ddq
  std::vector<KeptStep> steps_;
  std::vector<Belief> begins_;     // of each block: after the moment before it
  std::size_t first_ = 0;          // moment of the block that is kept
  std::vector<Belief> predicted_;  // at each of its moments, before its measurements
  std::vector<Update> updates_;    // by each of its measurements
  double log_likelihood_ = 0;
};

/// work(Filter) of the right number of states.
template <typename Work>
auto with_filter(const SmootherModel& model, const std::vector<Measurement>& measurements, const Timeline& line,
                 const Work& work) {
  switch (model.smoothness) {
    case Smoothness::matern52:
      return work(Filter<3>(model, measurements, line));
    case Smoothness::matern72:
      return work(Filter<4>(model, measurements, line));
    case Smoothness::matern92:
      break;
  }
  return work(Filter<5>(model, measurements, line));
}

}  // namespace

const std::vector<std::string>& smoothness_words() {
  static const std::vector<std::string> words = {"5/2", "7/2", "9/2"};
  return words;
}

std::optional<Smoothness> smoothness_of(const std::string& word) {
  const auto found = std::find(smoothness_words().begin(), smoothness_words().end(), word);
  if (found == smoothness_words().end()) return std::nullopt;
  return static_cast<Smoothness>(2 + (found - smoothness_words().begin()));
}

double bandwidth_of(const SmootherModel& model, double time_step) {
  // where the spectrum of the motion, s² c/λ / (1 + (ω/λ)²)^D, sinks into that of the noise, σ² Δt
  const int D = static_cast<int>(model.smoothness) + 1;
  const double rate = std::sqrt(2.0 * D - 1) / model.lengthscale;
  const double ratio = std::pow(model.signal_stddev / model.noise_stddev, 2) * matern_intensity(D) / (rate * time_step);
  return ratio > 1 ? rate * std::sqrt(std::pow(ratio, 1.0 / D) - 1) / (2 * std::numbers::pi) : 0;
}

void check_measurements(const SmootherModel& model, const std::vector<Measurement>& measurements, const char* caller) {
  const auto require_positive = [&](double value, const char* name) {
    if (!(value > 0) || !std::isfinite(value))
      throw InputError(fmt::format("{}: {} must be positive, got {}", caller, name, value));
  };
  require_positive(model.lengthscale, "lengthscale");
  require_positive(model.signal_stddev, "signal_stddev");
  require_positive(model.noise_stddev, "noise_stddev");
  require_positive(model.velocity_noise_stddev, "velocity_noise_stddev");
  if (!(model.time_stddev >= 0) || !std::isfinite(model.time_stddev)) {
    throw InputError(fmt::format("{}: time_stddev must not be negative, got {}", caller, model.time_stddev));
  }
  if (measurements.empty()) throw InputError(fmt::format("{}: there are no measurements", caller));
  for (std::size_t k = 0; k < measurements.size(); ++k) {
    const Measurement& one = measurements[k];
    if (!std::isfinite(one.time) || !std::isfinite(one.value) || !std::isfinite(one.rate)) {
      throw InputError(fmt::format("{}: measurement {} must be finite, got {} at time {}", caller, k, one.value, one.time));
    }
    require_positive(one.noise_factor, "noise_factor");
    if (k > 0 && one.time < measurements[k - 1].time) {
      throw InputError(
          fmt::format("{}: times must not run backwards, got {} after {}", caller, one.time, measurements[k - 1].time));
    }
  }
}

double log_likelihood(const SmootherModel& model, const std::vector<Measurement>& measurements, VectorXd* gradient) {
  check_measurements(model, measurements, "log_likelihood");
  return with_filter(model, measurements, timeline_of(measurements), [&](auto&& filter) {
    if (gradient) *gradient = filter.gradient();
    return filter.log_likelihood();
  });
}

double smooth_each(const SmootherModel& model, const std::vector<Measurement>& measurements,
                   const Eigen::Ref<const VectorXd>& times, const WriteMotion& write) {
  check_measurements(model, measurements, "smooth");
  for (Index k = 0; k < times.size(); ++k) {
    if (!std::isfinite(times[k]) || (k > 0 && !(times[k] > times[k - 1]))) {
      throw InputError(fmt::format("smooth: times must be finite and increase, got {} at {}", times[k], k));
    }
  }
  const Timeline line = timeline_of(measurements, times);
  return with_filter(model, measurements, line, [&](auto&& filter) {
    Index next = times.size() - 1;
    filter.smooth([&](std::size_t k, const Eigen::Vector3d& mean, const Eigen::Matrix3d& covariance) {
      if (next < 0 || line.moments[k].time != times[next]) return;
      write(next--, mean, covariance);
    });
    return filter.log_likelihood();
  });
}

SmoothedMotion smooth(const SmootherModel& model, const std::vector<Measurement>& measurements, const VectorXd& times) {
  SmoothedMotion out{Eigen::Matrix3Xd(3, times.size()), std::vector<Eigen::Matrix3d>(static_cast<std::size_t>(times.size()))};
  smooth_each(model, measurements, times, [&](Index k, const Eigen::Vector3d& mean, const Eigen::Matrix3d& covariance) {
    out.mean.col(k) = mean;
    out.covariance[static_cast<std::size_t>(k)] = covariance;
  });
  return out;
}

}  // namespace gp2
