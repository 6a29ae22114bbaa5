#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <functional>
#include <map>
#include <numbers>
#include <numeric>
#include <optional>
#include <set>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include "base/suggestion.hpp"
#include "gp2/error.hpp"
#include "gp2/symbolic/expression.hpp"
#include "symbolic/functions.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {

using internal::find_function;
using internal::Function;
using internal::functions;

namespace {

constexpr std::size_t max_text_length = 65536;
constexpr int max_depth = 200;

// not <cctype>: these do not depend on the locale
bool is_digit(char c) { return c >= '0' && c <= '9'; }
bool is_letter(char c) { return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '_'; }
bool is_space(char c) { return c == ' ' || c == '\t' || c == '\n' || c == '\r'; }

template <class Names>
std::string joined(const Names& names, std::string_view separator) {
  std::string text;
  for (const std::string_view name : names) text.append(text.empty() ? "" : separator).append(name);
  return text;
}

// Ids of expressions.
using Parts = std::set<std::uint32_t>;

// Adds to `seen` what a product, and with `of_sum` a sum of products, is made of: all operands on the way down to its factors, but
// for numbers. Those that are new are visited.
void parts_of(Expression e, bool of_sum, Parts& seen, const std::function<void(Expression)>& visit = nullptr) {
  const std::size_t n_before = seen.size();
  std::vector<Expression> open = {e};
  while (!open.empty()) {
    const Expression part = open.back();
    open.pop_back();
    if (part.is_constant() || !seen.insert(part.id()).second) continue;
    if (visit) visit(part);
    const Operation operation = part.operation();
    const bool has_two = operation == Operation::multiply || (of_sum && operation == Operation::add);
    if (has_two || operation == Operation::divide || operation == Operation::negate) open.push_back(part.left());
    if (has_two) open.push_back(part.right());
  }
  internal::StepLimit::count(seen.size() - n_before);
}

// The components g of lengths |g| or √(g² + …) among the factors of a divisor, each with its own factors: which of them are
// parameters is not known here.
Parts components_in(Expression divisor) {
  Parts components, factors, terms;
  parts_of(divisor, /*of_sum=*/false, factors, [&](Expression length) {
    if (length.operation() == Operation::abs) parts_of(length.left(), /*of_sum=*/false, components);
    if (length.operation() != Operation::sqrt) return;
    parts_of(length.left(), /*of_sum=*/true, terms, [&](Expression e) {
      const bool is_square = (e.operation() == Operation::power && e.right().is_constant(2)) ||
                             (e.operation() == Operation::multiply && e.left() == e.right());
      if (is_square) parts_of(e.left(), /*of_sum=*/false, components);
    });
  });
  return components;
}

/// Recursive descent, one function per rule of the grammar:
///
///     sum     = product { ("+" | "-") product }
///     product = factor { ("*" | "/") factor }
///     factor  = ("-" | "+") factor | power
///     power   = atom [ "^" factor ]
///     atom    = number | symbol | function "(" sum { "," sum } ")" | quantity | multiplier | "(" sum ")"
///     quantity = symbol "(" name in quotes { "," number } ")" "." symbol
///     multiplier = ("lambda0" | "lambda") "(" (number | word) ")"
class Parser {
 public:
  Parser(std::string_view text, ExpressionGraph& graph, const std::function<std::optional<Expression>(std::string_view)>& resolve,
         std::span<const std::string> known_names)
      : text_(text), graph_(graph), resolve_(resolve), known_names_(known_names) {}

  Expression parse() {
    require_length();
    skip_space();
    if (at_end()) fail(0, "the expression is empty; write a number, a symbol or a formula such as 2*q1");
    const Expression result = sum();
    if (!at_end()) fail_after_operand();
    return result;
  }

