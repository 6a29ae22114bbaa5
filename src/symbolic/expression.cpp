#include "gp2/symbolic/expression.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <string>
#include <unordered_map>
#include <unordered_set>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {

using internal::is_binary;
using internal::is_leaf;
using internal::Node;

namespace {

struct StepsLeft {
  bool is_limited = false;
  std::uint64_t limit = 0, taken = 0;
};
thread_local StepsLeft steps_of_thread;

}  // namespace

internal::StepLimit::StepLimit(std::uint64_t steps) : is_outermost_(!steps_of_thread.is_limited) {
  if (is_outermost_) steps_of_thread = {true, steps, 0};
}

internal::StepLimit::~StepLimit() {
  if (is_outermost_) steps_of_thread = {};
}

void internal::StepLimit::count(std::size_t steps) {
  StepsLeft& all = steps_of_thread;
  if (!all.is_limited) return;
  all.taken += steps;
  if (all.taken > all.limit) {
    throw InputError(
        fmt::format("expressions: their derivatives and tapes take more than {} steps; use fewer or shorter "
                    "expressions, or fewer parameters",
                    all.limit));
  }
}

std::uint32_t ExpressionGraph::Implementation::intern(const Node& node) {
  const std::scoped_lock lock(growing_);
  return intern_alone(node);
}

std::uint32_t ExpressionGraph::Implementation::intern(std::string_view name) {
  const std::scoped_lock lock(growing_);
  if (const auto found = variable_ids_.find(name); found != variable_ids_.end()) return found->second;
  const std::uint32_t id = intern_alone({Operation::variable, static_cast<std::uint32_t>(names.size()), 0, 0});
  names.push_back(std::string(name));
  variable_ids_.emplace(name, id);
  return id;
}

std::size_t ExpressionGraph::Implementation::size() const {
  const std::scoped_lock lock(growing_);
  return nodes.size();
}

std::uint32_t ExpressionGraph::Implementation::intern_alone(const Node& node) {
  internal::StepLimit::count(1);
  Key key{node.operation, node.a, node.b, std::bit_cast<std::uint64_t>(node.value)};
  if (internal::is_commutative(node.operation) && key.a > key.b) std::swap(key.a, key.b);
  if (const auto found = ids_.find(key); found != ids_.end()) return found->second;
  if (nodes.size() >= max_nodes) {
    throw InputError(fmt::format("expressions: more than {} operations; use fewer or shorter expressions", max_nodes));
  }
  const auto id = static_cast<std::uint32_t>(nodes.size());
  nodes.push_back(node);
  ids_.emplace(key, id);
  return id;
}

std::vector<std::uint32_t> ExpressionGraph::Implementation::reachable(std::span<const std::uint32_t> roots) const {
  std::unordered_set<std::uint32_t> seen;
  std::vector<std::uint32_t> found;
  const auto visit = [&](std::uint32_t id) {
    if (seen.insert(id).second) found.push_back(id);
  };
  for (const std::uint32_t id : roots) visit(id);
  std::size_t next = 0;
  while (next < found.size()) {
    const Node& node = nodes[found[next++]];
    if (!is_leaf(node.operation)) visit(node.a);
    if (is_binary(node.operation)) visit(node.b);
  }
  internal::StepLimit::count(found.size());
  std::sort(found.begin(), found.end());
  return found;
}

// ---------------------------------------------------------------------------------------------------------------- Expression

Operation Expression::operation() const { return graph_->implementation_->nodes[id_].operation; }

bool Expression::is_constant(double value) const { return is_constant() && constant_value() == value; }

double Expression::constant_value() const {
  assert(is_constant());
  return graph_->implementation_->nodes[id_].value;
}

const std::string& Expression::variable_name() const {
  assert(operation() == Operation::variable);
  return graph_->implementation_->names[graph_->implementation_->nodes[id_].a];
}

