#include <algorithm>
#include <limits>
#include <unordered_map>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "gp2/symbolic/expression.hpp"
#include "symbolic/graph.hpp"
#include "symbolic/state_derivatives.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

constexpr Index block_size = 64;  // points evaluated together

using Node = internal::Node;
using Nodes = internal::Growing<Node>;

// by id of the variable
std::unordered_map<std::uint32_t, std::uint32_t> index_inputs(std::span<const Expression> inputs, const ExpressionGraph& graph) {
  std::unordered_map<std::uint32_t, std::uint32_t> input_index;
  for (std::size_t i = 0; i < inputs.size(); ++i) {
    if (&inputs[i].graph() != &graph || inputs[i].operation() != Operation::variable) {
      throw InputError(fmt::format("tape: input {} must be a variable of the graph of the outputs", i + 1));
    }
    input_index.emplace(inputs[i].id(), static_cast<std::uint32_t>(i));
  }
  return input_index;
}

std::vector<std::uint32_t> roots_of(std::span<const Expression> outputs, const ExpressionGraph& graph) {
  std::vector<std::uint32_t> roots;
  for (const Expression& output : outputs) {
    if (&output.graph() != &graph) throw InputError("tape: all outputs must belong to one graph");
    roots.push_back(output.id());
  }
  return roots;
}

// of a power with a small constant integer as exponent; else 0
int exponent_of(const Nodes& nodes, const Node& node) {
  const bool constant_exponent = node.operation == Operation::power && nodes[node.b].operation == Operation::constant;
  return constant_exponent ? internal::small_integer(nodes[node.b].value).value_or(0) : 0;
}

bool reads_b(const Nodes& nodes, const Node& node) {
  return internal::is_binary(node.operation) && exponent_of(nodes, node) == 0;
}

// the position in `order` at which each value is read last; outputs are kept to the end
std::unordered_map<std::uint32_t, std::size_t> last_reads(const Nodes& nodes, const std::vector<std::uint32_t>& order,
                                                          const std::vector<std::uint32_t>& roots) {
  std::unordered_map<std::uint32_t, std::size_t> last_read;
  for (std::size_t k = 0; k < order.size(); ++k) {
    const Node& node = nodes[order[k]];
    if (!internal::is_leaf(node.operation)) last_read[node.a] = k;
    if (reads_b(nodes, node)) last_read[node.b] = k;
  }
  for (const std::uint32_t id : roots) last_read[id] = std::numeric_limits<std::size_t>::max();
  return last_read;
}

}  // namespace

Tape::Tape(std::span<const Expression> outputs, std::span<const Expression> inputs) : uses_input_(inputs.size(), false) {
  internal::StepLimit::count(inputs.size() + outputs.size());
  if (outputs.empty()) return;
  ExpressionGraph& graph = outputs.front().graph();
  const Nodes& nodes = graph.implementation_->nodes;
  const std::unordered_map<std::uint32_t, std::uint32_t> input_index = index_inputs(inputs, graph);
  const std::vector<std::uint32_t> roots = roots_of(outputs, graph);
  const std::vector<std::uint32_t> order = graph.implementation_->reachable(roots);
  const std::unordered_map<std::uint32_t, std::size_t> last_read = last_reads(nodes, order, roots);

  // one slot per constant and input; those of intermediate values are used again after their last read
  std::unordered_map<std::uint32_t, std::uint32_t> slots;
  std::vector<std::uint32_t> free_slots;
  for (std::size_t k = 0; k < order.size(); ++k) {
    const std::uint32_t id = order[k];
    const Node& node = nodes[id];
    if (!last_read.contains(id)) continue;  // the exponent of an integer power
    if (node.operation == Operation::variable) {
      const auto index = input_index.find(id);
      if (index == input_index.end()) {
        throw InputError(fmt::format("tape: an output depends on '{}', which is not among the inputs; add it to them",
                                     graph.implementation_->names[node.a]));
      }
      uses_input_[index->second] = true;
      inputs_.emplace_back(n_slots_, index->second);
      slots[id] = n_slots_++;
    } else if (node.operation == Operation::constant) {
      constants_.emplace_back(n_slots_, node.value);
      slots[id] = n_slots_++;
    } else {
      // the result never shares a slot with its operands: these are freed afterwards
      if (free_slots.empty()) free_slots.push_back(n_slots_++);
      const std::uint32_t result = free_slots.back();
      free_slots.pop_back();
      slots[id] = result;
      const std::uint32_t operand_b = reads_b(nodes, node) ? node.b : node.a;
      instructions_.push_back({node.operation, exponent_of(nodes, node), result, slots.at(node.a), slots.at(operand_b)});
      const auto release = [&](std::uint32_t operand) {
        if (last_read.at(operand) == k && !internal::is_leaf(nodes[operand].operation)) free_slots.push_back(slots.at(operand));
      };
      release(node.a);
      if (operand_b != node.a) release(operand_b);
    }
  }
  for (const std::uint32_t id : roots) outputs_.push_back(slots.at(id));
}

