#include "jobs/observation_noise.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "base/number_range.hpp"
#include "gp2/error.hpp"
#include "gp2/training/robust.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// at two digits that are not below the value
std::string rounded_up(double value) {
  if (!(value > 0) || !std::isfinite(value)) return fmt::format("{}", value);
  const double unit = std::pow(10, std::floor(std::log10(value)) - 1);
  std::string text = fmt::format("{:.2g}", value);
  if (std::stod(text) < value) text = fmt::format("{:.2g}", std::stod(text) + unit);
  return text;
}

// σ of a row of a group; refused where ε‖K̃‖ ≪ 1 could not hold at a signal of the given size, or σ is beyond what has a square
struct NoiseRule {
  std::string source, name;  // where σ comes from; the row
  double signal = 0;         // its size
  int n_data = 0;

  // ‖K̃‖ ≤ Σ_i (signal/noise_i)²; a hundredth of the digits must be left
  static constexpr double largest_norm = 0.01 / std::numeric_limits<double>::epsilon();

  [[nodiscard]] double smallest() const { return signal * std::sqrt(static_cast<double>(n_data) / largest_norm); }

  /// @param stddev  ∞ where nothing is measured
  /// @param rows    of the log, of each value
  void require_each(const Eigen::RowVectorXd& stddev, const std::vector<int>& rows) const {
    Index largest = 0;
    const double most = stddev.array().isInf().select(0, stddev).maxCoeff(&largest);
    if (most > largest_number) {
      refuse_too_large(most, fmt::format("data row {}: ", rows[static_cast<std::size_t>(largest)] + 1));
    }
    if (!((signal / stddev.array()).square().sum() > largest_norm)) return;
    Index worst = 0;
    const double least = stddev.minCoeff(&worst);
    refuse_too_small(least, fmt::format("data row {}: ", rows[static_cast<std::size_t>(worst)] + 1));
  }

  void require(double stddev, bool estimated) const {
    if (!(stddev > 0) || !std::isfinite(stddev)) {
      throw InputError(fmt::format("{}: the noise standard deviation of {} must be positive, got {}", source, name, stddev));
    }
    if (stddev > largest_number) refuse_too_large(stddev);
    if (!estimated && stddev < smallest()) refuse_too_small(stddev);
  }

  /// @param place  "data row 3: ", or nothing
  [[noreturn]] void refuse_too_small(double stddev, const std::string& place = "") const {
    throw InputError(
        fmt::format("{}: {}the noise standard deviation {} of {} is too small for double precision beside a spread of {:.3g}; "
                    "the smallest usable value is {}",
                    source, place, stddev, name, signal, rounded_up(smallest())));
  }
  /// @param place  "data row 3: ", or nothing
  [[noreturn]] void refuse_too_large(double stddev, const std::string& place = "") const {
    throw InputError(fmt::format("{}: {}the noise standard deviation {} of {} is too large: at most {:.0e} can be computed with",
                                 source, place, stddev, name, largest_number));
  }
};

// Where noise is small beside a spread that single values make, these are what is wrong.
void require_no_gross_errors(const Eigen::RowVectorXd& values, const std::string& name) {
  const double spread = row_stddev(values)[0], without = row_stddev(without_gross_errors(values))[0];
  if (without > 0.1 * spread) return;
  const std::vector<double> measured = measured_entries(values, 0);
  const double middle = median(measured);
  const double farthest = *std::ranges::max_element(measured, {}, [middle](double value) { return std::abs(value - middle); });
  throw InputError(
      fmt::format("single values of {} lie far from all others, which spread by {:.3g}, not by {:.3g}: correct or leave out "
                  "impossible ones, such as {:.6g}, or fit with `robust`",
                  name, without, spread, farthest));
}

// Standard deviation of each row, over the values that a robust fit does not distrust at sight.
VectorXd spread_of(const Readings& readings, const FitProblemOptions& options) {
  return row_stddev(options.robust ? without_gross_errors(readings.values) : readings.values);
}

