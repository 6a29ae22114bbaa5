#pragma once

#include <string_view>
#include <utility>

#include <fmt/format.h>
#include <nlohmann/json_fwd.hpp>

// What the command prints. A stream that cannot be written, of a full disk or a closed terminal, throws nothing and ends nothing:
// no result is lost to it.
namespace gp2::command {

/// Makes stdin, stdout and stderr safe to use: one that is closed fails when it is used, instead of being the next file that is
/// opened, and a pipe without a reader is an error instead of a signal.
void prepare_streams();

/// Writes a text to stdout. A failure is kept for finish_stdout().
void write_stdout(std::string_view text);
/// From here on write_stdout writes to stderr: stdout is the file of a result.
void leave_stdout_to_a_file();
/// Writes a text to stderr, or drops it.
void write_stderr(std::string_view text);

template <typename... Values>
void print_result(fmt::format_string<Values...> format, Values&&... values) {
  write_stdout(fmt::format(format, std::forward<Values>(values)...));
}
/// Names of files and columns may be of any encoding: what is not UTF-8 is replaced.
void print_json(const nlohmann::ordered_json& json);
template <typename... Values>
void print_message(fmt::format_string<Values...> format, Values&&... values) {
  write_stderr(fmt::format(format, std::forward<Values>(values)...));
}

/// From here on notes and progress are not printed; warnings and errors are.
void be_quiet();
[[nodiscard]] bool is_quiet();

/// Whether it is time to say how far long work is: ten times a second on a terminal, every ten seconds elsewhere, never when quiet.
bool progress_is_due();
/// Says it: on a terminal in one line that rewrites itself.
void print_progress(std::string_view text);
/// Clears that line.
void end_progress();

/// Flushes stdout. Where its reader has gone, the process ends by SIGPIPE, as other programs do.
/// @return the errno of the first write that failed; 0: all was written
int finish_stdout();

}  // namespace gp2::command
