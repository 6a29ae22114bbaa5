#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>

#include <fcntl.h>
#include <poll.h>
#include <sys/stat.h>
#include <unistd.h>

#include <fmt/format.h>

#include "gp2/csv.hpp"
#include "gp2/error.hpp"

namespace gp2 {

namespace {

constexpr int patience = 3000;                                 // how long a pipe may lack a writer [ms]
constexpr std::size_t max_device_size = std::size_t{1} << 24;  // /dev/zero has no end; a person at a terminal types less

struct OpenFile {
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

}  // namespace

std::string read_file(const std::filesystem::path& path, std::size_t max_size) {
  const auto fail = [&](const std::string& why) { throw InputError(fmt::format("{}: {}", path.string(), why)); };
  const auto require = [&](bool good) {
    if (!good) fail(fmt::format("cannot be read: {}", std::strerror(errno)));
  };
  // opened without waiting, for a pipe may never get a writer
  const OpenFile file(path);
  require(file.descriptor >= 0);
  struct stat status = {};
  require(fstat(file.descriptor, &status) == 0);
  const bool is_pipe = S_ISFIFO(status.st_mode);
  if (!S_ISREG(status.st_mode) && !is_pipe) max_size = std::min(max_size, max_device_size);

  std::string content;
  if (S_ISREG(status.st_mode)) {
    const auto size = static_cast<std::size_t>(status.st_size);
    if (size > max_size) fail(fmt::format("{} bytes; at most {} are read", size, max_size));
    content.reserve(size);
  }
  std::array<char, 1 << 16> block;
  bool has_writer = !is_pipe, was_patient = false;
  while (true) {
    const ssize_t n = read(file.descriptor, block.data(), block.size());
    if (n > 0) {
      content.append(block.data(), static_cast<std::size_t>(n));
      if (content.size() > max_size) fail(fmt::format("more than {} bytes, which is all that is read", max_size));
      has_writer = true;
    } else if (n == 0) {
      if (has_writer) return content;
      // no one has opened the pipe for writing yet
      if (was_patient) fail("cannot be read: a pipe that nothing writes to");
      if (file.wait(patience)) {
        has_writer = true;
      } else {
        was_patient = true;
      }
    } else if (errno == EAGAIN) {
      has_writer = true;
      static_cast<void>(file.wait(-1));
    } else {
      require(errno == EINTR);
    }
  }
}

}  // namespace gp2
