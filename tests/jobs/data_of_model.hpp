#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/model.hpp"

namespace gp2::test {

/// A log of a model as matrices, to put faults into.
struct LogData {
  const Model* model = nullptr;
  Eigen::MatrixXd states, accelerations;  // NaN: not in the log

  [[nodiscard]] CsvTable table() const;
};

/// The noise of ddq that a model's [noise] states, of each coordinate; 0.05 without.
Eigen::VectorXd noise_of(const Model& model);

/// n states drawn from the model's [sampling], or met in its [motion], with that noise.
LogData drawn_log(const Model& model, int n, std::uint64_t seed);
LogData drawn_log(const std::string& file, int n, std::uint64_t seed);

/// A motion of the model that starts at a drawn state, with that noise; t is in the log.
LogData moving_log(const std::string& file, int n, double time_step, std::uint64_t seed);

/// A fit of the logs under the known force as mean, from one start.
FitRequest fit_request(Model model, std::vector<CsvTable> logs);

}  // namespace gp2::test