// Size of G ā in each row of a view: the spread of the values or, for those that hardly vary, as exact zeros, what the prior
// expects: its standard deviation, root mean square over the states, with the signals at their default scales.
VectorXd signal_size(const LoggedSystem& logged, Readings readings, const std::vector<VectorXd>& signal_stddev) {
  constexpr Index enough = 10'000;  // states, evenly taken
  const Index n_all = readings.states.cols(), n_data = std::min(n_all, enough);
  if (n_data < n_all) {
    std::vector<int> some;
    for (Index i = 0; i < n_data; ++i) some.push_back(static_cast<int>(i * n_all / n_data));
    readings.keep(some);
  }
  const MechanicsBatch mechanics = require_mechanics(logged.prior, readings.view, readings.states, logged.parameters);
  const ViewValues view = evaluate_view(readings.view, mechanics, readings.states);
  PriorValues prior = require_prior_values(logged.prior, readings.states, logged.parameters, mechanics);
  keep_viewed(readings.view, prior);
  VectorXd variance = VectorXd::Zero(readings.view.size());
  for (int i = 0; i < n_data; ++i) {
    for (std::size_t a = 0; a < signal_stddev.size(); ++a) {
      variance += (view.G(i) * prior.E(a, i) * signal_stddev[a].asDiagonal()).rowwise().squaredNorm();
    }
  }
  return (variance / n_data).cwiseSqrt().cwiseMax(row_stddev(readings.values - view.offset));
}

}  // namespace

std::vector<std::string> stated_accelerations(std::vector<std::string> names, const LogReader& reader) {
  std::erase_if(names, [&](const std::string& name) { return reader.stddev_column(name).empty(); });
  return names;
}

MatrixXd stated_stddevs(const Model& model, const std::vector<std::string>& names, LogReader& reader, Index n_rows) {
  MatrixXd stddev = MatrixXd::Constant(std::ssize(names), n_rows, not_a_number);
  const std::vector<std::string> every = model.system->acceleration_names();
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (reader.stddev_column(names[k]).empty()) continue;
    auto row = stddev.row(static_cast<Index>(k));
    row = reader.stddevs({names[k]});
    // exactly 1 is how observations mark what has no deviation of its own (Observations::states_noise)
    row = (row.array() == 1).select(std::nextafter(1.0, 2.0), row);
    const auto coordinate = static_cast<std::size_t>(std::find(every.begin(), every.end(), names[k]) - every.begin());
    if (coordinate >= model.noise.floor.size()) continue;
    const double floor = model.noise.floor[coordinate];
    if (floor > 0) row = (row.array().square() + floor * floor).sqrt();
  }
  return stddev;
}

bool estimates_factor(const FitProblemOptions& options) {
  const bool can_estimate = options.protocol.name != Protocol::Name::paper && !options.baseline;
  return can_estimate && (options.estimate_noise || !options.trust_stated_noise);
}

MatrixXd stated_noise(const Model& model, const std::vector<std::string>& observed, const FitProblemOptions& options,
                      LogReader& reader, const CsvTable& log, std::vector<std::string>& notes) {
  const std::vector<std::string> stated = stated_accelerations(observed, reader);
  if (stated.empty()) return {};
  std::vector<std::string> columns;
  for (const std::string& name : stated) columns.push_back(reader.stddev_column(name));
  if (options.noise_stddev) {
    notes.push_back(fmt::format("{}: `noise_std={}` replaces the standard deviations in {}", log.name(), *options.noise_stddev,
                                fmt::join(columns, ", ")));
    return {};
  }
  notes.push_back(fmt::format("{}: the noise of each value is that in {}{}{}", log.name(), fmt::join(columns, ", "),
                              model.noise.floor.empty() ? "" : " and the floor of [noise]",
                              estimates_factor(options) ? ", times a factor that is estimated" : ""));
  return stated_stddevs(model, observed, reader, log.n_rows());
}

