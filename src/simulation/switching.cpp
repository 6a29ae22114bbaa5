#include "simulation/switching.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>

#include <Eigen/QR>
#include <Eigen/SVD>

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// Where the constraints hardly let the motion leave a surface, as a slider at its dead centre, its sides hardly act on the motion.
constexpr double least_way_out = 1e-4;

// How far rows of length 1 may differ that are taken for one: those of surfaces that are one, as of two feet of a box that stands flat,
// are so up to rounding alone.
constexpr double alike = 1e-6;

// 1 or −1 where two rows of length 1 are alike, up to their sign; else 0.
template <typename Row, typename Other>
double common_side(const Row& row, const Other& other) {
  const double side = row.dot(other) < 0 ? -1 : 1;
  return (row - side * other).norm() <= alike ? side : 0;
}

// The least x for A x = b. No difference between rows of length 1 is divided by up to `rounding`.
VectorXd least_solution(MatrixXd A, VectorXd b, double rounding = alike) {
  if (A.rows() == 0) return VectorXd::Zero(A.cols());
  for (Index k = 0; k < A.rows(); ++k) {
    const double length = A.row(k).norm();
    if (!(length > 0)) continue;
    A.row(k) /= length;
    b[k] /= length;
  }
  Eigen::CompleteOrthogonalDecomposition<MatrixXd> decomposition;
  decomposition.setThreshold(rounding);
  return decomposition.compute(A).solve(b);
}

}  // namespace

Switching::Switching(const SwitchingFunctions& functions, VectorXd parameters, StateLayout layout, double tolerance)
    : functions_(functions),
      parameters_(std::move(parameters)),
      layout_(layout),
      tolerance_(tolerance),
      hold_(static_cast<std::size_t>(functions.size()), Hold::none),
      first_united_(hold_.size()),
      toward_(VectorXd::Zero(functions.first().back())) {
  std::iota(first_united_.begin(), first_united_.end(), 0);
  for (int k = 0; k < functions_.size(); ++k) toward_[first_of(k)] = 1;
}

bool Switching::is_sliding() const { return std::find(hold_.begin(), hold_.end(), Hold::rest) != hold_.end(); }

bool Switching::is_guided() const {
  return std::any_of(hold_.begin(), hold_.end(), [](Hold hold) { return hold != Hold::none; });
}

std::vector<int> Switching::sliding() const {
  std::vector<int> surfaces;
  for (int k = 0; k < functions_.size(); ++k) {
    if (hold(k) == Hold::rest && first_united_[static_cast<std::size_t>(k)] == k) surfaces.push_back(k);
  }
  return surfaces;
}

std::vector<int> Switching::united_with(int first) const {
  std::vector<int> surfaces;
  for (int k = first; k < functions_.size(); ++k) {
    if (first_united_[static_cast<std::size_t>(k)] == first) surfaces.push_back(k);
  }
  return surfaces;
}

Switching::Surfaces Switching::surfaces_at(const VectorXd& state) const {
  // A line is crossed wherever the motion meets it. How near it comes to a point is left to the tolerances.
  constexpr double to_line = 1e-3, to_point = 10, of_rounding = 1e-12;
  Surfaces out;
  MatrixXd gradients;
  functions_.evaluate(state, parameters_, out.g, gradients);
  const auto dq = state.segment(layout_.dq(0), layout_.nq);
  out.normals = gradients.middleCols(layout_.dq(0), layout_.nq);
  out.drift = gradients.leftCols(layout_.nq) * dq + gradients.col(layout_.t());
  const VectorXd size = tolerance_ * out.normals.rowwise().lpNorm<1>(), rounding = out.normals.cwiseAbs() * dq.cwiseAbs();
  out.margin.resize(functions_.size());
  for (int k = 0; k < functions_.size(); ++k) {
    const double of_tolerance = part(size, k).size() == 1 ? to_line : to_point;
    out.margin[k] = of_tolerance * part(size, k).maxCoeff() + of_rounding * part(rounding, k).maxCoeff();
  }
  // surfaces that are alike are one, which is as thick as they are apart
  for (Index k = 0; k < out.normals.rows() && toward_.size() == functions_.size(); ++k) {
    for (Index other = 0; other < k; ++other) {
      const double length = out.normals.row(k).norm(), other_length = out.normals.row(other).norm();
      const auto row = out.normals.row(k) / length, other_row = out.normals.row(other) / other_length;
      const double side = common_side(row, other_row);
      if (side == 0) continue;
      const double apart = std::abs((row - side * other_row).dot(dq));
      out.margin[k] += length * apart;
      out.margin[other] += other_length * apart;
    }
  }
  return out;
}

