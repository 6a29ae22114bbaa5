#include "gp2/jobs/show_job.hpp"

#include <algorithm>

#include <fmt/format.h>
#include <fmt/ranges.h>

namespace gp2 {

namespace {

// the expressions of a robot fill books
std::string entry_text(Expression e, bool full) {
  constexpr double readable = 100;
  const ExpressionSize size = e.graph().size_of(e);
  return full || size.written <= readable ? to_string(e) : fmt::format("({} operations)", size.operations);
}

std::string matrix_text(const std::vector<std::vector<Expression>>& rows, bool full) {
  // columns aligned
  std::vector<std::size_t> widths;
  for (const auto& row : rows) {
    widths.resize(std::max(widths.size(), row.size()));
    for (std::size_t j = 0; j < row.size(); ++j) widths[j] = std::max(widths[j], entry_text(row[j], full).size());
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

std::string matrix_latex(const char* name, const std::vector<std::vector<Expression>>& rows) {
  std::string out = fmt::format("{} = \\begin{{bmatrix}}\n", name);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    std::vector<std::string> entries;
    for (Expression entry : rows[i]) entries.push_back(to_string(entry, Notation::latex));
    out += fmt::format("  {}{}\n", fmt::join(entries, " & "), i + 1 < rows.size() ? " \\\\" : "");
  }
  return out + "\\end{bmatrix}\n";
}

std::string latex_text(const SymbolicSystem::Definition& definition, const std::vector<std::vector<Expression>>& A,
                       const std::vector<std::vector<Expression>>& b, const std::vector<std::vector<Expression>>& F) {
  return fmt::format("\\begin{{align*}}\n{}\\\\\n{}\\\\\n{}\\\\\n{}\\end{{align*}}\n", matrix_latex("M", definition.mass),
                     matrix_latex("F", F), matrix_latex("A", A), matrix_latex("b", b));
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

// "  0.1   in [0, 1]   estimated"
std::string parameter_text(const Parameter& parameter) {
  std::string text = fmt::format("  {:<12} {}", parameter.name, parameter.value);
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
  for (const Parameter& parameter : system.parameters()) text += parameter_text(parameter);
  for (const Model::DerivedParameter& derived : model.derived_parameters) {
    text += fmt::format("  {:<12} {}   = {}\n", derived.name, derived.value, derived.text);
  }
  return text;
}

std::string directions_text(const Model& model, const LatentSpec& latent, bool full) {
  if (latent.direction_code) return "  code\n";
  std::vector<std::vector<Expression>> directions;
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

std::string latents_text(const Model& model, bool full) {
  std::string text;
  const Prior prior = make_prior(model);
  for (const LatentSpec& spec : model.latents) {
    const auto is_of_it = [&](const Latent& latent) { return latent.name == spec.name; };
    const Latent& latent = *std::find_if(prior.latents.begin(), prior.latents.end(), is_of_it);
    std::vector<std::string> columns;
    for (const Latent& one : prior.latents) {
      if (is_of_it(one)) columns.insert(columns.end(), one.column_names.begin(), one.column_names.end());
    }
    text += fmt::format("\nlatent '{}'\n  kernel      {}{}\n  features    {}\n  acts on     {}\n", latent.name,
                        latent.kernel.text(), latent.direction.empty() ? "" : "   one for each direction",
                        fmt::join(latent.feature_names, ", "), fmt::join(columns, ", "));
    for (const auto& [feature, range] : spec.lengthscales) {
      text += fmt::format("  lengthscale {} {}\n", feature, range_text(range));
    }
    if (spec.directions.empty() && !spec.direction_code) continue;
    text += fmt::format("  directions{}\n{}", latent.base == Latent::Base::force ? " (forces)" : "",
                        directions_text(model, spec, full));
  }
  return text;
}

std::string whole_text(const Model& model, const SymbolicSystem& system, const std::vector<std::vector<Expression>>& A,
                       const std::vector<std::vector<Expression>>& b, const std::vector<std::vector<Expression>>& F, bool full) {
  std::string text = fmt::format("{}\n  {} coordinates, {} inputs, {} constraints\n", system.name(), system.nq(),
                                 system.inputs().size(), system.nc());
  if (model.robot) text += robot_text(*model.robot);
  text += fmt::format("\nmass matrix M\n{}", matrix_text(system.definition().mass, full));
  text += fmt::format("\nknown force F\n{}", matrix_text(F, full));
  text += "\nconstraints A ddq = b\n";
  for (const ConstraintRow& row : system.definition().constraints) {
    const char* level = row.level == ConstraintRow::Level::position   ? "position"
                        : row.level == ConstraintRow::Level::velocity ? "velocity"
                                                                      : "acceleration";
    text += fmt::format("  {} = 0   ({} level{}{})\n", row.text, level, row.noise > 0 ? fmt::format(", noise {}", row.noise) : "",
                        row.condition.empty() ? "" : (row.contact ? ", a contact, when " : ", when ") + row.condition);
  }
  text += fmt::format("A\n{}b\n{}", matrix_text(A, full), matrix_text(b, full));
  return text + actuators_text(model) + parameters_text(model, system) + latents_text(model, full);
}

}  // namespace

std::vector<Option> options(ShowRequest& request) {
  return {{"latex", &request.latex, "", "as LaTeX"},
          {"full", &request.full, "", "long expressions too, which otherwise are counted"}};
}

std::string show(const Model& model, const ShowRequest& request) {
  const SymbolicSystem& system = require_symbolic_system(model);
  const SymbolicSystem::Definition& definition = system.definition();
  std::vector<std::vector<Expression>> A, b, F;
  for (const ConstraintRow& row : definition.constraints) {
    A.push_back(row.A);
    b.push_back({row.b});
  }
  for (Expression entry : definition.force) F.push_back({entry});
  return request.latex ? latex_text(definition, A, b, F) : whole_text(model, system, A, b, F, request.full);
}

}  // namespace gp2
