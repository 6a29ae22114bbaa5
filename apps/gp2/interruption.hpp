#pragma once

#include <array>
#include <atomic>
#include <cerrno>
#include <csignal>
#include <string_view>

#include <unistd.h>

namespace gp2::command {

/// A command ended by a signal after it saved what there was. main exits with 128 + signal, as a shell says it.
struct Interrupted {
  int signal;
};

/// While it lives Ctrl-C, SIGTERM and a terminal that is closed (SIGHUP) ask for an end instead of being one: the first of them
/// sets stop(). From then on they do what they did before, so that a second one ends the process at once. One that was ignored
/// before, as by nohup, stays ignored. There is one at a time.
class Interruption {
 public:
  Interruption() {
    stop_ = false;
    signal_ = 0;
    for (std::size_t k = 0; k < signals.size(); ++k) {
      sigaction(signals[k], nullptr, &before_[k]);
      if (before_[k].sa_handler == SIG_IGN) continue;
      struct sigaction action = {};
      action.sa_handler = ask;
      action.sa_flags = SA_RESTART;
      for (const int signal : signals) sigaddset(&action.sa_mask, signal);  // one after the other
      sigaction(signals[k], &action, nullptr);
    }
  }
  ~Interruption() { restore(); }
  Interruption(const Interruption&) = delete;
  Interruption& operator=(const Interruption&) = delete;

  [[nodiscard]] const std::atomic<bool>* stop() const { return &stop_; }
  [[nodiscard]] int signal() const { return signal_; }  // 0: none came

 private:
  static constexpr std::array<int, 3> signals = {SIGINT, SIGTERM, SIGHUP};

  // a handler may call sigaction and write, and touch atomics without a lock, and little else
  static void ask(int signal) {
    constexpr std::string_view text =
        "\ngp2: stopping, which takes some seconds with many rows; once more ends at once, without a fit\n";
    const int error = errno;
    const bool is_second = stop_.exchange(true);
    if (!is_second) signal_ = signal;
    restore();
    if (is_second) {  // it came to another thread while the first was on its way
      ::raise(signal);
      return;
    }
    static_cast<void>(::write(STDERR_FILENO, text.data(), text.size()) == 0);
    errno = error;
  }
  static void restore() {
    for (std::size_t k = 0; k < signals.size(); ++k) sigaction(signals[k], &before_[k], nullptr);
  }

  static_assert(std::atomic<bool>::is_always_lock_free && std::atomic<int>::is_always_lock_free);
  static inline std::atomic<bool> stop_ = false;
  static inline std::atomic<int> signal_ = 0;
  static inline std::array<struct sigaction, 3> before_ = {};
};

}  // namespace gp2::command