  /// a ≤ b is min(1, 1 + sign(b − a)), and a < b is max(0, sign(b − a)): exactly 0 or 1, without a derivative.
  Expression parse_condition() {
    require_length();
    skip_space();
    if (at_end()) fail(0, "the condition is empty; write a comparison such as gap <= 0");
    const Expression left = sum();
    if (peek() != '<' && peek() != '>') {
      if (!at_end() && peek() != '=') fail_after_operand();
      fail(position_, fmt::format("found {} where one of < <= > >= must stand: a condition compares two expressions, as gap <= 0",
                                  peek() == '=' ? "'='" : found()));
    }
    const bool is_less = text_[position_++] == '<';
    const bool or_equal = peek() == '=';
    if (or_equal) ++position_;
    skip_space();
    const Expression right = sum();
    if (!at_end()) {
      if (peek() == '<' || peek() == '>') fail(position_, "a condition is one comparison: combine several by min and max");
      fail_after_operand();
    }
    const Expression sign = graph_.apply(Operation::sign, is_less ? right - left : left - right);
    const Expression one = graph_.constant(1);
    return or_equal ? graph_.apply(Operation::min, one, one + sign) : graph_.apply(Operation::max, graph_.constant(0), sign);
  }

 private:
  void require_length() const {
    if (text_.size() <= max_text_length) return;
    throw InputError(fmt::format("the expression has {} characters, at most {} are allowed; give its parts names of their own",
                                 text_.size(), max_text_length));
  }

  /// Refuses the text when it nests too deep; lives as long as one level.
  class Level {
   public:
    explicit Level(Parser& parser) : depth_(parser.depth_) {
      if (++depth_ > max_depth) {
        parser.fail(parser.position_,
                    fmt::format("parentheses, functions, signs and powers are nested deeper than {}; give inner "
                                "parts names of their own",
                                max_depth));
      }
    }
    ~Level() { --depth_; }
    Level(const Level&) = delete;
    Level& operator=(const Level&) = delete;

   private:
    int& depth_;
  };

  Expression sum() {
    Expression result = product();
    while (peek() == '+' || peek() == '-') {
      const char sign = take();
      const Expression right = product();
      result = sign == '+' ? result + right : result - right;
    }
    return result;
  }

  Expression product() {
    Expression result = factor();
    Parts parts;  // of the result, as far as it was looked at
    while (peek() == '*' || peek() == '/') {
      if (text_.substr(position_, 2) == "**") fail(position_, "found '**'; a power is written ^");
      const char sign = take();
      const Expression right = factor();
      result = sign == '*' ? result * right : quotient(result, right, parts);
    }
    return result;
  }

  /// A component over its length jumps where both are 0, and is 0 there as sign(0) is, the mean of all directions.
  /// @param parts  those of `a` that were looked at, so that a long product is looked at once
  Expression quotient(Expression a, Expression b, Parts& parts) {
    const auto [found, is_new] = components_.try_emplace(b.id());
    if (is_new) found->second = components_in(b);
    const Parts& components = found->second;
    if (components.empty()) return a / b;
    parts_of(a, /*of_sum=*/false, parts);
    internal::StepLimit::count(components.size());
    const auto is_part = [&](std::uint32_t id) { return parts.count(id) > 0; };
    if (std::none_of(components.begin(), components.end(), is_part)) return a / b;
    parts.clear();
    // a sign in the denominator would rise out of 1/b
    if (b.operation() == Operation::negate) a = -a, b = b.left();
    return graph_.apply(Operation::multiply_or_zero, a, graph_.constant(1) / b);
  }

  Expression factor() {
    if (peek() != '-' && peek() != '+') return power();
    const Level level(*this);
    const char sign = take();
    const Expression operand = factor();
    return sign == '-' ? -operand : operand;
  }

  Expression power() {
    const Expression base = atom();
    if (peek() != '^') return base;
    const Level level(*this);
    take();
    return graph_.apply(Operation::power, base, factor());
  }

  Expression atom() {
    const char c = peek();
    if (is_digit(c) || c == '.') return number();
    if (is_letter(c)) return symbol_or_call();
    if (c != '(') {
      fail(position_, fmt::format("found {} where a number, a symbol, a function or '(' must stand", found()));
    }
    const Level level(*this);
    const std::size_t open = position_;
    take();
    const Expression inside = sum();
    close(open);
    return inside;
  }

