#include "gp2/view.hpp"

#include <algorithm>
#include <numeric>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;
using Quantity = View::Quantity;

namespace {

// G and d of every row of a quantity at one state, or their derivatives
struct Affine {
  MatrixXd G;
  VectorXd d;
};

Affine evaluate_at(const View& view, const MechanicsBatch& mechanics, const Ref<const MatrixXd>& states, int i) {
  const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
  const MatrixXd& T = projection.T();
  const VectorXd& Lb = projection.Lb();
  const Eigen::Index nq = T.rows();
  // Aᵀλ = M ddq − M'ā
  const auto constraint_force = [&]() -> Affine {
    const auto M = mechanics.values.M(i);
    return {M * T - projection.mass(), M * Lb};
  };
  switch (view.quantity) {
    case Quantity::constrained_acceleration:
      return {T, Lb};
    case Quantity::unconstrained_acceleration:
      return {MatrixXd::Identity(nq, nq), VectorXd::Zero(nq)};
    case Quantity::constraint_force:
      return constraint_force();
    case Quantity::multipliers: {
      const MatrixXd K = projection.multipliers_of_force();
      const Affine force = constraint_force();
      return {K * force.G, K * force.d};
    }
    case Quantity::next_velocity:
      return {view.time_step * T, states.col(i).segment(nq, nq) + view.time_step * Lb};
  }
  return {};
}

Affine differentiate_at(const View& view, const MechanicsBatch& mechanics, const SystemValues& derivative, int i) {
  const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
  const Eigen::Index nq = projection.T().rows();
  const auto dM = derivative.M(i);
  const auto dA = derivative.A(i);
  if (view.quantity == Quantity::unconstrained_acceleration) return {MatrixXd::Zero(nq, nq), VectorXd::Zero(nq)};
  if (view.quantity == Quantity::multipliers) {
    // λ = Λ (b − A ā) − Σ b
    if (projection.rank() < dA.rows()) {
      throw InputError(
          "multipliers of redundant constraints cannot be observed while parameters are estimated: leave out the rows "
          "that follow from others");
    }
    const MatrixXd Lambda = projection.Lambda();
    const MatrixXd dLambda = projection.differentiate_Lambda(dM, dA);
    return {-(dLambda * mechanics.values.A(i) + Lambda * dA),
            dLambda * mechanics.values.b(i) + Lambda * derivative.b(i) - projection.row_masses().cwiseProduct(derivative.b(i))};
  }
  const UdwadiaKalaba::Derivative d = projection.differentiate(dM, dA, derivative.b(i));
  if (view.quantity == Quantity::constraint_force) {
    const auto M = mechanics.values.M(i);
    return {dM * projection.T() + M * d.T - projection.differentiate_mass(dM, dA), dM * projection.Lb() + M * d.Lb};
  }
  const double factor = view.quantity == Quantity::next_velocity ? view.time_step : 1;
  return {factor * d.T, factor * d.Lb};
}

// the rows of the view at every state
template <typename At>
ViewValues collect(const View& view, const MechanicsBatch& mechanics, const At& at) {
  const Eigen::Index nq = mechanics.values.force.rows();
  const int n_states = mechanics.values.n_states();
  ViewValues out{MatrixXd(view.size() * nq, n_states), MatrixXd(view.size(), n_states)};
  for (int i = 0; i < n_states; ++i) {
    const Affine affine = at(i);
    Eigen::Map<MatrixXd>(out.matrix.col(i).data(), view.size(), nq) = affine.G(view.rows, Eigen::all);
    out.offset.col(i) = affine.d(view.rows);
  }
  // what a latent adds has no part of the offset
  if (view.latent >= 0) out.offset.setZero();
  return out;
}

}  // namespace

View View::all(Quantity quantity, const System& system) {
  const int size = quantity == Quantity::multipliers ? system.nc() : system.nq();
  View view{quantity, std::vector<int>(static_cast<std::size_t>(size))};
  std::iota(view.rows.begin(), view.rows.end(), 0);
  return view;
}

const std::vector<std::string>& View::quantity_words() {
  // in the order of Quantity
  static const std::vector<std::string> words = {"constrained", "unconstrained", "constraint-force", "multipliers",
                                                 "next-velocity"};
  return words;
}

std::string View::word(Quantity quantity) { return quantity_words()[static_cast<std::size_t>(quantity)]; }

std::optional<Quantity> View::quantity_of(std::string_view word) {
  const auto found = std::find(quantity_words().begin(), quantity_words().end(), word);
  if (found == quantity_words().end()) return std::nullopt;
  return static_cast<Quantity>(found - quantity_words().begin());
}

std::vector<bool> View::reads(const System& system) const {
  std::vector<bool> reads(static_cast<std::size_t>(system.layout().size()), false);
  if (quantity != Quantity::next_velocity || latent >= 0) return reads;
  for (int row : rows) reads[static_cast<std::size_t>(system.layout().dq(row))] = true;
  return reads;
}

std::vector<std::string> View::names(const System& system, const std::string& latent_name) const {
  std::vector<std::string> names;
  for (int row : rows) {
    const auto coordinate = [&] { return system.coordinates()[static_cast<std::size_t>(row)]; };
    const auto name = [&]() -> std::string {
      switch (quantity) {
        case Quantity::constrained_acceleration:
          return coordinate().acceleration();
        case Quantity::unconstrained_acceleration:
          return fmt::format("abar_{}", coordinate().name);
        case Quantity::constraint_force:
          return fmt::format("fc_{}", coordinate().name);
        case Quantity::multipliers:
          return fmt::format("lambda{}", row + 1);
        case Quantity::next_velocity:
          return fmt::format("{}_next", coordinate().velocity());
      }
      return "";
    };
    names.push_back(latent < 0 ? name() : fmt::format("{}@{}", name(), latent_name));
  }
  return names;
}

ViewValues evaluate_view(const View& view, const MechanicsBatch& mechanics, const Ref<const MatrixXd>& states) {
  return collect(view, mechanics, [&](int i) { return evaluate_at(view, mechanics, states, i); });
}

ViewValues differentiate_view(const View& view, const MechanicsBatch& mechanics, const SystemValues& derivative) {
  return collect(view, mechanics, [&](int i) { return differentiate_at(view, mechanics, derivative, i); });
}

}  // namespace gp2
