// Random motions read by random encoders, one fault put into each log: how derive bears them.
#include <algorithm>
#include <cstdlib>
#include <functional>
#include <map>
#include <numbers>

#include <fmt/format.h>
#include <gtest/gtest.h>

#include "base/random.hpp"
#include "gp2/base/statistics.hpp"
#include "gp2/jobs/derive.hpp"

namespace gp2::test {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double duration = 6;  // s
constexpr double pi = std::numbers::pi;

// q at times `step` apart and their accelerations, of q¨ = f(q, q˙, t)
struct Motion {
  MatrixXd positions, accelerations;  // coordinates × samples
};

using Dynamics = std::function<VectorXd(double t, const VectorXd& q, const VectorXd& dq)>;

Motion motion_of(const Dynamics& f, VectorXd q, VectorXd dq, double step, Index n) {
  const int substeps = std::max(1, static_cast<int>(std::ceil(step / 0.5e-3)));
  const double h = step / substeps;
  Motion out{MatrixXd(q.size(), n), MatrixXd(q.size(), n)};
  double t = 0;
  for (Index k = 0; k < n; ++k) {
    out.positions.col(k) = q;
    out.accelerations.col(k) = f(t, q, dq);
    for (int s = 0; s < substeps; ++s, t += h) {
      const VectorXd a1 = f(t, q, dq), v2 = dq + h / 2 * a1, a2 = f(t + h / 2, q + h / 2 * dq, v2), v3 = dq + h / 2 * a2,
                     a3 = f(t + h / 2, q + h / 2 * v2, v3), v4 = dq + h * a3, a4 = f(t + h, q + h * v3, v4);
      q += h / 6 * (dq + 2 * v2 + 2 * v3 + v4);
      dq += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4);
    }
  }
  return out;
}

// a drive of three sines
std::function<double(double)> drive(RandomStream& random, double size) {
  std::array<double, 9> r{};
  for (double& x : r) x = random.uniform();
  return [r, size](double t) {
    double sum = 0;
    for (std::size_t k = 0; k < 3; ++k)
      sum += size * (r[k] - 0.3) * std::sin(2 * pi * (0.2 + 1.3 * r[3 + k]) * t + 2 * pi * r[6 + k]);
    return sum;
  };
}

Motion random_motion(const std::string& machine, RandomStream& random, double step, Index n) {
  const auto even = [&](double low, double high) { return low + (high - low) * random.uniform(); };
  const int nq = machine == "double pendulum" ? 2 : 1;
  VectorXd q(nq), dq(nq);
  for (int j = 0; j < nq; ++j) {
    q[j] = even(-2, 2);
    dq[j] = even(-3, 3);
  }
  if (machine == "crank") {
    // a crank of 0.1 m, a rod of 0.3 m and a slider
    const auto torque = drive(random, 2);
    const double constant = even(0.2, 1);
    return motion_of(
        [=](double t, const VectorXd& x, const VectorXd& v) {
          const double s = std::sin(x[0]), c = std::cos(x[0]), root = std::sqrt(0.09 - 0.01 * s * s);
          const double slope = -0.1 * s - 0.01 * s * c / root;
          const double curvature = -0.1 * c - 0.01 * (c * c - s * s) / root - 1e-4 * s * s * c * c / (root * root * root);
          const double friction = 1.5 * std::tanh(20 * slope * v[0]);
          return VectorXd{{(constant + torque(t) - 0.05 * v[0] - slope * (0.95 * curvature * v[0] * v[0] + friction)) /
                           (0.01 + 0.95 * slope * slope)}};
        },
        q, dq, step, n);
  }
  if (machine == "pendulum") {
    return motion_of(
        [](double, const VectorXd& x, const VectorXd& v) {
          return VectorXd{{-9.81 * std::sin(x[0]) - 0.15 * v[0] - 0.3 * std::tanh(v[0] / 0.1)}};
        },
        q, dq, step, n);
  }
  if (machine == "double pendulum") {
    return motion_of(
        [](double, const VectorXd& x, const VectorXd& v) {
          const double c = std::cos(x[0] - x[1]), s = std::sin(x[0] - x[1]);
          const double g1 = -s * v[1] * v[1] - 2 * 9.81 / 0.5 * std::sin(x[0]) - 0.1 * v[0],
                       g2 = s * v[0] * v[0] - 9.81 / 0.5 * std::sin(x[1]) - 0.1 * (v[1] - v[0]);
          const double determinant = 2 - c * c;
          return VectorXd{{(g1 - c * g2) / determinant, (2 * g2 - c * g1) / determinant}};
        },
        q, dq, step, n);
  }
  const auto force = drive(random, 8);
  return motion_of([force](double t, const VectorXd&,
                           const VectorXd& v) { return VectorXd{{force(t) - 0.5 * v[0] - 1.5 * std::tanh(v[0] / 0.05)}}; },
                   0.2 * q, 0.2 * dq, step, n);
}

