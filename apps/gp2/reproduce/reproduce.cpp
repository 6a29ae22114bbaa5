#include <array>
#include <filesystem>
#include <memory>
#include <vector>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command.hpp"
#include "gp2/error.hpp"
#include "reproduce/experiment.hpp"

namespace gp2::command {

namespace {

struct ReproduceArguments {
  std::string what, protocol = "both", data, output, experiments;
  std::optional<int> runs;
  int threads = 0;
};

struct Experiment {
  const char* name;
  void (*run)(const ReproduceOptions& options);
  bool of_the_paper = true;  // and of "all"
};

constexpr std::array<Experiment, 8> experiments = {{{"table1", reproduce_table1},
                                                    {"fig3a", reproduce_fig3a},
                                                    {"fig3b", reproduce_fig3b},
                                                    {"fig3c", reproduce_fig3c},
                                                    {"figS7", reproduce_figS7},
                                                    {"learning-curve", reproduce_learning_curve},
                                                    {"arm-on-surface", reproduce_arm_on_surface, false},
                                                    {"arm-mass", reproduce_arm_mass, false}}};

// the definitions: as told, beside an installed command, or in the source the command was built from
std::filesystem::path definitions(const std::string& told) {
  std::error_code error;  // of a folder that may not be looked into
  if (!told.empty()) {
    if (!std::filesystem::is_directory(told, error))
      throw InputError(fmt::format("--experiments: there is no folder '{}'", told));
    return told;
  }
  const std::filesystem::path command = std::filesystem::read_symlink("/proc/self/exe", error);
  for (const std::filesystem::path& folder :
       {command.parent_path() / GP2_EXPERIMENTS_FROM_BIN, std::filesystem::path(GP2_EXPERIMENTS_IN_SOURCE)}) {
    if (std::filesystem::is_directory(folder, error)) return folder.lexically_normal();
  }
  throw InputError("the definitions of the experiments are not where this command was installed: give --experiments DIR");
}

void run(const ReproduceArguments& arguments) {
  require_threads(arguments.threads);
  ReproduceOptions options;
  options.experiments = definitions(arguments.experiments);
  if (!arguments.data.empty()) {
    std::error_code error;
    if (!std::filesystem::is_directory(arguments.data, error)) {
      throw InputError(fmt::format("--data: there is no folder '{}'", arguments.data));
    }
    options.data = arguments.data;
  }
  options.output = arguments.output;
  if (arguments.protocol != "default") options.protocols.push_back(Protocol::Name::paper);
  if (arguments.protocol != "paper") options.protocols.push_back(Protocol::Name::standard);
  options.runs = arguments.runs;
  options.threads = arguments.threads;
  make_folder(arguments.output);
  // hours of numbers do not wait for a picture
  std::vector<std::string> not_drawn;
  for (const Experiment& experiment : experiments) {
    if (arguments.what == "all" ? !experiment.of_the_paper : arguments.what != experiment.name) continue;
    try {
      experiment.run(options);
      print_notes({fmt::format("{}: {} is done", options.output.string(), experiment.name)});
    } catch (const PictureError& picture) {
      if (not_drawn.empty() || not_drawn.back() != picture.what()) not_drawn.emplace_back(picture.what());
    }
  }
  if (!not_drawn.empty()) throw InputError(fmt::format("{}", fmt::join(not_drawn, "\n")));
}

}  // namespace

Command reproduce_command() {
  const auto a = std::make_shared<ReproduceArguments>();
  std::vector<std::pair<std::string, std::string>> names = {{"all", "all"}};
  for (const Experiment& experiment : experiments) names.emplace_back(experiment.name, experiment.name);
  Option what{"what", choice(a->what, names), "", "which"};
  what.flag = "WHAT";
  return {"reproduce",
          "Rebuild the tables and figures of Geist & Trimpe 2020, and more",
          "gp2 reproduce table1 --runs 2 -o results",
          {required(std::move(what)),
           {"protocol", choice(a->protocol, {{"paper", "paper"}, {"default", "default"}, {"both", "both"}}), "",
            "training of GP²; the other methods are the same in both"},
           {"data", &a->data, "DIR", "folder of the published observations; default: drawn from the same distributions"},
           {"runs", &a->runs, "R", "data sets", "10, or those that --data holds"},
           threads_option(a->threads),
           {"experiments", &a->experiments, "DIR", "folder of the definitions", "those of gp2"},
           output(a->output, "DIR", "folder for numbers (CSV, JSON) and pictures (SVG, PNG)")},
          [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