Expression Expression::left() const {
  assert(!is_leaf(operation()));
  return {graph_, graph_->implementation_->nodes[id_].a};
}

Expression Expression::right() const {
  assert(is_binary(operation()));
  return {graph_, graph_->implementation_->nodes[id_].b};
}

Expression operator+(Expression a, Expression b) { return a.graph().apply(Operation::add, a, b); }
Expression operator-(Expression a, Expression b) { return a.graph().apply(Operation::subtract, a, b); }
Expression operator*(Expression a, Expression b) { return a.graph().apply(Operation::multiply, a, b); }
Expression operator/(Expression a, Expression b) { return a.graph().apply(Operation::divide, a, b); }
Expression operator-(Expression a) { return a.graph().apply(Operation::negate, a); }

namespace {

/// Whether e is written with a leading minus: −u, or a negative constant. Then -e is simpler than e.
bool has_minus(Expression e) { return e.operation() == Operation::negate || (e.is_constant() && e.constant_value() < 0); }

void require_own(const ExpressionGraph& graph, Expression e) {
  if (&e.graph() == &graph) return;
  throw InputError("expressions: the operand belongs to another graph; build all operands in one graph");
}

/// What `operation` makes of two constants, unless that is infinite or NaN: such a node stays,
/// so that evaluating it shows the error.
std::optional<double> fold(Operation operation, double a, double b) {
  double value = 0;
  if (const auto n = internal::small_integer(b); operation == Operation::power && n) {
    internal::integer_power(*n, 1, &a, &value);
  } else {
    internal::with_arithmetic(operation, [&](auto f) { value = f(a, b); });
  }
  return std::isfinite(value) ? std::optional(value) : std::nullopt;
}

/// A product with its constant factor c in front, and only one: u·c = c·u, c·(c₂·u) = (c·c₂)·u, u·(c·v) = c·(u·v).
std::optional<Expression> constant_first(Expression a, Expression b) {
  const auto has_factor = [](Expression e) { return e.operation() == Operation::multiply && e.left().is_constant(); };
  if (a.is_constant()) {
    if (!has_factor(b)) return std::nullopt;
    const auto product = fold(Operation::multiply, a.constant_value(), b.left().constant_value());
    if (!product || *product == 0) return std::nullopt;
    return a.graph().constant(*product) * b.right();
  }
  if (b.is_constant()) return b * a;
  if (has_factor(a)) return a.left() * (a.right() * b);
  if (has_factor(b)) return b.left() * (a * b.right());
  return std::nullopt;
}

/// A simpler expression equal to `a operation b`, if a local rule gives one. Signs rise out of sums and products ((−a)·b =
/// −(a·b)), which is exact in floating point, so that they cancel where they meet and an expression prints with few of them.
std::optional<Expression> simplify(Operation operation, Expression a, Expression b) {
  ExpressionGraph& graph = a.graph();
  switch (operation) {
    case Operation::add:
      if (a.is_constant(0)) return b;
      if (b.is_constant(0)) return a;
      // (−u) + (−v): written the same way in either order
      if (has_minus(a) && has_minus(b) && a.id() > b.id()) return b - (-a);
      if (has_minus(b)) return a - (-b);
      if (has_minus(a)) return b - (-a);
      break;
    case Operation::subtract:
      if (a == b) return graph.constant(0);
      if (b.is_constant(0)) return a;
      if (a.is_constant(0)) return -b;
      if (has_minus(b)) return a + (-b);
      break;
    case Operation::multiply:
      if (a.is_constant(0) || b.is_constant(0)) return graph.constant(0);
      if (a.is_constant(1)) return b;
      if (b.is_constant(1)) return a;
      if (has_minus(a)) return -((-a) * b);
      if (has_minus(b)) return -(a * (-b));
      if (const auto product = constant_first(a, b)) return product;
      break;
    case Operation::divide:
      if (a.is_constant(0) && !b.is_constant(0)) return graph.constant(0);
      if (b.is_constant(1)) return a;
      if (has_minus(a)) return -((-a) / b);
      if (has_minus(b)) return -(a / (-b));
      break;
    case Operation::power:
      if (b.is_constant(0)) return graph.constant(1);
      if (b.is_constant(1)) return a;
      if (b.is_constant(0.5)) return graph.apply(Operation::sqrt, a);
      break;
    case Operation::multiply_or_zero:
      if (a.is_constant(0)) return graph.constant(0);
      // 0 · finite is 0 anyway, and a known a ≠ 0 needs no guard
      if (a.is_constant() || b.is_constant()) return a * b;
      break;
    default:
      break;
  }
  return std::nullopt;
}

}  // namespace

