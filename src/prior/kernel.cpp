#include "gp2/prior/kernel.hpp"

#include <algorithm>
#include <cctype>
#include <map>
#include <numeric>
#include <optional>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/shape.hpp"
#include "base/suggestion.hpp"
#include "gp2/error.hpp"
#include "prior/kernel_columns.hpp"
#include "prior/primitive.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Primitive = Kernel::Primitive;

namespace {

constexpr std::size_t max_parameters = 10'000;

std::string_view trim(std::string_view text) {
  while (!text.empty() && std::isspace(static_cast<unsigned char>(text.front()))) text.remove_prefix(1);
  while (!text.empty() && std::isspace(static_cast<unsigned char>(text.back()))) text.remove_suffix(1);
  return text;
}

Primitive primitive_of(std::string_view name, std::string_view text) {
  const std::span<const std::string_view> known = primitive_names();
  for (std::size_t k = 0; k < known.size(); ++k) {
    if (known[k] == name) return static_cast<Primitive>(k);
  }
  // the names that other libraries have for them
  constexpr std::pair<std::string_view, std::string_view> others[] = {
      {"rbf", "se"}, {"gaussian", "se"}, {"squaredexponential", "se"}, {"matern", "matern52"}, {"rationalquadratic", "rq"}};
  const auto other = std::find_if(std::begin(others), std::end(others), [&](const auto& one) { return one.first == name; });
  throw InputError(fmt::format("kernel \"{}\": unknown kernel '{}'{}; use sums and products of {}", shortened(text),
                               shortened(name), other == std::end(others) ? "" : fmt::format(", here called {}", other->second),
                               fmt::join(known, " ")));
}

/// A kernel as it is written: a sum of products of factors, which are numbered in the order of the text. Parentheses are multiplied
/// out, and a factor may then stand in several products.
///
///     sum     = product { "+" product }
///     product = factor { "*" factor }
///     factor  = NAME | "(" sum ")"
class KernelText {
 public:
  using Product = std::vector<std::size_t>;

  explicit KernelText(std::string_view text) : text_(text) {
    products_ = sum();
    if (position_ < text_.size()) fail(position_, "')' closes nothing");
  }

  [[nodiscard]] const std::vector<Product>& products() const { return products_; }
  [[nodiscard]] const std::vector<Primitive>& factors() const { return factors_; }

 private:
  static constexpr int max_depth = 100;

  [[noreturn]] void fail(std::size_t position, const std::string& what) const {
    throw InputError(fmt::format("kernel \"{}\", column {}: {}", shortened(text_), position + 1, what));
  }

  [[nodiscard]] char peek() {
    while (position_ < text_.size() && std::isspace(static_cast<unsigned char>(text_[position_]))) ++position_;
    return position_ < text_.size() ? text_[position_] : '\0';
  }

  bool take(char mark) {
    if (peek() != mark) return false;
    ++position_;
    return true;
  }

  std::vector<Product> sum() {
    std::vector<Product> products = product();
    while (take('+')) {
      const std::vector<Product> more = product();
      require_size(size_of(products) + size_of(more));
      products.insert(products.end(), more.begin(), more.end());
    }
    return products;
  }

  std::vector<Product> product() {
    std::vector<Product> left = factor();
    while (take('*')) {
      const std::vector<Product> right = factor();
      require_size(size_of(left) * right.size() + left.size() * size_of(right));
      std::vector<Product> all;
      for (Product& a : left) {
        for (std::size_t k = 0; k < right.size(); ++k) {
          all.push_back(k + 1 < right.size() ? a : std::move(a));
          all.back().insert(all.back().end(), right[k].begin(), right[k].end());
        }
      }
      left = std::move(all);
    }
    return left;
  }

  // of all products together
  static std::size_t size_of(const std::vector<Product>& products) {
    return std::accumulate(products.begin(), products.end(), std::size_t{0},
                           [](auto n, const auto& one) { return n + one.size(); });
  }

  void require_size(std::size_t n_factors) const {
    constexpr std::size_t most = 20'000;
    if (n_factors > most) fail(position_, fmt::format("more than {} factors, its parentheses multiplied out", most));
  }

  std::vector<Product> factor() {
    if (peek() != '(') return {Product{name()}};
    const std::size_t open = position_++;
    if (++depth_ > max_depth) fail(open, fmt::format("parentheses are nested deeper than {}", max_depth));
    std::vector<Product> inside = sum();
    if (!take(')')) fail(open, "this '(' is not closed");
    --depth_;
    const char next = peek();
    if (next != '\0' && next != '+' && next != '*' && next != ')') fail(position_, "expected '+' or '*' after ')'");
    return inside;
  }

