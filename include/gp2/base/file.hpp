#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "gp2/export.hpp"

namespace gp2 GP2_API {

/// Writes `content` to a file whole or not at all: into a temporary file beside it, flushed, then renamed over `path`. The
/// temporary file has no name until it is whole, where the file system can do that: then nothing is left of it however the
/// process ends. A link stays and its target is replaced; an old file's permissions are kept, and one that is read-only is not
/// replaced; a device or pipe is written to as it is, and so is /dev/stdout, whatever it leads to.
/// @throws InputError naming the path and the system's reason when that fails; an old file at `path` is then intact.
void write_file(const std::filesystem::path& path, std::string_view content);

/// Several files that belong together: none of them is replaced before all are written.
void write_files(const std::vector<std::pair<std::filesystem::path, std::string>>& files);

/// The same of what `produce` hands on block after block, so that a long text need not be in memory as a whole.
/// @throws InputError as write_file, and what `produce` throws.
void write_blocks(const std::filesystem::path& path,
                  const std::function<void(const std::function<void(std::string_view)>& put)>& produce);

/// @throws InputError as write_file would, for what can be told before there is content: no such folder, a folder of that name,
/// no permission.
void require_writable(const std::filesystem::path& path);

/// The largest file that is read, 1 GiB.
inline constexpr std::size_t max_file_size = std::size_t{1} << 30;

/// The content of a file, or of a pipe or device to its end.
/// @throws InputError when it cannot be read, holds more than `max_size` bytes, changes while it is read, or is a pipe that nothing
///   writes to.
std::string read_file(const std::filesystem::path& path, std::size_t max_size = max_file_size);

/// The same, handed on block after block as it is read.
/// @throws InputError as read_file, and what `take` throws.
void read_blocks(const std::filesystem::path& path, const std::function<void(std::string_view)>& take,
                 std::size_t max_size = max_file_size);

/// What tells one state of a file from another.
struct FileVersion {
  std::uint64_t device = 0, inode = 0, size = 0;
  std::int64_t seconds = 0, nanoseconds = 0;  // of its last change
  bool operator==(const FileVersion&) const = default;
};

/// Nothing of a pipe or device, which is read once, nor where there is no such file.
std::optional<FileVersion> file_version(const std::filesystem::path& path);

class OpenFile;

/// A file, no pipe or device, of which several threads may read parts at once.
class FileParts {
 public:
  /// @throws InputError as read_file.
  explicit FileParts(std::filesystem::path path);
  ~FileParts();
  FileParts(const FileParts&) = delete;
  FileParts& operator=(const FileParts&) = delete;

  [[nodiscard]] std::uint64_t size() const { return version_.size; }
  /// Fewer than n bytes at the end of the file. @throws InputError when it cannot be read.
  [[nodiscard]] std::string read(std::uint64_t first, std::size_t n) const;
  /// @throws InputError when the file has changed since it was opened.
  void require_unchanged() const;

 private:
  std::filesystem::path path_;
  std::unique_ptr<const OpenFile> file_;
  FileVersion version_;
};

/// @throws InputError that the file is another one than when it was read first.
[[noreturn]] void throw_changed(const std::filesystem::path& path);

/// The shortest text that reads back to the same double.
std::string shortest(double value);

}  // namespace gp2
