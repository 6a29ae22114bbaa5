#pragma once

#include <string>

#include "command.hpp"

namespace CLI {
class App;
}

namespace gp2::command {

/// Adds a subcommand to the command line.
void add_command(CLI::App& app, Command command);

/// The options of a command as a table of docs/command-line.md.
std::string markdown_table(const Command& command);

}  // namespace gp2::command