Model machine_model(const std::string& machine) {
  const bool angle = machine != "cart";
  const std::string row = angle ? R"({ name = "NAME", angle = true })" : R"("NAME")";
  const auto coordinate = [&](const std::string& name) {
    std::string text = row;
    return text.replace(text.find("NAME"), 4, name);
  };
  const bool two = machine == "double pendulum";
  return Model::parse(fmt::format(R"(
name = "{}"
coordinates = [{}]
[mechanics]
mass = {}
force = {}
[[latent]]
name = "rest"
features = ["dq1"]
directions = "force"
)",
                                  machine, two ? coordinate("q1") + ", " + coordinate("q2") : coordinate("q1"),
                                  two ? R"([["1", "0"], ["0", "1"]])" : R"([["1"]])", two ? R"(["0", "0"])" : R"(["0"])"),
                      "machine.toml");
}

const std::vector<std::string> faults = {"none",          "wrong end",    "half a turn", "five rows near 0",
                                         "a day's pause", "unit of time", "lost rows",   "outliers"};

/// A log, what moved, and which rows of the log belong to which sample.
struct RawLog {
  CsvTable table;
  Motion truth;
  double step = 0, resolution = 0;
  std::vector<Index> sample;     // of each row of the log; −1: none
  std::vector<bool> is_wrong;    // of each row
  std::vector<double> recorded;  // time of each row, in seconds
  std::string machine, what;
};

