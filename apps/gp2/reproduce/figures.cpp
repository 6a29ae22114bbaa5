#include <algorithm>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/inference/evaluation.hpp"
#include "gp2/simulation/generate.hpp"
#include "gp2/simulation/model_motion.hpp"
#include "reproduce/experiment.hpp"
#include "reproduce/table.hpp"

// Figures 3a and 3b of Geist & Trimpe 2020: posteriors and samples along lines of states.
namespace gp2::command {

namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Quantity = View::Quantity;

/// A figure shows one protocol: the default one, unless told otherwise.
Protocol::Name protocol_of(const ReproduceOptions& options) { return options.protocols.back(); }

/// GP² trained on the observations that a section names.
struct TrainedFigure {
  Model model;
  Trained trained;

  TrainedFigure(const Section& section, const Section& restarts, const ReproduceOptions& options)
      : model(Model::read(options.experiments / section.text("model"))),
        trained(train(model, {}, method(section, restarts), protocol_of(options),
                      observations_of(model, section.text("data"), options.data, 0, section.integer("n")), 0, options.threads)) {}

  [[nodiscard]] const Posterior& posterior() const { return trained.fit.posterior; }

 private:
  static Method method(const Section& section, const Section& restarts) {
    Method method;
    method.mean = section.mean();
    method.n_restarts = {{Protocol::Name::paper, restarts.integer("paper")},
                         {Protocol::Name::standard, restarts.integer("default")}};
    return method;
  }
};

// the running entry of a line, then a view's mean, standard deviation and truth
Table along(const Line& line, const System& system, const Posterior& posterior, const View& view, const MatrixXd& truth) {
  const std::vector<std::string> entries = system.state_names();
  const Index running = std::find(entries.begin(), entries.end(), line.name) - entries.begin();
  const Posterior::Marginal prediction = posterior.marginal(view, line.states);
  const MatrixXd stddev = prediction.stddev();
  const std::vector<std::string> names = view.names(system);
  Table table;
  for (Index i = 0; i < line.states.cols(); ++i) {
    Table::Row row = {{line.name, line.states(running, i)}};
    for (std::size_t k = 0; k < names.size(); ++k) {
      const auto j = static_cast<Index>(k);
      row[names[k]] = prediction.mean(j, i);
      row[names[k] + "_std"] = stddev(j, i);
      row[names[k] + "_truth"] = truth(j, i);
    }
    table.add(std::move(row));
  }
  return table;
}

}  // namespace

void reproduce_fig3a(const ReproduceOptions& options) {
  const Section definition = Section::read(options.experiments / "fig3a.toml");
  const TrainedFigure figure(definition, definition.section("restarts"), options);
  const View here = View::constrained_acceleration(*figure.model.system);
  const Line line = line_of(definition.section("line"), figure.model);
  along(line, *figure.model.system, figure.posterior(), here, line.truth).write(options.output / "fig3a_same_surface");

  // the same latents under the other surface (eq. 10)
  const Model other = Model::read(options.experiments / definition.text("other"));
  View there = here;
  there.other_system = make_other_system(figure.model, other, figure.trained.problem.prior_options);
  const Line line_there = line_of(definition.section("line"), other);
  along(line_there, *other.system, figure.posterior(), there, line_there.truth).write(options.output / "fig3a_other_surface");
  plot(options, "fig3a");
}

void reproduce_fig3b(const ReproduceOptions& options) {
  const Section definition = Section::read(options.experiments / "fig3b.toml");
  const Section restarts = definition.section("restarts");
  const int n_samples = definition.integer("samples");

  // samples of ddq1 before and after conditioning
  const Section samples_of = definition.section("samples_of");
  const TrainedFigure figure(samples_of, restarts, options);
  const System& system = *figure.model.system;
  const Line line = line_of(samples_of.section("line"), figure.model);
  const View all = View::constrained_acceleration(system);
  const MatrixXd before = figure.posterior().without_data().sample({{all, line.states}}, n_samples, 1);
  const MatrixXd after = figure.posterior().sample({{all, line.states}}, n_samples, 1);
  const Posterior::Marginal prediction = figure.posterior().marginal(all, line.states);
  const MatrixXd stddev = prediction.stddev();
  Table samples;
  double worst = 0;
  for (Index i = 0; i < line.states.cols(); ++i) {
    const std::vector<std::string> entries = system.state_names();
    const Index running = std::find(entries.begin(), entries.end(), line.name) - entries.begin();
    Table::Row row = {{line.name, line.states(running, i)},
                      {"ddq1", prediction.mean(0, i)},
                      {"ddq1_std", stddev(0, i)},
                      {"ddq1_truth", line.truth(0, i)}};
    for (int s = 0; s < n_samples; ++s) row[fmt::format("prior_sample{}", s + 1)] = before(i * all.size(), s);
    for (int s = 0; s < n_samples; ++s) row[fmt::format("posterior_sample{}", s + 1)] = after(i * all.size(), s);
    samples.add(std::move(row));
  }
  samples.write(options.output / "fig3b_samples");
  for (const MatrixXd& of : {before, after}) {
    for (int s = 0; s < n_samples; ++s) {
      worst = std::max(worst, max_constraint_error(system, line.states, figure.posterior().values().parameters,
                                                   of.col(s).reshaped(all.size(), line.states.cols())));
    }
  }
  print_notes({fmt::format("fig3b: largest |A ddq − b| of {} samples: {:.2g}", 2 * n_samples, worst)});

  for (const Section& section : definition.sections("unconstrained")) {
    const TrainedFigure inferred(section, restarts, options);
    const Line of = line_of(section.section("line"), inferred.model);
    const View a_bar = View::unconstrained_acceleration(*inferred.model.system);
    along(of, *inferred.model.system, inferred.posterior(), a_bar,
          ModelMotion(inferred.model).unconstrained_acceleration(of.states))
        .write(options.output / fmt::format("fig3b_abar_{}", section.text("name")));
  }
  plot(options, "fig3b");
}

}  // namespace gp2::command