// The state with velocities changed, the least that is needed, so that it is toward the given side of every surface; of those that
// hold it, there exactly, or on the surface where `toward` is 0. What holds it comes first: a surface beside it that is hardly apart
// from those, as of the other foot of a box that rocks, is left where it is, as only far velocities would lead back over it.
VectorXd Switching::beside(VectorXd state, const Surfaces& surfaces, const VectorXd& toward) const {
  constexpr double hardly_apart = 0.1;
  std::vector<int> rows;
  std::vector<double> changes;
  Index n_holding = 0;  // rows
  for (const bool is_holding : {true, false}) {
    for (int k = 0; k < functions_.size(); ++k) {
      if ((hold(k) != Hold::none) != is_holding) continue;
      const auto d = part(toward, k);
      const auto g = part(surfaces.g, k);
      const double along = d.dot(g), margin = surfaces.margin[k];
      if (!is_holding && !(along < margin)) continue;
      const VectorXd change = !is_holding             ? VectorXd((margin - along) * d)
                              : hold(k) == Hold::rest ? VectorXd(margin * d - g)
                                                      : VectorXd(std::max(margin, along) * d - g);
      changes.insert(changes.end(), change.begin(), change.end());
      for (Index j = 0; j < d.size(); ++j) rows.push_back(first_of(k) + static_cast<int>(j));
    }
    if (is_holding) n_holding = std::ssize(rows);
  }
  if (rows.empty()) return state;
  const MatrixXd normals = surfaces.normals(rows, Eigen::all);
  if (!normals.allFinite()) return state;
  const MatrixXd T = tangent_ ? tangent_(state) : MatrixXd::Identity(layout_.nq, layout_.nq);
  MatrixXd along = normals * T;
  for (Index k = 0; k < along.rows(); ++k) {
    if (along.row(k).norm() <= least_way_out * normals.row(k).norm()) along.row(k).setZero();
  }
  const Eigen::Map<const VectorXd> wanted(changes.data(), std::ssize(changes));
  // surfaces that were one part where their rows differ by `alike`, and hold the motion until settle() lets one of them go
  const MatrixXd holding = along.topRows(n_holding);
  const auto solve_holding = [&](const VectorXd& b) { return least_solution(holding, b, 10 * alike); };
  VectorXd x = solve_holding(wanted.head(n_holding));
  MatrixXd others = along.bottomRows(along.rows() - n_holding);
  const VectorXd left = wanted.tail(others.rows()) - others * x;
  for (Index k = 0; k < others.rows(); ++k) {
    const VectorXd row = others.row(k).transpose(), free = row - solve_holding(holding * row);
    others.row(k) = free.transpose();
    if (free.norm() <= hardly_apart * row.norm()) others.row(k).setZero();
  }
  x += least_solution(others, left);
  state.segment(layout_.dq(0), layout_.nq) += T * x;
  if (constraints_) constraints_(state);
  return state;
}

void Switching::take_sides(const VectorXd& state) {
  const Surfaces surfaces = surfaces_at(state);
  for (int k = 0; k < functions_.size(); ++k) {
    const double length = part(surfaces.g, k).norm();
    hold(k) = length > surfaces.margin[k] ? Hold::none : Hold::rest;
    if (hold(k) == Hold::none) part(toward_, k) = part(surfaces.g, k) / length;
  }
}

