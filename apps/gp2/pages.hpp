#pragma once

#include <cstddef>
#include <string>
#include <string_view>
#include <vector>

#include "command.hpp"

// What is made of the tables of options for who reads them: help, man pages, and the completion of shells.
namespace gp2::command {

/// What goes for gp2 as a whole.
inline constexpr std::string_view summary =
    "Learn the dynamics of constrained mechanical systems from measured data, with predictions that obey the constraints "
    "exactly.";

/// --help of one command, or of gp2 with all of them, in lines of at most `width` columns.
std::string help_page(const Command& command, std::size_t width);
std::string help_page(const std::vector<Command>& commands, std::size_t width);

/// gp2-NAME.1 of one command, or gp2.1 with all of them, in the man macros of troff.
std::string man_page(const Command& command);
std::string man_page(const std::vector<Command>& commands);

/// The script that lets a shell complete commands, options, their words and files.
/// @param shell  bash, zsh or fish
std::string completion_script(const std::string& shell, const std::vector<Command>& commands);

}  // namespace gp2::command
