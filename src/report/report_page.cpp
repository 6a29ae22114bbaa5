#include "gp2/report/report_page.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <limits>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <nlohmann/json.hpp>

#include "gp2/base/statistics.hpp"
#include "gp2/base/version.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/training/laplace.hpp"
#include "jobs/hyperparameters_json.hpp"
#include "report/assets.hpp"
#include "report/markup.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

using Json = nlohmann::ordered_json;

// more points than these are not drawn: an even selection is
constexpr Index max_drawn = 2000;
// of marks along an axis
constexpr Index max_ticks = 200;

// For pictures: six digits, or more where a row changes little beside its size, as the time since 1970 does.
template <typename Row>
int digits_of(const Row& row) {
  constexpr double infinity = std::numeric_limits<double>::infinity();
  double low = infinity, high = -infinity;
  for (Index i = 0; i < row.size(); ++i) {
    if (!std::isfinite(row[i])) continue;
    low = std::min(low, row[i]);
    high = std::max(high, row[i]);
  }
  if (!(low < high)) return 6;
  const double ratio = std::max(std::abs(low), std::abs(high)) / (high - low);
  return static_cast<int>(std::clamp(6 + std::log10(ratio), 6.0, 17.0));
}

// What is not finite becomes null, here and wherever a number is written as JSON.
template <typename Row>
Json row_json(const Row& row, Index stride = 1) {
  const int digits = digits_of(row);
  Json array = Json::array();
  for (Index i = 0; i < row.size(); i += stride) {
    array.push_back(std::strtod(fmt::format("{:.{}g}", row[i], digits).c_str(), nullptr));
  }
  return array;
}

Json rows_json(const MatrixXd& matrix, Index stride = 1) {
  Json rows = Json::array();
  for (Index k = 0; k < matrix.rows(); ++k) rows.push_back(row_json(matrix.row(k), stride));
  return rows;
}

std::string matrix_mathml(const char* name, const std::vector<std::vector<Expression>>& rows) {
  constexpr std::size_t longest = 60'000;  // characters; beyond it nobody reads the matrix
  std::string body;
  for (const auto& row : rows) {
    body += "<mtr>";
    for (const Expression entry : row) {
      if (entry.graph().size_of(entry).written > longest) return "";
    }
    for (const Expression entry : row) body += "<mtd><mrow>" + to_string(entry, Notation::mathml) + "</mrow></mtd>";
    body += "</mtr>";
    if (body.size() > longest) return "";
  }
  return fmt::format(
      "<math xmlns=\"http://www.w3.org/1998/Math/MathML\" display=\"block\"><mrow><mi>{}</mi><mo>=</mo><mrow><mo>[</mo><mtable>{}"
      "</mtable><mo>]</mo></mrow></mrow></math>",
      name, body);
}

Json model_json(const FitFile& fit) {
  const System& system = *fit.model.system;
  std::vector<std::vector<Expression>> A, b;
  Json constraints = Json::array();
  if (const SymbolicSystem* symbolic = fit.model.symbolic_system()) {
    for (const ConstraintRow& row : symbolic->definition().constraints) {
      A.push_back(row.A);
      b.push_back({row.b});
      constraints.push_back({{"text", row.text}, {"level", word_of(row.level)}});
      if (!row.condition.empty()) constraints.back().update({{"when", row.condition}, {"contact", row.contact.has_value()}});
    }
  } else {
    for (const std::string& label : system.constraint_labels())
      constraints.push_back({{"text", label}, {"level", "given by code"}});
  }
  Json coordinates = Json::array();
  for (const Coordinate& coordinate : system.coordinates()) coordinates.push_back(coordinate.name);
  return {{"name", system.name()},
          {"file", fit.model.name},
          {"coordinates", coordinates},
          {"inputs", system.inputs()},
          {"units", Json(fit.model.known_units())},
          {"constraints", constraints},
          {"A", A.empty() ? "" : matrix_mathml("A", A)},
          {"b", b.empty() ? "" : matrix_mathml("b", b)}};
}

