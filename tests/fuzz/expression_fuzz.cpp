// Lines of text: the k-th is an expression that may use those before it, by the names e1 … e(k−1).

#include <bit>
#include <cmath>
#include <map>
#include <optional>
#include <string>
#include <unordered_map>
#include <vector>

#include <fmt/format.h>

#include "fuzz/fuzz.hpp"
#include "gp2/symbolic/expression.hpp"
#include "symbolic/graph.hpp"

using gp2::Expression;
using gp2::ExpressionGraph;
using gp2::Operation;
using gp2::test::accepts;
using gp2::test::require;

namespace {

const std::vector<std::string> variable_names = {"q1", "q2", "dq1", "t", "m"};

/// The value of an expression as its definition says, operand by operand.
/// Integer powers take the library's own product: std::pow rounds otherwise.
class DirectEvaluation {
 public:
  explicit DirectEvaluation(const std::map<std::string, double>& values) : values_(values) {}

  double operator()(Expression e) {
    if (const auto known = known_.find(e.id()); known != known_.end()) return known->second;
    return known_[e.id()] = compute(e);
  }

 private:
  double compute(Expression e) {
    switch (e.operation()) {
      case Operation::constant:
        return e.constant_value();
      case Operation::variable:
        return values_.at(e.variable_name());
      default:
        break;
    }
    const double a = (*this)(e.left());
    switch (e.operation()) {
      case Operation::negate:
        return -a;
      case Operation::sin:
        return std::sin(a);
      case Operation::cos:
        return std::cos(a);
      case Operation::tan:
        return std::tan(a);
      case Operation::asin:
        return std::asin(a);
      case Operation::acos:
        return std::acos(a);
      case Operation::atan:
        return std::atan(a);
      case Operation::sinh:
        return std::sinh(a);
      case Operation::cosh:
        return std::cosh(a);
      case Operation::tanh:
        return std::tanh(a);
      case Operation::exp:
        return std::exp(a);
      case Operation::log:
        return std::log(a);
      case Operation::sqrt:
        return std::sqrt(a);
      case Operation::abs:
        return std::fabs(a);
      case Operation::sign:
        return a > 0 ? 1 : a < 0 ? -1 : a;
      default:
        break;
    }
    const double b = (*this)(e.right());
    switch (e.operation()) {
      case Operation::add:
        return a + b;
      case Operation::subtract:
        return a - b;
      case Operation::multiply:
        return a * b;
      case Operation::divide:
        return a / b;
      case Operation::power:
        return power(a, b, e.right().is_constant());
      case Operation::atan2:
        return std::atan2(a, b);
      case Operation::min:
        return std::isnan(a) || a < b ? a : b;
      case Operation::max:
        return std::isnan(a) || a > b ? a : b;
      case Operation::multiply_or_zero:
        return std::abs(a) < 1e-100 ? 0 : a * b;
      default:
        require(false, "every operation has a meaning");
        return 0;
    }
  }

  static double power(double a, double b, bool constant_exponent) {
    const std::optional<int> n = constant_exponent ? gp2::internal::small_integer(b) : std::nullopt;
    if (!n) return std::pow(a, b);
    double value = 0;
    gp2::internal::integer_power(*n, 1, &a, &value);
    return value;
  }

