#include "simulation/switching.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <set>
#include <utility>

#include <Eigen/QR>

#include "gp2/model.hpp"
#include "mechanics/known_multipliers.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

// ---------------------------------------------------------------- where the accelerations of a model jump

SwitchingFunctions::SwitchingFunctions(std::span<const Expression> functions, const SystemSymbols& symbols)
    : size_(static_cast<int>(functions.size())) {
  if (functions.empty()) return;
  for (const Expression& g : functions) names_.push_back(to_string(g));
  std::vector<Expression> outputs(functions.begin(), functions.end());
  std::vector<Expression> moving = symbols.q;
  moving.insert(moving.end(), symbols.dq.begin(), symbols.dq.end());
  moving.push_back(symbols.t);
  for (const Expression& x : moving) {
    for (const Expression& derivative : functions.front().graph().differentiate(functions, x)) outputs.push_back(derivative);
  }
  tape_ = Tape(outputs, symbols.state_and_parameters());
}

void SwitchingFunctions::evaluate(const Eigen::Ref<const VectorXd>& state, const Eigen::Ref<const VectorXd>& parameters,
                                  VectorXd& values, MatrixXd& gradients) const {
  MatrixXd results;
  tape_.evaluate(state, parameters, results);
  values = results.topRows(size_);
  gradients = results.bottomRows(results.rows() - size_).reshaped(size_, results.rows() / size_ - 1);
}

namespace {

// The arguments of sign() in expressions, and of |·| in denominators, that read a velocity and no input, each once and each factor by
// itself, without constants: sign(v), sign(−2 v), sign(lambda(1) v) and v/|v| are of one surface.
class ArgumentsOfSign {
 public:
  ArgumentsOfSign(ExpressionGraph& graph, const SystemSymbols& symbols) : graph_(graph), symbols_(symbols) {}

  void add(Expression e) {
    if (!seen_.insert(e.id()).second || e.operation() <= Operation::variable) return;
    if (e.operation() == Operation::sign) add_surface(e.left());
    if (e.operation() == Operation::divide && e.right().operation() == Operation::abs) add_surface(e.right().left());
    add(e.left());
    if (is_binary(e.operation())) add(e.right());
  }
  [[nodiscard]] const std::vector<Expression>& found() const { return found_; }

 private:
  static bool is_binary(Operation operation) {
    constexpr std::array binary = {Operation::add,    Operation::subtract, Operation::multiply,
                                   Operation::divide, Operation::power,    Operation::atan2,
                                   Operation::min,    Operation::max,      Operation::multiply_or_zero};
    return std::find(binary.begin(), binary.end(), operation) != binary.end();
  }

  void add_surface(Expression g) {
    while (true) {
      if (g.operation() == Operation::negate) {
        g = g.left();
      } else if (g.operation() == Operation::multiply && g.left().is_constant()) {
        g = g.right();
      } else if (g.operation() == Operation::divide && g.right().is_constant()) {
        g = g.left();
      } else {
        break;
      }
    }
    if (g.operation() == Operation::multiply || g.operation() == Operation::divide) {
      add_surface(g.left());
      add_surface(g.right());
      return;
    }
    // λ₀ and λ are no expressions of the state: where they change their sign is not looked for
    const std::vector<std::string> variables = graph_.variables_of(g);
    if (std::any_of(variables.begin(), variables.end(), is_multiplier)) return;
    const auto reads = [&](const Expression& x) { return graph_.depends_on(g, x); };
    if (std::none_of(symbols_.dq.begin(), symbols_.dq.end(), reads)) return;
    if (std::any_of(symbols_.u.begin(), symbols_.u.end(), reads)) return;
    if (std::find(found_.begin(), found_.end(), g) == found_.end()) found_.push_back(g);
  }

  ExpressionGraph& graph_;
  const SystemSymbols& symbols_;
  std::set<std::uint32_t> seen_;
  std::vector<Expression> found_;
};

}  // namespace

