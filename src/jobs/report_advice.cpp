#include <algorithm>
#include <cctype>
#include <cmath>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/report_job.hpp"

namespace gp2 {

namespace {

using Level = Advice::Level;

// a feature that moves the acceleration by less than this, in spreads, over its own spread hardly matters
constexpr double irrelevant = 0.01;

bool hardly_matters(const Relevance& one) { return std::max(one.relevance, one.effect.value_or(one.relevance)) < irrelevant; }

// A fit that stopped short of its tolerances.
void convergence_advice(const FitReport& report, std::vector<Advice>& advice) {
  constexpr double alike = 1e-3;
  const auto n_alike =
      std::ranges::count_if(report.restarts, [&](const RestartReport& one) { return one.objective < report.objective + alike; });
  if (n_alike >= 2 && report.termination != FitReport::unsettled) {
    advice.push_back({Level::note, fmt::format("The optimiser stopped short of its tolerances: {}.", report.termination),
                      fmt::format("It does not matter: {} of {} restarts ended within {} of the best objective.", n_alike,
                                  report.restarts.size(), alike)});
    return;
  }
  const bool at_limit = report.termination.find("limit of iterations") != std::string::npos;
  advice.push_back({Level::warning, fmt::format("The optimiser did not converge: {}.", report.termination),
                    at_limit ? "Fit again with a larger `max_iterations`, or with `start` of this file to go on from here."
                             : "Fit again with `start` of this file to go on from here, or with more `restarts`."});
}

void optimiser_advice(const FitReport& report, std::vector<Advice>& advice) {
  const auto n_restarts_that = [&](const auto& is_so) { return std::ranges::count_if(report.restarts, is_so); };
  const bool ran = report.converged || report.iterations > 0 ||
                   n_restarts_that([](const RestartReport& one) { return one.iterations > 0; }) > 0;
  if (!ran) {
    const bool was_stopped = report.termination == FitReport::interrupted;
    advice.push_back({Level::note, fmt::format("Nothing was optimised: {}.", report.termination),
                      fmt::format("All figures below are of the starting values. {}",
                                  was_stopped ? "Fit again, without stopping it." : "Leave out `max_iterations=0` to fit.")});
    return;
  }
  if (!report.converged) convergence_advice(report, advice);
  const auto n_finite = n_restarts_that([](const RestartReport& one) { return std::isfinite(one.objective); });
  // a unit of the objective is a factor e of the posterior density
  const auto n_best = n_restarts_that([&](const RestartReport& one) { return one.objective < report.objective + 1; });
  const auto n_not_begun =
      n_restarts_that([](const RestartReport& one) { return one.evaluations == 0 && !std::isfinite(one.objective); });
  const auto n_failed = std::ssize(report.restarts) - n_finite - n_not_begun;
  if (n_not_begun > 0) {
    advice.push_back(
        {Level::note,
         fmt::format("{} of {} restarts were not begun: the fit was stopped before.", n_not_begun, report.restarts.size()),
         "One of them may have found a better optimum: fit again with `start` of this file."});
  }
  if (n_failed > 0) {
    advice.push_back({Level::note, fmt::format("{} of {} restarts found no finite start.", n_failed, report.restarts.size()),
                      "Look at the bounds in the model file: a random start within them was no possible system."});
  }
  if (n_finite >= 3 && n_best <= 1) {
    advice.push_back({Level::note,
                      n_best == 1 ? fmt::format("Only one of {} restarts reached the best optimum.", report.restarts.size())
                                  : "No restart reached the best optimum: a scan from the best of them found it.",
                      "There may be a better one that none has reached: fit with more `restarts` and compare the objective."});
  }
}

// Whether a lengthscale is that of a linear kernel, which only scales a slope.
bool is_slope(const FitFile& fit, const Hyperparameter& h) {
  if (!fit.model.system) return false;
  const Kernel kernel = fit.prior().latents[static_cast<std::size_t>(h.owner)].kernel;
  const std::string& name = kernel.parameters()[static_cast<std::size_t>(h.index)].name;
  // a kernel that is linear alone does not stand in the names of its parameters
  return name.starts_with("linear") || (name.starts_with("lengthscale") && kernel.text().find("linear") != std::string::npos);
}

// Hyperparameters at a bound of which the fit itself says nothing: not the system's, and no noise at its lower bound.
void bound_advice(const FitFile& fit, std::vector<Advice>& advice) {
  std::vector<std::string> short_lengthscales, others;
  for (const Hyperparameter& h : fit.report.hyperparameters) {
    const bool is_lower = h.value - h.lower < h.upper - h.value;
    const bool is_lengthscale = h.kind == Hyperparameter::Kind::kernel && h.name.find("lengthscale") != std::string::npos;
    if (!h.at_bound() || h.is_system_parameter() || (is_lengthscale && is_slope(fit, h))) continue;
    if (is_lengthscale && is_lower) {
      short_lengthscales.push_back(fmt::format("{} ({:.4g})", h.name, h.value));
    } else if (!(is_lengthscale || (h.kind == Hyperparameter::Kind::noise_stddev && is_lower))) {
      // a long lengthscale is a feature that does not matter, of which relevance_advice speaks
      others.push_back(fmt::format("{} ({} bound, {:.4g})", h.name, is_lower ? "lower" : "upper", h.value));
    }
  }
  if (!short_lengthscales.empty()) {
    advice.push_back({Level::note, fmt::format("At the lower bound: {}.", fmt::join(short_lengthscales, ", ")),
                      "The latent changes from row to row there: it explains noise by wiggles, or takes up steps, single "
                      "values that are wrong (`robust`), or what another feature would say. Look at the residuals against that "
                      "feature; a smaller bound makes it worse."});
  }
  if (!others.empty()) {
    advice.push_back(
        {Level::note, fmt::format("At a bound: {}.", fmt::join(others, ", ")),
         fit.prior_options.baseline
             ? "The bounds of a baseline are fixed, in proportion to the spread of its data: it is there to compare with."
             : "Widen the bounds in the model file if you have no reason for them."});
  }
}

// The first sentence is what was found, and all others what to do.
void note_advice(const std::vector<std::string>& notes, std::vector<Advice>& advice) {
  constexpr std::string_view warning = "warning: ";
  for (const std::string& note : notes) {
    const bool is_warning = note.starts_with(warning);
    std::string text = note.substr(is_warning ? warning.size() : 0);
    if (!text.ends_with('.')) text += '.';
    std::size_t end = text.find(". ");
    while (end != std::string::npos && std::isupper(static_cast<unsigned char>(text[end + 2])) == 0)
      end = text.find(". ", end + 1);
    const bool is_one = end == std::string::npos;
    advice.push_back(
        {is_warning ? Level::warning : Level::note, is_one ? text : text.substr(0, end + 1), is_one ? "" : text.substr(end + 2)});
  }
}

void relevance_advice(const Report& report, std::vector<Advice>& advice) {
  if (report.fit.report.iterations == 0) return;  // starting values say nothing
  std::vector<std::string> latents;
  for (const Relevance& one : report.relevance) {
    if (std::find(latents.begin(), latents.end(), one.latent) == latents.end()) latents.push_back(one.latent);
  }
  for (const std::string& latent : latents) {
    std::vector<std::string> features;
    std::ptrdiff_t n = 0;
    for (const Relevance& one : report.relevance) {
      if (one.latent != latent) continue;
      ++n;
      if (hardly_matters(one)) features.push_back(one.feature);
    }
    if (features.empty()) continue;
    if (std::ssize(features) == n) {
      advice.push_back({Level::note, fmt::format("No feature of '{}' matters: it is as good as constant.", latent),
                        "The known part of the model explains the data already, or the features are not those that count."});
    } else {
      advice.push_back({Level::note,
                        fmt::format("Of '{}', the {} {} hardly {}: the lengthscale is far beyond the spread in the data.", latent,
                                    features.size() == 1 ? "feature" : "features", fmt::join(features, ", "),
                                    features.size() == 1 ? "matters" : "matter"),
                        "Leaving out such features makes the model smaller and faster; if you expect an effect, take data with "
                        "more variation there."});
    }
  }
}

// A fit may have chosen the rows that it learned from, so that they are not numbered as those of the log.
std::string kept_row_text(const ReportData& data, int state) {
  return data.is_test ? fmt::format("row {} of {}", state + 1, data.name)
                      : fmt::format("row {} of the rows that {} kept", state + 1, data.name);
}

void constraint_advice(const Report& report, std::vector<Advice>& advice) {
  std::vector<std::string> names;
  const ReportData* worst = nullptr;
  for (const ReportData& data : report.data) {
    if (!data.violation || data.violation->relative <= constraint_violation_tolerance) continue;
    names.push_back(data.name);
    if (worst == nullptr || data.violation->relative > worst->violation->relative) worst = &data;
  }
  if (worst == nullptr) return;
  const ConstraintViolation& violation = *worst->violation;
  advice.push_back(
      {violation.relative > large_constraint_violation ? Level::warning : Level::note,
       fmt::format("States of the {} data are off the constraint. The farthest, {}: {} = {:.3g}, {:.2g} of "
                   "its scale.",
                   fmt::join(names, " and "), kept_row_text(*worst, violation.state), violation.constraint, violation.value,
                   violation.relative),
       "Small values are measurement noise, or estimated parameters, and do no harm. Large ones mean wrong units, signs or "
       "offsets of a column, or wrong parameters of the constraint: estimate them with `estimate`."});
}

void rank_advice(const Report& report, std::vector<Advice>& advice) {
  for (const ReportData& data : report.data) {
    const LowerRank& lower = data.lower_rank;
    if (lower.states.empty()) continue;
    advice.push_back({Level::warning,
                      fmt::format("The constraints have rank {} but at {} of {} states of the {} data, where it is as low as {}, "
                                  "first at {}.",
                                  lower.usual, lower.states.size(), data.states.cols(), data.name, lower.lowest,
                                  kept_row_text(data, lower.states.front())),
                      "One constraint less holds there, as at a dead centre of a linkage. If the machine has none, look whether "
                      "a row vanishes only as it is written: gp2 check names it."});
  }
}

void independence_advice(const Report& report, std::vector<Advice>& advice) {
  for (const ReportData& data : report.data) {
    if (data.independent.empty()) continue;
    advice.push_back(
        {Level::warning,
         fmt::format("The accelerations of the {} data follow from each other: they satisfy the constraint, or part of it, far "
                     "more closely than noise allows.",
                     data.name),
         fmt::format("They are not independent measurements. Fit with `observe={}`.", fmt::join(data.independent, ","))});
  }
}

// Measured accelerations of a test for which A ddq = b does not hold; of those of training the fit itself says it.
void residual_advice(const Report& report, std::vector<Advice>& advice) {
  for (const ReportData& data : report.data) {
    for (const ConstraintResidual& one : data.constraint_residuals) {
      if (!data.is_test || !one.is_too_large()) continue;
      advice.push_back({Level::warning, fmt::format("The {} data violate a constraint: {}.", data.name, one.text()),
                        "Until the cause is found, the rest of this page means little: check the rows named, units, signs and "
                        "frames of the columns, and the constants of the constraint."});
    }
  }
}

// A noise that came with each value is changed in the log, any other by an option, which a baseline and the paper's protocol do not
// have.
std::string noise_mend(const Report& report, const char* too) {
  const FitFile& fit = report.fit;
  const bool is_paper = !fit.options.empty() && request_of(fit).problem.protocol.name == Protocol::Name::paper;
  if (fit.prior_options.baseline || is_paper) return fmt::format("the noise is stated too {}", too);
  const bool is_stated = std::any_of(fit.observations.begin(), fit.observations.end(), [](const Observations& group) {
    bool any = false;
    for (int k = 0; k < group.view().size(); ++k) any = any || group.states_noise(k);
    return any;
  });
  if (!is_stated) return fmt::format("the noise is too {}: `noise_std=estimate`", too);
  return fmt::format(
      "the standard deviations in the log's columns NAME_std are too {}, and one factor for all does not correct them", too);
}

// Single errors far beyond the bands, and errors that follow a feature.
void error_shape_advice(const ReportData& data, std::vector<Advice>& advice) {
  const Eigen::MatrixXd z = standardised_errors(data);
  for (Eigen::Index k = 0; k < z.rows(); ++k) {
    const std::string& output = data.outputs[static_cast<std::size_t>(k)];
    std::vector<int> known;
    for (int i = 0; i < static_cast<int>(z.cols()); ++i) {
      if (!std::isnan(z(k, i))) known.push_back(i);
    }
    const auto farthest =
        std::max_element(known.begin(), known.end(), [&](int a, int b) { return std::abs(z(k, a)) < std::abs(z(k, b)); });
    constexpr double far = 6;  // of a million Gaussian values none
    if (farthest != known.end() && std::abs(z(k, *farthest)) > far) {
      advice.push_back({Level::warning,
                        fmt::format("At row {} of the {} data {} is off by {:.2g} standard deviations.", *farthest + 1, data.name,
                                    output, std::abs(z(k, *farthest))),
                        "An outlier of the log, or a state far from training at which the fit is overconfident."});
    }
    const double n = static_cast<double>(known.size());
    for (const auto& feature : data.features) {
      const Eigen::VectorXd& values = feature.second;
      std::sort(known.begin(), known.end(), [&](int a, int b) { return values[a] < values[b]; });
      double products = 0, squares = 0;
      for (std::size_t i = 0; i < known.size(); ++i) {
        squares += z(k, known[i]) * z(k, known[i]);
        if (i > 0) products += z(k, known[i - 1]) * z(k, known[i]);
      }
      // errors that are no larger than the bands follow what they like
      if (known.size() < 30 || squares < 1.5 * n || products < std::max(0.4, 4 / std::sqrt(n)) * squares) continue;
      advice.push_back(
          {Level::warning, fmt::format("Errors of {} in the {} data follow {}.", output, data.name, feature.first),
           "Neighbours in that feature err alike: the kernel or the features miss its shape, or training has too few "
           "points there."});
      break;
    }
  }
}

void coverage_advice(const Report& report, const ReportData& data, std::vector<Advice>& advice) {
  const Evaluation& e = data.evaluation;
  constexpr double nominal = 0.95;
  // three standard deviations of the share of n independent points, and no less than what anyone would act on
  const double tolerance = std::max(0.03, 3 * std::sqrt(nominal * (1 - nominal) / std::max(e.n, 1)));
  if (std::isfinite(e.coverage95) && e.coverage95 < nominal - tolerance) {
    advice.push_back(
        {Level::warning, fmt::format("Over-confident: {:.1f} % of the test data lie within the 95 % bands.", 100 * e.coverage95),
         fmt::format("The test goes where training has not been, {}, or a feature is missing. Residuals against each "
                     "feature show which; take training data there.",
                     noise_mend(report, "small"))});
    return;
  }
  if (!(std::isfinite(e.coverage95) && e.coverage95 > nominal + tolerance)) return;
  // errors below the noise, where the noise of training is what its residuals are
  const bool is_below_noise = (e.rmse.array() < 0.7 * data.noise_stddev.rowwise().mean().array()).all();
  const bool noise_is_right = std::none_of(report.cross_validation.residuals.begin(), report.cross_validation.residuals.end(),
                                           [](const auto& one) { return one.is_of_ddq && one.rms < 0.7; });
  const bool is_covered = std::isfinite(e.coverage95_latent) && std::abs(e.coverage95_latent - nominal) <= tolerance;
  const bool is_noise_free = is_covered || (is_below_noise && noise_is_right && !report.cross_validation.residuals.empty());
  if (is_noise_free && std::isfinite(e.coverage95_latent) && e.coverage95_latent < nominal - tolerance) {
    advice.push_back(
        {Level::warning,
         fmt::format("Over-confident: {:.1f} % of the test data, which seem to be free of noise, lie within the 95 % bands "
                     "without noise.",
                     100 * e.coverage95_latent),
         "The test goes where training has not been, or a feature is missing. Residuals against each feature show which; "
         "take training data there."});
    return;
  }
  if (is_noise_free && !is_covered) return;
  advice.push_back(
      {Level::note, fmt::format("Too cautious: {:.1f} % of the test data lie within the 95 % bands.", 100 * e.coverage95),
       is_noise_free ? "The test data seem to be free of noise: judge by the noise-free coverage, which is as it should be."
                     : fmt::format("If the test data hold measurement noise, {}.", noise_mend(report, "large"))});
}

void test_advice(const Report& report, const ReportData& data, std::vector<Advice>& advice) {
  coverage_advice(report, data, advice);
  error_shape_advice(data, advice);
  const ReportData& training = report.data.front();
  if (training.is_test || training.outputs != data.outputs) return;
  const Evaluation& e = data.evaluation;
  if (e.far.n > 0.05 * e.n) {
    advice.push_back(
        {Level::warning,
         fmt::format("{:.0f} % of the test states are far from those of training: nrmse {:.3g} there, {:.3g} at the others.",
                     100.0 * e.far.n / e.n, e.far.nrmse, e.near.nrmse),
         "Standard deviations are usually too small there. Take training data where the test goes."});
    return;
  }
  const double ratio = e.rmse.norm() / training.evaluation.rmse.norm();
  const bool beyond_noise = (e.rmse.array() > 2 * data.noise_stddev.rowwise().mean().array()).any();
  if (ratio > 3 && beyond_noise) {
    advice.push_back(
        {Level::warning, fmt::format("Test errors are {:.1f} times those of training.", ratio),
         "The test goes beyond the states of training, or training has too few points. Compare the pictures of both: "
         "where the band is wide, more training data help most."});
  }
}

}  // namespace

std::vector<Advice> learning_advice(const Report& report) {
  std::vector<Advice> advice;
  optimiser_advice(report.fit.report, advice);
  bound_advice(report.fit, advice);
  note_advice(report.notes, advice);
  for (const ReportData& data : report.data) note_advice(data.notes, advice);
  constraint_advice(report, advice);
  rank_advice(report, advice);
  independence_advice(report, advice);
  residual_advice(report, advice);
  for (const ReportData& data : report.data) {
    if (data.is_test) test_advice(report, data, advice);
  }
  relevance_advice(report, advice);
  std::stable_sort(advice.begin(), advice.end(), [](const Advice& a, const Advice& b) { return a.level > b.level; });
  if (advice.empty()) {
    advice.push_back({Level::good, "No problem was found.",
                      report.data.empty() || !report.data.back().is_test
                          ? "The training data cannot show everything: give `data` of a run that the fit has not seen."
                          : "Look at the pictures all the same: not everything is tested."});
  }
  return advice;
}

}  // namespace gp2
