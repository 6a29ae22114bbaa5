#include "gp2/report/plot.hpp"

#include <cmath>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"

namespace gp2::test {
namespace {

using testing::HasSubstr;
using testing::Not;

class PlotCommand : public testing::Test {
 protected:
  void SetUp() override {
    desk.done("gp2 generate models/arm_on_moving_plane.toml --n 30 -o train.csv");
    desk.done(
        "gp2 fit models/arm_on_moving_plane.toml --data train.csv --mean force --max-iterations 3 --restarts 1 -o fit.json");
  }
  [[nodiscard]] LearnedCurve curve(const PlotRequest& request) const {
    return learned_curve(FitFile::read(desk / "fit.json").posterior(), request);
  }
  Desk desk;
};

TEST_F(PlotCommand, DrawsOneOfTheForcesOfTheReport) {
  EXPECT_THAT(desk.done("gp2 plot fit.json --what \"friction of the tip\" --along dshoulder --force elbow -o tip.svg").err,
              HasSubstr("tip.svg: force_elbow@friction of the tip along dshoulder"));
  const std::string svg = desk.read("tip.svg");
  EXPECT_THAT(svg, testing::StartsWith("<svg xmlns"));
  EXPECT_THAT(svg, HasSubstr("friction of the tip – two-link arm on a moving plane"));
  for (const char* outside : {"href", "url(", "<script", "<style"}) EXPECT_THAT(svg, Not(HasSubstr(outside)));
  const LearnedCurve found = curve({"friction of the tip", "dshoulder", "elbow"});
  const std::vector<LearnedForce> all = learned_forces(FitFile::read(desk / "fit.json").posterior());
  const auto same = std::ranges::find_if(
      all, [](const LearnedForce& one) { return one.latent == "friction of the tip" && one.along == "dshoulder"; });
  ASSERT_NE(same, all.end());
  EXPECT_EQ(found.row, 1);
  EXPECT_EQ(found.force.mean, same->mean);
  EXPECT_EQ(found.force.data.size(), 30);
}

TEST_F(PlotCommand, ChoosesWhatTheDataDetermineBest) {
  const auto clearness = [](const LearnedCurve& one) {
    const auto mean = one.force.mean.row(one.row);
    return (mean.maxCoeff() - mean.minCoeff()) / std::sqrt(one.force.stddev.row(one.row).array().square().mean());
  };
  const LearnedCurve best = curve({});
  for (const char* force : {"shoulder", "elbow"})
    EXPECT_GE(clearness(best), clearness(curve({std::nullopt, std::nullopt, force})));
}

TEST_F(PlotCommand, NamesWhatThereIsAndWritesNothing) {
  const std::pair<const char*, const char*> cases[] = {
      {"--what tip", "--what: 'tip' is not among what was learned; there are: friction of the tip, friction of the joints"},
      {"--along dshulder", "did you mean 'dshoulder'"},
      {"--force wrist", "there are: shoulder, elbow"},
      {"--what", "--what"},
  };
  for (const auto& [arguments, text] : cases) {
    const Outcome outcome = desk.run(std::string("gp2 plot fit.json -o tip.svg ") + arguments);
    EXPECT_EQ(outcome.status, 2) << arguments;
    EXPECT_THAT(outcome.err, HasSubstr(text)) << arguments;
    EXPECT_FALSE(desk.has("tip.svg")) << arguments;
  }
}

TEST_F(PlotCommand, SaysWhereThereIsNothingToDraw) {
  desk.write("constant.csv", "dx,ddx\n1,0.1\n1,0.2\n");
  desk.write("mass.toml",
             "coordinates = ['x']\n[mechanics]\nmass = [['1']]\n[[latent]]\nfeatures = ['dx']\n[noise]\nddq = 0.1\n");
  desk.done("gp2 fit mass.toml --data constant.csv --max-iterations 0 -o mass.json");
  EXPECT_THAT(desk.run("gp2 plot mass.json -o mass.svg").err, HasSubstr("nothing to plot"));
}

TEST(Plot, IsAPictureOfACurveThatIsFlatAndCertain) {
  LearnedCurve curve;
  curve.force = {"drag",
                 "dx",
                 {"force_x"},
                 Eigen::VectorXd::LinSpaced(3, 0, 1),
                 Eigen::MatrixXd::Zero(1, 3),
                 Eigen::MatrixXd::Zero(1, 3),
                 Eigen::VectorXd::Zero(2)};
  const Model model =
      Model::parse("name = 'a & b'\ncoordinates = ['x']\n[mechanics]\nmass = [['1']]\n[units]\nx = 'm'\n", "model.toml");
  const std::string picture = plot(curve, model);
  EXPECT_THAT(picture, testing::AllOf(HasSubstr("a &amp; b"), Not(HasSubstr("nan")), Not(HasSubstr("inf"))));
  EXPECT_THAT(picture, testing::AllOf(HasSubstr(">dx [m/s]<"), HasSubstr(">force_x [N]<")));
}

TEST(Plot, TellsTicksApartThatLieFarFromZero) {
  LearnedCurve curve;
  const double since_1970 = 1.7e9;
  Eigen::MatrixXd mean = Eigen::MatrixXd::Constant(1, 3, 100);
  mean(0, 1) = std::nextafter(100, 101);  // no more than rounding
  curve.force = {"drag",
                 "t",
                 {"force_x"},
                 Eigen::VectorXd::LinSpaced(3, since_1970, since_1970 + 10),
                 mean,
                 mean * 0,
                 Eigen::VectorXd::Constant(2, since_1970)};
  const Model model = Model::parse("coordinates = ['x']\n[mechanics]\nmass = [['1']]\n", "model.toml");
  const std::string picture = plot(curve, model);
  for (const char* tick : {">1700000002<", ">1700000004<", ">100<"}) EXPECT_THAT(picture, HasSubstr(tick));
}

TEST(Plot, KnowsTheUnitsOfAnglesWithoutBeingTold) {
  const Model model = Model::parse(
      "coordinates = [{ name = 'phi', angle = true }, 'x']\n[mechanics]\nmass = [['1', '0'], ['0', '1']]\n", "m.toml");
  EXPECT_EQ(model.labelled("ddphi"), "ddphi [rad/s²]");
  EXPECT_EQ(model.labelled("force_phi@friction"), "force_phi@friction [N m]");
  EXPECT_EQ(model.labelled("dx"), "dx");
}

TEST_F(PlotCommand, RefusesThePictureOfAnotherKind) {
  const Outcome outcome = desk.run("gp2 plot fit.json -o tip.png");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, HasSubstr("tip.png: the picture is SVG: name a file that ends in .svg"));
  EXPECT_FALSE(desk.has("tip.png"));
}

}  // namespace
}  // namespace gp2::test
