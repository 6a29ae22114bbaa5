#include <cerrno>
#include <cstring>

#include <fcntl.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <fmt/format.h>

#include "reproduce/experiment.hpp"
#include "streams.hpp"

extern char** environ;  // NOLINT(readability-redundant-declaration): POSIX leaves it to the program

namespace gp2::command {

namespace {

// a text as gnuplot reads it between single quotes
std::string quoted(const std::string& text) {
  std::string out = "'";
  for (const char c : text) out.append(c == '\'' ? 2 : 1, c);
  return out + "'";
}

// runs a program and waits; its exit status, or −1 when there is no such program
int run_program(std::vector<std::string> words) {
  std::vector<char*> arguments;
  for (std::string& word : words) arguments.push_back(word.data());
  arguments.push_back(nullptr);
  pid_t child = 0;
  const int failure = posix_spawnp(&child, arguments.front(), nullptr, nullptr, arguments.data(), environ);
  if (failure == ENOENT) return -1;
  if (failure != 0) throw PictureError(fmt::format("{} cannot be started: {}", words.front(), std::strerror(failure)));
  int status = 0;
  while (waitpid(child, &status, 0) < 0 && errno == EINTR) {
  }
  return WIFEXITED(status) ? WEXITSTATUS(status) : 128;
}

}  // namespace

void plot(const ReproduceOptions& options, const std::string& name) {
  const std::string script = (options.experiments / (name + ".gp")).string();
  for (const char* format : {"svg", "png"}) {
    const std::string terminal = format == std::string("svg")
                                     ? "set terminal svg size 1100,500 dynamic font 'sans,13' background 'white'"
                                     : "set terminal pngcairo size 1650,750 font 'sans,15'";
    const std::string output = (options.output / fmt::format("{}.{}", name, format)).string();
    const std::string setup = fmt::format("dir = {}; set datafile separator ','; {}; set output {}",
                                          quoted(options.output.string()), terminal, quoted(output));
    const int status = run_program({"gnuplot", "-e", setup, script});
    if (status == -1) {
      throw PictureError(
          fmt::format("{}: the numbers are written, but there is no gnuplot to draw the picture: install the Debian "
                      "package gnuplot-nox",
                      options.output.string()));
    }
    if (status != 0) throw PictureError(fmt::format("{}: gnuplot failed (exit code {}); its message is above", script, status));
  }
}

}  // namespace gp2::command
