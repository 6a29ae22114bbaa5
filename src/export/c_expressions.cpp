#include <fmt/format.h>
#include <fmt/ranges.h>

#include "export/c_writer.hpp"

namespace gp2::c_export {

using Eigen::Index;

namespace {

// what expressions call
constexpr Piece helpers[] = {
    {"sign_of", R"c(static real sign_of(real x)
{
  return x > 0 ? 1 : x < 0 ? -1 : x;
}
)c"},
    {"smaller", R"c(static real smaller(real x, real y)
{
  return x != x || x < y ? x : y;
}
)c"},
    {"larger", R"c(static real larger(real x, real y)
{
  return x != x || x > y ? x : y;
}
)c"},
    {"product_or_zero", R"c(/* x y, but 0 where x is negligible, whatever y is */
static real product_or_zero(real x, real y)
{
  const real negligible = sizeof(real) < sizeof(double) ? (real)1e-18 : (real)1e-100;
  return x < negligible && x > -negligible ? 0 : x * y;
}
)c"},
    {"square", R"c(static real square(real x)
{
  return x * x;
}
)c"},
    {"integer_power", R"c(static real integer_power(real x, int n)
{
  real power = 1;
  for (int rest = n < 0 ? -n : n; rest > 0; rest /= 2) {
    if (rest % 2 == 1) power *= x;
    x *= x;
  }
  return n < 0 ? 1 / power : power;
}
)c"},
};

// what[0], what[1], …
void add_entries(std::vector<std::string>& entries, const std::string& what, Index n) {
  for (Index i = 0; i < n; ++i) entries.push_back(fmt::format("{}[{}]", what, i));
}

}  // namespace

// @param loads  what stands behind the state
std::string Writer::program(const Tape& tape, const std::vector<std::string>& results, bool with_parameters,
                            const std::vector<std::string>& loads) const {
  std::string text;
  std::vector<std::string> inputs(inputs_.begin(), inputs_.begin() + layout_.size());
  inputs.insert(inputs.end(), loads.begin(), loads.end());
  const int n_varying = static_cast<int>(inputs.size());
  if (with_parameters) inputs.insert(inputs.end(), inputs_.begin() + layout_.size(), inputs_.end());
  bool reads_state = false, reads_parameters = false;
  for (int i = 0; i < static_cast<int>(inputs.size()); ++i) {
    if (!tape.uses_input(i)) continue;
    (i < n_varying ? reads_state : reads_parameters) = true;
    text += fmt::format("  const real {} = {}[{}];\n", inputs[static_cast<std::size_t>(i)],
                        i < n_varying ? "state" : "parameters", i < n_varying ? i : i - n_varying);
  }
  if (!reads_state) text += "  (void)state;\n";
  if (with_parameters && !reads_parameters) text += "  (void)parameters;\n";
  return text + tape.as_c(inputs, results, options_.single_precision);
}

void Writer::write_system() {
  const Index nq = system().nq(), nc = system().nc();
  std::vector<std::string> results;
  add_entries(results, "w->M", nq * nq);
  add_entries(results, "w->A", nc * nq);
  add_entries(results, "w->b", nc);
  add_entries(results, "w->F", nq);
  const std::string head = "const real *parameters, const real *state, workspace *w";
  function("evaluate_system", head, program(*values_->tape(), results, true));
  if (!has("jacobian")) return;
  // the derivatives by what they are of, each with its entries
  const char* const names[] = {"d_M", "d_A", "d_b", "d_F"};
  const bool load = has("load");
  const bool is_read[] = {true, has("moved") || load || has("admissible"), (has("moved") && has("all")) || load,
                          has("known") || load};
  std::vector<std::string> entries[4];
  for (const StateEvaluator::Derivative& one : derivatives_->derivatives()) {
    std::vector<std::string>& of = entries[static_cast<std::size_t>(one.quantity)];
    results.push_back(fmt::format("w->{}[{}]", names[static_cast<std::size_t>(one.quantity)], of.size()));
    of.push_back(fmt::format("{{{}, {}, {}}}", one.row, one.column, one.state_index));
  }
  for (std::size_t quantity = 0; quantity < 4; ++quantity) {
    const std::string name = names[quantity];
    const std::size_t n = entries[quantity].size();
    if (n == 0) continue;
    add_workspace(fmt::format("{}_real {}[{}];", options_.name, name, n));
    if (!is_read[quantity]) continue;
    filling_.conditions.insert(name);
    text("n_" + name) = std::to_string(n);
    text("expressions") +=
        fmt::format("\nstatic const short of_{}[{}][3] = {{ /* row, column, entry of the state */\n  {}\n}};\n", name, n,
                    fmt::join(entries[quantity], ", "));
  }
  // where nothing depends on the state it is evaluate_system
  text("system_and_derivatives") =
      function("evaluate_system_and_derivatives", head, program(*derivatives_->tape(), results, true));
}

// Features or directions of a latent and, where asked, their derivatives; their names go to the texts of the latent.
void Writer::write_state_function(Term& term, const std::string& kind, StateFunction::Evaluator& of, bool is_differentiated) {
  const bool is_matrix = &of == term.directions.get();
  const std::string name = fmt::format("{}_{}", kind, &term - terms_.data());
  const std::string arguments = std::string(is_matrix ? "const real *parameters, " : "") + "const real *state, real *out";
  const StateFunction::Evaluator::Tapes tapes = of.tapes();
  const bool reads_multipliers = is_matrix && term.reads_multipliers;
  const std::vector<std::string> loads = reads_multipliers   ? multipliers_
                                         : tapes.n_loads > 0 ? known_multipliers_
                                                             : std::vector<std::string>();
  const auto write = [&](const std::string& wanted, const Tape& tape, Index n) {
    std::vector<std::string> results;
    add_entries(results, "out", n);
    return function(wanted, arguments, program(tape, results, is_matrix, loads));
  };
  std::map<std::string, std::string>& texts = term.filling.texts;
  texts[kind] = write(name, *tapes.values, is_matrix ? system().nq() * term.p : term.D);
  const Index n_entries = std::ssize(*tapes.entries);
  if (!is_differentiated || n_entries == 0) return;
  texts["d_" + kind] = write("d_" + name, *tapes.derivatives, n_entries);
  const Index nq = system().nq();
  std::vector<std::string> entries;
  for (const StateDerivatives::Entry& entry : *tapes.entries) {
    entries.push_back(is_matrix ? fmt::format("{{{}, {}, {}}}", entry.output % nq, entry.output / nq, entry.state_index)
                                : fmt::format("{{{}, {}}}", entry.output, entry.state_index));
  }
  const int n_indices = is_matrix ? 3 : 2;
  const auto [known, is_new] = known_.try_emplace(fmt::format("short *[{}]{}", n_indices, fmt::join(entries, ",")), "of_" + name);
  if (is_new) {
    text("expressions") += fmt::format("static const short of_{}[{}][{}] = {{ /* {}, entry of the state */\n  {}\n}};\n", name,
                                       n_entries, n_indices, is_matrix ? "row, column" : "feature", fmt::join(entries, ", "));
  }
  texts["of_" + kind] = known->second;
  texts["n_d_" + kind] = std::to_string(n_entries);
}

void Writer::write_expressions() {
  write_system();
  for (Term& term : terms_) {
    write_state_function(term, "features", *term.features, has("jacobian") && term.reads_features());
    if (term.is_admissible()) text("admissible") = table("admissible", term.admissible.data(), term.p);
    if (term.has_directions()) {
      write_state_function(term, "directions", *term.directions, has("jacobian") || term.reads_multipliers);
    }
  }
  text("helpers") = called_pieces(helpers, text("expressions"));
}

}  // namespace gp2::c_export