  const std::map<std::string, double>& values_;
  std::unordered_map<std::uint32_t, double> known_;
};

// equal to a zero's sign, which a division turns into that of an infinity
bool same(double a, double b) { return (a == b && std::signbit(a) == std::signbit(b)) || (std::isnan(a) && std::isnan(b)); }

void compare_with_tape(const std::vector<Expression>& outputs, const std::vector<Expression>& inputs) {
  const gp2::Tape tape(outputs, inputs);
  // inside, at the edge and outside of where functions are defined
  Eigen::MatrixXd points(5, 4);
  points << 0.3, 0, -1.5, 1e200,  //
      -0.7, 0, 2, -3,             //
      1.1, 0, -1, 1e-300,         //
      0.5, 0, 3, 0,               //
      2, 1, -4, 0.5;
  Eigen::MatrixXd results;
  tape.evaluate(points, Eigen::VectorXd(), results);
  Eigen::VectorXd workspace = tape.make_workspace(Eigen::VectorXd());
  Eigen::VectorXd single(tape.n_outputs());
  for (Eigen::Index point = 0; point < points.cols(); ++point) {
    std::map<std::string, double> values;
    for (std::size_t k = 0; k < inputs.size(); ++k) {
      values[variable_names[k]] = points(static_cast<Eigen::Index>(k), point);
    }
    DirectEvaluation direct(values);
    tape.evaluate_at(points.col(point), workspace, single);
    for (std::size_t k = 0; k < outputs.size(); ++k) {
      const auto row = static_cast<Eigen::Index>(k);
      require(same(results(row, point), direct(outputs[k])), "the tape computes what the expression says");
      require(same(single[row], results(row, point)), "one point at a time is as many at once");
    }
  }
}

bool has_guard(Expression e, std::unordered_map<std::uint32_t, bool>& known) {
  if (gp2::internal::is_leaf(e.operation())) return false;
  if (const auto found = known.find(e.id()); found != known.end()) return found->second;
  bool guard = e.operation() == Operation::multiply_or_zero || has_guard(e.left(), known);
  if (gp2::internal::is_binary(e.operation())) guard = has_guard(e.right(), known) || guard;
  return known[e.id()] = guard;
}

constexpr double enough = 1000;  // operations to write out

void read_back(Expression e, ExpressionGraph& graph) {
  if (graph.size_of(e).written > enough) return;
  static_cast<void>(to_string(e, gp2::Notation::latex));
  static_cast<void>(to_string(e, gp2::Notation::mathml));
  // a guard prints as a product
  std::unordered_map<std::uint32_t, bool> known;
  if (has_guard(e, known)) return;
  const std::string text = to_string(e);
  std::optional<Expression> again;
  // the text may nest deeper than a reader goes
  accepts([&] { again = parse_expression(text, graph, [&](std::string_view name) { return graph.variable(name); }, {}); });
  // and what is x/|x| of a derivative reads back as one
  if (again && !has_guard(*again, known)) require(*again == e, "what is printed reads back to the same expression");
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  std::string_view text = gp2::test::text_of(data, size);
  if (size > 4096) return -1;
  ExpressionGraph graph;
  std::map<std::string, Expression, std::less<>> symbols;
  std::vector<Expression> variables;
  for (const std::string& name : variable_names) variables.push_back(symbols[name] = graph.variable(name));
  const auto resolve = [&](std::string_view name) {
    const auto found = symbols.find(name);
    return found == symbols.end() ? std::optional<Expression>() : found->second;
  };

  std::vector<Expression> outputs;
  while (!text.empty()) {
    const std::string_view line = text.substr(0, text.find('\n'));
    text.remove_prefix(std::min(line.size() + 1, text.size()));
    const bool good = accepts([&] { outputs.push_back(parse_expression(line, graph, resolve, variable_names)); });
    if (!good) return 0;
    symbols[fmt::format("e{}", outputs.size())] = outputs.back();
  }
  if (outputs.empty()) return 0;
  const Expression last = outputs.back();
  read_back(last, graph);

  // derivatives, and a second one as a constraint at position level takes it
  for (const Expression x : variables) {
    const Expression first = graph.differentiate(last, x);
    outputs.push_back(first);
    if (x == variables.front()) outputs.push_back(graph.differentiate(first, x));
    read_back(first, graph);
  }
  outputs.push_back(graph.substitute(last, {{"q1", variables[1]}, {"q2", graph.constant(0)}}));
  compare_with_tape(outputs, variables);
  return 0;
}