  Expression number() {
    const std::size_t start = position_;
    double value = 0;
    const auto [end, error] = std::from_chars(text_.data() + start, text_.data() + text_.size(), value);
    if (error == std::errc::invalid_argument) fail(start, "found '.' without digits; a number is written as 2, 0.5, .5 or 1e-3");
    position_ = static_cast<std::size_t>(end - text_.data());
    const std::string_view written = text_.substr(start, position_ - start);
    if (error == std::errc::result_out_of_range) {
      fail(start, fmt::format("the number {} does not fit a double (2.2e-308 to 1.8e308 in size)", shortened(written, 40)));
    }
    if (position_ < text_.size() && text_[position_] == '.') {
      fail(position_, fmt::format("found a second '.' in the number {}.; write one decimal point", shortened(written, 40)));
    }
    // 2q1, 2(q1 + 1): the most common slip
    if (position_ < text_.size() && (is_letter(text_[position_]) || text_[position_] == '(')) {
      std::size_t stop = position_ + 1;
      while (stop < text_.size() && (is_letter(text_[stop]) || is_digit(text_[stop]))) ++stop;
      const std::string right =
          text_[position_] == '(' ? std::string("(...)") : shortened(text_.substr(position_, stop - position_), 40);
      fail(position_, fmt::format("found '{}' right after a number; a product needs its sign, write {}*{}", right,
                                  shortened(written, 40), right));
    }
    skip_space();
    return graph_.constant(value);
  }

  // letters and digits, and the space behind them
  std::string_view word() {
    const std::size_t start = position_;
    while (position_ < text_.size() && (is_letter(text_[position_]) || is_digit(text_[position_]))) ++position_;
    const std::string_view found = text_.substr(start, position_ - start);
    skip_space();
    return found;
  }

  Expression symbol_or_call() {
    const std::size_t start = position_;
    const std::string_view name = word();
    if (name == "lambda0" || (name == "lambda" && peek() == '(')) return multiplier(name, start);
    if (peek() == '(') {
      const std::size_t inside = text_.find_first_not_of(" \t\n\r", position_ + 1);
      if (inside != std::string_view::npos && (text_[inside] == '"' || text_[inside] == '\'')) return quantity(name, start);
      return call(name, start);
    }

    if (name == "pi") return graph_.constant(std::numbers::pi);
    if (const auto resolved = resolve_(name)) return *resolved;
    if (find_function(name) != nullptr) fail(start, fmt::format("the function '{}' has no argument; write {}(...)", name, name));
    std::string mend = suggestion(name, known_names_);
    if (mend.empty()) mend = "; known here: " + (known_names_.empty() ? "none" : joined(known_names_, ", "));
    fail(start, fmt::format("unknown symbol '{}'{}", shortened(name, 40), mend));
  }

  /// A symbol that is no single word, such as site("tip").z or point("link7", 0, 0, 0.1).x, resolved by its text with double
  /// quotes and one space after each comma.
  Expression quantity(std::string_view kind, std::size_t start) {
    const Level level(*this);
    const std::size_t open = position_;
    take();
    const char quote = text_[position_];
    const std::size_t end = text_.find(quote, position_ + 1);
    if (end == std::string_view::npos) fail(position_, "this name in quotes does not end");
    std::string symbol = fmt::format("{}(\"{}\"", kind, text_.substr(position_ + 1, end - position_ - 1));
    position_ = end + 1;
    skip_space();
    while (peek() == ',') {
      take();
      const std::size_t number_start = position_;
      const Expression value = factor();
      if (!value.is_constant()) fail(number_start, fmt::format("what follows the name in {}(...) must be numbers", kind));
      symbol += fmt::format(", {}", value.constant_value());
    }
    close(open);
    if (peek() != '.') fail(position_, fmt::format("found {} where a component must stand, as in {}).x", found(), symbol));
    ++position_;
    symbol += fmt::format(").{}", word());
    std::optional<Expression> resolved;
    try {
      resolved = resolve_(symbol);
    } catch (const InputError& error) {
      fail(start, error.what());
    }
    if (!resolved) {
      fail(start, fmt::format("unknown symbol '{}'; a model with a robot has the points site(\"NAME\").x, body(\"NAME\").x and "
                              "point(\"BODY\", 0, 0, 0.1).x",
                              shortened(symbol, 40)));
    }
    return *resolved;
  }

