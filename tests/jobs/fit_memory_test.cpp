#include "gp2/jobs/fit_memory.hpp"

#include <cmath>

#include <gmock/gmock.h>

#include "gp2/jobs/predict_job.hpp"
#include "gp2/simulation/generate.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

using test::input_error_of;
using test::TemporaryFolder;
using testing::AllOf;
using testing::HasSubstr;

constexpr double gigabyte = 1e9;

/// A fit of the surface, of which each state measures two of three accelerations independently; states are repeated.
FitProblem problem_of_size(int n_states) {
  const Model& model = test::model("models/surface.toml");
  const Eigen::VectorXd noise_stddev = Eigen::VectorXd::Constant(3, 0.1);
  const GeneratedData data = generate(model, {50, 3, noise_stddev});
  FitProblem problem;
  problem.prior = make_prior(model);
  std::vector<int> again;
  for (int i = 0; i < n_states; ++i) again.push_back(i % 50);
  const Observations group(data.states, View::all(View::Quantity::constrained_acceleration, *model.system), data.accelerations,
                           noise_stddev);
  problem.observations = {group.take(again)};
  problem.hyperparameters = default_hyperparameters(problem.prior, problem.observations, {}, {});
  return problem;
}

FitOptions on_threads(int n) {
  FitOptions options;
  options.n_threads = n;
  return options;
}

TEST(FitMemory, GrowsWithTheSquareOfTheReducedSizeAndWithTheRunsSideBySide) {
  const FitMemory one = fit_memory(problem_of_size(10000), on_threads(1));
  EXPECT_EQ(one.reduced_size, 20000);
  EXPECT_EQ(one.side_by_side, 1);
  // the triangle that is factored, or the square where the system has huge pages always
  EXPECT_GT(one.evaluation, 0.5 * 8 * 20000. * 20000);
  EXPECT_LT(one.evaluation, 1.25 * 8 * 20000. * 20000);
  const FitMemory four = fit_memory(problem_of_size(10000), on_threads(4));
  EXPECT_EQ(four.side_by_side, 4);
  EXPECT_NEAR(four.bytes() - one.shared, 4 * one.evaluation, 1);
  // the posterior, the factor that its residuals take, and a fifth of its square for stretches
  EXPECT_NEAR(one.bytes() - one.shared, 2 * one.evaluation + 0.2 * 8 * 20000. * 20000, 0.05 * one.evaluation);
  EXPECT_NEAR(fit_memory(problem_of_size(20000), on_threads(1)).bytes() / one.bytes(), 4, 0.2);
  FitOptions once = on_threads(4);
  once.max_iterations = 0;
  EXPECT_EQ(fit_memory(problem_of_size(100), once).side_by_side, 1) << "nothing is optimised";
}

TEST(FitMemory, ThroughInducingPointsGrowsWithTheirNumberAndInProportionToTheData) {
  FitOptions options = on_threads(4);
  options.n_inducing = 500;
  const FitMemory memory = fit_memory(problem_of_size(10000), options), more = fit_memory(problem_of_size(40000), options);
  EXPECT_EQ(memory.reduced_size, 20000);
  EXPECT_LT(memory.bytes(), 0.1 * gigabyte);
  EXPECT_LT(more.bytes(), 4 * memory.bytes());
  options.n_inducing = 1000;
  constexpr int of_parts = 8, of_threads = 4, others = 6;
  EXPECT_NEAR((fit_memory(problem_of_size(10000), options).evaluation - memory.evaluation) / (8. * 500 * 500),
              3 * (of_parts + of_threads + others), 1);
}

TEST(FitMemory, OfABaselineIsThatOfOneOutputAtATime) {
  const Model& model = test::model("models/surface.toml");
  FitProblemOptions options;
  options.baseline = Baseline::Kind::se;
  const GeneratedData data = generate(model, {400, 3, Eigen::VectorXd::Constant(3, 0.1)});
  const FitProblem problem = make_fit_problem(model, as_table(data, *model.system, "log.csv"), options);
  const FitMemory memory = fit_memory(problem, on_threads(1));
  EXPECT_EQ(memory.reduced_size, 1200);
  EXPECT_LT(memory.evaluation, memory.posterior);
}

TEST(WithinMemory, ThatIsEnoughOrUnknownNothingChanges) {
  const FitProblem problem = problem_of_size(10000);
  std::vector<std::string> notes;
  EXPECT_EQ(within_memory(problem, on_threads(4), std::nullopt, notes).max_side_by_side, 0);
  EXPECT_EQ(within_memory(problem, on_threads(4), 1000 * gigabyte, notes).max_side_by_side, 0);
  EXPECT_TRUE(notes.empty());
}