SwitchingFunctions switching_functions(const Model& model, bool of_latents) {
  const SystemSymbols symbols = model.symbols();
  ArgumentsOfSign arguments(*model.graph, symbols);
  const auto add = [&](const std::vector<Expression>& expressions) {
    for (const Expression& e : expressions) arguments.add(e);
  };
  if (const SymbolicSystem* system = model.symbolic_system()) add(system->definition().force);
  if (!of_latents) {
    add(model.truth);
    add(model.truth_force);
    return {arguments.found(), symbols};
  }
  for (const LatentSpec& latent : model.latents) {
    if (!latent.feature_code) {
      for (const std::string& feature : latent.features) arguments.add(model.expression(feature));
    }
    if (latent.direction_code) continue;
    for (const std::vector<std::string>& row : latent.directions) {
      for (const std::string& direction : row) arguments.add(model.expression(direction));
    }
  }
  return {arguments.found(), symbols};
}

// ---------------------------------------------------------------- motion across surfaces

Switching::Switching(const SwitchingFunctions& functions, VectorXd parameters, StateLayout layout, double tolerance)
    : functions_(functions),
      parameters_(std::move(parameters)),
      layout_(layout),
      tolerance_(tolerance),
      sides_(static_cast<std::size_t>(functions.size()), 1) {}

bool Switching::is_sliding() const { return std::find(sides_.begin(), sides_.end(), 0) != sides_.end(); }

std::vector<int> Switching::sliding() const {
  std::vector<int> surfaces;
  for (std::size_t k = 0; k < sides_.size(); ++k) {
    if (sides_[k] == 0) surfaces.push_back(static_cast<int>(k));
  }
  return surfaces;
}

Switching::Surfaces Switching::surfaces_at(const VectorXd& state) const {
  constexpr double of_tolerance = 1e-3, of_rounding = 1e-12;
  Surfaces out;
  MatrixXd gradients;
  functions_.evaluate(state, parameters_, out.g, gradients);
  const auto dq = state.segment(layout_.dq(0), layout_.nq);
  out.normals = gradients.middleCols(layout_.dq(0), layout_.nq);
  out.drift = gradients.leftCols(layout_.nq) * dq + gradients.col(layout_.t());
  out.margin =
      of_tolerance * tolerance_ * out.normals.rowwise().lpNorm<1>() + of_rounding * (out.normals.cwiseAbs() * dq.cwiseAbs());
  return out;
}

// The state with velocities changed, the least that is needed, so that it is on the given side of every surface; where the side
// is 0, on the surface.
VectorXd Switching::beside(VectorXd state, const Surfaces& surfaces, const std::vector<int>& sides) const {
  std::vector<int> rows;
  std::vector<double> changes;
  for (std::size_t k = 0; k < sides.size(); ++k) {
    const auto row = static_cast<Index>(k);
    const double wanted = sides[k] * surfaces.margin[row], g = surfaces.g[row];
    if (sides[k] != 0 && !(sides[k] * g < surfaces.margin[row])) continue;
    rows.push_back(static_cast<int>(k));
    changes.push_back(wanted - g);
  }
  if (rows.empty()) return state;
  const MatrixXd normals = surfaces.normals(rows, Eigen::all);
  if (!normals.allFinite()) return state;
  const MatrixXd T = tangent_ ? tangent_(state) : MatrixXd::Identity(layout_.nq, layout_.nq);
  MatrixXd along = normals * T;
  // Where the constraints hardly let the motion leave a surface, as a slider at its dead centre, its sides hardly act on the motion.
  constexpr double least = 1e-4;
  for (Index k = 0; k < along.rows(); ++k) {
    if (along.row(k).norm() <= least * normals.row(k).norm()) along.row(k).setZero();
  }
  state.segment(layout_.dq(0), layout_.nq) += T * along.completeOrthogonalDecomposition().solve(Eigen::Map<const VectorXd>(
                                                      changes.data(), static_cast<Index>(rows.size())));
  if (constraints_) constraints_(state);
  return state;
}

void Switching::start(const VectorXd& state, const Acceleration& acceleration) {
  const Surfaces surfaces = surfaces_at(state);
  for (std::size_t k = 0; k < sides_.size(); ++k) {
    const auto row = static_cast<Index>(k);
    sides_[k] = !(std::abs(surfaces.g[row]) > surfaces.margin[row]) ? 0 : surfaces.g[row] > 0 ? 1 : -1;
  }
  settle(state, acceleration);
}

bool Switching::has_crossed(const VectorXd& state) const {
  const Surfaces surfaces = surfaces_at(state);
  for (std::size_t k = 0; k < sides_.size(); ++k) {
    if (sides_[k] * surfaces.g[static_cast<Index>(k)] < -surfaces.margin[static_cast<Index>(k)]) return true;
  }
  return false;
}