  /// lambda0(1), lambda(1) or lambda(wall), a symbol that is resolved by its text without spaces.
  Expression multiplier(std::string_view name, std::size_t start) {
    constexpr double most = 1e6;
    const std::size_t open = position_;
    std::string row;
    if (peek() == '(') {
      take();
      if (is_letter(peek())) {
        row = word();
      } else if (const Expression number = factor(); number.is_constant()) {
        const double value = number.constant_value();
        if (value >= 1 && value <= most && value == std::floor(value)) row = fmt::format("{}", static_cast<int>(value));
      }
    }
    if (row.empty()) {
      fail(start,
           fmt::format("{0} takes the number of a row of the constraints, counted from 1, or its name; write {0}(1)", name));
    }
    close(open);
    const auto resolved = resolve_(fmt::format("{}({})", name, row));
    if (!resolved)
      fail(start, fmt::format("{} is a multiplier of the constraints of a model, of which there is none here", name));
    return *resolved;
  }

  Expression call(std::string_view name, std::size_t start) {
    const Level level(*this);
    const Function* const function = find_function(name);
    if (function == nullptr) {
      if (name == "pi" || resolve_(name)) {
        fail(position_, fmt::format("found '(' right after '{}', which is not a function; a product is written {}*(...)",
                                    shortened(name, 40), shortened(name, 40)));
      }
      const std::string_view kind = name.substr(std::min(name.find_first_not_of('d'), name.size()));
      if (kind == "site" || kind == "body" || kind == "point") {
        fail(start, fmt::format("the name in {0}(...) stands in quotes: write '{0}(\"NAME\"{1}).x'", name,
                                kind == "point" ? ", 0, 0, 0.1" : ""));
      }
      std::vector<std::string_view> names;
      for (const Function& known : functions) names.push_back(known.text);
      const std::string mend = suggestion(name, names);
      fail(start, fmt::format("unknown function '{}'{} Functions are {}", shortened(name, 40), mend.empty() ? "." : mend,
                              joined(names, " ")));
    }

    const std::size_t open = position_;
    take();
    std::vector<Expression> arguments;
    if (peek() != ')') {
      arguments.push_back(sum());
      while (peek() == ',') {
        take();
        arguments.push_back(sum());
      }
    }
    close(open);

    const auto require = [&](bool right_count, std::string_view takes) {
      if (!right_count) fail(start, fmt::format("{} takes {}, got {}", name, takes, arguments.size()));
    };
    switch (function->operation) {
      case Operation::atan2:
        require(arguments.size() == 2, "2 arguments");
        return graph_.apply(Operation::atan2, arguments[0], arguments[1]);
      case Operation::min:
      case Operation::max:
        require(arguments.size() >= 2, "2 or more arguments");
        return std::accumulate(arguments.begin() + 1, arguments.end(), arguments[0],
                               [&](Expression a, Expression b) { return graph_.apply(function->operation, a, b); });
      default:
        require(arguments.size() == 1, "1 argument");
        return graph_.apply(function->operation, arguments[0]);
    }
  }

  void close(std::size_t open) {
    if (peek() != ')') {
      if (!at_end() && peek() != ',') fail_if_no_operator();
      fail(position_, fmt::format("found {} where ')' must close the '(' of column {}", found(), column(open)));
    }
    take();
  }

  [[noreturn]] void fail_after_operand() {
    if (peek() == ')') fail(position_, "found ')' without a '(' before it; remove it or add the '('");
    if (peek() == ',') fail(position_, "found ',' outside a function; write one expression, with '.' as the decimal point");
    fail_if_no_operator();
    fail(position_, fmt::format("found {} where an operator + - * / ^ or the end must stand", found()));
  }

  void fail_if_no_operator() {
    if (is_letter(peek()) || is_digit(peek()) || peek() == '.' || peek() == '(') {
      fail(position_, fmt::format("found {} where an operator must stand; a product is written with *", found()));
    }
  }

