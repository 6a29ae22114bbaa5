#include "pages.hpp"

#include <algorithm>
#include <utility>
#include <variant>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command_line.hpp"
#include "gp2/base/version.hpp"

namespace gp2::command {

namespace {

constexpr std::string_view exit_codes =
    "0 done, 1 numerical failure, 2 bad input, 128 + n ended by signal n (130 Ctrl-C, 143 SIGTERM; gp2 fit, excite and simulate "
    "save what there is so far). Results go to stdout, messages to stderr.";
constexpr std::string_view example =
    "gp2 generate models/surface.toml --n 100 -o train.csv\n"
    "gp2 fit models/surface.toml --data train.csv -o fit.json\n"
    "gp2 predict fit.json --states train.csv --cov std -o prediction.csv";

// What main adds to the table: flag and text.
using Row = std::pair<std::string, std::string>;
const std::vector<Row>& rows_of_gp2() {
  static const std::vector<Row> rows = {
      {"-h, --help", "show this page; for a command: gp2 help COMMAND"},
      {"-V, --version", "the version"},
      {"--verbose", "with --version: also the compiler, the BLAS and the processor features it uses"},
  };
  return rows;
}

bool is_positional(const Option& option) { return !flag_of(option).starts_with('-'); }
bool is_flag(const Option& option) {
  return std::holds_alternative<bool*>(option.value) || std::holds_alternative<YesByDefault>(option.value);
}
bool may_be_a_file(const Option& option) {
  return std::holds_alternative<std::string*>(option.value) || std::holds_alternative<Repeated>(option.value) ||
         std::holds_alternative<NamedNumbers*>(option.value);
}

// {"-o", "--output"}
std::vector<std::string> spellings_of(const Option& option) {
  const std::string flag = flag_of(option);
  const std::size_t comma = flag.find(',');
  if (comma == std::string::npos) return {flag};
  return {flag.substr(0, comma), flag.substr(comma + 1)};
}

// What stands behind the flag: CSV, zero|force.
std::string value_of(const Option& option) {
  if (const std::vector<std::string> words = words_of(option); !words.empty()) {
    const std::string number = option.sample.empty() ? "" : option.sample + "|";
    return number + fmt::format("{}", fmt::join(words, "|"));
  }
  return option.sample;
}

std::string usage_of(const Command& command) {
  std::string positional, required;
  bool has_options = false;
  for (const Option& option : command.options) {
    if (is_positional(option)) {
      const std::string name = flag_of(option) + (std::holds_alternative<Repeated>(option.value) ? "…" : "");
      positional += option.is_required ? " " + name : " [" + name + "]";
    } else if (option.is_required) {
      required += fmt::format(" {} {}", spellings_of(option)[0], value_of(option));
    } else {
      has_options = true;
    }
  }
  return fmt::format("gp2 {}{}{}{}", command.name, positional, required, has_options ? " [options]" : "");
}

Row row_of(const Option& option) {
  std::string text = help_of(option);
  if (option.otherwise.empty() && !option.is_required) {
    if (const std::string value = default_of(option); !value.empty()) text += fmt::format(" (default: {})", value);
  }
  if (option.is_required && !is_positional(option)) text += " (required)";
  if (!option.needs.empty()) text += fmt::format(" (with --{})", option.needs);
  if (is_positional(option)) return {flag_of(option), text};
  const std::string value = value_of(option);
  return {fmt::format("{}{}{}", fmt::join(spellings_of(option), ", "), value.empty() ? "" : " ", value), text};
}

// Options under their headings, in the order in which these first occur.
std::vector<std::pair<std::string, std::vector<Row>>> groups_of(const Command& command) {
  std::vector<std::pair<std::string, std::vector<Row>>> groups;
  const auto add = [&](const std::string& heading, Row row) {
    const auto same = std::find_if(groups.begin(), groups.end(), [&](const auto& group) { return group.first == heading; });
    (same == groups.end() ? groups.emplace_back(heading, std::vector<Row>()) : *same).second.push_back(std::move(row));
  };
  for (const Option& option : command.options) {
    add(is_positional(option) ? "Arguments" : option.group.empty() ? "Options" : option.group, row_of(option));
  }
  add("Options", {"-h, --help", "this page"});
  return groups;
}

std::vector<Row> rows_of(const std::vector<Command>& commands) {
  std::vector<Row> rows;
  for (const Command& command : commands) rows.emplace_back(command.name, command.text);
  return rows;
}

// ---------------------------------------------------------------- help

// characters, where each takes one column
std::size_t columns_of(std::string_view text) {
  return static_cast<std::size_t>(std::count_if(text.begin(), text.end(), [](char c) { return (c & 0xC0) != 0x80; }));
}

// Words of a text in lines up to `width`, the second and further ones indented; the first begins at column `at`.
std::string wrapped(std::string_view text, std::size_t at, std::size_t indent, std::size_t width) {
  std::string out;
  std::size_t column = at;
  bool is_first = true;
  while (!text.empty()) {
    const std::size_t space = std::min(text.find(' '), text.size());
    const std::string_view word = text.substr(0, space);
    text.remove_prefix(std::min(space + 1, text.size()));
    const std::size_t length = columns_of(word);
    if (!is_first && column + 1 + length > width) {
      out += "\n" + std::string(indent, ' ');
      column = indent;
    } else if (!is_first) {
      out += ' ';
      ++column;
    }
    out += word;
    column += length;
    is_first = false;
  }
  return out + "\n";
}

std::string table_of(const std::string& heading, const std::vector<Row>& rows, std::size_t width) {
  constexpr std::size_t widest = 24;
  std::size_t name_width = 0;
  for (const Row& row : rows) name_width = std::max(name_width, std::min(widest, columns_of(row.first)));
  std::string out = "\n" + heading + ":\n";
  const std::size_t indent = name_width + 4;
  for (const auto& [name, text] : rows) {
    const bool fits = columns_of(name) <= name_width;
    out += "  " + (fits ? name : wrapped(name, 2, 6, width));
    out += std::string(fits ? indent - 2 - columns_of(name) : indent, ' ') + wrapped(text, indent, indent, width);
  }
  return out;
}

std::string indented(std::string_view lines) {
  std::string out = "  ";
  for (const char c : lines) out += c == '\n' ? "\n  " : std::string(1, c);
  return out + "\n";
}

// ---------------------------------------------------------------- man pages

// What troff would take for a request or an escape.
std::string troff(std::string_view text) {
  std::string out;
  bool at_start = true;
  for (const char c : text) {
    if (at_start && (c == '.' || c == '\'')) out += "\\&";
    out += c == '\\' ? "\\e" : c == '-' ? "\\-" : std::string(1, c);
    at_start = c == '\n';
  }
  return out;
}

std::string man_rows(const std::string& heading, const std::vector<Row>& rows) {
  std::string out = fmt::format(".SS {}\n", troff(heading));
  for (const auto& [name, text] : rows) out += fmt::format(".TP\n.B {}\n{}\n", troff(name), troff(text));
  return out;
}

std::string man_head(const std::string& name, std::string_view text, const std::string& usage) {
  std::string title = name;
  for (char& c : title) c = static_cast<char>(c >= 'a' && c <= 'z' ? c - 'a' + 'A' : c);
  return fmt::format(".TH {} 1 \"\" \"gp2 {}\" \"gp2\"\n.SH NAME\n{} \\- {}\n.SH SYNOPSIS\n{}\n.SH OPTIONS\n", troff(title),
                     version(), troff(name), troff(text), troff(usage));
}

std::string man_foot(std::string_view examples, const std::string& see_also) {
  return fmt::format(".SH EXIT STATUS\n{}\n.SH EXAMPLES\n.nf\n{}\n.fi\n.SH SEE ALSO\n{}\n", troff(exit_codes), troff(examples),
                     see_also);
}

// ---------------------------------------------------------------- completion

// The beginning of a text, for menus.
std::string brief(const std::string& text) {
  const std::size_t end = std::min({text.find(": "), text.find("; "), text.find(". "), text.find(" ("), text.size()});
  return text.substr(0, end);
}

// A text between single quotes, with what it holds of them escaped.
std::string quoted(const std::string& text, const std::string& for_quote) {
  std::string out = "'";
  for (const char c : text) out += c == '\'' ? for_quote : std::string(1, c);
  return out + "'";
}

std::vector<std::string> names_of(const std::vector<Command>& commands) {
  std::vector<std::string> names;
  for (const Command& command : commands) names.push_back(command.name);
  return names;
}

std::string bash_case(const Command& command) {
  std::string options = "-h --help", cases, numbers;
  for (const Option& option : command.options) {
    const std::vector<std::string> spellings = spellings_of(option);
    const std::vector<std::string> words = words_of(option);
    if (is_positional(option)) {
      if (!words.empty()) cases += fmt::format("        *) words='{}' ;;\n", fmt::join(words, " "));
      continue;
    }
    options += fmt::format(" {}", fmt::join(spellings, " "));
    if (!words.empty()) {
      cases = fmt::format("        {}) words='{}' ;;\n", fmt::join(spellings, "|"), fmt::join(words, " ")) + cases;
    } else if (!is_flag(option) && !may_be_a_file(option)) {
      numbers += fmt::format("{}{}", numbers.empty() ? "" : "|", fmt::join(spellings, "|"));
    }
  }
  if (!numbers.empty()) cases = fmt::format("        {}) compopt +o default; return ;;\n", numbers) + cases;
  return fmt::format("    {})\n      options='{}'\n{}      ;;\n", command.name, options,
                     cases.empty() ? "" : fmt::format("      case $before in\n{}      esac\n", cases));
}

std::string bash_script(const std::vector<Command>& commands) {
  std::string cases;
  for (const Command& command : commands) cases += bash_case(command);
  return fmt::format(R"(# bash completion of gp2 {}
_gp2() {{
  local word=$2 before=$3 options='' words=''
  case ${{COMP_WORDS[1]}} in
{}  esac
  if ((COMP_CWORD == 1)); then
    options='-h --help -V --version --verbose'
    words='{}'
  fi
  if [[ $word == -* ]]; then words=$options; fi
  mapfile -t COMPREPLY < <(compgen -W "$words" -- "$word")
}}
complete -o default -F _gp2 gp2
)",
                     version(), cases, fmt::join(names_of(commands), " "));
}

// Of a text that _arguments and _describe take apart at colons and brackets.
std::string zsh_text(const std::string& text) {
  std::string out;
  for (const char c : text) out += (c == ':' || c == '[' || c == ']' || c == '\\' ? "\\" : "") + std::string(1, c);
  return out;
}

std::string zsh_argument(const Option& option) {
  const std::vector<std::string> words = words_of(option);
  const std::string action = !words.empty() ? fmt::format("({})", fmt::join(words, " ")) : may_be_a_file(option) ? "_files" : " ";
  const std::string value = is_flag(option) ? "" : fmt::format(":{}:{}", zsh_text(brief(option.sample)), action);
  const std::string text = zsh_text(brief(help_of(option)));
  if (is_positional(option)) return quoted(fmt::format(":{}:{}", text, action), "'\\''");
  std::string out;
  for (const std::string& flag : spellings_of(option)) {
    const char* often = std::holds_alternative<Repeated>(option.value) ? "*" : "";
    out += (out.empty() ? "" : " ") + quoted(fmt::format("{}{}[{}]{}", often, flag, text, value), "'\\''");
  }
  return out;
}

std::string zsh_script(const std::vector<Command>& commands) {
  std::vector<std::string> described;
  std::string cases;
  for (const Command& command : commands) {
    described.push_back(quoted(command.name + ":" + zsh_text(brief(command.text)), "'\\''"));
    cases += fmt::format("    {})\n      _arguments '(- *)'{{-h,--help}}'[help]'", command.name);
    for (const Option& option : command.options) cases += " \\\n        " + zsh_argument(option);
    cases += "\n      ;;\n";
  }
  return fmt::format(R"(#compdef gp2
# zsh completion of gp2 {}
_gp2() {{
  local -a commands=(
    {}
  )
  if ((CURRENT == 2)); then
    _describe command commands
    _arguments '(- *)'{{-h,--help}}'[help]' '(-V --version)'{{-V,--version}}'[version]' '--verbose[with --version]'
    return
  fi
  local command=$words[2]
  shift words
  ((CURRENT--))
  case $command in
{}  esac
}}
if [[ $zsh_eval_context[-1] == loadautofunc ]]; then _gp2 "$@"; else compdef _gp2 gp2; fi
)",
                     version(), fmt::join(described, "\n    "), cases);
}

