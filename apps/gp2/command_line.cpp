#include "command_line.hpp"

#include <algorithm>
#include <charconv>
#include <cstdint>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <regex>
#include <system_error>
#include <type_traits>
#include <utility>
#include <variant>

#include <sys/ioctl.h>
#include <unistd.h>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <CLI/CLI.hpp>

#include "base/suggestion.hpp"
#include "gp2/error.hpp"
#include "pages.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

void set_number_or_word(const NumberOrWord& one, const Option& option, const std::string& text) {
  for (const auto& [word, flag] : one.words) {
    *flag = text == word;
    if (*flag) return;
  }
  double number = 0;
  if (!CLI::detail::lexical_cast(text, number)) {
    std::vector<std::string> words;
    for (const auto& [word, flag] : one.words) words.push_back("'" + word + "'");
    throw InputError(
        fmt::format("{}: expected a positive number, {}, got '{}'", flag_of(option), fmt::join(words, " or "), text));
  }
  *one.number = number;
}

// Values that CLI11 leaves as text.
void set_from_text(const Option& option, const std::string& text) {
  std::visit(Overloaded{[&](std::vector<std::string>* list) { *list = parse_list(text, flag_of(option)); },
                        [&](std::optional<std::vector<std::string>>* list) {
                          *list = text == "none" ? std::vector<std::string>{} : parse_list(text, flag_of(option));
                        },
                        [&](std::map<std::string, std::string>* columns) { *columns = parse_map(text); },
                        [&](std::map<std::string, int>* counts) { *counts = parse_counts(text, flag_of(option)); },
                        [&](NamedNumbers* numbers) {
                          *numbers = {text, {}};
                        },
                        [&](const Choice& one) { one.set(text); }, [&](const Switch& one) { *one.value = text == one.on; },
                        [&](const NumberOrWord& one) { set_number_or_word(one, option, text); }, [](const auto&) {}},
             option.value);
}

// ---------------------------------------------------------------- the tables of docs/command-line.md

// `--mean zero` \| `force`
std::string usage_of(const Option& option) {
  const std::string flag = flag_of(option);
  if (std::vector<std::string> words = words_of(option); !words.empty()) {
    if (!option.sample.empty()) words.insert(words.begin(), option.sample);
    return fmt::format("`{} {}`", flag, fmt::join(words, "` \\| `"));
  }
  const std::size_t comma = flag.find(',');  // of -o,--output
  const std::string sample = option.sample.empty() ? "" : " " + option.sample;
  return fmt::format("`{}{}`", flag.substr(0, comma), sample);
}

// docs/priors.md -> [priors.md](priors.md)
std::string with_links(const std::string& text) {
  static const std::regex page("docs/([a-z-]+\\.md)");
  return std::regex_replace(text, page, "[$1]($1)");
}

// CLI11 would take 010 for 8.
template <typename T>
bool is_whole_number(const std::string& text) {
  T read = 0, meant = 0;
  const char* const end = text.data() + text.size();
  const auto [rest, error] = std::from_chars(text.data() + (text.starts_with('+') ? 1 : 0), end, meant);
  return error == std::errc() && rest == end && CLI::detail::lexical_cast(text, read) && read == meant;
}

// CLI11 would take -1, and what is larger than the largest number there is, for that number.
CLI::Validator not_negative() {
  const auto check = [](const std::string& text) {
    if (text.starts_with('-')) return "must not be negative, got " + text;
    std::uint64_t number = 0;
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), number);
    if (error == std::errc::result_out_of_range) return "must be below 2^64, got " + text;
    return text.empty() || is_whole_number<std::uint64_t>(text) ? "" : fmt::format("expected a whole number, got '{}'", text);
  };
  return {check, ""};
}

// Text that CLI11 can read as a number of this type. Of an empty one require_value() speaks.
template <typename T>
CLI::Validator number_of_type() {
  const auto check = [](const std::string& text) {
    if (text.empty()) return std::string();
    if constexpr (std::is_integral_v<T>) {
      if (is_whole_number<T>(text)) return std::string();
      return fmt::format("expected a whole number, at most {}, got '{}'", std::numeric_limits<T>::max(), text);
    } else {
      T number = 0;
      return CLI::detail::lexical_cast(text, number) ? std::string() : fmt::format("expected a number, got '{}'", text);
    }
  };
  return {check, ""};
}

CLI::Validator one_of(const std::vector<std::string>& words) {
  const auto check = [words](const std::string& text) {
    if (std::find(words.begin(), words.end(), text) != words.end()) return std::string();
    return fmt::format("'{}' is none of {}{}", text, fmt::join(words, ", "), suggestion(text, words));
  };
  return {check, ""};
}

