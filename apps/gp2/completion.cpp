#include <filesystem>
#include <memory>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include "command.hpp"
#include "command_line.hpp"
#include "gp2/base/file.hpp"
#include "pages.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

struct CompletionArguments {
  std::string shell, output;
};

// Man pages and completions where systems look for them below /usr/share, /usr/local/share or ~/.local/share.
void write_share(const std::string& folder) {
  const std::vector<Command> commands = all_commands();
  const std::filesystem::path share = folder;
  std::vector<std::pair<std::filesystem::path, std::string>> files;
  const auto write = [&](const std::filesystem::path& path, std::string text) {
    make_folder((share / path.parent_path()).string());
    files.emplace_back(share / path, std::move(text));
  };
  write("man/man1/gp2.1", man_page(commands));
  for (const Command& command : commands) write(fmt::format("man/man1/gp2-{}.1", command.name), man_page(command));
  write("bash-completion/completions/gp2", completion_script("bash", commands));
  write("zsh/site-functions/_gp2", completion_script("zsh", commands));
  write("fish/vendor_completions.d/gp2.fish", completion_script("fish", commands));
  write_files(files);
}

void run(const CompletionArguments& arguments) {
  if (arguments.shell != "all") {
    if (!arguments.output.empty()) throw UsageError{"-o goes with 'all': the script of one shell is printed"};
    print_result("{}", completion_script(arguments.shell, all_commands()));
    return;
  }
  if (arguments.output.empty()) throw UsageError{"'all' needs -o DIR, say ~/.local/share"};
  write_share(arguments.output);
}

}  // namespace

Command completion_command() {
  const auto a = std::make_shared<CompletionArguments>();
  Option shell{"shell", choice(a->shell, {{"bash", "bash"}, {"zsh", "zsh"}, {"fish", "fish"}, {"all", "all"}}), "",
               "shell; all: the scripts of all shells and the man pages, written below -o"};
  shell.flag = "SHELL";
  Option folder = output(a->output, "DIR", "folder like /usr/local/share or ~/.local/share");
  folder.is_required = false;
  return {"completion",
          "Print the completion script of a shell, or write those of all shells and the man pages",
          "source <(gp2 completion bash)\n"
          "gp2 completion fish > ~/.config/fish/completions/gp2.fish\n"
          "gp2 completion all -o ~/.local/share",
          {required(std::move(shell)), std::move(folder)},
          [a](const std::set<std::string>&) { run(*a); }};
}

Command help_command(const std::vector<std::string>& names) {
  const auto name = std::make_shared<std::string>();
  std::vector<std::pair<std::string, std::string>> words;
  for (const std::string& one : names) words.emplace_back(one, one);
  Option of{"command", choice(*name, words), "", "command to explain; without it all are listed"};
  of.flag = "COMMAND";
  const auto run = [name](const std::set<std::string>&) {
    const std::vector<Command> commands = all_commands();
    for (const Command& one : commands) {
      if (one.name == *name) return write_stdout(help_page(one, help_width()));
    }
    write_stdout(help_page(commands, help_width()));
  };
  return {"help", "Explain gp2 or one of its commands", "gp2 help fit", {std::move(of)}, run};
}

}  // namespace gp2::command
