#include <algorithm>
#include <csignal>
#include <cstdio>
#include <cstring>
#include <exception>
#include <sstream>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#ifdef __GLIBC__
#include <malloc.h>
#endif

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <CLI/CLI.hpp>

#include "base/suggestion.hpp"
#include "blas_choice.hpp"
#include "command.hpp"
#include "command_line.hpp"
#include "gp2/base/blas.hpp"
#include "gp2/base/version.hpp"
#include "gp2/error.hpp"
#include "interruption.hpp"
#include "pages.hpp"
#include "ranks.hpp"
#include "streams.hpp"

namespace {

constexpr int exit_numerical = 1;
constexpr int exit_bad_input = 2;

int failed(int exit_code, const std::string& text) {
  static_cast<void>(std::fflush(stdout));  // where both go to one terminal or file, the results came first
  gp2::command::end_progress();
  gp2::command::print_message("gp2: {}\n", text);
  gp2::command::abort_ranks(exit_code, text);
  return exit_code;
}

// Matrices of a likelihood are freed and asked for again at each of its evaluations. Given back to the system in between, their pages
// are cleared each time, which takes longer than the factors of some hundred inducing variables.
void keep_freed_memory() {
#ifdef __GLIBC__
  mallopt(M_MMAP_THRESHOLD, 32 << 20);
  mallopt(M_TRIM_THRESHOLD, 64 << 20);
#endif
}

// results that could not be printed must not pass as printed
int finished() {
  const int error = gp2::command::finish_stdout();
  if (error == 0) return 0;
  return failed(exit_bad_input, fmt::format("error: standard output: cannot be written: {}", std::strerror(error)));
}

// of --version --verbose
std::string build_and_machine() {
  const gp2::BlasReport blas = gp2::blas_report();
  const gp2::ProcessorFeatures features = gp2::processor_features();
#ifdef __clang__
  const std::string compiler = __VERSION__;
#else
  const std::string compiler = "g++ " __VERSION__;
#endif
  std::vector<std::pair<std::string, std::string>> rows = {
      {"version", gp2::version()},
      {"compiler", compiler},
      {"BLAS library", blas.library},
      {"BLAS kernel", blas.kernel.empty() ? "unknown" : blas.kernel + ", chosen by " + gp2::command::blas_kernel_chosen_by()},
      {"BLAS threads", std::to_string(blas.n_threads)},
      {"processor", features.avx512 ? "AVX-512, AVX2, FMA"
                    : features.avx2 ? "AVX2, FMA"
                                    : "neither AVX-512 nor AVX2"},
      {"own loops", gp2::instruction_set()},
  };
  // what gp2 has already asked for need not be advised
  if (!blas.advice.empty() && gp2::command::blas_kernel_chosen_by() != "gp2") rows.emplace_back("advice", blas.advice);
  std::string text;
  for (const auto& [name, value] : rows) text += fmt::format("{}{:<14}{}", text.empty() ? "" : "\n", name, value);
  return text;
}

// The one that is to run, "" where only options are given. CLI11 would say of an unknown one that a command is missing.
std::string known_command(const std::vector<gp2::command::Command>& commands, int argc, char** argv) {
  if (argc < 2 || argv[1][0] == '-') return "";
  std::vector<std::string> names;
  for (const gp2::command::Command& command : commands) names.push_back(command.name);
  if (std::find(names.begin(), names.end(), argv[1]) != names.end()) return argv[1];
  std::string mend = gp2::suggestion(argv[1], names);
  if (mend.empty()) mend = fmt::format("; there are: {}", fmt::join(names, ", "));
  throw gp2::command::UsageError{fmt::format("there is no command '{}'{}", argv[1], mend)};
}

// CLI11 takes the next option for a value that is missing.
void require_values(const gp2::command::Command& command, int argc, char** argv) {
  std::vector<std::string> all = {"-h", "--help"}, with_value;
  for (const gp2::Option& option : command.options) {
    const bool takes_value =
        !std::holds_alternative<bool*>(option.value) && !std::holds_alternative<gp2::YesByDefault>(option.value);
    std::istringstream flags(gp2::command::flag_of(option));  // -o,--output
    for (std::string flag; std::getline(flags, flag, ',');) {
      if (!flag.starts_with('-')) continue;  // an argument by its position
      all.push_back(flag);
      if (takes_value) with_value.push_back(flag);
    }
  }
  for (int i = 2; i + 1 < argc; ++i) {
    const std::string next = argv[i + 1];
    if (std::ranges::count(with_value, argv[i]) == 0 || std::ranges::count(all, next.substr(0, next.find('='))) == 0) continue;
    throw gp2::command::UsageError{fmt::format("{}: its value is missing", argv[i])};
  }
}

// command: the one that is to run, or ""
int usage_error(const std::string& text, const std::string& command) {
  return failed(exit_bad_input, fmt::format("error: {}\nRun gp2{} --help.", text, command.empty() ? "" : " " + command));
}

gp2::Option quiet_option() {
  static bool quiet = false;
  gp2::Option option{"quiet", &quiet, "", "print no progress and no notes, only warnings and errors"};
  option.flag = "-q,--quiet";
  return option;
}

}  // namespace