/// A subcommand while its options are added and read.
class Parsing {
 public:
  Parsing(CLI::App& app, Command command) : app_(app), command_(std::move(command)) {
    for (const Option& option : command_.options) {
      CLI::Option* added = add(option);
      if (option.is_required) added->required();
      if (!option.needs.empty()) added->needs(added_.at(option.needs));
      added_[option.name] = added;
    }
  }

  [[nodiscard]] const Command& command() const { return command_; }

  void run() const {
    std::set<std::string> given;
    for (const Option& option : command_.options) {
      if (added_.at(option.name)->count() == 0) continue;
      given.insert(option.name);
      require_value(option);
      const auto text = texts_.find(option.name);
      if (text != texts_.end()) set_from_text(option, text->second);
    }
    if (given.contains("quiet")) be_quiet();
    take_streams(given);
    command_.run(given);
  }

 private:
  // An empty one, as of a shell variable that is not set, would count as not given. Of a file to write that is told elsewhere.
  void require_value(const Option& option) const {
    const std::string flag = flag_of(option);
    if (!flag.starts_with('-') || option.sample.empty() || option.name == "output") return;
    for (const std::string& value : added_.at(option.name)->results()) {
      if (value.empty()) throw UsageError{fmt::format("{}: expected a value such as {}, got ''", flag, option.sample)};
    }
  }

  // - is standard input or, of a file that is written, standard output; also in --data -@OTHER.toml and --also VIEW:-.
  void take_streams(const std::set<std::string>& given) const {
    int n_read = 0, n_written = 0;
    const auto take = [&](const Option& option, std::string& text) {
      if (option.name == "output" || option.name == "smoothed") {
        if (text != "-") return;
        text = "/dev/stdout";
        ++n_written;
        return;
      }
      const std::size_t colon = text.find(":-"), place = colon == std::string::npos ? 0 : colon + 1;
      if (text.substr(place) != "-" && !text.substr(place).starts_with("-@")) return;
      if (option.name == "checkpoint") throw UsageError{"--checkpoint is rewritten repeatedly: name a file instead of -"};
      text.replace(place, 1, "/dev/stdin");
      ++n_read;
    };
    for (const Option& option : command_.options) {
      if (!given.contains(option.name)) continue;
      std::visit(Overloaded{[&](std::string* text) { take(option, *text); },
                            [&](const Repeated& texts) {
                              for (std::string& text : *texts.values) take(option, text);
                            },
                            [&](NamedNumbers* numbers) { take(option, numbers->file); }, [](const auto&) {}},
                 option.value);
    }
    if (n_read > 1) throw UsageError{"standard input is read once, but - stands for several files: name all others"};
    if (n_written > 1) throw UsageError{"standard output is one file, but - stands for several: name all others"};
    if (n_written == 0) return;
    if (given.contains("json")) throw UsageError{"--json prints to standard output, which is the file too: name a file"};
    leave_stdout_to_a_file();
  }

  CLI::Option* add(const Option& option) {
    const std::string flag = flag_of(option), help = help_of(option);
    CLI::Option* added = std::visit(
        Overloaded{
            [&](bool* value) { return app_.add_flag(flag, *value, help); },
            [&](const YesByDefault& one) {
              return app_.add_flag(
                  flag, [one](std::int64_t n) { *one.value = n == 0; }, help);
            },
            [&](int* value) { return app_.add_option(flag, *value, help)->check(number_of_type<int>())->capture_default_str(); },
            [&](double* value) {
              return app_.add_option(flag, *value, help)->check(number_of_type<double>())->capture_default_str();
            },
            [&](std::string* value) { return app_.add_option(flag, *value, help); },
            [&](std::uint64_t* value) {
              return app_.add_option(flag, *value, help)->check(not_negative())->capture_default_str();
            },
            [&](std::optional<std::uint64_t>* value) { return app_.add_option(flag, *value, help)->check(not_negative()); },
            [&](const Repeated& one) {
              return app_.add_option(flag, *one.values, help)->allow_extra_args(!flag.starts_with('-'));
            },
            [&](const Choice& one) { return add_words(option, one.words, one.get()); },
            [&](const Switch& one) {
              return add_words(option, {one.on, one.off}, *one.value ? one.on : one.off);
            },
            [&]<typename T>(std::optional<T>* value) { return add_optional(option, value); },
            [&](const auto&) { return app_.add_option(flag, texts_[option.name], help); },
        },
        option.value);
    if (!option.sample.empty()) added->type_name(option.sample);
    return added;
  }

  CLI::Option* add_words(const Option& option, const std::vector<std::string>& words, const std::string& chosen) {
    std::string& text = texts_[option.name] = chosen;
    CLI::Option* added = app_.add_option(flag_of(option), text, help_of(option))->check(one_of(words));
    return chosen.empty() ? added : added->capture_default_str();
  }

