#include <ostream>

#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "published/acceptance.hpp"

// The paper's set-up, optimised to the end: at least as good an optimum as the best known on each published data set.
namespace gp2::test {
namespace {

struct Variant {
  std::string system, name;

  [[nodiscard]] bool estimates() const { return name.find("_est_") != std::string::npos; }
  [[nodiscard]] bool has_mean() const { return name.ends_with("_mean"); }
  [[nodiscard]] std::vector<std::string> parameters() const {
    if (!estimates()) return {};
    const PublishedSystem& published = published_system(system);
    return has_mean() ? published.parameters_with_mean : published.parameters_without_mean;
  }
};

void PrintTo(const Variant& one, std::ostream* out) { *out << one.system << ' ' << one.name; }

std::vector<Variant> variants() {
  std::vector<Variant> all;
  for (const char* system : {"surface", "unicycle", "duffing"}) {
    for (const char* name : {"GP2_known_mean0", "GP2_known_mean", "GP2_est_mean0", "GP2_est_mean"}) all.push_back({system, name});
  }
  return all;
}

class PaperProtocol : public testing::TestWithParam<Variant> {};

TEST_P(PaperProtocol, ReachesTheConvergedOptimaOfThePublishedRuns) {
  if (const auto absent = why_reference_is_absent()) GTEST_SKIP() << *absent;
  const Variant& variant = GetParam();
  const nlohmann::json converged = reference_json("mle_converged.json").at(variant.system).at(variant.name);
  FitProblemOptions options;
  options.mean = variant.has_mean() ? Prior::Mean::force : Prior::Mean::zero;
  options.estimate = variant.parameters();
  options.protocol.name = Protocol::Name::paper;
  constexpr double margin = 0.05;
  std::vector<double> ours, theirs;  // errors of the runs that ended in the same optimum
  for (int run = 0; run < 5; ++run) {
    SCOPED_TRACE(fmt::format("{} {} run {}", variant.system, variant.name, run));
    const Score result =
        score(model(model_of(variant.system)), reference_file(fmt::format("train/{}_run{}.csv", variant.system, run)),
              reference_file("grid/" + variant.system + "_grid.csv"), options, 20);
    const nlohmann::json& known = converged.at(static_cast<std::size_t>(run));
    ASSERT_EQ(known["run"], run);
    const double lower_by = known["nll"].get<double>() - result.normalised_likelihood(100);
    EXPECT_GE(lower_by, -margin);
    if (lower_by < margin) {
      ours.push_back(result.evaluation.rmse_normalised);
      theirs.push_back(known["rmse"]);
    }
    EXPECT_LE(result.evaluation.max_constraint_error_fitted, published_system(variant.system).constraint_error);
    if (!variant.estimates()) {
      EXPECT_LE(result.evaluation.max_constraint_error, published_system(variant.system).constraint_error);
    }
  }
  if (!ours.empty()) {
    EXPECT_LE(mean(ours), 1.02 * mean(theirs));
  }
}

INSTANTIATE_TEST_SUITE_P(OfEveryVariant, PaperProtocol, testing::ValuesIn(variants()),
                         [](const auto& one) { return one.param.system + "_" + one.param.name; });

TEST(PaperProtocolCommand, IsTheLibrarys) {
  if (const auto absent = why_reference_is_absent()) GTEST_SKIP() << *absent;
  const Desk desk;
  const auto train = reference_file("train/unicycle_run0.csv"), grid = reference_file("grid/unicycle_grid.csv");
  const nlohmann::json report =
      desk.done("gp2 fit experiments/unicycle_published.toml --data '" + train.string() +
                "' --protocol paper --mean force --estimate R,Ic --restarts 20 --threads 2 --json -o fit.json")
          .json();
  const nlohmann::json figures = desk.done("gp2 evaluate fit.json --data '" + grid.string() + "' --json").json();
  FitProblemOptions options;
  options.mean = Prior::Mean::force;
  options.estimate = {"R", "Ic"};
  options.protocol.name = Protocol::Name::paper;
  const Score expected = score(model(model_of("unicycle")), train, grid, options, 20);
  EXPECT_EQ(report["nll"].get<double>(), expected.report.negative_log_likelihood);
  EXPECT_EQ(figures["rmse_normalised"].get<double>(), expected.evaluation.rmse_normalised);
}

}  // namespace
}  // namespace gp2::test
