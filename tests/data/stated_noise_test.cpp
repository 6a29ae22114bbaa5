#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "base/random.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/jobs/resample.hpp"
#include "gp2/mechanics/check.hpp"
#include "io_testing.hpp"

// Logs that state a standard deviation for each value, in columns NAME_std.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::input_error_of;
using testing::Contains;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::Not;

// y = x/2 all the time, so ddy follows from ddx
constexpr const char* slope = R"(
coordinates = ["x", "y"]
[mechanics]
mass = [["1", "0"], ["0", "2"]]
[constraints]
position = ["y - 0.5*x"]
[[latent]]
name       = "a"
kernel     = "se"
features   = ["x", "dx"]
directions = "acceleration"
)";

Model slope_with(const std::string& more = "") { return Model::parse(slope + more, "slope.toml"); }

// columns x, y, dx, dy, ddx, ddy and those of `stated`; ddx ranges over [−1.9, 2], its deviation over 0.01 … 0.4
std::string csv_of(const std::vector<std::string>& stated, const std::vector<std::string>& names = {"ddx", "ddy"}) {
  std::string csv = fmt::format("x,y,dx,dy,{},{}", names[0], names[1]);
  for (const std::string& name : stated) csv += "," + name;
  csv += "\n";
  for (int i = 0; i < 40; ++i) {
    const double x = std::sin(1.3 * i), dx = std::cos(0.7 * i), ddx = 0.1 * ((7 * i) % 40 - 19);
    csv += fmt::format("{},{},{},{},{},{}", x, x / 2, dx, dx / 2, ddx, ddx / 2);
    for (std::size_t k = 0; k < stated.size(); ++k) csv += fmt::format(",{}", 0.01 * (i + 1));
    csv += "\n";
  }
  return csv;
}

CsvTable log_of(const std::vector<std::string>& stated, const std::vector<std::string>& names = {"ddx", "ddy"}) {
  return CsvTable::parse(csv_of(stated, names), "log.csv");
}

// the log with the deviation of one row, from 1, written anew
CsvTable log_with(const std::string& stddev, int row) {
  std::string csv = csv_of({"ddx_std"});
  std::size_t line = csv.find('\n') + 1;
  for (int i = 1; i < row; ++i) line = csv.find('\n', line) + 1;
  const std::size_t end = csv.find('\n', line), comma = csv.rfind(',', end);
  return CsvTable::parse(csv.substr(0, comma + 1) + stddev + csv.substr(end), "log.csv");
}

std::vector<std::string> observed(const FitProblem& problem) {
  return problem.observations.front().view().names(*problem.prior.system);
}

const Hyperparameter& noise_in(const FitProblem& problem) {
  for (const Hyperparameter& h : problem.hyperparameters) {
    if (h.kind == Hyperparameter::Kind::noise_stddev) return h;
  }
  throw std::runtime_error("no noise is estimated");
}

FitProblemOptions trusting() {
  FitProblemOptions options;
  options.trust_stated_noise = true;
  return options;
}

VectorXd stated_deviations() { return 0.01 * VectorXd::LinSpaced(40, 1, 40); }

TEST(StatedNoise, IsThatOfEachValueAndSaysWhatIsObserved) {
  const FitProblem problem = make_fit_problem(slope_with(), log_of({"ddx_std"}), trusting());
  EXPECT_THAT(observed(problem), ElementsAre("ddx"));
  const Observations& group = problem.observations.front();
  EXPECT_EQ(group.noise().stddev(), VectorXd::Ones(1));
  EXPECT_FALSE(group.noise().is_estimated());
  ASSERT_EQ(group.noise().scale().cols(), 40);
  EXPECT_LE((group.noise().scale().row(0).transpose() - stated_deviations()).cwiseAbs().maxCoeff(), 1e-15);
  EXPECT_THAT(problem.notes,
              ElementsAre("log.csv: observes ddx: the log has standard deviations of these only; others with `observe`",
                          "log.csv: the noise of each value is that in ddx_std"))
      << "no warning of accelerations that depend on each other, no column that is not needed";
}

