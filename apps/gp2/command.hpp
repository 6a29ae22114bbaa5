#pragma once

#include <functional>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "gp2/error.hpp"
#include "gp2/jobs/derive.hpp"
#include "gp2/jobs/excite_job.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/jobs/simulate_job.hpp"
#include "gp2/model.hpp"

namespace gp2::command {

/// A subcommand: its options, and what it does when they are read. `run` owns what the options point at.
struct Command {
  std::string name, text, example;
  std::vector<Option> options;                                  // in the order of --help
  std::function<void(const std::set<std::string>& given)> run;  // given: names of the options on the command line
};

Command show_command();
Command check_command();
Command generate_command();
Command derive_command();
Command resample_command();
Command fit_command();
Command predict_command();
Command simulate_command();
Command shoot_command();
Command excite_command();
Command evaluate_command();
Command update_command();
Command export_command();
Command report_command();
Command plot_command();
Command reproduce_command();
Command completion_command();
Command help_command(const std::vector<std::string>& names);

/// In the order of --help. All that may say something beside their result have -q.
std::vector<Command> all_commands();

/// An argument by its position, which must be given: MODEL.
Option argument(const std::string& flag, std::string& value, const std::string& text);
/// Arguments that stand one behind the other, one at least: FIT.json OTHER.json.
Option arguments(const std::string& flag, std::vector<std::string>& values, const std::string& text);
/// -o, --output, which must be given.
/// @param sample  CSV, say
Option output(std::string& value, const std::string& sample, const std::string& text);
/// An option that must be given.
Option required(Option option);

/// A message of the library with its options as the command line has them: `noise_std=estimate` -> --noise-std estimate.
std::string with_flags(const std::string& message);
/// --noise-std, of the table's noise_std.
std::string flag_of(const Option& option);

/// Thrown for a command line that misses something; main adds where help is.
struct UsageError {
  std::string text;
};

/// "theta1=q3,theta2=q6" -> model's name -> log's name.
/// @throws InputError when it is not of that form.
std::map<std::string, std::string> parse_map(const std::string& text);
/// "a,atan2(b, c)" -> {"a", "atan2(b, c)"}; empty for "". A comma in parentheses separates nothing.
/// @param option  for messages
/// @throws InputError when a parenthesis is not closed.
std::vector<std::string> parse_list(const std::string& text, const std::string& option);
/// "q1=5,dq1=3" -> numbers by name.
/// @throws InputError when it is not of that form.
std::map<std::string, int> parse_counts(const std::string& text, const std::string& option);

/// "u1=-5:5,u2=0:1" -> lowest and highest values by name.
/// @throws InputError when it is not of that form.
Limits parse_limits(const std::string& text, const std::string& option);
/// The start of a motion: "q1=0.4,dq1=0.8", or the path of a CSV.
/// @throws InputError when it is neither.
MotionStart read_start(const std::string& text);
/// --start, as read_start takes it.
Option start_option(std::string& value);

/// Whether a file can be written at the end: better said before an hour of work than after.
/// @param inputs  files that are read, which it must not replace; "" for none
/// @param option  that names it, for messages
/// @throws InputError when its folder does not exist, it is an input, or as require_writable.
void require_output(const std::string& output, const std::vector<std::string>& inputs, const char* option = "-o");

/// The folder -o, which need not be there.
/// @throws InputError when it cannot be made.
void make_folder(const std::string& output);

/// Whether a text is a file written by gp2 fit: no model file begins so.
bool is_fit(const std::string& text);
/// The model of another system; null for an empty path.
std::shared_ptr<const Model> read_other_system(const std::string& path);

inline constexpr const char* system_help =
    "model file of another system with the same coordinates, inputs and latents: predict under its constraints, masses and "
    "parameters";

/// "LOG@OTHER.toml" -> {"LOG", "OTHER.toml"}, split at the last @ at which both are files, else at the last; {text, ""} where the
/// text does not end in .toml.
std::pair<std::string, std::string> split_at_system(const std::string& text);

/// @param text  LOG
/// @param why   the command takes no log of another system, as the end of a sentence
/// @throws InputError where it is LOG@OTHER.toml
void require_own_system(const std::string& text, const std::string& why);

/// Prints notes to stderr, a line each.
void print_notes(const std::vector<std::string>& notes);
/// What became of each coordinate of a raw log, a line each.
void print_smoothing(const DerivedData& data, const System& system);

}  // namespace gp2::command
