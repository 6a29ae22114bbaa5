#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "command.hpp"

namespace CLI {
class App;
}

namespace gp2::command {

/// Adds a subcommand to the command line.
void add_command(CLI::App& app, Command command);

/// An option's words; empty where it takes others than words too, or none.
std::vector<std::string> words_of(const Option& option);
/// What --help says of an option.
std::string help_of(const Option& option);
/// What holds where an option is not given, as far as a new request says it.
std::string default_of(const Option& option);
/// Columns for the lines of --help: those of the terminal, as far as lines are readable.
std::size_t help_width();

/// ", did you mean '--restarts'?" where the command line has an option that the command lacks.
/// @return what is wrong with it, as a sentence; empty where there is none
std::string unknown_option(const CLI::App& app);

/// What CLI11 says of a command line that cannot be read, as a sentence of ours.
std::string in_plain_words(const std::string& error);

/// The options of a command as a table of docs/command-line.md.
std::string markdown_table(const Command& command);

}  // namespace gp2::command
