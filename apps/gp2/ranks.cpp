#include "ranks.hpp"

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <cstring>
#include <thread>

#include <fmt/format.h>
#include <unistd.h>

#include "gp2/base/blas.hpp"
#include "gp2/base/version.hpp"
#include "gp2/error.hpp"
#include "streams.hpp"

#ifdef GP2_HAS_MPI
#include <fcntl.h>
#include <mpi.h>
#endif

namespace gp2::command {

namespace {

int number_in_environment(const char* name) {
  const char* const text = std::getenv(name);
  return text == nullptr ? 0 : std::atoi(text);
}

// The numbers of the first rank are those of all, to the bit.
bool are_alike(const Ranks& ranks, const std::vector<double>& numbers) {
  std::vector<double> first = numbers;
  ranks.broadcast(first, 0);
  bool is_alike = std::memcmp(first.data(), numbers.data(), numbers.size() * sizeof(double)) == 0;
  for (int rank = 0; rank < ranks.size(); ++rank) {
    double answer = is_alike ? 1 : 0;
    ranks.broadcast({&answer, 1}, rank);
    is_alike = is_alike && answer == 1;
  }
  return is_alike;
}

}  // namespace

int n_started_together() {
  const int n = std::max(number_in_environment("OMPI_COMM_WORLD_SIZE"), number_in_environment("PMI_SIZE"));
  return std::getenv("PMIX_RANK") == nullptr ? n : std::max(n, number_in_environment("SLURM_NTASKS"));
}

void require_same_data(const Ranks& ranks, const std::vector<Observations>& observations) {
  std::vector<double> numbers;
  for (const Observations& group : observations) {
    const Eigen::MatrixXd &states = group.states(), &values = group.values();
    numbers.insert(numbers.end(), {static_cast<double>(group.n_data()), states.array().isNaN().select(0, states).sum(),
                                   values.array().isNaN().select(0, values).sum()});
  }
  numbers.resize(1024);
  if (!are_alike(ranks, numbers))
    throw InputError("the processes of mpirun have read different data: give all of them the same files");
}

#ifdef GP2_HAS_MPI

namespace {

int own_stderr = -1;  // of a process that was silenced

std::vector<double> as_numbers(std::string text) {
  text.resize(256);
  return {text.begin(), text.end()};
}

class MpiRanks final : public Ranks {
 public:
  MpiRanks() {
    MPI_Comm_rank(MPI_COMM_WORLD, &rank_);
    MPI_Comm_size(MPI_COMM_WORLD, &size_);
  }
  [[nodiscard]] int rank() const override { return rank_; }
  [[nodiscard]] int size() const override { return size_; }
  void broadcast(std::span<double> numbers, int from) const override {
    constexpr std::size_t most = 1U << 30U;  // a count is an int
    for (std::size_t first = 0; first < numbers.size(); first += most) {
      const std::size_t n = std::min(most, numbers.size() - first);
      MPI_Bcast(numbers.data() + first, static_cast<int>(n), MPI_DOUBLE, from, MPI_COMM_WORLD);
    }
  }
  void exchange(const std::vector<std::vector<double>>& to, std::vector<std::vector<double>>& from) const override {
    Messages sent(to), received(from);
    for (std::size_t rank = 0; rank < to.size(); ++rank) {
      std::copy(to[rank].begin(), to[rank].end(), sent.numbers.begin() + sent.first[rank]);
    }
    MPI_Alltoallv(sent.numbers.data(), sent.count.data(), sent.first.data(), MPI_DOUBLE, received.numbers.data(),
                  received.count.data(), received.first.data(), MPI_DOUBLE, MPI_COMM_WORLD);
    for (std::size_t rank = 0; rank < from.size(); ++rank) {
      std::copy_n(received.numbers.begin() + received.first[rank], from[rank].size(), from[rank].begin());
    }
  }

 private:
  // one after the other, as MPI wants them
  struct Messages {
    std::vector<int> count, first;
    std::vector<double> numbers;

    explicit Messages(const std::vector<std::vector<double>>& all) {
      int n = 0;
      for (const std::vector<double>& one : all) {
        count.push_back(static_cast<int>(one.size()));
        first.push_back(std::exchange(n, n + count.back()));
      }
      numbers.resize(static_cast<std::size_t>(n));
    }
  };

  int rank_ = 0, size_ = 1;
};

bool is_joined() {
  int is_initialised = 0;
  MPI_Initialized(&is_initialised);
  return is_initialised != 0;
}

void be_silent() {
  own_stderr = dup(STDERR_FILENO);
  const int nowhere = open("/dev/null", O_WRONLY);
  for (const int stream : {STDOUT_FILENO, STDERR_FILENO}) dup2(nowhere, stream);
  close(nowhere);
}

}  // namespace

std::shared_ptr<const Ranks> join_ranks() {
  if (n_started_together() <= 1) return nullptr;
  MPI_Init(nullptr, nullptr);
  auto ranks = std::make_shared<const MpiRanks>();
  if (ranks->rank() > 0) be_silent();
  if (!are_alike(*ranks, as_numbers(version()))) throw InputError("the processes of mpirun are of different versions of gp2");
  if (!are_alike(*ranks, as_numbers(fmt::format("{} {}", blas_report().kernel, instruction_set())))) {
    throw InputError(
        "the processes of mpirun compute with different kernels of OpenBLAS, and would differ in the last digits: set "
        "OPENBLAS_CORETYPE to one that all machines have");
  }
  return ranks;
}

void leave_ranks() {
  if (is_joined()) MPI_Finalize();
}

void abort_ranks(int exit_code, std::string_view why) {
  if (!is_joined()) return;
  if (own_stderr >= 0) {
    // an error of all is told by the first, which ends the others
    std::this_thread::sleep_for(std::chrono::seconds(2));
    dup2(own_stderr, STDERR_FILENO);
    int rank = 0;
    MPI_Comm_rank(MPI_COMM_WORLD, &rank);
    print_message("gp2: process {} of mpirun: {}\n", rank, why);
  }
  MPI_Abort(MPI_COMM_WORLD, exit_code);
}

#else

std::shared_ptr<const Ranks> join_ranks() {
  if (n_started_together() <= 1) return nullptr;
  throw InputError("mpirun has started several of gp2, which was built without MPI (Debian: libopenmpi-dev): start it alone");
}

void leave_ranks() {}
void abort_ranks(int, std::string_view) {}

#endif

}  // namespace gp2::command
