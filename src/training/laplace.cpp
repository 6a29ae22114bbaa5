#include "gp2/training/laplace.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/decompositions.hpp"
#include "base/lapack.hpp"
#include "base/not_a_number.hpp"
#include "base/parallel.hpp"
#include "inference/requirements.hpp"
#include "training/constraint_parameters.hpp"
#include "training/curvature.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double wider = 1e6;

// Widths of the boxes in units of Curvature; bounds that are no more than limits are no box. Those of parameters are taken as wider:
// where two of them are known only together, the box of one says nothing of the other.
VectorXd boxes_of(const Curvature& curvature, const std::vector<Hyperparameter>& hyperparameters) {
  VectorXd width = curvature.unit.cwiseInverse();
  for (Index k = 0; k < width.size(); ++k) {
    const Hyperparameter& h = hyperparameters[static_cast<std::size_t>(curvature.free[static_cast<std::size_t>(k)])];
    if (h.positive || h.size == 0) width[k] *= h.upper_coordinate() - h.lower_coordinate();
    if (h.is_system_parameter()) width[k] *= wider;
  }
  return width;
}

// Variances that directions of no curvature, F (n × n_flat), add where boxes are all that is known along them: F (FᵀB⁻²F)⁻¹Fᵀ.
VectorXd variances_within(const VectorXd& boxes, const MatrixXd& flat) {
  const MatrixXd in_boxes = boxes.cwiseInverse().asDiagonal() * flat;
  const MatrixXd root = MatrixXd(in_boxes.transpose() * in_boxes).llt().matrixL().solve(MatrixXd(flat.transpose()));
  return root.colwise().squaredNorm();
}

// whether the data leave it no better known than its hyper-prior does
bool is_silent(const Hyperparameter& h, double stddev) { return stddev >= 0.999 * stddev_of(h.hyperprior); }

// Where the width of the bounds is all that gives a parameter its deviation, the data do not determine it.
void forget_bounds(const std::vector<Hyperparameter>& hyperparameters, LaplaceUncertainty& out) {
  for (Index k = 0; k < out.stddev.size(); ++k) {
    const Hyperparameter& h = hyperparameters[static_cast<std::size_t>(k)];
    if (!is_known_by_bounds_only(h) || !std::isfinite(out.stddev[k]) || !is_silent(h, out.stddev[k])) continue;
    out.stddev[k] = std::numeric_limits<double>::infinity();
    out.correlation.row(k).setConstant(not_a_number);
    out.correlation.col(k).setConstant(not_a_number);
    out.correlation(k, k) = 1;
    out.undetermined.conservativeResize(Eigen::NoChange, out.undetermined.cols() + 1);
    out.undetermined.rightCols(1) = VectorXd::Unit(out.stddev.size(), k);
  }
}

}  // namespace

