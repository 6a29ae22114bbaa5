#include "export/c_math_functions.hpp"

#include <cctype>
#include <set>
#include <string_view>

#include <fmt/format.h>

#include "export/portable_math.hpp"

namespace gp2::c_export {

void use_float_functions(std::string& source) {
  for (const char* const function : {"sqrt(", "fabs(", "sin(", "exp(", "log("}) {
    for (std::size_t at = source.find(function); at != std::string::npos; at = source.find(function, at + 1)) {
      const bool is_whole_word = source.find_last_of(" -!(", at) + 1 == at;
      if (is_whole_word) source.insert(at + std::string_view(function).size() - 1, 1, 'f');
    }
  }
}

void use_portable_functions(std::string& source, const std::string& name) {
  const auto is_of_name = [](char c) { return std::isalnum(static_cast<unsigned char>(c)) != 0 || c == '_'; };
  const std::string_view prefix = "portable_";
  std::set<std::string> of_floats;
  std::string users;
  for (std::size_t at = 0; at < source.size();) {
    const bool is_comment = source.compare(at, 2, "/*") == 0;
    std::size_t end = is_comment ? source.find("*/", at) + 2 : at + 1;
    while (!is_comment && is_of_name(source[at]) && end < source.size() && is_of_name(source[end])) ++end;
    if (!is_comment && source[end] == '(') {
      const std::string word = source.substr(at, end - at);
      for (const Piece& piece : portable_pieces) {
        if (!piece.name.starts_with(prefix)) continue;
        const std::string_view function = piece.name.substr(prefix.size());
        const bool is_of_floats = word == fmt::format("{}f", function);
        if (word != function && !is_of_floats) continue;
        source.insert(at, prefix);
        end += prefix.size();
        users += std::string(piece.name) + "(";
        if (is_of_floats) of_floats.emplace(function);
      }
    }
    at = end;
  }
  std::string pieces = called_pieces(portable_pieces, users);
  for (const std::string& function : of_floats) {
    const bool is_binary = function == "atan2" || function == "pow";
    pieces += fmt::format("\nstatic float portable_{0}f(float x{1})\n{{\n  return (float)portable_{0}(x{2});\n}}\n", function,
                          is_binary ? ", float y" : "", is_binary ? ", y" : "");
  }
  std::string head(portable_head);
  head.replace(head.find("@name@"), 6, name);
  source.replace(source.find("@portable@"), 10, head + pieces);
}

}  // namespace gp2::c_export