  // what stands up to the next mark
  std::size_t name() {
    const std::size_t end = std::min(text_.find_first_of("+*()", position_), text_.size());
    const std::string_view word = trim(text_.substr(position_, end - position_));
    if (end < text_.size() && text_[end] == '(' && !word.empty()) fail(end, "expected '+' or '*' before '('");
    factors_.push_back(primitive_of(word, text_));
    position_ = end;
    return factors_.size() - 1;
  }

  std::string_view text_;
  std::size_t position_ = 0;
  int depth_ = 0;
  std::vector<Primitive> factors_;
  std::vector<Product> products_;
};

// "lengthscale" of the feature d, or "alpha" of none
bool is_of_feature(Kernel::ParameterKind kind) { return kind != Kernel::ParameterKind::shape; }

const char* word(Kernel::ParameterKind kind) {
  if (kind == Kernel::ParameterKind::shape) return "alpha";
  return kind == Kernel::ParameterKind::period ? "period" : "lengthscale";
}

}  // namespace

Kernel Kernel::parse(std::string_view text, std::span<const std::string> features) {
  Kernel kernel;
  kernel.text_ = std::string(trim(text));
  kernel.n_features_ = static_cast<int>(features.size());

  const KernelText written(text);
  const std::vector<Primitive>& primitives = written.factors();

  // parameter names carry the kernel's name only where there are several, and a number only where one stands twice
  std::map<Primitive, int> n_uses, n_seen;
  for (const Primitive primitive : primitives) ++n_uses[primitive];
  std::vector<std::string> prefixes;
  for (const Primitive primitive : primitives) {
    const std::string name(primitive_names()[static_cast<std::size_t>(primitive)]);
    const int number = ++n_seen[primitive];
    prefixes.push_back(primitives.size() == 1 ? "" : n_uses[primitive] == 1 ? name + "." : fmt::format("{}{}.", name, number));
  }
  // a factor of several products is one and the same in all of them
  std::vector<std::optional<Factor>> made(primitives.size());
  const auto make = [&](std::size_t k) {
    const Primitive primitive = primitives[k];
    made[k] = {primitive, static_cast<int>(kernel.parameters_.size()), kernel.n_scaled_columns_};
    if (parameter_kinds(primitive).empty()) return;
    kernel.n_scaled_columns_ += kernel.n_features_;
    for (const ParameterKind kind : parameter_kinds(primitive)) {
      if (!is_of_feature(kind)) kernel.parameters_.push_back({kind, -1, prefixes[k] + word(kind)});
      for (std::size_t d = 0; is_of_feature(kind) && d < features.size(); ++d) {
        kernel.parameters_.push_back({kind, static_cast<int>(d), fmt::format("{}{}({})", prefixes[k], word(kind), features[d])});
      }
    }
    if (kernel.parameters_.size() > max_parameters) {
      throw InputError(fmt::format("a kernel of {} factors on {} features has more than {} hyperparameters; use fewer",
                                   primitives.size(), features.size(), max_parameters));
    }
  };
  for (const KernelText::Product& product : written.products()) {
    Term term{-1, {}};
    // an amplitude goes by the first factor that is in no term before, and where there is none by all
    std::string name_of_new, name_of_all;
    for (const std::size_t k : product) {
      const bool is_new = !made[k];
      if (is_new) make(k);
      if (is_new && name_of_new.empty()) name_of_new = prefixes[k];
      name_of_all += prefixes[k];
      term.factors.push_back(*made[k]);
    }
    if (!kernel.terms_.empty()) {
      term.amplitude = static_cast<int>(kernel.parameters_.size());
      kernel.parameters_.push_back(
          {ParameterKind::amplitude, -1, (name_of_new.empty() ? name_of_all : name_of_new) + "amplitude"});
    }
    kernel.terms_.push_back(std::move(term));
  }
  return kernel;
}

MatrixXd Kernel::evaluate(const Ref<const MatrixXd>& left, const Ref<const MatrixXd>& right,
                          const Ref<const VectorXd>& values) const {
  require_shape("Kernel::evaluate: the points on the left", left, left.rows(), n_features());
  require_shape("Kernel::evaluate: the points on the right", right, right.rows(), n_features());
  require_shape("Kernel::evaluate: values", values, std::ssize(parameters()), 1);
  const KernelColumns columns(*this, left, values);
  KernelColumns::Workspace workspace;
  VectorXd point, column(columns.n_rows());
  MatrixXd k(left.rows(), right.rows());
  for (Index j = 0; j < right.rows(); ++j) {
    columns.scale(right.row(j).transpose(), point);
    columns.evaluate(0, columns.n_rows(), point, column.data(), workspace);
    k.col(j) = column.head(left.rows());
  }
  return k;
}

}  // namespace gp2