LaplaceUncertainty laplace_uncertainty(const Curvature& curvature, const std::vector<Hyperparameter>& hyperparameters) {
  constexpr double infinity = std::numeric_limits<double>::infinity();
  const std::vector<int>& free = curvature.free;
  const auto n = static_cast<Index>(hyperparameters.size()), n_free = static_cast<Index>(free.size());
  const Index n_flat = (curvature.eigenvalues.array() <= curvature.zero).count();
  const MatrixXd flat = curvature.eigenvectors.leftCols(n_flat), steep = curvature.eigenvectors.rightCols(n_free - n_flat);
  const MatrixXd covariance = steep * curvature.eigenvalues.tail(n_free - n_flat).cwiseInverse().asDiagonal() * steep.transpose();

  LaplaceUncertainty out;
  out.stddev = VectorXd::Zero(n);
  out.correlation = MatrixXd::Identity(n, n);
  out.undetermined = MatrixXd::Zero(n, n_flat);
  for (Index k = 0; k < n; ++k) {
    if (std::find(free.begin(), free.end(), k) == free.end()) out.held.push_back(static_cast<int>(k));
  }
  // a parameter that moves by a small part of its box before others, as a lengthscale that runs away, have gone through theirs is known
  constexpr double part = 1e-2;
  const VectorXd boxes = boxes_of(curvature, hyperparameters);
  VectorXd within = covariance.diagonal();
  if (n_flat > 0) within += variances_within(boxes, flat);
  within = within.cwiseSqrt();
  const auto is_flat = [&](Index k) {
    const bool is_parameter = hyperparameters[static_cast<std::size_t>(free[static_cast<std::size_t>(k)])].is_system_parameter();
    return flat.row(k).squaredNorm() > 1e-4 && !(is_parameter && within[k] * wider < part * boxes[k]);
  };
  for (Index k = 0; k < n_free; ++k) {
    const Index at = free[static_cast<std::size_t>(k)];
    const double to_unit = curvature.unit[k] * hyperparameters[static_cast<std::size_t>(at)].map().unit;
    out.stddev[at] = is_flat(k) ? infinity : to_unit * within[k];
    out.undetermined.row(at) = to_unit * flat.row(k);
    for (Index l = 0; l < k; ++l) {
      const Index other = free[static_cast<std::size_t>(l)];
      const double both = std::sqrt(covariance(k, k) * covariance(l, l));
      out.correlation(at, other) = out.correlation(other, at) = is_flat(k) || is_flat(l) ? not_a_number : covariance(k, l) / both;
    }
  }
  out.undetermined.colwise().normalize();
  forget_bounds(hyperparameters, out);
  out.distance_from_optimum = curvature.distance_from_optimum();
  return out;
}

LaplaceUncertainty laplace_uncertainty(const Prior& prior, const std::vector<Observations>& observations,
                                       const std::vector<Hyperparameter>& hyperparameters, int n_threads) {
  require_observations(prior, observations);
  require_hyperparameters(prior, observations, hyperparameters);
  const lapack::SingleThread single_thread;
  const Objective objective(prior, observations, hyperparameters, about_posterior_mean(prior, observations, hyperparameters));
  return laplace_uncertainty(curvature_at(objective, coordinates(hyperparameters), hyperparameters, thread_count(n_threads),
                                          nullptr, AtBound::free_if_open),
                             hyperparameters);
}

namespace {

bool draws_know_parameters(const FitReport& report) {
  if (!report.draws) return false;
  for (std::size_t k = 0; k < report.hyperparameters.size(); ++k) {
    const Hyperparameter& h = report.hyperparameters[k];
    if (h.is_system_parameter() && !h.is_fixed() && !report.draws->is_drawn(static_cast<Index>(k))) return false;
  }
  return true;
}

// Under delays and lags that are known.
double stddev_under_actuators(const FitReport& report, std::size_t k) {
  const auto at = static_cast<Index>(k);
  if (report.hyperparameters[k].at_bound()) return not_a_number;
  // which of a positive one is that of its logarithm
  const double unit = report.hyperparameters[k].positive ? report.hyperparameters[k].value : 1;
  const double by_curvature = report.uncertainty ? unit * report.uncertainty->stddev[at] : not_a_number;
  // draws of what the data leave open tell the width of its bounds, or how far a chain got
  const bool is_of_draws = draws_know_parameters(report) && report.draws->is_drawn(at) && !std::isinf(by_curvature);
  return is_of_draws ? report.draws->stddev[at] : by_curvature;
}

// What the errors of delays and lags add to the covariance of two parameters.
double covariance_by_actuators(const FitReport& report, std::size_t k, std::size_t l) {
  double sum = 0;
  for (const ActuatorEstimate& one : report.actuators) {
    const auto move = [&](std::size_t of) {
      const auto found = one.moves.find(report.hyperparameters[of].name);
      return found == one.moves.end() ? 0 : found->second;
    };
    sum += move(k) * move(l);
  }
  return sum;
}

double stddev_of_parameter(const FitReport& report, std::size_t k) {
  return std::hypot(stddev_under_actuators(report, k), std::sqrt(covariance_by_actuators(report, k, k)));
}

void require_hyperparameter(const char* function, const FitReport& report, std::size_t k) {
  if (k < report.hyperparameters.size()) return;
  throw InputError(fmt::format("{}: the fit has {} hyperparameters, numbered from 0, got the number {}", function,
                               report.hyperparameters.size(), k));
}

}  // namespace