void Switching::start(const VectorXd& state, const Acceleration& acceleration) {
  take_sides(state);
  settle(state, acceleration);
}

bool Switching::has_crossed(const Surfaces& surfaces, int k) const {
  return hold(k) != Hold::rest && part(toward_, k).dot(part(surfaces.g, k)) < -surfaces.margin[k];
}

bool Switching::has_crossed(const VectorXd& state) const {
  const Surfaces surfaces = surfaces_at(state);
  for (int k = 0; k < functions_.size(); ++k) {
    if (has_crossed(surfaces, k)) return true;
  }
  return false;
}

void Switching::cross(const VectorXd& state) {
  constexpr double fast = 1e3;  // margins
  const Surfaces surfaces = surfaces_at(state);
  const bool is_past_any = has_crossed(state);
  for (int k = 0; k < functions_.size(); ++k) {
    if (hold(k) == Hold::direction && part(surfaces.g, k).norm() > fast * surfaces.margin[k]) hold(k) = Hold::none;
    if (!has_crossed(surfaces, k)) {
      // of surfaces that are one up to rounding one is found to be crossed first
      if (is_past_any && hold(k) == Hold::none && part(surfaces.g, k).norm() <= surfaces.margin[k]) hold(k) = Hold::rest;
      continue;
    }
    const auto d = part(toward_, k);
    const auto g = part(surfaces.g, k);
    // it may have turned, beside a point, as it may not beside a line
    hold(k) = (g - d.dot(g) * d).norm() <= surfaces.margin[k] ? Hold::rest : Hold::none;
  }
}

void Switching::turn(const VectorXd& state) {
  if (toward_.size() == functions_.size()) return;
  const Surfaces surfaces = surfaces_at(state);
  for (int k = 0; k < functions_.size(); ++k) {
    const double length = part(surfaces.g, k).norm();
    if (hold(k) == Hold::none && length > surfaces.margin[k]) part(toward_, k) = part(surfaces.g, k) / length;
  }
}

void Switching::put(VectorXd& state) const {
  VectorXd toward = toward_;
  Surfaces surfaces = surfaces_at(state);
  for (int k = 0; k < functions_.size(); ++k) {
    const double length = part(surfaces.g, k).norm();
    if (hold(k) == Hold::rest) part(toward, k).setZero();
    // what creeps, or was let go, may be slower than the margin, beside which it is evaluated
    if (hold(k) != Hold::rest) surfaces.margin[k] = 0;
    // those that hold nothing stay where they are
    if (hold(k) == Hold::none && length > 0) part(toward, k) = part(surfaces.g, k) / length;
  }
  state = beside(std::move(state), surfaces, toward);
}

bool Switching::is_let_go(const VectorXd& state, const Acceleration& acceleration) {
  static_cast<void>(this->acceleration(state, acceleration));
  return (sigma_.array().abs() > 1).any();
}

VectorXd Switching::margins(const VectorXd& state, const Acceleration& acceleration) {
  VectorXd out = VectorXd::Ones(functions_.size());
  if (is_empty()) return out;
  static_cast<void>(this->acceleration(state, acceleration));
  Index next = 0;
  for (const int k : sliding()) out[k] = 1 - std::abs(sigma_[next++]);
  return out;
}

void Switching::settle(const VectorXd& state, const Acceleration& acceleration) {
  bool has_changed = true;
  while (has_changed && is_sliding()) {
    static_cast<void>(this->acceleration(state, acceleration));
    has_changed = false;
    Index next = 0;
    for (const int k : sliding()) {
      const double sigma = sigma_[next++];
      if (std::abs(sigma) <= 1) continue;
      for (const int one : united_with(k)) {
        hold(one) = part(toward_, one).size() == 1 ? Hold::none : Hold::direction;
        if (sigma < 0) part(toward_, one) *= -1;
      }
      has_changed = true;
    }
  }
}