TEST(WithinMemory, ASmallFitIsNeverRefused) {
  std::vector<std::string> notes;
  EXPECT_EQ(within_memory(problem_of_size(100), on_threads(4), 0, notes).max_side_by_side, 0);
  EXPECT_NE(input_error_of([&] { within_memory(problem_of_size(10000), on_threads(4), 0, notes); }), "");
}

TEST(WithinMemory, ThatHoldsFewerFewerRunSideBySide) {
  const FitProblem problem = problem_of_size(10000);
  const FitMemory memory = fit_memory(problem, on_threads(4));
  std::vector<std::string> notes;
  const FitOptions fewer = within_memory(problem, on_threads(4), (memory.shared + 2.5 * memory.evaluation) / 0.9, notes);
  EXPECT_EQ(fewer.max_side_by_side, 2);
  EXPECT_EQ(fewer.n_threads, 4);
  ASSERT_EQ(notes.size(), 1U);
  EXPECT_THAT(notes[0], testing::MatchesRegex("[0-9.]+ GB of memory are free, and 4 runs side by side would take [0-9.]+ GB: "
                                              "2 at a time"));
  EXPECT_LT(fit_memory(problem, fewer).bytes(), memory.bytes());
}

TEST(WithinMemory, ThatHoldsNoneIsToldTheRowsThatFit) {
  std::vector<std::string> notes;
  const std::string error = input_error_of([&] { within_memory(problem_of_size(10000), on_threads(4), 0.5 * gigabyte, notes); });
  EXPECT_THAT(error, AllOf(HasSubstr("the fit of 10000 rows factors a matrix of size 20000 and takes "),
                           HasSubstr("GB of memory, of which 0.5 GB are free"), HasSubstr("take so many with `max_points="),
                           HasSubstr("or choose them with gp2 resample")));
  // so many fit, and not many more
  const int most = std::stoi(error.substr(error.find("`max_points=") + 12));
  EXPECT_GT(most, 1000);
  EXPECT_EQ(within_memory(problem_of_size(most), on_threads(1), 0.5 * gigabyte, notes).max_side_by_side, 0);
  EXPECT_NE(input_error_of([&] { within_memory(problem_of_size(most + most / 10), on_threads(1), 0.5 * gigabyte, notes); }), "");
}