TEST(StatedNoise, OfEveryAccelerationLeavesThemAllObserved) {
  const FitProblem problem = make_fit_problem(slope_with(), log_of({"ddx_std", "ddy_std"}), trusting());
  EXPECT_THAT(observed(problem), ElementsAre("ddx", "ddy"));
  EXPECT_THAT(problem.notes, Contains("log.csv: the noise of each value is that in ddx_std, ddy_std"));
  EXPECT_THAT(problem.notes, Contains(HasSubstr("warning: log.csv: the accelerations satisfy A ddq = b")));
}

TEST(StatedNoise, TheModelsNoiseServesWhereNothingIsStated) {
  FitProblemOptions options = trusting();
  options.observe = {"ddy", "ddx"};
  const FitProblem problem = make_fit_problem(slope_with("[noise]\nddq = [0.3, 0.7]\n"), log_of({"ddx_std"}), options);
  const Observations& group = problem.observations.front();
  EXPECT_THAT(observed(problem), ElementsAre("ddy", "ddx"));
  EXPECT_EQ(group.noise().stddev(), Eigen::Vector2d(0.7, 1));
  EXPECT_EQ(group.noise().scale().row(0), Eigen::RowVectorXd::Ones(40));
  EXPECT_LE((group.noise().scale().row(1).transpose() - stated_deviations()).cwiseAbs().maxCoeff(), 1e-15);

  EXPECT_THAT(input_error_of([&] { make_fit_problem(slope_with(), log_of({"ddx_std"}), options); }),
              HasSubstr("slope.toml: the noise of ddy is not known"));
}

TEST(StatedNoise, OneNoiseForAllReplacesIt) {
  FitProblemOptions options;
  options.noise_stddev = 0.2;
  const FitProblem problem = make_fit_problem(slope_with(), log_of({"ddx_std"}), options);
  EXPECT_THAT(observed(problem), ElementsAre("ddx"));
  EXPECT_FALSE(problem.observations.front().noise().has_scale());
  EXPECT_EQ(problem.observations.front().noise().stddev(), VectorXd::Constant(1, 0.2));
  EXPECT_THAT(problem.notes, Contains("log.csv: `noise_std=0.2` replaces the standard deviations in ddx_std"));
}

TEST(StatedNoise, IsMultipliedByAFactorThatIsEstimatedUnlessItIsTrusted) {
  const FitProblem problem = make_fit_problem(slope_with(), log_of({"ddx_std"}), {});
  EXPECT_THAT(problem.notes, Contains("log.csv: the noise of each value is that in ddx_std, times a factor that is estimated"));
  const Hyperparameter& factor = noise_in(problem);
  EXPECT_EQ(factor.name, "noise_stddev(ddx)");
  EXPECT_EQ(factor.unit, "stated deviation of ddx");
  EXPECT_EQ(factor.value, 1);
  EXPECT_EQ(factor.hyperprior.median, 1);
  EXPECT_EQ(factor.hyperprior.stddev, 0.5);
  // no fit says that stated deviations are more than five times too large; the usual one stays below twice the spread
  const double spread = row_stddev(problem.observations.front().values())[0];
  EXPECT_EQ(factor.lower, 0.2);
  EXPECT_DOUBLE_EQ(factor.upper, 2 * spread / 0.21);
  EXPECT_TRUE(problem.observations.front().noise().is_estimated());
}

TEST(StatedNoise, AModelThatWantsItsNoiseEstimatedIsNotAskedWhereItIsTrusted) {
  const Model model = slope_with("[noise]\nddq = { estimate = true, initial = 0.1 }\n");
  EXPECT_FALSE(make_fit_problem(model, log_of({"ddx_std"}), trusting()).observations.front().noise().is_estimated());
  EXPECT_TRUE(make_fit_problem(model, log_of({}), {}).observations.front().noise().is_estimated());
}

