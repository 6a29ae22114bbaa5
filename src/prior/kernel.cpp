#include "gp2/kernel.hpp"

#include <array>
#include <cctype>
#include <cmath>
#include <map>
#include <numbers>
#include <utility>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::ArrayXd;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Primitive = Kernel::Primitive;

namespace {

constexpr std::array<std::pair<std::string_view, Primitive>, 7> primitive_names = {{{"se", Primitive::se},
                                                                                    {"matern32", Primitive::matern32},
                                                                                    {"matern52", Primitive::matern52},
                                                                                    {"rq", Primitive::rq},
                                                                                    {"periodic", Primitive::periodic},
                                                                                    {"linear", Primitive::linear},
                                                                                    {"constant", Primitive::constant}}};

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
  for (const auto& [known, primitive] : primitive_names) {
    if (known == name) return primitive;
  }
  std::string known_names;
  for (const auto& [known, primitive] : primitive_names) known_names += fmt::format(" {}", known);
  throw InputError(fmt::format("kernel \"{}\": unknown kernel '{}'; use sums and products of{}", text, name, known_names));
}

bool is_stationary(Primitive primitive) {
  return primitive == Primitive::se || primitive == Primitive::matern32 || primitive == Primitive::matern52 ||
         primitive == Primitive::rq;
}

// r² = Σ_d ((φ_id − φ'_d)/ℓ_d)² into `out`
void squared_distance(const Ref<const MatrixXd>& features, const Ref<const VectorXd>& point, const double* lengthscales,
                      Ref<ArrayXd> out) {
  out.setZero();
  for (Index d = 0; d < features.cols(); ++d) {
    out += ((features.col(d).array() - point[d]) * (1 / lengthscales[d])).square();
  }
}

// a primitive's value from r² (stationary) or from the features, into `out`
void evaluate_primitive(Primitive primitive, const Ref<const MatrixXd>& features, const Ref<const VectorXd>& point,
                        const double* v, Ref<ArrayXd> out) {
  const Index n_features = features.cols();
  if (is_stationary(primitive)) squared_distance(features, point, v, out);
  switch (primitive) {
    case Primitive::se:
      out = (-0.5 * out).exp();
      break;
    case Primitive::matern32:
      out = std::sqrt(3.0) * out.sqrt();
      out = (1 + out) * (-out).exp();
      break;
    case Primitive::matern52:
      out = std::sqrt(5.0) * out.sqrt();
      out = (1 + out + out.square() / 3) * (-out).exp();
      break;
    case Primitive::rq:
      out = (-v[n_features] * (1 + out / (2 * v[n_features])).log()).exp();
      break;
    case Primitive::periodic:
      out.setZero();
      for (Index d = 0; d < n_features; ++d) {
        const double inverse_period = std::numbers::pi / v[n_features + d];
        out += (((features.col(d).array() - point[d]) * inverse_period).sin() / v[d]).square();
      }
      out = (-2 * out).exp();
      break;
    case Primitive::linear:
      out.setZero();
      for (Index d = 0; d < n_features; ++d) out += features.col(d).array() * (point[d] / (v[d] * v[d]));
      break;
    case Primitive::constant:
      out.setOnes();
      break;
  }
}

