#include "gp2/jobs/show_job.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <nlohmann/json.hpp>

#include "base/suggestion.hpp"
#include "gp2/error.hpp"
#include "gp2/training/laplace.hpp"

namespace gp2 {

namespace {

using OrderedJson = nlohmann::ordered_json;
using Rows = std::vector<std::vector<Expression>>;

/// M, F, A and b.
struct Derived {
  explicit Derived(const SymbolicSystem& system) : M(system.definition().mass) {
    for (const ConstraintRow& row : system.definition().constraints) {
      A.push_back(row.A);
      b.push_back({row.b});
    }
    for (const Expression entry : system.definition().force) F.push_back({entry});
  }

  Rows M, F, A, b;  // F and b of one column
};

// the expressions of a robot fill books
std::string entry_text(Expression e, bool full) {
  constexpr double readable = 100;
  const ExpressionSize size = e.graph().size_of(e);
  return full || size.written <= readable ? to_string(e) : fmt::format("({} operations)", size.operations);
}

std::string matrix_text(const Rows& rows, bool full) {
  // columns are aligned, but for the sake of no long entry
  constexpr std::size_t widest = 40;
  std::vector<std::size_t> widths;
  for (const auto& row : rows) {
    widths.resize(std::max(widths.size(), row.size()));
    for (std::size_t j = 0; j < row.size(); ++j) {
      const std::size_t size = entry_text(row[j], full).size();
      if (size <= widest) widths[j] = std::max(widths[j], size);
    }
  }
  std::string out;
  for (const auto& row : rows) {
    out += "  [";
    for (std::size_t j = 0; j < row.size(); ++j)
      out += fmt::format("{}{:<{}}", j == 0 ? " " : "   ", entry_text(row[j], full), widths[j]);
    out += " ]\n";
  }
  return out.empty() ? "  (no rows)\n" : out;
}

std::string text_of(const OrderedJson& json) {
  return json.dump(2, ' ', false, OrderedJson::error_handler_t::replace) + "\n";  // names of files may be of any encoding
}

std::string matrix_latex(const char* name, const Rows& rows) {
  std::string out = fmt::format("{} = \\begin{{bmatrix}}\n", name);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    std::vector<std::string> entries;
    for (Expression entry : rows[i]) entries.push_back(to_string(entry, Notation::latex));
    out += fmt::format("  {}{}\n", fmt::join(entries, " & "), i + 1 < rows.size() ? " \\\\" : "");
  }
  return out + "\\end{bmatrix}\n";
}

std::string latex_text(const Derived& derived) {
  return fmt::format("\\begin{{align*}}\n{}\\\\\n{}\\\\\n{}\\\\\n{}\\end{{align*}}\n", matrix_latex("M", derived.M),
                     matrix_latex("F", derived.F), matrix_latex("A", derived.A), matrix_latex("b", derived.b));
}

std::string robot_text(const RobotDescription& robot) {
  const auto names = [](const auto& things) {
    std::vector<std::string> out;
    for (const auto& thing : things) out.push_back(thing.name);
    return out.empty() ? "none" : fmt::format("{}", fmt::join(out, ", "));
  };
  std::string text =
      fmt::format("\nrobot {}\n  bodies      {}\n  sites       {}\n", robot.name, names(robot.bodies), names(robot.sites));
  for (const std::string& note : robot.notes) text += fmt::format("  {}\n", note);
  return text;
}

// " kg", or nothing
std::string spaced(const std::string& unit) { return unit.empty() ? "" : " " + unit; }

// "  0.1 kg   in [0, 1]   estimated"
std::string parameter_text(const Parameter& parameter, const std::string& unit = "") {
  std::string text = fmt::format("  {:<12} {}{}", parameter.name, parameter.value, spaced(unit));
  if (parameter.bounds) text += fmt::format("   in [{}, {}]", parameter.bounds->first, parameter.bounds->second);
  return text + (parameter.estimate ? "   estimated\n" : "\n");
}

// delays and lags [s]; nothing where every command acts itself
std::string actuators_text(const Model& model) {
  std::string text;
  for (const Actuator& actuator : model.actuators) {
    if (!actuator.is_direct() || actuator.is_estimated()) text += parameter_text(actuator.delay) + parameter_text(actuator.lag);
  }
  return text.empty() ? text : "\nactuators\n" + text;
}

std::string parameters_text(const Model& model, const System& system) {
  std::string text = "\nparameters\n";
  for (const Parameter& parameter : system.parameters()) text += parameter_text(parameter, model.unit_of(parameter.name));
  for (const Model::DerivedParameter& derived : model.derived_parameters) {
    text += fmt::format("  {:<12} {}{}   = {}\n", derived.name, derived.value, spaced(model.unit_of(derived.name)), derived.text);
  }
  return text;
}

// of coordinates, velocities and inputs; nothing where the model states none
std::string units_text(const Model& model, const System& system) {
  std::string text;
  for (const std::string& name : system.state_names()) {
    if (const std::string unit = model.unit_of(name); !unit.empty()) text += fmt::format("  {:<12} {}\n", name, unit);
  }
  return text.empty() ? text : "\nunits\n" + text;
}

std::string directions_text(const Model& model, const LatentSpec& latent, bool full) {
  if (latent.direction_code) return "  code\n";
  Rows directions;
  for (const std::vector<std::string>& row : latent.directions) {
    directions.emplace_back();
    for (const std::string& entry : row) directions.back().push_back(model.expression(entry));
  }
  return matrix_text(directions, full);
}

// "0.5   held", "from 0.5   in [0.1, 2]"
std::string range_text(const Latent::Range& range) {
  if (range.upper > 0 && range.lower == range.upper) return fmt::format("{}   held", range.upper);
  std::string text = range.initial > 0 ? fmt::format("from {}", range.initial) : "";
  if (range.upper > 0) text += fmt::format("{}in [{}, {}]", text.empty() ? "" : "   ", range.lower, range.upper);
  if (range.log_stddev > 0) {
    text += fmt::format("{}median {}, log_stddev {}", text.empty() ? "" : "   ", range.median, range.log_stddev);
  }
  return text;
}

// What `use` makes of each latent of the model file, of what it is in the prior, and of the names of the directions it acts in.
template <typename Use>
void for_each_latent(const Model& model, const Use& use) {
  const Prior prior = make_prior(model);
  for (const LatentSpec& spec : model.latents) {
    const auto is_of_it = [&](const Latent& latent) { return latent.name == spec.name; };
    std::vector<std::string> columns;
    for (const Latent& one : prior.latents) {
      if (is_of_it(one)) columns.insert(columns.end(), one.column_names.begin(), one.column_names.end());
    }
    use(spec, *std::find_if(prior.latents.begin(), prior.latents.end(), is_of_it), columns);
  }
}

std::string latents_text(const Model& model, bool full) {
  std::string text;
  for_each_latent(model, [&](const LatentSpec& spec, const Latent& latent, const std::vector<std::string>& columns) {
    text +=
        fmt::format("\nlatent '{}'\n  kernel      {}{}\n  features    {}\n  acts on     {}\n", latent.name, latent.kernel.text(),
                    latent.direction.empty() ? "" : "   one for each direction", fmt::join(latent.feature_names, ", "),
                    latent.is_potential ? "forces, as their potential" : fmt::format("{}", fmt::join(columns, ", ")));
    for (const auto& [feature, range] : spec.lengthscales) {
      text += fmt::format("  lengthscale {} {}\n", feature, range_text(range));
    }
    if (spec.directions.empty() && !spec.direction_code) return;
    text += fmt::format("  directions{}{}\n{}", latent.base == Latent::Base::force ? " (forces)" : "",
                        latent.is_positive ? ", times the exponential of the latent" : "", directions_text(model, spec, full));
  });
  return text;
}

std::string whole_text(const Model& model, const SymbolicSystem& system, bool full) {
  const Derived derived(system);
  std::string text = fmt::format("{}\n  {}, {}, {}\n", system.name(), counted(system.nq(), "coordinate"),
                                 counted(system.inputs().size(), "input"), counted(system.nc(), "constraint"));
  if (model.robot) text += robot_text(*model.robot);
  text += units_text(model, system);
  text += fmt::format("\nmass matrix M\n{}", matrix_text(derived.M, full));
  text += fmt::format("\nknown force F\n{}", matrix_text(derived.F, full));
  text += "\nconstraints A ddq = b\n";
  for (const ConstraintRow& row : system.definition().constraints) {
    text += fmt::format("  {} = 0   ({} level{}{})\n", row.text, word_of(row.level),
                        row.noise > 0 ? fmt::format(", noise {}", row.noise) : "",
                        row.condition.empty() ? "" : (row.contact ? ", a contact, when " : ", when ") + row.condition);
  }
  text += fmt::format("A\n{}b\n{}", matrix_text(derived.A, full), matrix_text(derived.b, full));
  return text + actuators_text(model) + parameters_text(model, system) + latents_text(model, full);
}

OrderedJson matrix_json(const Rows& rows) {
  OrderedJson json = OrderedJson::array();
  for (const auto& row : rows) {
    json.push_back(OrderedJson::array());
    for (const Expression entry : row) json.back().push_back(to_string(entry));
  }
  return json;
}

OrderedJson column_json(const Rows& rows) {
  OrderedJson json = OrderedJson::array();
  for (const auto& row : rows) json.push_back(to_string(row.front()));
  return json;
}

OrderedJson parameter_json(const Parameter& parameter) {
  OrderedJson json = {{"name", parameter.name}, {"value", parameter.value}};
  if (parameter.bounds) json.update({{"lower", parameter.bounds->first}, {"upper", parameter.bounds->second}});
  json["estimate"] = parameter.estimate;
  return json;
}

OrderedJson model_json(const Model& model, const SymbolicSystem& system) {
  const Derived derived(system);
  OrderedJson coordinates, constraints, parameters, latents;
  for (OrderedJson* list : {&coordinates, &constraints, &parameters, &latents}) *list = OrderedJson::array();
  for (const Coordinate& q : system.coordinates()) coordinates.push_back(q.name);
  for (const ConstraintRow& row : system.definition().constraints) {
    constraints.push_back({{"text", row.text}, {"level", word_of(row.level)}, {"noise", row.noise}});
    if (!row.condition.empty()) constraints.back().update({{"when", row.condition}, {"contact", row.contact.has_value()}});
  }
  for (const Parameter& parameter : system.parameters()) parameters.push_back(parameter_json(parameter));
  for (const Model::DerivedParameter& one : model.derived_parameters) {
    parameters.push_back({{"name", one.name}, {"value", one.value}, {"expression", one.text}});
  }
  for (const Actuator& actuator : model.actuators) {
    if (actuator.is_direct() && !actuator.is_estimated()) continue;
    for (const Parameter& parameter : {actuator.delay, actuator.lag}) parameters.push_back(parameter_json(parameter));
  }
  for_each_latent(model, [&](const LatentSpec&, const Latent& latent, const std::vector<std::string>& columns) {
    latents.push_back({{"name", latent.name},
                       {"kernel", latent.kernel.text()},
                       {"per_direction", !latent.direction.empty()},
                       {"features", latent.feature_names},
                       {"acts_on", columns}});
  });
  return {{"name", system.name()},       {"coordinates", coordinates},
          {"inputs", system.inputs()},   {"units", OrderedJson(model.units)},
          {"M", matrix_json(derived.M)}, {"F", column_json(derived.F)},
          {"constraints", constraints},  {"A", matrix_json(derived.A)},
          {"b", column_json(derived.b)}, {"parameters", parameters},
          {"latents", latents}};
}

// "0.1 ± 0.02   [0, 1]   at its bound"
std::string estimate_line(const std::string& name, double value, const std::string& error, const std::string& unit, double lower,
                          double upper, const char* remark) {
  return fmt::format("  {:<34} {:>13.6g}{}{}   [{:.3g}, {:.3g}]{}\n", name, value, error, spaced(unit), lower, upper, remark);
}

// "", " ± ∞" or " ± 0.02"
std::string error_text(double stddev) {
  return std::isnan(stddev) ? "" : std::isinf(stddev) ? " ± ∞" : fmt::format(" ± {:.2g}", stddev);
}

// Whether a standard error of it is told.
bool has_standard_error(const Hyperparameter& h) {
  return h.is_system_parameter() || h.kind == Hyperparameter::Kind::noise_stddev;
}

std::string draws_text(const FitReport& report) {
  const HyperparameterDraws& draws = *report.draws;
  Eigen::Index slowest = 0, worst = 0;
  const double size = draws.effective_size.minCoeff(&slowest), r_hat = draws.r_hat.maxCoeff(&worst);
  const auto name = [&](Eigen::Index k) { return report.hyperparameters[static_cast<std::size_t>(k)].name; };
  return fmt::format(
      "hyperparameters integrated: {} draws of {} chains, R̂ at most {:.4g} ({}), worth {:.0f} independent ones or more ({})\n",
      draws.size(), draws.n_chains, r_hat, name(worst), size, name(slowest));
}

}  // namespace

