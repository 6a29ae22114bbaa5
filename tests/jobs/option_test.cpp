#include "gp2/jobs/option.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "gp2/error.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "input_error.hpp"

namespace gp2 {
namespace {

using nlohmann::json;
using testing::HasSubstr;

json json_of(FitRequest& request) { return json::parse(options_json(options(request))); }

TEST(Options, OfANewFitAreTheDefaults) {
  FitRequest request;
  EXPECT_EQ(json_of(request), json::parse(R"({"discrepancy": "default", "hyperparameters": "auto", "hyperprior": "default",
                            "max_iterations": 1000, "mean": "zero",
                            "protocol": "default", "seed": 0, "standard_errors": true, "thin": "auto"})"));
}

FitRequest request_with_every_option() {
  FitRequest request;
  FitProblemOptions& asked = request.problem;
  asked.columns = {{"q3", "theta1"}};
  asked.observe = {"ddq1", "ddq3"};
  asked.mean = Prior::Mean::force;
  asked.base = Latent::Base::force;
  asked.baseline = Baseline::Kind::icm;
  asked.estimate = std::vector<std::string>();
  asked.noise_stddev = 0.1;
  asked.protocol = {Protocol::Name::paper, false};
  asked.discrepancy = false;
  asked.max_points = 30;
  asked.also_noise_stddev = 0.2;
  asked.time_step = 0.01;
  asked.seed = 18446744073709551615U;
  asked.project = asked.robust = true;
  request.restarts = 3;
  request.max_escapes = 0;
  request.gradient_tolerance = 1e-5;
  request.reduction_tolerance = 1e-12;
  request.max_iterations = 7;
  request.hyperparameters = HyperparameterChoice::integrate;
  request.standard_errors = false;
  request.start.values = {{"m2", 0.7}};
  request.thin = false;
  return request;
}

constexpr const char* every_option =
    R"({"also_noise_std": 0.2, "baseline": "icm", "discrepancy": "none", "dt": 0.01, "estimate": [], "gradient_tolerance": 1e-5,
        "hyperparameters": "integrate", "hyperprior": "none", "map": ["theta1=q3"], "max_escapes": 0, "max_iterations": 7, "max_points": 30, "mean": "force",
        "noise_std": 0.1, "observe": ["ddq1", "ddq3"], "prior": "force", "project": true, "protocol": "paper",
        "reduction_tolerance": 1e-12, "restarts": 3, "robust": true, "seed": 18446744073709551615, "standard_errors": false,
        "start": {"m2": 0.7}, "thin": "none"})";

TEST(Options, AreWrittenUnderTheirNames) {
  FitRequest request = request_with_every_option();
  EXPECT_EQ(json_of(request), json::parse(every_option));
  request.problem.estimate_noise = true;
  EXPECT_EQ(json_of(request)["noise_std"], "estimate");
  request.problem.estimate_noise = false;
  request.problem.trust_stated_noise = true;
  EXPECT_EQ(json_of(request)["noise_std"], "stated");
}

TEST(Options, ReadBackAreThoseThatWereWritten) {
  FitRequest request;
  read_options(every_option, options(request), "fit.json");
  EXPECT_EQ(json_of(request), json::parse(every_option));
  EXPECT_EQ(request.problem.columns, (std::map<std::string, std::string>{{"q3", "theta1"}}));
  EXPECT_EQ(request.problem.protocol.name, Protocol::Name::paper);
  EXPECT_EQ(request.hyperparameters, HyperparameterChoice::integrate);
  EXPECT_FALSE(request.standard_errors);
  EXPECT_EQ(request.problem.seed, 18446744073709551615U);
  read_options(R"({"noise_std": "stated"})", options(request), "fit.json");
  EXPECT_TRUE(request.problem.trust_stated_noise);
}

std::string refusal(const std::string& text) {
  FitRequest request;
  return test::input_error_of([&] { read_options(text, options(request), "fit.json"); });
}

TEST(Options, OfAnotherKindAreRefusedByName) {
  EXPECT_EQ(refusal(R"({"restart": 3})"), "fit.json: unknown option 'restart'");
  for (const char* wrong : {R"({"restarts": "3"})", R"({"mean": "one"})", R"({"mean": 1})", R"({"project": 1})",
                            R"({"observe": "ddq1"})", R"({"map": "theta1=q3"})", R"({"map": ["theta1"]})",
                            R"({"noise_std": "little"})", R"({"start": {"m2": "heavy"}})", R"({"hyperprior": true})"}) {
    EXPECT_THAT(refusal(wrong), HasSubstr("is of another kind")) << wrong;
  }
}

TEST(Options, HaveASentenceEach) {
  FitRequest request;
  for (const Option& option : options(request)) {
    EXPECT_THAT(option.name, testing::MatchesRegex("[a-z_]+"));
    EXPECT_GT(option.text.size(), 20U) << option.name;
    EXPECT_THAT(option.text, testing::Not(HasSubstr("--"))) << option.name << ": no face's spelling";
  }
}

TEST(Options, InMessagesAreRespelledByAFace) {
  const auto spelled = [](const std::string& message) {
    return respelled(message, [](const std::string& name, const std::optional<std::string>& value) {
      return "<" + name + (value ? ":" + *value : "") + ">";
    });
  };
  EXPECT_EQ(spelled("`noise_std`: give `noise_std=estimate` or `map=a=b`"),
            "<noise_std>: give <noise_std:estimate> or <map:a=b>");
  EXPECT_EQ(spelled("log `A`: no `Option`, one `of` ` these"), "log `A`: no `Option`, one <of> ` these");
  EXPECT_EQ(spelled("nothing to spell"), "nothing to spell");
}

}  // namespace
}  // namespace gp2