TEST(StatedNoise, GoesByTheNameThatTheLogGivesTheAcceleration) {
  EXPECT_THAT(observed(make_fit_problem(slope_with(), log_of({"x_ddot_std"}, {"x_ddot", "y_ddot"}), {})), ElementsAre("ddx"));
  EXPECT_THAT(observed(make_fit_problem(slope_with(), log_of({"ddx_std"}, {"x_ddot", "y_ddot"}), {})), ElementsAre("ddx"));
  FitProblemOptions options;
  options.columns = {{"ddy", "height"}};
  EXPECT_THAT(observed(make_fit_problem(slope_with(), log_of({"height_std"}, {"ddx", "height"}), options)), ElementsAre("ddy"));
}

TEST(StatedNoise, FollowsTheRowsThatAreTaken) {
  FitProblemOptions options;
  options.max_points = 7;
  const FitProblem all = make_fit_problem(slope_with(), log_of({"ddx_std"}), {});
  const FitProblem some = make_fit_problem(slope_with(), log_of({"ddx_std"}), options);
  const Observations &whole = all.observations.front(), &part = some.observations.front();
  ASSERT_EQ(part.n_data(), 7);
  for (Index i = 0; i < 7; ++i) {
    Index same = -1;
    (whole.states().row(0).array() - part.states()(0, i)).abs().minCoeff(&same);
    EXPECT_EQ(part.noise().scale()(0, i), whole.noise().scale()(0, same));
  }
}

TEST(StatedNoise, SizesTheDiscrepancyByWhatTheRowsSay) {
  const FitProblem problem = make_fit_problem(slope_with(), log_of({"ddx_std"}), trusting());
  ASSERT_TRUE(problem.prior_options.discrepancy.has_value());
  const Eigen::RowVectorXd stddev = problem.observations.front().noise().scale().row(0);
  EXPECT_NEAR(problem.prior_options.discrepancy->stddev[0], 1 / std::sqrt(stddev.array().square().inverse().mean()), 1e-12);
}

TEST(StatedNoise, ThatIsNotAPositiveNumberIsNamedByFileLineAndColumn) {
  const auto refused = [](const std::string& stddev) {
    return input_error_of([&] { make_fit_problem(slope_with(), log_with(stddev, 3), {}); });
  };
  const std::string rule =
      "log.csv:4: column 'ddx_std': the standard deviation of ddx must be positive, got {}; leave the cell "
      "empty where nothing is measured";
  EXPECT_EQ(refused("0"), fmt::format(fmt::runtime(rule), 0));
  EXPECT_EQ(refused("-0.1"), fmt::format(fmt::runtime(rule), -0.1));
  EXPECT_EQ(refused("inf"), "log.csv:4: column 'ddx_std': 'inf' is not a finite number");
  EXPECT_EQ(refused("nan"),
            "log.csv:4: column 'ddx_std': 'nan' is not a finite number; leave the cell empty where nothing is measured");
  EXPECT_EQ(refused(""), "") << "an empty cell is a value that is not measured";
}

double smallest_usable(const std::string& text) {
  const std::string before = "the smallest usable value is ";
  return std::stod(text.substr(text.find(before) + before.size()));
}

TEST(StatedNoise, TooSmallForDoublePrecisionAtOneValueIsRefused) {
  // ‖K̃‖ ≤ Σ (signal/noise)² must leave a hundredth of the digits: one small value among 40 may be √40 below the rule for all
  const double spread = row_stddev(make_fit_problem(slope_with(), log_of({"ddx_std"}), {}).observations.front().values())[0];
  const double limit = spread * std::sqrt(std::numeric_limits<double>::epsilon() / 0.01);
  EXPECT_NO_THROW(make_fit_problem(slope_with(), log_with(shortest(1.01 * limit), 3), {}));
  for (const bool estimate : {false, true}) {
    FitProblemOptions options;
    options.estimate_noise = estimate;
    const std::string text =
        input_error_of([&] { make_fit_problem(slope_with(), log_with(shortest(0.99 * limit), 3), options); });
    EXPECT_THAT(text,
                HasSubstr(fmt::format("log.csv: column 'ddx_std': data row 3: the noise standard deviation {} of ddx is too "
                                      "small for double precision beside a spread of {:.3g}; the smallest usable value is ",
                                      0.99 * limit, spread)));
    EXPECT_GE(smallest_usable(text), limit * std::sqrt(40));
    EXPECT_LE(smallest_usable(text), 1.1 * limit * std::sqrt(40));
  }
}

