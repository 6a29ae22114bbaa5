#include <fmt/ranges.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "published/acceptance.hpp"

// The published likelihoods and predictions, from the command with --start and --max-iterations 0.
namespace gp2::test {
namespace {

using nlohmann::json;

/// Relative tolerance of the likelihood, absolute one of normalised predictions: duffing has condition numbers of 1e9 to 1e11.
struct Tolerance {
  double likelihood, prediction;
};
Tolerance tolerance_of(const std::string& system) { return system == "duffing" ? Tolerance{1e-7, 5e-8} : Tolerance{1e-9, 1e-9}; }

class GoldenCommand : public testing::TestWithParam<std::string> {};

/// The published hyperparameters under the names of a fit.
json start_values(const json& golden, const std::vector<std::string>& parameters) {
  const Prior prior = make_prior(model(model_of(golden["system"])), {Prior::Mean::zero, std::nullopt, true});
  const std::vector<std::string>& features = prior.latents.front().feature_names;
  const json& theta = golden["theta"];
  json start = {{"signal_stddev", theta["signal_std"]}};
  for (std::size_t k = 0; k < features.size(); ++k) {
    start["lengthscale(" + features[k] + ")"] =
        theta["lengthscales"][k].get<double>() * golden["normalisation"]["x_std"][k].get<double>();
  }
  for (std::size_t k = 0; k < parameters.size(); ++k) start[parameters[k]] = theta["params"][k];
  return start;
}

/// The given rows of a CSV file, with its header.
std::string rows_of(const std::filesystem::path& file, const json& rows) {
  const CsvTable table = CsvTable::read(file);
  std::string csv = fmt::format("{}\n", fmt::join(table.header(), ","));
  for (const json& row : rows) {
    std::vector<std::string> cells;
    for (int column = 0; column < table.n_columns(); ++column) cells.push_back(table.cell(row, column));
    csv += fmt::format("{}\n", fmt::join(cells, ","));
  }
  return csv;
}

TEST_P(GoldenCommand, ReproducesLikelihoodsAndPredictions) {
  if (const auto absent = why_reference_is_absent()) GTEST_SKIP() << *absent;
  const std::string system = GetParam();
  const Tolerance tolerance = tolerance_of(system);
  const json every = reference_json("golden.json");
  int n_likelihoods = 0, n_predictions = 0;
  for (const json& golden : every) {
    if (golden["system"] != system) continue;
    SCOPED_TRACE(fmt::format("{} run {}", golden["variant"].get<std::string>(), golden["run"].dump()));
    const bool with_mean = golden["prior_mean_a"];
    std::vector<std::string> estimated;
    if (golden["variant"].get<std::string>().find("_est_") != std::string::npos) {
      estimated = with_mean ? published_system(system).parameters_with_mean : published_system(system).parameters_without_mean;
    }
    const Desk desk;
    desk.write("start.json", start_values(golden, estimated).dump());
    const json report =
        desk.done(fmt::format("gp2 fit {} --data '{}' --protocol paper --mean {} --estimate {} --noise-std {} --start start.json "
                              "--max-iterations 0 --json -o fit.json",
                              model_of(system), reference_file(golden["train_csv"].get<std::string>()).string(),
                              with_mean ? "force" : "zero",
                              estimated.empty() ? "none" : fmt::format("{}", fmt::join(estimated, ",")),
                              golden["theta"]["noise_std"][0].get<double>()))
            .json();
    double jacobian = 0;
    for (const json& spread : golden["normalisation"]["y_std"]) jacobian += std::log(spread.get<double>());
    const int n_data = CsvTable::read(reference_file(golden["train_csv"].get<std::string>())).n_rows();
    const double expected = golden["nll"]["independent_extended"];
    EXPECT_NEAR(report["nll"].get<double>() - n_data * jacobian, expected, tolerance.likelihood * std::abs(expected));
    ++n_likelihoods;

    if (!golden.contains("test_points")) continue;
    const json& points = golden["test_points"];
    desk.write("states.csv", rows_of(reference_file(golden["grid_csv"].get<std::string>()), points["grid_row"]));
    desk.done("gp2 predict fit.json --states states.csv --cov std -o prediction.csv");
    const CsvTable prediction = desk.table("prediction.csv");
    for (std::size_t i = 0; i < points["grid_row"].size(); ++i) {
      for (std::size_t k = 0; k < golden["normalisation"]["y_std"].size(); ++k) {
        const std::string name = fmt::format("ddq{}", k + 1);
        const double spread = golden["normalisation"]["y_std"][k], offset = golden["normalisation"]["y_mean"][k];
        const double mean = prediction.number(static_cast<int>(i), prediction.find(name));
        const double stddev = prediction.number(static_cast<int>(i), prediction.find(name + "_std"));
        EXPECT_NEAR((mean - offset) / spread, points["mean_normalised"][i][k].get<double>(), tolerance.prediction);
        EXPECT_NEAR(std::pow(stddev / spread, 2), points["latent_var_normalised"][i][k].get<double>(), tolerance.prediction);
        ++n_predictions;
      }
    }
  }
  const std::map<std::string, int> published = {{"surface", 5}, {"unicycle", 13}, {"duffing", 12}};
  EXPECT_EQ(n_likelihoods, published.at(system));
  EXPECT_GT(n_predictions, 0);
}

INSTANTIATE_TEST_SUITE_P(OfEverySystem, GoldenCommand, testing::Values("surface", "unicycle", "duffing"),
                         [](const auto& one) { return one.param; });

}  // namespace
}  // namespace gp2::test
