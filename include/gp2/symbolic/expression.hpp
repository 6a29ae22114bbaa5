#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"

namespace gp2 GP2_API {

class ExpressionGraph;

/// How large an expression is.
struct ExpressionSize {
  std::size_t operations = 0;  // different ones: what evaluating it takes
  double written = 0;          // operations, numbers and symbols when it is written out, what is shared each time
};

/// What a node of an expression computes from its operands a, b.
enum class Operation : std::uint8_t {
  constant,  // a number
  variable,  // a named symbol
  add,       // a + b
  subtract,  // a − b
  multiply,  // a · b
  divide,    // a / b
  negate,    // −a
  power,     // a ^ b
  sin,
  cos,
  tan,
  asin,
  acos,
  atan,
  sinh,
  cosh,
  tanh,
  exp,
  log,
  sqrt,
  abs,
  sign,   // −1, 0 or 1
  atan2,  // atan2(a, b)
  min,
  max,
  /// a · b, but 0 wherever |a| < 1e-100, whatever b is. It appears in derivatives, d√u = u̇ ⊗ 1/(2√u) is 0, not NaN, along a
  /// direction in which u does not change, in a component over its length, and in rows of constraints that come and go.
  multiply_or_zero,
};

/// A node of an ExpressionGraph: a cheap value, valid as long as its graph lives. Two expressions of one graph are structurally
/// equal exactly when they compare equal (the graph is hash-consed).
class Expression {
 public:
  Expression() = default;

  [[nodiscard]] Operation operation() const;
  [[nodiscard]] bool is_constant() const { return operation() == Operation::constant; }
  [[nodiscard]] bool is_constant(double value) const;
  [[nodiscard]] double constant_value() const;             // of a constant
  [[nodiscard]] const std::string& variable_name() const;  // of a variable
  [[nodiscard]] Expression left() const;                   // operand a
  [[nodiscard]] Expression right() const;                  // operand b, of a binary operation
  [[nodiscard]] std::uint32_t id() const { return id_; }   // position in the graph; operands come before what uses them
  [[nodiscard]] ExpressionGraph& graph() const { return *graph_; }
  friend bool operator==(const Expression& a, const Expression& b) { return a.graph_ == b.graph_ && a.id_ == b.id_; }

 private:
  friend class ExpressionGraph;
  Expression(ExpressionGraph* graph, std::uint32_t id) : graph_(graph), id_(id) {}
  ExpressionGraph* graph_ = nullptr;
  std::uint32_t id_ = 0;
};

/// Hash-consed expressions in deterministic order: the same calls build the same nodes, so the same text gives the same bits on
/// every run. Local simplification only (0·x, 1·x, x + 0, x − x, 0/x, constants, −(−x), x^0, x^1, √ for x^0.5); signs rise out of
/// sums and products (a + (−b) = a − b, (−a)·b = −(a·b)), which is exact in floating point, and constant factors to the front of
/// products, where they become one (u·(c·v) = c·(u·v)); nothing else is expanded or reordered. What would fold to ∞ or NaN stays,
/// so that evaluation shows it. Every member function may be called from several threads at once.
///
/// @throws InputError from any operation that would grow the graph past `max_nodes`, from a constant that is not finite, and from
///   operands of different graphs.
class ExpressionGraph {
 public:
  static constexpr std::size_t max_nodes = 1'000'000;

  ExpressionGraph();
  ExpressionGraph(const ExpressionGraph&) = delete;
  ExpressionGraph& operator=(const ExpressionGraph&) = delete;
  ~ExpressionGraph();

  Expression constant(double value);
  Expression variable(std::string_view name);  // the same node for the same name
  Expression apply(Operation operation, Expression a);
  Expression apply(Operation operation, Expression a, Expression b);

  /// ∂e/∂x. Shared subexpressions are differentiated once.
  Expression differentiate(Expression e, Expression x);

  /// ∂e/∂x of several expressions, what they share differentiated once.
  std::vector<Expression> differentiate(std::span<const Expression> expressions, Expression x);

  /// The same expressions in this graph: those of another graph are copied as they are.
  std::vector<Expression> copy(std::span<const Expression> expressions);

  /// e with every variable in `replacements` replaced, all at once.
  Expression substitute(Expression e, const std::map<std::string, Expression>& replacements);

  /// Names of the variables e depends on, sorted.
  [[nodiscard]] std::vector<std::string> variables_of(Expression e) const;
  [[nodiscard]] bool depends_on(Expression e, Expression x) const;
  [[nodiscard]] ExpressionSize size_of(Expression e) const;
  [[nodiscard]] std::size_t size() const;

