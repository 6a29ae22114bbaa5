#pragma once

// Vectors and matrices of expressions in space. What is constant folds away, so zeros cost nothing.

#include <array>

#include <Eigen/Core>

#include "gp2/symbolic/expression.hpp"

namespace gp2 {

struct ExpressionVector {
  std::array<Expression, 3> entries;

  Expression& operator[](int i) { return entries[static_cast<std::size_t>(i)]; }
  Expression operator[](int i) const { return entries[static_cast<std::size_t>(i)]; }
};

struct ExpressionMatrix {
  std::array<ExpressionVector, 3> columns;

  Expression& operator()(int i, int j) { return columns[static_cast<std::size_t>(j)][i]; }
  Expression operator()(int i, int j) const { return columns[static_cast<std::size_t>(j)][i]; }
};

inline ExpressionVector constant(ExpressionGraph& graph, const Eigen::Vector3d& v) {
  return {{graph.constant(v.x()), graph.constant(v.y()), graph.constant(v.z())}};
}

inline ExpressionMatrix constant(ExpressionGraph& graph, const Eigen::Matrix3d& m) {
  return {{constant(graph, Eigen::Vector3d(m.col(0))), constant(graph, Eigen::Vector3d(m.col(1))),
           constant(graph, Eigen::Vector3d(m.col(2)))}};
}

inline ExpressionVector operator+(const ExpressionVector& a, const ExpressionVector& b) {
  return {{a[0] + b[0], a[1] + b[1], a[2] + b[2]}};
}
inline ExpressionVector operator-(const ExpressionVector& a, const ExpressionVector& b) {
  return {{a[0] - b[0], a[1] - b[1], a[2] - b[2]}};
}
inline ExpressionVector operator*(const ExpressionVector& a, Expression s) { return {{a[0] * s, a[1] * s, a[2] * s}}; }
inline Expression dot(const ExpressionVector& a, const ExpressionVector& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline ExpressionVector cross(const ExpressionVector& a, const ExpressionVector& b) {
  return {{a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]}};
}

inline ExpressionVector operator*(const ExpressionMatrix& m, const ExpressionVector& v) {
  return m.columns[0] * v[0] + m.columns[1] * v[1] + m.columns[2] * v[2];
}
inline ExpressionMatrix operator*(const ExpressionMatrix& a, const ExpressionMatrix& b) {
  return {{a * b.columns[0], a * b.columns[1], a * b.columns[2]}};
}
inline ExpressionMatrix operator+(const ExpressionMatrix& a, const ExpressionMatrix& b) {
  return {{a.columns[0] + b.columns[0], a.columns[1] + b.columns[1], a.columns[2] + b.columns[2]}};
}
inline ExpressionMatrix transposed(const ExpressionMatrix& m) {
  ExpressionMatrix out = m;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) out(i, j) = m(j, i);
  }
  return out;
}

/// R I Rᵀ of a symmetric I, symmetric to the last bit.
inline ExpressionMatrix rotated_inertia(const ExpressionMatrix& R, const ExpressionMatrix& inertia) {
  const ExpressionMatrix half = R * inertia, transposed_R = transposed(R);
  ExpressionMatrix out = inertia;
  for (int j = 0; j < 3; ++j) {
    const ExpressionVector column = half * transposed_R.columns[static_cast<std::size_t>(j)];
    for (int i = 0; i <= j; ++i) out(i, j) = out(j, i) = column[i];
  }
  return out;
}

/// Turns by an angle about a constant unit axis: c 1 + s [a]× + (1 − c) a aᵀ.
inline ExpressionMatrix rotation_about(const Eigen::Vector3d& axis, Expression angle) {
  ExpressionGraph& graph = angle.graph();
  const Expression c = graph.apply(Operation::cos, angle), s = graph.apply(Operation::sin, angle), one = graph.constant(1);
  ExpressionMatrix out;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      const double along = axis[i] * axis[j];
      // [a]×_ij = −a_k for (i, j, k) cyclic, a_k for the other order
      const double across = i == j ? 0 : (j - i + 3) % 3 == 1 ? -axis[3 - i - j] : axis[3 - i - j];
      out(i, j) = i == j ? graph.constant(along) + graph.constant(1 - along) * c
                         : graph.constant(along) * (one - c) + graph.constant(across) * s;
    }
  }
  return out;
}

/// A quaternion p = w + xi + yj + zk of any length but 0: it turns as p/|p| does.
struct ExpressionQuaternion {
  Expression w, x, y, z;
};

inline Expression dot(const ExpressionQuaternion& a, const ExpressionQuaternion& b) {
  return a.w * b.w + a.x * b.x + a.y * b.y + a.z * b.z;
}

/// R(p/|p|): axes of the turned body in those that it is turned in.
inline ExpressionMatrix rotation_by(const ExpressionQuaternion& p) {
  const auto& [w, x, y, z] = p;
  const Expression two_by_square = w.graph().constant(2) / dot(p, p), one = w.graph().constant(1);
  const auto off = [&](Expression a, Expression b) { return two_by_square * (a + b); };
  const auto on = [&](Expression a, Expression b) { return one - two_by_square * (a * a + b * b); };
  const ExpressionVector first = {{on(y, z), off(x * y, w * z), off(x * z, -(w * y))}};
  const ExpressionVector second = {{off(x * y, -(w * z)), on(x, z), off(y * z, w * x)}};
  const ExpressionVector third = {{off(x * z, w * y), off(y * z, -(w * x)), on(x, y)}};
  return {{first, second, third}};
}

/// E(p), with ω = 2 E(p) ṗ/|p|² the angular velocity in the axes of the turned body (3 × 4).
inline std::array<std::array<Expression, 4>, 3> velocity_matrix(const ExpressionQuaternion& p) {
  const auto& [w, x, y, z] = p;
  return {{{{-x, w, z, -y}}, {{-y, -z, w, x}}, {{-z, y, -x, w}}}};
}

}  // namespace gp2