void Switching::cross(const VectorXd& state) {
  const Surfaces surfaces = surfaces_at(state);
  for (std::size_t k = 0; k < sides_.size(); ++k) {
    if (sides_[k] * surfaces.g[static_cast<Index>(k)] < -surfaces.margin[static_cast<Index>(k)]) sides_[k] = 0;
  }
}

void Switching::hold(VectorXd& state) const {
  std::vector<int> sides = sides_;
  const Surfaces surfaces = surfaces_at(state);
  // those that are not slid on stay where they are
  for (std::size_t k = 0; k < sides.size(); ++k) {
    if (sides[k] != 0) sides[k] = surfaces.g[static_cast<Index>(k)] < 0 ? -1 : 1;
  }
  state = beside(std::move(state), surfaces, sides);
}

bool Switching::is_let_go(const VectorXd& state, const Acceleration& acceleration) {
  static_cast<void>(this->acceleration(state, acceleration));
  return (sigma_.array().abs() > 1).any();
}

VectorXd Switching::margins(const VectorXd& state, const Acceleration& acceleration) {
  static_cast<void>(this->acceleration(state, acceleration));
  VectorXd out = VectorXd::Ones(static_cast<Index>(sides_.size()));
  Index next = 0;
  for (std::size_t k = 0; k < sides_.size(); ++k) {
    if (sides_[k] == 0) out[static_cast<Index>(k)] = 1 - std::abs(sigma_[next++]);
  }
  return out;
}

void Switching::settle(const VectorXd& state, const Acceleration& acceleration) {
  bool has_changed = true;
  while (has_changed && is_sliding()) {
    static_cast<void>(this->acceleration(state, acceleration));
    has_changed = false;
    const std::vector<int> surfaces = sliding();
    for (std::size_t k = 0; k < surfaces.size(); ++k) {
      const double sigma = sigma_[static_cast<Index>(k)];
      if (std::abs(sigma) <= 1) continue;
      sides_[static_cast<std::size_t>(surfaces[k])] = sigma > 0 ? 1 : -1;
      has_changed = true;
    }
  }
}

Switching::Values Switching::evaluate(const VectorXd& state, const Surfaces& surfaces, const Function& function) const {
  std::vector<int> sides = sides_;
  std::replace(sides.begin(), sides.end(), 0, 1);
  const std::vector<int> slid_on = sliding();
  const auto side_of = [&](std::size_t k) -> int& { return sides[static_cast<std::size_t>(slid_on[k])]; };
  const auto value = [&] { return function(beside(state, surfaces, sides)); };
  const std::size_t n = slid_on.size();
  Values out;
  out.above = value();
  out.jumps.resize(out.above.size(), static_cast<Index>(n));
  for (std::size_t k = 0; k < n; ++k) {
    side_of(k) = -1;
    out.jumps.col(static_cast<Index>(k)) = (out.above - value()) / 2;
    side_of(k) = 1;
  }
  // more surfaces at a time than this are taken for ones whose jumps add up
  constexpr std::size_t most = 8;
  if (n < 2 || n > most) return out;
  for (std::size_t k = 0; k < n; ++k) side_of(k) = -1;
  const VectorXd below = value();
  constexpr double rounding = 1e-9;
  const double size = out.above.norm() + out.jumps.norm();
  if (!((out.above - 2 * out.jumps.rowwise().sum() - below).norm() > rounding * size)) return out;
  const Index n_corners = Index{1} << n;
  out.corners.resize(out.above.size(), n_corners);
  out.corners.col(0) = out.above;
  out.corners.col(n_corners - 1) = below;
  for (Index corner = 1; corner < n_corners - 1; ++corner) {
    const bool is_of_one = (corner & (corner - 1)) == 0;
    Index first = 0;
    for (std::size_t k = 0; k < n; ++k) {
      const bool is_below = ((corner >> k) & 1) != 0;
      side_of(k) = is_below ? -1 : 1;
      if (is_below) first = static_cast<Index>(k);
    }
    out.corners.col(corner) = is_of_one ? VectorXd(out.above - 2 * out.jumps.col(first)) : VectorXd(value());
  }
  return out;
}