VectorXd noise_of(const Model& model, const FitProblemOptions& options, const Readings& readings, bool estimate) {
  const VectorXd spread = spread_of(readings, options);
  const std::vector<std::string> names = readings.view.names(*model.system);
  const std::string source = options.noise_stddev ? "`noise_std`" : model.name + ": [noise] ddq";
  VectorXd stddev(readings.view.size());
  for (Index k = 0; k < stddev.size(); ++k) {
    const auto row = static_cast<std::size_t>(readings.view.rows[static_cast<std::size_t>(k)]);
    const std::string& name = names[static_cast<std::size_t>(k)];
    // a robust fit leaves out values that have no square
    const bool has_squares = options.robust || !(readings.values.row(k).array().abs() > largest_number).any();
    if (!has_squares) require_no_gross_errors(readings.values.row(k), name);
    if (readings.states_noise(k)) {
      stddev[k] = 1;
      continue;
    }
    if (options.noise_stddev) {
      stddev[k] = *options.noise_stddev;
    } else if (!model.noise.stddev.empty()) {
      stddev[k] = model.noise.stddev[row];
    } else if (estimate) {
      stddev[k] = 0.05 * (spread[k] > 0 ? spread[k] : 1);
    } else {
      throw InputError(
          fmt::format("{}: the noise of {} is not known: write [noise] ddq = … in the model, or give `noise_std=S` or "
                      "`noise_std=estimate`",
                      model.name, name));
    }
    const NoiseRule rule{source, name, spread[k], static_cast<int>(readings.states.cols())};
    if (!estimate && stddev[k] < rule.smallest()) require_no_gross_errors(readings.values.row(k), name);
    rule.require(stddev[k], estimate);
  }
  return stddev;
}

MatrixXd noise_scale_of(const Readings& readings, const std::vector<std::string>& names, const FitProblemOptions& options,
                        const LogReader& reader, const CsvTable& log, const std::vector<int>& rows) {
  if (!readings.states_noise()) return {};
  MatrixXd scale = readings.stated_stddev;
  const VectorXd spread = spread_of(readings, options);
  for (Index k = 0; k < scale.rows(); ++k) {
    if (!readings.states_noise(k)) {
      scale.row(k).setOnes();
      continue;
    }
    const std::string& name = names[static_cast<std::size_t>(k)];
    const auto is_measured = !readings.values.row(k).array().isNaN();
    NoiseRule{fmt::format("{}: column '{}'", log.name(), reader.stddev_column(name)), name, spread[k],
              static_cast<int>(scale.cols())}
        .require_each(is_measured.select(scale.row(k), std::numeric_limits<double>::infinity()), rows);
  }
  return scale;
}

void require_noise(const std::string& source, const std::string& name, double signal, const Eigen::RowVectorXd& stddev,
                   const std::vector<int>& rows) {
  const NoiseRule rule{source, name, signal, static_cast<int>(stddev.size())};
  if (rows.empty()) {
    if (const double least = stddev.minCoeff(); std::isfinite(least)) rule.require(least, /*estimated=*/false);
    return;
  }
  rule.require_each(stddev, rows);
}

VectorXd noise_of_side_information(const LoggedSystem& logged, const SideInformation& side_information,
                                   const FitProblemOptions& options, const Readings& readings,
                                   const std::vector<VectorXd>& signal_stddev) {
  const std::vector<double>& of_model = logged.model.noise.stddev;
  if (!options.also_noise_stddev && (!side_information.quantity->is_acceleration() || of_model.empty())) {
    throw InputError(fmt::format("`also={}`: {}: its noise is not known: give `also_noise_std=S`",
                                 side_information.quantity->word(), side_information.log.table.name()));
  }
  const std::string source = options.also_noise_stddev ? "`also_noise_std`" : logged.model.name + ": [noise] ddq";
  const std::vector<std::string> names = readings.view.names(logged.system(), side_information.latent);
  const VectorXd signal = signal_size(logged, readings, signal_stddev);
  VectorXd stddev(readings.view.size());
  for (Index k = 0; k < stddev.size(); ++k) {
    const auto row = static_cast<std::size_t>(k);
    stddev[k] =
        options.also_noise_stddev ? *options.also_noise_stddev : of_model[static_cast<std::size_t>(readings.view.rows[row])];
    NoiseRule{source, names[row], signal[k], static_cast<int>(readings.states.cols())}.require(stddev[k], false);
  }
  return stddev;
}

}  // namespace gp2
