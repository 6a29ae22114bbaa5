#pragma once

#include <atomic>
#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/model.hpp"

namespace gp2 GP2_API {

/// Greedy k-centre (Gonzalez 1985): point after point, the next the one farthest from all chosen before it; of equal ones the
/// first. The n chosen leave no point farther from them than twice what the best n could. O(n N D).
struct FarthestPoints {
  std::vector<int> chosen;   // columns, in the order of choice: the first k are the choice of k
  Eigen::VectorXd distance;  // of each from the nearest chosen before it, falling; of the first 0
  double radius = 0;         // of the farthest point that is left, from the nearest chosen
};

/// @param points  (D × N)
/// @param n       1 … N
/// @param first   the column to start with
/// @param stop    set: ends before long, by throwing
/// @throws NumericalError when stopped.
FarthestPoints farthest_points(const Eigen::Ref<const Eigen::MatrixXd>& points, int n, int first,
                               const std::atomic<bool>* stop = nullptr);

struct ResampleOptions {
  int n = 0;
  std::vector<std::string> features = {};           // expressions; empty: those of the model's latents
  std::optional<std::uint64_t> seed = {};           // of a random first row; not given: the row nearest to the mean
  std::map<std::string, std::string> columns = {};  // model's name -> log's name, before the model's own [columns]
};

std::vector<Option> options(ResampleOptions& options);

/// Which rows of a log to learn from.
struct Resample {
  std::vector<int> rows;              // of the log, in the order of choice
  Eigen::VectorXd distance;           // as FarthestPoints
  double radius = 0;                  // as FarthestPoints
  std::vector<std::string> features;  // measured by; angles as sine and cosine
  int n_skipped = 0;                  // rows without a number in some feature
};

/// n rows of a log that cover it best: farthest points in the space of the model's features, each divided by its standard
/// deviation over the log. A feature that does not vary counts for nothing.
///
/// @param stop  as of farthest_points
/// @throws InputError when n is not positive or exceeds the rows that have every feature, for an unknown symbol, a missing
///   column, or cells that are neither numbers nor empty.
/// @throws NumericalError when stopped.
Resample resample(const Model& model, const CsvTable& log, const ResampleOptions& options,
                  const std::atomic<bool>* stop = nullptr);

/// How well the chosen rows cover a log.
/// @param name  stands for these rows
std::vector<std::string> resample_notes(const Resample& chosen, const CsvTable& log, const std::string& name);

}  // namespace gp2