// adds Σ_i weight_i ∂(primitive)/∂log v to gradient; `value` is the primitive's value and `scratch` is overwritten
void add_primitive_gradient(Primitive primitive, const Ref<const MatrixXd>& features, const Ref<const VectorXd>& point,
                            const double* v, const Ref<const ArrayXd>& value, const Ref<const ArrayXd>& weight,
                            Ref<ArrayXd> scratch, double* gradient) {
  const Index n_features = features.cols();
  const auto delta = [&](Index d) { return features.col(d).array() - point[d]; };
  switch (primitive) {
    case Primitive::se:
      scratch = weight * value;  // −2 dk/d(r²) = k
      break;
    case Primitive::matern32:
      squared_distance(features, point, v, scratch);
      scratch = weight * 3 * (-std::sqrt(3.0) * scratch.sqrt()).exp();  // −2 dk/d(r²)
      break;
    case Primitive::matern52:
      squared_distance(features, point, v, scratch);
      scratch = std::sqrt(5.0) * scratch.sqrt();
      scratch = weight * (5.0 / 3.0) * (1 + scratch) * (-scratch).exp();  // −2 dk/d(r²)
      break;
    case Primitive::rq: {
      const double alpha = v[n_features];
      squared_distance(features, point, v, scratch);
      scratch = 1 + scratch / (2 * alpha);
      gradient[n_features] += (weight * value * alpha * (1 - scratch.inverse() - scratch.log())).sum();
      scratch = weight * value / scratch;  // −2 dk/d(r²)
      break;
    }
    case Primitive::periodic:
      scratch = weight * value * 4;
      for (Index d = 0; d < n_features; ++d) {
        const double inverse_period = std::numbers::pi / v[n_features + d];
        const double inverse_square = 1 / (v[d] * v[d]);
        gradient[d] += (scratch * (delta(d) * inverse_period).sin().square()).sum() * inverse_square;
        gradient[n_features + d] +=
            0.5 * (scratch * (2 * inverse_period * delta(d)).sin() * delta(d)).sum() * inverse_period * inverse_square;
      }
      return;
    case Primitive::linear:
      for (Index d = 0; d < n_features; ++d) {
        gradient[d] -= 2 * (weight * features.col(d).array()).sum() * point[d] / (v[d] * v[d]);
      }
      return;
    case Primitive::constant:
      return;
  }
  // stationary: ∂k/∂log ℓ_d = −2 dk/d(r²) (Δ_d/ℓ_d)²
  for (Index d = 0; d < n_features; ++d) gradient[d] += (scratch * delta(d).square()).sum() / (v[d] * v[d]);
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
    const std::string name(primitive_names[static_cast<std::size_t>(primitive)].first);
    return n_uses[primitive] == 1 ? name + "." : fmt::format("{}{}.", name, number);
  };
  for (const std::vector<Primitive>& product : sum) {
    Term term{-1, {}};
    std::string term_prefix;
    for (Primitive primitive : product) {
      const std::string prefix = prefix_of(primitive);
      if (term_prefix.empty()) term_prefix = prefix;
      term.factors.push_back({primitive, static_cast<int>(kernel.parameters_.size())});
      if (primitive == Primitive::constant) continue;
      for (std::size_t d = 0; d < features.size(); ++d) {
        kernel.parameters_.push_back(
            {primitive == Primitive::periodic ? ParameterKind::periodic_lengthscale : ParameterKind::lengthscale,
             static_cast<int>(d), fmt::format("{}lengthscale({})", prefix, features[d])});
      }
      if (primitive == Primitive::periodic) {
        for (std::size_t d = 0; d < features.size(); ++d) {
          kernel.parameters_.push_back(
              {ParameterKind::period, static_cast<int>(d), fmt::format("{}period({})", prefix, features[d])});
        }
      }
      if (primitive == Primitive::rq) kernel.parameters_.push_back({ParameterKind::shape, -1, prefix + "alpha"});
    }
    if (!kernel.terms_.empty()) {
      term.amplitude = static_cast<int>(kernel.parameters_.size());
      kernel.parameters_.push_back({ParameterKind::amplitude, -1, term_prefix + "amplitude"});
    }
    kernel.terms_.push_back(std::move(term));
  }
  return kernel;
}

void Kernel::evaluate(const Ref<const MatrixXd>& features, const Ref<const VectorXd>& point, const Ref<const VectorXd>& values,
                      Ref<VectorXd> out, Workspace& workspace) const {
  const Index n = features.rows();
  if (terms_.size() == 1 && terms_[0].factors.size() == 1) {
    evaluate_primitive(terms_[0].factors[0].primitive, features, point, values.data() + terms_[0].factors[0].first_parameter,
                       out.array());
    return;
  }
  if (workspace.columns.rows() < n || workspace.columns.cols() < 2) workspace.columns.resize(n, 2);
  auto product = workspace.columns.col(0).head(n);
  auto factor_value = workspace.columns.col(1).head(n);
  out.setZero();
  for (const Term& term : terms_) {
    product.setConstant(term.amplitude < 0 ? 1 : values[term.amplitude] * values[term.amplitude]);
    for (const Factor& factor : term.factors) {
      evaluate_primitive(factor.primitive, features, point, values.data() + factor.first_parameter, factor_value);
      product *= factor_value;
    }
    out.array() += product;
  }
}

void Kernel::add_gradient(const Ref<const MatrixXd>& features, const Ref<const VectorXd>& point,
                          const Ref<const VectorXd>& values, const Ref<const VectorXd>& w, Ref<VectorXd> gradient,
                          Workspace& workspace) const {
  const Index n = features.rows();
  std::size_t n_factors = 1;
  for (const Term& term : terms_) n_factors = std::max(n_factors, term.factors.size());
  const Index n_columns = static_cast<Index>(n_factors) + 2;
  if (workspace.columns.rows() < n || workspace.columns.cols() < n_columns) workspace.columns.resize(n, n_columns);
  auto weight = workspace.columns.col(0).head(n);
  auto scratch = workspace.columns.col(1).head(n);
  const auto factor_value = [&](std::size_t f) { return workspace.columns.col(static_cast<Index>(f) + 2).head(n); };

  for (const Term& term : terms_) {
    for (std::size_t f = 0; f < term.factors.size(); ++f) {
      evaluate_primitive(term.factors[f].primitive, features, point, values.data() + term.factors[f].first_parameter,
                         factor_value(f));
    }
    const double amplitude = term.amplitude < 0 ? 1 : values[term.amplitude] * values[term.amplitude];
    for (std::size_t f = 0; f < term.factors.size(); ++f) {
      // product rule: the weight of one factor carries all the others
      weight = amplitude * w.array();
      for (std::size_t other = 0; other < term.factors.size(); ++other) {
        if (other != f) weight *= factor_value(other);
      }
      const int first = term.factors[f].first_parameter;
      add_primitive_gradient(term.factors[f].primitive, features, point, values.data() + first, factor_value(f), weight, scratch,
                             gradient.data() + first);
    }
    if (term.amplitude >= 0) {
      scratch = 2 * amplitude * w.array();
      for (std::size_t f = 0; f < term.factors.size(); ++f) scratch *= factor_value(f);
      gradient[term.amplitude] += scratch.sum();
    }
  }
}

}  // namespace gp2
