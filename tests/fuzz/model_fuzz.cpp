#include <string>

#include "fuzz/fuzz.hpp"
#include "gp2/mechanics/state_evaluator.hpp"
#include "gp2/model.hpp"

namespace {

// whatever file a model names as its robot: one link on a hinge, with a point to speak of
gp2::RobotDescription pendulum(const std::string&) {
  gp2::RobotDescription robot;
  robot.name = "pendulum";
  gp2::RobotDescription::Body link;
  link.name = "link";
  link.mass = 1;
  link.com = {0, 0, -0.5};
  link.inertia = 0.1 * Eigen::Matrix3d::Identity();
  link.joints.emplace_back();
  link.joints.front().name = "hinge";
  robot.bodies.push_back(link);
  robot.sites.push_back({"tip", 0, {0, 0, -1}});
  return robot;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  gp2::test::accepts([&] {
    const gp2::Model model =
        gp2::Model::parse(std::string(gp2::test::text_of(data, size)), "model.toml", gp2::RobotSource(pendulum));
    static_cast<void>(make_prior(model));
    // the mechanics where everything is zero, and their derivatives
    const auto evaluator = model.system->make_evaluator(model.system->parameter_values(), true);
    evaluator->evaluate(Eigen::VectorXd::Zero(model.system->layout().size()));
  });
  return 0;
}
