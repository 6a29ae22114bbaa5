#include <algorithm>
#include <cstdint>
#include <optional>
#include <set>
#include <string>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/model.hpp"
#include "gp2/simulate.hpp"
#include "mechanics/known_multipliers.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

SwitchingFunctions::SwitchingFunctions(std::span<const std::vector<Expression>> surfaces, const SystemSymbols& symbols) {
  if (surfaces.empty()) return;
  std::vector<Expression> outputs;
  for (const std::vector<Expression>& functions : surfaces) {
    std::vector<std::string> texts;
    for (const Expression& g : functions) texts.push_back(to_string(g));
    names_.push_back(fmt::format("{}", fmt::join(texts, ", ")));
    outputs.insert(outputs.end(), functions.begin(), functions.end());
    first_.push_back(static_cast<int>(outputs.size()));
  }
  const std::vector<Expression> functions = outputs;
  std::vector<Expression> moving = symbols.q;
  moving.insert(moving.end(), symbols.dq.begin(), symbols.dq.end());
  moving.push_back(symbols.t);
  for (const Expression& x : moving) {
    for (const Expression& derivative : functions.front().graph().differentiate(functions, x)) outputs.push_back(derivative);
  }
  tape_ = Tape(outputs, symbols.state_and_parameters());
}

void SwitchingFunctions::evaluate(const Eigen::Ref<const VectorXd>& state, const Eigen::Ref<const VectorXd>& parameters,
                                  VectorXd& values, MatrixXd& gradients) const {
  const Index n = first_.back();
  MatrixXd results;
  tape_.evaluate(state, parameters, results);
  values = results.topRows(n);
  gradients = results.bottomRows(results.rows() - n).reshaped(n, results.rows() / n - 1);
}

namespace {

// The surfaces at which expressions jump: arguments of sign(), and those whose length is a factor of a denominator, |v| or
// √(v² + w²), that read a velocity and no input, each once and each factor by itself, without constants: sign(v), sign(−2 v),
// sign(lambda(1) v), v/|v| and v/(2 |−v|) are of one surface, as are sign(v − w) and sign(w − v).
class JumpsOf {
 public:
  JumpsOf(ExpressionGraph& graph, const SystemSymbols& symbols) : graph_(graph), symbols_(symbols) {}

  void add(Expression root) {
    // a stack of its own: expressions are as deep as a file makes them
    std::vector<Expression> open = {root};
    while (!open.empty()) {
      const Expression e = open.back();
      open.pop_back();
      if (!seen_.insert(e.id()).second || internal::is_leaf(e.operation())) continue;
      if (e.operation() == Operation::sign) add_factors(e.left());
      if (e.operation() == Operation::divide) add_lengths(e.right());
      if (e.operation() == Operation::power && e.right().is_constant(-0.5)) add_length(e.left());
      if (internal::is_binary(e.operation())) open.push_back(e.right());
      open.push_back(e.left());
    }
  }
  [[nodiscard]] const std::vector<std::vector<Expression>>& found() const { return found_; }

 private:
  void add_factors(Expression product) {
    std::vector<Expression> open = {product};
    while (!open.empty()) {
      const Expression g = open.back();
      open.pop_back();
      if (!seen_factors_.insert(g.id()).second) continue;
      if (g.operation() == Operation::negate) {
        open.push_back(g.left());
      } else if (g.operation() == Operation::multiply || g.operation() == Operation::divide) {
        open.push_back(g.right());
        open.push_back(g.left());
      } else if (reads_velocity(g)) {
        add_surface({g});
      }
    }
  }

  // those among the factors of a divisor
  void add_lengths(Expression divisor) {
    std::vector<Expression> open = {divisor};
    while (!open.empty()) {
      const Expression e = open.back();
      open.pop_back();
      if (!seen_in_divisors_.insert(e.id()).second) continue;
      const bool is_product = e.operation() == Operation::multiply;
      if (e.operation() == Operation::abs) add_factors(e.left());
      if (e.operation() == Operation::sqrt) add_length(e.left());
      if (is_product) open.push_back(e.right());
      if (is_product || e.operation() == Operation::divide || e.operation() == Operation::negate) open.push_back(e.left());
    }
  }