namespace {

// of the corner among those that differ in other surfaces than `without`; all when −1
double weight(Index corner, const VectorXd& share, Index without) {
  double product = 1;
  for (Index k = 0; k < share.size(); ++k) {
    if (k == without) continue;
    product *= ((corner >> k) & 1) != 0 ? share[k] / 2 : 1 - share[k] / 2;
  }
  return product;
}

}  // namespace

VectorXd Switching::mixture(const Values& values, const VectorXd& share) {
  if (values.corners.size() == 0) return values.above - values.jumps * share;
  VectorXd sum = VectorXd::Zero(values.above.size());
  for (Index corner = 0; corner < values.corners.cols(); ++corner) sum += weight(corner, share, -1) * values.corners.col(corner);
  return sum;
}

MatrixXd Switching::slopes(const Values& values, const VectorXd& share) {
  if (values.corners.size() == 0) return values.jumps;
  MatrixXd out = MatrixXd::Zero(values.jumps.rows(), values.jumps.cols());
  for (Index corner = 0; corner < values.corners.cols(); ++corner) {
    for (Index k = 0; k < share.size(); ++k) {
      const double sign = ((corner >> k) & 1) != 0 ? -1 : 1;
      out.col(k) += sign / 2 * weight(corner, share, k) * values.corners.col(corner);
    }
  }
  return out;
}

// ġ = drift + N f = 0 for s = 1 − σ of each surface that is slid on: in one step of Newton's method where jumps add up, as those of
// most forces do. A surface that would need s outside [0, 2] cannot hold the motion: s stays at the end of the range, and the others
// are solved anew.
VectorXd Switching::acceleration(const VectorXd& state, const Acceleration& acceleration) {
  const Surfaces surfaces = surfaces_at(state);
  const Values values = evaluate(state, surfaces, acceleration);
  std::vector<int> slid_on = sliding();
  const auto n = static_cast<Index>(slid_on.size());
  share_.setZero(n);
  sigma_.setOnes(n);
  const MatrixXd normals = surfaces.normals(slid_on, Eigen::all);
  const VectorXd drift = surfaces.drift(slid_on);
  const MatrixXd gain = normals * values.jumps;
  const VectorXd rate = drift + normals * values.above;
  std::vector<int> open;
  for (int k = 0; k < static_cast<int>(n); ++k) {
    if (gain(k, k) < 0) {
      open.push_back(k);
    } else {  // its sides do not both drive the motion onto this surface
      share_[k] = rate[k] < 0 ? 2 : 0;
      sigma_[k] = rate[k] < 0 ? -2 : 2;
    }
  }
  while (!open.empty()) {
    VectorXd solved = share_(open);
    constexpr int most_steps = 30;
    constexpr double enough = 1e-14, farthest = 4;
    for (int step = 0; step < most_steps; ++step) {
      VectorXd share = share_;
      share(open) = solved;
      const VectorXd rest = (drift + normals * mixture(values, share))(open);
      const MatrixXd slope = (normals * slopes(values, share))(open, open);
      const VectorXd change = slope.completeOrthogonalDecomposition().solve(rest);
      solved += change;
      if (values.corners.size() == 0 || change.norm() <= enough) break;
      solved = solved.cwiseMax(-farthest).cwiseMin(2 + farthest);
    }
    std::size_t worst = 0;
    double excess = 0;
    for (std::size_t k = 0; k < open.size(); ++k) {
      const double s = solved[static_cast<Index>(k)], beyond = std::max(-s, s - 2);
      if (!(beyond <= excess)) worst = k, excess = beyond;
    }
    if (excess == 0) {
      share_(open) = solved;
      sigma_(open) = 1 - solved.array();
      break;
    }
    const int k = open[worst];
    share_[k] = solved[static_cast<Index>(worst)] > 2 ? 2 : 0;
    sigma_[k] = share_[k] > 0 ? -2 : 2;
    open.erase(open.begin() + static_cast<std::ptrdiff_t>(worst));
    for (const int other : open) share_[other] = 0;
  }
  return mixture(values, share_);
}

VectorXd Switching::acceleration_anew(const VectorXd& state, const Acceleration& acceleration) {
  const std::vector<int> before = sides_;
  start(state, acceleration);
  VectorXd ddq = this->acceleration(state, acceleration);
  sides_ = before;
  return ddq;
}

VectorXd Switching::mixed(const VectorXd& state, const Function& function) const {
  if (is_empty()) return function(state);
  return mixture(evaluate(state, surfaces_at(state), function), share_);
}

}  // namespace gp2
