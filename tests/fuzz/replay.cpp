// Feeds files to a fuzz target, where there is no fuzzer: every file named, and every file of every folder named.

#include <cstdio>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <string>
#include <vector>

#include <fmt/format.h>

#include "fuzz/fuzz.hpp"

namespace {

constexpr double max_seconds = 5;  // of the processor; generous, for sanitizers

std::vector<std::filesystem::path> files_of(const std::filesystem::path& path) {
  if (!std::filesystem::is_directory(path)) return {path};
  std::vector<std::filesystem::path> files;
  for (const auto& entry : std::filesystem::directory_iterator(path)) files.push_back(entry.path());
  return files;
}

}  // namespace

int main(int n_arguments, char** arguments) {
  int n_files = 0, n_slow = 0;
  for (int k = 1; k < n_arguments; ++k) {
    for (const std::filesystem::path& path : files_of(arguments[k])) {
      std::ifstream file(path, std::ios::binary);
      const std::string content{std::istreambuf_iterator<char>(file), {}};
      fmt::print("{}\n", path.string());
      static_cast<void>(std::fflush(stdout));  // the last name is that of the culprit
      const std::clock_t start = std::clock();
      LLVMFuzzerTestOneInput(reinterpret_cast<const std::uint8_t*>(content.data()), content.size());
      const double seconds = static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
      ++n_files;
      if (seconds > max_seconds) {
        ++n_slow;
        fmt::print("took {:.1f} s, more than {} s\n", seconds, max_seconds);
      }
    }
  }
  fmt::print("{} inputs read or refused, {} of them too slowly\n", n_files, n_slow);
  return n_files > 0 && n_slow == 0 ? 0 : 1;
}
