#pragma once

#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/prior.hpp"

namespace gp2 GP2_API {

/// Code for the features or the directions of a latent: a contact Jacobian of another library, say. It must give the same for the
/// same arguments and may be called from several threads at once. What it throws goes to the caller as it is; the shape of what it
/// returns is checked at every call, and that numbers are finite where everything that is read is.
struct StateCode {
  using States = StateFunction::States;
  using Parameters = StateFunction::Parameters;

  /// One row per number, one column per state (rows × N). Features are given no parameters (size 0): they depend on none that may
  /// be estimated.
  std::function<Eigen::MatrixXd(const States& states, const Parameters& parameters)> evaluate = nullptr;

  /// Derivatives of directions in parameters()[index], exact (rows × N). Optional: without it they are differences, as in
  /// CallableSystem::Definition::differentiate.
  std::function<Eigen::MatrixXd(const States& states, const Parameters& parameters, int index)> differentiate = nullptr;

  /// Names of the state's entries (q1, dq1, t, u1, …) that it reads: a log needs these columns. Not given: all.
  std::optional<std::vector<std::string>> reads = std::nullopt;

  explicit operator bool() const { return static_cast<bool>(evaluate); }
};

/// What a latent is made from: words, as in the [[latent]] of a model file (docs/model-files.md), or code.
struct LatentSpec {
  std::string name;
  std::string kernel = {};            // empty: PriorOptions::kernel or kernel_along; of a potential rq + linear
  std::vector<std::string> features;  // φ(x): expressions of the state; of code, what its numbers are called
  StateCode feature_code = {};        // empty: features are expressions
  Latent::Base base = Latent::Base::acceleration;
  std::vector<std::vector<std::string>> directions = {};  // B(x): nq rows of p expressions of state and parameters
  std::vector<std::string> direction_names = {};          // of code, its columns (p)
  StateCode direction_code = {};                          // B(x) column-major (nq·p × N); neither: B = I
  bool is_positive = false;                               // Latent::is_positive; directions are then given
  bool is_potential = false;  // it acts as the force −Jᵀ∇V of a potential V of its features; without directions
  Latent::Range lengthscale = {}, signal_stddev = {};
  /// Whether each direction has lengthscales, and all else of the kernel, of its own: p latents of one direction. Not given: where
  /// the kernel is not given either and PriorOptions::per_direction says so.
  std::optional<bool> per_direction = {};
  /// Lengthscales of single features, in their units and not relative. An angle's name stands for its sine and its cosine.
  std::vector<std::pair<std::string, Latent::Range>> lengthscales = {};
};

/// What the model's kernel would rule out without reason: a second latent of fixed, short lengthscales and a size below the
/// noise, which is its one hyperparameter. It hardly moves the mean, but keeps a standard deviation where the fit would call an
/// effect absent that the data cannot see.
struct Discrepancy {
  Eigen::VectorXd lengthscale;  // of each of its features (D); empty: 1
  Eigen::VectorXd stddev;       // of each acceleration (nq), as large as the noise; the size is a factor of it
  Latent::Base base = Latent::Base::admissible;
  /// Of each feature over the data (D): outside their range the standard deviation grows up to 16 times, as what was too small to be
  /// seen may (theory.md, T23). Empty: it does not grow.
  Eigen::VectorXd centre = {}, half_range = {};
};

struct PriorOptions {
  Prior::Mean mean = Prior::Mean::zero;
  std::optional<Latent::Base> base;             // replaces the directions of the one latent by the identity or M⁻¹
  bool raw_angles = false;                      // a feature that is an angle stays as it is instead of its sine and cosine
  std::optional<Discrepancy> discrepancy = {};  // beside the model's latents
  /// Of a latent that gives no kernel: what machines are made of, a part that is linear in the features and a smooth one; the p
  /// directions of such a latent have hyperparameters of their own.
  std::string kernel = "se + linear";
  /// Of one along directions of its own, as friction at a joint is: it may have kinks, and no discrepancy stands for what the
  /// smooth part rules out.
  std::string kernel_along = "se + matern32 + linear";
  bool per_direction = true;
  /// By a feature's name, what such a latent subtracts from it: its mean over the data, so that the linear part does not depend on
  /// where a coordinate has its zero. Features that are not named stay as they are.
  std::map<std::string, double> feature_centres = {};
};

/// A prior without a model file. Expressions are of the system's coordinates, velocities, t, inputs and parameters.
/// @throws InputError naming the latent, when a kernel, an expression, a range or a list of code is wrong, or `base` is asked for
///   and there are several latents.
Prior make_prior(std::shared_ptr<const System> system, const std::vector<LatentSpec>& latents, const PriorOptions& options = {});

}  // namespace gp2
