#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

#include "gp2/export.hpp"

namespace gp2 GP2_API {

/// A value that is one word of a fixed set, for an enumeration.
struct Choice {
  std::vector<std::string> words;
  std::function<std::string()> get;             // the chosen word; empty: none
  std::function<void(const std::string&)> set;  // takes one of `words`
};
/// @param value  an enumeration, or an optional one
template <typename Value>
Choice choice(Value& value, const std::vector<std::pair<std::string, std::type_identity_t<Value>>>& words) {
  Choice out;
  for (const auto& [word, meaning] : words) out.words.push_back(word);
  out.get = [&value, words] {
    for (const auto& [word, meaning] : words) {
      if (meaning == value) return word;
    }
    return std::string();
  };
  out.set = [&value, words](const std::string& given) {
    for (const auto& [word, meaning] : words) {
      if (word == given) value = meaning;
    }
  };
  return out;
}

/// A Boolean that is written as one of two words, such as on and off.
struct Switch {
  bool* value;
  std::string on, off;
};

/// A Boolean that is true unless the flag --no-NAME is given.
struct YesByDefault {
  bool* value;
};

/// A number, or one of several words, each of which sets a Boolean of its own.
struct NumberOrWord {
  std::optional<double>* number;
  std::vector<std::pair<std::string, bool*>> words;
};

/// Numbers by name, given directly or read from a file.
struct NamedNumbers {
  std::string file;  // {"name": value, …} as JSON, or a FIT.json; empty: `values`
  std::map<std::string, double> values;

  [[nodiscard]] bool empty() const { return file.empty() && values.empty(); }
};

/// Texts that are given by repeating the option: --data A.csv --data B.csv.
struct Repeated {
  std::vector<std::string>* values;
};

/// Points to the value of an option; the alternative held is the kind of that value.
using OptionValue =
    std::variant<bool*, int*, std::uint64_t*, double*, std::string*,                             //
                 std::optional<int>*, std::optional<std::uint64_t>*, std::optional<double>*,     //
                 std::optional<std::string>*, std::vector<std::string>*,                         //
                 std::optional<std::vector<std::string>>*, std::map<std::string, std::string>*,  //
                 std::map<std::string, int>*, NamedNumbers*, Choice, Switch, YesByDefault, NumberOrWord, Repeated>;

/// A visitor of OptionValue: one function for each kind.
template <typename... Cases>
struct Overloaded : Cases... {
  using Cases::operator()...;
};
template <typename... Cases>
Overloaded(Cases...) -> Overloaded<Cases...>;

/// One entry of a job's table of options: `std::vector<Option> options(Request&)`. From this table come the options of the
/// command, the keywords of Python with their docstrings and stubs, `options` in FIT.json, and the tables of the documentation.
/// The default is the value of a new request.
struct Option {
  std::string name;            // in snake_case: noise_std, which the command spells --noise-std
  OptionValue value;           // points to the value in the request
  std::string sample;          // placeholder of the value in a usage line: S, ddq3,ddq6, FILE
  std::string text;            // description, one sentence
  std::string otherwise = {};  // description of the default, if the value of a new request does not show it
  std::string keyword = {};    // keyword in Python, if it is not the name
  std::string flag = {};       // flag of the command, if it is not the name: -o,--output; MODEL for a positional argument
  std::string needs = {};      // another option that this one requires
  bool is_required = false;
  bool is_recorded = true;  // whether FIT.json stores it, because the result depends on it
  std::string group = {};   // heading in --help; empty: Options
};

/// Options under one heading of --help.
inline std::vector<Option> in_group(const std::string& heading, std::vector<Option> options) {
  for (Option& option : options) option.group = heading;
  return options;
}
inline std::vector<Option> joined(const std::vector<std::vector<Option>>& tables) {
  std::vector<Option> all;
  for (const std::vector<Option>& table : tables) all.insert(all.end(), table.begin(), table.end());
  return all;
}

/// The same option, not stored in FIT.json because no result depends on it.
inline Option not_recorded(Option option) {
  option.is_recorded = false;
  return option;
}

/// The option `threads`, the same in every job.
Option threads_option(int& threads);
/// @throws InputError if it is negative.
void require_threads(int threads);
/// The option `map` of every job that reads a log.
Option columns_option(std::map<std::string, std::string>& columns, const std::string& text = "columns by other names");

/// The option with this name; null if there is none.
const Option* find_option(const std::vector<Option>& options, const std::string& name);

/// The values of options as a JSON object. Options without a value are left out: not given, an empty list, a flag that is not set.
std::string options_json(const std::vector<Option>& options);

/// Sets options to values that options_json wrote.
/// @param source  name of the file, for messages
/// @throws InputError that names a key that is unknown or has a value of the wrong kind.
void read_options(const std::string& json, const std::vector<Option>& options, const std::string& source);

/// The message with each option in the spelling of the command or of Python. The library names an option in backticks, alone or
/// with a value: `noise_std`, `noise_std=estimate`.
/// @param spell  (name, value if there is one) -> the spelling
std::string respelled(const std::string& message,
                      const std::function<std::string(const std::string&, const std::optional<std::string>&)>& spell);

/// Gives the options in a whole message the spelling of the command or of Python.
using Spelling = std::function<std::string(const std::string& message)>;

}  // namespace gp2
