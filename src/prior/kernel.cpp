#include "gp2/prior/kernel.hpp"

#include <cctype>
#include <map>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

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

std::vector<std::string_view> split(std::string_view text, char separator) {
  std::vector<std::string_view> parts;
  while (true) {
    const std::size_t end = text.find(separator);
    parts.push_back(trim(text.substr(0, end)));
    if (end == std::string_view::npos) return parts;
    text.remove_prefix(end + 1);
  }
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
  throw InputError(fmt::format("kernel \"{}\": unknown kernel '{}'{}; use sums and products of {}", text, name,
                               other == std::end(others) ? "" : fmt::format(", here called {}", other->second),
                               fmt::join(known, " ")));
}

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

  std::vector<std::vector<Primitive>> sum;
  std::map<Primitive, int> n_uses;
  int n_factors = 0;
  for (std::string_view product : split(text, '+')) {
    sum.emplace_back();
    for (std::string_view name : split(product, '*')) {
      sum.back().push_back(primitive_of(name, text));
      ++n_uses[sum.back().back()];
      ++n_factors;
    }
  }

  // parameter names carry the kernel's name only where there are several, and a number only where one stands twice
  std::map<Primitive, int> n_seen;
  const auto prefix_of = [&](Primitive primitive) -> std::string {
    const int number = ++n_seen[primitive];
    if (n_factors == 1) return "";
    const std::string name(primitive_names()[static_cast<std::size_t>(primitive)]);
    return n_uses[primitive] == 1 ? name + "." : fmt::format("{}{}.", name, number);
  };
  for (const std::vector<Primitive>& product : sum) {
    Term term{-1, {}};
    std::string term_prefix;
    for (Primitive primitive : product) {
      const std::string prefix = prefix_of(primitive);
      if (term_prefix.empty()) term_prefix = prefix;
      term.factors.push_back({primitive, static_cast<int>(kernel.parameters_.size()), kernel.n_scaled_columns_});
      if (parameter_kinds(primitive).empty()) continue;
      kernel.n_scaled_columns_ += kernel.n_features_;
      for (const ParameterKind kind : parameter_kinds(primitive)) {
        if (!is_of_feature(kind)) kernel.parameters_.push_back({kind, -1, prefix + word(kind)});
        for (std::size_t d = 0; is_of_feature(kind) && d < features.size(); ++d) {
          kernel.parameters_.push_back({kind, static_cast<int>(d), fmt::format("{}{}({})", prefix, word(kind), features[d])});
        }
      }
      if (kernel.parameters_.size() > max_parameters) {
        throw InputError(fmt::format("a kernel of {} factors on {} features has more than {} hyperparameters; use fewer",
                                     n_factors, features.size(), max_parameters));
      }
    }
    if (!kernel.terms_.empty()) {
      term.amplitude = static_cast<int>(kernel.parameters_.size());
      kernel.parameters_.push_back({ParameterKind::amplitude, -1, term_prefix + "amplitude"});
    }
    kernel.terms_.push_back(std::move(term));
  }
  return kernel;
}

MatrixXd Kernel::evaluate(const Ref<const MatrixXd>& left, const Ref<const MatrixXd>& right,
                          const Ref<const VectorXd>& values) const {
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
