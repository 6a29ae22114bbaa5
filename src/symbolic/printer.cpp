#include <algorithm>
#include <array>
#include <iterator>
#include <numbers>
#include <utility>

#include <fmt/format.h>

#include "gp2/base/file.hpp"
#include "gp2/error.hpp"
#include "gp2/symbolic/expression.hpp"
#include "symbolic/functions.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {

namespace {

constexpr std::size_t max_written_length = std::size_t{1} << 24;  // characters

/// How tightly a written expression holds together; one that must stand where more is needed gets parentheses.
enum Binding { in_sum, in_product, in_power, atomic };

/// A bit of text, or an expression still to be written where `binding` is needed.
struct Piece {
  Piece(const char* written) : text(written) {}             // NOLINT(google-explicit-constructor)
  Piece(std::string written) : text(std::move(written)) {}  // NOLINT(google-explicit-constructor)
  Piece(Expression e, Binding needed) : expression(e), binding(needed) {}
  std::string text;
  std::optional<Expression> expression;
  Binding binding = in_sum;
};

struct Written {
  std::vector<Piece> pieces;
  Binding binding = atomic;
};

/// A number in MathML: its sign is an operator, a power of ten is raised.
Written write_mathml_number(double value) {
  std::string digits = shortest(std::abs(value));
  Binding binding = atomic;
  std::string text;
  const std::size_t exponent = digits.find('e');
  if (std::abs(value) == std::numbers::pi) {
    text = "<mi>π</mi>";
  } else if (exponent == std::string::npos) {
    text = fmt::format("<mn>{}</mn>", digits);
  } else {
    const int power_of_ten = std::stoi(digits.substr(exponent + 1));
    text = fmt::format("<mn>{}</mn><mo>·</mo><msup><mn>10</mn><mn>{}{}</mn></msup>", digits.substr(0, exponent),
                       power_of_ten < 0 ? "−" : "", std::abs(power_of_ten));
    binding = in_product;
  }
  if (!std::signbit(value)) return {{text}, binding};
  return {{fmt::format("<mrow><mo>−</mo>{}</mrow>", text)}, in_product};
}

Written write_number(double value, Notation notation) {
  if (notation == Notation::mathml) return write_mathml_number(value);
  if (std::abs(value) == std::numbers::pi) {
    return {{value < 0 ? "-" : "", notation == Notation::latex ? "\\pi" : "pi"}, value < 0 ? in_product : atomic};
  }
  std::string digits = shortest(value);
  const std::size_t exponent = digits.find('e');
  Binding binding = value < 0 ? in_product : atomic;
  if (notation == Notation::latex && exponent != std::string::npos) {
    const int power_of_ten = std::stoi(digits.substr(exponent + 1));
    digits = fmt::format("{} \\cdot 10^{{{}}}", digits.substr(0, exponent), power_of_ten);
    binding = in_product;
  }
  return {{digits}, binding};
}

/// "theta" → "\theta" or, in MathML, "θ"; a single letter as it is; nothing for other words.
std::optional<std::string> symbol_of(std::string_view word, Notation notation) {
  using Greek = std::pair<std::string_view, std::string_view>;
  static constexpr std::array greek{
      Greek{"alpha", "α"},  Greek{"beta", "β"},  Greek{"gamma", "γ"},   Greek{"delta", "δ"}, Greek{"epsilon", "ε"},
      Greek{"zeta", "ζ"},   Greek{"eta", "η"},   Greek{"theta", "θ"},   Greek{"iota", "ι"},  Greek{"kappa", "κ"},
      Greek{"lambda", "λ"}, Greek{"mu", "μ"},    Greek{"nu", "ν"},      Greek{"xi", "ξ"},    Greek{"rho", "ρ"},
      Greek{"sigma", "σ"},  Greek{"tau", "τ"},   Greek{"upsilon", "υ"}, Greek{"phi", "φ"},   Greek{"chi", "χ"},
      Greek{"psi", "ψ"},    Greek{"omega", "ω"}, Greek{"Gamma", "Γ"},   Greek{"Delta", "Δ"}, Greek{"Theta", "Θ"},
      Greek{"Lambda", "Λ"}, Greek{"Xi", "Ξ"},    Greek{"Pi", "Π"},      Greek{"Sigma", "Σ"}, Greek{"Upsilon", "Υ"},
      Greek{"Phi", "Φ"},    Greek{"Psi", "Ψ"},   Greek{"Omega", "Ω"}};
  if (word.size() == 1 && word != "_") return std::string(word);
  const auto* const found = std::find_if(greek.begin(), greek.end(), [&](const Greek& one) { return one.first == word; });
  if (found == greek.end()) return std::nullopt;
  return notation == Notation::mathml ? std::string(found->second) : fmt::format("\\{}", word);
}

/// A variable's name, taken apart: its symbol or else its word, its index, and how many dots it bears.
struct NameParts {
  std::optional<std::string> symbol;
  std::string word, index;
  int n_dots = 0;
};

NameParts name_parts(std::string_view name, Notation notation) {
  const std::size_t word_end = name.find_last_not_of("0123456789") + 1;
  std::string_view word = name.substr(0, word_end);
  NameParts parts{std::nullopt, "", std::string(name.substr(word_end)), 0};
  if (word.size() > 1 && word.ends_with('_') && !parts.index.empty()) word.remove_suffix(1);
  parts.word = word;

  parts.symbol = symbol_of(word, notation);
  for (const std::string_view dots : {"dd", "d"}) {
    if (parts.symbol || !word.starts_with(dots)) continue;
    parts.symbol = symbol_of(word.substr(dots.size()), notation);
    parts.n_dots = parts.symbol ? static_cast<int>(dots.size()) : 0;
  }
  return parts;
}

/// q1 → q_{1}, dq1 → \dot{q}_{1}, ddq1 → \ddot{q}_{1}, theta → \theta, mass_rod → \mathrm{mass\_rod}.
std::string latex_name(std::string_view name) {
  const NameParts parts = name_parts(name, Notation::latex);
  const std::string index = parts.index.empty() ? "" : fmt::format("_{{{}}}", parts.index);
  if (parts.n_dots > 0) return fmt::format("\\{}{{{}}}{}", parts.n_dots == 2 ? "ddot" : "dot", *parts.symbol, index);
  if (parts.symbol) return *parts.symbol + index;
  std::string escaped;
  for (const char c : parts.word) {
    if (std::string_view("_#%&${}").find(c) != std::string_view::npos) escaped += '\\';
    escaped += c;
  }
  return fmt::format("\\mathrm{{{}}}{}", escaped, index);
}

/// The same in MathML, where a name of several letters stands upright by itself.
std::string mathml_name(std::string_view name) {
  const NameParts parts = name_parts(name, Notation::mathml);
  std::string escaped;
  for (const char c : parts.symbol.value_or(parts.word)) {
    escaped += c == '<' ? "&lt;" : c == '>' ? "&gt;" : c == '&' ? "&amp;" : std::string(1, c);
  }
  // combining dots: every font has them, while accents over <mi> need one for mathematics
  const std::string symbol =
      parts.n_dots == 0 ? fmt::format("<mi>{}</mi>", escaped)
                        : fmt::format("<mi mathvariant=\"italic\">{}{}</mi>", escaped, parts.n_dots == 2 ? "\u0308" : "\u0307");
  return parts.index.empty() ? symbol : fmt::format("<msub>{}<mn>{}</mn></msub>", symbol, parts.index);
}

/// Whether the LaTeX of a product starting with e starts with a digit.
bool starts_with_number(Expression e) {
  while (e.operation() == Operation::multiply || e.operation() == Operation::multiply_or_zero ||
         e.operation() == Operation::power) {
    e = e.left();
  }
  return e.is_constant();
}

/// Whether e is a·(1/b) with 0 for a = 0. It is written a/b, which reads back to it where b is a length with component a.
bool is_quotient_or_zero(Expression e) {
  return e.operation() == Operation::multiply_or_zero && e.right().operation() == Operation::divide &&
         e.right().left().is_constant(1);
}

/// Whether e is a product that starts with a minus, which after another factor would be read as a difference.
bool starts_with_minus(Expression e) {
  while ((e.operation() == Operation::multiply || e.operation() == Operation::multiply_or_zero) && !is_quotient_or_zero(e)) {
    e = e.left();
  }
  return e.operation() == Operation::negate || (e.is_constant() && e.constant_value() < 0);
}

/// Whether c*e, written without parentheses, reads back to c·e: e = u·v·… whose first factor is neither a quotient nor a number.
bool continues_product(Expression e) {
  if (e.operation() != Operation::multiply) return false;
  while (e.operation() == Operation::multiply) e = e.left();
  return e.operation() != Operation::divide && !is_quotient_or_zero(e) && !e.is_constant();
}

/// Whether e is a product or quotient that starts with 0, as 0/0 does: of -0/0 a reader takes -0, which is 0, first.
bool starts_with_zero(Expression e) {
  while (e.operation() == Operation::multiply || e.operation() == Operation::divide) e = e.left();
  return e.is_constant(0);
}

/// Parentheses around what stands between, and the name of a function before them.
/// Not stretchy: around indices and powers browsers make them taller than the eye needs.
constexpr const char* mathml_open = "<mrow><mo stretchy=\"false\">(</mo>";
constexpr const char* mathml_close = "<mo stretchy=\"false\">)</mo></mrow>";

Written write_mathml_quotient(Expression a, Expression b) {
  return {{"<mfrac><mrow>", {a, in_sum}, "</mrow><mrow>", {b, in_sum}, "</mrow></mfrac>"}, in_product};
}

/// e in terms of its operands, in MathML: what belongs together is an element, so fewer parentheses are needed.
Written write_mathml(Expression e) {
  switch (e.operation()) {
    case Operation::constant:
      return write_mathml_number(e.constant_value());
    case Operation::variable:
      return {{mathml_name(e.variable_name())}, atomic};
    case Operation::add:
      return {{{e.left(), in_sum}, "<mo>+</mo>", {e.right(), in_product}}, in_sum};
    case Operation::subtract:
      return {{{e.left(), in_sum}, "<mo>−</mo>", {e.right(), in_product}}, in_sum};
    case Operation::negate:
      return {{"<mrow><mo>−</mo>", {e.left(), in_product}, "</mrow>"}, in_product};
    case Operation::multiply:
    case Operation::multiply_or_zero: {
      if (is_quotient_or_zero(e)) return write_mathml_quotient(e.left(), e.right().right());
      // a thin space around the invisible times; a dot between numbers
      const char* const times = starts_with_number(e.right()) ? "<mo>·</mo>" : "<mo lspace=\"0.16em\" rspace=\"0\">&#x2062;</mo>";
      return {{{e.left(), in_product}, times, {e.right(), starts_with_minus(e.right()) ? in_power : in_product}}, in_product};
    }
    case Operation::divide:
      return write_mathml_quotient(e.left(), e.right());
    case Operation::power:
      return {{"<msup><mrow>", {e.left(), atomic}, "</mrow><mrow>", {e.right(), in_sum}, "</mrow></msup>"}, in_power};
    case Operation::sqrt:
      return {{"<msqrt>", {e.left(), in_sum}, "</msqrt>"}, atomic};
    case Operation::abs:
      return {{"<mrow><mo>|</mo>", {e.left(), in_sum}, "<mo>|</mo></mrow>"}, atomic};
    default:
      break;
  }
  const internal::Function& function = *internal::find_function(e.operation());
  const std::string open = fmt::format("<mrow><mi>{}</mi><mo>&#x2061;</mo>{}", function.text, mathml_open);
  const std::string close = std::string(mathml_close) + "</mrow>";
  if (!internal::is_binary(e.operation())) return {{open, {e.left(), in_sum}, close}, atomic};
  return {{open, {e.left(), in_sum}, "<mo>,</mo>", {e.right(), in_sum}, close}, atomic};
}

Written write_quotient(Expression a, Expression b, bool in_latex) {
  if (in_latex) return {{"\\frac{", {a, in_sum}, "}{", {b, in_sum}, "}"}, in_product};
  return {{{a, in_product}, "/", {b, in_power}}, in_product};
}

/// e in terms of its operands.
Written write(Expression e, Notation notation) {
  if (notation == Notation::mathml) return write_mathml(e);
  const bool latex = notation == Notation::latex;
  const Operation operation = e.operation();
  switch (operation) {
    case Operation::constant:
      return write_number(e.constant_value(), notation);
    case Operation::variable:
      return {{latex ? latex_name(e.variable_name()) : e.variable_name()}, atomic};
    // left-associative: a right operand of the same kind needs parentheses
    case Operation::add:
      return {{{e.left(), in_sum}, " + ", {e.right(), in_product}}, in_sum};
    case Operation::subtract:
      return {{{e.left(), in_sum}, " - ", {e.right(), in_product}}, in_sum};
    case Operation::negate:
      return {{"-", {e.left(), starts_with_zero(e.left()) ? in_power : in_product}}, in_product};
    case Operation::multiply_or_zero:
      if (is_quotient_or_zero(e)) return write_quotient(e.left(), e.right().right(), latex);
      [[fallthrough]];
    case Operation::multiply: {
      const char* const times = !latex ? "*" : starts_with_number(e.right()) ? " \\cdot " : " \\, ";
      // c*u*v reads back as c·(u·v), and in LaTeX no one asks which product came first
      const bool plain_chain = latex ? !starts_with_minus(e.right()) : e.left().is_constant() && continues_product(e.right());
      return {{{e.left(), in_product}, times, {e.right(), plain_chain ? in_product : in_power}}, in_product};
    }
    case Operation::divide:
      return write_quotient(e.left(), e.right(), latex);
    case Operation::power:
      if (latex) return {{{e.left(), atomic}, "^{", {e.right(), in_sum}, "}"}, in_power};
      return {{{e.left(), atomic}, "^", {e.right(), in_power}}, in_power};
    case Operation::sqrt:
      if (latex) return {{"\\sqrt{", {e.left(), in_sum}, "}"}, atomic};
      break;
    case Operation::abs:
      if (latex) return {{"\\left|", {e.left(), in_sum}, "\\right|"}, atomic};
      break;
    default:
      break;
  }

  // the rest are functions
  const internal::Function& function = *internal::find_function(operation);
  std::vector<Piece> pieces{std::string(latex ? function.latex : function.text), latex ? "\\left(" : "(", {e.left(), in_sum}};
  if (internal::is_binary(operation)) {
    pieces.emplace_back(", ");
    pieces.emplace_back(e.right(), in_sum);
  }
  pieces.emplace_back(latex ? "\\right)" : ")");
  return {std::move(pieces), atomic};
}

}  // namespace

std::string to_string(Expression e, Notation notation) {
  const bool mathml = notation == Notation::mathml;
  const char* const open = mathml ? mathml_open : notation == Notation::latex ? "\\left(" : "(";
  const char* const close = mathml ? mathml_close : notation == Notation::latex ? "\\right)" : ")";
  std::string text;
  // what is still to be written, the next piece last: no recursion, so that depth costs no stack
  std::vector<Piece> rest{{e, in_sum}};
  while (!rest.empty()) {
    const Piece piece = std::move(rest.back());
    rest.pop_back();
    if (!piece.expression) {
      text += piece.text;
      if (text.size() > max_written_length) {
        throw InputError(
            fmt::format("expressions: written out, this one has more than {} characters; print its parts", max_written_length));
      }
      continue;
    }
    Written written = write(*piece.expression, notation);
    const bool parentheses = written.binding < piece.binding;
    if (parentheses) rest.emplace_back(close);
    std::move(written.pieces.rbegin(), written.pieces.rend(), std::back_inserter(rest));
    if (parentheses) rest.emplace_back(open);
  }
  return text;
}

}  // namespace gp2
