#pragma once

#include <map>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>

#include "gp2/csv.hpp"
#include "gp2/error.hpp"

namespace gp2::command {

// One function per subcommand: declares its arguments; its callback does the work.
void add_show(CLI::App& app);
void add_check(CLI::App& app);
void add_generate(CLI::App& app);
void add_fit(CLI::App& app);
void add_predict(CLI::App& app);
void add_evaluate(CLI::App& app);

/// "theta1=q3,theta2=q6" -> model's name -> log's name.
/// @throws InputError when it is not of that form.
std::map<std::string, std::string> parse_map(const std::string& text);

/// "a,b" -> {"a", "b"}; empty for "" .
std::vector<std::string> parse_list(const std::string& text);

/// For unsigned options: CLI11 would take -1 for the largest number there is.
CLI::Validator not_negative();

/// @throws InputError when the folder of a file to be written does not exist: better said before an hour of work than after.
void require_folder(const std::string& output);

/// work(), with the log named in what it throws: a posterior knows the number of a state only.
template <typename Work>
auto at_states_of(const CsvTable& log, const Work& work) {
  try {
    return work();
  } catch (const InputError& error) {
    throw InputError(log.name() + ": " + error.what());
  }
}

/// Prints talk to stderr, a line each.
void talk(const std::vector<std::string>& notes);

}  // namespace gp2::command