  /// What stands at the position, in words. A character no expression can hold is an error of its own.
  std::string found() {
    if (at_end()) return "the end of the text";
    const auto byte = static_cast<unsigned char>(text_[position_]);
    if (is_letter(peek()) || is_digit(peek())) {
      std::size_t stop = position_;
      while (stop < text_.size() && (is_letter(text_[stop]) || is_digit(text_[stop]))) ++stop;
      return fmt::format("'{}'", shortened(text_.substr(position_, stop - position_), 40));
    }
    constexpr std::string_view known = "+-*/^().,";
    if (known.find(peek()) != std::string_view::npos) return fmt::format("'{}'", peek());
    if (peek() == '=') fail(position_, "found '='; write an equation left = right as the expression left - (right)");
    if (peek() == '<' || peek() == '>') {
      fail(position_,
           fmt::format("found '{}'; an expression has no comparison: a constraint that comes and goes is the equation that "
                       "holds while there is contact, with when = \"gap <= 0\" beside it",
                       peek()));
    }
    if (peek() == '[' || peek() == '{') fail(position_, fmt::format("found '{}'; group with ( )", peek()));
    constexpr std::string_view allowed = "allowed are letters a-z A-Z, digits, _ and + - * / ^ ( ) , .";
    if (byte >= 0x80) {
      // one UTF-8 character: its first byte and those that continue it
      std::size_t stop = position_ + 1;
      while (stop < text_.size() && (static_cast<unsigned char>(text_[stop]) & 0xC0U) == 0x80U && stop < position_ + 4) ++stop;
      const std::string_view character = text_.substr(position_, stop - position_);
      if (character == "²" || character == "³") {
        fail(position_, fmt::format("found '{}'; a power is written ^{}", character, character == "²" ? 2 : 3));
      }
      fail(position_, byte >= 0xC2 && stop > position_ + 1
                          ? fmt::format("character '{}' has no meaning here; {}", character, allowed)
                          : fmt::format("byte 0x{:02X} is not UTF-8 text; {}", byte, allowed));
    }
    if (byte < 0x20 || byte == 0x7F)
      fail(position_, fmt::format("control character 0x{:02X} has no meaning here; {}", byte, allowed));
    fail(position_, fmt::format("character '{}' has no meaning here; {}", peek(), allowed));
  }

  /// Columns count characters, not bytes.
  [[nodiscard]] std::size_t column(std::size_t position) const {
    return 1 + static_cast<std::size_t>(std::count_if(text_.begin(), text_.begin() + static_cast<std::ptrdiff_t>(position),
                                                      [](char c) { return (static_cast<unsigned char>(c) & 0xC0U) != 0x80U; }));
  }

  [[noreturn]] void fail(std::size_t position, const std::string& message) const {
    throw InputError(fmt::format("column {}: {}", column(position), message));
  }

  [[nodiscard]] bool at_end() const { return position_ >= text_.size(); }
  [[nodiscard]] char peek() const { return at_end() ? '\0' : text_[position_]; }
  void skip_space() {
    while (!at_end() && is_space(text_[position_])) ++position_;
  }
  char take() {
    const char c = text_[position_++];
    skip_space();
    return c;
  }

  std::string_view text_;
  ExpressionGraph& graph_;
  const std::function<std::optional<Expression>(std::string_view)>& resolve_;
  std::span<const std::string> known_names_;
  std::size_t position_ = 0;
  int depth_ = 0;
  std::map<std::uint32_t, Parts> components_;  // in divisors, by their ids
};

}  // namespace

Expression parse_expression(std::string_view text, ExpressionGraph& graph,
                            const std::function<std::optional<Expression>(std::string_view)>& resolve,
                            std::span<const std::string> known_names) {
  return Parser(text, graph, resolve, known_names).parse();
}

Expression parse_condition(std::string_view text, ExpressionGraph& graph,
                           const std::function<std::optional<Expression>(std::string_view)>& resolve,
                           std::span<const std::string> known_names) {
  return Parser(text, graph, resolve, known_names).parse_condition();
}

}  // namespace gp2
