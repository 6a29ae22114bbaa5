#include "gp2/generate.hpp"

#include <memory>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "command.hpp"
#include "gp2/csv.hpp"
#include "gp2/error.hpp"

namespace gp2::command {

namespace {

struct Arguments {
  std::string model, output;
  int n = 0;
  std::uint64_t seed = 1;
  std::optional<double> noise_stddev;
};

Eigen::VectorXd noise_of(const ModelFile& model, const std::optional<double>& given) {
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

// the columns that the model reads, then the accelerations
std::string csv_of(const GeneratedData& data, const System& system) {
  const std::vector<std::string> names = system.state_names();
  std::string csv;
  std::vector<std::string> line;
  const auto end_line = [&] {
    csv += fmt::format("{}\n", fmt::join(line, ","));
    line.clear();
  };
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (data.known[k]) line.push_back(names[k]);
  }
  for (const Coordinate& coordinate : system.coordinates()) line.push_back(coordinate.acceleration());
  end_line();
  for (Eigen::Index i = 0; i < data.states.cols(); ++i) {
    for (std::size_t k = 0; k < names.size(); ++k) {
      if (data.known[k]) line.push_back(shortest(data.states(static_cast<Eigen::Index>(k), i)));
    }
    for (const double value : data.accelerations.col(i)) line.push_back(shortest(value));
    end_line();
  }
  return csv;
}

void run(const Arguments& arguments) {
  if (arguments.n < 1) throw InputError(fmt::format("--n: must be positive, got {}", arguments.n));
  const ModelFile model = ModelFile::read(arguments.model);
  const GeneratedData data = generate(model, {arguments.n, arguments.seed, noise_of(model, arguments.noise_stddev)});

  write_file(arguments.output, csv_of(data, *model.system));
  talk({fmt::format("{}: {} rows of '{}'", arguments.output, arguments.n, model.system->name())});
}

}  // namespace

void add_generate(CLI::App& app) {
  CLI::App* command = app.add_subcommand("generate", "Draw states from a model's [sampling] and measure its [truth]");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("MODEL", arguments->model, "model file")->required();
  command->add_option("--n", arguments->n, "number of rows")->required();
  command->add_option("--seed", arguments->seed, "of the random numbers")->check(not_negative())->capture_default_str();
  command->add_option("--noise-std", arguments->noise_stddev,
                      "standard deviation of the noise on every ddq; 0 gives the truth (default: the model's [noise])");
  command->add_option("-o,--output", arguments->output, "CSV file to write")->required();
  command->footer("Example:\n  gp2 generate models/surface.toml --n 100 --seed 1 -o train.csv");
  command->callback([arguments] { run(*arguments); });
}

}  // namespace gp2::command