Json prior_json(const FitFile& fit) {
  Json rows = Json::array();
  const auto add = [&rows](const std::string& label, const std::string& value) { rows.push_back({label, value}); };
  const Prior prior = fit.prior();
  if (fit.prior_options.baseline) {
    add("baseline", fmt::format("{}: learns ddq without mechanics", Baseline::word(fit.prior_options.baseline->kind)));
  }
  add("mean of ā", prior.mean == Prior::Mean::force      ? "M⁻¹F, the model's known force"
                   : prior.mean == Prior::Mean::constant ? "constant, the mean of the training data"
                                                         : "zero");
  for (const Latent& latent : prior.latents) {
    if (latent.kernel_is_fixed) {
      add("latent " + latent.name, "small and fixed: what the kernel would rule out without reason");
      continue;
    }
    if (latent.is_potential) {
      add("latent " + latent.name,
          fmt::format("{} of {}; the potential of a force", latent.kernel.text(), fmt::join(latent.feature_names, ", ")));
      continue;
    }
    add("latent " + latent.name + (latent.direction.empty() ? "" : ", " + latent.direction),
        fmt::format("{} of {}; acts on {}{}", latent.kernel.text(), fmt::join(latent.feature_names, ", "),
                    fmt::join(latent.column_names, ", "), latent.base == Latent::Base::force ? " (forces)" : ""));
  }
  if (fit.report.inducing) add("learned through", fmt::format("{} inducing variables", fit.report.inducing->n_variables));
  return rows;
}

Json observations_json(const FitFile& fit) {
  const Prior fitted = fit.prior();
  const ModelValues values = model_values(fitted, fit.observations, fit.report.hyperparameters);
  const std::vector<std::int64_t> n_states = fit.n_states();
  Json groups = Json::array();
  for (std::size_t g = 0; g < fit.observations.size(); ++g) {
    const Observations& group = fit.observations[g];
    const std::string latent =
        !group.view().latent ? "" : fitted.latents[static_cast<std::size_t>(group.view().latent->first)].name;
    Json noise = Json::array();
    for (const double one : group.usual_noise(values.noise_stddev[g])) noise.push_back(one);
    groups.push_back({{"names", group.view().names(*prior_of(fitted, group.view()).system, latent)},
                      {"n", n_states[g]},
                      {"system", g < fit.systems.size() && fit.systems[g] ? fit.systems[g]->system->name() : ""},
                      {"noise", noise},
                      {"estimated", group.noise().is_estimated()}});
  }
  return groups;
}

Json parameters_json(const FitFile& fit) {
  Json rows = Json::array();
  for (const Parameter& parameter : fit.model.system->parameters()) {
    Json row = {{"name", parameter.name}, {"model", parameter.value}};
    for (std::size_t k = 0; k < fit.report.hyperparameters.size(); ++k) {
      const Hyperparameter& h = fit.report.hyperparameters[k];
      if (h.kind != Hyperparameter::Kind::parameter || h.name != parameter.name) continue;
      row["fitted"] = h.value;
      row["lower"] = h.lower;
      row["upper"] = h.upper;
      row["at_bound"] = h.at_bound();
      const double stddev = parameter_uncertainty(fit.report, k).stddev;
      if (!std::isnan(stddev)) row["stddev"] = std::isinf(stddev) ? Json("not determined") : Json(stddev);
    }
    rows.push_back(row);
  }
  return rows;
}

// Beside where most of their draws are.
Json drawn_hyperparameters_json(const FitReport& report, const Model& model) {
  Json rows = hyperparameters_json(report, model);
  for (Index k = 0; report.draws && k < std::ssize(rows); ++k)
    rows[static_cast<std::size_t>(k)]["drawn95"] = {report.draws->lower[k], report.draws->upper[k]};
  return rows;
}

