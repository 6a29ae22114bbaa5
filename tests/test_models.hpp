#pragma once

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <functional>
#include <limits>
#include <string>
#include <vector>

#include <fmt/core.h>
#include <gtest/gtest.h>
#include <Eigen/Core>

#include "base/random.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"
#include "gp2/model.hpp"
#include "gp2/simulation/generate.hpp"

// The models that laws are tested on, the states they are tested at, and the difference quotients they are tested against.
namespace gp2::test {

inline constexpr double eps = std::numeric_limits<double>::epsilon();

/// Model files of the given folders of the checkout, as "models/surface.toml", sorted.
std::vector<std::string> model_files(const std::vector<std::string>& folders);
inline std::vector<std::string> every_model() { return model_files({"models", "experiments"}); }
inline std::vector<std::string> library_models() { return model_files({"models"}); }

inline std::string stem(const std::string& file) { return std::filesystem::path(file).stem().string(); }

/// Name of a parameterised test: the model's.
inline std::string model_test_name(const testing::TestParamInfo<std::string>& info) { return stem(info.param); }

/// A model file of the checkout, read once.
const Model& model(const std::string& file);

/// The largest entry by size; 0 where there is none.
double largest(const Eigen::MatrixXd& matrix);

Eigen::VectorXd random_vector(Eigen::Index size, RandomStream& random);
Eigen::MatrixXd random_matrix(Eigen::Index rows, Eigen::Index cols, RandomStream& random);

/// States and noise-free accelerations drawn from a model's [sampling].
GeneratedData draw(const Model& model, int n, std::uint64_t seed);

/// Whether some rows of A follow from the others. They do so on the constraint only, so such a model has no meaning off it.
bool has_redundant_rows(const Model& model);

struct StateFamily {
  std::string name;
  Eigen::MatrixXd states;
};

/// The states laws must hold at: usual ones, at rest, hardly moving, far off the usual ones, nearly singular.
std::vector<StateFamily> state_families(const std::string& file, std::uint64_t seed);

/// A derivative by differences, and how far off it may be.
struct Difference {
  Eigen::VectorXd value, error;
};

/// d f/dx by the central difference of fourth order, with steps h and h/2 where h = ε^(1/5)·scale balances truncation against
/// rounding. `error` is twice what the two steps differ by, plus the rounding of f over the step.
///
/// @param scale      over which f changes
/// @param precision  relative rounding error of f
Difference central_difference(const std::function<Eigen::VectorXd(double)>& f, double x, double scale,
                              double precision = 8 * eps);

/// Each entry of `analytic` lies within the difference quotient's error.
testing::AssertionResult matches(const Eigen::VectorXd& analytic, const Difference& difference);

}  // namespace gp2::test