  template <typename T>
  CLI::Option* add_optional(const Option& option, std::optional<T>* value) {
    if constexpr (std::is_same_v<T, std::vector<std::string>>) {
      return app_.add_option(flag_of(option), texts_[option.name], help_of(option));
    } else {
      CLI::Option* added = app_.add_option(flag_of(option), *value, help_of(option));
      if constexpr (std::is_arithmetic_v<T>) added->check(number_of_type<T>());
      return added;
    }
  }

  CLI::App& app_;
  const Command command_;
  std::map<std::string, CLI::Option*> added_;
  std::map<std::string, std::string> texts_;  // what was given for options that CLI11 leaves as text
};

}  // namespace

// "docs/priors.md" stays in help; `seed` becomes --seed
std::string help_of(const Option& option) {
  std::string text = with_flags(option.text);
  if (std::holds_alternative<YesByDefault>(option.value)) text = "leave out " + text;
  if (!option.otherwise.empty()) text += fmt::format(" (default: {})", option.otherwise);
  return text;
}

std::vector<std::string> words_of(const Option& option) {
  return std::visit(Overloaded{[](const Choice& one) { return one.words; },
                               [](const Switch& one) {
                                 return std::vector<std::string>{one.on, one.off};
                               },
                               [](const NumberOrWord& one) {
                                 std::vector<std::string> words;
                                 for (const auto& [word, flag] : one.words) words.push_back(word);
                                 return words;
                               },
                               [](const auto&) { return std::vector<std::string>(); }},
                    option.value);
}

std::string default_of(const Option& option) {
  return std::visit(
      Overloaded{[&](const Choice& one) { return one.get(); }, [&](const Switch& one) { return *one.value ? one.on : one.off; },
                 [](int* number) { return std::to_string(*number); },
                 [](std::uint64_t* number) { return std::to_string(*number); },
                 [](double* number) { return fmt::format("{}", *number); }, [](const auto&) { return std::string(); }},
      option.value);
}

std::size_t help_width() {
  constexpr std::size_t usual = 80, readable = 110;
  winsize size = {};
  if (ioctl(STDOUT_FILENO, TIOCGWINSZ, &size) != 0 || size.ws_col == 0) return usual;
  return std::clamp<std::size_t>(size.ws_col, 40, readable);
}

std::string unknown_option(const CLI::App& app) {
  for (const CLI::App* command : app.get_subcommands()) {
    std::vector<std::string> names;
    for (const CLI::Option* option : command->get_options()) {
      for (const std::string& name : option->get_lnames()) names.push_back(name);
    }
    for (const std::string& given : command->remaining()) {
      if (given.size() < 2 || given[0] != '-') continue;
      const std::string flag = given.substr(0, given.find('='));
      const std::string name = flag.substr(std::min(flag.find_first_not_of('-'), flag.size()));
      return fmt::format("gp2 {} has no option {}{}", command->get_name(), flag, suggestion(name, names, "--"));
    }
  }
  return "";
}

std::string in_plain_words(const std::string& error) {
  static const std::regex several(R"((\S+): At Most \d+ required but received (\d+))"),
      none(R"((\S+): \d+ required \S+ missing)");
  static const std::regex output("^--output\\b");
  std::smatch part;
  std::string text = error;
  if (std::regex_match(error, part, several)) {
    text = fmt::format("{} is given {}", part.str(1), part.str(2) == "2" ? "twice" : part.str(2) + " times");
  } else if (std::regex_match(error, part, none)) {
    text = part.str(1) + ": its value is missing";
  }
  return std::regex_replace(text, output, "-o (--output)");
}

void add_command(CLI::App& app, Command command) {
  CLI::App* subcommand = app.add_subcommand(command.name, command.text);
  const auto parsing = std::make_shared<Parsing>(*subcommand, std::move(command));
  subcommand->formatter_fn([parsing](auto&&...) { return help_page(parsing->command(), help_width()); });
  subcommand->callback([parsing] { parsing->run(); });
  // for scripts/options; like --version it asks for nothing else
  subcommand->set_version_flag("--options-as-markdown", [parsing] { return markdown_table(parsing->command()); })->group("");
}

std::string markdown_table(const Command& command) {
  std::string table = "| option | default | |\n|---|---|---|\n";
  for (const Option& option : command.options) {
    if (option.name == "quiet") continue;  // of all commands, said once
    const std::string usage = usage_of(option);
    std::string otherwise = option.is_required ? "required" : option.otherwise;
    if (otherwise.empty()) {
      otherwise = default_of(option);
      if (!otherwise.empty() && !words_of(option).empty()) otherwise = "`" + otherwise + "`";
    }
    std::string text = with_flags(option.text);
    if (std::holds_alternative<YesByDefault>(option.value)) text = "leave out " + text;
    table += fmt::format("| {} | {} | {} |\n", usage, otherwise, with_links(text));
  }
  return table;
}

}  // namespace gp2::command
