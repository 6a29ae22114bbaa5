#pragma once

#include <cmath>
#include <memory>
#include <string>

#include "gp2/data/csv.hpp"
#include "gp2/mechanics/callable_system.hpp"
#include "gp2/model.hpp"

// models/surface.toml with M, A, b and F written as code.
namespace gp2::test {

/// The text of models/surface.toml without [mechanics] and [constraints].
inline std::string surface_without_mechanics() {
  std::string text = read_file(GP2_SOURCE_DIR "/models/surface.toml");
  const auto from = text.find("[mechanics]");
  return text.erase(from, text.find("[[latent]]") - from);
}

/// θ in the order of the file.
struct SurfaceParameters {
  double m, g, p1, p2, p3, p4, p5;
  explicit SurfaceParameters(const CallableSystem::Parameters& p)
      : m(p[0]), g(p[1]), p1(p[2]), p2(p[3]), p3(p[4]), p4(p[5]), p5(p[6]) {}
};

inline SystemValues surface_zeros(Eigen::Index n) {
  return {Eigen::MatrixXd::Zero(9, n), Eigen::MatrixXd::Zero(3, n), Eigen::MatrixXd::Zero(1, n), Eigen::MatrixXd::Zero(3, n)};
}

inline SystemValues surface_values(const CallableSystem::States& states, const CallableSystem::Parameters& parameters) {
  const SurfaceParameters p(parameters);
  SystemValues out = surface_zeros(states.cols());
  for (Eigen::Index i = 0; i < states.cols(); ++i) {
    const auto x = states.col(i);
    const double q1 = x[0], q2 = x[1], dq1 = x[3], dq2 = x[4];
    out.mass(0, i) = out.mass(4, i) = out.mass(8, i) = p.m;
    out.constraint_matrix.col(i) << 2 * p.p1 * q1 + p.p3 * q2 - p.p4 * p.p5 * std::sin(p.p5 * q1), 2 * p.p2 * q2 + p.p3 * q1, -1;
    out.constraint_vector(0, i) =
        -((2 * p.p1 - p.p4 * p.p5 * p.p5 * std::cos(p.p5 * q1)) * dq1 * dq1 + 2 * p.p3 * dq1 * dq2 + 2 * p.p2 * dq2 * dq2);
    out.force.col(i) << x[7], x[8], x[9] - p.m * p.g;
  }
  return out;
}

inline SystemValues surface_derivatives(const CallableSystem::States& states, const CallableSystem::Parameters& parameters,
                                        int index) {
  const SurfaceParameters p(parameters);
  SystemValues out = surface_zeros(states.cols());
  for (Eigen::Index i = 0; i < states.cols(); ++i) {
    const auto x = states.col(i);
    const double q1 = x[0], q2 = x[1], dq1 = x[3], dq2 = x[4], s = std::sin(p.p5 * q1), c = std::cos(p.p5 * q1);
    auto A = out.constraint_matrix.col(i);
    double& b = out.constraint_vector(0, i);
    switch (index) {
      case 0:
        out.mass(0, i) = out.mass(4, i) = out.mass(8, i) = 1;
        out.force(2, i) = -p.g;
        break;
      case 1:
        out.force(2, i) = -p.m;
        break;
      case 2:
        A[0] = 2 * q1;
        b = -2 * dq1 * dq1;
        break;
      case 3:
        A[1] = 2 * q2;
        b = -2 * dq2 * dq2;
        break;
      case 4:
        A[0] = q2;
        A[1] = q1;
        b = -2 * dq1 * dq2;
        break;
      case 5:
        A[0] = -p.p5 * s;
        b = p.p5 * p.p5 * c * dq1 * dq1;
        break;
      default:
        A[0] = -p.p4 * (s + p.p5 * q1 * c);
        b = p.p4 * p.p5 * (2 * c - p.p5 * q1 * s) * dq1 * dq1;
    }
  }
  return out;
}

/// c and dc/dt.
inline Eigen::MatrixXd surface_residuals(const CallableSystem::States& states, const CallableSystem::Parameters& parameters) {
  const SurfaceParameters p(parameters);
  const SystemValues values = surface_values(states, parameters);
  Eigen::MatrixXd out(2, states.cols());
  for (Eigen::Index i = 0; i < states.cols(); ++i) {
    const double q1 = states(0, i), q2 = states(1, i);
    out(0, i) = p.p1 * q1 * q1 + p.p2 * q2 * q2 + p.p3 * q1 * q2 + p.p4 * std::cos(p.p5 * q1) - states(2, i);
    out(1, i) = values.A(static_cast<int>(i)).row(0).dot(states.col(i).segment(3, 3));
  }
  return out;
}

/// The surface as functions, with everything that is optional.
inline CallableSystem::Definition surface_definition(const SystemDeclaration& declaration) {
  CallableSystem::Definition definition;
  definition.declaration = declaration;
  definition.constraints = {{"the surface", ConstraintLevel::position}};
  definition.evaluate = surface_values;
  definition.differentiate = surface_derivatives;
  definition.residuals = surface_residuals;
  definition.mechanics_reads = {{"q1", "q2", "dq1", "dq2"}};
  definition.force_reads = {{"u1", "u2", "u3"}};
  definition.residuals_read = {{"q1", "q2", "q3", "dq1", "dq2", "dq3"}};
  return definition;
}

inline std::shared_ptr<const System> callable_surface(const SystemDeclaration& declaration) {
  return std::make_shared<const CallableSystem>(surface_definition(declaration));
}

/// The same, its parameters differentiated by differences.
inline std::shared_ptr<const System> differenced_surface(const SystemDeclaration& declaration) {
  CallableSystem::Definition definition = surface_definition(declaration);
  definition.differentiate = nullptr;
  return std::make_shared<const CallableSystem>(definition);
}

}  // namespace gp2::test