Json fit_json(const FitReport& report, bool rows_are_those_of_fit) {
  Json restarts = Json::array();
  for (const RestartReport& one : report.restarts) {
    restarts.push_back({{"objective", one.objective},
                        {"nll", one.negative_log_likelihood},
                        {"iterations", one.iterations},
                        {"evaluations", one.evaluations},
                        {"failed", one.failed_evaluations},
                        {"converged", one.converged},
                        {"termination", one.termination}});
  }
  Json draws;
  if (report.draws) {
    draws = {{"n", report.draws->size()},
             {"n_chains", report.draws->n_chains},
             {"r_hat", report.draws->r_hat.maxCoeff()},
             {"effective_size", report.draws->effective_size.minCoeff()}};
  }
  return {{"draws", draws},
          {"rows_are_those_of_fit", rows_are_those_of_fit},
          {"nll", report.negative_log_likelihood},
          {"objective", report.objective},
          {"converged", report.converged},
          {"termination", report.termination},
          {"iterations", report.iterations},
          {"best_restart", report.best_restart},
          {"restarts", restarts}};
}

Json figures_json(const ReportData& data) {
  const Evaluation& e = data.evaluation;
  const VectorXd truth = data.rmse_to_truth();
  Json rmse = Json::array(), rmse_to_truth = Json::array();
  for (Index k = 0; k < e.rmse.size(); ++k) {
    rmse.push_back(e.rmse[k]);
    rmse_to_truth.push_back(truth[k]);
  }
  return {{"outputs", data.outputs},
          {"rmse", rmse},
          {"rmse_to_truth", rmse_to_truth},
          {"rmse_normalised", e.rmse_normalised},
          {"nrmse", e.nrmse},
          {"max_constraint_error", e.max_constraint_error},
          {"max_constraint_error_fitted", e.max_constraint_error_fitted},
          {"nlpd", e.nlpd},
          {"coverage50", e.coverage50},
          {"coverage80", e.coverage80},
          {"coverage95", e.coverage95},
          {"nlpd_latent", e.nlpd_latent},
          {"coverage50_latent", e.coverage50_latent},
          {"coverage80_latent", e.coverage80_latent},
          {"coverage95_latent", e.coverage95_latent},
          {"n_zero_variance", e.n_zero_variance},
          {"n_far", e.far.n},
          {"nrmse_near", e.near.nrmse},
          {"nrmse_far", e.far.nrmse},
          {"coverage95_far", e.far.coverage95},
          {"n", e.n}};
}

Json rollout_json(const System& system, const Rollout& rollout, const Spelling& spelled) {
  if (!rollout.reason.empty()) return {{"reason", spelled(rollout.reason)}};
  Json potentials = Json::array();
  for (std::size_t k = 0; k < rollout.potentials.size(); ++k) {
    const auto row = static_cast<Index>(k);
    potentials.push_back({{"latent", rollout.potentials[k]},
                          {"mean", row_json(rollout.potential.row(row))},
                          {"stddev", row_json(rollout.potential_stddev.row(row))}});
  }
  return {{"t", row_json(rollout.times)},
          {"measured", rows_json(rollout.measured)},
          {"simulated", rows_json(rollout.simulated)},
          {"stddev", rows_json(rollout.stddev)},
          {"ended", spelled(rollout.ended)},
          {"leaves", rollout.leaves ? Json(*rollout.leaves) : Json()},
          {"leaving", rollout.leaving},
          {"far_from", rollout.far_from ? Json(*rollout.far_from) : Json()},
          {"multipliers", rollout.multipliers.rows() > 0 ? View::multipliers(system).names(system) : std::vector<std::string>()},
          {"lambda", rows_json(rollout.multipliers)},
          {"lambda_stddev", rows_json(rollout.multipliers_stddev)},
          {"lambda_simulated", rows_json(rollout.simulated_multipliers)},
          {"energy", row_json(rollout.energy)},
          {"energy_simulated", row_json(rollout.simulated_energy)},
          {"potentials", potentials},
          {"points", rollout.points},
          {"lines", rollout.lines},
          {"measured_points", rows_json(rollout.measured_points)},
          {"simulated_points", rows_json(rollout.simulated_points)}};
}