// ----------------------------------------------------------------------------------------------------------- ExpressionGraph

ExpressionGraph::ExpressionGraph() : implementation_(std::make_unique<Implementation>()) {}
ExpressionGraph::~ExpressionGraph() = default;

std::size_t ExpressionGraph::size() const { return implementation_->size(); }

Expression ExpressionGraph::constant(double value) {
  if (!std::isfinite(value)) throw InputError(fmt::format("expressions: a constant must be finite, got {}", value));
  // one zero: −0 becomes 0
  return {this, implementation_->intern({Operation::constant, 0, 0, value == 0 ? 0.0 : value})};
}

Expression ExpressionGraph::variable(std::string_view name) { return {this, implementation_->intern(name)}; }

Expression ExpressionGraph::apply(Operation operation, Expression a) {
  assert(!is_leaf(operation) && !is_binary(operation));
  require_own(*this, a);
  if (a.is_constant()) {
    if (const auto value = fold(operation, a.constant_value(), 0)) return constant(*value);
  }
  if (operation == Operation::negate && a.operation() == Operation::negate) return a.left();
  return {this, implementation_->intern({operation, a.id_, 0, 0})};
}

Expression ExpressionGraph::apply(Operation operation, Expression a, Expression b) {
  assert(is_binary(operation));
  if (a.graph_ != this || b.graph_ != this) {
    throw InputError("expressions: the operands belong to different graphs; build all operands in one graph");
  }
  if (a.is_constant() && b.is_constant()) {
    if (const auto value = fold(operation, a.constant_value(), b.constant_value())) return constant(*value);
  }
  if (const auto simpler = simplify(operation, a, b)) return *simpler;
  return {this, implementation_->intern({operation, a.id_, b.id_, 0})};
}

