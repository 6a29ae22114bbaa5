#include <algorithm>
#include <array>
#include <charconv>
#include <iterator>
#include <numbers>
#include <utility>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "gp2/expression.hpp"
#include "symbolic/functions.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {

namespace {

constexpr std::size_t max_length = std::size_t{1} << 24;  // characters

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

/// The shortest digits that read back as `value`, whatever the locale.
std::string shortest(double value) {
  std::array<char, 32> buffer;
  const auto [end, error] = std::to_chars(buffer.data(), buffer.data() + buffer.size(), value);
  return {buffer.data(), end};
}

Written write_number(double value, Notation notation) {
  if (notation != Notation::c && std::abs(value) == std::numbers::pi) {
    return {{value < 0 ? "-" : "", notation == Notation::latex ? "\\pi" : "pi"}, value < 0 ? in_product : atomic};
  }
  std::string digits = shortest(value);
  const std::size_t exponent = digits.find('e');
  Binding binding = value < 0 ? in_product : atomic;
  if (notation == Notation::latex && exponent != std::string::npos) {
    const int power_of_ten = std::stoi(digits.substr(exponent + 1));
    digits = fmt::format("{} \\cdot 10^{{{}}}", digits.substr(0, exponent), power_of_ten);
    binding = in_product;
  } else if (notation == Notation::c && digits.find_first_of(".e") == std::string::npos) {
    digits += ".0";  // else 1/2 would be a division of integers
  }
  return {{digits}, binding};
}

/// "theta" → "\theta"; a single letter as it is; nothing for other words.
std::optional<std::string> latex_symbol(std::string_view word) {
  static constexpr std::array greek{"alpha", "beta",   "gamma",   "delta", "epsilon", "zeta",  "eta",   "theta",  "iota",
                                    "kappa", "lambda", "mu",      "nu",    "xi",      "rho",   "sigma", "tau",    "upsilon",
                                    "phi",   "chi",    "psi",     "omega", "Gamma",   "Delta", "Theta", "Lambda", "Xi",
                                    "Pi",    "Sigma",  "Upsilon", "Phi",   "Psi",     "Omega"};
  if (word.size() == 1 && word != "_") return std::string(word);
  if (std::find(greek.begin(), greek.end(), word) != greek.end()) return fmt::format("\\{}", word);
  return std::nullopt;
}

/// q1 → q_{1}, dq1 → \dot{q}_{1}, ddq1 → \ddot{q}_{1}, theta → \theta, mass_rod → \mathrm{mass\_rod}.
std::string latex_name(std::string_view name) {
  const std::size_t word_end = name.find_last_not_of("0123456789") + 1;
  std::string_view word = name.substr(0, word_end);
  const std::string index = word_end < name.size() ? fmt::format("_{{{}}}", name.substr(word_end)) : "";
  if (word.size() > 1 && word.ends_with('_') && !index.empty()) word.remove_suffix(1);

  if (const auto symbol = latex_symbol(word)) return *symbol + index;
  if (word.starts_with("dd")) {
    if (const auto symbol = latex_symbol(word.substr(2))) return fmt::format("\\ddot{{{}}}{}", *symbol, index);
  }
  if (word.starts_with('d')) {
    if (const auto symbol = latex_symbol(word.substr(1))) return fmt::format("\\dot{{{}}}{}", *symbol, index);
  }
  std::string escaped;
  for (const char c : word) escaped += c == '_' ? std::string("\\_") : std::string(1, c);
  return fmt::format("\\mathrm{{{}}}{}", escaped, index);
}

/// Whether the LaTeX of a product starting with e starts with a digit.
bool starts_with_number(Expression e) {
  while (e.operation() == Operation::multiply || e.operation() == Operation::multiply_or_zero ||
         e.operation() == Operation::power) {
    e = e.left();
  }
  return e.is_constant();
}

/// Whether c*e, written without parentheses, reads back to c·e: e = u·v·… whose first factor is neither a quotient nor a number.
bool continues_product(Expression e) {
  if (e.operation() != Operation::multiply) return false;
  while (e.operation() == Operation::multiply) e = e.left();
  return e.operation() != Operation::divide && !e.is_constant();
}

/// e in terms of its operands.
Written write(Expression e, Notation notation) {
  const bool latex = notation == Notation::latex;
  const bool c = notation == Notation::c;
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
      return {{"-", {e.left(), in_product}}, in_product};
    case Operation::multiply_or_zero:
      if (c) {
        return {{"(", {e.left(), in_sum}, " == 0.0 ? 0.0 : ", {e.left(), in_product}, "*", {e.right(), in_power}, ")"}, atomic};
      }
      [[fallthrough]];
    case Operation::multiply: {
      const char* const times = !latex ? "*" : starts_with_number(e.right()) ? " \\cdot " : " \\, ";
      // c*u*v reads back as c·(u·v), and in LaTeX no one asks which product came first; C computes from the left
      const bool plain_chain = latex || (!c && e.left().is_constant() && continues_product(e.right()));
      return {{{e.left(), in_product}, times, {e.right(), plain_chain ? in_product : in_power}}, in_product};
    }
    case Operation::divide:
      if (latex) return {{"\\frac{", {e.left(), in_sum}, "}{", {e.right(), in_sum}, "}"}, in_product};
      return {{{e.left(), in_product}, "/", {e.right(), in_power}}, in_product};
    case Operation::power:
      if (c) {
        // as the tape computes it
        const bool short_base = e.left().operation() == Operation::variable;
        if (short_base && e.right().is_constant(2)) return {{{e.left(), atomic}, "*", {e.left(), atomic}}, in_product};
        if (short_base && e.right().is_constant(3)) {
          return {{{e.left(), atomic}, "*", {e.left(), atomic}, "*", {e.left(), atomic}}, in_product};
        }
        return {{"pow(", {e.left(), in_sum}, ", ", {e.right(), in_sum}, ")"}, atomic};
      }
      if (latex) return {{{e.left(), atomic}, "^{", {e.right(), in_sum}, "}"}, in_power};
      return {{{e.left(), atomic}, "^", {e.right(), in_power}}, in_power};
    case Operation::sqrt:
      if (latex) return {{"\\sqrt{", {e.left(), in_sum}, "}"}, atomic};
      break;
    case Operation::abs:
      if (latex) return {{"\\left|", {e.left(), in_sum}, "\\right|"}, atomic};
      break;
    case Operation::sign:
      // the cast: two signs would be divided as integers
      if (c) return {{"(double)((", {e.left(), in_sum}, " > 0.0) - (", {e.left(), in_sum}, " < 0.0))"}, atomic};
      break;
    default:
      break;
  }

  // the rest are functions
  const internal::Function& function = *internal::find_function(operation);
  std::vector<Piece> pieces{std::string(latex ? function.latex
                                        : c   ? function.c
                                              : function.text),
                            latex ? "\\left(" : "(",
                            {e.left(), in_sum}};
  if (internal::is_binary(operation)) {
    pieces.emplace_back(", ");
    pieces.emplace_back(e.right(), in_sum);
  }
  pieces.emplace_back(latex ? "\\right)" : ")");
  return {std::move(pieces), atomic};
}

}  // namespace

std::string to_string(Expression e, Notation notation) {
  const char* const open = notation == Notation::latex ? "\\left(" : "(";
  const char* const close = notation == Notation::latex ? "\\right)" : ")";
  std::string text;
  // what is still to be written, the next piece last: no recursion, so that depth costs no stack
  std::vector<Piece> rest{{e, in_sum}};
  while (!rest.empty()) {
    const Piece piece = std::move(rest.back());
    rest.pop_back();
    if (!piece.expression) {
      text += piece.text;
      if (text.size() > max_length) {
        throw InputError(
            fmt::format("expressions: written out, this one has more than {} characters; print its parts", max_length));
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
