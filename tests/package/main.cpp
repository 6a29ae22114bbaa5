// Uses an installed gp2 from outside: reads an expression, differentiates it, evaluates both.
#include <array>
#include <cmath>
#include <cstdio>
#include <gp2/expression.hpp>
#include <span>
#include <string>
#include <string_view>

int main() {
  gp2::ExpressionGraph graph;
  const auto q = graph.variable("q");
  const auto e = gp2::parse_expression(
      "q^2 + sin(q)", graph, [&](std::string_view) { return q; }, std::span<const std::string>{});
  const auto de_dq = graph.differentiate(e, q);

  const std::array<gp2::Expression, 2> outputs{e, de_dq};
  const std::array<gp2::Expression, 1> inputs{q};
  Eigen::MatrixXd results;
  gp2::Tape(outputs, inputs).evaluate(Eigen::MatrixXd::Constant(1, 1, 0.5), Eigen::VectorXd(), results);

  std::printf("d/dq (%s) = %s = %.15g at q = 0.5\n", gp2::to_string(e).c_str(), gp2::to_string(de_dq).c_str(), results(1, 0));
  const bool right =
      std::abs(results(0, 0) - (0.25 + std::sin(0.5))) < 1e-15 && std::abs(results(1, 0) - (1 + std::cos(0.5))) < 1e-15;
  return right ? 0 : 1;
}
