#pragma once

#include <cstdlib>
#include <filesystem>
#include <optional>
#include <stdexcept>
#include <string>

#include <fmt/core.h>

// Where tests find data that is not part of the repository. GP2_REFERENCE_DIR, GP2_REAL_DIR and GP2_ROBOTS_DIR name the folders;
// when a variable is not set, ../shared/reference, ../shared/real and ../shared/robots beside the checkout are used if they
// exist. A promised file that is missing fails the test; without a promise (no variable, no default folder) the test is skipped:
//
//   if (const auto absent = why_reference_is_absent()) GTEST_SKIP() << *absent;
//   const auto path = reference_file("train/surface_run0.csv");
namespace gp2::test {

/// A folder of data outside the repository.
struct DataFolder {
  const char* variable;        // environment variable that names it
  const char* default_path;    // relative to the checkout
  const char* what_is_absent;  // scripts/test counts skipped tests by this text

  /// The folder promised by the variable or, without one, the default folder if it exists.
  [[nodiscard]] std::optional<std::filesystem::path> path() const {
    if (const char* value = std::getenv(variable); value != nullptr && *value != '\0') return std::filesystem::path(value);
    const auto fallback = std::filesystem::path(GP2_SOURCE_DIR) / default_path;
    if (std::filesystem::is_directory(fallback)) return fallback.lexically_normal();
    return std::nullopt;
  }

  /// The reason to skip, or nothing when the folder is promised.
  [[nodiscard]] std::optional<std::string> why_absent() const {
    if (path()) return std::nullopt;
    return fmt::format("{} (set {})", what_is_absent, variable);
  }

  /// @throws std::runtime_error when the folder is not there.
  [[nodiscard]] std::filesystem::path directory() const {
    const auto folder = path();
    if (!folder) throw std::runtime_error(fmt::format("{} (set {})", what_is_absent, variable));
    if (!std::filesystem::is_directory(*folder)) {
      throw std::runtime_error(fmt::format("{} names '{}', which is not a folder", variable, folder->string()));
    }
    return *folder;
  }

  /// @throws std::runtime_error when the file is not there.
  [[nodiscard]] std::filesystem::path file(const std::filesystem::path& name) const {
    auto path = directory() / name;
    if (!std::filesystem::is_regular_file(path)) {
      throw std::runtime_error(
          fmt::format("missing file '{}' (the folder comes from {} or its default)", path.string(), variable));
    }
    return path;
  }
};

inline constexpr DataFolder reference_data{"GP2_REFERENCE_DIR", "../shared/reference", "published data not found"};
inline constexpr DataFolder real_data{"GP2_REAL_DIR", "../shared/real", "measured data of real machines not found"};
inline constexpr DataFolder robot_data{"GP2_ROBOTS_DIR", "../shared/robots", "published descriptions of robots not found"};

/// Published data and results of the paper.
inline std::optional<std::string> why_reference_is_absent() { return reference_data.why_absent(); }
inline std::filesystem::path reference_dir() { return reference_data.directory(); }
inline std::filesystem::path reference_file(const std::filesystem::path& name) { return reference_data.file(name); }

/// Measurements of real machines.
inline std::optional<std::string> why_real_is_absent() { return real_data.why_absent(); }
inline std::filesystem::path real_dir() { return real_data.directory(); }
inline std::filesystem::path real_file(const std::filesystem::path& name) { return real_data.file(name); }

/// URDF files of real robots.
inline std::optional<std::string> why_robots_are_absent() { return robot_data.why_absent(); }
inline std::filesystem::path robot_file(const std::filesystem::path& name) { return robot_data.file(name); }

}  // namespace gp2::test