std::string fish_script(const std::vector<Command>& commands) {
  const auto text_of = [](const std::string& text) { return quoted(brief(text), "\\'"); };
  std::string out = fmt::format(
      "# fish completion of gp2 {}\ncomplete -c gp2 -n __fish_use_subcommand -f -s h -l help -d help\n"
      "complete -c gp2 -n __fish_use_subcommand -f -s V -l version -d version\n",
      version());
  for (const Command& command : commands) {
    out += fmt::format("complete -c gp2 -n __fish_use_subcommand -f -a {} -d {}\n", command.name, text_of(command.text));
    const std::string here = fmt::format("complete -c gp2 -n '__fish_seen_subcommand_from {}'", command.name);
    for (const Option& option : command.options) {
      const std::vector<std::string> words = words_of(option);
      std::string line = here;
      if (!is_positional(option)) {
        for (const std::string& flag : spellings_of(option)) {
          line += flag.starts_with("--") ? " -l " + flag.substr(2) : " -s " + flag.substr(1);
        }
        if (!is_flag(option)) line += may_be_a_file(option) ? " -r -F" : " -x";
      } else if (words.empty()) {
        continue;  // fish offers files by itself
      }
      if (!words.empty()) line += fmt::format("{} -a '{}'", is_positional(option) ? " -f" : "", fmt::join(words, " "));
      out += fmt::format("{} -d {}\n", line, text_of(help_of(option)));
    }
    out += here + " -f -s h -l help -d help\n";
  }
  return out;
}

}  // namespace

