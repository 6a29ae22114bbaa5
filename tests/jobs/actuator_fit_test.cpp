#include "gp2/jobs/actuator_fit.hpp"

#include <cmath>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "gp2/base/file.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/jobs/raw_fit.hpp"
#include "gp2/training/laplace.hpp"
#include "input_error.hpp"
#include "io_testing.hpp"
#include "jobs/late_cart.hpp"

namespace gp2::test {
namespace {

using testing::Contains;
using testing::HasSubstr;

const char* const estimated = R"({ name = "u", delay = { estimate = true }, lag = { estimate = true } })";

FitRequest request_for(const std::string& input, const CsvTable& log) {
  FitRequest request;
  request.model = late_cart(input);
  request.logs = {{log}};
  request.problem.mean = Prior::Mean::force;
  request.problem.max_points = 120;
  request.restarts = 2;
  request.hyperparameters = HyperparameterChoice::optimise;
  return request;
}

FitOutcome fit_of(const std::string& input, const CsvTable& log) { return run_fit(prepare_fit(request_for(input, log))); }

double nrmse(const FitOutcome& fit, const CsvTable& test) { return evaluate(fit.file, fit.posterior, test, {}).evaluation.nrmse; }

TEST(ActuatorFit, FindsDelayAndLagWithinTheirErrorsAndLearnsAsIfTheyWereKnown) {
  struct Truth {
    double delay, lag, rate;
  };
  // of two deviations 95 % are within; each seed tells both
  int n_within = 0, n = 0;
  double known = 0, found = 0, ignored = 0;
  for (const Truth truth : {Truth{0.02, 0.05, 250}, Truth{0.05, 0.02, 100}}) {
    for (std::uint64_t seed = 21; seed < 27; ++seed) {
      const CsvTable log = late_cart_log(truth.delay, truth.lag, truth.rate, 6, seed),
                     test = late_cart_log(truth.delay, truth.lag, truth.rate, 4, 100 + seed, 0);
      const FitOutcome fit = fit_of(estimated, log);
      ASSERT_EQ(fit.file.report.actuators.size(), 2);
      for (const ActuatorEstimate& one : fit.file.report.actuators) {
        const double off = std::abs(one.value - (one.name == "u.delay" ? truth.delay : truth.lag));
        EXPECT_LT(one.stddev, 0.004) << one.name;
        EXPECT_LT(off, 4 * one.stddev) << one.name << " of seed " << seed;
        n_within += off < 2 * one.stddev ? 1 : 0;
        ++n;
      }
      const std::string given = fmt::format("{{ name = \"u\", delay = {}, lag = {} }}", truth.delay, truth.lag);
      found += std::log(nrmse(fit, test));
      known += std::log(nrmse(fit_of(given, log), test));
      ignored += std::log(nrmse(fit_of(R"("u")", log), test));
    }
  }
  EXPECT_GE(n_within, 0.8 * n);
  EXPECT_LT(std::exp((found - known) / (n / 2.0)), 1.3);
  EXPECT_GT(std::exp((ignored - known) / (n / 2.0)), 5);
}

// which no delay and no lag is linear in
TEST(ActuatorFit, FindsThemBesideALatentThatIsPositive) {
  int n_within = 0, n = 0;
  for (std::uint64_t seed = 31; seed < 35; ++seed) {
    FitRequest request = request_for(estimated, late_cart_log(0.02, 0.05, 250, 6, seed));
    std::string text = request.model.text;
    const std::string linear = "[\"dx\"]\ndirections = \"force\"";
    text.replace(text.find(linear), linear.size(), "[\"abs(dx)\"]\ndirections = { force = [[\"-dx\"]] }\npositive = true");
    request.model = Model::parse(text, "late_cart.toml");
    const FitOutcome fit = run_fit(prepare_fit(std::move(request)));
    ASSERT_EQ(fit.file.report.actuators.size(), 2);
    for (const ActuatorEstimate& one : fit.file.report.actuators) {
      const double off = std::abs(one.value - (one.name == "u.delay" ? 0.02 : 0.05));
      EXPECT_LT(one.stddev, 0.004) << one.name;
      EXPECT_LT(off, 4 * one.stddev) << one.name << " of seed " << seed;
      n_within += off < 2 * one.stddev ? 1 : 0;
      ++n;
    }
  }
  EXPECT_GE(n_within, 0.75 * n);
}

TEST(ActuatorFit, SameSeedSameBitsForAnyNumberOfThreads) {
  const CsvTable log = late_cart_log(0.02, 0.05, 100, 4, 3);
  std::vector<FitOutcome> fits;
  for (const int threads : {1, 3}) {
    FitRequest request = request_for(estimated, log);
    request.threads = threads;
    fits.push_back(run_fit(prepare_fit(std::move(request))));
  }
  for (std::size_t k = 0; k < 2; ++k) {
    EXPECT_EQ(fits[0].file.report.actuators[k].value, fits[1].file.report.actuators[k].value);
    EXPECT_EQ(fits[0].file.report.actuators[k].stddev, fits[1].file.report.actuators[k].stddev);
  }
  EXPECT_EQ(fits[0].file.report.objective, fits[1].file.report.objective);
}

TEST(ActuatorFit, AFitKeepsItsEstimatesInItsFileAndIsDoneAgainFromThere) {
  const CsvTable log = late_cart_log(0.02, 0.05, 100, 4, 3);
  const FitOutcome fit = fit_of(estimated, log);
  const TemporaryFolder folder;
  fit.file.write(folder / "late.json");
  const FitFile read = FitFile::read(folder / "late.json");
  ASSERT_EQ(read.report.actuators.size(), 2);
  EXPECT_EQ(read.model.actuators[0].delay.value, fit.file.report.actuators[0].value);
  EXPECT_EQ(read.model.actuators[0].lag.value, fit.file.report.actuators[1].value);
  EXPECT_EQ(read.report.actuators[1].stddev, fit.file.report.actuators[1].stddev);
  EXPECT_EQ(nrmse(fit, log), evaluate(read, read.posterior(), log, {}).evaluation.nrmse);
  const FitOutcome again = run_fit(prepare_fit_again(read));
  EXPECT_EQ(again.file.report.objective, fit.file.report.objective);
  EXPECT_EQ(again.file.model.actuators[0].delay.value, read.model.actuators[0].delay.value);
}

TEST(ActuatorFit, AStartHasDelaysAndLagsToo) {
  const CsvTable log = late_cart_log(0.02, 0.05, 100, 4, 3);
  const FitOutcome fit = fit_of(estimated, log);
  const TemporaryFolder folder;
  fit.file.write(folder / "late.json");
  const auto prepared = [&](const std::string& input, const NamedNumbers& start) {
    FitRequest request = request_for(input, log);
    request.start = start;
    request.max_iterations = 0;
    return prepare_fit(std::move(request));
  };
  const auto started_as = [&](const std::string& input, const NamedNumbers& start) { return run_fit(prepared(input, start)); };
  const NamedNumbers from_file{.file = (folder / "late.json").string(), .values = {}};
  const FitOutcome as_it_is = started_as(estimated, from_file);
  EXPECT_NEAR(as_it_is.file.report.negative_log_likelihood, fit.file.report.negative_log_likelihood, 1e-6);
  EXPECT_EQ(as_it_is.file.model.actuators[0].delay.value, fit.file.model.actuators[0].delay.value);
  as_it_is.file.write(folder / "again.json");
  const FitFile read = FitFile::read(folder / "again.json");
  EXPECT_EQ(evaluate(read, read.posterior(), log, {}).evaluation.nrmse, nrmse(as_it_is, log));
  EXPECT_EQ(started_as(estimated, {.file = "", .values = {{"u.lag", 0.03}}}).file.model.actuators[0].lag.value, 0.03);
  FitRequest beyond = request_for(estimated, log);
  beyond.start.values = {{"u.lag", 3}};
  EXPECT_THAT(input_error_of([&] { prepare_fit(beyond); }), HasSubstr("u.lag = 3 is outside its bounds [0, 0.1]"));
  // one that holds them says what it does not take
  const FitJob held = prepared(R"({ name = "u", delay = 0.01 })", from_file);
  EXPECT_THAT(held.notes,
              Contains(testing::AllOf(HasSubstr("u.delay = "), HasSubstr(" is not taken: this fit does not estimate it "
                                                                         "and has 0.01 of the model"))));
}

TEST(ActuatorFit, CountsWhatAnErrorOfALagMakesOfAMass) {
  const CsvTable log = late_cart_log(0, 0.04, 100, 6, 8);
  const auto fit_with = [&](const std::string& lag) {
    FitRequest request = request_for(R"("u")", log);
    request.model = late_cart(fmt::format("{{ name = \"u\", lag = {} }}", lag), /*estimates_mass=*/true);
    request.thin = false;
    return run_fit(prepare_fit(std::move(request))).file.report;
  };
  const auto mass_of = [](const FitReport& report) {
    return std::ranges::find(report.hyperparameters, "m", &Hyperparameter::name) - report.hyperparameters.begin();
  };
  const FitReport report = fit_with("{ estimate = true }");
  const ActuatorEstimate& lag = report.actuators.front();
  const auto m = mass_of(report);
  const auto mass_at = [&](double value) {
    const FitReport there = fit_with(fmt::format("{{ estimate = true, prior = {{ mean = {}, stddev = 1e-7 }} }}", value));
    return there.hyperparameters[static_cast<std::size_t>(mass_of(there))].value;
  };
  const double move = (mass_at(lag.value + lag.stddev) - mass_at(lag.value - lag.stddev)) / 2;
  EXPECT_NEAR(lag.moves.at("m"), move, 0.2 * std::abs(move));
  const double of_mass = report.uncertainty->stddev[m];
  EXPECT_DOUBLE_EQ(parameter_uncertainty(report, static_cast<std::size_t>(m)).stddev, std::hypot(of_mass, lag.moves.at("m")));
  EXPECT_GT(std::abs(move), 0.1 * of_mass);
  EXPECT_NEAR(parameter_correlation(report, static_cast<std::size_t>(m), static_cast<std::size_t>(m)), 1, 1e-14);
}

TEST(ActuatorFit, FromARawLogToo) {
  const CsvTable log = late_cart_log(0.03, 0.02, 200, 4, 5);
  std::vector<CsvTable::Column> columns;
  for (const char* name : {"t", "x", "u"}) {
    columns.push_back({name, {}});
    for (int row = 0; row < log.n_rows(); ++row) {
      const double value = log.number(row, log.find(name));
      columns.back().numbers.push_back(columns.size() == 2 ? std::round(value * 1e5) / 1e5 : value);
    }
  }
  FitRequest request = request_for(estimated, log);
  request.problem.max_points = 200;
  RawFitOptions options;
  options.most_passes = 1;
  const LearnedLog learned = learn_and_smooth(request, CsvTable::from_columns("raw", columns), options);
  EXPECT_NE(learned.windows, nullptr);
  const FitOutcome fit = run_fit(prepare_fit(learned.request(request, "raw")));
  EXPECT_TRUE(fit.posterior.observations().front().has_sums());
  EXPECT_NEAR(fit.file.model.actuators[0].delay.value, 0.03, 0.003);
  EXPECT_NEAR(fit.file.model.actuators[0].lag.value, 0.02, 0.003);
  EXPECT_NEAR(fit.file.model.actuators[0].delay.value + fit.file.model.actuators[0].lag.value, 0.05, 0.001);
}

TEST(ActuatorFit, AFileWithTheDelayOfNoInputIsRefused) {
  const TemporaryFolder folder;
  fit_of(R"({ name = "u", delay = { estimate = true } })", late_cart_log(0.02, 0, 100, 2, 3)).file.write(folder / "late.json");
  const auto json = nlohmann::json::parse(read_file(folder / "late.json"));
  const auto error_of = [&](const char* key, const auto& value) {
    auto changed = without_checksum(json);
    changed["actuators"][0][key] = value;
    return input_error_of([&] { FitFile::parse(changed.dump(), "late.json"); });
  };
  EXPECT_EQ(error_of("name", "u.delay"), "");
  EXPECT_EQ(error_of("name", "v.delay"), "late.json: 'v.delay' is not of this model");
  EXPECT_EQ(error_of("value", -1), "late.json: u.delay must not be negative, got -1");
}

TEST(ActuatorFit, SaysWhatTheDataDoNotDetermine) {
  // a constant force, which is as it is however late
  const CsvTable moving = late_cart_log(0, 0, 100, 3, 3);
  std::vector<CsvTable::Column> columns;
  for (const std::string& name : moving.header()) {
    columns.push_back({name, {}});
    for (int row = 0; row < moving.n_rows(); ++row)
      columns.back().numbers.push_back(name == "u" ? 1 : moving.number(row, moving.find(name)));
  }
  const FitOutcome fit = fit_of(estimated, CsvTable::from_columns("steady", columns));
  for (const ActuatorEstimate& one : fit.file.report.actuators) EXPECT_FALSE(std::isfinite(one.stddev)) << one.name;
  EXPECT_THAT(fit.notes, Contains(HasSubstr("the data do not determine u.delay")));
}

TEST(ActuatorFit, SaysWhereABoundHolds) {
  const CsvTable log = late_cart_log(0.06, 0, 100, 4, 3);
  const FitOutcome fit = fit_of(R"({ name = "u", delay = { bounds = [0, 0.03], estimate = true } })", log);
  EXPECT_DOUBLE_EQ(fit.file.report.actuators[0].value, 0.03);
  EXPECT_TRUE(std::isnan(fit.file.report.actuators[0].stddev));
  EXPECT_THAT(fit.notes, Contains("warning: u.delay ended at its bound, 0.03 s. It may lie beyond: give it wider bounds"));
}

TEST(ActuatorFit, APriorWeighs) {
  const CsvTable log = late_cart_log(0.06, 0, 100, 4, 3);
  const FitOutcome free = fit_of(R"({ name = "u", delay = { estimate = true } })", log);
  const FitOutcome sure = fit_of(R"({ name = "u", delay = { estimate = true, prior = { mean = 0.03, stddev = 1e-6 } } })", log);
  EXPECT_NEAR(free.file.report.actuators[0].value, 0.06, 0.002);
  EXPECT_NEAR(sure.file.report.actuators[0].value, 0.03, 1e-4);
  EXPECT_NEAR(sure.file.report.actuators[0].stddev, 1e-6, 1e-8);
}

TEST(ActuatorFit, EstimatesWhatIsAskedFor) {
  const CsvTable log = late_cart_log(0.02, 0.03, 100, 3, 3);
  FitRequest none = request_for(estimated, log), one = request_for(R"({ name = "u", lag = 0.03 })", log);
  none.problem.estimate.emplace();
  one.problem.estimate = {"u.delay"};
  EXPECT_TRUE(prepare_fit(none).problem.late.empty());
  const FitJob job = prepare_fit(one);
  ASSERT_EQ(job.problem.late.size(), 1);
  EXPECT_EQ(job.problem.late[0].name, "u.delay");
  // what nothing reads
  FitRequest unread = request_for(estimated, log);
  unread.problem.mean = Prior::Mean::zero;
  EXPECT_THAT(prepare_fit(unread).notes, Contains(HasSubstr("warning: u.delay is not estimated: nothing that this fit reads")));
}

}  // namespace
}  // namespace gp2::test
