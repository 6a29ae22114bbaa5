#include <memory>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command.hpp"
#include "gp2/model.hpp"

namespace gp2::command {

namespace {

struct Arguments {
  std::string model;
  bool latex = false, full = false;
};

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

void print_latex(const SymbolicSystem::Definition& definition, const std::vector<std::vector<Expression>>& A,
                 const std::vector<std::vector<Expression>>& b, const std::vector<std::vector<Expression>>& F) {
  fmt::print("\\begin{{align*}}\n{}\\\\\n{}\\\\\n{}\\\\\n{}\\end{{align*}}\n", matrix_latex("M", definition.mass),
             matrix_latex("F", F), matrix_latex("A", A), matrix_latex("b", b));
}

void print_robot(const RobotDescription& robot) {
  const auto names = [](const auto& things) {
    std::vector<std::string> out;
    for (const auto& thing : things) out.push_back(thing.name);
    return out.empty() ? "none" : fmt::format("{}", fmt::join(out, ", "));
  };
  fmt::print("\nrobot {}\n  bodies      {}\n  sites       {}\n", robot.name, names(robot.bodies), names(robot.sites));
  for (const std::string& note : robot.notes) fmt::print("  {}\n", note);
}

void print_text(const Model& model, const SymbolicSystem& system, const std::vector<std::vector<Expression>>& A,
                const std::vector<std::vector<Expression>>& b, const std::vector<std::vector<Expression>>& F, bool full) {
  fmt::print("{}\n  {} coordinates, {} inputs, {} constraints\n", system.name(), system.nq(), system.inputs().size(),
             system.nc());
  if (model.robot) print_robot(*model.robot);
  fmt::print("\nmass matrix M\n{}", matrix_text(system.definition().mass, full));
  fmt::print("\nknown force F\n{}", matrix_text(F, full));
  fmt::print("\nconstraints A ddq = b\n");
  for (const ConstraintRow& row : system.definition().constraints) {
    const char* level = row.level == ConstraintRow::Level::position   ? "position"
                        : row.level == ConstraintRow::Level::velocity ? "velocity"
                                                                      : "acceleration";
    fmt::print("  {} = 0   ({} level)\n", row.text, level);
  }
  fmt::print("A\n{}b\n{}", matrix_text(A, full), matrix_text(b, full));
  fmt::print("\nparameters\n");
  for (const Parameter& parameter : system.parameters()) {
    fmt::print("  {:<12} {}", parameter.name, parameter.value);
    if (parameter.bounds) fmt::print("   in [{}, {}]", parameter.bounds->first, parameter.bounds->second);
    fmt::print("{}\n", parameter.estimate ? "   estimated" : "");
  }
  const Prior prior = make_prior(model);
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    fmt::print("\nlatent '{}'\n  kernel      {}\n  features    {}\n  acts on     {}\n", latent.name, latent.kernel.text(),
               fmt::join(latent.feature_names, ", "), fmt::join(latent.column_names, ", "));
    if (!latent.directions_are_identity) {
      fmt::print("  directions{}\n{}", latent.base == Latent::Base::force ? " (forces)" : "",
                 matrix_text(model.latents[a].directions, full));
    }
  }
}

void run(const Arguments& arguments) {
  const Model model = Model::read(arguments.model);
  const SymbolicSystem& system = require_symbolic_system(model);
  const SymbolicSystem::Definition& definition = system.definition();
  std::vector<std::vector<Expression>> A, b, F;
  for (const ConstraintRow& row : definition.constraints) {
    A.push_back(row.A);
    b.push_back({row.b});
  }
  for (Expression entry : definition.force) F.push_back({entry});
  if (arguments.latex) {
    print_latex(definition, A, b, F);
  } else {
    print_text(model, system, A, b, F, arguments.full);
  }
}

}  // namespace

Command show_command() {
  const auto a = std::make_shared<Arguments>();
  Command command{
      "show", "Print the derived A, b, M, F, the parameters and the features of a model", "gp2 show models/surface.toml", {}, {}};
  command.options = {argument("MODEL", a->model, "model file"),
                     {"latex", &a->latex, "", "as LaTeX"},
                     {"full", &a->full, "", "long expressions too, which otherwise are counted"}};
  command.run = [a](const std::set<std::string>&) { run(*a); };
  return command;
}

}  // namespace gp2::command
