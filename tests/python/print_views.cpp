// For test_same_numbers.py:  print_views FIT.json STATES.csv OTHER.toml
//
// prints, for every view, each latent, and under OTHER: its name, then mean and covariance (column-major) of all states, as
// numbers that read back to the same bits.
#include <memory>
#include <string>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/data/csv.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/jobs/fit_problem.hpp"

namespace {

void print(const std::string& name, const gp2::Posterior& posterior, gp2::View view, const gp2::Model& model,
           const gp2::CsvTable& table) {
  view.time_step = 0.01;
  const gp2::Prior& prior = view.other_system ? view.other_system->prior : posterior.prior();
  const gp2::LogStates log = gp2::read_log_states(prior, view, model, table, {});
  const gp2::Posterior::Marginal prediction = posterior.marginal(view, log.states);
  fmt::print("{}", name);
  for (const double value : prediction.mean.reshaped()) fmt::print(" {}", gp2::shortest(value));
  for (const double value : prediction.covariance.reshaped()) fmt::print(" {}", gp2::shortest(value));
  fmt::print("\n");
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 4) return 2;
  const gp2::FitFile fit = gp2::FitFile::read(argv[1]);
  const gp2::CsvTable table = gp2::CsvTable::read(argv[2]);
  const gp2::Model other = gp2::Model::read(argv[3]);
  const gp2::Posterior posterior = fit.posterior();
  const gp2::System& system = *fit.model.system;
  for (const std::string& word : gp2::View::Quantity::words()) {
    const gp2::View view = gp2::View::all(*gp2::View::Quantity::of_word(word), system);
    print(word, posterior, view, fit.model, table);
    for (int latent = 0; latent < static_cast<int>(posterior.prior().latents.size()); ++latent) {
      gp2::View part = view;
      part.latent = latent;
      print(fmt::format("{}@{}", word, latent), posterior, part, fit.model, table);
    }
    gp2::View there = gp2::View::all(*gp2::View::Quantity::of_word(word), *other.system);
    there.other_system = gp2::make_other_system(fit.model, other, fit.prior_options);
    print(word + "@other", posterior, there, other, table);
  }
  return 0;
}
