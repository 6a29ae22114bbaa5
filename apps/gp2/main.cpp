#include <cstdio>
#include <exception>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/error.hpp"
#include "gp2/version.hpp"

namespace {

constexpr int exit_numerical = 1;
constexpr int exit_bad_input = 2;

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Learn the dynamics of constrained mechanical systems from measured data, with predictions that obey the constraints exactly."};
  app.name("gp2");
  app.require_subcommand(1);
  app.set_version_flag("--version", gp2::version());
  app.footer(
      "Example:\n"
      "  gp2 generate models/surface.toml --n 100 -o train.csv\n"
      "  gp2 fit models/surface.toml --data train.csv -o fit.json\n"
      "  gp2 predict fit.json --states train.csv --cov std -o prediction.csv\n\n"
      "Exit codes: 0 done, 1 numerical failure, 2 bad input. Results go to stdout, talk to stderr.");
  gp2::command::add_show(app);
  gp2::command::add_check(app);
  gp2::command::add_generate(app);
  gp2::command::add_fit(app);
  gp2::command::add_predict(app);
  gp2::command::add_evaluate(app);

  try {
    app.parse(argc, argv);
  } catch (const CLI::CallForHelp& help) {
    return app.exit(help);
  } catch (const CLI::CallForVersion& version) {
    return app.exit(version);
  } catch (const CLI::ParseError& error) {
    fmt::print(stderr, "gp2: error: {}\nRun gp2 --help, or gp2 COMMAND --help.\n", error.what());
    return exit_bad_input;
  } catch (const gp2::InputError& error) {
    fmt::print(stderr, "gp2: error: {}\n", error.what());
    return exit_bad_input;
  } catch (const gp2::NumericalError& error) {
    fmt::print(stderr, "gp2: numerical failure: {}\n", error.what());
    return exit_numerical;
  } catch (const std::bad_alloc&) {
    fmt::print(stderr, "gp2: numerical failure: not enough memory; take fewer points (--max-points)\n");
    return exit_numerical;
  } catch (const std::exception& error) {
    fmt::print(stderr, "gp2: internal error: {}\n", error.what());
    return exit_numerical;
  }
  return 0;
}