VectorXd nominal_levels() {
  VectorXd levels(21);
  levels << VectorXd::LinSpaced(20, 0, 0.95), 0.99;
  return levels;
}

Json data_json(const Report& report, const ReportData& data, const Spelling& spelled) {
  const System& system = *report.fit.model.system;
  const Index n = data.measured.cols();
  const Index stride = (n + max_drawn - 1) / max_drawn;
  const std::vector<std::string> names = system.state_names();
  Json columns = Json::object();
  for (std::size_t k = 0; k < names.size(); ++k) {
    const auto row = data.states.row(static_cast<Index>(k));
    if (!row.hasNaN()) columns[names[k]] = row_json(row, stride);
  }
  Json features = Json::array();
  for (const auto& [name, values] : data.features) {
    features.push_back(name);
    if (!columns.contains(name)) columns[name] = row_json(values, stride);
  }
  const VectorXd levels = nominal_levels();
  Json noise = Json::array();
  // the page draws one band for all measurements of an output
  for (const auto& row : data.noise_stddev.rowwise()) noise.push_back(median({row.begin(), row.end()}));
  const auto errors = data.constraint_error.array();
  const double largest_error = errors.size() == 0 ? 0 : errors.isNaN().select(0, errors).maxCoeff();
  Json json = {{"name", data.name},
               {"source", data.source},
               {"test", data.is_test},
               {"other_system", data.is_of_other_system},
               {"n", n},
               {"stride", stride},
               {"outputs", data.outputs},
               {"rows", data.rows},
               {"features", features},
               {"figures", figures_json(data)},
               {"noise", noise},
               {"levels", row_json(levels)},
               {"coverage", rows_json(coverage(data, levels).transpose())},
               {"pit_near", rows_json(pit_counts(data, /*far=*/false).transpose())},
               {"pit_far", rows_json(pit_counts(data, /*far=*/true).transpose())},
               {"columns", columns},
               {"measured", rows_json(data.measured, stride)},
               {"predicted", rows_json(data.predicted, stride)},
               {"residual", rows_json(data.measured - data.predicted(data.rows, Eigen::all), stride)},
               {"stddev", rows_json(data.stddev, stride)},
               {"unconstrained", rows_json(data.unconstrained, stride)},
               {"unconstrained_stddev", rows_json(data.unconstrained_stddev, stride)},
               {"constraint_error", rows_json(data.constraint_error, stride)},
               {"largest_constraint_error", largest_error},
               {"rollout", rollout_json(system, data.rollout, spelled)}};
  if (data.truth.cols() > 0) json["truth"] = rows_json(data.truth, stride);
  return json;
}

Json relevance_json(const std::vector<Relevance>& all) {
  Json rows = Json::array();
  for (const Relevance& one : all) {
    rows.push_back({{"latent", one.latent},
                    {"feature", one.feature},
                    {"lengthscale", one.lengthscale},
                    {"spread", one.spread},
                    {"relevance", one.relevance},
                    {"effect", one.effect ? Json(*one.effect) : Json()}});
  }
  return rows;
}

Json learned_json(const std::vector<LearnedForce>& all) {
  Json curves = Json::array();
  for (const LearnedForce& one : all) {
    // coordinates that the latent does not act on have no picture
    const VectorXd size = one.mean.cwiseAbs().rowwise().maxCoeff() + one.stddev.rowwise().maxCoeff();
    for (Index k = 0; k < size.size(); ++k) {
      if (!(size[k] > 1e-12 * size.maxCoeff())) continue;
      curves.push_back({{"name", one.names[static_cast<std::size_t>(k)]},
                        {"along", one.along},
                        {"at", row_json(one.at)},
                        {"mean", row_json(one.mean.row(k))},
                        {"stddev", row_json(one.stddev.row(k))},
                        {"data", row_json(one.data, (one.data.size() + max_ticks - 1) / max_ticks)}});
    }
  }
  return curves;
}

