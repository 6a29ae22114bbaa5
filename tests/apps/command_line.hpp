#pragma once

#include <cstdlib>
#include <filesystem>
#include <stdexcept>
#include <string>
#include <vector>

#include <sys/wait.h>

#include <Eigen/Core>
#include <nlohmann/json.hpp>

#include "gp2/base/blas.hpp"
#include "gp2/data/csv.hpp"
#include "io_testing.hpp"

// The built command, run as a person runs it: by a shell, in a folder, with files beside it.
namespace gp2::test {

/// What a command left behind.
struct Outcome {
  int status = 0;
  std::string out, err;

  [[nodiscard]] bool said(const std::string& text) const { return err.find(text) != std::string::npos; }
  [[nodiscard]] nlohmann::json json() const { return nlohmann::json::parse(out); }
};

/// A folder to work in, where models/ and experiments/ are the checkout's and gp2 is the command that was built.
class Desk {
 public:
  Desk() {
    // commands have the kernel of OpenBLAS that this process has: gp2 would choose a better one, which rounds differently
    if (const std::string kernel = blas_report().kernel; !kernel.empty()) setenv("OPENBLAS_CORETYPE", kernel.c_str(), 0);
    for (const char* name : {"models", "experiments"}) {
      std::filesystem::create_directory_symlink(std::filesystem::path(GP2_SOURCE_DIR) / name, folder_ / name);
    }
  }

  /// Runs a line of shell.
  Outcome run(const std::string& line) const {
    const std::string path = std::filesystem::path(GP2_COMMAND).parent_path().string();
    const std::string script =
        "cd '" + folder_.path().string() + "' && PATH='" + path + "':$PATH && { " + line + "\n} >.stdout 2>.stderr </dev/null";
    const int status = std::system(script.c_str());
    if (!WIFEXITED(status)) throw std::runtime_error("not ended by itself: " + line);
    return {WEXITSTATUS(status), read(".stdout"), read(".stderr")};
  }

  /// The same for a line that must succeed.
  Outcome done(const std::string& line) const {
    Outcome outcome = run(line);
    if (outcome.status != 0) throw std::runtime_error(line + ": exit " + std::to_string(outcome.status) + ": " + outcome.err);
    return outcome;
  }

  [[nodiscard]] std::filesystem::path operator/(const std::string& name) const { return folder_ / name; }
  [[nodiscard]] std::string read(const std::string& name) const { return read_file(folder_ / name); }
  [[nodiscard]] CsvTable table(const std::string& name) const { return CsvTable::read(folder_ / name); }
  [[nodiscard]] nlohmann::json json(const std::string& name) const { return nlohmann::json::parse(read(name)); }
  void write(const std::string& name, const std::string& content) const { static_cast<void>(folder_.write(name, content)); }
  [[nodiscard]] bool has(const std::string& name) const { return std::filesystem::exists(folder_ / name); }
  [[nodiscard]] const std::filesystem::path& path() const { return folder_.path(); }

 private:
  TemporaryFolder folder_;
};

/// `text` with the one place where `from` stands changed to `to`.
inline std::string replaced(std::string text, const std::string& from, const std::string& to) {
  const std::size_t place = text.find(from);
  if (place == std::string::npos || text.find(from, place + 1) != std::string::npos) {
    throw std::runtime_error("'" + from + "' must stand once in the text");
  }
  return text.replace(place, from.size(), to);
}

/// Columns of a table by their names (names × rows).
inline Eigen::MatrixXd columns(const CsvTable& table, const std::vector<std::string>& names) {
  Eigen::MatrixXd values(static_cast<Eigen::Index>(names.size()), table.n_rows());
  for (std::size_t k = 0; k < names.size(); ++k) {
    const int column = table.find(names[k]);
    if (column < 0) throw std::runtime_error("no column " + names[k]);
    for (int i = 0; i < table.n_rows(); ++i) values(static_cast<Eigen::Index>(k), i) = table.number(i, column);
  }
  return values;
}

}  // namespace gp2::test