TEST(JointPrediction, ThatMemoryDoesNotHoldIsRefused) {
  const FitProblem problem = problem_of_size(100);
  const Posterior posterior(problem.prior, problem.observations,
                            model_values(problem.prior, problem.observations, problem.hyperparameters));
  const View view = View::constrained_acceleration(*problem.prior.system);
  const auto error = [&](Eigen::Index n, std::optional<double> free) {
    return input_error_of([&] { require_memory_of_joint(posterior, view, n, free); });
  };
  EXPECT_EQ(error(1'000'000, std::nullopt), "");
  EXPECT_EQ(error(100, 0), "") << "a small one";
  EXPECT_EQ(error(10'000, 18 * gigabyte), "");
  EXPECT_THAT(error(10'000, 10 * gigabyte),
              AllOf(HasSubstr("all 10000 rows takes 15.3 GB"), HasSubstr("10.0 GB are free; take fewer rows")));
  EXPECT_NE(error(30'000, 18 * gigabyte), "");
}

TEST(WithinMemory, TheResultIsTheSame) {
  const FitProblem problem = problem_of_size(30);
  FitOptions options = on_threads(3);
  options.n_restarts = 3;
  options.max_iterations = 5;
  const FitReport all = fit(problem, options).report;
  options.max_side_by_side = 1;
  const FitReport one = fit(problem, options).report;
  EXPECT_EQ(one.objective, all.objective);
  ASSERT_EQ(one.hyperparameters.size(), all.hyperparameters.size());
  for (std::size_t k = 0; k < one.hyperparameters.size(); ++k)
    EXPECT_EQ(one.hyperparameters[k].value, all.hyperparameters[k].value);
}

TEST(WithinMemory, WhatTheSystemDoesNotGiveIsNotBegun) {
  const FitProblem problem = problem_of_size(1000);  // the square of 2000 and a buffer of BLAS: 32 MB and 134 MB
  const auto with_limit = [&](double limit, std::vector<std::string>& notes) {
    return within_memory(problem, on_threads(4), std::nullopt, notes, [&](double bytes, int n) { return n * bytes <= limit; });
  };
  std::vector<std::string> notes;
  EXPECT_EQ(with_limit(gigabyte, notes).max_side_by_side, 0);
  EXPECT_TRUE(notes.empty());
  EXPECT_EQ(with_limit(0.4 * gigabyte, notes).max_side_by_side, 2);
  ASSERT_EQ(notes.size(), 1U);
  EXPECT_EQ(notes[0], "the system does not give the memory that 4 runs side by side ask for (ulimit -v?): 2 at a time");
  const std::string few_rows = input_error_of([&] { with_limit(0.15 * gigabyte, notes); });
  EXPECT_THAT(few_rows, AllOf(HasSubstr("the fit of 1000 rows asks for 0.2 GB of memory in one piece"),
                              HasSubstr("rows of each log would fit: take so many with `max_points=")));
  EXPECT_THAT(input_error_of([&] { with_limit(0.1 * gigabyte, notes); }), HasSubstr("however few rows there are"));
  // of a million GB none is given, of little enough
  EXPECT_FALSE(is_given(1e15, 1));
  EXPECT_TRUE(is_given(1e6, 4));
}

// ---- what the system says

class Machine : public testing::Test {
 protected:
  void write(const std::string& path, const std::string& content) const {
    std::filesystem::create_directories((folder_ / path).parent_path());
    static_cast<void>(folder_.write(path, content));
  }
  [[nodiscard]] std::optional<double> free() const { return free_memory(folder_.path()); }

  TemporaryFolder folder_;
};

TEST_F(Machine, ThatDoesNotSayHasNoLimit) {
  EXPECT_EQ(free(), std::nullopt);
  write("proc/meminfo", "MemTotal:       1000 kB\nMemFree:         100 kB\n");
  EXPECT_EQ(free(), std::nullopt);
}

TEST_F(Machine, SaysWhatIsAvailable) {
  write("proc/meminfo", "MemTotal:       1000 kB\nMemFree:         100 kB\nMemAvailable:    500 kB\n");
  EXPECT_EQ(free(), 500 * 1024.);
  write("proc/self/cgroup", "0::/\n");
  EXPECT_EQ(free(), 500 * 1024.);
}

TEST_F(Machine, LeavesAControlGroupLess) {
  write("proc/meminfo", "MemAvailable:    500 kB\n");
  write("proc/self/cgroup", "0::/batch/job\n");
  write("sys/fs/cgroup/batch/job/memory.max", "max\n");
  write("sys/fs/cgroup/batch/job/memory.current", "1000\n");
  EXPECT_EQ(free(), 500 * 1024.);
  write("sys/fs/cgroup/batch/memory.max", "300000\n");
  write("sys/fs/cgroup/batch/memory.current", "200000\n");
  EXPECT_EQ(free(), 100000) << "of the group above";
  write("sys/fs/cgroup/batch/memory.stat", "anon 5\ninactive_file 50000\nactive_file 7\n");
  EXPECT_EQ(free(), 150000) << "files that nobody is using make room";
  write("sys/fs/cgroup/batch/job/memory.max", "500\n");
  EXPECT_EQ(free(), 0);
}

TEST_F(Machine, LeavesAControlGroupOfTheFirstVersionLess) {
  write("proc/meminfo", "MemAvailable:    500 kB\n");
  write("proc/self/cgroup", "4:memory:/docker/abc\n1:cpu:/\n0::/\n");
  write("sys/fs/cgroup/memory/memory.limit_in_bytes", "9223372036854771712\n");
  write("sys/fs/cgroup/memory/memory.usage_in_bytes", "1000\n");
  EXPECT_EQ(free(), 500 * 1024.);
  write("sys/fs/cgroup/memory/docker/abc/memory.limit_in_bytes", "100000\n");
  write("sys/fs/cgroup/memory/docker/abc/memory.usage_in_bytes", "70000\n");
  write("sys/fs/cgroup/memory/docker/abc/memory.stat", "total_inactive_file 1000\n");
  EXPECT_EQ(free(), 31000);
}

TEST(ThisMachine, SaysWhatIsFree) {
  const std::optional<double> free = free_memory();
  ASSERT_TRUE(free);
  EXPECT_GT(*free, 1e6);
  EXPECT_LT(*free, 1e15);
}

}  // namespace
}  // namespace gp2