RawLog raw_log(int seed, const std::string& fault) {
  static const std::vector<std::string> machines = {"crank", "pendulum", "double pendulum", "cart"};
  static const std::vector<double> rates = {50, 100, 200, 500, 1000};
  RandomStream random(static_cast<std::uint64_t>(seed), 17);
  const auto one_of = [&](int n) { return static_cast<int>(random.uniform() * n); };
  const std::string machine = machines[static_cast<std::size_t>(one_of(4))];
  const double rate = rates[static_cast<std::size_t>(one_of(5))];
  const double counts = std::pow(2, 9 + one_of(6));
  const double resolution = machine == "cart" ? 0.2 / counts : 2 * pi / counts;
  const auto n = static_cast<Index>(duration * rate);
  RawLog out;
  out.machine = machine;
  out.step = 1 / rate;
  out.resolution = resolution;
  out.what = fmt::format("seed {}, {}, {:g} Hz, {:g} counts, {}", seed, machine, rate, counts, fault);
  out.truth = random_motion(machine, random, out.step, n);
  const bool wraps = machine == "crank";
  const Index nq = out.truth.positions.rows();
  const Index pause = n / 3 + one_of(static_cast<int>(n / 3));
  if (fault == "a day's pause") {
    // what comes after it starts anew
    const Motion second = random_motion(machine, random, out.step, n - pause);
    out.truth.positions.rightCols(n - pause) = second.positions;
    out.truth.accelerations.rightCols(n - pause) = second.accelerations;
  }
  std::vector<std::vector<double>> cells;
  std::vector<double> times;
  for (Index k = 0; k < n; ++k) {
    double t = static_cast<double>(k) * out.step;
    if (fault == "lost rows" && random.uniform() < 0.05 && k > 0 && k + 1 < n) continue;
    if (fault == "a day's pause" && k >= pause) t += 86400;
    if (fault == "five rows near 0" && k >= 5) t += 1.7e9;  // beside which a clock's digits end at 2e-7 s
    std::vector<double> row;
    for (Index j = 0; j < nq; ++j) {
      double value = resolution * std::round(out.truth.positions(j, k) / resolution);
      if (wraps) value = std::remainder(value, 2 * pi);
      row.push_back(value);
    }
    bool wrong = false;
    if (fault == "outliers" && random.uniform() < 0.01) {
      row[0] += (random.uniform() - 0.5);
      wrong = true;
    }
    times.push_back(t);
    cells.push_back(row);
    out.sample.push_back(k);
    out.is_wrong.push_back(wrong);
  }
  const std::size_t last = cells.size() - 1;
  if (fault == "wrong end") {
    const std::size_t at = random.uniform() < 0.5 ? 0 : last;
    cells[at][0] = random.uniform() < 0.5 ? 0.0 : cells[at][0] + 2 * (random.uniform() - 0.5);
    out.is_wrong[at] = true;
  }
  if (fault == "half a turn") {
    const auto at = 1 + static_cast<std::size_t>(one_of(static_cast<int>(last) - 1));
    cells[at][0] += cells[at][0] > 0 ? -pi : pi;
    out.is_wrong[at] = true;
  }
  if (fault == "five rows near 0") {
    for (std::size_t k = 0; k < 5; ++k) out.is_wrong[k] = true;
  }
  const double unit = fault == "unit of time" ? std::pow(1000, 1 + one_of(3)) : 1;
  std::vector<CsvTable::Column> columns = {{"t", {}}};
  for (Index j = 0; j < nq; ++j) columns.push_back({fmt::format("q{}", j + 1), {}});
  for (std::size_t k = 0; k < cells.size(); ++k) {
    columns[0].numbers.push_back(times[k] * unit);
    for (std::size_t j = 0; j < cells[k].size(); ++j) columns[j + 1].numbers.push_back(cells[k][j]);
  }
  out.recorded = times;
  out.table = CsvTable::from_columns("raw.csv", std::move(columns));
  return out;
}

struct Outcome {
  double error = 0, hindsight = 0;  // rms of q¨ [/s²]
  double coverage = 0;              // of 95 % intervals of q¨
  bool warned = false;
  std::string failure;
};

// The least error that some lengthscale and size of the motion give, from the samples that nothing is wrong with.
double error_in_hindsight(const RawLog& log, Index j) {
  std::vector<Measurement> measurements;
  std::vector<double> times;
  std::vector<Index> samples;
  const double mean = log.truth.positions.row(j).mean();
  double before = std::nan("");
  for (std::size_t k = 0; k < log.sample.size(); ++k) {
    if (log.is_wrong[k]) continue;
    const Index sample = log.sample[k];
    const double time = log.table.number(static_cast<int>(k), 0);
    if (time == before) continue;
    before = time;
    const double truth = log.truth.positions(j, sample);
    times.push_back(log.recorded[k]);
    measurements.push_back({times.back(), log.resolution * std::round(truth / log.resolution) - mean, false, 1});
    samples.push_back(sample);
  }
  const VectorXd at = Eigen::Map<const VectorXd>(times.data(), static_cast<Index>(times.size()));
  const double size = std::sqrt((log.truth.positions.row(j).array() - mean).square().mean());
  double least = std::numeric_limits<double>::infinity();
  for (const double lengthscale : {0.1, 0.4, 1.6}) {
    for (double ratio = 1e-2; ratio < 1e7; ratio *= 4) {
      SmootherModel model;
      model.lengthscale = lengthscale;
      model.signal_stddev = size;
      model.noise_stddev = size / ratio;
      const SmoothedMotion motion = smooth(model, measurements, at);
      double sum = 0;
      for (std::size_t k = 0; k < samples.size(); ++k)
        sum += std::pow(motion.mean(2, static_cast<Index>(k)) - log.truth.accelerations(j, samples[k]), 2);
      least = std::min(least, std::sqrt(sum / static_cast<double>(samples.size())));
    }
  }
  return least;
}

