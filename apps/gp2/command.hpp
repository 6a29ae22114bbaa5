#pragma once

#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/simulation/generate.hpp"

namespace gp2::command {

// One function per subcommand: declares its arguments; its callback does the work.
void add_show(CLI::App& app);
void add_check(CLI::App& app);
void add_generate(CLI::App& app);
void add_derive(CLI::App& app);
void add_resample(CLI::App& app);
void add_fit(CLI::App& app);
void add_predict(CLI::App& app);
void add_simulate(CLI::App& app);
void add_evaluate(CLI::App& app);
void add_report(CLI::App& app);
void add_reproduce(CLI::App& app);

/// "theta1=q3,theta2=q6" -> model's name -> log's name.
/// @throws InputError when it is not of that form.
std::map<std::string, std::string> parse_map(const std::string& text);
/// "a,b" -> {"a", "b"}; empty for "" .
std::vector<std::string> parse_list(const std::string& text);

/// For unsigned options: CLI11 would take -1 for the largest number there is.
CLI::Validator not_negative();

/// Whether a file can be written at the end: better said before an hour of work than after.
/// @param inputs  files that are read, which it must not replace; "" for none
/// @throws InputError when its folder does not exist, it is an input, or as require_writable.
void require_output(const std::string& output, const std::vector<std::string>& inputs);

/// work(), with the log named in what it throws: a posterior knows the number of a state only.
template <typename Work>
auto at_states_of(const CsvTable& log, const Work& work) {
  try {
    return work();
  } catch (const InputError& error) {
    throw InputError(log.name() + ": " + error.what());
  }
}

/// The system under which a fit predicts.
struct PredictedSystem {
  Model model;
  std::shared_ptr<const OtherSystem> other_system;  // null: the fit's own
  Prior prior;                                      // of that system

  /// Every row of a quantity there.
  [[nodiscard]] View view(View::Quantity quantity) const;
};

/// @param path  of --system: another model file; empty: the fit's own
/// @throws InputError when that model does not fit (make_other_system).
PredictedSystem predicted_system(const FitFile& fit, const std::string& path);

inline constexpr const char* system_help =
    "model file of another system with the same coordinates, inputs and latents: predict under its constraints, masses and "
    "parameters";

/// "LOG@OTHER.toml" -> {"LOG", "OTHER.toml"}, split at the last @; {text, ""} where what follows it does not end in .toml.
std::pair<std::string, std::string> split_at_system(const std::string& text);

/// Prints talk to stderr, a line each.
void talk(const std::vector<std::string>& notes);

}  // namespace gp2::command
