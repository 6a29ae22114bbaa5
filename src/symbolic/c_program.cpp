#include <array>
#include <charconv>
#include <cmath>
#include <limits>
#include <set>
#include <utility>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "gp2/symbolic/expression.hpp"
#include "symbolic/functions.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {

namespace {

/// How tightly a text holds together: one that must stand where more is needed gets parentheses.
enum class Holds { as_sum, as_product, alone };

struct CText {
  std::string text;
  Holds binding = Holds::alone;

  [[nodiscard]] std::string where(Holds needed) const { return binding < needed ? fmt::format("({})", text) : text; }
  // behind an operator: no sign stands there by itself
  [[nodiscard]] std::string behind(Holds needed) const {
    return text.starts_with('-') ? fmt::format("({})", text) : where(needed);
  }
  [[nodiscard]] bool is_name() const { return binding == Holds::alone && text.find('(') == std::string::npos; }
};

template <typename T>
std::string digits_of(T value) {
  std::array<char, 32> buffer;
  const auto [end, error] = std::to_chars(buffer.data(), buffer.data() + buffer.size(), value);
  return {buffer.data(), end};
}

/// What an instruction computes from its operands.
CText write_c(Operation operation, int exponent, const CText& a, const CText& b, const std::string& suffix) {
  const auto call = [](const std::string& name, const std::string& arguments) { return CText{name + "(" + arguments + ")"}; };
  switch (operation) {
    case Operation::add:
      return {a.where(Holds::as_sum) + " + " + b.behind(Holds::as_product), Holds::as_sum};
    case Operation::subtract:
      return {a.where(Holds::as_sum) + " - " + b.behind(Holds::as_product), Holds::as_sum};
    case Operation::multiply:
      return {a.where(Holds::as_product) + "*" + b.behind(Holds::alone), Holds::as_product};
    case Operation::divide:
      return {a.where(Holds::as_product) + "/" + b.behind(Holds::alone), Holds::as_product};
    case Operation::negate:
      return {fmt::format("-{}", a.behind(Holds::alone)), Holds::as_product};
    case Operation::power:
      if (exponent == 2) return a.is_name() ? CText{a.text + "*" + a.text, Holds::as_product} : call("square", a.text);
      if (exponent != 0) return call("integer_power", fmt::format("{}, {}", a.text, exponent));
      return call("pow" + suffix, a.text + ", " + b.text);
    case Operation::sign:
      return call("sign_of", a.text);
    case Operation::min:
      return call("smaller", a.text + ", " + b.text);
    case Operation::max:
      return call("larger", a.text + ", " + b.text);
    case Operation::multiply_or_zero:
      return call("product_or_zero", a.text + ", " + b.text);
    default:
      break;
  }
  const std::string name = std::string(internal::find_function(operation)->c) + suffix;
  return call(name, internal::is_binary(operation) ? a.text + ", " + b.text : a.text);
}

}  // namespace

std::string Tape::as_c(std::span<const std::string> inputs, std::span<const std::string> results, bool single_precision,
                       std::string_view indent) const {
  constexpr std::size_t longest_part = 60;  // of a line, that stands where it is used
  const std::string suffix = single_precision ? "f" : "";
  const std::set<std::string> taken(inputs.begin(), inputs.end());
  std::vector<CText> slots(n_slots_);
  for (const auto& [slot, value] : constants_) {
    if (single_precision && std::abs(value) > std::numeric_limits<float>::max()) {
      throw InputError(fmt::format("the number {} does not fit single precision: leave `float` out", value));
    }
    std::string digits = single_precision ? digits_of(static_cast<float>(value)) : digits_of(value);
    if (digits.find_first_of(".e") == std::string::npos) digits += ".0";
    slots[slot] = {digits + suffix};
  }
  for (const auto& [slot, input] : inputs_) slots[slot] = {inputs[input]};

  // how often each instruction's result is read
  std::vector<std::size_t> writer(n_slots_, instructions_.size());
  std::vector<int> n_reads(instructions_.size() + 1, 0);
  for (std::size_t k = 0; k < instructions_.size(); ++k) {
    const Instruction& one = instructions_[k];
    ++n_reads[writer[one.a]];
    if (internal::is_binary(one.operation) && one.exponent == 0) ++n_reads[writer[one.b]];
    writer[one.result] = k;
  }
  for (const std::uint32_t output : outputs_) ++n_reads[writer[output]];

  std::string program;
  int n_names = 0;
  for (std::size_t k = 0; k < instructions_.size(); ++k) {
    const Instruction& one = instructions_[k];
    CText text = write_c(one.operation, one.exponent, slots[one.a], slots[one.b], suffix);
    if (n_reads[k] > 1 || text.text.size() > longest_part) {
      std::string name = fmt::format("v{}", ++n_names);
      while (taken.contains(name)) name += '_';
      program += fmt::format("{}const real {} = {};\n", indent, name, text.text);
      text = {std::move(name)};
    }
    slots[one.result] = std::move(text);
  }
  for (std::size_t i = 0; i < outputs_.size(); ++i) {
    program += fmt::format("{}{} = {};\n", indent, results[i], slots[outputs_[i]].text);
  }
  return program;
}

}  // namespace gp2
