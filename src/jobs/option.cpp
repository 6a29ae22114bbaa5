#include "gp2/jobs/option.hpp"

#include <algorithm>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "gp2/error.hpp"

namespace gp2 {

namespace {

using Json = nlohmann::json;

// The value of an option in JSON; null where it has none.
Json json_of(const OptionValue& value) {
  return std::visit(Overloaded{
                        [](const bool* flag) { return *flag ? Json(true) : Json(); },
                        [](const Switch& one) { return Json(*one.value ? one.on : one.off); },
                        [](const YesByDefault& one) { return Json(*one.value); },
                        [](const Choice& one) { return one.get().empty() ? Json() : Json(one.get()); },
                        [](const NumberOrWord& one) {
                          for (const auto& [word, flag] : one.words) {
                            if (*flag) return Json(word);
                          }
                          return *one.number ? Json(**one.number) : Json();
                        },
                        [](const std::map<std::string, std::string>* columns) {
                          Json list;
                          for (const auto& [name, column] : *columns) list.push_back(fmt::format("{}={}", column, name));
                          return list;
                        },
                        [](const NamedNumbers* one) { return one->values.empty() ? Json() : Json(one->values); },
                        [](const std::string* text) { return text->empty() ? Json() : Json(*text); },
                        [](const std::vector<std::string>* list) { return list->empty() ? Json() : Json(*list); },
                        [](const Repeated& one) { return one.values->empty() ? Json() : Json(*one.values); },
                        []<typename T>(const std::optional<T>* one) { return *one ? Json(**one) : Json(); },
                        [](const auto* one) { return Json(*one); },
                    },
                    value);
}

// The reverse of json_of; false where the JSON is of another kind.
bool read_value(const Json& json, const OptionValue& value) {
  return std::visit(Overloaded{
                        [&](bool* flag) { return json.is_boolean() && (json.get_to(*flag), true); },
                        [&](const Switch& one) {
                          *one.value = json == one.on;
                          return json == one.on || json == one.off;
                        },
                        [&](const YesByDefault& one) { return json.is_boolean() && (json.get_to(*one.value), true); },
                        [&](const Choice& one) {
                          const bool known = json.is_string() && std::ranges::count(one.words, json.get<std::string>()) > 0;
                          if (known) one.set(json.get<std::string>());
                          return known;
                        },
                        [&](const NumberOrWord& one) {
                          bool known = json.is_number();
                          if (known) *one.number = json.get<double>();
                          for (const auto& [word, flag] : one.words) known = (*flag = json == word) || known;
                          return known;
                        },
                        [&](std::map<std::string, std::string>* columns) {
                          for (const Json& entry : json) {
                            const std::string text = entry.is_string() ? entry.get<std::string>() : "";
                            const std::size_t equals = text.rfind('=');
                            if (equals == std::string::npos) return false;
                            (*columns)[text.substr(equals + 1)] = text.substr(0, equals);
                          }
                          return json.is_array();
                        },
                        [&](NamedNumbers* one) {
                          for (const auto& [name, entry] : json.items()) {
                            if (!entry.is_number()) return false;
                            one->values[name] = entry.get<double>();
                          }
                          return json.is_object();
                        },
                        [&](const Repeated& one) {
                          json.get_to(*one.values);
                          return true;
                        },
                        [&]<typename T>(std::optional<T>* one) {
                          one->emplace(json.get<T>());
                          return true;
                        },
                        [&](auto* one) {
                          json.get_to(*one);
                          return true;
                        },
                    },
                    value);
}

}  // namespace

Option threads_option(int& threads) {
  return not_recorded({"threads", &threads, "K", "number of threads; 0: all of the machine. Does not change the results"});
}

Option columns_option(std::map<std::string, std::string>& columns, const std::string& text) {
  return {"map", &columns, "LOGNAME=NAME,…", text, "", "columns"};
}

void require_threads(int threads) {
  if (threads < 0) {
    throw InputError(fmt::format("`threads`: must be positive, or 0 for as many as the machine has; got {}", threads));
  }
}

const Option* find_option(const std::vector<Option>& options, const std::string& name) {
  const auto found = std::find_if(options.begin(), options.end(), [&](const Option& option) { return option.name == name; });
  return found == options.end() ? nullptr : &*found;
}

std::string options_json(const std::vector<Option>& options) {
  Json json = Json::object();
  for (const Option& option : options) {
    if (!option.is_recorded) continue;
    Json value = json_of(option.value);
    if (!value.is_null()) json[option.name] = std::move(value);
  }
  return json.dump(-1, ' ', false, Json::error_handler_t::replace);  // names of files may be of any encoding
}

void read_options(const std::string& json, const std::vector<Option>& options, const std::string& source) {
  const Json values = Json::parse(json);
  for (const auto& [name, value] : values.items()) {
    const Option* option = find_option(options, name);
    if (option == nullptr) throw InputError(fmt::format("{}: unknown option '{}'", source, name));
    bool is_read = false;
    try {
      is_read = read_value(value, option->value);
    } catch (const Json::exception&) {
    }
    if (!is_read) throw InputError(fmt::format("{}: the value {} of '{}' is of another kind", source, value.dump(), name));
  }
}

std::string respelled(const std::string& message,
                      const std::function<std::string(const std::string&, const std::optional<std::string>&)>& spell) {
  const auto is_name = [](const std::string& text) {
    return !text.empty() && std::all_of(text.begin(), text.end(), [](char c) { return (c >= 'a' && c <= 'z') || c == '_'; });
  };
  std::string out;
  std::size_t at = 0;
  while (true) {
    const std::size_t open = message.find('`', at);
    const std::size_t close = open == std::string::npos ? open : message.find('`', open + 1);
    if (close == std::string::npos) return out + message.substr(at);
    const std::string inner = message.substr(open + 1, close - open - 1);
    const std::size_t equals = inner.find('=');
    const std::string name = inner.substr(0, equals);
    out += message.substr(at, open - at);
    if (is_name(name)) {
      out += spell(name, equals == std::string::npos ? std::nullopt : std::optional(inner.substr(equals + 1)));
      at = close + 1;
    } else {
      out += '`';  // of somebody else's
      at = open + 1;
    }
  }
}

}  // namespace gp2
