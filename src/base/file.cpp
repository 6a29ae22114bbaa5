#include "gp2/base/file.hpp"

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <charconv>
#include <cstdio>
#include <cstring>
#include <deque>
#include <functional>
#include <optional>
#include <system_error>
#include <utility>

#include <fcntl.h>
#include <poll.h>
#include <sys/stat.h>
#include <unistd.h>

#include <fmt/format.h>

#include "gp2/error.hpp"

namespace gp2 {

class OpenFile {
 public:
  explicit OpenFile(const std::filesystem::path& path) : descriptor(open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK)) {}
  ~OpenFile() {
    if (descriptor >= 0) close(descriptor);
  }
  OpenFile(const OpenFile&) = delete;
  OpenFile& operator=(const OpenFile&) = delete;

  /// Waits until there is something to read, or the end; false when that takes longer than `milliseconds`.
  [[nodiscard]] bool wait(int milliseconds) const {
    pollfd one = {descriptor, POLLIN, 0};
    return poll(&one, 1, milliseconds) != 0;
  }

  const int descriptor;
};

namespace {

constexpr int patience = 3000;                                 // how long a pipe may lack a writer [ms]
constexpr std::size_t max_device_size = std::size_t{1} << 24;  // /dev/zero has no end; a person at a terminal types less

FileVersion version_of(const struct stat& status) {
  return {status.st_dev, status.st_ino, static_cast<std::uint64_t>(status.st_size), status.st_mtim.tv_sec,
          status.st_mtim.tv_nsec};
}

[[noreturn]] void refuse(const std::filesystem::path& path, const std::string& why) {
  throw InputError(fmt::format("{}: {}", path.string(), why));
}

// `good` is what a call of the system says.
void require(bool good, const std::filesystem::path& path) {
  if (!good) refuse(path, fmt::format("cannot be read: {}", std::strerror(errno)));
}

struct stat status_of(const OpenFile& file, const std::filesystem::path& path) {
  require(file.descriptor >= 0, path);
  struct stat status = {};
  require(fstat(file.descriptor, &status) == 0, path);
  return status;
}

void require_size(std::uint64_t size, const std::filesystem::path& path, std::size_t max_size) {
  if (size > max_size) refuse(path, fmt::format("{} bytes; at most {} are read", size, max_size));
}

// Not one of the files that are taken for text by mistake.
void require_text(std::string_view begin, const std::filesystem::path& path) {
  using namespace std::string_view_literals;
  if (begin.starts_with("\xff\xfe"sv) || begin.starts_with("\xfe\xff"sv)) {
    refuse(path, "the text is UTF-16; save it as UTF-8 (iconv -f UTF-16 -t UTF-8)");
  }
  if (begin.starts_with("\x1f\x8b"sv)) refuse(path, "the file is compressed by gzip; unpack it first (gunzip)");
  if (begin.starts_with("PK\x03\x04"sv)) {
    refuse(path, "the file is a ZIP archive, as spreadsheets are; export it as CSV, or unpack it");
  }
}

// Reads what a descriptor that does not wait has, block after block, to its end.
void read_to_end(const OpenFile& file, bool is_pipe, const std::filesystem::path& path,
                 const std::function<void(std::string_view)>& take) {
  std::array<char, 1 << 16> block;
  bool has_writer = !is_pipe, was_patient = false;
  while (true) {
    const ssize_t n = read(file.descriptor, block.data(), block.size());
    if (n > 0) {
      take({block.data(), static_cast<std::size_t>(n)});
      has_writer = true;
    } else if (n == 0) {
      if (has_writer) return;
      // no one has opened the pipe for writing yet
      if (was_patient) refuse(path, "cannot be read: a pipe that nothing writes to");
      has_writer = file.wait(patience);
      was_patient = !has_writer;
    } else if (errno == EAGAIN) {
      has_writer = true;
      static_cast<void>(file.wait(-1));
    } else {
      require(errno == EINTR, path);
    }
  }
}

}  // namespace

void throw_changed(const std::filesystem::path& path) {
  throw InputError(
      fmt::format("{}: changed while it was read; read it when nothing writes to it any more, or read a copy", path.string()));
}

std::optional<FileVersion> file_version(const std::filesystem::path& path) {
  struct stat status = {};
  if (stat(path.c_str(), &status) != 0 || !S_ISREG(status.st_mode)) return std::nullopt;
  return version_of(status);
}

FileParts::FileParts(std::filesystem::path path)
    : path_(std::move(path)), file_(std::make_unique<const OpenFile>(path_)), version_(version_of(status_of(*file_, path_))) {
  require_size(size(), path_, max_file_size);
  require_text(read(0, 4), path_);
}