TEST(StatedNoise, TheSmallestUsableValueIsUsable) {
  FitProblemOptions options;
  for (const int n_rows : {3, 7, 12, 19, 26, 33, 40}) {
    const CsvTable log = log_of({}).first_rows(n_rows);
    options.noise_stddev = 1e-12;
    options.noise_stddev = smallest_usable(input_error_of([&] { make_fit_problem(slope_with(), log, options); }));
    EXPECT_NO_THROW(make_fit_problem(slope_with(), log, options)) << n_rows;
  }
}

TEST(StatedNoise, WeighsTheValuesOfAFit) {
  // a mass on a spring, measured well and badly: the fit believes the good values
  std::string csv = "x,dx,ddx,ddx_std\n";
  RandomStream random(5);
  for (int i = 0; i < 60; ++i) {
    const double x = std::sin(0.9 * i), dx = std::cos(1.7 * i), stddev = i % 2 == 0 ? 0.01 : 2;
    csv += fmt::format("{},{},{},{}\n", x, dx, -3 * x - 0.5 * dx + stddev * random.normal(), stddev);
  }
  const Model spring = Model::parse(
      "coordinates = [\"x\"]\n[mechanics]\nmass = [[\"1\"]]\n[[latent]]\nname = \"a\"\nkernel = \"se\"\nfeatures = [\"x\", "
      "\"dx\"]\ndirections = \"acceleration\"\n",
      "spring.toml");
  const CsvTable log = CsvTable::parse(csv, "log.csv");
  const auto worst_error = [&](const FitProblemOptions& options) {
    FitOptions fit_options;
    fit_options.n_restarts = 1;
    const Fit fitted = fit(make_fit_problem(spring, log, options), fit_options);
    MatrixXd states = MatrixXd::Zero(3, 50);  // x, dx, t
    for (int i = 0; i < 50; ++i) states.col(i).head(2) = 0.9 * Eigen::Vector2d(std::sin(0.31 * i), std::cos(0.53 * i));
    const MatrixXd mean = fitted.posterior.mean(View::all(View::Quantity::constrained_acceleration, *spring.system), states);
    return (mean.row(0) + 3 * states.row(0) + 0.5 * states.row(1)).cwiseAbs().maxCoeff();
  };
  FitProblemOptions blind;
  blind.noise_stddev = 1.4;
  EXPECT_LT(worst_error({}), 0.05);
  EXPECT_LT(worst_error(trusting()), 0.05);
  EXPECT_GT(worst_error(blind), 0.2);
}

TEST(StatedNoise, IsStatedWhateverItsUnit) {
  for (const double stddev : {0.5, 1.0, 2.0}) {
    std::string text = "x,y,dx,dy,ddx,ddx_std\n";
    for (int i = 0; i < 20; ++i) {
      const double x = 0.1 * i, dx = std::sin(0.7 * i);
      text += fmt::format("{},{},{},{},{},{}\n", x, x / 2, dx, dx / 2, std::cos(1.3 * i), stddev * (1 + i % 3));
    }
    FitProblemOptions options;
    options.observe = {"ddx"};
    const FitProblem problem = make_fit_problem(slope_with(), CsvTable::parse(text, "log.csv"), options);
    EXPECT_TRUE(problem.observations.front().states_noise(0)) << stddev;
  }
}

