#include "gp2/view.hpp"

#include <numeric>

namespace gp2 {

using Eigen::MatrixXd;
using Quantity = View::Quantity;

namespace {

ViewValues allocate(const View& view, const MechanicsBatch& mechanics) {
  const int nq = static_cast<int>(mechanics.values.force.rows());
  const int n_states = mechanics.values.n_states();
  return {MatrixXd::Zero(view.size() * nq, n_states), MatrixXd::Zero(view.size(), n_states)};
}

// the rows of the view out of a full (nq × nq) matrix and (nq) offset, written to column i
void store_rows(const View& view, const MatrixXd& G, const Eigen::VectorXd& d, int i, ViewValues& out) {
  Eigen::Map<MatrixXd> block(out.matrix.col(i).data(), view.size(), G.cols());
  for (int row = 0; row < view.size(); ++row) {
    block.row(row) = G.row(view.rows[static_cast<std::size_t>(row)]);
    out.offset(row, i) = d[view.rows[static_cast<std::size_t>(row)]];
  }
}

}  // namespace

View View::all(Quantity quantity, const System& system) {
  View view{quantity, std::vector<int>(static_cast<std::size_t>(system.nq()))};
  std::iota(view.rows.begin(), view.rows.end(), 0);
  return view;
}

std::vector<std::string> View::names(const System& system) const {
  std::vector<std::string> names;
  for (int row : rows) {
    const Coordinate& coordinate = system.coordinates()[static_cast<std::size_t>(row)];
    names.push_back(quantity == Quantity::constrained_acceleration ? coordinate.acceleration() : "abar_" + coordinate.name);
  }
  return names;
}

ViewValues evaluate_view(const View& view, const MechanicsBatch& mechanics) {
  ViewValues out = allocate(view, mechanics);
  const Eigen::Index nq = mechanics.values.force.rows();
  for (int i = 0; i < mechanics.values.n_states(); ++i) {
    const UdwadiaKalaba& projection = mechanics.projections[static_cast<std::size_t>(i)];
    switch (view.quantity) {
      case Quantity::constrained_acceleration:
        store_rows(view, projection.T(), projection.Lb(), i, out);
        break;
      case Quantity::unconstrained_acceleration:
        store_rows(view, MatrixXd::Identity(nq, nq), Eigen::VectorXd::Zero(nq), i, out);
        break;
    }
  }
  return out;
}

ViewValues differentiate_view(const View& view, const MechanicsBatch& mechanics, const SystemValues& derivative) {
  ViewValues out = allocate(view, mechanics);
  if (view.quantity == Quantity::unconstrained_acceleration) return out;  // G = I, d = 0 whatever the parameters
  for (int i = 0; i < mechanics.values.n_states(); ++i) {
    const UdwadiaKalaba::Derivative d =
        mechanics.projections[static_cast<std::size_t>(i)].differentiate(derivative.M(i), derivative.A(i), derivative.b(i));
    store_rows(view, d.T, d.Lb, i, out);
  }
  return out;
}

}  // namespace gp2
