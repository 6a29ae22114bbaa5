#include <fmt/format.h>

#include "export/c_kernel_pieces.hpp"
#include "export/c_writer.hpp"
#include "prior/primitive.hpp"

namespace gp2::c_export {

using Eigen::Index;
using Primitive = Kernel::Primitive;

namespace {

std::string_view word(Primitive primitive) { return primitive_names()[static_cast<std::size_t>(primitive)]; }

// s² of a product of kernels
std::string square_of_amplitude(const Kernel::Term& product) {
  return product.amplitude < 0 ? "1" : fmt::format("a->kernel[{0}] * a->kernel[{0}]", product.amplitude);
}

// "times_rq(n, 3, x, p, a->scale + 3, a->kernel + 3, scratch, value);"
std::string factor_call(const std::string& verb, const Kernel::Factor& factor, Index D, const std::string& value) {
  const bool has_parameters = factor.primitive == Primitive::rq || factor.primitive == Primitive::periodic;
  return fmt::format("  {}_{}(n, {}, x, p, a->scale + {},{} scratch, {});\n", verb, word(factor.primitive), D,
                     factor.first_column, has_parameters ? fmt::format(" a->kernel + {},", factor.first_parameter) : "", value);
}

std::string start(const std::string& what, const std::string& value) {
  return fmt::format("  for (int i = 0; i < n; ++i) {}[i] = {};\n", what, value);
}

std::string from_zero(const std::string& n, const std::string& body) {
  return fmt::format("  for (int j = 0; j < {}; ++j) out[j] = 0;\n{}", n, body);
}

// with what a body of C declares and what it does not read
std::string whole_body(const std::string& text) {
  std::string head = "  const int n = a->n;\n";
  if (text.find(" x,") != std::string::npos) head += "  const real *const x = a->points;\n";
  if (text.find("value") != std::string::npos) head += "  real *const value = scratch + n;\n";
  for (const char* const argument : {"p", "k", "scratch"}) {
    if (text.find(fmt::format(" {},", argument)) == std::string::npos &&
        text.find(fmt::format("{}[", argument)) == std::string::npos &&
        head.find(fmt::format("= {} ", argument)) == std::string::npos) {
      head += fmt::format("  (void){};\n", argument);
    }
  }
  return head + text;
}

}  // namespace

// A function of one latent, whose name goes to the texts of the latent.
void Writer::write_of(Term& term, const std::string& what, const std::string& head, const std::string& body) {
  term.filling.texts[what] = function(fmt::format("{}_{}", what, &term - terms_.data()), head, body);
}

// The gradient of a potential, kernel by kernel of its sum (theory.md, T44)
void Writer::write_potential(Term& term) {
  std::string pairs, sums, slopes, products, variance;
  Index first = 0;  // of this kernel among the pairs of all
  for (const Kernel::Term& of : term.kernel.terms()) {
    const Kernel::Factor& factor = of.factors.front();
    const std::string square = square_of_amplitude(of), at = fmt::format("pairs + {} * a->n", first),
                      scale = fmt::format("a->scale + {}", factor.first_column);
    const bool is_rq = factor.primitive == Primitive::rq;
    const auto over_points = [&](const char* function, const char* factors) {
      return fmt::format("  {}(a->n, {}, {}, {}, {}, scratch, out);\n", function, term.D, at, scale, factors);
    };
    pairs += fmt::format("  compare_points(a->n, {}, a->points, p, {}, {});\n", term.D, scale, at);
    pairs += fmt::format("  slopes_{}(a->n, {},{} {});\n", word(factor.primitive), square,
                         is_rq ? fmt::format(" a->kernel[{}],", factor.first_parameter + term.D) : "", at);
    sums += over_points("add_gradients", "a->weights");
    slopes += over_points("add_hessians", "a->weights");
    products += over_points("multiply_pairs", "loading");
    variance += fmt::format("  for (int j = 0; j < {0}; ++j) out[j] += {1} * a->scale[{2} + j] * a->scale[{2} + j]{3};\n", term.D,
                            square, factor.first_column, factor.primitive == Primitive::matern52 ? " * 5 / 3" : "");
    first += 3 + term.D;
  }
  const std::string to_out = "const latent *a, const real *pairs, real *scratch, real *out";
  write_of(term, "pairs", "const latent *a, const real *p, real *pairs", pairs);
  write_of(term, "sums", to_out, from_zero(std::to_string(term.D), sums));
  if (has("jacobian")) write_of(term, "gradient", to_out, from_zero(std::to_string(term.D * term.D), slopes));
  if (!has("stddev")) return;
  write_of(term, "products", "const latent *a, const real *pairs, const real *loading, real *scratch, real *out",
           from_zero(fmt::format("{} * a->n", term.D), products));
  write_of(term, "variance", "const latent *a, real *out", from_zero(std::to_string(term.D), variance));
}

void Writer::write_kernel(Term& term) {
  const Index D = term.D;
  std::string k, gradient, variance = "  real sum = 0;\n";
  bool is_constant = true, is_first = true;
  for (const Kernel::Term& product : term.kernel.terms()) {
    const std::string amplitude = square_of_amplitude(product), value = is_first ? "k" : "value";
    k += start(value, amplitude);
    std::string at_zero = amplitude;
    for (const Kernel::Factor& factor : product.factors) {
      if (factor.primitive == Primitive::constant) continue;
      k += factor_call("times", factor, D, value);
      if (factor.primitive == Primitive::linear) {
        at_zero += fmt::format(" * squared_norm({}, p, a->scale + {})", D, factor.first_column);
        is_constant = false;
      }
      // the derivative of this factor, the others as they are; of se alone its slope is k
      if (!term.is_se()) {
        gradient += start("value", amplitude);
        for (const Kernel::Factor& other : product.factors) {
          const bool is_slope = &other == &factor;
          if (other.primitive == Primitive::constant || (is_slope && other.primitive == Primitive::linear)) continue;
          const bool has_slope = is_slope && other.primitive != Primitive::se && other.primitive != Primitive::periodic;
          gradient += factor_call(has_slope ? "slope" : "times", other, D, "value");
        }
      }
      const std::string common = fmt::format("n, {}, {}, x,", D, term.p),
                        scale = fmt::format("a->scale + {}", factor.first_column),
                        rest = fmt::format("{}, a->weights, out);\n", term.is_se() ? "k" : "value");
      gradient += factor.primitive == Primitive::linear ? fmt::format("  add_features({} {}, {}", common, scale, rest)
                  : factor.primitive == Primitive::periodic
                      ? fmt::format("  add_sines({} p, {}, a->kernel + {}, {}", common, scale, factor.first_parameter, rest)
                      : fmt::format("  add_differences({} p, {}, {}", common, scale, rest);
    }
    if (!is_first) k += "  for (int i = 0; i < n; ++i) k[i] += value[i];\n";
    variance += fmt::format("  sum += {};\n", at_zero);
    is_first = false;
  }
  write_of(term, "covariance", "const latent *a, const real *p, real *k, real *scratch", whole_body(k));
  if (has("stddev")) {
    const bool reads_a = variance.find("a->") != std::string::npos;
    write_of(term, "variance", "const latent *a, const real *p, real *out",
             fmt::format("{}{}{}  *out = sum;\n", reads_a ? "" : "  (void)a;\n", is_constant ? "  (void)p;\n" : "", variance));
  }
  if (has("jacobian") && term.features_vary()) {
    write_of(term, "gradient", "const latent *a, const real *p, const real *k, real *scratch, real *out",
             whole_body(from_zero(std::to_string(D * term.p), gradient)));
  }
}

void Writer::write_kernels() {
  std::string& expressions = text("expressions");
  const std::size_t before = expressions.size();
  for (Term& term : terms_) {
    if (term.of->is_potential) {
      write_potential(term);
    } else {
      write_kernel(term);
    }
  }
  std::vector<Piece> pieces(std::begin(kernel_pieces), std::end(kernel_pieces));
  for (Piece& piece : pieces) {
    if (options_.single_precision && piece.name == float_exponentials.name) piece = float_exponentials;
  }
  // of latents that are no potentials, and of deviations
  const std::string sums = has("other") || has("stddev") ? " weighted_sum(" : "";
  expressions.insert(before, called_pieces(pieces, expressions + sums));
}

}  // namespace gp2::c_export