std::vector<Option> options(ShowRequest& request) {
  return {{"latex", &request.latex, "", "print as LaTeX"},
          {"full", &request.full, "", "print long expressions in full instead of their size"},
          {"json", &request.json, "", "print as JSON, with full expressions"}};
}

std::string show(const Model& model, const ShowRequest& request) {
  if (request.latex && request.json) throw InputError("`latex` and `json` are two forms of the same: leave out one");
  const SymbolicSystem& system = require_symbolic_system(model);
  if (request.json) return text_of(model_json(model, system));
  return request.latex ? latex_text(Derived(system)) : whole_text(model, system, request.full);
}

std::string show(const FitFile& fit, const ShowRequest& request, const Spelling& spelled) {
  std::vector<std::string> notes = fit.notes.value_or(std::vector<std::string>());
  for (std::string& note : notes) note = spelled(note);
  const std::string of_model = show(fit.model, request);
  if (request.latex) return of_model;
  const std::vector<std::int64_t> n = fit.n_states();
  const std::int64_t n_states = std::accumulate(n.begin(), n.end(), std::int64_t{0});
  if (!request.json) {
    const std::string said = notes.empty() ? "" : fmt::format("\nnotes\n  {}\n", fmt::join(notes, "\n  "));
    std::string found = text_of(fit.report, fit.model);
    // what a fit said goes as soon as its rows change; a checkpoint has said nothing yet
    if (!fit.notes && !fit.report.restarts.empty())
      found.insert(found.find('\n'), ", at the last fit or shoot; rows may have changed since");
    return fmt::format("learned from {} states of {}\n{}{}\n{}", n_states, fit.data_source, found, said, of_model);
  }
  OrderedJson json = OrderedJson::parse(of_model), hyperparameters = OrderedJson::object(), stddevs = OrderedJson::object();
  for (const ActuatorEstimate& one : fit.report.actuators) stddevs[one.name] = one.stddev;
  for (std::size_t k = 0; k < fit.report.hyperparameters.size(); ++k) {
    const Hyperparameter& h = fit.report.hyperparameters[k];
    hyperparameters[h.name] = h.value;
    if (has_standard_error(h)) stddevs[h.name] = parameter_uncertainty(fit.report, k).stddev;
  }
  json["fit"] = {{"data", fit.data_source},
                 {"states", n_states},
                 {"nll", fit.report.negative_log_likelihood},
                 {"termination", fit.report.termination},
                 {"hyperparameters", hyperparameters},
                 {"stddev", stddevs},
                 {"notes", notes},
                 {"options", fit.options.empty() ? OrderedJson() : OrderedJson::parse(fit.options)}};
  return text_of(json);
}