namespace gp2::command {

std::vector<Command> all_commands() {
  std::vector<Command> commands;
  std::vector<std::string> names;
  for (const auto command : {show_command, check_command, generate_command, derive_command, resample_command, fit_command,
                             predict_command, simulate_command, excite_command, evaluate_command, update_command, shoot_command,
                             report_command, plot_command, export_command, reproduce_command, completion_command}) {
    commands.push_back(command());
    if (command != completion_command) commands.back().options.push_back(quiet_option());
    names.push_back(commands.back().name);
  }
  names.emplace_back("help");
  commands.push_back(help_command(names));
  return commands;
}

}  // namespace gp2::command

int main(int argc, char** argv) {
  gp2::command::choose_blas_kernel(argv);
  keep_freed_memory();
  gp2::command::prepare_streams();
  std::signal(SIGXFSZ, SIG_IGN);  // a file beyond the limit (ulimit -f) is an error to tell, like a full disk
  CLI::App app;
  app.name("gp2");
  app.require_subcommand(1);
  bool verbose = false;
  CLI::Option* verbose_flag = app.add_flag("--verbose", verbose);
  const auto version_text = [&verbose]() -> std::string { return verbose ? build_and_machine() : gp2::version(); };
  verbose_flag->needs(app.set_version_flag("-V,--version", version_text));
  const std::vector<gp2::command::Command> commands = gp2::command::all_commands();
  for (const gp2::command::Command& command : commands) gp2::command::add_command(app, command);
  app.formatter_fn([&](auto&&...) { return gp2::command::help_page(commands, gp2::command::help_width()); });

  std::string running;
  try {
    running = known_command(commands, argc, argv);
    const auto command = std::ranges::find(commands, running, &gp2::command::Command::name);
    if (command != commands.end()) require_values(*command, argc, argv);
    if (argc > 1 && running != "fit" && gp2::command::n_started_together() > 1) {
      throw gp2::InputError("mpirun is for gp2 fit; start this command alone");
    }
    app.parse(argc, argv);
  } catch (const CLI::Success& help_or_version) {
    std::ostringstream text;
    app.exit(help_or_version, text, text);
    gp2::command::write_stdout(text.str());
  } catch (const CLI::ParseError& error) {
    // CLI11 names an option that is missing before one that is misspelt
    const std::string unknown = gp2::command::unknown_option(app);
    return usage_error(unknown.empty() ? gp2::command::in_plain_words(error.what()) : unknown, running);
  } catch (const gp2::command::UsageError& error) {
    return usage_error(error.text, running);
  } catch (const gp2::command::Interrupted& interrupted) {
    return 128 + interrupted.signal;
  } catch (const gp2::InputError& error) {
    return failed(exit_bad_input, fmt::format("error: {}", gp2::command::with_flags(error.what())));
  } catch (const gp2::NumericalError& error) {
    return failed(exit_numerical, fmt::format("numerical failure: {}", gp2::command::with_flags(error.what())));
  } catch (const std::bad_alloc&) {
    return failed(exit_numerical, "numerical failure: not enough memory");
  } catch (const std::exception& error) {
    return failed(exit_numerical, fmt::format("internal error: {}", error.what()));
  }
  gp2::command::leave_ranks();
  return finished();
}
