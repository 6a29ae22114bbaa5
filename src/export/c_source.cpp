#include "gp2/export/c_source.hpp"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <limits>
#include <map>
#include <optional>
#include <set>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "export/c_template.hpp"
#include "export/fill_template.hpp"
#include "export/portable_math.hpp"
#include "gp2/base/file.hpp"
#include "gp2/base/version.hpp"
#include "gp2/error.hpp"
#include "gp2/mechanics/state_evaluator.hpp"
#include "gp2/predictor.hpp"
#include "inference/posterior_implementation.hpp"
#include "inference/requirements.hpp"
#include "prior/gradient_columns.hpp"
#include "prior/primitive.hpp"

namespace gp2 {

namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Component = std::shared_ptr<const Posterior::Implementation>;
using Texts = std::map<std::string, std::string>;

constexpr Index lanes = 8;
constexpr int n_tests = 4;

Index whole(Index n) { return (n + lanes - 1) / lanes * lanes; }

// ---------------------------------------------------------------- text

// whether a name can stand in C: no keyword, and what the functions call their own
const std::set<std::string>& taken_names() {
  static const std::set<std::string> names = {
      "auto",   "break",  "case",   "char",   "const",  "continue",   "default", "do",        "double",   "else",     "enum",
      "extern", "float",  "for",    "goto",   "if",     "inline",     "int",     "long",      "register", "restrict", "return",
      "short",  "signed", "sizeof", "static", "struct", "switch",     "typedef", "union",     "unsigned", "void",     "volatile",
      "while",  "state",  "w",      "real",   "out",    "parameters", "status",  "workspace", "NAN",      "INFINITY", "HUGE_VAL"};
  return names;
}

bool is_identifier(const std::string& text) {
  const auto is_letter = [](char c) { return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '_'; };
  return !text.empty() && is_letter(text.front()) && !taken_names().contains(text) &&
         std::all_of(text.begin(), text.end(), [&](char c) { return is_letter(c) || (c >= '0' && c <= '9'); });
}

std::string in_comment(std::string text) {
  for (std::size_t at = text.find("*/"); at != std::string::npos; at = text.find("*/", at)) text.replace(at, 2, "* /");
  return text;
}

// sqrt(x) -> sqrtf(x)
void use_float_functions(std::string& source) {
  for (const char* const function : {"sqrt(", "fabs(", "sin(", "exp(", "log("}) {
    for (std::size_t at = source.find(function); at != std::string::npos; at = source.find(function, at + 1)) {
      const bool is_whole_word = source.find_last_of(" -!(", at) + 1 == at;
      if (is_whole_word) source.insert(at + std::string_view(function).size() - 1, 1, 'f');
    }
  }
}

// sin(x) -> portable_sin(x), but not in comments, and these functions for @portable@; sinf rounds what portable_sin finds
void use_portable_functions(std::string& source, const std::string& name) {
  const auto is_of_name = [](char c) { return std::isalnum(static_cast<unsigned char>(c)) != 0 || c == '_'; };
  const std::string_view prefix = "portable_";
  std::set<std::string> of_floats;
  std::string users;
  for (std::size_t at = 0; at < source.size();) {
    const bool is_comment = source.compare(at, 2, "/*") == 0;
    std::size_t end = is_comment ? source.find("*/", at) + 2 : at + 1;
    while (!is_comment && is_of_name(source[at]) && end < source.size() && is_of_name(source[end])) ++end;
    if (!is_comment && source[end] == '(') {
      const std::string word = source.substr(at, end - at);
      for (const c_export::Piece& piece : c_export::portable_pieces) {
        if (!piece.name.starts_with(prefix)) continue;
        const std::string_view function = piece.name.substr(prefix.size());
        const bool is_of_floats = word == fmt::format("{}f", function);
        if (word != function && !is_of_floats) continue;
        source.insert(at, prefix);
        end += prefix.size();
        users += std::string(piece.name) + "(";
        if (is_of_floats) of_floats.emplace(function);
      }
    }
    at = end;
  }
  std::string pieces;
  for (auto piece = std::rbegin(c_export::portable_pieces); piece != std::rend(c_export::portable_pieces); ++piece) {
    if (users.find(std::string(piece->name) + "(") == std::string::npos) continue;
    pieces = fmt::format("\n{}{}", piece->text, pieces);
    users += piece->text;
  }
  for (const std::string& function : of_floats) {
    const bool is_binary = function == "atan2" || function == "pow";
    pieces += fmt::format("\nstatic float portable_{0}f(float x{1})\n{{\n  return (float)portable_{0}(x{2});\n}}\n", function,
                          is_binary ? ", float y" : "", is_binary ? ", y" : "");
  }
  std::string head(c_export::portable_head);
  head.replace(head.find("@name@"), 6, name);
  source.replace(source.find("@portable@"), 10, head + pieces);
}

// ---------------------------------------------------------------- one latent

// What stands in the C for latent a of a view; the code is the same in every component of a mixture.
struct Term {
  std::size_t latent = 0;      // of the prior
  const Latent* of = nullptr;  // there
  Kernel kernel;
  Index D = 0, p = 0, F = 0;  // features, directions, functions
  Index first = 0;            // of its functions among all
  Index n_points = 0;         // the most of all components
  std::unique_ptr<StateFunction::Evaluator> features, directions;
  VectorXd admissible;             // s, of directions that the constraint changes; else empty
  bool reads_multipliers = false;  // λ, in directions

  [[nodiscard]] bool has_directions() const { return of->directions != nullptr; }
  [[nodiscard]] bool is_admissible() const { return admissible.size() > 0; }
  [[nodiscard]] bool features_read_load() const { return features->tapes().n_loads > 0; }
  [[nodiscard]] bool directions_read_load() const { return has_directions() && directions->tapes().n_loads > 0; }  // λ₀
  [[nodiscard]] bool reads_features() const {
    return std::any_of(kernel.terms().begin(), kernel.terms().end(), [](const Kernel::Term& term) {
      return std::any_of(term.factors.begin(), term.factors.end(),
                         [](const Kernel::Factor& factor) { return factor.primitive != Kernel::Primitive::constant; });
    });
  }
  [[nodiscard]] bool is_forced() const { return of->base == Latent::Base::force; }
  [[nodiscard]] bool is_se() const {
    return kernel.terms().size() == 1 && kernel.terms()[0].factors.size() == 1 &&
           kernel.terms()[0].factors[0].primitive == Kernel::Primitive::se;
  }
};

class Writer {
 public:
  Writer(const Posterior& posterior, std::vector<Component> components, View view, const CSourceOptions& options);
  [[nodiscard]] CSource write();

 private:
  void set_conditions();
  void set_sizes();
  void declare_workspace();
  void add_workspace(const std::string& text) { texts_["workspace"] += "  " + text + "\n"; }
  [[nodiscard]] std::string number(double value) const;
  [[nodiscard]] std::string numbers(const double* values, Index n, Index stride = 1) const;
  std::string table(const std::string& type, const std::string& wanted, const std::vector<std::string>& entries);
  std::string table(const std::string& wanted, const double* values, Index n);
  std::string function(const std::string& wanted, const std::string& head, const std::string& body);
  void write_tables();
  [[nodiscard]] std::string inverse_of(const LatentPosterior& latents, std::size_t k);
  void write_expressions();
  [[nodiscard]] std::string program(const Tape& tape, const std::vector<std::string>& results, bool with_parameters,
                                    const std::vector<std::string>& loads = {}) const;
  void write_kernels();
  void write_potential(std::size_t a);
  [[nodiscard]] std::string factor_call(const std::string& verb, const Kernel::Factor& factor, Index D,
                                        const std::string& value) const;
  void write_signals();
  void write_under_load();
  void write_view();
  void write_stddev();
  void write_jacobian();
  void write_tests();
  [[nodiscard]] std::pair<double, double> rounding_at(const VectorXd& state, double prior_stddev) const;
  void require_single_precision() const;

  [[nodiscard]] const System& system() const { return *prior_.system; }
  [[nodiscard]] bool has(const std::string& condition) const { return conditions_.contains(condition); }
  [[nodiscard]] std::string row(const std::string& r) const { return all_rows_ ? r : fmt::format("view_rows[{}]", r); }

