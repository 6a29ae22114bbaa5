#include <memory>

#include <fmt/core.h>

#include "command.hpp"
#include "gp2/jobs/show_job.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

struct ShowArguments {
  std::string model;
  ShowRequest request;
};

}  // namespace

Command show_command() {
  const auto a = std::make_shared<ShowArguments>();
  Command command{
      "show", "Print the derived A, b, M, F, the parameters and the features of a model", "gp2 show models/surface.toml", {}, {}};
  command.options = options(a->request);
  command.options.insert(command.options.begin(), argument("MODEL", a->model, "model file"));
  command.run = [a](const std::set<std::string>&) { print_result("{}", show(Model::read(a->model), a->request)); };
  return command;
}

}  // namespace gp2::command