template <typename Output>
void Tape::run(const Ref<const MatrixXd>& values, const Ref<const VectorXd>& shared, const Output& output_at) const {
  const Index n_first = values.rows();
  const Index n_points = values.cols();
  if (n_first + shared.size() != static_cast<Index>(uses_input_.size())) {
    throw InputError(fmt::format("tape: evaluate needs {} inputs, got {} per point and {} shared", uses_input_.size(), n_first,
                                 shared.size()));
  }

  // kept between calls, so that repeated evaluation allocates nothing
  thread_local std::vector<double> workspace;
  const Index stride = std::min(block_size, n_points);
  workspace.resize(std::max(workspace.size(), static_cast<std::size_t>(n_slots_ * stride)));
  const auto slot = [&, data = workspace.data()](std::uint32_t index) { return data + index * stride; };

  // what every block shares
  for (const auto& [index, value] : constants_) std::fill_n(slot(index), stride, value);
  for (const auto& [index, input] : inputs_) {
    if (input >= n_first) std::fill_n(slot(index), stride, shared[input - n_first]);
  }

  for (Index start = 0; start < n_points; start += block_size) {
    const Index lanes = std::min(block_size, n_points - start);
    for (const auto& [index, input] : inputs_) {
      if (input >= n_first) continue;
      double* const x = slot(index);
      for (Index i = 0; i < lanes; ++i) x[i] = values(input, start + i);
    }
    for (const Instruction& instruction : instructions_) {
      double* const r = slot(instruction.result);
      const double* const a = slot(instruction.a);
      const double* const b = slot(instruction.b);
      if (instruction.exponent != 0) {
        internal::integer_power(instruction.exponent, lanes, a, r);
        continue;
      }
      internal::with_arithmetic(instruction.operation, [&](auto f) {
        for (Index i = 0; i < lanes; ++i) r[i] = f(a[i], b[i]);
      });
    }
    for (std::size_t output = 0; output < outputs_.size(); ++output) {
      const double* const r = slot(outputs_[output]);
      const auto [first, step] = output_at(output);
      for (Index i = 0; i < lanes; ++i) first[(start + i) * step] = r[i];
    }
  }
}

void Tape::evaluate(const Ref<const MatrixXd>& values, const Ref<const VectorXd>& shared, MatrixXd& results) const {
  results.resize(n_outputs(), values.cols());
  run(values, shared, [&](std::size_t output) { return std::pair(results.data() + output, results.rows()); });
}

void Tape::evaluate(const Ref<const MatrixXd>& values, const Ref<const VectorXd>& shared,
                    std::span<Ref<MatrixXd>> results) const {
  // outputs are asked for in order, and again in each block
  std::size_t part = 0, first_of_part = 0;
  run(values, shared, [&](std::size_t output) {
    if (output == 0) part = first_of_part = 0;
    while (output - first_of_part >= static_cast<std::size_t>(results[part].rows())) {
      first_of_part += static_cast<std::size_t>(results[part++].rows());
    }
    return std::pair(results[part].data() + (output - first_of_part), results[part].outerStride());
  });
}

VectorXd Tape::make_workspace(const Ref<const VectorXd>& shared) const {
  const Index n_inputs = static_cast<Index>(uses_input_.size());
  if (shared.size() > n_inputs) {
    throw InputError(fmt::format("tape: make_workspace takes at most the {} inputs, got {} shared", n_inputs, shared.size()));
  }
  VectorXd workspace = VectorXd::Zero(n_slots_);
  for (const auto& [index, value] : constants_) workspace[index] = value;
  for (const auto& [index, input] : inputs_) {
    if (input >= n_inputs - shared.size()) workspace[index] = shared[input - (n_inputs - shared.size())];
  }
  return workspace;
}

void Tape::evaluate_at(const Ref<const VectorXd>& point, VectorXd& workspace, Ref<VectorXd> results) const {
  double* const slot = workspace.data();
  for (const auto& [index, input] : inputs_) {
    if (input < point.size()) slot[index] = point[input];
  }
  for (const Instruction& instruction : instructions_) {
    double& r = slot[instruction.result];
    const double a = slot[instruction.a];
    if (instruction.exponent == 2) {
      r = a * a;
    } else if (instruction.exponent != 0) {
      internal::integer_power(instruction.exponent, 1, &a, &r);
    } else {
      internal::with_arithmetic(instruction.operation, [&, b = slot[instruction.b]](auto f) { r = f(a, b); });
    }
  }
  double* result = results.data();
  for (const std::uint32_t index : outputs_) *result++ = slot[index];
}

internal::DerivativeExpressions internal::state_derivatives(std::span<const Expression> expressions,
                                                            std::span<const Expression> state) {
  DerivativeExpressions out;
  if (expressions.empty()) return out;
  for (std::size_t k = 0; k < state.size(); ++k) {
    const std::vector<Expression> derivatives = state[k].graph().differentiate(expressions, state[k]);
    for (std::size_t i = 0; i < derivatives.size(); ++i) {
      if (derivatives[i].is_constant(0)) continue;
      out.entries.push_back({static_cast<int>(i), static_cast<int>(k)});
      out.expressions.push_back(derivatives[i]);
    }
  }
  return out;
}

StateDerivatives::StateDerivatives(std::span<const Expression> expressions, std::span<const Expression> inputs, int n_states) {
  internal::DerivativeExpressions derivatives =
      internal::state_derivatives(expressions, inputs.first(static_cast<std::size_t>(n_states)));
  tape = Tape(derivatives.expressions, inputs);
  entries = std::move(derivatives.entries);
}

}  // namespace gp2