const char* word_of(ConstraintRow::Level level) {
  return level == ConstraintRow::Level::position   ? "position"
         : level == ConstraintRow::Level::velocity ? "velocity"
                                                   : "acceleration";
}

std::string unit_of(const Hyperparameter& h, const Model& model) {
  constexpr std::string_view of = "unit of ";  // as default hyperparameters have it
  return model.unit_of(h.unit.starts_with(of) ? h.unit.substr(of.size()) : h.is_system_parameter() ? h.name : "");
}

std::string text_of(const FitReport& report, const Model& model) {
  const double nll = report.negative_log_likelihood;
  std::string text = "negative log likelihood ";
  text += std::abs(nll) < 1e9 ? fmt::format("{:.6f}\n", nll) : fmt::format("{:.6g}\n", nll);
  text += report.restarts.empty()
              ? fmt::format("{}: a checkpoint of a fit in progress", report.termination)
              : fmt::format("{} after {} ({}, best: {})", report.termination, counted(report.iterations, "iteration"),
                            counted(report.restarts.size(), "restart"), report.best_restart + 1);
  text += report.seconds > 0 ? fmt::format(", {:.2f} s\n", report.seconds) : "\n";  // no file holds how long it took
  if (report.draws) text += draws_text(report);
  for (const ActuatorEstimate& one : report.actuators) {
    text += estimate_line(one.name, one.value, error_text(one.stddev), model.units.empty() ? "" : "s", one.lower, one.upper,
                          one.at_lower() || one.at_upper() ? "   at its bound" : "");
  }
  for (std::size_t k = 0; k < report.hyperparameters.size(); ++k) {
    const Hyperparameter& h = report.hyperparameters[k];
    std::string error;
    if (has_standard_error(h)) {
      const ParameterUncertainty known = parameter_uncertainty(report, k);
      error = error_text(known.stddev);
      if (known.is_of_draws) error += fmt::format(" (mean {:.6g}, 95 % {:.6g} … {:.6g})", known.mean, known.lower, known.upper);
    }
    text += estimate_line(h.name, h.value, error, unit_of(h, model), h.lower, h.upper,
                          h.is_fixed()   ? "   held"
                          : h.at_bound() ? "   at its bound"
                                         : "");
  }
  return text;
}

}  // namespace gp2