namespace {

/// Whether e is 1/n with a length |g| or √(g² + …) among the factors of n; under that of the slope of asin is a difference.
bool is_over_length(Expression e) {
  if (e.operation() != Operation::divide || !e.left().is_constant(1)) return false;
  const auto is_length = [](Expression n) {
    return n.operation() == Operation::abs || (n.operation() == Operation::sqrt && n.left().operation() != Operation::subtract);
  };
  Expression n = e.right();
  for (; n.operation() == Operation::multiply; n = n.left()) {
    if (is_length(n.right())) return true;
  }
  return is_length(n);
}

/// The derivative of e = f(a) or f(a, b), given those of its operands. A factor w that can be infinite enters as ȧ ⊗ w.
Expression derivative(Expression e, Expression da, Expression db) {
  ExpressionGraph& graph = e.graph();
  const auto number = [&](double value) { return graph.constant(value); };
  const auto function = [&](Operation operation, Expression u) { return graph.apply(operation, u); };
  const auto power = [&](Expression u, Expression v) { return graph.apply(Operation::power, u, v); };
  const auto or_zero = [&](Expression du, Expression w) { return graph.apply(Operation::multiply_or_zero, du, w); };
  const Expression a = e.left();
  const Expression b = is_binary(e.operation()) ? e.right() : a;

  switch (e.operation()) {
    case Operation::constant:
    case Operation::variable:
    case Operation::sign:
      return number(0);
    case Operation::add:
      return da + db;
    case Operation::subtract:
      return da - db;
    case Operation::multiply:
      return da * b + a * db;
    case Operation::divide:  // (a/b)˙ = (ȧ − (a/b) ḃ) / b
      return (da - e * db) / b;
    case Operation::negate:
      return -da;
    case Operation::power: {
      // (aᵇ)˙ = b aᵇ⁻¹ ȧ + (aᵇ log a) ḃ, where aᵇ log a → 0 as a → 0 with b > 0
      const auto by_base = [&] { return b * power(a, b - number(1)); };
      if (b.is_constant() && b.constant_value() >= 1 && b.constant_value() == std::trunc(b.constant_value())) {
        return by_base() * da;
      }
      const Expression through_base = da.is_constant(0) ? da : or_zero(da, by_base());
      if (db.is_constant(0)) return through_base;
      return through_base + or_zero(db, or_zero(e, function(Operation::log, a)));
    }
    case Operation::sin:
      return function(Operation::cos, a) * da;
    case Operation::cos:
      return -function(Operation::sin, a) * da;
    case Operation::tan:
      return (number(1) + e * e) * da;
    case Operation::asin:
      return or_zero(da, number(1) / function(Operation::sqrt, number(1) - a * a));
    case Operation::acos:
      return -or_zero(da, number(1) / function(Operation::sqrt, number(1) - a * a));
    case Operation::atan:
      return da / (number(1) + a * a);
    case Operation::sinh:
      return function(Operation::cosh, a) * da;
    case Operation::cosh:
      return function(Operation::sinh, a) * da;
    case Operation::tanh:
      return (number(1) - e * e) * da;
    case Operation::exp:
      return e * da;
    case Operation::log:
      return da / a;
    case Operation::sqrt:
      return or_zero(da, number(0.5) / e);
    case Operation::abs:
      return function(Operation::sign, a) * da;
    case Operation::atan2: {  // (b ȧ − a ḃ) / (a² + b²)
      const Expression square = a * a + b * b;
      return or_zero(da, b / square) - or_zero(db, a / square);
    }
    case Operation::min:
    case Operation::max: {  // the weight of ȧ is 1 where a is taken, ½ at a tie, 0 elsewhere
      const Expression order = function(Operation::sign, e.operation() == Operation::min ? b - a : a - b);
      return or_zero(number(0.5) + number(0.5) * order, da) + or_zero(number(0.5) - number(0.5) * order, db);
    }
    case Operation::multiply_or_zero: {
      const Expression slope = or_zero(da, b) + or_zero(a, db);
      if (!is_over_length(b)) return slope;
      // a component over a length has the slope 0 where this is 0, as sign has at 0; single precision can hold the bound too
      const Expression length = function(Operation::abs, b.right());
      return or_zero(function(Operation::sign, graph.apply(Operation::max, length - number(1e-30), number(0))), slope);
    }
  }
  return number(0);
}

}  // namespace

Expression ExpressionGraph::differentiate(Expression e, Expression x) { return differentiate(std::span(&e, 1), x).front(); }

std::vector<Expression> ExpressionGraph::differentiate(std::span<const Expression> expressions, Expression x) {
  require_own(*this, x);
  if (x.operation() != Operation::variable) throw InputError("expressions: a derivative is taken with respect to a variable");
  const Expression zero = constant(0);
  std::vector<std::uint32_t> roots;
  for (const Expression e : expressions) {
    require_own(*this, e);
    roots.push_back(e.id_);
  }

  // forwards through the operands, so that depth costs no stack; nodes missing from the map do not depend on x
  std::unordered_map<std::uint32_t, Expression> derivatives{{x.id_, constant(1)}};
  const auto derivative_of = [&](std::uint32_t id) {
    const auto found = derivatives.find(id);
    return found == derivatives.end() ? zero : found->second;
  };
  for (const std::uint32_t id : implementation_->reachable(roots)) {
    const Node node = implementation_->nodes[id];
    if (is_leaf(node.operation)) continue;
    const Expression da = derivative_of(node.a);
    const Expression db = is_binary(node.operation) ? derivative_of(node.b) : zero;
    if (da == zero && db == zero) continue;
    derivatives.emplace(id, derivative({this, id}, da, db));
  }
  std::vector<Expression> results;
  for (const std::uint32_t id : roots) results.push_back(derivative_of(id));
  return results;
}

