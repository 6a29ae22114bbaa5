#include "export/c_writer.hpp"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <limits>
#include <set>

#include <fmt/format.h>

#include "gp2/base/file.hpp"
#include "gp2/error.hpp"
#include "inference/requirements.hpp"
#include "prior/primitive.hpp"
#include "symbolic/functions.hpp"

namespace gp2::c_export {

using Eigen::Index;
using Eigen::VectorXd;

namespace {

const std::set<std::string>& taken_names() {
  static const std::set<std::string> names = {
      "alignas", "alignof", "asm", "auto", "bool", "break", "case", "char", "const", "constexpr", "continue", "default", "do",
      "double", "else", "enum", "extern", "false", "float", "for", "goto", "if", "inline", "int", "linux", "long", "nullptr",
      "register", "restrict", "return", "short", "signed", "sizeof", "static", "struct", "switch", "true", "typedef", "typeof",
      "static_assert", "thread_local", "union", "unix", "unsigned", "void", "volatile", "while", "state", "w", "real", "out",
      "parameters", "status", "workspace", "evaluate",
      // macros of math.h
      "NAN", "INFINITY", "HUGE_VAL", "HUGE_VALF", "HUGE_VALL", "NULL", "MAXFLOAT", "FP_NAN", "FP_INFINITE", "FP_ZERO",
      "FP_NORMAL", "FP_SUBNORMAL", "FP_ILOGB0", "FP_ILOGBNAN", "FP_FAST_FMA", "FP_FAST_FMAF", "FP_FAST_FMAL", "MATH_ERRNO",
      "MATH_ERREXCEPT", "math_errhandling", "signgam", "M_E", "M_LOG2E", "M_LOG10E", "M_LN2", "M_LN10", "M_PI", "M_PI_2",
      "M_PI_4", "M_1_PI", "M_2_PI", "M_2_SQRTPI", "M_SQRT2", "M_SQRT1_2", "M_TWOPI", "M_3PI_4", "M_SQRTPI", "M_SQRT3", "M_LN2LO",
      "M_LN2HI", "M_IVLN10", "M_INVLN2", "M_LOG2_E"};
  return names;
}

// System::largest_rank_of, at the workspace's state: `row_scale` is 0 of a row that vanishes.
std::string largest_rank_in_c(const System& system) {
  int n_always = system.largest_rank();
  std::string others;
  for (int row = 0; row < system.nc(); ++row) {
    if (!system.is_conditional(row)) continue;
    --n_always;
    others += fmt::format(" + (w->row_scale[{}] != 0)", row);
  }
  return std::to_string(n_always) + others;
}

}  // namespace

bool is_identifier(const std::string& text) {
  const auto is_letter = [](char c) { return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '_'; };
  return !text.empty() && text != "_" && is_letter(text.front()) && !taken_names().contains(text) &&
         std::all_of(text.begin(), text.end(), [&](char c) { return is_letter(c) || (c >= '0' && c <= '9'); });
}

std::string in_comment(std::string text) {
  for (const auto& [mark, apart] : {std::pair("*/", "* /"), std::pair("/*", "/ *")}) {
    for (std::size_t at = text.find(mark); at != std::string::npos; at = text.find(mark, at)) text.replace(at, 2, apart);
  }
  return text;
}

bool Term::reads_features() const {
  return std::any_of(kernel.terms().begin(), kernel.terms().end(), [](const Kernel::Term& term) {
    return std::any_of(term.factors.begin(), term.factors.end(),
                       [](const Kernel::Factor& factor) { return factor.primitive != Kernel::Primitive::constant; });
  });
}

bool Term::is_se() const {
  return kernel.terms().size() == 1 && kernel.terms()[0].factors.size() == 1 &&
         kernel.terms()[0].factors[0].primitive == Kernel::Primitive::se;
}

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

Writer::Writer(const Posterior& posterior, std::vector<Component> components, View view, const CSourceOptions& options)
    : posterior_(posterior),
      components_(std::move(components)),
      view_(std::move(view)),
      options_(options),
      prior_(prior_of(posterior.prior(), view_)),
      layout_(prior_.system->layout()) {
  for (std::size_t r = 0; r < view_.rows.size(); ++r) all_rows_ = all_rows_ && view_.rows[r] == static_cast<int>(r);
  add_terms();
  set_names();
  set_conditions();
  set_sizes();
  declare_workspace();
}

void Writer::add_terms() {
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
  for (std::size_t a = 0; a < prior_.latents.size() && !view_.has_mean(); ++a) {
    is_partial_ = is_partial_ || (view_.has_latent(a) && prior_.latents[a].reads_multipliers());
  }
  for (std::size_t a = 0; a < prior_.latents.size(); ++a) {
    if (!view_.has_latent(a) && !is_partial_) continue;
    const Latent& of = prior_.latents[a];
    Term& term = terms_.emplace_back();
    term.latent = a;
    term.of = &of;
    term.is_viewed = view_.has_latent(a);
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
}

void Writer::set_names() {
  std::set<std::string> taken = taken_names();
  // what expressions call: no number beside them may hide it
  for (const char* const called : {"sign_of", "smaller", "larger", "product_or_zero", "square", "integer_power", "pow", "powf"}) {
    taken.insert(called);
  }
  // the source may be compiled as C++, whose words these are too
  taken.insert(
      {"and",      "and_eq",       "bitand",   "bitor",  "catch",   "char8_t",    "char16_t",  "char32_t",  "class",
       "co_await", "co_return",    "co_yield", "compl",  "concept", "const_cast", "consteval", "constinit", "decltype",
       "delete",   "dynamic_cast", "explicit", "export", "friend",  "mutable",    "namespace", "new",       "noexcept",
       "not",      "not_eq",       "operator", "or",     "or_eq",   "private",    "protected", "public",    "reinterpret_cast",
       "requires", "static_cast",  "template", "this",   "throw",   "try",        "typeid",    "typename",  "using",
       "virtual",  "wchar_t",      "xor",      "xor_eq"});
  for (const internal::Function& function : internal::functions) {
    taken.emplace(function.c);
    taken.insert(std::string(function.c) + "f");
  }
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
}

void Writer::set_conditions() {
  const MotionParts parts = view_.quantity->parts();
  const auto set = [&](const std::string& name, bool holds) {
    if (holds) filling_.conditions.insert(name);
  };
  const auto any = [&](const auto& holds) { return std::any_of(terms_.begin(), terms_.end(), holds); };
  // the quantity of the view by its word, and what of the motion it reads
  filling_.conditions.emplace(view_.quantity->word());
  set("nonlinear", any([](const Term& term) { return term.reads_multipliers; }));
  set("moved", parts.constrained_acceleration || parts.constraint_force || has("nonlinear"));
  set("reaction", parts.constraint_force);
  set("abar", parts.unconstrained_acceleration);
  set("applied", parts.applied_force);
  // mu and b are part of it: it is not of latents alone; or the load of a part is looked for; mu = M^-1 F, or is constant
  set("partial", is_partial_);
  set("has_mean", view_.has_mean());
  set("all", view_.has_mean() || is_partial_);
  set("known", has("all") && prior_.mean == Prior::Mean::force);
  set("constant", has("all") && prior_.mean == Prior::Mean::constant);
  // the load answers to what it is viewed by, or to all latents where some of them are viewed, whose deviation has a part of it
  set("responds", has("nonlinear") && !view_.latent);
  set("by_load", has("nonlinear") && view_.latent && options_.stddev);
  set("answers", has("responds") || has("by_load"));
  // constraints, more than one
  set("rows", system().nc() > 0);
  set("redundant", system().largest_rank() < system().nc());
  set("several", system().nc() > 1);
  // a latent is multiplied by M^-1; or it or mu is
  set("forced_latent", any([](const Term& term) { return term.is_forced(); }));
  set("forced", has("known") || has("forced_latent"));
  set("admissible", any([](const Term& term) { return term.is_admissible(); }));
  set("potential", any([](const Term& term) { return term.of->is_potential; }));
  set("other", any([](const Term& term) { return !term.of->is_potential; }));
  // a latent reads λ₀; or λ (nonlinear); the multipliers of least norm are computed
  set("load", any([](const Term& term) { return term.features_read_load() || term.directions_read_load(); }));
  set("loaded", has("load") || has("nonlinear"));
  set("least_norm", has("multipliers") || has("loaded"));
  // functions that are asked for
  set("stddev", options_.stddev);
  set("jacobian", options_.jacobian);
  set("portable", options_.portable_math);
  set("mixture", components_.size() > 1);
  // observations are sums of rows; covariances are kept by latent functions, which are fewer than the rows of the view
  set("sums", options_.stddev && components_.front()->latents->sums() != nullptr);
  set("by_function", n_functions_ < view_.size());
  set("factor", components_.front()->latents->whitens_by_factor());
  // triangular systems of M are solved, or M itself
  set("forced_solves", has("forced") || has("loaded") || (options_.jacobian && has("moved")));
  set("solves", has("rows") || has("forced_solves"));
}

void Writer::set_sizes() {
  const Index nq = system().nq(), nc = system().nc(), nx = layout_.size(), nr = view_.size();
  for (const Component& component : components_) {
    const LatentPosterior& latents = *component->latents;
    n_variables_ = std::max(n_variables_, whole(latents.size()));
    n_cross_rows_ = std::max(n_cross_rows_, latents.n_rows());
    for (Term& term : terms_) term.n_points = std::max(term.n_points, latents.latents()[term.latent].kernel.n_rows());
  }
  if (!has("sums")) n_cross_rows_ = n_variables_;
  const bool single = options_.single_precision;
  filling_.texts = {
      {"name", options_.name},
      {"real", single ? "float" : "double"},
      {"r", all_rows_ ? "r" : "view_rows[r]"},
      {"start_parameters", is_partial_ ? "const component *c, const real *state, workspace *w" : "workspace *w"},
      {"start_arguments", is_partial_ ? "c, state, w" : "w"},
      {"of_whole", is_partial_ ? "w->is_part ? 0 : " : ""},
      {"dt", view_.time_step ? number(*view_.time_step) : ""},
      {"nq", std::to_string(nq)},
      {"nc", std::to_string(nc)},
      {"nmin", std::to_string(std::min(nq, nc))},
      {"n_state", std::to_string(nx)},
      {"n_rows", std::to_string(nr)},
      {"n_components", std::to_string(components_.size())},
      {"n_functions", std::to_string(n_functions_)},
      {"n_variables", std::to_string(n_variables_)},
      {"n_columns", std::to_string(std::min(nr, n_functions_))},
      {"n_latents", std::to_string(terms_.size())},
      {"index", n_cross_rows_ < 32767 ? "short" : "int"},
      {"cross", has("sums") ? "rows" : "cross"},
      {"cross_rows", std::to_string(n_cross_rows_)},
      {"lost_pivot", single ? "1e-6f" : "1e-14"},
      {"semidefinite", single ? "5e-6f" : "1e-13"},
      {"singular", single ? "1e-4f" : number(UdwadiaKalaba::mass_tolerance)},
      {"tie", single ? "1e-5f" : "1e-10"},
      {"rank_tolerance", single ? "1e-5f" : number(UdwadiaKalaba::rank_tolerance)},
      {"largest_rank", largest_rank_in_c(system())},
      {"consistency", single ? "1e-3f" : number(UdwadiaKalaba::consistency_tolerance)},
      {"well_conditioned", single ? "1e-2f" : "1e-4"},
      {"small_norm", single ? "1e-15f" : "1e-140"},
      {"large_norm", single ? "1e15f" : "1e140"},
      {"newton", single ? "4e-6f" : "1.5e-14"},
      {"newton_stops", single ? "1e-3f" : "1e-10"},
      {"smallest_row", single ? "1.17549435e-38f" : "2.2250738585072014e-308"},
      {"if_singular", what_needs_acceleration(prior_, view_) ? "NO_UNCONSTRAINED_ACCELERATION" : "OK"},
  };
  text("guard") = options_.name + "_H";  // names may differ in the case of their letters
}

std::string Writer::number(double value) const {
  if (options_.single_precision && std::abs(value) > std::numeric_limits<float>::max()) {
    throw InputError(fmt::format("the number {} does not fit single precision: leave `float` out", value));
  }
  std::string text = options_.single_precision ? fmt::format("{}", static_cast<float>(value)) : shortest(value);
  if (text.find_first_of(".e") == std::string::npos) text += ".0";
  return options_.single_precision ? text + "f" : text;
}

std::string Writer::numbers(const double* values, Index n) const {
  std::string text;
  for (Index i = 0; i < n; ++i) text += (i == 0 ? "" : ", ") + number(values[i]);
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
  if (is_new) text("tables") += fmt::format("static const {} {}[{}] = {{\n{}}};\n\n", type, wanted, entries.size(), body);
  return known->second;
}

std::string Writer::table(const std::string& wanted, const double* values, Index n) {
  std::vector<std::string> entries;
  for (Index i = 0; i < n; ++i) entries.push_back(number(values[i]));
  return table("real", wanted, entries);
}

// The name of a static function; where there is one of the same body it is that one.
std::string Writer::function(const std::string& wanted, const std::string& head, const std::string& body) {
  const auto [known, is_new] = known_.try_emplace(head + body, wanted);
  if (is_new) text("expressions") += fmt::format("\nstatic void {}({})\n{{\n{}}}\n", wanted, head, body);
  return known->second;
}

}  // namespace gp2::c_export
