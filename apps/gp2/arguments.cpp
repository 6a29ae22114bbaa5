#include <cctype>
#include <charconv>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <optional>
#include <system_error>
#include <variant>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/base/file.hpp"
#include "gp2/error.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

// {"q1", "0.4"} of "q1=0.4"; nothing where there is no =
std::optional<std::pair<std::string, std::string>> split_at_equals(const std::string& item) {
  const std::size_t equals = item.find('=');
  if (equals == std::string::npos) return std::nullopt;
  return std::pair(item.substr(0, equals), item.substr(equals + 1));
}

}  // namespace

std::vector<std::string> parse_list(const std::string& text, const std::string& option) {
  std::vector<std::string> items;
  int depth = 0;
  std::string item;
  for (const char c : text + ",") {
    if (c == '(') ++depth;
    if (c == ')') --depth;
    if (c != ',' || depth > 0) {
      item += c;
      continue;
    }
    const std::size_t first = item.find_first_not_of(' ');
    if (first != std::string::npos) items.push_back(item.substr(first, item.find_last_not_of(' ') + 1 - first));
    item.clear();
  }
  if (!item.empty()) throw InputError(fmt::format("{}: a parenthesis is not closed in '{}'", option, text));
  return items;
}

std::map<std::string, int> parse_counts(const std::string& text, const std::string& option) {
  std::map<std::string, int> counts;
  for (const std::string& item : parse_list(text, option)) {
    const auto [name, written] = split_at_equals(item).value_or(std::pair<std::string, std::string>());
    int n = 0;
    const char* const end = written.data() + written.size();
    const auto [rest, error] = std::from_chars(written.data(), end, n);
    if (name.empty() || rest != end || error != std::errc()) {
      throw InputError(fmt::format("{}: '{}' is not RANGE=POINTS, say q1=5", option, item));
    }
    if (!counts.emplace(name, n).second) throw InputError(fmt::format("{}: '{}' stands twice", option, name));
  }
  return counts;
}

std::map<std::string, std::string> parse_map(const std::string& text) {
  std::map<std::string, std::string> columns;
  for (const std::string& item : parse_list(text, "--map")) {
    const auto [column, name] = split_at_equals(item).value_or(std::pair<std::string, std::string>());
    if (column.empty() || name.empty()) {
      throw InputError(fmt::format("--map: '{}' is not LOGNAME=MODELNAME, say theta1=q3", item));
    }
    const auto [twice, is_new] = columns.emplace(name, column);
    if (!is_new) throw InputError(fmt::format("--map: '{}' is given two columns, '{}' and '{}'", name, twice->second, column));
  }
  return columns;
}

namespace {

// nothing where it is no finite number
std::optional<double> finite_number(const std::string& text) {
  char* end = nullptr;
  const double value = std::strtod(text.c_str(), &end);
  return text.empty() || *end != '\0' || !std::isfinite(value) ? std::nullopt : std::optional(value);
}

std::map<std::string, double> parse_start(const std::string& text) {
  std::map<std::string, double> start;
  for (const std::string& item : parse_list(text, "--start")) {
    const auto entry = split_at_equals(item);
    if (!entry) throw InputError(fmt::format("--start: '{}' is not NAME=VALUE, say q1=0.4", item));
    const auto& [name, written] = *entry;
    const std::optional<double> value = finite_number(written);
    if (!value) throw InputError(fmt::format("--start: {} = '{}' is not a finite number", name, written));
    if (!start.emplace(name, *value).second) throw InputError(fmt::format("--start: '{}' is given twice", name));
  }
  return start;
}

}  // namespace

Limits parse_limits(const std::string& text, const std::string& option) {
  Limits limits;
  for (const std::string& item : parse_list(text, option)) {
    const auto entry = split_at_equals(item);
    const std::size_t colon = entry ? entry->second.find(':') : std::string::npos;
    if (colon == std::string::npos)
      throw InputError(fmt::format("{}: '{}' is not NAME=LOWEST:HIGHEST, say u1=-5:5", option, item));
    const auto& [name, range] = *entry;
    const std::optional<double> lower = finite_number(range.substr(0, colon)), upper = finite_number(range.substr(colon + 1));
    if (!lower || !upper) throw InputError(fmt::format("{}: {} = '{}' is not two finite numbers", option, name, range));
    if (!limits.emplace(name, std::pair(*lower, *upper)).second) {
      throw InputError(fmt::format("{}: '{}' is given twice", option, name));
    }
  }
  return limits;
}

