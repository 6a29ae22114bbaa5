#pragma once

#include <array>
#include <atomic>
#include <cerrno>
#include <csignal>
#include <cstdint>
#include <cstring>
#include <ctime>
#include <filesystem>
#include <optional>
#include <string>
#include <string_view>

#include <unistd.h>

#include <fmt/format.h>

#include "gp2/base/file.hpp"

namespace gp2::command {

/// A command ended by a signal after it saved what there was. main exits with 128 + signal, as a shell says it.
struct Interrupted {
  int signal;
};

/// Where a fit that ends before its time is saved, which it says when it does, also from a signal handler.
class LastWord {
 public:
  /// @param checkpoint  file that is saved while the fit runs; empty: none
  explicit LastWord(const std::string& checkpoint)
      : checkpoint_(checkpoint),
        text_(fmt::format("\ngp2: {0} holds the best so far; --start {0} continues from there\n", checkpoint)),
        before_(file_version(checkpoint_)) {}
  /// Says it where there is such a file and it was saved since.
  void say() const {
    if (const std::optional<FileVersion> now = file_version(checkpoint_); !now || now == before_) return;
    static_cast<void>(::write(STDERR_FILENO, text_.data(), text_.size()) == 0);
  }

 private:
  std::filesystem::path checkpoint_;
  std::string text_;
  std::optional<FileVersion> before_;
};

/// While it lives Ctrl-C, SIGTERM and a terminal that is closed (SIGHUP) ask for an end instead of being one: the first of them
/// sets stop(). The next one does what it did before and ends the process at once, unless it is the same within half a second: `timeout`
/// sends its signal to a process and then to the group it is in. One that was ignored before, as by nohup, stays ignored.
/// There is one at a time.
class Interruption {
 public:
  /// @param may_save   false: signals do what they did before
  /// @param last_word  said before a signal ends the process at once; null: none
  explicit Interruption(bool may_save = true, const LastWord* last_word = nullptr) : is_on_(may_save || last_word != nullptr) {
    if (!is_on_) return;
    may_save_ = may_save;
    last_word_ = last_word;
    stop_ = false;
    signal_ = 0;
    asked_at_ = never;
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
  ~Interruption() {
    if (is_on_) restore();
  }
  Interruption(const Interruption&) = delete;
  Interruption& operator=(const Interruption&) = delete;

  [[nodiscard]] const std::atomic<bool>* stop() const { return &stop_; }
  [[nodiscard]] int signal() const { return signal_; }  // 0: none came
  /// Of the signal that came.
  [[nodiscard]] std::string text() const { return fmt::format("interrupted by signal {} ({})", signal(), strsignal(signal())); }

 private:
  static constexpr std::array<int, 3> signals = {SIGINT, SIGTERM, SIGHUP};

  static constexpr std::int64_t never = -1, one_wish = 500;  // [ms]

  // a handler may call clock_gettime, sigaction and write, and touch atomics without a lock, and little else
  static void ask(int signal) {
    constexpr std::string_view text =
        "\ngp2: stopping, which takes some seconds with many rows; a second signal ends it at once, with nothing saved\n";
    const int error = errno;
    timespec now = {};
    clock_gettime(CLOCK_MONOTONIC, &now);
    const std::int64_t here = std::int64_t{now.tv_sec} * 1000 + now.tv_nsec / 1'000'000;
    std::int64_t first = never;
    if (!may_save_) {
      end_at_once(signal);
    } else if (asked_at_.compare_exchange_strong(first, here)) {
      signal_ = signal;
      stop_ = true;
      static_cast<void>(::write(STDERR_FILENO, text.data(), text.size()) == 0);
    } else if (signal != signal_ || here - first > one_wish) {
      end_at_once(signal);
    }
    errno = error;
  }
  static void end_at_once(int signal) {
    if (last_word_ != nullptr) last_word_->say();
    restore();
    ::raise(signal);
  }
  static void restore() {
    for (std::size_t k = 0; k < signals.size(); ++k) sigaction(signals[k], &before_[k], nullptr);
  }

  static_assert(std::atomic<bool>::is_always_lock_free && std::atomic<int>::is_always_lock_free &&
                std::atomic<std::int64_t>::is_always_lock_free);
  static inline bool may_save_ = true;                 // set before there is a handler that reads it
  static inline const LastWord* last_word_ = nullptr;  // likewise
  static inline std::atomic<bool> stop_ = false;
  static inline std::atomic<int> signal_ = 0;
  static inline std::atomic<std::int64_t> asked_at_ = never;  // [ms]
  static inline std::array<struct sigaction, 3> before_ = {};
  bool is_on_;
};

}  // namespace gp2::command