 private:
  friend class Expression;
  friend class Tape;
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

Expression operator+(Expression a, Expression b);
Expression operator-(Expression a, Expression b);
Expression operator*(Expression a, Expression b);
Expression operator/(Expression a, Expression b);
Expression operator-(Expression a);

/// Reads `text` into `graph`: numbers, + − * / ^ (right-associative, binds tighter than unary minus: -x^2 = −(x²)), parentheses,
/// pi, and sin cos tan asin acos atan atan2 sinh cosh tanh exp log sqrt abs sign min max. site("tip").z, with a name in quotes
/// (single ones too), numbers after it and a component, is one symbol.
///
/// @param resolve  gives the expression a symbol stands for, or nothing when the name is unknown.
/// @param known_names  names to suggest from when a symbol is unknown ("unknown symbol 'dq4', did you mean 'dq3'?").
/// @throws InputError with the column in the text, the rule and the mend. Texts above 65536 characters or nested deeper than 200
/// are
///   refused.
Expression parse_expression(std::string_view text, ExpressionGraph& graph,
                            const std::function<std::optional<Expression>(std::string_view)>& resolve,
                            std::span<const std::string> known_names);

/// Reads a comparison of two expressions by <, <=, > or >= as the expression that is 1 where it holds and 0 where it does not, NaN
/// where a side is. Its derivatives are 0.
///
/// @throws InputError as parse_expression, and where the text is no comparison.
Expression parse_condition(std::string_view text, ExpressionGraph& graph,
                           const std::function<std::optional<Expression>(std::string_view)>& resolve,
                           std::span<const std::string> known_names);

enum class Notation : std::uint8_t { text, latex, mathml };

/// e written out with no more parentheses than needed; `text` reads back to the same expression. In LaTeX q1 → q_{1}, dq1 →
/// the same with a dot, ddq1 → with two, greek names → symbols, and so in MathML, where the elements of one `mrow` are given.
/// multiply_or_zero prints as a product. For C see Tape::as_c.
///
/// @throws InputError when the text would exceed 16 777 216 characters.
std::string to_string(Expression e, Notation notation = Notation::text);

/// A flat evaluation program for several expressions at many points at once, with common subexpressions computed once.
class Tape {
 public:
  Tape() = default;

  /// @param inputs  variables in the order of the rows of `evaluate`'s argument.
  /// @throws InputError when an output depends on a variable that is not among the inputs.
  Tape(std::span<const Expression> outputs, std::span<const Expression> inputs);

  /// @param values   (n_first_inputs × N): the first inputs, one column per point.
  /// @param shared   the remaining inputs, the same at every point.
  /// @param results  (n_outputs × N), one column per point; resized.
  void evaluate(const Eigen::Ref<const Eigen::MatrixXd>& values, const Eigen::Ref<const Eigen::VectorXd>& shared,
                Eigen::MatrixXd& results) const;

  /// The same, the outputs spread over several matrices with N columns and n_outputs rows in all: the first outputs fill the
  /// rows of the first matrix, and so on.
  void evaluate(const Eigen::Ref<const Eigen::MatrixXd>& values, const Eigen::Ref<const Eigen::VectorXd>& shared,
                std::span<Eigen::Ref<Eigen::MatrixXd>> results) const;

  /// Memory of `evaluate_at`, which holds the constants and the shared inputs (the last ones).
  [[nodiscard]] Eigen::VectorXd make_workspace(const Eigen::Ref<const Eigen::VectorXd>& shared) const;

  /// At one point after another: allocates nothing, and is as quick for one point as `evaluate` for many.
  /// @param point      (n_first_inputs), not checked
  /// @param workspace  from `make_workspace`; of one thread
  /// @param results    (n_outputs)
  void evaluate_at(const Eigen::Ref<const Eigen::VectorXd>& point, Eigen::VectorXd& workspace,
                   Eigen::Ref<Eigen::VectorXd> results) const;

  /// The program as statements of C99, one a line, behind `indent`: they assign the outputs to `results`. What is used once and
  /// short stands where it is used; the rest is called v1, v2, …, or v1_, … where an input is called so. C's functions of double
  /// or, in single precision, of float; sign_of, smaller, larger, product_or_zero, square and integer_power are left to define.
  /// @throws InputError for a number that single precision cannot hold.
  /// @param inputs   the text for each input: "q1", "parameters[0]"
  /// @param results  what each output is assigned to: "M[0]"
  [[nodiscard]] std::string as_c(std::span<const std::string> inputs, std::span<const std::string> results, bool single_precision,
                                 std::string_view indent = "  ") const;

  [[nodiscard]] int n_outputs() const { return static_cast<int>(outputs_.size()); }
  [[nodiscard]] bool uses_input(int index) const { return uses_input_[static_cast<std::size_t>(index)]; }
  [[nodiscard]] std::size_t n_instructions() const { return instructions_.size(); }

 private:
  template <typename Output>
  void run(const Eigen::Ref<const Eigen::MatrixXd>& values, const Eigen::Ref<const Eigen::VectorXd>& shared,
           const Output& output_at) const;

  struct Instruction {
    Operation operation;
    std::int32_t exponent;       // for `power` with a small integer exponent; else 0 and b is used
    std::uint32_t result, a, b;  // slots
  };
  std::vector<Instruction> instructions_;
  std::vector<std::pair<std::uint32_t, double>> constants_;      // slot, value
  std::vector<std::pair<std::uint32_t, std::uint32_t>> inputs_;  // slot, input index (used ones only)
  std::vector<std::uint32_t> outputs_;                           // slot of each output
  std::vector<bool> uses_input_;
  std::uint32_t n_slots_ = 0;
};

/// The derivatives of expressions y in the variables of a state x that do not vanish identically.
struct StateDerivatives {
  struct Entry {
    int output = 0;       // i of y_i
    int state_index = 0;  // k of x_k
  };
  std::vector<Entry> entries;  // sorted by k, then i
  Tape tape;                   // inputs -> ∂y_i/∂x_k, one output per entry

  StateDerivatives() = default;
  /// @param expressions  y
  /// @param inputs       of the tape: x, then what else y depends on
  /// @param n_states     size of x
  StateDerivatives(std::span<const Expression> expressions, std::span<const Expression> inputs, int n_states);
};

}  // namespace gp2