TEST(StatedNoise, WeighsTheValuesOfABaseline) {
  FitProblemOptions options;
  options.baseline = Baseline::Kind::se;
  const FitProblem problem = make_fit_problem(slope_with(), log_of({"ddx_std", "ddy_std"}), options);
  EXPECT_TRUE(problem.observations.front().noise().has_scale());
  FitOptions at_start;
  at_start.max_iterations = 0;
  const Fit fitted = fit(problem, at_start);
  const double together = fitted.posterior.negative_log_likelihood();
  EXPECT_NEAR(fitted.report.negative_log_likelihood, together, 1e-10 * std::abs(together)) << "output by output and together";

  EXPECT_THAT(input_error_of([&] { make_fit_problem(slope_with(), log_of({"ddx_std"}), options); }),
              HasSubstr("the noise of ddy is not known"))
      << "a baseline learns every acceleration";
}

TEST(StatedNoise, TellsACheckWhichAccelerationsAreMeasured) {
  const Model model = slope_with();
  const auto texts = [&](const std::vector<std::string>& stated) {
    const CsvTable log = log_of(stated);
    LogReader reader = open_log(model, log, {});
    const WholeLog whole = read_whole_log(model, reader);
    EXPECT_EQ(whole.stated.size(), stated.size());
    EXPECT_THAT(reader.unused_columns(), testing::IsEmpty());
    std::vector<std::string> out;
    for (const Finding& finding : check_data(*model.system, whole.states, model.system->parameter_values(), whole.accelerations,
                                             whole.stddev, whole.stated)) {
      out.push_back((finding.level == Finding::Level::good ? "good: " : "not good: ") + finding.text);
    }
    return out;
  };
  EXPECT_THAT(texts({"ddx_std"}), Contains("good: dependent columns: the 2 accelerations satisfy A ddq = b, or part of it, far "
                                           "more closely than measurement noise "
                                           "allows; a fit observes ddx, whose standard deviations the log gives"));
  EXPECT_THAT(texts({"ddx_std"}), Not(Contains(HasSubstr("not good"))));
  EXPECT_THAT(texts({}), Contains(HasSubstr("not good: dependent columns")));
  EXPECT_THAT(texts({"ddx_std", "ddy_std"}), Contains(HasSubstr("not good: dependent columns")));
}

TEST(StatedNoise, HasTheFloorOfTheModel) {
  const Model model = slope_with("[noise]\nddq = { floor = [0.03, 0.5] }\n");
  const FitProblem problem = make_fit_problem(model, log_of({"ddx_std"}), trusting());
  const MatrixXd& scale = problem.observations.front().noise().scale();
  for (Index i = 0; i < scale.cols(); ++i) {
    const double stated = 0.01 * static_cast<double>(i + 1);
    EXPECT_NEAR(scale(0, i), std::sqrt(0.03 * 0.03 + stated * stated), 1e-15);
  }
  EXPECT_THAT(problem.notes, Contains(HasSubstr("the noise of each value is that in ddx_std and the floor of [noise]")));
}

TEST(StatedNoise, BoundsOfTheModelAreThoseOfAnEstimateThatIsNoFactor) {
  const Model model = slope_with("[noise]\nddq = { value = 0.1, estimate = true, bounds = [0.05, 0.2], floor = 0.08 }\n");
  FitProblemOptions options;
  options.observe = {"ddx"};
  const Hyperparameter estimated = noise_in(make_fit_problem(model, log_of({}), options));
  EXPECT_EQ(estimated.lower, 0.08);
  EXPECT_EQ(estimated.upper, 0.2);
  EXPECT_EQ(estimated.value, 0.1);
  const Hyperparameter factor = noise_in(make_fit_problem(model, log_of({"ddx_std"}), options));
  EXPECT_EQ(factor.value, 1);
  EXPECT_GT(factor.upper, 0.2);
}

}  // namespace
}  // namespace gp2
