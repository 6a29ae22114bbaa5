#include "export/c_writer.hpp"

#include <algorithm>

#include <fmt/format.h>

namespace gp2::c_export {

using Eigen::Index;

// What each function of the C reads and writes
void Writer::declare_workspace() {
  const Index nq = system().nq(), nc = system().nc(), nx = layout_.size(), nr = view_.size();
  const Index nmin = std::min(nq, nc), n_columns = std::min<Index>(nr, n_functions_);
  const std::string real = options_.name + "_real ";
  const auto add = [&](const std::string& names) { add_workspace(real + names + ";"); };
  add(fmt::format("M[{0}], mass[{0}], C[{0}], F[{1}], T[{0}], pivot", nq * nq, nq));
  add_workspace("int is_singular;");
  if (has("rows")) {
    add(fmt::format("A[{0}], b[{1}], sigma[{1}], weight[{2}]", nc * nq, nc, nq));
    add(fmt::format("B[{0}], A_unit[{0}], b_unit[{1}], row_scale[{1}], residual[{1}], L[{0}], Lb[{2}]", nc * nq, nc, nq));
    add(fmt::format("tau[{}]", nmin));
    add_workspace(fmt::format("int rank, n_zero_rows, is_off_constraints, order[{}];", nc));
  }
  if (has("several")) {
    add(fmt::format("R[{}], tau2[{}]", nc * nmin, nmin));
    add_workspace(fmt::format("int order2[{}];", nmin));
  }
  add(fmt::format("a_bar[{0}], force[{0}], a_of_force[{0}]", nq));
  if (has("load")) add(fmt::format("x[{}], a0[{}]", nx + nc, nq));
  if (has("nonlinear")) {
    add(fmt::format("y[{}], G_lambda[{}], d_lambda[{}], D_lambda[{}]", nx + nc, nc * nq, nc, nc * nc));
    add(fmt::format("without_load[{0}], rest_of_load[{0}], force_of_load[{0}], a_under_load[{0}], a_at_zero[{0}]", nq));
    add(fmt::format("slope[{0}], rest_slope[{0}], force_slope[{0}]", nq * nc));
    add_workspace(fmt::format("int {}order_lambda[{}];", is_partial_ ? "is_part, " : "", nc));
  }
  if (has("moved")) add(fmt::format("a[{0}], gap[{0}], of_constraint[{0}]", nq));
  if (has("applied")) add(fmt::format("applied[{}]", nq));
  Index widest = 0, most_points = 1, most_derivatives = 1;
  for (std::size_t a = 0; a < terms_.size(); ++a) {
    const Term& term = terms_[a];
    add(fmt::format("phi_{0}[{1}], signal_{0}[{2}]", a, term.D, term.p));
    if (term.of->is_potential) {
      add(fmt::format("pairs_{}[{}]", a, std::ssize(term.kernel.terms()) * (3 + term.D) * term.n_points));
      if (has("stddev")) add(fmt::format("gradient_{}[{}]", a, term.D * term.n_points));
    } else {
      add(fmt::format("k_{}[{}]", a, term.n_points));
    }
    if (term.has_directions()) add(fmt::format("B_{}[{}]", a, nq * term.p));
    if (term.is_admissible()) add(fmt::format("stated_M[{0}], P[{0}], L_P[{1}]", nq * nq, nc * nq));
    widest = std::max(widest, term.D * term.p);
    most_points = std::max(most_points, term.n_points);
    most_derivatives = std::max(most_derivatives, std::ssize(*term.features->tapes().entries));
    if (term.has_directions()) most_derivatives = std::max(most_derivatives, std::ssize(*term.directions->tapes().entries));
  }
  add(fmt::format("scratch[{}]", 2 * most_points));
  if (has("multipliers")) add(fmt::format("lambda[{}]", nc));
  if (has("least_norm")) {
    add(fmt::format("K[{}]", nc * nq));
    if (has("several")) {
      add(fmt::format("null_space[{0}], null_rows[{0}], null_tau[{1}]", nc * nc, nc));
      add_workspace(fmt::format("int null_order[{}];", nc));
    }
  }
  if (has("stddev")) {
    add(fmt::format("Gt[{0}], M_inverse_Gt[{0}], loading[{1}], cross[{2}]", nq * nr, n_functions_ * nr,
                    n_variables_ * n_columns));
    if (has("by_load")) add(fmt::format("whole_slope[{0}], Gt_of_others[{1}], M_inverse_Gt_of_others[{1}]", nq * nc, nq * nr));
    if (!has("by_function") || has("potential")) add(fmt::format("products[{}]", terms_.empty() ? 1 : terms_[0].n_points));
    if (has("sums")) add(fmt::format("rows[{}]", n_cross_rows_ * n_columns));
    if (has("mixture")) add(fmt::format("means[{0}], stddevs[{0}]", std::ssize(components_) * nr));
  }
  if (has("jacobian") || has("nonlinear")) add(fmt::format("derivative[{}]", most_derivatives));
  if (has("jacobian")) {
    const Index n = nq * nx;
    add(fmt::format("dsignal[{}]", widest));
    add(fmt::format("d_of_rest[{0}], d_force[{0}]", n));
    if (has("abar")) add(fmt::format("d_a_bar[{}]", n));
    if (has("applied")) add(fmt::format("d_applied[{}]", n));
    if (has("moved")) add(fmt::format("d_a[{0}], d_of_constraint[{0}]", n));
    if (has("moved") && has("rows")) add(fmt::format("d_forced[{}], d_rows[{}]", n, nc * nx));
    if (has("reaction")) add(fmt::format("d_mass_a_bar[{}]", n));
    if (has("least_norm")) add(fmt::format("d_along[{}]", nc * nx));
    if (has("nonlinear")) add(fmt::format("d_load[{}]", nc * nx));
    if (has("load")) add(fmt::format("d_forced0[{0}], d_rows0[{1}], d_lambda0[{1}]", n, nc * nx));
  }
  if (has("mixture")) add(has("jacobian") ? fmt::format("mean[{}], jacobian[{}]", nr, nr * nx) : fmt::format("mean[{}]", nr));
}

}  // namespace gp2::c_export