std::vector<Expression> ExpressionGraph::copy(std::span<const Expression> expressions) {
  if (expressions.empty()) return {};
  const ExpressionGraph& source = expressions.front().graph();
  std::vector<std::uint32_t> roots;
  for (const Expression e : expressions) {
    if (e.graph_ != &source) throw InputError("expressions: what is copied belongs to different graphs; copy each on its own");
    roots.push_back(e.id_);
  }
  // as they are, without simplification, which they have been through
  std::unordered_map<std::uint32_t, std::uint32_t> copies;
  for (const std::uint32_t id : source.implementation_->reachable(roots)) {
    Node node = source.implementation_->nodes[id];
    if (node.operation == Operation::variable) {
      copies[id] = variable(source.implementation_->names[node.a]).id_;
      continue;
    }
    if (!is_leaf(node.operation)) node.a = copies.at(node.a);
    if (is_binary(node.operation)) node.b = copies.at(node.b);
    copies[id] = implementation_->intern(node);
  }
  std::vector<Expression> results;
  for (const std::uint32_t id : roots) results.push_back({this, copies.at(id)});
  return results;
}

Expression ExpressionGraph::substitute(Expression e, const std::map<std::string, Expression>& replacements) {
  require_own(*this, e);
  std::unordered_map<std::uint32_t, Expression> results;
  for (const std::uint32_t id : implementation_->reachable(std::array{e.id_})) {
    const Node node = implementation_->nodes[id];
    Expression result{this, id};
    if (node.operation == Operation::variable) {
      if (const auto found = replacements.find(implementation_->names[node.a]); found != replacements.end())
        result = found->second;
    } else if (is_binary(node.operation)) {
      const Expression a = results.at(node.a), b = results.at(node.b);
      if (a.id_ != node.a || b.id_ != node.b) result = apply(node.operation, a, b);
    } else if (!is_leaf(node.operation)) {
      if (const Expression a = results.at(node.a); a.id_ != node.a) result = apply(node.operation, a);
    }
    results.emplace(id, result);
  }
  return results.at(e.id_);
}

std::vector<std::string> ExpressionGraph::variables_of(Expression e) const {
  require_own(*this, e);
  std::vector<std::string> names;
  for (const std::uint32_t id : implementation_->reachable(std::array{e.id_})) {
    const Node& node = implementation_->nodes[id];
    if (node.operation == Operation::variable) names.push_back(implementation_->names[node.a]);
  }
  std::sort(names.begin(), names.end());
  return names;
}

bool ExpressionGraph::depends_on(Expression e, Expression x) const {
  for (const Expression one : {e, x}) require_own(*this, one);
  const std::vector<std::uint32_t> ids = implementation_->reachable(std::array{e.id_});
  return std::binary_search(ids.begin(), ids.end(), x.id_);
}

ExpressionSize ExpressionGraph::size_of(Expression e) const {
  require_own(*this, e);
  ExpressionSize size;
  std::unordered_map<std::uint32_t, double> written;
  for (const std::uint32_t id : implementation_->reachable(std::array{e.id_})) {
    const Node& node = implementation_->nodes[id];
    double sum = 1;
    if (!is_leaf(node.operation)) {
      ++size.operations;
      sum += written.at(node.a);
    }
    if (is_binary(node.operation)) sum += written.at(node.b);
    written.emplace(id, sum);
  }
  size.written = written.at(e.id_);
  return size;
}

}  // namespace gp2