Switching::Values Switching::evaluate(const VectorXd& state, const Surfaces& surfaces, const Function& function) const {
  VectorXd toward = toward_;
  const std::vector<int> slid_on = sliding();
  const auto flip = [&](std::size_t k) {
    for (const int one : united_with(slid_on[k])) part(toward, one) *= -1;
  };
  const auto value = [&] { return function(beside(state, surfaces, toward)); };
  const std::size_t n = slid_on.size();
  Values out;
  out.above = value();
  out.jumps.resize(out.above.size(), static_cast<Index>(n));
  for (std::size_t k = 0; k < n; ++k) {
    flip(k);
    out.jumps.col(static_cast<Index>(k)) = (out.above - value()) / 2;
    flip(k);
  }
  // more surfaces at a time than this are taken for ones whose jumps add up
  constexpr std::size_t most = 8;
  if (n < 2 || n > most) return out;
  for (std::size_t k = 0; k < n; ++k) flip(k);
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
    toward = toward_;
    Index first = 0;
    for (std::size_t k = 0; k < n; ++k) {
      if (((corner >> k) & 1) == 0) continue;
      flip(k);
      first = static_cast<Index>(k);
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

// Rows of normals and of drift are compared along the velocities that the constraints allow.
void Switching::unite(const VectorXd& state, const Surfaces& surfaces) {
  std::iota(first_united_.begin(), first_united_.end(), 0);
  const std::vector<int> slid_on = sliding();
  // points of a plane turn, each in its own direction
  if (slid_on.size() < 2 || toward_.size() > functions_.size() || !surfaces.normals.allFinite()) return;
  const MatrixXd T = tangent_ ? tangent_(state) : MatrixXd::Identity(layout_.nq, layout_.nq);
  MatrixXd rows(functions_.size(), layout_.nq + 1);
  rows << surfaces.normals * T, surfaces.drift;
  for (std::size_t k = 0; k < slid_on.size(); ++k) {
    auto row = rows.row(slid_on[k]);
    const double length = row.head(layout_.nq).norm();
    if (!(length > least_way_out * surfaces.normals.row(slid_on[k]).norm())) continue;
    row /= length * toward_[slid_on[k]];
    for (std::size_t other = 0; other < k; ++other) {
      const int first = slid_on[other];
      const double side = common_side(row, rows.row(first));
      if (first_united_[static_cast<std::size_t>(first)] != first || side == 0) continue;
      first_united_[static_cast<std::size_t>(slid_on[k])] = first;
      toward_[slid_on[k]] *= side;
      break;
    }
  }
}

// ġ = drift + N f = 0 along `toward` for s = 1 − σ of each surface that is slid on: in one step of Newton's method where jumps add up,
// as those of most forces do. A surface that would need s outside [0, 2] cannot hold the motion: s stays at the end of the range, and
// the others are solved anew. If the motion then goes to its other side, it is tried anew itself, once.
VectorXd Switching::acceleration_along(const Surfaces& surfaces, const Values& values) {
  const std::vector<int> slid_on = sliding();
  const auto n = static_cast<Index>(slid_on.size());
  share_.setZero(n);
  sigma_.setOnes(n);
  MatrixXd normals(n, layout_.nq);
  VectorXd drift(n);
  for (Index k = 0; k < n; ++k) {
    const int surface = slid_on[static_cast<std::size_t>(k)];
    const auto d = part(toward_, surface);
    normals.row(k) = d.transpose() * surfaces.normals.middleRows(first_of(surface), d.size());
    drift[k] = d.dot(part(surfaces.drift, surface));
  }
  const MatrixXd gain = normals * values.jumps;
  const VectorXd rate = drift + normals * values.above;
  std::vector<int> open;
  std::vector<bool> is_tried_anew(slid_on.size(), false);
  for (int k = 0; k < static_cast<int>(n); ++k) {
    if (gain(k, k) < 0) {
      open.push_back(k);
    } else {  // its sides do not both drive the motion onto this surface
      share_[k] = rate[k] < 0 ? 2 : 0;
      sigma_[k] = rate[k] < 0 ? -2 : 2;
    }
  }
  while (true) {
    VectorXd solved = share_(open);
    constexpr int most_steps = 30;
    constexpr double enough = 1e-14, farthest = 4;
    for (int step = 0; step < most_steps && !open.empty(); ++step) {
      VectorXd share = share_;
      share(open) = solved;
      const VectorXd rest = (drift + normals * mixture(values, share))(open);
      const MatrixXd slope = (normals * slopes(values, share))(open, open);
      // a force that is weak beside another is no rounding of it
      const VectorXd lengths = slope.colwise().norm().transpose(), size = (lengths.array() > 0).select(lengths, 1.0);
      const VectorXd change = least_solution(slope * size.cwiseInverse().asDiagonal(), rest).cwiseQuotient(size);
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
      const VectorXd left = drift + normals * mixture(values, share_);
      int wrong = 0;
      while (wrong < static_cast<int>(n) && (std::abs(sigma_[wrong]) <= 1 || is_tried_anew[static_cast<std::size_t>(wrong)] ||
                                             !(left[wrong] * sigma_[wrong] < 0)))
        ++wrong;
      if (wrong == static_cast<int>(n)) break;
      is_tried_anew[static_cast<std::size_t>(wrong)] = true;
      if (gain(wrong, wrong) < 0) {
        open.push_back(wrong);
      } else {
        share_[wrong] = 2 - share_[wrong];
        sigma_[wrong] *= -1;
      }
      continue;
    }
    const int k = open[worst];
    constexpr double least = 1e-9;
    share_[k] = solved[static_cast<Index>(worst)] > 2 ? 2 : 0;
    sigma_[k] = (share_[k] > 0 ? -1 : 1) * (1 + std::max(excess, least));
    open.erase(open.begin() + static_cast<std::ptrdiff_t>(worst));
    for (const int other : open) share_[other] = 0;
  }
  return mixture(values, share_);
}

// The directions in which the constraints let a motion leave each surface that holds it, an orthonormal basis of each that begins with
// `toward`, which is turned into them: in a plane a bead leaves rest along its wire alone.
std::vector<MatrixXd> Switching::ways_out(const VectorXd& state, const Surfaces& surfaces) {
  std::vector<MatrixXd> out(hold_.size());
  const MatrixXd T = tangent_ ? tangent_(state) : MatrixXd::Identity(layout_.nq, layout_.nq);
  for (int k = 0; k < functions_.size(); ++k) {
    auto d = part(toward_, k);
    if (hold(k) == Hold::none) continue;
    MatrixXd& ways = out[static_cast<std::size_t>(k)];
    ways = d;
    if (d.size() == 1) continue;
    Eigen::JacobiSVD<MatrixXd> svd(surfaces.normals.middleRows(first_of(k), d.size()) * T, Eigen::ComputeFullU);
    svd.setThreshold(least_way_out);
    if (svd.rank() == 0) continue;
    const MatrixXd basis = svd.matrixU().leftCols(svd.rank());
    VectorXd within = basis.transpose() * d;
    if (!(within.norm() > least_way_out)) within = VectorXd::Unit(within.size(), 0);
    ways = basis * MatrixXd(within.householderQr().householderQ());
    d = (basis * within).normalized();
    ways.col(0) = d;
  }
  return out;
}

// Of friction in a plane the direction is found as well: of a body at rest the one that leaves ġ = 0, of one that is let go or creeps
// the one that it is accelerated in. One step for σd of Broyden's method, whose first slope, of the sides along and across, is exact
// where jumps add up; whether any direction has changed.
bool Switching::turn_along(const VectorXd& state, const Surfaces& surfaces, const Values& values, const VectorXd& ddq,
                           const Acceleration& acceleration, Turn& turn) {
  const Index n = toward_.size();
  MatrixXd free = MatrixXd::Zero(n, n);  // a basis of what may change of σd, and columns of 0
  VectorXd at = toward_;                 // σd
  Index next = 0;
  for (int k = 0; k < functions_.size(); ++k) {
    const double sigma = hold(k) == Hold::rest ? sigma_[next++] : 2;
    part(at, k) *= std::clamp(sigma, -1.0, 1.0);
    if (hold(k) == Hold::none) continue;
    const MatrixXd& ways = turn.ways[static_cast<std::size_t>(k)];
    block(free, k).leftCols(ways.cols()) = ways;
    if (std::abs(sigma) > 1) block(free, k).col(0).setZero();
  }
  if (free.isZero()) return false;

  const VectorXd rate = surfaces.normals * ddq + surfaces.drift;
  if (turn.slope.size() == 0) {
    turn.slope.setZero(n, n);
    next = 0;
    for (int k = 0; k < functions_.size(); ++k) {
      if (hold(k) == Hold::none) continue;
      const MatrixXd& ways = turn.ways[static_cast<std::size_t>(k)];
      MatrixXd jumps = MatrixXd::Zero(layout_.nq, ways.cols());
      if (hold(k) == Hold::rest) jumps.col(0) = values.jumps.col(next++);
      VectorXd toward = toward_;
      for (Index j = 1; j < ways.cols(); ++j) {
        part(toward, k) = ways.col(j);
        const VectorXd above = acceleration(beside(state, surfaces, toward));
        part(toward, k) *= -1;
        jumps.col(j) = (above - acceleration(beside(state, surfaces, toward))) / 2;
      }
      columns(turn.slope, k) += surfaces.normals * jumps * ways.transpose();
      // what it is accelerated by turns with it
      if (block(free, k).col(0).isZero()) block(turn.slope, k).diagonal().array() -= part(at, k).dot(part(rate, k));
    }
  } else {
    const VectorXd step = at - turn.at;
    turn.slope += (rate - turn.rate - turn.slope * step) * step.transpose() / step.squaredNorm();
  }
  turn.at = at;
  turn.rate = rate;

  constexpr double enough = 1e-10;
  bool has_turned = false;
  const MatrixXd slope = free.transpose() * turn.slope * free;
  const VectorXd step = -free * slope.completeOrthogonalDecomposition().solve(free.transpose() * rate);
  if (!step.allFinite()) return false;
  for (int k = 0; k < functions_.size(); ++k) {
    if (hold(k) == Hold::none || part(toward_, k).size() == 1) continue;
    const VectorXd wanted = part(at, k) + part(step, k), d = part(toward_, k);
    if (!((wanted - d.dot(wanted) * d).norm() > enough)) continue;
    part(toward_, k) = wanted.normalized();
    has_turned = true;
  }
  return has_turned;
}

VectorXd Switching::acceleration(const VectorXd& state, const Acceleration& acceleration) {
  constexpr int most_turns = 30;
  const Surfaces surfaces = surfaces_at(state);
  unite(state, surfaces);
  const bool may_turn = is_guided() && toward_.size() > functions_.size();
  Turn turn;
  if (may_turn) turn.ways = ways_out(state, surfaces);
  for (int n = 0;; ++n) {
    const Values values = evaluate(state, surfaces, acceleration);
    VectorXd ddq = acceleration_along(surfaces, values);
    if (!may_turn || n == most_turns || !turn_along(state, surfaces, values, ddq, acceleration, turn)) return ddq;
  }
}

VectorXd Switching::acceleration_anew(const VectorXd& state, const Acceleration& acceleration) {
  const std::vector<Hold> hold = hold_;
  const VectorXd toward = toward_;
  start(state, acceleration);
  VectorXd ddq = this->acceleration(state, acceleration);
  hold_ = hold;
  toward_ = toward;
  return ddq;
}

VectorXd Switching::mixed(const VectorXd& state, const Function& function) const {
  if (is_empty()) return function(state);
  return mixture(evaluate(state, surfaces_at(state), function), share_);
}

}  // namespace gp2
