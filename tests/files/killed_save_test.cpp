#include <cmath>
#include <iostream>
#include <random>

#include <signal.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include <gmock/gmock.h>

#include "gp2/files/fit_file.hpp"
#include "gp2/simulation/generate.hpp"
#include "io_testing.hpp"
#include "test_models.hpp"

namespace gp2 {
namespace {

/// A fit of some megabytes, not optimised.
FitFile large_fit() {
  FitFile fit;
  fit.model = test::model("models/surface.toml");
  const Eigen::VectorXd noise_stddev = Eigen::VectorXd::Constant(3, 0.1);
  const GeneratedData data = generate(fit.model, {20000, 3, noise_stddev});
  const View view = View::all(View::Quantity::constrained_acceleration, *fit.model.system);
  fit.observations.push_back({data.states, view, data.accelerations, noise_stddev});
  fit.report.hyperparameters = default_hyperparameters(fit.prior(), fit.observations, {}, {});
  return fit;
}

TEST(ASaveThatIsKilled, LeavesTheOldFileOrTheNewOneWhole) {
  constexpr int n_kills = 50;
  const test::TemporaryFolder folder;
  const auto path = folder / "fit.json";
  FitFile fit = large_fit();
  fit.data_source = "save 0";
  timespec begin = {}, end = {};
  clock_gettime(CLOCK_MONOTONIC, &begin);
  fit.write(path);
  clock_gettime(CLOCK_MONOTONIC, &end);
  const double save_time =
      static_cast<double>(end.tv_sec - begin.tv_sec) + 1e-9 * static_cast<double>(end.tv_nsec - begin.tv_nsec);

  std::mt19937 engine(1);
  std::uniform_real_distribution<double> moment(0, 3 * save_time);
  int n_old = 0, n_new = 0;
  for (int kill_number = 0; kill_number < n_kills; ++kill_number) {
    const std::string before = FitFile::read(path).data_source;
    const pid_t child = fork();
    if (child == 0) {
      // saves without end: whenever it is killed, it is saving
      for (int save = 1;; ++save) {
        fit.data_source = "kill " + std::to_string(kill_number) + ", save " + std::to_string(save);
        fit.write(path);
      }
    }
    ASSERT_GT(child, 0);
    const double seconds = moment(engine);
    const timespec pause = {static_cast<time_t>(seconds), static_cast<long>(1e9 * (seconds - std::floor(seconds)))};
    nanosleep(&pause, nullptr);
    ASSERT_EQ(kill(child, SIGKILL), 0);
    ASSERT_EQ(waitpid(child, nullptr, 0), child);

    FitFile read;
    ASSERT_NO_THROW(read = FitFile::read(path)) << "kill " << kill_number << " after " << seconds << " s";
    ASSERT_EQ(read.observations.front().values(), fit.observations.front().values());
    (read.data_source == before ? n_old : n_new) += 1;
  }
  EXPECT_GT(n_old, 0);
  EXPECT_GT(n_new, 0);
  const auto n_left =
      std::distance(std::filesystem::directory_iterator(folder.path()), std::filesystem::directory_iterator()) - 1;
  std::cout << n_kills << " kills of a save of " << std::filesystem::file_size(path) / 1000000 << " MB that takes " << save_time
            << " s: the old file " << n_old << " times, a new one " << n_new << " times, temporary files left: " << n_left
            << "\n";
}

}  // namespace
}  // namespace gp2
