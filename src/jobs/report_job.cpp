#include "gp2/jobs/report_job.hpp"

#include <algorithm>
#include <chrono>
#include <filesystem>
#include <utility>

#include <fmt/chrono.h>
#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "gp2/base/version.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "gp2/training/default_hyperparameters.hpp"
#include "jobs/fit_notes.hpp"
#include "jobs/report_data.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;

namespace {

// the day a file was written, in UTC
std::string date_of(const std::filesystem::path& path) {
  const auto written = std::chrono::file_clock::to_sys(std::filesystem::last_write_time(path));
  const auto seconds = std::chrono::time_point_cast<std::chrono::seconds>(written);
  return fmt::format("{:%Y-%m-%d}", fmt::gmtime(std::chrono::system_clock::to_time_t(seconds)));
}

void add_truth(const ReportRequest& request, Report& report) {
  const Model& truth = *request.truth;
  const System& fitted = *report.fit.model.system;
  if (truth.truth.empty()) {
    throw InputError(
        fmt::format("`truth={}`: has no [truth]; give a model file that says what the true acceleration is", truth.name));
  }
  if (truth.system->state_names() != fitted.state_names()) {
    throw InputError(fmt::format("`truth={}`: its state is {}, that of the fit is {}; coordinates and inputs must be the same",
                                 truth.name, fmt::join(truth.system->state_names(), " "), fmt::join(fitted.state_names(), " ")));
  }
  const ModelMotion motion(truth);
  const bool acts_alike = act_alike(truth.actuators, report.fit.model.actuators);
  if (!acts_alike && !request.data) {
    throw InputError(
        fmt::format("`truth={}`: has other delays or lags than the fit, which keeps no commands: give a `data`", truth.name));
  }
  bool any = false;
  for (ReportData& data : report.data) {
    if (request.system ? !data.is_test : data.is_of_other_system) continue;  // it is the truth of one system
    if (!data.is_test && !acts_alike) {
      report.notes.push_back(
          fmt::format("the true acceleration at the data of training is not shown: '{}' has other delays or lags, "
                      "and the fit keeps no commands",
                      truth.name));
      continue;
    }
    MatrixXd states = data.states;
    if (data.truth_inputs.size() > 0) states.bottomRows(data.truth_inputs.rows()) = data.truth_inputs;
    data.truth = motion.acceleration(states);
    for (Index i = 0; i < data.truth.cols(); ++i) {
      if (data.truth.col(i).allFinite()) {
        any = true;
      } else {
        data.truth.col(i).setConstant(not_a_number);
      }
    }
  }
  if (!any) {
    throw InputError(
        fmt::format("`truth={}`: not finite at any state of the data; the fit keeps only the columns its model reads, "
                    "so give a `data` with all that the truth reads",
                    truth.name));
  }
  report.truth_source = truth.system->name();
}

std::vector<Relevance> relevance_of(const Posterior& posterior) {
  std::vector<Relevance> all;
  const Prior& prior = posterior.prior();
  const ModelValues& values = posterior.values();
  const Scales scales = default_scales(prior, posterior.observations());
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    if (latent.kernel_is_fixed) continue;
    const double largest_signal = values.signal_stddev[a].cwiseQuotient(scales.signal_stddev[a]).maxCoeff();
    for (std::size_t p = 0; p < latent.kernel.parameters().size(); ++p) {
      const Kernel::Parameter& parameter = latent.kernel.parameters()[p];
      const bool periodic = parameter.kind == Kernel::ParameterKind::periodic_lengthscale;
      if (parameter.kind != Kernel::ParameterKind::lengthscale && !periodic) continue;
      Relevance one{latent.name, latent.feature_names[static_cast<std::size_t>(parameter.feature)]};
      one.lengthscale = values.kernel[a][static_cast<Index>(p)];
      one.spread = scales.feature_stddev[a][parameter.feature];
      one.relevance = (periodic ? 1 : one.spread) / one.lengthscale;
      if (!values.has_free_loading(a)) one.effect = largest_signal * one.relevance;
      const auto known = std::find_if(all.begin(), all.end(), [&](const Relevance& other) {
        return other.latent == one.latent && other.feature == one.feature;
      });
      if (known == all.end()) {
        all.push_back(std::move(one));
      } else if (std::pair(one.effect.value_or(0), one.relevance) > std::pair(known->effect.value_or(0), known->relevance)) {
        *known = std::move(one);
      }
    }
  }
  return all;
}

