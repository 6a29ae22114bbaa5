#include "gp2/jobs/generate_job.hpp"

#include <memory>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"

namespace gp2::command {

namespace {

struct GenerateArguments {
  std::string model, output;
  GenerateRequest request;
};

void run(const GenerateArguments& arguments) {
  const GenerateRequest& request = arguments.request;
  if (request.n.has_value() != request.grid.empty()) throw InputError("give either --n or --grid; see gp2 generate --help");
  require_output(arguments.output, {arguments.model});
  const Model model = Model::read(arguments.model);
  const GeneratedData data = generate(model, request);
  as_table(data, *model.system, arguments.output).write(arguments.output);
  print_notes({fmt::format("{}: {} rows of '{}'", arguments.output, data.states.cols(), model.system->name())});
}

}  // namespace

Command generate_command() {
  const auto a = std::make_shared<GenerateArguments>();
  return {
      "generate", "Generate data: states from a model's [sampling], accelerations from its [truth] plus noise",
      "gp2 generate models/surface.toml --n 100 --seed 1 -o train.csv",
      joined({{argument("MODEL", a->model, "model file")}, options(a->request), {output(a->output, "CSV", "CSV file to write")}}),
      [a](const std::set<std::string>&) { run(*a); }};
}

}  // namespace gp2::command
