// A controller around a fit of docs/guide.md that goes on learning:  control_loop FIT.json LOG.csv
//
// A thread of 1 kHz pulls the bead to x = 0 like a damped spring: at each state the push that gives x the acceleration asked for, by
// one Newton step on what was learned so far. Another thread, the logger, learns from the measured accelerations of that log, forgets
// the oldest, and hands on what it learned. The states of the log stand in for the machine.

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <thread>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/error.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/inference/online_predictor.hpp"

namespace {

using Clock = std::chrono::steady_clock;

double microseconds_since(Clock::time_point start) {
  return std::chrono::duration<double, std::micro>(Clock::now() - start).count();
}

// median, 99th percentile and worst
void print(const char* what, std::vector<double> microseconds) {
  std::sort(microseconds.begin(), microseconds.end());
  if (microseconds.empty()) return;
  std::printf("%-34s %6zu times: median %9.2f us, 99 %% below %9.2f us, worst %9.2f us\n", what, microseconds.size(),
              microseconds[microseconds.size() / 2], microseconds[microseconds.size() * 99 / 100], microseconds.back());
}

struct Loop {
  int x = 0, dx = 0, push = 0;         // entries of the state
  double omega = 6, push_limit = 3;    // rad/s, N
  std::vector<double> late, computed;  // [us]: how late a cycle began, how long it took
  double largest_push = 0, largest_std = 0;
};

// Everything that allocates stands before the loop.
void run(Loop& loop, gp2::OnlinePredictor& online, const Eigen::MatrixXd& states, std::atomic<Eigen::Index>& n_passed) {
  const Eigen::Index nq = online.latest().predictor.view().size();
  Eigen::VectorXd state(states.rows()), ddq(nq), stddev(nq);
  Eigen::MatrixXd jacobian(nq, states.rows());
  Clock::time_point next = Clock::now();
  for (Eigen::Index i = 0; i < states.cols(); ++i) {
    next += std::chrono::milliseconds(1);
    std::this_thread::sleep_until(next);
    const Clock::time_point start = Clock::now();
    state = states.col(i);
    const auto [predictor, workspace] = online.latest();
    const double wanted = -loop.omega * loop.omega * state[loop.x] - 2 * loop.omega * state[loop.dx];
    double u = 0;  // a push that is safe where the fit knows nothing
    if (predictor.mean_and_jacobian(state, ddq, jacobian, workspace) == gp2::Predictor::Status::ok) {
      u = std::clamp(state[loop.push] + (wanted - ddq[0]) / jacobian(0, loop.push), -loop.push_limit, loop.push_limit);
    }
    if (predictor.mean_and_stddev(state, ddq, stddev, workspace) == gp2::Predictor::Status::ok) {
      loop.largest_std = std::max(loop.largest_std, stddev[0]);
    }
    loop.largest_push = std::max(loop.largest_push, std::abs(u));
    loop.computed.push_back(microseconds_since(start));
    loop.late.push_back(std::chrono::duration<double, std::micro>(start - next).count());
    n_passed.store(i + 1, std::memory_order_release);  // the logger may read these columns
  }
}

}  // namespace

int main(int argc, char** argv) try {
  if (argc != 3) throw gp2::InputError("usage: control_loop FIT.json LOG.csv");
  const gp2::FitFile fit = gp2::FitFile::read(argv[1]);
  const gp2::System& system = *fit.model.system;
  const gp2::StateLayout layout = system.layout();
  const gp2::CsvTable log = gp2::CsvTable::read(argv[2]);
  gp2::LogReader reader(log, system);
  const Eigen::MatrixXd states = reader.states(fit.prior().reads());
  // what the fit observed is measured on, with the noise that it found
  gp2::Posterior posterior = fit.posterior();
  const gp2::View measured = posterior.observations().front().view();
  const Eigen::VectorXd noise_stddev = posterior.noise_stddev(0);
  const Eigen::MatrixXd accelerations = reader.measurements(measured.names(system));

  gp2::OnlinePredictor online(std::move(posterior), gp2::View::constrained_acceleration(system));
  Loop loop;
  loop.x = layout.q(0), loop.dx = layout.dq(0), loop.push = layout.u(0);
  loop.late.reserve(static_cast<std::size_t>(states.cols()));
  loop.computed.reserve(loop.late.capacity());
  std::atomic<Eigen::Index> n_passed = 0;
  std::thread controller([&] { run(loop, online, states, n_passed); });

  // the logger: what has passed since it last looked
  std::vector<double> refreshed;
  for (Eigen::Index n_learned = 0; n_learned < states.cols();) {
    const Eigen::Index n_new = n_passed.load(std::memory_order_acquire) - n_learned;
    if (n_new == 0) {
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
      continue;
    }
    const Clock::time_point start = Clock::now();
    online.update({states.middleCols(n_learned, n_new), measured, accelerations.middleCols(n_learned, n_new), noise_stddev, false});
    online.remove_oldest(static_cast<int>(n_new));
    online.publish();
    refreshed.push_back(microseconds_since(start));
    n_learned += n_new;
  }
  controller.join();

  print("the loop was late, by", std::move(loop.late));
  print("it computed", std::move(loop.computed));
  print("the logger learned and handed on", std::move(refreshed));
  std::printf("%lld states are known; |push| <= %.3g N; standard deviation of ddx <= %.3g m/s^2\n",
              static_cast<long long>(online.posterior().n_states()), loop.largest_push, loop.largest_std);
  return 0;
} catch (const std::exception& error) {
  std::fprintf(stderr, "control_loop: %s\n", error.what());
  return 1;
}
