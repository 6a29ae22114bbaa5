#include "streams.hpp"

#include <cerrno>
#include <chrono>
#include <csignal>
#include <cstdio>

#include <fcntl.h>
#include <unistd.h>

#include <nlohmann/json.hpp>

namespace gp2::command {

namespace {

int stdout_error = 0;  // errno of the first write that failed
bool stdout_is_a_file = false;
bool quiet = false;
bool pipes_were_signalled = false;  // SIGPIPE was not ignored by who started the process

}  // namespace

void prepare_streams() {
  for (const int stream : {STDIN_FILENO, STDOUT_FILENO, STDERR_FILENO}) {
    if (fcntl(stream, F_GETFD) != -1 || errno != EBADF) continue;
    // the lowest free descriptor is this one; opened the wrong way round, each use of it fails
    static_cast<void>(open("/dev/null", stream == STDIN_FILENO ? O_WRONLY : O_RDONLY));
  }
  pipes_were_signalled = std::signal(SIGPIPE, SIG_IGN) != SIG_IGN;
}

void leave_stdout_to_a_file() { stdout_is_a_file = true; }

void write_stdout(std::string_view text) {
  if (stdout_is_a_file) return write_stderr(text);
  errno = 0;
  if (std::fwrite(text.data(), 1, text.size(), stdout) != text.size() && stdout_error == 0) stdout_error = errno;
}

void write_stderr(std::string_view text) {
  static_cast<void>(std::fwrite(text.data(), 1, text.size(), stderr));
  static_cast<void>(std::fflush(stderr));
}

void print_json(const nlohmann::ordered_json& json) {
  print_result("{}\n", json.dump(2, ' ', /*ensure_ascii=*/false, nlohmann::ordered_json::error_handler_t::replace));
}

void be_quiet() { quiet = true; }
bool is_quiet() { return quiet; }

bool progress_is_due() {
  using Clock = std::chrono::steady_clock;
  static const bool on_terminal = isatty(STDERR_FILENO) != 0;
  static Clock::time_point next = Clock::now() + (on_terminal ? std::chrono::seconds(0) : std::chrono::seconds(10));
  const Clock::time_point now = Clock::now();
  if (quiet || now < next) return false;
  next = now + (on_terminal ? std::chrono::milliseconds(100) : std::chrono::seconds(10));
  return true;
}

void print_progress(std::string_view text) {
  if (isatty(STDERR_FILENO) != 0) return print_message("\rgp2: {}\033[K", text);
  print_message("gp2: {}\n", text);
}

void end_progress() {
  if (!quiet && isatty(STDERR_FILENO) != 0) print_message("\r\033[K");
}

int finish_stdout() {
  errno = 0;
  const bool is_good = std::fflush(stdout) == 0 && std::ferror(stdout) == 0;
  if (!is_good && stdout_error == 0) stdout_error = errno != 0 ? errno : EIO;
  if (stdout_error == EPIPE && pipes_were_signalled) {
    std::signal(SIGPIPE, SIG_DFL);
    static_cast<void>(std::raise(SIGPIPE));
  }
  return stdout_error;
}

}  // namespace gp2::command