  // the terms of a sum of squares, each alone 0 where the sum is
  void add_length(const Expression& sum) {
    std::vector<Expression> functions, open = {sum};
    std::set<std::uint32_t> seen;
    while (!open.empty()) {
      const Expression e = open.back();
      open.pop_back();
      if (!seen.insert(e.id()).second) continue;
      if (e.operation() == Operation::add) {
        open.push_back(e.right());
        open.push_back(e.left());
      } else {
        const std::optional<Expression> root = reads_velocity(e) ? root_of(e) : std::nullopt;
        if (!root) return;
        functions.push_back(*root);
      }
    }
    if (functions.size() == 1) {
      add_factors(functions.front());
    } else {
      add_surface(std::move(functions));
    }
  }

  // of a square, or of one times what reads no velocity; right operands first, which are short where a text has many
  std::optional<Expression> root_of(const Expression& e) {
    const auto without_abs = [](const Expression& base) { return base.operation() == Operation::abs ? base.left() : base; };
    if (e.operation() == Operation::power && e.right().is_constant(2)) return without_abs(e.left());
    if (e.operation() == Operation::multiply && e.left() == e.right()) return without_abs(e.left());
    const bool is_product = e.operation() == Operation::multiply;
    if (!is_product && e.operation() != Operation::divide) return std::nullopt;
    const bool is_square_left = !reads_velocity(e.right());
    if (!is_square_left && (!is_product || reads_velocity(e.left()))) return std::nullopt;
    const std::optional<Expression> root = root_of(is_square_left ? e.left() : e.right());
    if (!root) return std::nullopt;
    const Expression factor = graph_.apply(Operation::sqrt, is_square_left ? e.right() : e.left());
    return is_product ? factor * *root : *root / factor;
  }

  // λ₀ and λ are no expressions of the state: where they change their sign is not looked for
  bool reads_velocity(const Expression& g) {
    const std::vector<std::string> variables = graph_.variables_of(g);
    if (std::any_of(variables.begin(), variables.end(), is_multiplier)) return false;
    const auto reads = [&](const Expression& x) { return graph_.depends_on(g, x); };
    return std::any_of(symbols_.dq.begin(), symbols_.dq.end(), reads) &&
           std::none_of(symbols_.u.begin(), symbols_.u.end(), reads);
  }

  // a − b and b − a are 0 together
  static bool is_same(const Expression& g, const Expression& h) {
    const bool are_differences = g.operation() == Operation::subtract && h.operation() == Operation::subtract;
    return g == h || (are_differences && g.left() == h.right() && g.right() == h.left());
  }

  void add_surface(std::vector<Expression> functions) {
    const auto is_it = [&](const std::vector<Expression>& one) { return std::ranges::equal(one, functions, is_same); };
    if (std::ranges::none_of(found_, is_it)) found_.push_back(std::move(functions));
  }

  ExpressionGraph& graph_;
  const SystemSymbols& symbols_;
  std::set<std::uint32_t> seen_, seen_factors_, seen_in_divisors_;
  std::vector<std::vector<Expression>> found_;
};

}  // namespace

SwitchingFunctions switching_functions(const Model& model, bool of_latents) {
  const SystemSymbols symbols = model.symbols();
  JumpsOf jumps(*model.graph, symbols);
  const auto add = [&](const std::vector<Expression>& expressions) {
    for (const Expression& e : expressions) jumps.add(e);
  };
  if (const SymbolicSystem* system = model.symbolic_system()) add(system->definition().force);
  if (!of_latents) {
    add(model.truth);
    add(model.truth_force);
    return {jumps.found(), symbols};
  }
  for (const LatentSpec& latent : model.latents) {
    if (!latent.feature_code) {
      for (const std::string& feature : latent.features) jumps.add(model.expression(feature));
    }
    if (latent.direction_code) continue;
    for (const std::vector<std::string>& row : latent.directions) {
      for (const std::string& direction : row) jumps.add(model.expression(direction));
    }
  }
  return {jumps.found(), symbols};
}

}  // namespace gp2