MotionStart read_start(const std::string& text) {
  if (text.find('=') != std::string::npos) return parse_start(text);
  return CsvTable::read(text, CsvTable::Keep::numbers);
}

Option start_option(std::string& value) {
  return required(
      {"start", &value, "NAME=VALUE,… or CSV",
       "coordinates and velocities, or a CSV whose first row is used; values not given follow from the constraints or are 0"});
}

void require_output(const std::string& output, const std::vector<std::string>& inputs, const char* option) {
  if (output.empty()) throw InputError(fmt::format("{}: expected the name of a file, got ''", option));
  const std::filesystem::path folder = std::filesystem::path(output).parent_path();
  std::error_code not_there;
  if (!folder.empty() && !std::filesystem::is_directory(folder, not_there)) {
    throw InputError(fmt::format("{} {}: there is no folder '{}'; make it first", option, output, folder.string()));
  }
  require_writable(output);
  if (!std::filesystem::is_regular_file(output, not_there)) return;
  for (const std::string& input : inputs) {
    if (std::filesystem::equivalent(output, input, not_there)) {
      throw InputError(
          fmt::format("{} {}: that is the input {}, which would be lost; write to another file", option, output, input));
    }
  }
}

void make_folder(const std::string& output) {
  std::error_code error;
  std::filesystem::create_directories(output, error);
  if (error) throw InputError(fmt::format("-o {}: the folder cannot be made: {}", output, error.message()));
}

bool is_fit(const std::string& text) {
  const std::size_t first = text.find_first_not_of(" \t\r\n");
  return first != std::string::npos && text[first] == '{';
}

std::shared_ptr<const Model> read_other_system(const std::string& path) {
  return path.empty() ? nullptr : std::make_shared<const Model>(Model::read(path));
}

std::pair<std::string, std::string> split_at_system(const std::string& text) {
  const std::size_t last = text.rfind('@');
  if (last == std::string::npos || !text.ends_with(".toml")) return {text, ""};
  // an @ may be part of a name: where both files are there is the right one
  for (std::size_t at = last; at != std::string::npos && at > 0; at = text.rfind('@', at - 1)) {
    std::error_code unknown;
    const std::string log = text.substr(0, at), system = text.substr(at + 1);
    if (std::filesystem::exists(log, unknown) && std::filesystem::exists(system, unknown)) return {log, system};
  }
  return {text.substr(0, last), text.substr(last + 1)};
}

void require_own_system(const std::string& text, const std::string& why) {
  const std::string model = split_at_system(text).second;
  if (model.empty()) return;
  throw InputError(fmt::format("--data: '{}' is of another system, '{}', than the fit: {}", text, model, why));
}

namespace {

Option positional(const std::string& flag, const OptionValue& value, const std::string& text) {
  Option option{"", value, "", text};
  for (const char c : flag) option.name += static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  option.flag = flag;
  return required(std::move(option));
}

}  // namespace

Option argument(const std::string& flag, std::string& value, const std::string& text) { return positional(flag, &value, text); }

Option arguments(const std::string& flag, std::vector<std::string>& values, const std::string& text) {
  return positional(flag, Repeated{&values}, text);
}

Option output(std::string& value, const std::string& sample, const std::string& text) {
  Option option{"output", &value, sample, text};
  option.flag = "-o,--output";
  return required(std::move(option));
}

Option required(Option option) {
  option.is_required = true;
  return option;
}

std::string flag_of(const Option& option) {
  if (!option.flag.empty()) return option.flag;
  std::string flag = std::holds_alternative<YesByDefault>(option.value) ? "--no-" : "--";
  for (const char c : option.name) flag += c == '_' ? '-' : c;
  return flag;
}

std::string with_flags(const std::string& message) {
  return respelled(message, [](const std::string& name, const std::optional<std::string>& value) {
    const std::string flag = flag_of(Option{name, static_cast<bool*>(nullptr), "", ""});
    return value ? flag + " " + *value : flag;
  });
}

void print_notes(const std::vector<std::string>& notes) {
  for (const std::string& note : notes) {
    if (!is_quiet() || note.starts_with("warning")) print_message("gp2: {}\n", with_flags(note));
  }
}

}  // namespace gp2::command
