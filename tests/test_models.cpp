#include "test_models.hpp"

#include <map>
#include <numbers>

#include "gp2/data/csv.hpp"
#include "gp2/robots/robot.hpp"

namespace gp2::test {

std::vector<std::string> model_files(const std::vector<std::string>& folders) {
  std::vector<std::string> files;
  for (const std::string& folder : folders) {
    for (const auto& entry : std::filesystem::directory_iterator(std::filesystem::path(GP2_SOURCE_DIR) / folder)) {
      // experiments/ may hold TOML files of other kinds
      const std::string text = entry.path().extension() == ".toml" ? read_file(entry.path()) : "";
      const bool is_readable = text.find("\nrobot ") == std::string::npos || can_read_robots();
      // M is singular: there is no ā, and other laws hold; singular_mass_test.cpp has them
      if (entry.path().stem() == "massless_rod") continue;
      if (text.find("[mechanics]") != std::string::npos && is_readable) {
        files.push_back(folder + "/" + entry.path().filename().string());
      }
    }
  }
  std::sort(files.begin(), files.end());
  return files;
}

const Model& model(const std::string& file) {
  static std::map<std::string, Model> models;
  const auto known = models.find(file);
  if (known != models.end()) return known->second;
  return models.emplace(file, Model::read(std::filesystem::path(GP2_SOURCE_DIR) / file)).first->second;
}

double largest(const Eigen::MatrixXd& matrix) { return matrix.size() == 0 ? 0 : matrix.cwiseAbs().maxCoeff(); }

Eigen::VectorXd random_vector(Eigen::Index size, RandomStream& random) {
  Eigen::VectorXd v(size);
  for (double& entry : v) entry = random.normal();
  return v;
}

Eigen::MatrixXd random_matrix(Eigen::Index rows, Eigen::Index cols, RandomStream& random) {
  return random_vector(rows * cols, random).reshaped(rows, cols);
}

GeneratedData draw(const Model& model, int n, std::uint64_t seed) {
  return generate(model, {n, seed, Eigen::VectorXd::Zero(model.system->nq())});
}

bool has_redundant_rows(const Model& model) {
  const MechanicsBatch batch = require_mechanics(*model.system, draw(model, 1, 1).states, model.system->parameter_values());
  return batch.projections[0].rank() < model.system->nc();
}

namespace {

// where A, or a part of it, is on the verge of vanishing or of losing rank
Eigen::MatrixXd nearly_singular_states(const std::string& file) {
  const Model& model_file = model(file);
  const StateLayout layout = model_file.system->layout();
  constexpr double half_pi = std::numbers::pi / 2;
  std::vector<Eigen::VectorXd> states;
  const auto add = [&]() -> Eigen::VectorXd& { return states.emplace_back(Eigen::VectorXd::Zero(layout.size())); };
  if (stem(file).starts_with("unicycle")) {
    // heading at ±90°, where the published form of the constraint row vanishes
    for (double heading : {half_pi, -half_pi, half_pi + 1e-9, -half_pi - 1e-9}) {
      Eigen::VectorXd& x = add();
      x[layout.q(2)] = heading;
      x[layout.dq(0)] = 0.7 * std::cos(heading);
      x[layout.dq(1)] = 0.7 * std::sin(heading);
      x[layout.dq(2)] = 0.4;
    }
  } else if (stem(file) == "slider_crank") {
    // stretched and folded: the slider's Jacobian vanishes
    const Eigen::VectorXd parameters = model_file.system->parameter_values();
    const double r = parameters[model_file.system->parameter_index("r")];
    const double l = parameters[model_file.system->parameter_index("l")];
    for (double crank : {0.0, 1e-8, std::numbers::pi, std::numbers::pi - 1e-8}) {
      Eigen::VectorXd& x = add();
      const double rod = -std::asin(r * std::sin(crank) / l);
      const double speed = 3;
      const double rod_speed = -r * std::cos(crank) * speed / (l * std::cos(rod));
      x[layout.q(0)] = crank;
      x[layout.q(1)] = rod;
      x[layout.q(2)] = r * std::cos(crank) + l * std::cos(rod);
      x[layout.dq(0)] = speed;
      x[layout.dq(1)] = rod_speed;
      x[layout.dq(2)] = -r * std::sin(crank) * speed - l * std::sin(rod) * rod_speed;
    }
  } else if (stem(file) == "arm_on_moving_plane") {
    // stretched upright: the height no longer depends on the joints
    Eigen::VectorXd& x = add();
    x[layout.q(0)] = half_pi - 1e-3;
    x[layout.dq(0)] = 0.5;
  } else {
    add();
  }
  Eigen::MatrixXd all(layout.size(), static_cast<Eigen::Index>(states.size()));
  for (std::size_t i = 0; i < states.size(); ++i) all.col(static_cast<Eigen::Index>(i)) = states[i];
  return all;
}

}  // namespace

std::vector<StateFamily> state_families(const std::string& file, std::uint64_t seed) {
  const Model& model_file = model(file);
  const StateLayout layout = model_file.system->layout();
  const int n = 20;
  Eigen::MatrixXd drawn = draw(model_file, n, seed).states;
  std::vector<StateFamily> families{{"generated", drawn}};
  drawn = drawn.array().isNaN().select(0, drawn);
  const auto with_speeds_times = [&](double factor) {
    Eigen::MatrixXd states = drawn;
    states.middleRows(layout.dq(0), layout.nq) *= factor;
    return states;
  };
  families.push_back({"at rest", with_speeds_times(0)});
  families.push_back({"tiny velocities", with_speeds_times(1e-9)});
  if (has_redundant_rows(model_file)) {
    families.push_back({"fast", with_speeds_times(30)});
  } else {
    RandomStream random(seed, 1);
    Eigen::MatrixXd states(layout.size(), n);
    for (double& entry : states.reshaped()) entry = 3 * random.normal();
    states.row(layout.t()) = states.row(layout.t()).cwiseAbs();
    families.push_back({"off the sampling box", states});
  }
  families.push_back({"nearly singular", nearly_singular_states(file)});
  return families;
}

Difference central_difference(const std::function<Eigen::VectorXd(double)>& f, double x, double scale, double precision) {
  const double step = std::pow(eps, 0.2) * scale;
  double magnitude = 0;
  const auto difference = [&](double h) -> Eigen::VectorXd {
    const Eigen::VectorXd f2 = f(x + 2 * h), f1 = f(x + h), f_1 = f(x - h), f_2 = f(x - 2 * h);
    magnitude = std::max({magnitude, f1.lpNorm<Eigen::Infinity>(), f_1.lpNorm<Eigen::Infinity>()});
    return (8 * (f1 - f_1) - (f2 - f_2)) / (12 * h);
  };
  const Eigen::VectorXd coarse = difference(step), fine = difference(step / 2);
  return {fine, (2 * (fine - coarse).cwiseAbs()).array() + 2 * precision * magnitude / step};
}

testing::AssertionResult matches(const Eigen::VectorXd& analytic, const Difference& difference) {
  if (analytic.size() != difference.value.size()) return testing::AssertionFailure() << "sizes differ";
  for (Eigen::Index k = 0; k < analytic.size(); ++k) {
    if (!(std::abs(analytic[k] - difference.value[k]) <= difference.error[k])) {
      return testing::AssertionFailure() << fmt::format("entry {}: analytic {:.12g}, difference quotient {:.12g} ± {:.2g}", k,
                                                        analytic[k], difference.value[k], difference.error[k]);
    }
  }
  return testing::AssertionSuccess();
}

}  // namespace gp2::test
