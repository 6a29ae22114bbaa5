#pragma once

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

/// The entries of a table in the file's own order: TOML tables are sorted by name.
std::vector<std::pair<std::string, const toml::node*>> entries_of(const toml::table& table);

int line_of(const toml::node& node);

/// A value as the file has it, to show what was got; at most 60 bytes.
std::string written(const toml::node& node);

/// Typed access to the nodes of a TOML file; what does not fit is an error "FILE:LINE: KEY: what was expected, what was got".
class TomlReader {
 public:
  explicit TomlReader(std::string file_name) : name_(std::move(file_name)) {}

  [[noreturn]] void fail(const toml::node& node, const std::string& key, const std::string& message) const;
  [[noreturn]] void fail(int line, const std::string& key, const std::string& message) const;
  /// Complains of the first key, in the file's order, that is not known.
  void only_keys(const toml::table& table, const std::string& where, const std::vector<std::string>& known) const;

  // a node as what it must be
  [[nodiscard]] const toml::table& table(const toml::node& node, const std::string& key) const;
  [[nodiscard]] const toml::array& array(const toml::node& node, const std::string& key) const;
  [[nodiscard]] std::string text(const toml::node& node, const std::string& key) const;
  [[nodiscard]] double number(const toml::node& node, const std::string& key) const;
  [[nodiscard]] bool boolean(const toml::node& node, const std::string& key) const;
  [[nodiscard]] std::pair<double, double> range(const toml::node& node, const std::string& key, bool may_be_equal = false) const;

 private:
  std::string name_;
};

}  // namespace gp2
