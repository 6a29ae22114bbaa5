#include "options.hpp"

#include <algorithm>
#include <string_view>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <pybind11/stl.h>

#include "bindings.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/derive.hpp"
#include "gp2/jobs/excite_job.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/generate_job.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/jobs/raw_fit.hpp"
#include "gp2/jobs/resample.hpp"
#include "gp2/jobs/shoot_job.hpp"
#include "gp2/jobs/simulate_job.hpp"

namespace gp2::python {

namespace {

std::vector<std::string> quoted(std::vector<std::string> words) {
  for (std::string& word : words) word = "'" + word + "'";
  return words;
}

std::vector<std::string> words_of(const NumberOrWord& one) {
  std::vector<std::string> words;
  for (const auto& [word, flag] : one.words) words.push_back(word);
  return words;
}

std::string one_of(py::handle given, const std::vector<std::string>& words, const std::string& name) {
  const auto word = argument<std::string>(given, name, "a str");
  if (std::find(words.begin(), words.end(), word) == words.end()) {
    throw InputError(fmt::format("{}: expected one of {}, got '{}'", name, fmt::join(quoted(words), ", "), word));
  }
  return word;
}

void read_number_or_word(py::handle given, const NumberOrWord& one, const std::string& name) {
  if (!py::isinstance<py::str>(given)) {
    *one.number = argument<double>(given, name, fmt::format("a positive number, {}", fmt::join(quoted(words_of(one)), " or ")));
    return;
  }
  const std::string word = one_of(given, words_of(one), name);
  for (const auto& [known, flag] : one.words) *flag = known == word;
}

void read_named_numbers(py::handle given, NamedNumbers& numbers, const std::string& name) {
  const py::object value = as_dict(py::reinterpret_borrow<py::object>(given));
  if (py::isinstance<py::dict>(value)) {
    numbers.values = argument<std::map<std::string, double>>(value, name, "numbers by name");
  } else {
    numbers.file = path_argument(value, name, "a path, or numbers by name");
  }
}

// Whether an empty list stands for something else than no names.
bool is_list_with_default(const Option& option) {
  return std::holds_alternative<std::vector<std::string>*>(option.value) && !option.otherwise.empty();
}

bool is_file(const Option& option) { return std::holds_alternative<std::string*>(option.value) && option.sample == "FILE"; }

// None stands for "not given" wherever that is possible.
bool has_none(const Option& option) {
  return is_list_with_default(option) ||
         std::visit(Overloaded{[]<typename T>(std::optional<T>*) { return true; },
                               [](std::map<std::string, std::string>*) { return true; },
                               [](std::map<std::string, int>*) { return true; }, [](NamedNumbers*) { return true; },
                               [](const Choice& one) { return one.get().empty(); }, [](const NumberOrWord&) { return true; },
                               [](const auto&) { return false; }},
                    option.value);
}

void read_keyword(py::handle given, const Option& option) {
  const std::string& name = keyword_of(option);
  if (given.is_none() && has_none(option)) return;
  std::visit(
      Overloaded{
          [&](bool* flag) { *flag = argument<bool>(given, name, "True or False"); },
          [&](const YesByDefault& one) { *one.value = argument<bool>(given, name, "True or False"); },
          [&](const Switch& one) {
            const bool is_word = py::isinstance<py::str>(given);
            *one.value =
                is_word ? one_of(given, {one.on, one.off}, name) == one.on : argument<bool>(given, name, "True or False");
          },
          [&](int* value) { *value = argument<int>(given, name, "a whole number"); },
          [&](std::uint64_t* value) { *value = argument<std::uint64_t>(given, name, "a whole number that is not negative"); },
          [&](double* value) { *value = argument<double>(given, name, "a number"); },
          [&](std::string* value) {
            const bool is_path = is_file(option) && py::hasattr(given, "__fspath__");
            *value = is_path ? path_argument(py::reinterpret_borrow<py::object>(given), name)
                             : argument<std::string>(given, name, "a str");
          },
          [&](std::optional<int>* value) { *value = argument<int>(given, name, "a whole number"); },
          [&](std::optional<std::uint64_t>* value) {
            *value = argument<std::uint64_t>(given, name, "a whole number that is not negative");
          },
          [&](std::optional<double>* value) { *value = argument<double>(given, name, "a number"); },
          [&](std::optional<std::string>* value) { *value = argument<std::string>(given, name, "a str"); },
          [&](std::vector<std::string>* list) {
            *list = argument<std::vector<std::string>>(given, name, "a list of names");
            if (is_list_with_default(option)) *list = names_or_all(*list, name.c_str());
          },
          [&](std::optional<std::vector<std::string>>* list) {
            const char* const expected = "a list of names, [] for none";
            *list = argument<std::vector<std::string>>(given, name, expected);
            if (**list == std::vector<std::string>{"none"}) {  // the word of the command
              throw InputError(fmt::format("{}: expected {}, got {}", name, expected, "['none']"));
            }
          },
          [&](std::map<std::string, std::string>* columns) {
            *columns = columns_argument(py::reinterpret_borrow<py::object>(given));
          },
          [&](std::map<std::string, int>* counts) {
            *counts = argument<std::map<std::string, int>>(given, name, "a dict of names to whole numbers");
          },
          [&](NamedNumbers* numbers) { read_named_numbers(given, *numbers, name); },
          [&](const Choice& one) { one.set(one_of(given, one.words, name)); },
          [&](const NumberOrWord& one) { read_number_or_word(given, one, name); },
          [&](const Repeated& one) { *one.values = argument<std::vector<std::string>>(given, name, "a list of names"); },
      },
      option.value);
}

std::string literal(const std::vector<std::string>& words) {
  std::string text;
  for (const std::string& word : words) text += (text.empty() ? "\"" : ", \"") + word + '"';
  return "Literal[" + text + "]";
}

// The type of a keyword as a stub has it, but for the None that has_none() tells of.
std::string type_of(const OptionValue& value) {
  const auto kinds = Overloaded{
      [](const bool*) { return "bool"; },
      [](const Switch& one) {
        return "bool | " + literal({one.on, one.off});
      },
      [](const YesByDefault&) { return "bool"; },
      [](const int*) { return "int"; },
      [](const std::uint64_t*) { return "int"; },
      [](const double*) { return "float"; },
      [](const std::string*) { return "str"; },
      [](const std::optional<int>*) { return "int"; },
      [](const std::optional<std::uint64_t>*) { return "int"; },
      [](const std::optional<double>*) { return "float"; },
      [](const std::optional<std::string>*) { return "str"; },
      [](const std::vector<std::string>*) { return "Sequence[str]"; },
      [](const std::optional<std::vector<std::string>>*) { return "Sequence[str]"; },
      [](const std::map<std::string, std::string>*) { return "Mapping[str, str]"; },
      [](const std::map<std::string, int>*) { return "Mapping[str, int]"; },
      [](const NamedNumbers*) { return "_Path | Mapping[str, float]"; },
      [](const Choice& one) { return literal(one.words); },
      [](const NumberOrWord& one) { return "float | " + literal(words_of(one)); },
      [](const Repeated&) { return "Sequence[str]"; },
  };
  return std::visit<std::string>(kinds, value);
}

// The default of a keyword as a stub has it.
std::string default_of(const OptionValue& value) {
  const auto truth = [](bool is_true) { return is_true ? "True" : "False"; };
  const auto kinds = Overloaded{
      [&](const bool* flag) { return truth(*flag); },
      [&](const Switch& one) { return truth(*one.value); },
      [&](const YesByDefault& one) { return truth(*one.value); },
      [](const int* number) { return std::to_string(*number); },
      [](const std::uint64_t* number) { return std::to_string(*number); },
      [](const double* number) { return std::string(py::repr(py::float_(*number))); },
      [](const std::string* text) { return '"' + *text + '"'; },
      [](const std::vector<std::string>*) { return "[]"; },
      [](const Repeated&) { return "[]"; },
      [](const Choice& one) { return one.get().empty() ? "None" : '"' + one.get() + '"'; },
      []<typename T>(const std::optional<T>*) { return "None"; },
      []<typename T>(const std::map<std::string, T>*) { return "None"; },
      [](const NamedNumbers*) { return "None"; },
      [](const NumberOrWord&) { return "None"; },
  };
  return std::visit<std::string>(kinds, value);
}

std::string declaration(const Option& option) {
  const char* const also = is_file(option) ? " | os.PathLike[str]" : has_none(option) ? " | None" : "";
  return fmt::format("{}: {}{} = {}", keyword_of(option), type_of(option.value), also,
                     is_list_with_default(option) ? "None" : default_of(option.value));
}

// Every option that a message may name, with its kind.
const std::vector<Option>& every_option() {
  static FitRequest fit;
  static RawFitOptions raw;
  static PredictRequest predict;
  static EvaluateRequest evaluate;
  static SimulateRequest simulate;
  static GenerateRequest generate;
  static DeriveOptions derive;
  static ResampleOptions resample;
  static ExciteRequest excite;
  static ShootRequest shoot;
  static const std::vector<Option> all = [] {
    std::vector<Option> list;
    for (std::vector<Option> table : {options(fit, raw), options(predict), options(evaluate), options(simulate),
                                      options(generate), options(derive), options(resample), options(excite), options(shoot)}) {
      list.insert(list.end(), table.begin(), table.end());
    }
    return list;
  }();
  return all;
}

std::string value_text(const Option& option, const std::string& value) {
  const auto is_word = [&](const std::vector<std::string>& words) {
    return std::find(words.begin(), words.end(), value) != words.end();
  };
  const auto list = [&] {
    std::vector<std::string> items;
    for (std::size_t first = 0; first <= value.size();) {
      const std::size_t end = std::min(value.find(',', first), value.size());
      items.push_back(value.substr(first, end - first));
      first = end + 1;
    }
    return fmt::format("[{}]", fmt::join(quoted(items), ", "));
  };
  return std::visit(Overloaded{[&](const Choice& one) { return is_word(one.words) ? "'" + value + "'" : value; },
                               [&](const NumberOrWord& one) { return is_word(words_of(one)) ? "'" + value + "'" : value; },
                               [&](std::vector<std::string>*) { return list(); },
                               [&](std::optional<std::vector<std::string>>*) { return value == "none" ? "[]" : list(); },
                               [&](std::map<std::string, std::string>*) {
                                 const std::size_t equals = value.rfind('=');
                                 return fmt::format("{{'{}': '{}'}}", value.substr(equals + 1), value.substr(0, equals));
                               },
                               [&](const auto&) { return value; }},
                    option.value);
}

}  // namespace

bool is_truth_value(py::handle given) {
  const std::string_view type = Py_TYPE(given.ptr())->tp_name;
  return type == "bool" || type == "numpy.bool" || type == "numpy.bool_";
}

void require_bits(int bits, py::handle given, const std::string& name) {
  if (PyIndex_Check(given.ptr()) == 0) return;
  const auto number = py::reinterpret_steal<py::object>(PyNumber_Index(given.ptr()));
  if (!number) return PyErr_Clear();  // an array may only seem to be one
  if (number < (py::int_(1) << py::int_(bits))) return;
  throw py::type_error(fmt::format("{}: expected a whole number below 2^{}, got {}", name, bits, std::string(py::repr(given))));
}

const std::string& keyword_of(const Option& option) { return option.keyword.empty() ? option.name : option.keyword; }

bool is_keyword(const std::string& name) {
  const std::vector<Option>& all = every_option();
  return std::any_of(all.begin(), all.end(), [&](const Option& one) { return keyword_of(one) == name; });
}

std::string nearest(const std::string& name, const py::list& known) {
  const py::list near = py::module_::import("difflib").attr("get_close_matches")(name, known, 1);
  return near.empty() ? "" : near[0].cast<std::string>();
}

void refuse_keyword(const std::string& function, const std::string& name, const py::list& known) {
  const std::string near = nearest(name, known);
  throw py::type_error(fmt::format("{}() got an unexpected keyword argument '{}'{}", function, name,
                                   near.empty() ? "" : fmt::format("; did you mean '{}'?", near)));
}

void read_keywords(const std::string& function, const py::dict& keywords, const std::vector<Option>& options,
                   const std::vector<std::string>& others) {
  for (const auto& [key, value] : keywords) {
    const auto name = key.cast<std::string>();
    const auto option = std::find_if(options.begin(), options.end(), [&](const Option& one) { return keyword_of(one) == name; });
    if (option != options.end()) {
      read_keyword(value, *option);
      const Option* needed = find_option(options, option->needs);
      if (needed != nullptr && !keywords.contains(keyword_of(*needed))) {
        throw InputError(fmt::format("{}: goes with {}, without which it means nothing", name, keyword_of(*needed)));
      }
      continue;
    }
    py::list known;
    for (const Option& one : options) known.append(keyword_of(one));
    for (const std::string& one : others) known.append(one);
    refuse_keyword(function, name, known);
  }
}

std::string signature(const std::string& function, const std::string& first, const std::vector<Option>& options,
                      const std::string& last, const std::string& returned) {
  std::vector<std::string> declarations;
  for (const Option& option : options) declarations.push_back(declaration(option));
  return fmt::format("{}({} {}{}) -> {}\n", function, first, fmt::join(declarations, ", "), last, returned);
}

std::string documentation(const std::vector<Option>& options) {
  std::string text;
  for (const Option& option : options) {
    const auto* const words = std::get_if<Switch>(&option.value);
    text += fmt::format("{:<19} {}{}{}\n", keyword_of(option), with_keywords(option.text),
                        option.otherwise.empty() ? "" : fmt::format("; default: {}", option.otherwise),
                        words != nullptr ? fmt::format("; True is '{}', False '{}'", words->on, words->off) : "");
  }
  return text;
}

std::string stub_lines(const std::vector<Option>& options) {
  std::string lines;
  for (const Option& option : options) lines += fmt::format("{},\n", declaration(option));
  return lines;
}

std::string with_keywords(const std::string& message) {
  return respelled(message, [](const std::string& name, const std::optional<std::string>& value) {
    const Option* option = find_option(every_option(), name);
    const std::string keyword = option == nullptr ? name : keyword_of(*option);
    if (!value) return keyword;
    return fmt::format("{}={}", keyword, option == nullptr ? *value : value_text(*option, *value));
  });
}

std::vector<std::string> with_keywords(std::vector<std::string> messages) {
  for (std::string& message : messages) message = with_keywords(message);
  return messages;
}

}  // namespace gp2::python
