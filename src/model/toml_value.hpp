#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "gp2/error.hpp"
#include "model/toml.hpp"

namespace gp2 {

/// A complaint that names its file, line and key already.
class LocatedError : public InputError {
 public:
  using InputError::InputError;
};

/// Refuses what toml++ 3.3 does not survive, for it goes down into dotted keys by recursion without a bound; and letters beyond
/// ASCII outside of quotes and comments, for it does not say what is wrong with them.
/// @throws LocatedError for these: a key of more than 16 dots, brackets deeper than 32.
void require_safe(std::string_view text, const std::string& file_name);

/// A value of a TOML file with the key that messages call it by. A value that is not what a function asks for is an error
/// "FILE:LINE: KEY: what was expected, what was got". File and tree must outlive it.
class TomlValue {
 public:
  /// @param key  of the root: empty
  TomlValue(const std::string& file_name, const toml::node& node, std::string key)
      : file_name_(&file_name), node_(&node), key_(std::move(key)) {}

  [[nodiscard]] const std::string& key() const { return key_; }
  [[nodiscard]] int line() const { return static_cast<int>(node_->source().begin.line); }
  /// As the file has it, to show what was got; at most 60 bytes.
  [[nodiscard]] std::string written() const;
  /// The same value by another key.
  [[nodiscard]] TomlValue called(std::string key) const { return {*file_name_, *node_, std::move(key)}; }

  [[noreturn]] void fail(const std::string& message) const { fail_at(line(), key_, message); }
  [[noreturn]] void fail_at(int line, const std::string& key, const std::string& message) const;

  [[nodiscard]] bool is_table() const { return node_->is_table(); }
  [[nodiscard]] bool is_array() const { return node_->is_array(); }
  [[nodiscard]] bool is_text() const { return node_->is_string(); }
  [[nodiscard]] bool is_number() const { return node_->is_number(); }

  // what it must be
  [[nodiscard]] std::string text() const;
  [[nodiscard]] double number() const;
  [[nodiscard]] bool boolean() const;
  [[nodiscard]] std::pair<double, double> range(bool may_be_equal = false) const;
  /// The elements of an array, which go by its key.
  [[nodiscard]] std::vector<TomlValue> array() const;

  // a table
  /// Its entries, KEY.NAME, in the file's own order.
  [[nodiscard]] std::vector<std::pair<std::string, TomlValue>> entries() const;
  [[nodiscard]] std::size_t n_entries() const { return table().size(); }
  [[nodiscard]] bool has(std::string_view name) const { return table().contains(name); }
  [[nodiscard]] std::optional<TomlValue> get(const std::string& name) const;
  /// Complains of the first entry, in the file's order, that is not known.
  void only_keys(const std::vector<std::string>& known) const;

 private:
  [[nodiscard]] const toml::table& table() const;
  [[nodiscard]] std::string key_of(const std::string& name) const { return key_.empty() ? name : key_ + "." + name; }

  const std::string* file_name_;
  const toml::node* node_;
  std::string key_;
};

}  // namespace gp2
