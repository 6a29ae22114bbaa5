#include "gp2/jobs/fit_memory.hpp"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>

#include <fmt/format.h>

#include "base/mapped_memory.hpp"
#include "base/parallel.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/evaluation.hpp"
#include "inference/gram.hpp"
#include "inference/piece_sums.hpp"

namespace gp2 {

using Eigen::Index;

namespace {

constexpr double number = sizeof(double);

// The lower triangle of an r × r matrix. What stands above it is never touched, and takes no memory but where it shares a page
// with what is; the kernel hands out pages of 4 kB, or of 2 MB where it is told to do so always.
double triangle(double r) {
  static const bool huge_pages = [] {
    std::string choices;
    std::getline(std::ifstream("/sys/kernel/mm/transparent_hugepage/enabled"), choices);
    return choices.find("[always]") != std::string::npos;
  }();
  constexpr double page = 4096;
  return huge_pages ? number * r * r : number * r * r / 2 + page / 2 * r;
}

// Σ rank of what the states of one Observations measure, from some of them
double reduced_size(const FitProblem& problem, std::size_t g, ModelValues values) {
  constexpr Index enough = 256;
  const Observations& group = problem.observations[g];
  const Index n = group.n_data(), n_some = std::min(n, enough);
  if (group.has_sums()) return static_cast<double>(n * group.view().size());
  std::vector<int> some;
  for (Index k = 0; k < n_some; ++k) some.push_back(static_cast<int>(k * n / n_some));
  values.noise_stddev = {values.noise_stddev[g]};
  return static_cast<double>(Likelihood(problem.prior, {group.take(some)}, values, {}).reduced_size()) * static_cast<double>(n) /
         static_cast<double>(n_some);
}

// What grows in proportion to the data, per state.
struct PerState {
  double shared = 0, evaluation = 0;  // numbers
  double observed = 0;                // of them in the observations themselves
  double linearised = 0;              // where a nonlinear prior is linear
  double n_parts = 1;                 // that are fitted one after the other, each with its share of the reduced size
};

PerState per_state(const FitProblem& problem, double rank) {
  const System& system = *problem.prior.system;
  const double n = system.nq(), m = system.nc();
  double d = 0;
  for (const Observations& group : problem.observations) d = std::max(d, static_cast<double>(group.view().size()));
  const auto n_parameters = std::count_if(problem.hyperparameters.begin(), problem.hyperparameters.end(),
                                          [](const auto& h) { return h.kind == Hyperparameter::Kind::parameter; });
  // states and values as they stand in the problem, the likelihood and the posterior
  PerState count;
  count.observed = static_cast<double>(system.state_names().size()) + d;
  count.shared = 3 * count.observed;
  if (problem.prior.is_nonlinear()) count.linearised = m;
  // M and its factor, A, L, T and what they are made of; G
  double model = 3 * n * n + 4 * m * n + 4 * n + d * n;
  // Q, R, e, ỹ of a sample, with what the allocator adds
  count.evaluation = d * rank + rank * n + 3 * d + 30;
  constexpr double tasks = 32;  // of the sums over pairs
  for (const Latent& latent : problem.prior.latents) {
    const double p = latent.size(), features = latent.n_features();
    count.shared += features;
    if (problem.prior.is_nonlinear()) count.linearised += p;
    model += n * p;
    count.evaluation += 3 * features + rank * p * 3 + tasks * (rank + 1) * p;
  }
  const std::optional<Baseline>& baseline = problem.prior_options.baseline;
  if (baseline && baseline->kind == Baseline::Kind::se) count.n_parts = n;
  // where parameters are estimated an evaluation has these of its own, and their derivatives
  (n_parameters > 0 ? count.evaluation : count.shared) += model * (1 + static_cast<double>(n_parameters));
  return count;
}

// A fit of so many states and reduced rows, one evaluation at a time.
FitMemory memory_of(double n_states, double r, const PerState& count, const FitOptions& options) {
  constexpr double blas = 1e7;  // OpenBLAS packs blocks of a matrix into memory of its own, one for each thread that calls it
  FitMemory memory;
  memory.reduced_size = static_cast<int>(std::lround(r));
  memory.shared = number * n_states * count.shared;
  const double n_components = std::max(1, options.n_draws);
  if (options.n_inducing > 0) {
    // the observations, those of a stage before all of them, or of a stretch, and what is kept of blocks; sums of each part of the rows
    // and of each stretch, with what is made of them
    constexpr double n_copies = 1.5;
    const double square = number * std::pow(std::min<double>(options.n_inducing, r), 2);
    constexpr double n_linearisations = 3;  // the one that is held, the best so far and the next
    memory.shared = number * n_states * (n_copies * count.observed + n_linearisations * count.linearised);
    memory.evaluation = (Pieces::n_parts + thread_count(options.n_threads) + 6) * square +
                        std::min<double>(BlocksOfStates::most_kept_bytes, number * n_states * count.evaluation) + blas;
    memory.posterior =
        (Pieces::n_parts + thread_count(options.n_threads) + 6 + n_components * 2 * CrossValidation::n_stretches) * square + blas;
    memory.asked_by_evaluation = memory.asked_by_posterior = square + blas_buffer;
    return memory;
  }
  memory.evaluation = triangle(r / count.n_parts) + number * n_states * count.evaluation + blas;
  // at the end a factor, its inverse in place, and what of it belongs to each stretch of cross_validate, stand beside the posterior
  const double left_out = triangle(r) + number * r * r / CrossValidation::n_stretches;
  memory.posterior = n_components * (triangle(r) + number * n_states * count.evaluation) + left_out + blas;
  memory.asked_by_evaluation = number * (r / count.n_parts) * (r / count.n_parts) + blas_buffer;
  memory.asked_by_posterior = n_components * number * r * r + blas_buffer;
  return memory;
}

double n_states(const FitProblem& problem, double most_per_log = HUGE_VAL) {
  double sum = 0;
  for (const Observations& group : problem.observations) sum += std::min<double>(group.n_data(), most_per_log);
  return sum;
}

struct Sizes {
  double rank = 0;  // mean of the states
  PerState count;
};

Sizes sizes_of(const FitProblem& problem) {
  const ModelValues values = model_values(problem.prior, problem.observations, problem.hyperparameters);
  double r = 0;
  for (std::size_t g = 0; g < problem.observations.size(); ++g) r += reduced_size(problem, g, values);
  const double rank = r / n_states(problem);
  return {rank, per_state(problem, rank)};
}

// evaluations at a time that a fit asks for; a scan for lower optima has more tasks than there are threads
int side_by_side(const FitProblem& problem, const FitOptions& options) {
  if (options.max_iterations == 0 || problem.hyperparameters.empty() || options.n_inducing > 0) return 1;
  const int n_threads = thread_count(options.n_threads);
  const int n = options.max_side_by_side > 0 ? std::min(options.max_side_by_side, n_threads) : n_threads;
  return options.max_escapes > 0 ? n : std::min(n, std::max(1, options.n_restarts));
}

double gigabytes(double bytes) { return bytes / 1e9; }

// the number behind a key, or the only one where the key is empty; nothing where there is none, as for "max"
std::optional<double> number_of(const std::filesystem::path& path, const std::string& key) {
  std::ifstream words(path);
  std::string word;
  double value = 0;
  while (!key.empty() && words >> word && word != key) continue;
  return words >> value ? std::optional(value) : std::nullopt;
}

// What a control group may take and what it has taken, without files in memory that nobody is using.
struct GroupFiles {
  const char* controller;  // as in /proc/self/cgroup
  const char* mount;
  const char *limit, *taken, *unused_files;
};
constexpr GroupFiles versions[] = {
    {"", "sys/fs/cgroup", "memory.max", "memory.current", "inactive_file"},
    {"memory", "sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"}};

// The most rows of each log with which `fits`, by halving.
int most_affordable_rows(const FitProblem& problem, const FitOptions& options,
                         const std::function<bool(const FitMemory&)>& fits) {
  const Sizes sizes = sizes_of(problem);
  int most = 0, too_many = 0;
  for (const Observations& group : problem.observations) too_many = std::max(too_many, group.n_data());
  while (too_many - most > 1) {
    const int middle = most + (too_many - most) / 2;
    const double n = n_states(problem, middle);
    (fits(memory_of(n, sizes.rank * n, sizes.count, options)) ? most : too_many) = middle;
  }
  return most;
}

// The options with as many evaluations side by side as the system gives memory for.
FitOptions within_given(const FitProblem& problem, const FitOptions& options, std::vector<std::string>& notes,
                        const std::function<bool(double, int)>& given) {
  const FitMemory memory = fit_memory(problem, options);
  const auto is_possible = [&](const FitMemory& one, int n) {
    return given(one.asked_by_evaluation, n) && given(one.asked_by_posterior, 1);
  };
  int n = memory.side_by_side;
  while (n > 0 && !is_possible(memory, n)) --n;
  if (n == memory.side_by_side) return options;
  if (n > 0) {
    FitOptions fewer = options;
    fewer.max_side_by_side = n;
    notes.push_back(
        fmt::format("the system does not give the memory that {} runs side by side ask for (ulimit -v?): {} at a time",
                    memory.side_by_side, n));
    return fewer;
  }
  const int most = most_affordable_rows(problem, options, [&](const FitMemory& fewer) { return is_possible(fewer, 1); });
  const double asked = std::max(memory.asked_by_evaluation, memory.asked_by_posterior);
  if (most == 0) {
    throw InputError(
        fmt::format("the fit asks for {:.1f} GB of memory, which the system does not give however few rows there are: "
                    "raise the limit (ulimit -v)",
                    gigabytes(asked)));
  }
  throw InputError(fmt::format(
      "the fit of {:.0f} rows asks for {:.1f} GB of memory in one piece, which the system does not give; {} rows of each "
      "log would fit: take so many with `max_points={}`, choose them with gp2 resample, or raise the limit (ulimit -v)",
      n_states(problem), gigabytes(asked), most, most));
}

}  // namespace

double FitMemory::bytes() const { return shared + std::max(side_by_side * evaluation, posterior); }

FitMemory fit_memory(const FitProblem& problem, const FitOptions& options) {
  const Sizes sizes = sizes_of(problem);
  const double n = n_states(problem);
  FitMemory memory = memory_of(n, sizes.rank * n, sizes.count, options);
  memory.side_by_side = side_by_side(problem, options);
  return memory;
}

std::optional<double> free_memory(const std::filesystem::path& root) {
  std::optional<double> free = number_of(root / "proc/meminfo", "MemAvailable:");
  if (!free) return std::nullopt;
  *free *= 1024;
  // a line per hierarchy, ID:CONTROLLERS:/PATH; the group and all above it have limits
  std::ifstream groups(root / "proc/self/cgroup");
  for (std::string line; std::getline(groups, line);) {
    const std::size_t first = line.find(':'), second = line.find(':', first + 1);
    if (second == std::string::npos) continue;
    const std::string controllers = line.substr(first + 1, second - first - 1);
    for (const GroupFiles& files : versions) {
      if (controllers != files.controller) continue;
      std::filesystem::path path = std::filesystem::path(line.substr(second + 1)).relative_path();
      while (true) {
        const std::filesystem::path group = root / files.mount / path;
        const std::optional<double> limit = number_of(group / files.limit, ""), taken = number_of(group / files.taken, "");
        if (limit && taken) {
          const double unused = number_of(group / "memory.stat", files.unused_files).value_or(0);
          free = std::clamp(*limit - *taken + unused, 0.0, *free);
        }
        if (path.empty()) break;
        path = path.parent_path();
      }
    }
  }
  return free;
}

bool is_given(double bytes, int n_pieces) { return maps(bytes, n_pieces); }

FitOptions within_memory(const FitProblem& problem, const FitOptions& all_options, std::optional<double> free,
                         std::vector<std::string>& notes, const std::function<bool(double, int)>& given) {
  const FitOptions options = within_given(problem, all_options, notes, given);
  if (!free) return options;
  // the estimate is good to a tenth or so; a small fit is never refused, for what is free is not known that well
  constexpr double share = 0.9, small = 1e8;
  const double usable = std::max(share * *free, small);
  const FitMemory memory = fit_memory(problem, options);
  if (memory.bytes() <= usable) return options;

  FitOptions fewer = options;
  fewer.max_side_by_side =
      static_cast<int>(std::clamp((usable - memory.shared) / memory.evaluation, 0.0, memory.side_by_side - 1.0));
  if (fewer.max_side_by_side >= 1 && memory.shared + memory.posterior <= usable) {
    notes.push_back(fmt::format("{:.1f} GB of memory are free, and {} runs side by side would take {:.1f} GB: {} at a time",
                                gigabytes(*free), memory.side_by_side, gigabytes(memory.bytes()), fewer.max_side_by_side));
    return fewer;
  }

  const int most =
      most_affordable_rows(problem, options, [&](const FitMemory& fewer_rows) { return fewer_rows.bytes() <= usable; });
  const double alone = memory.shared + std::max(memory.evaluation, memory.posterior);
  throw InputError(fmt::format(
      "the fit of {:.0f} rows factors a matrix of size {} and takes {:.1f} GB of memory, of which {:.1f} GB are free; {} rows "
      "of each log would fit: take so many with `max_points={}`, or choose them with gp2 resample",
      n_states(problem), memory.reduced_size, gigabytes(alone), gigabytes(*free), most, most));
}

}  // namespace gp2
