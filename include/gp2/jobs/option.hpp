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

/// One word of several, for an enumeration.
struct Choice {
  std::vector<std::string> words;
  std::function<std::string()> get;             // the word chosen; empty: none
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

/// Yes or no, by words where an option is written as text.
struct Switch {
  bool* value;
  std::string on, off;
};

/// Yes unless a flag --no-NAME says otherwise.
struct YesByDefault {
  bool* value;
};

/// A number, or a word that sets something else.
struct NumberOrWord {
  std::optional<double>* number;
  std::vector<std::pair<std::string, bool*>> words;
};

/// Numbers by name, from a file or as they are.
struct NamedNumbers {
  std::string file;  // {"name": value, …} as JSON, or a FIT.json; empty: `values`
  std::map<std::string, double> values;

  [[nodiscard]] bool empty() const { return file.empty() && values.empty(); }
};

/// Texts that are given one at a time: --data A.csv --data B.csv.
struct Repeated {
  std::vector<std::string>* values;
};

/// Where the value of an option stands, and of what kind it is.
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
  OptionValue value;           // where it stands in the request
  std::string sample;          // what stands for a value in a usage line: S, ddq3,ddq6, FILE
  std::string text;            // what it is, in a sentence
  std::string otherwise = {};  // what holds where it is not given and the value does not say it
  std::string keyword = {};    // Python's name where it is another
  std::string flag = {};       // the command's where it is another: -o,--output; MODEL for an argument by position
  std::string needs = {};      // another option without which it means nothing
  bool is_required = false;
  bool is_recorded = true;  // in FIT.json: the result depends on it
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

/// An option on which no result depends.
inline Option not_recorded(Option option) {
  option.is_recorded = false;
  return option;
}

/// "threads", alike in every job.
Option threads_option(int& threads);
/// @throws InputError when it is negative.
void require_threads(int threads);
/// "map", in every job that reads a log.
Option columns_option(std::map<std::string, std::string>& columns, const std::string& text = "columns by other names");

/// The entry of a name; null where there is none.
const Option* find_option(const std::vector<Option>& options, const std::string& name);

/// The values of options as a JSON object. Those without a value are left out: not given, an empty list, a flag not set.
std::string options_json(const std::vector<Option>& options);

/// Reads options_json back.
/// @param source  stands for the file in messages
/// @throws InputError naming a key that is unknown, or has a value of the wrong kind.
void read_options(const std::string& json, const std::vector<Option>& options, const std::string& source);

/// Messages below the faces name an option in backticks, by itself or with a value: `noise_std`, `noise_std=estimate`. A face
/// respells them in its own way.
/// @param spell  (name, value or nothing) -> its words
std::string respelled(const std::string& message,
                      const std::function<std::string(const std::string&, const std::optional<std::string>&)>& spell);

/// A face's way, of a whole message.
using Spelling = std::function<std::string(const std::string& message)>;

}  // namespace gp2