Json surface_json(const ConstraintSurface& surface) {
  Json sheets = Json::array();
  for (const MatrixXd& sheet : surface.sheets) sheets.push_back(rows_json(sheet));
  return {{"first", surface.first},
          {"second", surface.second},
          {"solved", surface.solved},
          {"first_grid", row_json(surface.first_grid)},
          {"second_grid", row_json(surface.second_grid)},
          {"sheets", sheets}};
}

Json advice_json(const std::vector<Advice>& all, const Spelling& spelled) {
  Json rows = Json::array();
  for (const Advice& one : all) {
    const char* level = one.level == Advice::Level::warning ? "warning" : one.level == Advice::Level::note ? "note" : "good";
    rows.push_back({{"level", level}, {"text", spelled(one.text)}, {"mend", spelled(one.mend)}});
  }
  return rows;
}

Json page_json(const Report& report, const Spelling& spelled) {
  Json json = {{"version", version()},
               {"label", report.label},
               {"library", report.library},
               {"date", report.file_date},
               {"source", report.fit.data_source},
               {"truth", report.truth_source},
               {"model", model_json(report.fit)},
               {"prior", prior_json(report.fit)},
               {"observations", observations_json(report.fit)},
               {"parameters", parameters_json(report.fit)},
               {"hyperparameters", drawn_hyperparameters_json(report.fit.report, report.fit.model)},
               // what a fit said goes as soon as its rows change
               {"fit", fit_json(report.fit.report, report.fit.notes.has_value())},
               {"left_out", report.data.empty() ? "" : report.cross_validation.text()},
               {"advice", advice_json(learning_advice(report), spelled)},
               {"relevance", relevance_json(report.relevance)},
               {"learned", learned_json(report.learned)},
               {"data", Json::array()}};
  for (const ReportData& data : report.data) json["data"].push_back(data_json(report, data, spelled));
  if (report.surface) json["surface"] = surface_json(*report.surface);
  return json;
}

}  // namespace

std::string report_json(const std::vector<Report>& reports, const Spelling& spelled) {
  Json json = Json::array();
  for (const Report& report : reports) json.push_back(page_json(report, spelled));
  std::string text = json.dump(-1, ' ', /*ensure_ascii=*/true, Json::error_handler_t::replace);
  // a < stands in strings only; written so it can neither end the element nor open a comment
  replace_all(text, "<", "\\u003c");
  return text;
}

std::string report_page(const std::vector<Report>& reports, const Spelling& spelled) {
  const std::vector<std::pair<std::string_view, std::string>> parts = {
      {"{{title}}", markup_text(reports.front().fit.model.system->name())},
      {"{{uplot_css}}", std::string(assets::uplot_css)},
      {"{{style}}", std::string(assets::report_css)},
      {"{{uplot_license}}", std::string(assets::uplot_license)},
      {"{{uplot}}", std::string(assets::uplot_js)},
      {"{{script}}", std::string(assets::report_js)},
      {"{{data}}", report_json(reports, spelled)},
  };
  // one pass over the template, so that what is put in is never read for marks
  std::string page;
  std::string_view rest = assets::page_html;
  while (!rest.empty()) {
    const std::size_t mark = std::min(rest.find("{{"), rest.size());
    page += rest.substr(0, mark);
    rest.remove_prefix(mark);
    const auto part = std::find_if(parts.begin(), parts.end(), [&](const auto& one) { return rest.starts_with(one.first); });
    if (part == parts.end()) {
      page += rest.substr(0, 2);
      rest.remove_prefix(std::min<std::size_t>(2, rest.size()));
    } else {
      page += part->second;
      rest.remove_prefix(part->first.size());
    }
  }
  return page;
}

}  // namespace gp2
