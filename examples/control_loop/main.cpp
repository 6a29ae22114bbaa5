// A controller around a fit of docs/guide.md:  control_loop FIT.json LOG.csv
//
// It pulls the bead to x = 0 like a damped spring: at each state the push that gives x the acceleration asked for, by one Newton
// step on what the fit predicts. The states of a log stand in for the machine.

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/predictor.hpp"

int main(int argc, char** argv) try {
  if (argc != 3) throw gp2::InputError("usage: control_loop FIT.json LOG.csv");
  const gp2::FitFile fit = gp2::FitFile::read(argv[1]);
  const gp2::System& system = *fit.model.system;
  const gp2::StateLayout layout = system.layout();
  const gp2::CsvTable log = gp2::CsvTable::read(argv[2]);
  const Eigen::MatrixXd states = gp2::LogReader(log, system).states(fit.prior().reads());

  // before the loop: everything that allocates
  gp2::Predictor::Options options;
  options.stddev = false;
  const gp2::Predictor predictor(fit.posterior(), gp2::View::all(gp2::View::Quantity::constrained_acceleration, system), options);
  gp2::Predictor::Workspace workspace = predictor.make_workspace();  // one per thread
  Eigen::VectorXd state(layout.size()), ddq(system.nq());
  Eigen::MatrixXd jacobian(system.nq(), layout.size());
  std::vector<double> microseconds;
  microseconds.reserve(static_cast<std::size_t>(states.cols()));

  const int x = layout.q(0), dx = layout.dq(0), push = layout.u(0);
  const double omega = 6, push_limit = 3;  // rad/s, N
  double largest_push = 0;
  for (Eigen::Index i = 0; i < states.cols(); ++i) {
    const auto start = std::chrono::steady_clock::now();
    state = states.col(i);
    const double wanted = -omega * omega * state[x] - 2 * omega * state[dx];
    double u = 0;  // a push that is safe where the fit knows nothing
    if (predictor.mean_and_jacobian(state, ddq, jacobian, workspace) == gp2::Predictor::Status::ok) {
      u = std::clamp(state[push] + (wanted - ddq[0]) / jacobian(0, push), -push_limit, push_limit);
    }
    microseconds.push_back(std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - start).count());
    largest_push = std::max(largest_push, std::abs(u));
  }

  std::sort(microseconds.begin(), microseconds.end());
  std::printf("%zu cycles, median %.2f us, 99 %% below %.2f us; |push| <= %.3g N\n", microseconds.size(),
              microseconds[microseconds.size() / 2], microseconds[microseconds.size() * 99 / 100], largest_push);
  return 0;
} catch (const gp2::InputError& error) {
  std::fprintf(stderr, "control_loop: %s\n", error.what());
  return 1;
}
