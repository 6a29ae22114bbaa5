#pragma once

#include <map>
#include <set>
#include <span>
#include <string>
#include <string_view>

// The form of the templates of C: @name@ stands for a text. A line behind {a,b} is there where a and b hold, behind {!a} where a
// does not; lines between {if a,b} and {end} likewise.
namespace gp2::c_export {

/// What a template is filled with.
struct Filling {
  std::set<std::string> conditions;
  std::map<std::string, std::string> texts;
  const Filling* outer = nullptr;  // what is not here is looked for there

  [[nodiscard]] bool has(const std::string& condition) const;
  [[nodiscard]] const std::string& text(const std::string& name) const;
};

/// A line that is nothing but an empty text goes.
std::string filled(std::string_view form, const Filling& with);

/// C that others call by its name.
struct Piece {
  std::string_view name, text;
};

/// The pieces that `users` call, and those that these call, each of which stands before its callers.
std::string called_pieces(std::span<const Piece> pieces, std::string users);

}  // namespace gp2::c_export