Outcome outcome_of(const RawLog& log) {
  Outcome out;
  const Model model = machine_model(log.machine);
  DerivedData data;
  try {
    data = derive(model, log.table, {.n_threads = 1});
  } catch (const std::exception& error) {
    out.failure = error.what();
    return out;
  }
  for (const std::string& note : data.notes) out.warned = out.warned || note.starts_with("warning");
  const Index nq = log.truth.positions.rows();
  const StateLayout layout = model.system->layout();
  // rows of the log that were written, in its order
  double inside = 0, n = 0, error = 0, hindsight = 0;
  for (Index j = 0; j < nq; ++j) {
    double sum = 0, m = 0;
    for (Index i = 0; i < data.states.cols(); ++i) {
      // the row of the log that is as far from the end
      const std::size_t row = log.sample.size() - static_cast<std::size_t>(data.states.cols()) + static_cast<std::size_t>(i);
      if (log.is_wrong[row]) continue;
      const double off = data.accelerations(static_cast<int>(j), i) - log.truth.accelerations(j, log.sample[row]);
      sum += off * off;
      inside += std::abs(off) <= 1.959964 * data.stddev(2 * layout.nq + static_cast<int>(j), i) ? 1 : 0;
      ++m;
    }
    n += m;
    // the worst coordinate counts
    const double here = std::sqrt(sum / m), best = error_in_hindsight(log, j);
    if (!(hindsight > 0) || !(here / best <= error / hindsight)) {
      error = here;
      hindsight = best;
    }
  }
  out.error = error;
  out.hindsight = hindsight;
  out.coverage = inside / n;
  return out;
}

// GP2_RAW_LOGS=500 for the table of docs/raw-logs.md; GP2_RAW_LOGS_SEED for other logs.
TEST(RawLogSweep, NoFaultBreaksDerive) {
  const auto number = [](const char* name, int otherwise) {
    const char* const text = std::getenv(name);
    return text ? std::stoi(text) : otherwise;
  };
  const int n = number("GP2_RAW_LOGS", 48), seed = number("GP2_RAW_LOGS_SEED", 1000);
  std::map<std::string, std::vector<Outcome>> outcomes;
  int broken = 0, in_silence = 0;
  for (int k = 0; k < n; ++k) {
    const std::string& fault = faults[static_cast<std::size_t>(k) % faults.size()];
    const RawLog log = raw_log(seed + k, fault);
    const Outcome one = outcome_of(log);
    outcomes[fault].push_back(one);
    if (one.failure.empty() && one.error <= 3 * one.hindsight) continue;
    ++broken;
    if (!one.warned && one.failure.empty()) ++in_silence;
    fmt::print("{}: error {:.3g}, in hindsight {:.3g}{} {}\n", log.what, one.error, one.hindsight, one.warned ? ", warned" : "",
               one.failure);
  }
  fmt::print(
      "| fault | logs | error beside the best in hindsight: median, worst | within 95 % | warned |\n|---|---|---|---|---|\n");
  double coverage_of_all = 0;
  for (const auto& [fault, all] : outcomes) {
    std::vector<double> ratios;
    double coverage = 0;
    int warned = 0;
    for (const Outcome& one : all) {
      ratios.push_back(one.failure.empty() ? one.error / one.hindsight : std::numeric_limits<double>::infinity());
      coverage += one.coverage / static_cast<double>(all.size());
      warned += one.warned ? 1 : 0;
    }
    coverage_of_all += coverage / static_cast<double>(faults.size());
    fmt::print("| {} | {} | {:.2f}, {:.2f} | {:.3f} | {} |\n", fault, all.size(), median(ratios),
               *std::max_element(ratios.begin(), ratios.end()), coverage, warned);
  }
  // what is left are bursts that a few samples describe
  EXPECT_LE(broken, 1 + n / 60);
  EXPECT_EQ(in_silence, 0);
  EXPECT_GE(coverage_of_all, 0.92);
  EXPECT_LE(coverage_of_all, 0.99);
}

}  // namespace
}  // namespace gp2::test