ParameterUncertainty parameter_uncertainty(const FitReport& report, std::size_t k) {
  require_hyperparameter("parameter_uncertainty", report, k);
  const auto at = static_cast<Index>(k);
  const double stddev = stddev_of_parameter(report, k);
  if (!draws_know_parameters(report) || !report.draws->is_drawn(at) || !std::isfinite(stddev)) return {.stddev = stddev};
  const HyperparameterDraws& draws = *report.draws;
  const double mean = draws.mean[at], factor = stddev / draws.stddev[at];
  return {true, stddev, mean, mean + factor * (draws.lower[at] - mean), mean + factor * (draws.upper[at] - mean)};
}

double parameter_correlation(const FitReport& report, std::size_t k, std::size_t l) {
  for (const std::size_t one : {k, l}) require_hyperparameter("parameter_correlation", report, one);
  const auto a = static_cast<Index>(k), b = static_cast<Index>(l);
  const bool is_of_draws = draws_know_parameters(report);
  if (!std::isfinite(stddev_under_actuators(report, k)) || !std::isfinite(stddev_under_actuators(report, l))) return not_a_number;
  const double correlation = is_of_draws ? report.draws->correlation(a, b) : report.uncertainty->correlation(a, b);
  const double added = covariance_by_actuators(report, k, l);
  if (added == 0) return correlation;
  return (correlation * stddev_under_actuators(report, k) * stddev_under_actuators(report, l) + added) /
         (stddev_of_parameter(report, k) * stddev_of_parameter(report, l));
}