  const Posterior& posterior_;
  std::vector<Component> components_;
  View view_;
  CSourceOptions options_;
  Prior prior_;  // where the view looks
  StateLayout layout_;
  std::vector<std::string> inputs_;                           // what C calls the entries of a state, then the parameters
  std::vector<std::string> known_multipliers_, multipliers_;  // and λ₀, λ
  std::vector<Term> terms_;
  std::unique_ptr<StateEvaluator> values_, derivatives_;
  bool all_rows_ = true;
  Index n_functions_ = 0, n_variables_ = 0, n_cross_rows_ = 0;
  std::set<std::string> conditions_;
  Texts texts_;
  std::map<std::string, std::string> known_;  // text of a table or a function -> its name
};

Writer::Writer(const Posterior& posterior, std::vector<Component> components, View view, const CSourceOptions& options)
    : posterior_(posterior),
      components_(std::move(components)),
      view_(std::move(view)),
      options_(options),
      prior_(prior_of(posterior.prior(), view_)),
      layout_(prior_.system->layout()) {
  const VectorXd parameters = parameters_of(view_, components_.front()->values.parameters);
  values_ = system().make_evaluator(parameters, false);
  if (options_.jacobian) derivatives_ = system().make_evaluator(parameters, true);
  const auto require_expressions = [](const Tape* tape, const std::string& what) {
    if (tape != nullptr) return;
    throw InputError(fmt::format("export to C: {} are code, which has no text; write them as expressions of a model file", what));
  };
  require_expressions(values_->tape(), "M, A, b or F of the system");
  if (options_.jacobian && derivatives_->tape() == nullptr) {
    throw InputError("export to C: the derivatives of the system are too large to be written; leave the Jacobian out");
  }
  for (std::size_t a = 0; a < prior_.latents.size(); ++a) {
    if (!view_.has_latent(a)) continue;
    const Latent& of = prior_.latents[a];
    Term& term = terms_.emplace_back();
    term.latent = a;
    term.of = &of;
    term.kernel = of.kernel;
    term.D = of.n_features();
    term.p = of.size();
    term.F = of.n_functions();
    term.first = n_functions_;
    n_functions_ += term.F;
    term.features = of.features->make_evaluator(VectorXd());
    require_expressions(term.features->tapes().values, fmt::format("features of latent '{}'", of.name));
    if (!term.has_directions()) continue;
    const StateFunction* const of_multipliers = of.directions->of_multipliers();
    term.reads_multipliers = of_multipliers != nullptr;
    term.directions = (of_multipliers != nullptr ? *of_multipliers : *of.directions).make_evaluator(parameters);
    require_expressions(term.directions->tapes().values, fmt::format("directions of latent '{}'", of.name));
    if (of.base != Latent::Base::admissible || system().nc() == 0) continue;
    VectorXd B(term.p * term.p);
    term.directions->evaluate(VectorXd::Zero(layout_.size()), B);
    term.admissible = B.reshaped(term.p, term.p).diagonal();
  }
  std::set<std::string> taken = taken_names();
  const auto add_name = [&](std::string name, std::vector<std::string>& names) {
    for (char& c : name) {
      if (!std::isalnum(static_cast<unsigned char>(c))) c = '_';
    }
    while (taken.contains(name)) name += '_';
    taken.insert(name);
    names.push_back(std::move(name));
  };
  for (const std::string& name : system().state_names()) add_name(name, inputs_);
  for (const Parameter& parameter : system().parameters()) add_name(parameter.name, inputs_);
  for (int k = 1; k <= system().nc(); ++k) add_name(fmt::format("lambda0_{}", k), known_multipliers_);
  for (int k = 1; k <= system().nc(); ++k) add_name(fmt::format("lambda_{}", k), multipliers_);
  for (std::size_t r = 0; r < view_.rows.size(); ++r) all_rows_ = all_rows_ && view_.rows[r] == static_cast<int>(r);
  set_conditions();
  set_sizes();
  declare_workspace();
}

void Writer::set_conditions() {
  const MotionParts parts = view_.quantity->parts();
  const auto set = [&](const std::string& name, bool holds) {
    if (holds) conditions_.insert(name);
  };
  const bool has_forced_latent = std::any_of(terms_.begin(), terms_.end(), [](const Term& term) { return term.is_forced(); });
  set("portable", options_.portable_math);
  set("rows", system().nc() > 0);
  set("admissible", std::any_of(terms_.begin(), terms_.end(), [](const Term& term) { return term.is_admissible(); }));
  set("several", system().nc() > 1);
  set("all", view_.has_mean());
  set("known", view_.has_mean() && prior_.mean == Prior::Mean::force);
  set("constant", view_.has_mean() && prior_.mean == Prior::Mean::constant);
  set("forced_latent", has_forced_latent);
  set("forced", has_forced_latent || has("known"));
  set("nonlinear", std::any_of(terms_.begin(), terms_.end(), [](const Term& term) { return term.reads_multipliers; }));
  set("moved", parts.constrained_acceleration || parts.constraint_force || has("nonlinear"));
  set("reaction", parts.constraint_force);
  set("abar", parts.unconstrained_acceleration);
  set("applied", parts.applied_force);
  set("multipliers", view_.quantity == View::Quantity::multipliers);
  set("potential", std::any_of(terms_.begin(), terms_.end(), [](const Term& term) { return term.of->is_potential; }));
  set("other", std::any_of(terms_.begin(), terms_.end(), [](const Term& term) { return !term.of->is_potential; }));
  set("load", std::any_of(terms_.begin(), terms_.end(),
                          [](const Term& term) { return term.features_read_load() || term.directions_read_load(); }));
  set("loaded", has("load") || has("nonlinear"));
  set("least_norm", has("multipliers") || has("loaded"));
  set("stddev", options_.stddev);
  set("jacobian", options_.jacobian);
  set("mixture", components_.size() > 1);
  set("sums", options_.stddev && components_.front()->latents->sums() != nullptr);
  set("by_function", n_functions_ < view_.size());
  set("forced_solves", has("forced") || has("loaded") || (options_.jacobian && has("moved")));
  set("solves", has("rows") || has("forced_solves"));
}

void Writer::set_sizes() {
  const Index nq = system().nq(), nc = system().nc(), nx = layout_.size(), nr = view_.size();
  const Index n_columns = std::min<Index>(nr, n_functions_);
  for (const Component& component : components_) {
    const LatentPosterior& latents = *component->latents;
    n_variables_ = std::max(n_variables_, whole(latents.size()));
    n_cross_rows_ = std::max(n_cross_rows_, latents.n_rows());
    for (Term& term : terms_) term.n_points = std::max(term.n_points, latents.latents()[term.latent].kernel.n_rows());
  }
  if (!has("sums")) n_cross_rows_ = n_variables_;
  const bool single = options_.single_precision;
  texts_ = {
      {"name", options_.name},
      {"real", single ? "float" : "double"},
      {"nq", std::to_string(nq)},
      {"nc", std::to_string(nc)},
      {"nmin", std::to_string(std::min(nq, nc))},
      {"n_state", std::to_string(nx)},
      {"n_rows", std::to_string(nr)},
      {"n_components", std::to_string(components_.size())},
      {"n_variables", std::to_string(n_variables_)},
      {"n_columns", std::to_string(n_columns)},
      {"n_latents", std::to_string(terms_.size())},
      {"n_tests", std::to_string(n_tests)},
      {"index", n_cross_rows_ < 32767 ? "short" : "int"},
      {"cross", has("sums") ? "rows" : "cross"},
      {"cross_rows", std::to_string(n_cross_rows_)},
      {"lost_pivot", single ? "1e-6f" : "1e-14"},
      {"semidefinite", single ? "5e-6f" : "1e-13"},
      {"singular", single ? "1e-4f" : number(UdwadiaKalaba::mass_tolerance)},
      {"rank_tolerance", single ? "1e-5f" : number(UdwadiaKalaba::rank_tolerance)},
      {"consistency", single ? "1e-3f" : number(UdwadiaKalaba::consistency_tolerance)},
      {"well_conditioned", single ? "1e-2f" : "1e-4"},
      {"small_norm", single ? "1e-15f" : "1e-140"},
      {"large_norm", single ? "1e15f" : "1e140"},
      {"newton", single ? "4e-6f" : "1.5e-14"},
      {"smallest_row", single ? "1.17549435e-38f" : "2.2250738585072014e-308"},
      {"if_singular", what_needs_acceleration(prior_, view_) ? "NO_UNCONSTRAINED_ACCELERATION" : "OK"},
  };
  std::string guard = options_.name + "_H";
  std::transform(guard.begin(), guard.end(), guard.begin(), [](unsigned char c) { return std::toupper(c); });
  texts_["guard"] = guard;
}

// What each function of the C reads and writes
void Writer::declare_workspace() {
  const Index nq = system().nq(), nc = system().nc(), nx = layout_.size(), nr = view_.size();
  const Index n_columns = std::min<Index>(nr, n_functions_);
  const std::string real = options_.name + "_real ";
  const auto add = [&](const std::string& names) { add_workspace(real + names + ";"); };
  const auto size = [](auto... factors) { return std::to_string((Index{factors} * ...)); };
  add(fmt::format("M[{0}], mass[{0}], C[{0}], F[{1}], T[{0}], pivot", size(nq, nq), size(nq)));
  add_workspace("int is_singular;");
  if (has("rows")) {
    add(fmt::format("A[{0}], b[{1}], sigma[{1}], weight[{2}]", size(nc, nq), size(nc), size(nq)));
    add(fmt::format("B[{0}], A_unit[{0}], b_unit[{1}], row_scale[{1}], residual[{1}], L[{0}], Lb[{2}]", size(nc, nq), size(nc),
                    size(nq)));
    add(fmt::format("tau[{}]", size(std::min(nq, nc))));
    add_workspace(fmt::format("int rank, n_zero_rows, order[{}];", nc));
  }
  if (has("several")) {
    add(fmt::format("R[{}], tau2[{}]", size(nc, std::min(nq, nc)), size(std::min(nq, nc))));
    add_workspace(fmt::format("int order2[{}];", std::min(nq, nc)));
  }
  add(fmt::format("a_bar[{0}], force[{0}], a_of_force[{0}]", nq));
  if (has("load")) add(fmt::format("x[{}], a0[{}]", nx + nc, nq));
  if (has("nonlinear")) {
    add(fmt::format("y[{}], G_lambda[{}], d_lambda[{}], D_lambda[{}]", nx + nc, nc * nq, nc, nc * nc));
    add(fmt::format("without_load[{0}], rest_of_load[{0}], force_of_load[{0}], a_under_load[{0}], a_at_zero[{0}]", nq));
    add(fmt::format("slope[{0}], rest_slope[{0}], force_slope[{0}]", nq * nc));
    add_workspace(fmt::format("int order_lambda[{}];", nc));
  }
  if (has("moved")) add(fmt::format("a[{0}], gap[{0}], of_constraint[{0}]", nq));
  if (has("applied")) add(fmt::format("applied[{}]", nq));
  Index widest = 0, most_points = 1, most_derivatives = 1;
  for (std::size_t a = 0; a < terms_.size(); ++a) {
    const Term& term = terms_[a];
    add(fmt::format("phi_{0}[{1}], signal_{0}[{2}]", a, term.D, term.p));
    if (term.of->is_potential) {
      add(fmt::format("pairs_{}[{}]", a, std::ssize(term.kernel.terms()) * (3 + term.D) * term.n_points));
      if (has("stddev")) add(fmt::format("gradient_{}[{}]", a, term.D * term.n_points));
    } else {
      add(fmt::format("k_{}[{}]", a, term.n_points));
    }
    if (term.has_directions()) add(fmt::format("B_{}[{}]", a, nq * term.p));
    if (term.is_admissible()) add(fmt::format("stated_M[{0}], P[{0}], L_P[{1}]", nq * nq, nc * nq));
    widest = std::max(widest, term.D * term.p);
    most_points = std::max(most_points, term.n_points);
    most_derivatives = std::max(most_derivatives, std::ssize(*term.features->tapes().entries));
    if (term.has_directions()) most_derivatives = std::max(most_derivatives, std::ssize(*term.directions->tapes().entries));
  }
  add(fmt::format("scratch[{}]", 2 * most_points));
  if (has("multipliers")) add(fmt::format("lambda[{}]", nc));
  if (has("least_norm")) {
    add(fmt::format("K[{}]", nc * nq));
    if (has("several")) {
      add(fmt::format("null_space[{0}], null_rows[{0}], null_tau[{1}]", nc * nc, nc));
      add_workspace(fmt::format("int null_order[{}];", nc));
    }
  }
  if (has("stddev")) {
    add(fmt::format("Gt[{0}], M_inverse_Gt[{0}], loading[{1}], cross[{2}]", nq * nr, n_functions_ * nr,
                    n_variables_ * n_columns));
    if (!has("by_function") || has("potential")) add(fmt::format("products[{}]", terms_.empty() ? 1 : terms_[0].n_points));
    if (has("sums")) add(fmt::format("rows[{}]", n_cross_rows_ * n_columns));
    if (has("mixture")) add(fmt::format("means[{0}], stddevs[{0}]", std::ssize(components_) * nr));
  }
  if (has("jacobian") || has("nonlinear")) add(fmt::format("derivative[{}]", most_derivatives));
  if (has("jacobian")) {
    const Index n = nq * nx;
    add(fmt::format("dsignal[{}]", widest));
    add(fmt::format("d_of_rest[{0}], d_force[{0}]", n));
    if (has("abar")) add(fmt::format("d_a_bar[{}]", n));
    if (has("applied")) add(fmt::format("d_applied[{}]", n));
    if (has("moved")) add(fmt::format("d_a[{0}], d_of_constraint[{0}]", n));
    if (has("moved") && has("rows")) add(fmt::format("d_forced[{}], d_rows[{}]", n, nc * nx));
    if (has("reaction")) add(fmt::format("d_mass_a_bar[{}]", n));
    if (has("least_norm")) add(fmt::format("d_along[{}]", nc * nx));
    if (has("load")) add(fmt::format("d_forced0[{0}], d_rows0[{1}], d_lambda0[{1}]", n, nc * nx));
  }
  if (has("mixture")) add(has("jacobian") ? fmt::format("mean[{}], jacobian[{}]", nr, nr * nx) : fmt::format("mean[{}]", nr));
}

// ---------------------------------------------------------------- numbers and tables

std::string Writer::number(double value) const {
  std::string text = options_.single_precision ? fmt::format("{}", static_cast<float>(value)) : shortest(value);
  if (text.find_first_of(".e") == std::string::npos) text += ".0";
  return options_.single_precision ? text + "f" : text;
}

std::string Writer::numbers(const double* values, Index n, Index stride) const {
  std::string text;
  for (Index i = 0; i < n; ++i) text += (i == 0 ? "" : ", ") + number(values[i * stride]);
  return text;
}

// The name of a constant table, which stands in the file once however often it is asked for.
std::string Writer::table(const std::string& type, const std::string& wanted, const std::vector<std::string>& entries) {
  constexpr std::size_t width = 120;
  std::string body;
  std::size_t line = 0;  // where the last one begins
  for (const std::string& entry : entries) {
    if (body.empty() || body.size() + entry.size() - line > width) {
      if (!body.empty()) body += '\n';
      line = body.size();
      body += ' ';
    }
    body += fmt::format(" {},", entry);
  }
  body += '\n';
  const auto [known, is_new] = known_.try_emplace(type + body, wanted);
  if (is_new) texts_["tables"] += fmt::format("static const {} {}[{}] = {{\n{}}};\n\n", type, wanted, entries.size(), body);
  return known->second;
}

std::string Writer::table(const std::string& wanted, const double* values, Index n) {
  std::vector<std::string> entries;
  for (Index i = 0; i < n; ++i) entries.push_back(number(values[i]));
  return table("real", wanted, entries);
}

// X of a component by rows, each in whole lanes
std::string Writer::inverse_of(const LatentPosterior& latents, std::size_t k) {
  const Index n = latents.size();
  constexpr Index block = 64;
  std::vector<std::vector<std::string>> rows(static_cast<std::size_t>(n));
  for (Index j = 0; j < n; j += block) {
    const Index m = std::min(block, n - j);
    const MatrixXd columns = latents.whitening_columns(j, m);
    for (Index i = j; i < n; ++i) {
      for (Index l = 0; l < std::min(m, i - j + 1); ++l) rows[static_cast<std::size_t>(i)].push_back(number(columns(i - j, l)));
    }
  }
  std::vector<std::string> entries;
  for (std::vector<std::string>& row : rows) {
    row.resize(static_cast<std::size_t>(whole(std::ssize(row))), "0");
    std::move(row.begin(), row.end(), std::back_inserter(entries));
  }
  return table("real", fmt::format("inverse_{}", k), entries);
}

// what each factor of a kernel multiplies the features by
VectorXd scales_of(const KernelColumns& columns) {
  const Kernel& kernel = columns.kernel();
  VectorXd scales(kernel.n_scaled_columns());
  for (const Kernel::Term& product : kernel.terms()) {
    for (const Kernel::Factor& factor : product.factors) {
      if (factor.primitive == Kernel::Primitive::constant) continue;
      for (Index d = 0; d < kernel.n_features(); ++d) {
        const double* const values = columns.values().data() + factor.first_parameter;
        scales[factor.first_column + d] = feature_scale(factor.primitive, values, kernel.n_features(), d);
      }
    }
  }
  return scales;
}

void Writer::write_tables() {
  texts_["tables"];
  if (!all_rows_) {
    std::vector<std::string> rows;
    for (const int r : view_.rows) rows.push_back(std::to_string(r));
    table("unsigned char", "view_rows", rows);
  }
  std::string list;
  for (std::size_t k = 0; k < components_.size(); ++k) {
    const Posterior::Implementation& component = *components_[k];
    const LatentPosterior& latents = *component.latents;
    const VectorXd parameters = parameters_of(view_, component.values.parameters);
    list +=
        fmt::format("  {{{}, {{\n",
                    parameters.size() == 0 ? "0" : table(fmt::format("parameters_{}", k), parameters.data(), parameters.size()));
    for (std::size_t a = 0; a < terms_.size(); ++a) {
      const Term& term = terms_[a];
      const LatentPosterior::Basis& basis = latents.latents()[term.latent];
      const MatrixXd C = component.C[term.latent], weights = basis.beta * C.transpose(), points = basis.kernel.features();
      const VectorXd values = basis.kernel.values(), scales = scales_of(basis.kernel);
      const auto name = [&](const char* what) { return fmt::format("{}_{}_{}", what, k, a); };
      const auto of = [&](const char* what, const auto& matrix) {
        return matrix.size() == 0 ? std::string("0") : table(name(what), matrix.data(), matrix.size());
      };
      list += fmt::format("    {{{}, {}, {}, {}, {}", basis.kernel.n_rows(), of("points", points), of("scale", scales),
                          of("kernel", values), of("weights", weights));
      if (has("stddev")) list += fmt::format(", {}, {}", of("loading", C), of("rows", basis.Z));
      list += "},\n";
    }
    list += "  }";
    if (has("stddev")) {
      const Index n = terms_.empty() ? 0 : latents.latents()[terms_[0].latent].kernel.n_rows();
      std::vector<std::string> row_of;
      for (const std::vector<Index>& rows : latents.row_of()) {
        for (Index j = 0; j < n; ++j)
          row_of.push_back(std::to_string(j < std::ssize(rows) ? rows[static_cast<std::size_t>(j)] : -1));
      }
      list += fmt::format(", {}, {}, {}, {}", latents.size(), latents.row_of().size(),
                          table(texts_["index"], fmt::format("row_of_{}", k), row_of), inverse_of(latents, k));
    }
    if (has("sums")) {
      const auto& D = latents.sums()->D;
      std::vector<std::string> begin{"0"}, columns;
      std::vector<std::string> values;
      for (Index i = 0; i < D.rows(); ++i) {
        for (Eigen::SparseMatrix<double, Eigen::RowMajor>::InnerIterator entry(D, i); entry; ++entry) {
          columns.push_back(std::to_string(entry.col()));
          values.push_back(number(entry.value()));
        }
        begin.push_back(std::to_string(columns.size()));
      }
      list += fmt::format(", {}, {}, {}", table("int", fmt::format("sum_begin_{}", k), begin),
                          table("int", fmt::format("sum_column_{}", k), columns),
                          table("real", fmt::format("sum_value_{}", k), values));
    }
    list += "},\n";
  }
  texts_["tables"] += fmt::format("static const component components[{}] = {{\n{}}};\n", components_.size(), list);
}

// ---------------------------------------------------------------- expressions

// The name of a static function; where there is one of the same body it is that one.
std::string Writer::function(const std::string& wanted, const std::string& head, const std::string& body) {
  const auto [known, is_new] = known_.try_emplace(head + body, wanted);
  if (is_new) texts_["expressions"] += fmt::format("\nstatic void {}({})\n{{\n{}}}\n", wanted, head, body);
  return known->second;
}

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

void Writer::write_expressions() {
  const Index nq = system().nq(), nc = system().nc();
  std::vector<std::string> results;
  const auto add = [&](const char* what, Index n) {
    for (Index i = 0; i < n; ++i) results.push_back(fmt::format("w->{}[{}]", what, i));
  };
  add("M", nq * nq);
  add("A", nc * nq);
  add("b", nc);
  add("F", nq);
  const std::string head = "const real *parameters, const real *state, workspace *w";
  function("evaluate_system", head, program(*values_->tape(), results, true));
  if (has("jacobian")) {
    // the derivatives by what they are of, each with its entries
    const char* const names[] = {"d_M", "d_A", "d_b", "d_F"};
    std::vector<std::string> entries[4];
    for (const StateEvaluator::Derivative& one : derivatives_->derivatives()) {
      std::vector<std::string>& of = entries[static_cast<std::size_t>(one.quantity)];
      results.push_back(fmt::format("w->{}[{}]", names[static_cast<std::size_t>(one.quantity)], of.size()));
      of.push_back(fmt::format("{{{}, {}, {}}}", one.row, one.column, one.state_index));
    }
    const bool load = has("load");
    const bool is_read[] = {true, has("moved") || load || has("admissible"), (has("moved") && has("all")) || load,
                            has("known") || load};
    for (std::size_t quantity = 0; quantity < 4; ++quantity) {
      if (entries[quantity].empty()) continue;
      add_workspace(fmt::format("{}_real {}[{}];", options_.name, names[quantity], entries[quantity].size()));
      if (!is_read[quantity]) continue;
      const std::size_t n = entries[quantity].size();
      conditions_.insert(names[quantity]);
      texts_[std::string("n_") + names[quantity]] = std::to_string(n);
      std::string table = fmt::format("static const short of_{}[{}][3] = {{ /* row, column, entry of the state */\n  {}\n}};\n",
                                      names[quantity], n, fmt::join(entries[quantity], ", "));
      texts_["expressions"] += "\n" + table;
    }
    // where nothing depends on the state it is evaluate_system
    texts_["system_and_derivatives"] =
        function("evaluate_system_and_derivatives", head, program(*derivatives_->tape(), results, true));
  }
  const auto vector = [](const char* what, Index n) {
    std::vector<std::string> entries;
    for (Index i = 0; i < n; ++i) entries.push_back(fmt::format("{}[{}]", what, i));
    return entries;
  };
  const auto write = [&](const std::string& name, StateFunction::Evaluator& of, Index n, bool with_parameters,
                         bool is_differentiated, bool reads_multipliers) {
    const std::string arguments = std::string(with_parameters ? "const real *parameters, " : "") + "const real *state, real *out";
    const StateFunction::Evaluator::Tapes tapes = of.tapes();
    const std::vector<std::string> loads = reads_multipliers   ? multipliers_
                                           : tapes.n_loads > 0 ? known_multipliers_
                                                               : std::vector<std::string>();
    texts_[name] = function(name, arguments, program(*tapes.values, vector("out", n), with_parameters, loads));
    const Index n_entries = std::ssize(*tapes.entries);
    if (!is_differentiated || n_entries == 0) return;
    texts_["d_" + name] =
        function("d_" + name, arguments, program(*tapes.derivatives, vector("out", n_entries), with_parameters, loads));
    std::vector<std::string> entries;
    for (const StateDerivatives::Entry& entry : *tapes.entries) {
      entries.push_back(with_parameters ? fmt::format("{{{}, {}, {}}}", entry.output % nq, entry.output / nq, entry.state_index)
                                        : fmt::format("{{{}, {}}}", entry.output, entry.state_index));
    }
    const std::string type = fmt::format("short *[{}]", with_parameters ? 3 : 2);
    const auto [known, is_new] = known_.try_emplace(type + fmt::format("{}", fmt::join(entries, ",")), "of_" + name);
    if (is_new) {
      texts_["expressions"] +=
          fmt::format("static const short of_{}[{}][{}] = {{ /* {}, entry of the state */\n  {}\n}};\n", name, n_entries,
                      with_parameters ? 3 : 2, with_parameters ? "row, column" : "feature", fmt::join(entries, ", "));
    }
    texts_["of_" + name] = known->second;
  };
  for (std::size_t a = 0; a < terms_.size(); ++a) {
    const Term& term = terms_[a];
    write(fmt::format("features_{}", a), *term.features, term.D, false, has("jacobian") && term.reads_features(), false);
    if (term.is_admissible()) {
      texts_["admissible"] = table("admissible", term.admissible.data(), term.p);
    } else if (term.has_directions()) {
      write(fmt::format("directions_{}", a), *term.directions, nq * term.p, true, has("jacobian") || term.reads_multipliers,
            term.reads_multipliers);
    }
  }
  // what they call
  const std::pair<const char*, const char*> helpers[] = {
      {"sign_of", "static real sign_of(real x)\n{\n  return x > 0 ? 1 : x < 0 ? -1 : x;\n}\n"},
      {"smaller", "static real smaller(real x, real y)\n{\n  return x != x || x < y ? x : y;\n}\n"},
      {"larger", "static real larger(real x, real y)\n{\n  return x != x || x > y ? x : y;\n}\n"},
      {"product_or_zero",
       "/* x y, but 0 where x is 0, whatever y is */\nstatic real product_or_zero(real x, real y)\n{\n  return x == 0 ? 0 : x * "
       "y;\n}\n"},
      {"square", "static real square(real x)\n{\n  return x * x;\n}\n"},
      {"integer_power",
       "static real integer_power(real x, int n)\n{\n  real power = 1;\n  for (int rest = n < 0 ? -n : n; rest > 0; rest /= 2) "
       "{\n"
       "    if (rest % 2 == 1) power *= x;\n    x *= x;\n  }\n  return n < 0 ? 1 / power : power;\n}\n"}};
  for (const auto& [name, text] : helpers) {
    if (texts_["expressions"].find(std::string(name) + "(") != std::string::npos) texts_["helpers"] += std::string("\n") + text;
  }
  texts_["helpers"];
}

// ---------------------------------------------------------------- kernels

std::string primitive_name(Kernel::Primitive primitive) {
  return std::string(primitive_names()[static_cast<std::size_t>(primitive)]);
}
bool has_parameters_in_c(Kernel::Primitive primitive) {
  return primitive == Kernel::Primitive::rq || primitive == Kernel::Primitive::periodic;
}

// "times_rq(n, 3, x, p, a->scale + 3, a->kernel + 3, scratch, value);"
std::string Writer::factor_call(const std::string& verb, const Kernel::Factor& factor, Index D, const std::string& value) const {
  return fmt::format("  {}_{}(n, {}, x, p, a->scale + {},{} scratch, {});\n", verb, primitive_name(factor.primitive), D,
                     factor.first_column,
                     has_parameters_in_c(factor.primitive) ? fmt::format(" a->kernel + {},", factor.first_parameter) : "", value);
}

// The gradient of a potential, kernel by kernel of its sum (theory.md, T44)
void Writer::write_potential(std::size_t a) {
  const Term& term = terms_[a];
  std::string pairs, sums, slopes, products, variance;
  for (std::size_t t = 0; t < term.kernel.terms().size(); ++t) {
    const Kernel::Term& of = term.kernel.terms()[t];
    const Kernel::Factor& factor = of.factors.front();
    const std::string square = of.amplitude < 0 ? std::string("1") : fmt::format("a->kernel[{0}] * a->kernel[{0}]", of.amplitude),
                      at = fmt::format("pairs + {} * a->n", static_cast<Index>(t) * (3 + term.D)),
                      scale = fmt::format("a->scale + {}", factor.first_column);
    const bool is_rq = factor.primitive == Kernel::Primitive::rq;
    pairs += fmt::format("  compare_points(a->n, {}, a->points, p, {}, {});\n", term.D, scale, at);
    pairs += fmt::format("  slopes_{}(a->n, {},{} {});\n", primitive_name(factor.primitive), square,
                         is_rq ? fmt::format(" a->kernel[{}],", factor.first_parameter + term.D) : "", at);
    sums += fmt::format("  add_gradients(a->n, {}, {}, {}, a->weights, scratch, out);\n", term.D, at, scale);
    slopes += fmt::format("  add_hessians(a->n, {}, {}, {}, a->weights, scratch, out);\n", term.D, at, scale);
    products += fmt::format("  multiply_pairs(a->n, {}, {}, {}, loading, scratch, out);\n", term.D, at, scale);
    variance += fmt::format("  for (int j = 0; j < {0}; ++j) out[j] += {1} * a->scale[{2} + j] * a->scale[{2} + j]{3};\n", term.D,
                            square, factor.first_column, factor.primitive == Kernel::Primitive::matern52 ? " * 5 / 3" : "");
  }
  const auto from_zero = [](const std::string& n, const std::string& body) {
    return fmt::format("  for (int j = 0; j < {}; ++j) out[j] = 0;\n{}", n, body);
  };
  const std::string to_out = "const latent *a, const real *pairs, real *scratch, real *out";
  const auto name = [&](const char* what) { return fmt::format("{}_{}", what, a); };
  const auto write = [&](const char* what, const std::string& head, const std::string& body) {
    texts_[name(what)] = function(name(what), head, body);
  };
  write("pairs", "const latent *a, const real *p, real *pairs", pairs);
  write("sums", to_out, from_zero(std::to_string(term.D), sums));
  if (has("jacobian")) write("gradient", to_out, from_zero(std::to_string(term.D * term.D), slopes));
  if (!has("stddev")) return;
  write("products", "const latent *a, const real *pairs, const real *loading, real *scratch, real *out",
        from_zero(fmt::format("{} * a->n", term.D), products));
  write("variance", "const latent *a, real *out", from_zero(std::to_string(term.D), variance));
}

void Writer::write_kernels() {
  texts_["expressions"] += "@kernel_pieces@";
  const auto amplitude = [](const Kernel::Term& term) {
    return term.amplitude < 0 ? std::string("1") : fmt::format("a->kernel[{0}] * a->kernel[{0}]", term.amplitude);
  };
  const auto start = [](const std::string& what, const std::string& value) {
    return fmt::format("  for (int i = 0; i < n; ++i) {}[i] = {};\n", what, value);
  };
  // what a body of C declares and what it does not read
  const auto body_of = [](const std::string& text, std::string_view end = "") {
    std::string head = "  const int n = a->n;\n";
    if (text.find(" x,") != std::string::npos) head += "  const real *const x = a->points;\n";
    if (text.find("value") != std::string::npos) head += "  real *const value = scratch + n;\n";
    for (const char* const argument : {"p", "k", "scratch"}) {
      if (text.find(fmt::format(" {},", argument)) == std::string::npos &&
          text.find(fmt::format("{}[", argument)) == std::string::npos &&
          head.find(fmt::format("= {} ", argument)) == std::string::npos) {
        head += fmt::format("  (void){};\n", argument);
      }
    }
    return head + text + std::string(end);
  };
  for (std::size_t a = 0; a < terms_.size(); ++a) {
    const Term& term = terms_[a];
    const Index D = term.D;
    if (term.of->is_potential) {
      write_potential(a);
      continue;
    }
    std::string k, gradient, variance = "  real sum = 0;\n";
    bool is_constant = true;
    for (std::size_t t = 0; t < term.kernel.terms().size(); ++t) {
      const Kernel::Term& product = term.kernel.terms()[t];
      const std::string value = t == 0 ? "k" : "value";
      k += start(value, amplitude(product));
      std::string at_zero = amplitude(product);
      for (std::size_t f = 0; f < product.factors.size(); ++f) {
        const Kernel::Factor& factor = product.factors[f];
        if (factor.primitive == Kernel::Primitive::constant) continue;
        k += factor_call("times", factor, D, value);
        if (factor.primitive == Kernel::Primitive::linear) {
          at_zero += fmt::format(" * squared_norm({}, p, a->scale + {})", D, factor.first_column);
          is_constant = false;
        }
        // the derivative of this factor, the others as they are; of se alone its slope is k
        const std::string slope = term.is_se() ? "k" : "value";
        if (!term.is_se()) {
          gradient += start("value", amplitude(product));
          for (std::size_t other = 0; other < product.factors.size(); ++other) {
            const Kernel::Primitive primitive = product.factors[other].primitive;
            const bool is_slope = other == f;
            if (primitive == Kernel::Primitive::constant || (is_slope && primitive == Kernel::Primitive::linear)) continue;
            const bool has_slope = is_slope && primitive != Kernel::Primitive::se && primitive != Kernel::Primitive::periodic;
            gradient += factor_call(has_slope ? "slope" : "times", product.factors[other], D, "value");
          }
        }
        const std::string common = fmt::format("n, {}, {}, x,", D, term.p),
                          scale = fmt::format("a->scale + {}", factor.first_column);
        const std::string rest = fmt::format("{}, a->weights, out);\n", slope);
        gradient += factor.primitive == Kernel::Primitive::linear ? fmt::format("  add_features({} {}, {}", common, scale, rest)
                    : factor.primitive == Kernel::Primitive::periodic
                        ? fmt::format("  add_sines({} p, {}, a->kernel + {}, {}", common, scale, factor.first_parameter, rest)
                        : fmt::format("  add_differences({} p, {}, {}", common, scale, rest);
      }
      if (t > 0) k += "  for (int i = 0; i < n; ++i) k[i] += value[i];\n";
      variance += fmt::format("  sum += {};\n", at_zero);
    }
    texts_[fmt::format("covariance_{}", a)] =
        function(fmt::format("covariance_{}", a), "const latent *a, const real *p, real *k, real *scratch", body_of(k));
    if (has("stddev")) {
      const bool reads_a = variance.find("a->") != std::string::npos;
      texts_[fmt::format("variance_{}", a)] = function(
          fmt::format("variance_{}", a), "const latent *a, const real *p, real *out",
          fmt::format("{}{}{}  *out = sum;\n", reads_a ? "" : "  (void)a;\n", is_constant ? "  (void)p;\n" : "", variance));
    }
    if (has("jacobian") && term.reads_features() && !term.features->tapes().entries->empty()) {
      texts_[fmt::format("gradient_{}", a)] =
          function(fmt::format("gradient_{}", a), "const latent *a, const real *p, const real *k, real *scratch, real *out",
                   body_of(fmt::format("  for (int j = 0; j < {}; ++j) out[j] = 0;\n{}", D * term.p, gradient)));
    }
  }
  // the pieces that are used, each after those that it uses
  std::string& text = texts_["expressions"];
  std::string pieces;
  std::string users = text + " weighted_sum(";
  for (auto piece = std::rbegin(c_export::kernel_pieces); piece != std::rend(c_export::kernel_pieces); ++piece) {
    if (users.find(std::string(piece->name) + "(") == std::string::npos) continue;
    const bool is_float_exponential = piece->name == "exponentials" && options_.single_precision;
    std::string body = is_float_exponential
                           ? "static void exponentials(int n, float *x)\n{\n  for (int i = 0; i < n; ++i) x[i] = expf(x[i]);\n}\n"
                           : std::string(piece->text);
    pieces = fmt::format("\n{}{}", body, pieces);
    users += body;
  }
  text.replace(text.find("@kernel_pieces@"), std::string("@kernel_pieces@").size(), pieces);
}

// ---------------------------------------------------------------- mean

// where a function finds its state
const char* state_of_features(const Term& term) { return term.features_read_load() ? "w->x" : "state"; }
const char* state_of_directions(const Term& term) {
  return term.reads_multipliers ? "w->y" : term.directions_read_load() ? "w->x" : "state";
}

void Writer::write_signals() {
  std::string& text = texts_["signals"];
  for (std::size_t a = 0; a < terms_.size(); ++a) {
    const Term& term = terms_[a];
    const std::string to = term.is_forced() ? "force" : "a_bar";
    text +=
        fmt::format("\n  /* latent {}: {} of {} */\n", in_comment(term.of->name.empty() ? std::to_string(a + 1) : term.of->name),
                    in_comment(term.kernel.text()), in_comment(fmt::format("{}", fmt::join(term.of->feature_names, ", "))));
    text += fmt::format("  {}({}, w->phi_{});\n", texts_[fmt::format("features_{}", a)], state_of_features(term), a);
    text += fmt::format("  if (!is_finite({}, w->phi_{})) return {}_NOT_FINITE;\n", term.D, a, options_.name);
    if (term.of->is_potential) {
      text += fmt::format("  {0}(&c->latents[{1}], w->phi_{1}, w->pairs_{1});\n", texts_[fmt::format("pairs_{}", a)], a);
      text += fmt::format("  {0}(&c->latents[{1}], w->pairs_{1}, w->scratch, w->signal_{1});\n",
                          texts_[fmt::format("sums_{}", a)], a);
    } else {
      text +=
          fmt::format("  {0}(&c->latents[{1}], w->phi_{1}, w->k_{1}, w->scratch);\n", texts_[fmt::format("covariance_{}", a)], a);
      text += fmt::format(
          "  for (int l = 0; l < {1}; ++l) {{\n    const latent *const a = &c->latents[{0}];\n"
          "    w->signal_{0}[l] = weighted_sum(a->n, w->k_{0}, a->weights + a->n * l);\n  }}\n",
          a, term.p);
    }
    if (term.of->is_positive)
      text += fmt::format("  for (int l = 0; l < {1}; ++l) w->signal_{0}[l] = exp(w->signal_{0}[l]);\n", a, term.p);
    if (term.reads_multipliers) continue;
    if (term.has_directions()) {
      text += term.is_admissible() ? fmt::format("  for (int i = 0; i < NQ * NQ; ++i) w->B_{}[i] = w->P[i] * {}[i / NQ];\n", a,
                                                 texts_["admissible"])
                                   : fmt::format("  {}(c->parameters, {}, w->B_{});\n", texts_[fmt::format("directions_{}", a)],
                                                 state_of_directions(term), a);
      text += fmt::format("  for (int l = 0; l < {}; ++l) {{\n", term.p);
      text +=
          fmt::format("    for (int i = 0; i < NQ; ++i) w->{0}[i] += w->B_{1}[i + NQ * l] * w->signal_{1}[l];\n  }}\n", to, a);
    } else {
      text += fmt::format("  for (int i = 0; i < NQ; ++i) w->{}[i] += w->signal_{}[i];\n", to, a);
    }
  }
  if (!terms_.empty()) text += "\n";
  if (has("constant")) texts_["mu"] = numbers(prior_.constant_mean.data(), prior_.constant_mean.size());
}

// The latents whose directions read λ, at w->y = [state; λ]
void Writer::write_under_load() {
  std::string& text = texts_["under_load"];
  for (std::size_t a = 0; a < terms_.size(); ++a) {
    const Term& term = terms_[a];
    if (!term.reads_multipliers) continue;
    const std::string directions = fmt::format("directions_{}", a), part = term.is_forced() ? "force" : "rest";
    text += fmt::format(
        "  {0}(c->parameters, w->y, w->B_{1});\n  for (int l = 0; l < {2}; ++l) {{\n"
        "    for (int i = 0; i < NQ; ++i) w->{3}_of_load[i] += w->B_{1}[i + NQ * l] * w->signal_{1}[l];\n  }}\n",
        texts_[directions], a, term.p, part);
    if (term.directions->tapes().entries->empty()) continue;
    text += fmt::format(
        "  {0}(c->parameters, w->y, w->derivative);\n  for (int e = 0; e < {1}; ++e) {{\n"
        "    const int i = {2}[e][0], l = {2}[e][1], k = {2}[e][2] - NX;\n"
        "    if (k >= 0) w->{3}_slope[i + NQ * k] += w->derivative[e] * w->signal_{4}[l];\n  }}\n",
        texts_["d_" + directions], term.directions->tapes().entries->size(), texts_["of_" + directions], part, a);
  }
}

// What each quantity is of the motion: value, G transposed and derivative.
void Writer::write_view() {
  const View::Quantity quantity = view_.quantity;
  const std::string r = row("r"), each_row = "for (int r = 0; r < NR; ++r) ";
  const std::string T = has("rows") ? fmt::format("w->T[{} + NQ * j]", r) : fmt::format("({} == j)", r);
  const std::string dt = view_.time_step ? number(*view_.time_step) : "";
  std::string &value = texts_["value"], &matrix = texts_["view_matrix"], &change = texts_["dvalue"];
  const auto each_entry = [&](const std::string& of) {
    return fmt::format("  for (int k = 0; k < NX; ++k) {{\n    {}jacobian[r + NR * k] = {};\n  }}\n", each_row, of);
  };
  const auto each_column = [&](const std::string& of) {
    return fmt::format("  {}{{\n    for (int j = 0; j < NQ; ++j) w->Gt[j + NQ * r] = {};\n  }}\n", each_row, of);
  };
  if (quantity == View::Quantity::constrained_acceleration) {
    value = fmt::format("    {}mean[r] = w->a[{}];\n", each_row, r);
    matrix = each_column(T);
    change = each_entry(fmt::format("w->d_a[{} + NQ * k]", r));
  } else if (quantity == View::Quantity::unconstrained_acceleration) {
    value = fmt::format("    {}mean[r] = w->a_bar[{}];\n", each_row, r);
    matrix = each_column(fmt::format("({} == j)", r));
    change = each_entry(fmt::format("w->d_a_bar[{} + NQ * k]", r));
  } else if (quantity == View::Quantity::learned_force) {
    value = fmt::format("    {}mean[r] = w->applied[{}];\n", each_row, r);
    matrix = each_column(fmt::format("w->mass[{} + NQ * j]", r));
    change = each_entry(fmt::format("w->d_applied[{} + NQ * k]", r));
  } else if (quantity == View::Quantity::next_velocity) {
    const std::string added = view_.has_mean() ? fmt::format("state[NQ + {}] + ", r) : "";
    value = fmt::format("    {}mean[r] = {}{} * w->a[{}];\n", each_row, added, dt, r);
    matrix = each_column(fmt::format("{} * {}", dt, T));
    change =
        each_entry(fmt::format("{}{} * w->d_a[{} + NQ * k]", view_.has_mean() ? fmt::format("(k == NQ + {}) + ", r) : "", dt, r));
  } else if (quantity == View::Quantity::constraint_force) {
    value = fmt::format("    {}mean[r] = w->of_constraint[{}];\n", each_row, r);
    change = each_entry(fmt::format("w->d_of_constraint[{} + NQ * k]", r));
    matrix = fmt::format(
        "  {}{{ /* M T - M */\n    for (int j = 0; j < NQ; ++j) {{\n      real sum = -w->mass[{} + NQ * j];\n"
        "      for (int i = 0; i < NQ; ++i) sum += w->M[{} + NQ * i] * {};\n      w->Gt[j + NQ * r] = sum;\n    }}\n  }}\n",
        each_row, r, r, has("rows") ? "w->T[i + NQ * j]" : "(i == j)");
  } else {  // multipliers
    value = fmt::format(
        "    multipliers_of_force(w);\n    for (int i = 0; i < NC; ++i) {{\n      w->lambda[i] = 0;\n"
        "      for (int j = 0; j < NQ; ++j) w->lambda[i] += w->K[i + NC * j] * w->of_constraint[j];\n    }}\n"
        "    {}mean[r] = w->lambda[{}];\n",
        each_row, r);
    matrix = fmt::format(
        "  {}{{ /* K (M T - M) */\n    for (int j = 0; j < NQ; ++j) {{\n      real product = 0;\n      for (int l = 0; l < NQ; "
        "++l) {{\n"
        "        real sum = -w->mass[l + NQ * j];\n        for (int i = 0; i < NQ; ++i) sum += w->M[l + NQ * i] * w->T[i + NQ * "
        "j];\n"
        "        product += w->K[{} + NC * l] * sum;\n      }}\n      w->Gt[j + NQ * r] = product;\n    }}\n  }}\n",
        each_row, r);
    const auto of_dA = [&](const std::string& statement) {
      return has("d_A")
                 ? fmt::format(
                       "  for (int e = 0; e < {}; ++e) {{\n    const int i = of_d_A[e][0], j = of_d_A[e][1], k = of_d_A[e][2];\n"
                       "    {}\n  }}\n",
                       texts_["n_d_A"], statement)
                 : "";
    };
    change = of_dA("w->d_of_constraint[j + NQ * k] -= w->d_A[e] * w->lambda[i];");
    change += fmt::format(
        "  real along[NQ];\n  along_multipliers(w->lambda, w, along);\n"
        "  for (int i = 0; i < NC * NX; ++i) w->d_along[i] = 0;\n{}"
        "  for (int k = 0; k < NX; ++k) {{\n    real d_lambda[NC];\n"
        "    change_of_multipliers(w->d_of_constraint + NQ * k, w->d_along + NC * k, w, d_lambda);\n"
        "    {}jacobian[r + NR * k] = d_lambda[{}];\n  }}\n",
        of_dA("w->d_along[i + NC * k] += w->d_A[e] * along[j];"), each_row, r);
  }
  if (!has("stddev")) matrix.clear();
  if (!has("jacobian")) change.clear();
}

// ---------------------------------------------------------------- standard deviation

void Writer::write_stddev() {
  std::string &loadings = texts_["loadings"], &by_row = texts_["cross_by_row"], &by_function = texts_["cross_by_function"];
  if (!has("stddev")) return;
  for (std::size_t a = 0; a < terms_.size(); ++a) {
    const Term& term = terms_[a];
    const std::string G = term.is_forced() ? "M_inverse_Gt" : "Gt";
    const std::string variance = texts_[fmt::format("variance_{}", a)];
    loadings += term.of->is_potential
                    ? fmt::format("  real prior_{0}[{2}];\n  {1}(&c->latents[{0}], prior_{0});\n", a, variance, term.F)
                    : fmt::format("  real prior_{0};\n  {1}(&c->latents[{0}], w->phi_{0}, &prior_{0});\n", a, variance);
    loadings +=
        fmt::format("  for (int r = 0; r < NR; ++r) {{\n    for (int f = 0; f < {}; ++f) {{\n      real sum = 0;\n", term.F);
    loadings += fmt::format("      for (int l = 0; l < {}; ++l) {{\n", term.p);
    if (term.has_directions()) {
      loadings += fmt::format(
          "        real along = 0;\n        for (int i = 0; i < NQ; ++i) along += w->B_{}[i + NQ * l] * w->{}[i + NQ * r];\n", a,
          G);
    } else {
      loadings += fmt::format("        const real along = w->{}[l + NQ * r];\n", G);
    }
    loadings += fmt::format("        sum += c->latents[{0}].loading[l + {1} * f] * along{2};\n      }}\n", a, term.p,
                            term.of->is_positive ? fmt::format(" * w->signal_{}[l]", a) : "");
    loadings +=
        fmt::format("      w->loading[{} * r + {} + f] = sum;\n      variance[r] += prior_{}{} * sum * sum;\n    }}\n  }}\n",
                    n_functions_, term.first, a, term.of->is_potential ? "[f]" : "");
    if (term.of->is_potential) {
      const auto multiplied = [&](const std::string& indent, const std::string& loading, const std::string& products) {
        return fmt::format(
            "{0}{1}(&c->latents[{2}], w->pairs_{2}, {3}, w->scratch, w->gradient_{2});\n"
            "{0}add_gradient_products(&c->latents[{2}], {4}, row, w->gradient_{2}, {5});\n",
            indent, texts_[fmt::format("products_{}", a)], a, loading, term.F, products);
      };
      if (!has("by_function")) {
        by_row += multiplied("      ", fmt::format("w->loading + {} * r + {}", n_functions_, term.first), "w->products");
        continue;
      }
      by_function += fmt::format(
          "    for (int f = 0; f < {0}; ++f) {{\n      real unit[{0}] = {{0}};\n      unit[f] = 1;\n"
          "      real *const cross = w->{1} + {2} * ({3} + f);\n      for (int j = 0; j < n; ++j) w->products[j] = 0;\n{4}"
          "      for (int j = 0; j < n; ++j) {{\n        if (row_of[j] >= 0) cross[row_of[j]] = w->products[j];\n      }}\n    "
          "}}\n",
          term.F, texts_["cross"], texts_["cross_rows"], term.first, multiplied("      ", "unit", "w->products"));
    } else if (has("by_function")) {
      by_function += fmt::format(
          "    for (int f = 0; f < {0}; ++f) {{\n      const real *const rows = c->latents[{1}].rows + n * ({0} * row + f);\n"
          "      real *const cross = w->{2} + {3} * ({4} + f);\n      for (int j = 0; j < n; ++j) {{\n"
          "        if (row_of[j] >= 0) cross[row_of[j]] = w->k_{1}[j] * rows[j];\n      }}\n    }}\n",
          term.F, a, texts_["cross"], texts_["cross_rows"], term.first);
    } else {
      by_row +=
          fmt::format("      add_products(&c->latents[{0}], {1}, row, w->k_{0}, w->loading + {2} * r + {3}, w->products);\n", a,
                      term.F, n_functions_, term.first);
    }
  }
}

// ---------------------------------------------------------------- Jacobian

// the change by entry e of the derivatives of a function, of what stands for ā in `to`
std::string added_change(bool reads_load, const std::string& to, const std::string& slope) {
  return reads_load ? fmt::format("add_change(w->{}, i, k, {}, w);\n", to, slope)
                    : fmt::format("w->{}[i + NQ * k] += {};\n", to, slope);
}

void Writer::write_jacobian() {
  std::string &signals = texts_["dsignals"], &mechanics = texts_["dmechanics"], &load = texts_["dload"],
              &along = texts_["dalong"];
  if (!has("jacobian")) return;
  bool reads_state = false, reads_component = false;
  for (std::size_t a = 0; a < terms_.size(); ++a) {
    const Term& term = terms_[a];
    const std::string to = term.is_forced() ? "d_force" : "d_of_rest";
    const std::string features = fmt::format("features_{}", a), directions = fmt::format("directions_{}", a);
    if (const std::size_t n = term.features->tapes().entries->size(); n > 0 && term.reads_features()) {
      reads_component = true;
      reads_state = reads_state || !term.features_read_load();
      const std::string at = term.of->is_potential ? fmt::format("w->pairs_{}", a) : fmt::format("w->phi_{0}, w->k_{0}", a);
      signals +=
          fmt::format("  {}(&c->latents[{}], {}, w->scratch, w->dsignal);\n", texts_[fmt::format("gradient_{}", a)], a, at);
      if (term.of->is_positive) {
        signals +=
            fmt::format("  for (int j = 0; j < {0}; ++j) w->dsignal[j] *= w->signal_{1}[j / {2}];\n", term.D * term.p, a, term.D);
      }
      signals += fmt::format("  {}({}, w->derivative);\n  for (int e = 0; e < {}; ++e) {{\n", texts_["d_" + features],
                             state_of_features(term), n);
      signals += fmt::format("    const int d = {0}[e][0], k = {0}[e][1];\n    for (int i = 0; i < NQ; ++i) {{\n",
                             texts_["of_" + features]);
      if (term.has_directions()) {
        signals += fmt::format(
            "      real sum = 0;\n      for (int l = 0; l < {}; ++l) sum += w->B_{}[i + NQ * l] * w->dsignal[d + {} * l];\n",
            term.p, a, term.D);
        signals += "      " + added_change(term.features_read_load(), to, "sum * w->derivative[e]") + "    }\n  }\n";
      } else {
        const std::string slope = fmt::format("w->dsignal[d + {} * i] * w->derivative[e]", term.D);
        signals += "      " + added_change(term.features_read_load(), to, slope) + "    }\n  }\n";
      }
    }
    if (term.is_admissible() && has("d_A")) {
      signals += fmt::format(
          "  real along[NQ], multiplier[NC]; /* dE g = -(L dA E g + E B dA' lambda), lambda = L' B^-1 g */\n"
          "  for (int i = 0; i < NQ; ++i) {{\n    along[i] = 0;\n"
          "    for (int l = 0; l < NQ; ++l) along[i] += w->B_{0}[i + NQ * l] * w->signal_{0}[l];\n  }}\n"
          "  for (int k = 0; k < NC; ++k) {{\n    multiplier[k] = 0;\n"
          "    for (int i = 0; i < NQ; ++i) multiplier[k] += w->L_P[i + NQ * k] * w->signal_{0}[i] / {1}[i];\n  }}\n"
          "  for (int e = 0; e < {2}; ++e) {{\n    const int i = of_d_A[e][0], j = of_d_A[e][1], k = of_d_A[e][2];\n"
          "    for (int l = 0; l < NQ; ++l) {{\n      w->d_of_rest[l + NQ * k] -=\n"
          "          w->d_A[e] * (along[j] * w->L_P[l + NQ * i] + multiplier[i] * {1}[j] * w->B_{0}[l + NQ * j]);\n    }}\n  "
          "}}\n",
          a, texts_["admissible"], texts_["n_d_A"]);
      continue;
    }
    if (!term.has_directions() || term.directions->tapes().entries->empty()) continue;
    reads_component = true;
    reads_state = reads_state || !(term.directions_read_load() || term.reads_multipliers);
    signals += fmt::format("  {}(c->parameters, {}, w->derivative);\n  for (int e = 0; e < {}; ++e) {{\n",
                           texts_["d_" + directions], state_of_directions(term), term.directions->tapes().entries->size());
    signals += fmt::format("    const int i = {0}[e][0], l = {0}[e][1], k = {0}[e][2];\n", texts_["of_" + directions]);
    if (term.reads_multipliers) signals += "    if (k >= NX) continue; /* in lambda, which follows the state */\n";
    const std::string slope = fmt::format("w->derivative[e] * w->signal_{}[l]", a);
    signals += "    " + added_change(term.directions_read_load(), to, slope) + "  }\n";
  }
  if (!reads_state) signals += "  (void)state;\n";
  if (!reads_component) signals += "  (void)c;\n";
  const auto each = [&](std::string& text, const std::string& of, const std::vector<std::string>& statements) {
    if (!has(of) || statements.empty()) return;
    const bool is_matrix = of == "d_M" || of == "d_A";
    text += fmt::format("  for (int e = 0; e < {}; ++e) {{\n    const int i = of_{}[e][0],", texts_["n_" + of], of);
    if (is_matrix) text += fmt::format(" j = of_{}[e][1],", of);
    text += fmt::format(" k = of_{}[e][2];\n", of);
    for (const std::string& statement : statements) text += "    " + statement + "\n";
    text += "  }\n";
  };
  std::vector<std::string> of_M{"w->d_force[i + NQ * k] -= w->d_M[e] * w->a_of_force[j];"}, of_A, of_b, of_F;
  if (has("moved")) of_M.emplace_back("w->d_of_constraint[i + NQ * k] += w->d_M[e] * w->gap[j];");
  if (has("applied")) of_M.emplace_back("w->d_applied[i + NQ * k] += w->d_M[e] * w->a_bar[j];");
  if (has("moved")) of_A = {"w->d_forced[j + NQ * k] += w->d_A[e] * lambda[i];", "w->d_rows[i + NC * k] -= w->d_A[e] * w->a[j];"};
  if (has("moved") && has("all")) of_b = {"w->d_rows[i + NC * k] += w->d_b[e];"};
  if (has("known")) of_F = {"w->d_force[i + NQ * k] += w->d_F[e];"};
  each(mechanics, "d_M", of_M);
  each(mechanics, "d_A", of_A);
  each(mechanics, "d_b", of_b);
  each(mechanics, "d_F", of_F);
  if (has("load")) {
    each(load, "d_M", {"w->d_forced0[i + NQ * k] -= w->d_M[e] * w->a0[j];"});
    each(load, "d_A",
         {"w->d_forced0[j + NQ * k] += w->d_A[e] * lambda0[i];", "w->d_rows0[i + NC * k] -= w->d_A[e] * w->a0[j];",
          "w->d_along[i + NC * k] += w->d_A[e] * along[j];"});
    each(load, "d_b", {"w->d_rows0[i + NC * k] += w->d_b[e];"});
    each(load, "d_F", {"w->d_forced0[i + NQ * k] += w->d_F[e];"});
  }
  if (has("nonlinear")) each(along, "d_A", {"w->d_along[i + NC * k] += w->d_A[e] * along[j];"});
  if (mechanics.empty() && !has("moved")) mechanics = "  (void)w;\n";
}

// ---------------------------------------------------------------- tests

// The functions of a latent at a state: their standard deviations, that of the prior, and Σ_j |k_j β_j| of their means.
struct FunctionsAt {
  VectorXd stddev, sizes;  // (F)
  double prior_stddev = 0;
};
FunctionsAt functions_at(const LatentPosterior& latents, std::size_t latent, const VectorXd& features) {
  const LatentPosterior::Basis& basis = latents.latents()[latent];
  const Index F = basis.n_functions, n = basis.kernel.n_rows();
  VectorXd point, k(n), variance(F);
  basis.kernel.scale(features, point);
  const GradientColumns gradient(basis.kernel);
  GradientColumns::Workspace of_gradient;
  if (basis.is_potential) {
    gradient.evaluate(0, n, point, of_gradient);
    variance = gradient.variance();
  } else {
    KernelColumns::Workspace memory;
    basis.kernel.evaluate(0, n, point, k.data(), memory);
    variance.setConstant(basis.kernel.variance(point));
  }
  FunctionsAt out{VectorXd(F), VectorXd(F), std::sqrt(variance.maxCoeff())};
  MatrixXd rows = MatrixXd::Zero(latents.n_rows(), F);
  for (Index f = 0; f < F; ++f) {
    MatrixXd K = MatrixXd::Zero(n, F);  // of every function at each point with this one
    if (basis.is_potential) {
      gradient.multiply(VectorXd::Unit(F, f), of_gradient);
      K = of_gradient.out;
    } else {
      K.col(f) = k;
    }
    out.sizes[f] = K.cwiseProduct(basis.beta).cwiseAbs().sum();
    for (std::size_t c = 0; c < latents.row_of().size(); ++c) {
      const std::vector<Index>& row_of = latents.row_of()[c];
      const VectorXd of_points = K.cwiseProduct(basis.Z.middleCols(static_cast<Index>(c) * F, F)).rowwise().sum();
      for (std::size_t j = 0; j < row_of.size(); ++j) {
        if (row_of[j] >= 0) rows(row_of[j], f) = of_points[static_cast<Index>(j)];
      }
    }
  }
  MatrixXd cross = latents.sums() != nullptr ? MatrixXd(latents.sums()->D * rows) : std::move(rows);
  latents.whiten(cross);
  out.stddev = (variance - cross.colwise().squaredNorm().transpose()).cwiseMax(0).cwiseSqrt();
  return out;
}

// What rounding may make of the mean at a state, and how much more of its derivatives. Weights that cancel leave a function off by
// rounding of Σ_j |k_j β_j|, and a row is at most its deviation under the prior, in units of the function's, times as large.
std::pair<double, double> Writer::rounding_at(const VectorXd& state, double prior_stddev) const {
  double cancelled = 0, steepest = 1;
  for (const Component& component : components_) {
    double of_component = 0;
    for (const Term& term : terms_) {
      VectorXd features(term.D);
      term.features->evaluate(state, features);
      const FunctionsAt at = functions_at(*component->latents, term.latent, features);
      if (at.prior_stddev > 0) of_component += at.sizes.norm() / at.prior_stddev;
      const VectorXd scales = scales_of(component->latents->latents()[term.latent].kernel);
      if (scales.size() > 0) steepest = std::max(steepest, scales.maxCoeff());
    }
    cancelled = std::max(cancelled, of_component);
  }
  return {32 * (options_.single_precision ? 6e-8 : 1.1e-16) * prior_stddev * cancelled, steepest};
}

void Writer::write_tests() {
  const MatrixXd& observed = components_.front()->observations.front().states();
  const Predictor predictor(posterior_, view_, {options_.stddev, options_.jacobian, Predictor::Storage::double_precision});
  const Predictor before(posterior_.without_data(), view_, {true, false, Predictor::Storage::double_precision});
  Predictor::Workspace workspace = predictor.make_workspace(), workspace_before = before.make_workspace();
  const Index nr = view_.size(), nx = layout_.size();
  VectorXd mean(nr), stddev = VectorXd::Zero(nr), at_zero(nr), prior(nr);
  MatrixXd jacobian(nr, nx);
  std::string& text = texts_["tests"];
  int n = 0;
  // evenly among the observed, those that have a prediction
  for (Index i = 0; i < observed.cols() && n < n_tests; i += std::max<Index>(1, observed.cols() / n_tests)) {
    VectorXd state = observed.col(i).array().isNaN().select(0, observed.col(i));
    Predictor::Status status = predictor.mean(state, mean, workspace);
    if (has("jacobian") && status == Predictor::Status::ok)
      status = predictor.mean_and_jacobian(state, mean, jacobian, workspace);
    if (has("stddev") && status == Predictor::Status::ok) status = predictor.mean_and_stddev(state, mean, stddev, workspace);
    if (status != Predictor::Status::ok) continue;
    ++n;
    static_cast<void>(before.mean_and_stddev(state, at_zero, prior, workspace_before));
    const double size = prior.maxCoeff(), precision = options_.single_precision ? 1e-4 : 1e-9;
    const auto [rounding, steepest] = rounding_at(state, size);
    const VectorXd variance = stddev.array().square();
    text += fmt::format("    {{{{{}}}, {{{}}},\n", numbers(state.data(), nx), numbers(mean.data(), nr));
    if (has("stddev")) text += fmt::format("     {{{}}},\n", numbers(variance.data(), nr));
    if (has("jacobian")) text += fmt::format("     {{{}}},\n", numbers(jacobian.data(), nr * nx));
    std::vector<std::string> errors = {number(precision * std::max(1.0, mean.cwiseAbs().maxCoeff()) + rounding)};
    if (has("stddev")) errors.push_back(number(precision * size * size));
    if (has("jacobian"))
      errors.push_back(number(precision * std::max(1.0, jacobian.cwiseAbs().maxCoeff()) + rounding * steepest));
    text += fmt::format("     {}}},\n", fmt::join(errors, ", "));
  }
  if (n == 0)
    throw InputError("export to C: no observed state has a prediction of this view, so that there is nothing to test it by");
  texts_["n_tests"] = std::to_string(n);
}

// ---------------------------------------------------------------- single precision

void Writer::require_single_precision() const {
  constexpr double epsilon = 6e-8;  // half the spacing of floats at 1
  constexpr double largest_share = 0.01;
  constexpr Index most_states = 200;
  double worst = 0;
  std::string where;
  for (const Component& component : components_) {
    for (const Observations& group : component->observations) {
      const MatrixXd& states = group.states();
      for (Index i = 0; i < states.cols(); i += std::max<Index>(1, states.cols() / most_states)) {
        const VectorXd state = states.col(i).array().isNaN().select(0, states.col(i));
        for (const Term& term : terms_) {
          VectorXd features(term.D);
          term.features->evaluate(state, features);
          const FunctionsAt at = functions_at(*component->latents, term.latent, features);
          for (Index f = 0; f < term.F; ++f) {
            const double share = epsilon * at.sizes[f] / at.stddev[f];
            if (!(share > worst)) continue;
            worst = share;
            where = term.of->name;
          }
        }
      }
    }
  }
  if (worst <= largest_share) return;
  throw InputError(fmt::format(
      "export to C: in single precision latent '{}' would be off by up to {:.2g} of its standard deviation at an observed state, "
      "where {:.2g} is allowed: its weights cancel. Fewer {} or a larger noise help, or leave `float` out",
      where, worst, largest_share, posterior_.values().inducing ? "inducing points" : "rows"));
}

CSource Writer::write() {
  if (options_.single_precision) require_single_precision();
  texts_["portable"] = options_.portable_math ? "@portable@" : "";
  const std::vector<std::string> names =
      view_.names(system(), view_.latent ? prior_.latents[static_cast<std::size_t>(view_.latent->first)].name : "");
  texts_["title"] = in_comment(fmt::format("{}: {} as learned by gp2 {}.", system().name(), fmt::join(names, ", "), version()));
  std::string& about = texts_["about"];
  about += fmt::format(" * The {} view, of {} observed states{}.\n", view_.quantity->word(), posterior_.n_states(),
                       has("mixture") ? fmt::format(", a mixture over {} draws of hyperparameters", components_.size()) : "");
  for (const std::string& line : options_.about) about += " * " + in_comment(line) + "\n";
  if (options_.portable_math)
    about +=
        " * Its numbers are the same to the bit on every machine (compile with -ffp-contract=off). sin, cos and tan of more than "
        "1e6\n"
        " * are NaN.\n";
  for (const std::string& label : system().constraint_labels()) about += in_comment(fmt::format(" * It obeys {} = 0.\n", label));
  const auto stated = [&](const std::string& name) -> std::string {
    const auto found = options_.units.find(name.substr(0, name.find('@')));
    return found == options_.units.end() ? "" : fmt::format(" [{}]", found->second);
  };
  const auto unit = [&](int k) -> std::string {
    const int nq = layout_.nq;
    const std::string label = stated(system().state_names()[static_cast<std::size_t>(k)]);
    if (k > layout_.t()) return label + " (what acts now, where commands act late)";
    if (!label.empty()) return label;
    if (k == layout_.t()) return " [s]";
    const Coordinate& coordinate = system().coordinates()[static_cast<std::size_t>(k % nq)];
    return coordinate.angle ? (k < nq ? " [rad]" : " [rad/s]") : "";
  };
  for (int k = 0; k < layout_.size(); ++k) {
    texts_["state"] +=
        in_comment(fmt::format(" *   [{}] {}{}\n", k, system().state_names()[static_cast<std::size_t>(k)], unit(k)));
  }
  for (std::size_t r = 0; r < names.size(); ++r)
    texts_["view"] += in_comment(fmt::format(" *   [{}] {}{}\n", r, names[r], stated(names[r])));
  std::vector<std::string> parameters;
  for (const Parameter& parameter : system().parameters()) parameters.push_back(parameter.name + stated(parameter.name));
  texts_["parameters"] = in_comment(parameters.empty() ? "none" : fmt::format("{}", fmt::join(parameters, ", ")));

  write_tables();
  write_expressions();
  write_kernels();
  write_signals();
  write_under_load();
  write_view();
  write_stddev();
  write_jacobian();
  write_tests();
  CSource out;
  out.header = c_export::filled(c_export::header_template, conditions_, texts_);
  out.source = c_export::filled(c_export::mechanics_template, conditions_, texts_) +
               c_export::filled(c_export::prediction_template, conditions_, texts_);
  if (options_.single_precision) use_float_functions(out.source);
  if (options_.portable_math) use_portable_functions(out.source, options_.name);
  return out;
}

}  // namespace

CSource export_c(const Posterior& posterior, const View& view, const CSourceOptions& options) {
  require_view(posterior.prior(), view);
  if (view.latent || !view.has_mean()) require_linear(prior_of(posterior.prior(), view), "export to C of a part of the motion");
  if (!is_identifier(options.name)) {
    throw InputError(fmt::format("`name`: must be a name of C, of letters, digits and _, got '{}'", options.name));
  }
  const auto& components = posterior.conditioned();
  if (posterior.n_states() == 0) throw InputError("export to C: nothing was observed, so there is nothing to export");
  return Writer(posterior, components, view, options).write();
}

}  // namespace gp2