// What the fit said when it ended; of a file that does not hold it, what its data tell without fitting again.
std::vector<std::string> notes_of_fit(const FitFile& fit, const Posterior& posterior, const CrossValidation& cross_validation) {
  if (fit.notes) return *fit.notes;
  std::vector<std::string> notes = notes_of(fit.report, posterior);
  if (fit.report.inducing) add_inducing_note(*fit.report.inducing, notes);
  add_residual_notes(posterior, {posterior.observations()}, cross_validation.residuals, notes);
  add_stretch_note(cross_validation, notes, posterior.prior());
  const std::string correlated = correlated_text(cross_validation.residuals, fit.prior_options.baseline.has_value());
  if (!correlated.empty()) notes.push_back(correlated);
  return notes;
}

}  // namespace

std::vector<Option> options(ReportOptions& options) {
  return {
      {"data", &options.data, "CSV", "test log: CSV with states and accelerations that the fit has not seen"},
      {"system", &options.system, "OTHER.toml",
       "model file of the system of `data` and `truth`, if it is another one with the same coordinates, inputs and latents", "",
       "", "", "data"},
      {"truth", &options.truth, "MODEL", "model file whose [truth] is the true acceleration, shown beside the prediction"},
      columns_option(options.columns, "columns of `data` by other names"),
  };
}

Report collect_report(FitFile fit, const Posterior& posterior, const ReportRequest& request, std::vector<std::string>& notes) {
  if (!request.data && !request.columns.empty()) {
    throw InputError("`map` names columns of `data`, which is not given; the fit has its own data");
  }
  if (!request.data && request.system) throw InputError("`system` is that of `data`, which is not given");
  Report report;
  report.label = fit.model.system->name();
  report.library = fit.library.empty() ? version() : fit.library;
  report.fit = std::move(fit);
  report.data = training_data(report.fit, posterior);
  report.cross_validation = cross_validate(report.fit, posterior);
  report.notes = notes_of_fit(report.fit, posterior, report.cross_validation);
  report.relevance = relevance_of(posterior);
  report.learned = learned_forces(posterior, &report.notes);
  if (request.data) {
    report.data.push_back(compare(report.fit, posterior, request, notes));
    add_learned_note(report.fit, *request.data, notes);
  }
  if (request.truth) add_truth(request, report);
  if (const SymbolicSystem* system = report.fit.model.symbolic_system(); system != nullptr) {
    MatrixXd q(system->layout().size(), 0);
    for (const ReportData& data : report.data) {
      if (data.is_of_other_system) continue;  // which has another surface
      q.conservativeResize(Eigen::NoChange, q.cols() + data.states.cols());
      q.rightCols(data.states.cols()) = data.states;
    }
    report.surface = constraint_surface(*system, posterior.values().parameters, q);
  }
  return report;
}

Report collect_report(const std::filesystem::path& fit, const ReportRequest& request, std::vector<std::string>& notes) {
  FitFile file = FitFile::read(fit);
  const Posterior posterior = file.posterior();
  Report report = collect_report(std::move(file), posterior, request, notes);
  report.label = fit.string();
  report.file_date = date_of(fit);
  return report;
}

std::vector<Report> collect_reports(const ReportOptions& options, std::vector<std::string>& notes) {
  const auto model = [](const std::string& path) {
    return path.empty() ? nullptr : std::make_shared<const Model>(Model::read(path));
  };
  ReportRequest request;
  if (!options.data.empty()) request.data = CsvTable::read(options.data, CsvTable::Keep::numbers);
  request.truth = model(options.truth);
  request.system = model(options.system);
  request.columns = options.columns;
  std::vector<Report> reports;
  for (const std::string& fit : options.fits) {
    std::vector<std::string> of_this;
    reports.push_back(collect_report(std::filesystem::path(fit), request, of_this));
    // the log is read for each fit, but what is said of it is said once
    for (std::string& note : of_this) {
      if (std::ranges::find(notes, note) == notes.end()) notes.push_back(std::move(note));
    }
  }
  return reports;
}

}  // namespace gp2