FileParts::~FileParts() = default;

std::string FileParts::read(std::uint64_t first, std::size_t n) const {
  std::string part(n, '\0');
  std::size_t n_read = 0;
  while (n_read < n) {
    const ssize_t now = pread(file_->descriptor, part.data() + n_read, n - n_read, static_cast<off_t>(first + n_read));
    if (now == 0) break;
    require(now > 0 || errno == EINTR, path_);
    if (now > 0) n_read += static_cast<std::size_t>(now);
  }
  part.resize(n_read);
  return part;
}

void FileParts::require_unchanged() const {
  if (version_of(status_of(*file_, path_)) != version_) throw_changed(path_);
}

void read_blocks(const std::filesystem::path& path, const std::function<void(std::string_view)>& take, std::size_t max_size) {
  // opened without waiting, for a pipe may never get a writer
  const OpenFile file(path);
  const struct stat status = status_of(file, path);
  const bool is_pipe = S_ISFIFO(status.st_mode);
  if (!S_ISREG(status.st_mode) && !is_pipe) max_size = std::min(max_size, max_device_size);
  if (S_ISREG(status.st_mode)) require_size(static_cast<std::uint64_t>(status.st_size), path, max_size);
  std::size_t size = 0;
  bool is_begin = true;
  read_to_end(file, is_pipe, path, [&](std::string_view block) {
    if (std::exchange(is_begin, false)) require_text(block, path);
    size += block.size();
    if (size > max_size) refuse(path, fmt::format("more than {} bytes, which is all that is read", max_size));
    take(block);
  });
  if (S_ISREG(status.st_mode) && version_of(status_of(file, path)) != version_of(status)) throw_changed(path);
}

std::string read_file(const std::filesystem::path& path, std::size_t max_size) {
  std::string content;
  std::error_code unknown;
  const std::uintmax_t size = std::filesystem::file_size(path, unknown);
  if (!unknown && size <= max_size) content.reserve(static_cast<std::size_t>(size));
  read_blocks(
      path, [&](std::string_view block) { content += block; }, max_size);
  return content;
}

std::string shortest(double value) {
  char buffer[32];
  const auto result = std::to_chars(buffer, buffer + sizeof buffer, value);
  return std::string(buffer, result.ptr);
}

namespace {

// a name beside `target` that no other thread or process takes
std::string temporary_name(const std::string& target) {
  static std::atomic<unsigned> counter = 0;
  return fmt::format("{}.{}-{}.tmp", target, getpid(), counter++);
}

// The folder that a path is in.
std::string folder_of(const std::string& path) {
  const std::string folder = std::filesystem::path(path).parent_path().string();
  return folder.empty() ? "." : folder;
}

// Opens a new file beside `target`, with the permissions that the process gives to new files; −1 and errno when that fails. It
// has no name, which give_name() can give it, or where the system does not know such files `name`.
int open_beside(const std::string& target, std::string& name) {
#ifdef O_TMPFILE
  if (access("/proc/self/fd", X_OK) == 0) {
    const int file = open(folder_of(target).c_str(), O_WRONLY | O_TMPFILE | O_CLOEXEC, 0666);
    if (file >= 0) return file;
  }
#endif
  while (true) {
    name = temporary_name(target);
    const int file = open(name.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
    if (file >= 0 || errno != EEXIST) return file;
  }
}

// false and errno when that fails
bool give_name(int file, const std::string& target, std::string& name) {
  const std::string link = fmt::format("/proc/self/fd/{}", file);
  while (name.empty()) {
    const std::string wanted = temporary_name(target);
    if (linkat(AT_FDCWD, link.c_str(), AT_FDCWD, wanted.c_str(), AT_SYMLINK_FOLLOW) == 0) {
      name = wanted;
    } else if (errno != EEXIST) {
      return false;
    }
  }
  return true;
}

// all of `content`; false and errno when that fails
bool write_all(int file, std::string_view content) {
  while (!content.empty()) {
    const ssize_t n = ::write(file, content.data(), content.size());
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) return false;
    content.remove_prefix(static_cast<std::size_t>(n));
  }
  return true;
}

void require_written(const std::filesystem::path& path, bool good) {
  if (!good) throw InputError(fmt::format("{}: cannot be written: {}", path.string(), std::strerror(errno)));
}

// What a path leads to, also where links end at a file that is not there yet.
std::filesystem::path followed(std::filesystem::path path) {
  constexpr int most_links = 40;  // as the system follows
  std::error_code failed;
  for (int k = 0; k < most_links && std::filesystem::is_symlink(std::filesystem::symlink_status(path, failed)); ++k) {
    const std::filesystem::path target = std::filesystem::read_symlink(path, failed);
    path = target.is_absolute() ? target : path.parent_path() / target;
  }
  return path;
}

// Standard output is written to as it is, also where a shell has made it a file: what else is printed there stays.
bool is_standard_output(const std::filesystem::path& path) { return path == "/dev/stdout"; }

// A file to be written: a link stays, what it points at is replaced or made.
struct Target {
  std::string path;
  bool exists = false;
  struct stat status = {};