namespace {

// "R by +1 %, Ic by +0.98 %": θ along a direction, as far as the one that changes most changes by a hundredth
std::string changes_along(const std::vector<Hyperparameter>& hyperparameters, const std::vector<int>& parameters,
                          const VectorXd& direction) {
  const auto relative = [&](int k) {
    const double value = hyperparameters[static_cast<std::size_t>(k)].value;
    return value == 0 ? direction[k] : direction[k] / std::abs(value);
  };
  double largest = 0;
  for (const int k : parameters) largest = std::abs(relative(k)) > std::abs(largest) ? relative(k) : largest;
  std::vector<std::string> changes;
  for (const int k : parameters) {
    const Hyperparameter& h = hyperparameters[static_cast<std::size_t>(k)];
    const double change = relative(k) / largest;
    constexpr double negligible = 1e-3;
    if (std::abs(change) < negligible) continue;
    changes.push_back(h.value == 0 ? fmt::format("{} by {:+.2g}", h.name, change / 100)
                                   : fmt::format("{} by {:+.2g} %", h.name, change));
  }
  return fmt::format("{}", fmt::join(changes, ", "));
}

constexpr double far_from_optimum = 0.5;  // standard deviations

// Whether the optimiser was stopped on its way, where all seems undetermined.
bool is_on_the_way(const FitReport& report) {
  const bool is_cut_short =
      report.termination.find("limit of iterations") != std::string::npos || report.termination == FitReport::interrupted;
  return is_cut_short && report.uncertainty->distance_from_optimum > far_from_optimum;
}

void note_distance(const FitReport& report, const std::vector<int>& parameters, std::vector<UncertaintyNote>& notes) {
  const LaplaceUncertainty& uncertainty = *report.uncertainty;
  const double distance = uncertainty.distance_from_optimum;
  if (!(distance > far_from_optimum)) return;
  const bool has_open =
      !is_on_the_way(report) && std::ranges::any_of(parameters, [&](int k) { return std::isinf(uncertainty.stddev[k]); });
  notes.push_back({true,
                   fmt::format("the standard errors are rough: the optimiser stopped {}",
                               std::isfinite(distance) ? fmt::format("{:.2g} standard deviations before the optimum", distance)
                                                       : "where no optimum is near"),
                   has_open ? "Know first what the data do not determine: along it no optimum is reached"
                            : "Fit with a larger `max_iterations`, or `start` from this fit"});
}

// Of parameters at a bound nothing is known but that, and standard errors of others would be larger were they free.
void note_held(const std::vector<Hyperparameter>& fitted, const LaplaceUncertainty& uncertainty,
               const std::vector<int>& parameters, std::vector<UncertaintyNote>& notes) {
  std::vector<std::string> held;
  bool has_errors = false;
  for (const int k : parameters) {
    const bool at_bound = fitted[static_cast<std::size_t>(k)].at_bound();
    if (at_bound && !std::isinf(uncertainty.stddev[k])) held.push_back(fitted[static_cast<std::size_t>(k)].name);
    has_errors = has_errors || (!at_bound && uncertainty.stddev[k] > 0 && std::isfinite(uncertainty.stddev[k]));
  }
  if (held.empty() || !has_errors) return;
  notes.push_back({false, fmt::format("the standard errors hold {} at the bound", fmt::join(held, ", ")),
                   "Were they free, the others could be known far less: fit with wider bounds"});
}

// Priors of parameters that the data contradict, or that their bounds do.
void note_priors(const std::vector<Hyperparameter>& fitted, const std::vector<int>& parameters,
                 std::vector<UncertaintyNote>& notes) {
  constexpr double far = 3;  // deviations
  for (const int k : parameters) {
    const Hyperparameter& h = fitted[static_cast<std::size_t>(k)];
    if (h.hyperprior.form == HyperPrior::Form::none || h.is_fixed()) continue;
    const double deviations = std::abs(h.hyperprior.standardised(h.value));
    if (!(deviations > far)) continue;
    const bool is_outside = h.hyperprior.median < h.lower || h.hyperprior.median > h.upper;
    notes.push_back({true,
                     fmt::format("{} = {:.6g} lies {:.2g} deviations of its prior from the middle of that, {:.6g}{}", h.name,
                                 h.value, deviations, h.hyperprior.median, is_outside ? ", which its bounds forbid" : ""),
                     is_outside ? "Mend the prior or the bounds"
                                : "The prior or the model is wrong, and standard errors take both for right"});
  }
}

// The likelihood may have other optima, which a single start does not find, with other parameters and standard errors.
void note_single_start(const FitReport& report, const std::vector<int>& parameters, std::vector<UncertaintyNote>& notes) {
  const VectorXd& stddev = report.uncertainty->stddev;
  const auto has_error = [&](int k) { return stddev[k] > 0 && std::isfinite(stddev[k]); };
  const std::size_t n_starts = report.inducing && report.inducing->n_starts > 1
                                   ? static_cast<std::size_t>(report.inducing->n_starts)
                                   : report.restarts.size();
  if (n_starts != 1 || report.draws || std::none_of(parameters.begin(), parameters.end(), has_error)) return;
  // through points few rows are fitted once, however many runs are asked for
  const bool is_once = report.inducing && report.inducing->n_start == 0;
  notes.push_back({false, "the standard errors are those about the optimum of a single start",
                   is_once ? "Other starts may lead to a better one: fit exactly (`inducing=none`), with several `restarts`"
                           : "Other starts may lead to a better one: fit with more `restarts`"});
}

// Parameters that the data do not determine. Without hyper-priors combinations of other hyperparameters may be open too: of no
// interest.
void note_open_parameters(const std::vector<Hyperparameter>& fitted, const LaplaceUncertainty& uncertainty,
                          const std::vector<int>& parameters, std::vector<UncertaintyNote>& notes) {
  std::vector<int> open;
  std::vector<std::string> names;
  for (const int k : parameters) {
    if (!std::isinf(uncertainty.stddev[k])) continue;
    open.push_back(k);
    names.push_back(fitted[static_cast<std::size_t>(k)].name);
  }
  if (open.empty()) return;
  // what the combinations change of these parameters; they may differ in other hyperparameters only
  MatrixXd changes = MatrixXd::Zero(uncertainty.undetermined.rows(), uncertainty.undetermined.cols());
  changes(open, Eigen::all) = uncertainty.undetermined(open, Eigen::all);
  const Eigen::JacobiSVD<MatrixXd> svd(changes, Eigen::ComputeThinU);
  const auto n_open = static_cast<int>(open.size()),
             n_combinations = static_cast<int>((svd.singularValues().array() > 1e-6).count());
  if (n_open == 1) {
    notes.push_back(
        {true, fmt::format("the data do not determine {}", names[0]), "Hold it at a known value, or give it a prior"});
  } else if (n_combinations == n_open) {
    notes.push_back({true, fmt::format("the data determine none of {}", fmt::join(names, ", ")),
                     "Hold them at known values, or give them priors"});
  } else if (n_combinations == 1) {
    notes.push_back({true,
                     fmt::format("the data determine {} only together: changing {} at once fits as well", fmt::join(names, ", "),
                                 changes_along(fitted, open, svd.matrixU().col(0))),
                     "Hold one of them at a known value, or give it a prior"});
  } else if (n_combinations > 1) {
    notes.push_back({true,
                     fmt::format("of the {} parameters {} the data leave {} combinations open", n_open, fmt::join(names, ", "),
                                 n_combinations),
                     fmt::format("Hold {} of them at known values, or give them priors", n_combinations)});
  }
}

// Parameters of which the data say no more than their hyper-priors do.
void note_silent_parameters(const std::vector<Hyperparameter>& fitted, const LaplaceUncertainty& uncertainty,
                            const std::vector<int>& parameters, std::vector<UncertaintyNote>& notes) {
  std::vector<std::string> names;
  for (const int k : parameters) {
    const Hyperparameter& h = fitted[static_cast<std::size_t>(k)];
    if (std::isfinite(uncertainty.stddev[k]) && is_silent(h, uncertainty.stddev[k])) names.push_back(h.name);
  }
  if (names.empty()) return;
  notes.push_back({false, fmt::format("the accelerations say nothing of {}", fmt::join(names, ", ")),
                   "The value is that of its prior, or what the constraints say of the logged states"});
}

// Pairs that the data hardly tell apart.
void note_pairs(const std::vector<Hyperparameter>& fitted, const LaplaceUncertainty& uncertainty,
                const std::vector<int>& parameters, std::vector<UncertaintyNote>& notes) {
  constexpr double alike = 0.98;
  for (const int k : parameters) {
    for (const int l : parameters) {
      const double correlation = uncertainty.correlation(k, l);
      if (l <= k || !(std::abs(correlation) > alike)) continue;
      notes.push_back(
          {false,
           fmt::format("{} and {} are known much better together than each by itself (correlation {:.4f})",
                       fitted[static_cast<std::size_t>(k)].name, fitted[static_cast<std::size_t>(l)].name, correlation),
           "Know one of them from elsewhere, and the other follows"});
    }
  }
}

}  // namespace

std::vector<UncertaintyNote> uncertainty_notes(const FitReport& report) {
  if (!report.uncertainty) return {};
  const std::vector<Hyperparameter>& fitted = report.hyperparameters;
  std::vector<int> parameters;
  for (int k = 0; k < static_cast<int>(fitted.size()); ++k) {
    if (fitted[static_cast<std::size_t>(k)].is_system_parameter()) parameters.push_back(k);
  }
  std::vector<UncertaintyNote> notes;
  note_distance(report, parameters, notes);
  if (!is_on_the_way(report)) note_open_parameters(fitted, *report.uncertainty, parameters, notes);
  note_silent_parameters(fitted, *report.uncertainty, parameters, notes);
  note_pairs(fitted, *report.uncertainty, parameters, notes);
  note_held(fitted, *report.uncertainty, parameters, notes);
  note_priors(fitted, parameters, notes);
  note_single_start(report, parameters, notes);
  return notes;
}

}  // namespace gp2
