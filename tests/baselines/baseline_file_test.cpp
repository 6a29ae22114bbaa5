#include <functional>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "gp2/files/fit_file.hpp"
#include "gp2/simulation/generate.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

// Fits of baselines, there and back.
namespace gp2 {
namespace {

using Json = nlohmann::ordered_json;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::TemporaryFolder;
using testing::AllOf;
using testing::HasSubstr;

FitFile fit_file_of(Baseline::Kind kind) {
  FitFile fit;
  fit.model = test::model("models/unicycle.toml");
  const VectorXd noise_stddev = VectorXd::Constant(fit.model.system->nq(), 0.1);
  const GeneratedData data = generate(fit.model, {8, 3, noise_stddev});
  fit.observations.push_back({data.states, View::all(View::Quantity::constrained_acceleration, *fit.model.system),
                              data.accelerations, noise_stddev, false});
  const auto n_features = static_cast<Index>(fit.model.latents.front().features.size());
  fit.prior_options.raw_angles = true;
  fit.prior_options.baseline = {kind, VectorXd::Zero(fit.model.system->nq()), VectorXd::Zero(n_features),
                                VectorXd::Ones(n_features)};
  fit.prior_options.baseline = standardised_by(fit.observations, fit.prior(), kind);
  FitOptions options = baseline_fit_options();
  options.n_restarts = 2;
  options.max_iterations = 5;
  const Prior prior = fit.prior();
  fit.report = fit_baseline(kind, prior, fit.observations, baseline_hyperparameters(prior, fit.observations), options).report;
  return fit;
}

TEST(BaselineFile, PredictsTheSameBitsAfterItWasWrittenAndRead) {
  for (const Baseline::Kind kind : {Baseline::Kind::se, Baseline::Kind::icm, Baseline::Kind::lmc}) {
    SCOPED_TRACE(Baseline::word(kind));
    const TemporaryFolder folder;
    const FitFile fit = fit_file_of(kind);
    fit.write(folder / "fit.json");
    const FitFile read = FitFile::read(folder / "fit.json");
    ASSERT_TRUE(read.prior_options.baseline.has_value());
    EXPECT_EQ(read.prior_options.baseline->kind, kind);
    EXPECT_EQ(read.prior_options.baseline->output_mean, fit.prior_options.baseline->output_mean);
    const View view = View::all(View::Quantity::constrained_acceleration, *fit.model.system);
    const MatrixXd states = test::draw(fit.model, 5, 9).states;
    const Posterior before = fit.posterior(), after = read.posterior();
    EXPECT_EQ(before.marginal(view, states).mean, after.marginal(view, states).mean);
    EXPECT_EQ(before.marginal(view, states).covariance, after.marginal(view, states).covariance);
    EXPECT_TRUE(after.mean(view, states).allFinite());
  }
}

TEST(BaselineFile, ThatIsDamagedIsRefused) {
  const TemporaryFolder folder;
  fit_file_of(Baseline::Kind::lmc).write(folder / "fit.json");
  const Json whole = test::without_checksum(Json::parse(read_file(folder / "fit.json")));
  const auto refusal = [&](const std::function<void(Json&)>& damage) {
    Json json = whole;
    damage(json);
    const auto path = folder.write("damaged.json", json.dump());
    return test::input_error_of([&] { FitFile::read(path); });
  };
  EXPECT_EQ(refusal([](Json&) {}), "");
  EXPECT_THAT(refusal([](Json& j) { j["prior"]["baseline"]["kind"] = "gp"; }),
              AllOf(HasSubstr("damaged.json"), HasSubstr("'gp' is no baseline"), HasSubstr("se, icm, lmc")));
  EXPECT_THAT(refusal([](Json& j) { j["prior"]["baseline"]["output_mean"].erase(0); }),
              HasSubstr("output_mean of a baseline must hold one number for each of the 3 outputs, got 2"));
  EXPECT_THAT(refusal([](Json& j) { j["prior"]["baseline"]["feature_mean"].push_back(1); }),
              HasSubstr("feature_mean of a baseline must hold one number for each of the"));
  EXPECT_THAT(refusal([](Json& j) { j["prior"]["baseline"]["feature_stddev"][0] = 0; }),
              HasSubstr("feature_stddev of a baseline must be positive"));
  EXPECT_THAT(refusal([](Json& j) { j["prior"]["baseline"].erase("feature_stddev"); }), HasSubstr("not a whole fit file"));
  const auto last = [](Json& j) -> Json& { return j["hyperparameters"].back(); };
  EXPECT_THAT(refusal([&](Json& j) { last(j)["index"] = 7; }), HasSubstr("belongs to nothing in this model"));
  EXPECT_THAT(refusal([&](Json& j) { last(j).erase("scale"); }), HasSubstr("has the impossible value"));
  EXPECT_THAT(refusal([](Json& j) { j["hyperparameters"].erase(j["hyperparameters"].size() - 1); }),
              HasSubstr("sqrt_kappa 3 of latent 'linear' has no value"));
}

}  // namespace
}  // namespace gp2
