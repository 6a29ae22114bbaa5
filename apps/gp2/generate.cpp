#include "gp2/simulation/generate.hpp"

#include <memory>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"

namespace gp2::command {

namespace {

struct Arguments {
  std::string model, output, grid;
  std::optional<int> n;
  std::uint64_t seed = 1;
  std::optional<double> noise_stddev;
};

Eigen::VectorXd noise_of(const Model& model, const std::optional<double>& given) {
  const Eigen::Index nq = model.system->nq();
  if (given) {
    if (!(*given >= 0)) throw InputError(fmt::format("--noise-std: must not be negative, got {}", *given));
    return Eigen::VectorXd::Constant(nq, *given);
  }
  if (model.noise.stddev.empty()) {
    throw InputError(fmt::format("{}: no [noise] ddq to draw from; give --noise-std S (0 for the truth)", model.name));
  }
  return Eigen::Map<const Eigen::VectorXd>(model.noise.stddev.data(), nq);
}

std::map<std::string, int> grid_of(const std::string& text) {
  std::map<std::string, int> grid;
  for (const std::string& item : parse_list(text)) {
    const std::size_t equals = item.find('=');
    int points = 0;
    if (equals == std::string::npos || equals == 0 || !CLI::detail::lexical_cast(item.substr(equals + 1), points)) {
      throw InputError(fmt::format("--grid: '{}' is not RANGE=POINTS, say q1=5", item));
    }
    if (!grid.emplace(item.substr(0, equals), points).second) {
      throw InputError(fmt::format("--grid: '{}' stands twice", item.substr(0, equals)));
    }
  }
  return grid;
}

void run(const Arguments& arguments) {
  if (arguments.n.has_value() != arguments.grid.empty()) throw InputError("give either --n or --grid; see gp2 generate --help");
  if (arguments.n && *arguments.n < 1) throw InputError(fmt::format("--n: must be positive, got {}", *arguments.n));
  require_output(arguments.output, {arguments.model});
  const Model model = Model::read(arguments.model);
  const GeneratedData data = generate(
      model, {arguments.n.value_or(1), arguments.seed, noise_of(model, arguments.noise_stddev), grid_of(arguments.grid)});

  const CsvTable table = as_table(data, *model.system, arguments.output);
  write_file(arguments.output, table.text());
  talk({fmt::format("{}: {} rows of '{}'", arguments.output, data.states.cols(), model.system->name())});
}

}  // namespace

void add_generate(CLI::App& app) {
  CLI::App* command = app.add_subcommand("generate", "Draw states from a model's [sampling] and measure its [truth]");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("MODEL", arguments->model, "model file")->required();
  command->add_option("--n", arguments->n, "number of rows, drawn at random");
  command->add_option("--grid", arguments->grid,
                      "a grid instead: the number of points of every range, q1=5,dq1=3,…; use with --noise-std 0 for test data");
  command->add_option("--seed", arguments->seed, "of the random numbers")->check(not_negative())->capture_default_str();
  command->add_option("--noise-std", arguments->noise_stddev,
                      "standard deviation of the noise on every ddq; 0 gives the truth (default: the model's [noise])");
  command->add_option("-o,--output", arguments->output, "CSV file to write")->required();
  command->footer("Example:\n  gp2 generate models/surface.toml --n 100 --seed 1 -o train.csv");
  command->callback([arguments] { run(*arguments); });
}

}  // namespace gp2::command