std::string help_page(const Command& command, std::size_t width) {
  std::string out = "Usage: " + wrapped(usage_of(command), 7, 11, width) + "\n" + wrapped(command.text + ".", 0, 0, width);
  for (const auto& [heading, rows] : groups_of(command)) out += table_of(heading, rows, width);
  return out + "\nExample:\n" + indented(command.example);
}

std::string help_page(const std::vector<Command>& commands, std::size_t width) {
  return "Usage: gp2 COMMAND [options]\n\n" + wrapped(summary, 0, 0, width) + table_of("Commands", rows_of(commands), width) +
         table_of("Options", rows_of_gp2(), width) + "\nExample:\n" + indented(example) +
         "\nExit codes: " + wrapped(exit_codes, 12, 0, width);
}

std::string man_page(const Command& command) {
  std::string out = man_head("gp2-" + command.name, brief(command.text), usage_of(command));
  out.insert(out.find(".SH OPTIONS"), fmt::format(".SH DESCRIPTION\n{}.\n", troff(command.text)));
  for (const auto& [heading, rows] : groups_of(command)) out += man_rows(heading, rows);
  return out + man_foot(command.example, ".BR gp2 (1)");
}

std::string man_page(const std::vector<Command>& commands) {
  std::vector<std::string> pages;
  for (const std::string& name : names_of(commands)) pages.push_back(fmt::format(".BR gp2\\-{} (1)", name));
  return man_head("gp2", summary.substr(0, summary.find(',')), "gp2 COMMAND [options]") +
         man_rows("Commands", rows_of(commands)) + man_rows("Options", rows_of_gp2()) +
         man_foot(example, fmt::format("{}", fmt::join(pages, ",\n")));
}

std::string completion_script(const std::string& shell, const std::vector<Command>& commands) {
  return shell == "bash" ? bash_script(commands) : shell == "zsh" ? zsh_script(commands) : fish_script(commands);
}

}  // namespace gp2::command