  [[nodiscard]] bool is_regular() const { return !is_standard_output(path) && (!exists || S_ISREG(status.st_mode)); }
};

Target target_of(const std::filesystem::path& path) {
  Target target;
  if (is_standard_output(path)) {
    target.path = path.string();
    target.exists = true;
    require_written(path, fstat(STDOUT_FILENO, &target.status) == 0);
    return target;
  }
  std::error_code no_such_file;
  const std::filesystem::path resolved = std::filesystem::canonical(path, no_such_file);
  target.path = no_such_file ? followed(path).string() : resolved.string();
  target.exists = stat(target.path.c_str(), &target.status) == 0;
  if (target.exists && S_ISDIR(target.status.st_mode)) {
    errno = EISDIR;
    require_written(path, false);
  }
  // a file that is read-only could be replaced all the same, but is so for a reason
  if (target.exists) require_written(path, faccessat(AT_FDCWD, target.path.c_str(), W_OK, AT_EACCESS) == 0);
  return target;
}

}  // namespace

void require_writable(const std::filesystem::path& path) {
  const Target target = target_of(path);
  if (!target.is_regular()) return;
  const std::string folder = folder_of(target.path);
  const bool is_folder = std::filesystem::is_directory(folder);
  if (!is_folder) errno = std::filesystem::exists(folder) ? ENOTDIR : ENOENT;
  require_written(path, is_folder && faccessat(AT_FDCWD, folder.c_str(), W_OK | X_OK, AT_EACCESS) == 0);
}

namespace {

/// What is written: a device as it is, or a new file that takes the place of the old one in the end. Gone, should that not come.
class Output {
 public:
  explicit Output(const std::filesystem::path& path) : path_(path), target_(target_of(path)) {}
  ~Output() {
    if (file_ >= 0) close(file_);
    if (!temporary_.empty()) unlink(temporary_.c_str());
  }
  Output(const Output&) = delete;
  Output& operator=(const Output&) = delete;

  void begin() {
    // /dev/stdout, a pipe: nothing to replace, and a rename would destroy the device
    file_ = is_new_file()                      ? open_beside(target_.path, temporary_)
            : is_standard_output(target_.path) ? dup(STDOUT_FILENO)
                                               : open(target_.path.c_str(), O_WRONLY | O_CLOEXEC);
    require_written(path_, file_ >= 0);
    if (is_new_file() && target_.exists) require_written(path_, fchmod(file_, target_.status.st_mode & 07777) == 0);
  }

  void put(std::string_view content) const { require_written(path_, write_all(file_, content)); }

  /// All that may fail for want of space.
  void settle() {
    if (is_new_file()) require_written(path_, fsync(file_) == 0 && give_name(file_, target_.path, temporary_));
  }

  void finish() {
    if (is_new_file()) {
      require_written(path_, std::rename(temporary_.c_str(), target_.path.c_str()) == 0);
      temporary_.clear();
    }
    require_written(path_, close(std::exchange(file_, -1)) == 0);
  }

 private:
  [[nodiscard]] bool is_new_file() const { return target_.is_regular(); }

  const std::filesystem::path& path_;
  Target target_;
  int file_ = -1;
  std::string temporary_;  // the new file's name, as soon as it has one
};

}  // namespace

void write_blocks(const std::filesystem::path& path,
                  const std::function<void(const std::function<void(std::string_view)>& put)>& produce) {
  Output output(path);
  output.begin();
  produce([&](std::string_view block) { output.put(block); });
  output.settle();
  output.finish();
}

void write_files(const std::vector<std::pair<std::filesystem::path, std::string>>& files) {
  std::deque<Output> outputs;
  for (const auto& [path, content] : files) {
    Output& output = outputs.emplace_back(path);
    output.begin();
    output.put(content);
    output.settle();
  }
  for (Output& output : outputs) output.finish();
}

void write_file(const std::filesystem::path& path, std::string_view content) {
  write_blocks(path, [&](const auto& put) { put(content); });
}

}  // namespace gp2
