#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <thread>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <pybind11/stl.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "gp2/base/file.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/inverse_dynamics.hpp"
#include "gp2/jobs/export_job.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/fit_memory.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/jobs/shoot_job.hpp"
#include "gp2/jobs/update_job.hpp"
#include "options.hpp"
#include "pickles.hpp"

// for pickles
namespace gp2 {

static auto fields(Calibration& of) {
  return std::tie(of.coverage50, of.coverage80, of.coverage95, of.coverage50_latent, of.coverage80_latent, of.coverage95_latent,
                  of.pit);
}
static auto fields(Evaluation::Part& of) {
  return std::tuple_cat(fields(static_cast<Calibration&>(of)), std::tie(of.n, of.nrmse));
}
static auto fields(Evaluation& of) {
  return std::tuple_cat(
      fields(static_cast<Calibration&>(of)),
      std::tie(of.outputs, of.rmse, of.rmse_normalised, of.nrmse, of.max_constraint_error, of.max_constraint_error_fitted,
               of.nlpd, of.nlpd_latent, of.n_zero_variance, of.near, of.far, of.n, of.n_missing));
}
static auto fields(LeftOutScores& of) { return std::tie(of.view, of.one_by_one, of.stretches, of.values, of.nrmse_of_noise); }
static auto fields(TrainingResidual& of) {
  return std::tie(of.group, of.output, of.n, of.rms, of.coverage95, of.serial_correlation, of.n_serial, of.rms_in_noise, of.n_far,
                  of.farthest, of.farthest_state, of.is_of_ddq);
}
static auto fields(CrossValidation& of) {
  return std::tuple_cat(fields(static_cast<LeftOutScores&>(of)), std::tie(of.other_views, of.residuals));
}
static auto fields(InverseDynamics& of) { return std::tie(of.inputs, of.covariance, of.missed); }

}  // namespace gp2

namespace gp2::python {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

// ---------------------------------------------------------------- views

/// The keywords that name a view.
struct ViewArguments {
  std::string quantity = "constrained";
  const PySystem* system = nullptr;
  std::optional<std::string> latent;
  std::optional<double> time_step;
};

ViewRequest view_request(const ViewArguments& arguments) {
  return {quantity_argument(arguments.quantity), arguments.time_step, arguments.latent, model_of(arguments.system)};
}

/// A view, and the states at which it is asked for.
struct Asked {
  ViewRequest request;  // whose model of another system keeps alive what the view looks at
  PredictedView at;
  States states;

  Asked(const PyPosterior& self, ViewRequest request_of_view, const py::object& data, const py::object& columns)
      : request(std::move(request_of_view)),
        at(predicted_view(self.file, self.posterior.prior(), request)),
        states(data, at, parameters_of(at.view, self.posterior.values().parameters), columns) {}

  /// What `work` says without the interpreter's lock, with the table named in what it throws.
  template <typename Work>
  auto unlocked_and_named(const Work& work) const {
    return states.named([&] { return unlocked(work); });
  }
};

// ---------------------------------------------------------------- predictions

struct Prediction {
  py::array mean;
  std::optional<py::array> std, cov;
  py::array distance_from_data;
  std::vector<std::string> names;
  int n_clipped = 0;
};
auto fields(Prediction& of) { return std::tie(of.mean, of.std, of.cov, of.distance_from_data, of.names, of.n_clipped); }

/// States between two looks for Ctrl-C: some tenths of a second of work, in whole blocks of what the library takes at once.
Index states_between_signals(const Posterior& posterior, bool mean_only, Index d, int n_threads) {
  const auto n = static_cast<double>(posterior.reduced_size());
  const double operations_per_state = mean_only ? 100 * (n + 1) : static_cast<double>(d) * n * (n + 100) + 1;
  const double threads = n_threads > 0 ? n_threads : std::max(1U, std::thread::hardware_concurrency());
  constexpr double block = 256, most_blocks = 1000;
  return static_cast<Index>(block * std::clamp(std::floor(1e9 * threads / operations_per_state / block), 1.0, most_blocks));
}

Prediction predict(const PyPosterior& self, const py::object& data, const ViewArguments& arguments, bool mean_only,
                   const py::object& columns, int n_threads) {
  require_at_least(0, n_threads, "threads");
  const Asked asked(self, view_request(arguments), data, columns);
  const View& view = asked.at.view;
  const auto x = asked.states.matrix();
  const Index d = view.size(), n = x.cols();
  MatrixXd mean(d, n), stddev(mean_only ? 0 : d, n), covariance(mean_only ? 0 : d * d, n);
  VectorXd distance(n);
  Prediction out;
  const Posterior posterior = self.posterior;  // stays as it is, whatever another Python thread does with self
  const Index most = states_between_signals(posterior, mean_only, d, n_threads);
  for (Index first = 0; first < n; first += most) {
    const Index size = std::min(most, n - first);
    asked.unlocked_and_named([&] {
      try {
        if (mean_only) {
          mean.middleCols(first, size) = posterior.mean(view, x.middleCols(first, size), n_threads);
        } else {
          const Posterior::Marginal block = posterior.marginal(view, x.middleCols(first, size), n_threads);
          mean.middleCols(first, size) = block.mean;
          stddev.middleCols(first, size) = block.stddev();
          covariance.middleCols(first, size) = block.covariance;
          out.n_clipped += block.n_clipped;
        }
        distance.segment(first, size) = posterior.distance_from_data(view, x.middleCols(first, size), n_threads);
      } catch (const InputError&) {
        // once more, to name the state by its number among all
        static_cast<void>(posterior.mean(view, x.leftCols(first + size), n_threads));
        throw;
      }
    });
    if (PyErr_CheckSignals() != 0) throw py::error_already_set();
  }
  // arrays may be single states of a loop, which is not to be slowed down
  if (!mean_only && !is_array(data)) {
    for (const auto& note : unlocked([&] {
           return std::array{note_of_distance(distance), note_of_untold(posterior, asked.at, x, mean, distance)};
         })) {
      if (note) tell({*note});
    }
  }
  out.distance_from_data = to_vector(std::move(distance));
  out.names = asked.at.names;
  out.mean = to_rows(std::move(mean));
  if (!mean_only) {
    out.std = to_rows(std::move(stddev));
    out.cov = to_matrices(covariance, d, d);
  }
  return out;
}

py::array asked_for(const std::optional<py::array>& values) {
  if (!values) throw py::attribute_error("this prediction was made with mean_only=True");
  return *values;
}

py::tuple joint(const PyPosterior& self, const py::object& data, const ViewArguments& arguments, const py::object& columns) {
  const Asked asked(self, view_request(arguments), data, columns);
  const Posterior posterior = self.posterior;
  require_memory_of_joint(posterior, asked.at.view, asked.states.matrix().cols(), free_memory());
  Posterior::Joint result = asked.unlocked_and_named([&] { return posterior.joint(asked.at.view, asked.states.matrix()); });
  return py::make_tuple(to_vector(std::move(result.mean)), to_rows(std::move(result.covariance)));
}

py::array sample(const PyPosterior& self, const py::object& data, int n_samples, std::uint64_t seed,
                 const ViewArguments& arguments, const py::object& columns) {
  require_at_least(1, n_samples, "n_samples");
  const Asked asked(self, view_request(arguments), data, columns);
  const Posterior posterior = self.posterior;
  require_memory_of_samples(posterior, asked.at.view, asked.states.matrix().cols(), n_samples, free_memory());
  MatrixXd samples = asked.unlocked_and_named([&] {
    return posterior.sample({{asked.at.view, asked.states.matrix()}}, n_samples, seed);
  });
  const Index d = asked.at.view.size(), n = asked.states.matrix().cols();
  return to_rows(std::move(samples)).attr("reshape")(n_samples, n, d);
}

// the energy of a potential, less that at the first state, and its deviation
py::tuple potential_of(const PyPosterior& self, const py::object& data, const std::string& latent, const py::object& columns) {
  const Prior& prior = self.posterior.prior();
  const LatentRange range = latents_called(prior, latent, "`latent`");
  const Asked asked(self, ViewRequest(), data, columns);
  const auto x = asked.states.matrix();
  if (x.cols() == 0) return py::make_tuple(to_vector(VectorXd()), to_vector(VectorXd()));
  const Posterior posterior = self.posterior;
  Posterior::Potential energy = asked.unlocked_and_named([&] { return posterior.potential(range.first, x, x.col(0)); });
  return py::make_tuple(to_vector(std::move(energy.mean)), to_vector(std::move(energy.stddev)));
}

// ---------------------------------------------------------------- inverse dynamics

/// gp2.Inputs
struct Inputs {
  InverseDynamics found;
  std::vector<std::string> names;
};
auto fields(Inputs& of) { return std::tie(of.found, of.names); }

Inputs inverse_dynamics_of(const PyPosterior& self, const py::object& data, const py::object& accelerations,
                           const GivenNames& given_outputs, const PySystem* system, const py::object& columns) {
  const std::vector<std::string> outputs = names_or_all(given_outputs, "outputs");
  const FitSystem at = system_of(self.file, self.posterior.prior(), model_of(system));
  const System& there = *at.model->system;
  WantedMotion wanted;
  if (is_array(data)) {
    if (accelerations.is_none()) throw InputError("accelerations: needed beside an array of states");
    require_no_columns(columns);
    wanted.view = {View::Quantity::constrained_acceleration, acceleration_rows(there, outputs, "`outputs`")};
    const Rows states(data, there.state_names(), "states"), values(accelerations, wanted.view.names(there), "accelerations");
    wanted.states = states.matrix();
    wanted.accelerations = values.matrix();
  } else {
    if (!accelerations.is_none() || !outputs.empty()) {
      throw InputError("accelerations and outputs go with an array of states; those of a table are its columns");
    }
    const Eigen::VectorXd& fitted = self.posterior.values().parameters;
    wanted = read_wanted_motion(at.prior, *at.model, to_table(data, "states"), columns_argument(columns),
                                at.other_system ? at.other_system->parameters(fitted) : fitted);
    tell(wanted.notes);
  }
  wanted.view.other_system = at.other_system;
  const Posterior posterior = self.posterior;
  InverseDynamics found = unlocked([&] { return inverse_dynamics(posterior, wanted.view, wanted.states, wanted.accelerations); });
  if (const auto note = note_of_open_inputs(found, *at.model, "states")) tell({*note});
  return {std::move(found), there.inputs()};
}

void add_inputs(py::module_& module) {
  py::class_<Inputs>(module, "Inputs", "Inputs that produce wanted accelerations at n states.")
      .def_property_readonly(
          "inputs", [](const Inputs& i) { return read_only(to_rows(i.found.inputs)); }, "What acts (n, nu).")
      .def_property_readonly(
          "std", [](const Inputs& i) { return read_only(to_rows(i.found.stddev())); }, "Standard deviations (n, nu).")
      .def_property_readonly(
          "cov",
          [](const Inputs& i) {
            const Index nu = i.found.inputs.rows();
            return read_only(to_matrices(i.found.covariance, nu, nu));
          },
          "Covariance at each state (n, nu, nu).")
      .def_property_readonly(
          "missed", [](const Inputs& i) { return read_only(to_rows(i.found.missed)); },
          "Wanted less predicted accelerations under these inputs (n, d): rounding where the wanted can be produced.")
      .def_readonly("names", &Inputs::names, "Of the inputs.")
      .def("__repr__",
           [](const Inputs& i) {
             return fmt::format("<gp2.Inputs {} at {} states>", fmt::join(i.names, ", "), i.found.inputs.cols());
           })
      .def(pickled<Inputs>());
}

// ---------------------------------------------------------------- figures

Evaluation evaluate_posterior(const PyPosterior& self, const py::object& data, const PySystem* system, const GivenNames& outputs,
                              const py::object& columns, int n_threads) {
  const EvaluateRequest request{names_or_all(outputs, "outputs"), model_of(system), columns_argument(columns), n_threads};
  const CsvTable table = to_table(data, "data");
  const PyPosterior held = self;
  EvaluateOutcome outcome =
      run_or_raise([&](const std::atomic<bool>* stop) { return evaluate(held.file, held.posterior, table, request, stop); });
  tell(outcome.notes);
  return std::move(outcome.evaluation);
}

py::tuple shoot_posterior(const PyPosterior& self, const py::object& data, std::optional<double> duration, int stretches,
                          const py::object& columns, int n_threads) {
  using namespace py::literals;
  const ShootRequest request{duration, stretches, columns_argument(columns), n_threads};
  const CsvTable table = to_table(data, "data", CsvTable::Keep::text);
  FitFile file = self.file;
  file.take_data(self.posterior);
  ShootOutcome shot = run_or_raise([&](const std::atomic<bool>* stop) { return shoot(file, table, request, stop); });
  Posterior posterior = unlocked([&] { return shot.fit.posterior(); });
  tell(shot.notes);
  py::dict parameters, rms;
  for (const ShotParameter& one : shot.parameters) {
    parameters[py::str(one.name)] = py::dict("one_by_one"_a = one.one_step, "one_by_one_std"_a = one.one_step_stddev,
                                             "value"_a = one.value, "std"_a = one.stddev);
  }
  for (std::size_t c = 0; c < shot.coordinates.size(); ++c) {
    const auto k = static_cast<Index>(c);
    rms[py::str(shot.coordinates[c])] = py::make_tuple(shot.rms_before[k], shot.rms_after[k]);
  }
  shot.fit.observations.clear();
  py::dict report("parameters"_a = parameters, "rms"_a = rms, "duration"_a = shot.duration, "stretches"_a = shot.n_stretches,
                  "iterations"_a = shot.iterations, "converged"_a = shot.converged);
  return py::make_tuple(PyPosterior{std::move(shot.fit), std::move(posterior), {}}, report);
}

// ---------------------------------------------------------------- data that grow

// Changes are in place and under the interpreter's lock: other Python threads see them before or after. But Python functions of a
// model take that lock, in several threads: there a copy is changed without it.
template <typename Work>
void change(PyPosterior& self, const Work& work) {
  if (!self.has_code()) return work(self);
  PyPosterior copy = self;
  unlocked([&] { work(copy); });
  self = std::move(copy);
}

// Adds observations, between what `forget` and `window` ask for.
void add_observations(PyPosterior& self, Observations more, const CsvTable& log, const UpdateRequest& request,
                      std::vector<std::string>& notes) {
  FitFile& file = self.file;
  if (!request.forget && !request.window) {
    self.posterior = with_more(std::move(self.posterior), file, std::move(more), log, notes);
    return;
  }
  // a step that is refused undoes those before it
  const auto undo = [&file, prior = file.prior_options, draws = file.report.draws, distrusted = file.report.distrusted,
                     logs = file.logs, source = file.data_source, said = file.notes] {
    file.prior_options = prior;
    file.report.draws = draws;
    file.report.distrusted = distrusted;
    file.notes = said;
    file.logs = logs;
    file.data_source = source;
  };
  Posterior next = self.posterior;
  try {
    if (request.forget) next = forget(std::move(next), *request.forget);
    make_room(next, file, more, request);
    next = with_more(std::move(next), file, std::move(more), log, notes);
    keep_newest(next, file, request);
  } catch (...) {
    undo();
    throw;
  }
  self.posterior = std::move(next);
}

void update_with(PyPosterior& self, const py::object& data, const GivenNames& observe, const std::optional<double>& noise_stddev,
                 const py::object& columns, const std::optional<double>& share, const std::optional<int>& window) {
  const UpdateRequest request{names_or_all(observe, "observe"), noise_stddev, columns_argument(columns), share, window};
  std::vector<std::string> notes;
  const CsvTable log = to_table(data, "data");
  const auto read = [&](const PyPosterior& at) { return more_observations(at.file, at.posterior, log, request, notes); };
  Observations more = self.has_code() ? unlocked([&, held = self] { return read(held); }) : read(self);
  tell(std::exchange(notes, {}));
  change(self, [&](PyPosterior& changed) { add_observations(changed, std::move(more), log, request, notes); });
  tell(notes);
}

// ---------------------------------------------------------------- files

PyPosterior load(const py::object& path, const PySystem* system) {
  FitFile file = read_fit(path, system);
  Posterior posterior = unlocked([&] { return file.posterior(); });
  file.observations.clear();
  std::vector<std::string> notes = with_keywords(file.notes.value_or(std::vector<std::string>()));
  return {std::move(file), std::move(posterior), std::move(notes)};
}

void save(const PyPosterior& self, const py::object& path) {
  if (self.posterior.observations().empty()) {
    throw InputError("a posterior without data is not saved: save the fit, and call without_data() of what gp2.load gives");
  }
  FitFile file = self.file;
  file.take_data(self.posterior);
  const std::filesystem::path to = path_argument(path);
  unlocked([&] { file.write(to); });
  std::vector<std::string> notes;
  if (self.file.model.code && std::ranges::any_of(file.systems, [&](const auto& one) {
        return one && one->code && one->system != self.file.model.system;
      })) {
    notes.emplace_back(
        "warning: several systems of this fit are functions, but gp2.load takes one: the file is read only if their functions "
        "are the same");
  }
  tell(notes);
}

// ---------------------------------------------------------------- classes of results

void add_prediction(py::module_& module) {
  py::class_<Prediction>(module, "Prediction", "A view at n states, of d rows: the latent quantity, without measurement noise.")
      .def_readonly("mean", &Prediction::mean, "(n, d)")
      .def_property_readonly(
          "std", [](const Prediction& p) { return asked_for(p.std); }, "Standard deviations (n, d).")
      .def_property_readonly(
          "cov", [](const Prediction& p) { return asked_for(p.cov); }, "Covariance at each state (n, d, d).")
      .def_readonly("distance_from_data", &Prediction::distance_from_data,
                    "How far each state lies from the observed ones (n): beyond gp2.FAR_FROM_DATA deviations are too small as a "
                    "rule.")
      .def_readonly("names", &Prediction::names, "Of the d rows, as the columns of gp2 predict.")
      .def_readonly("n_clipped", &Prediction::n_clipped, "Variances that rounding made negative; they are 0.")
      .def("__repr__",
           [](const Prediction& p) {
             return fmt::format("<gp2.Prediction of {} at {} states>", fmt::join(p.names, ", "), p.mean.shape(0));
           })
      .def(pickled<Prediction>());
}

std::string coverage_text(const Calibration& c) {
  return fmt::format("coverage {:.3g}, {:.3g}, {:.3g} at 50, 80, 95 %", c.coverage50, c.coverage80, c.coverage95);
}

void add_evaluation(py::module_& module) {
  module.attr("FAR_FROM_DATA") = Posterior::far_from_data;
  py::class_<Calibration>(module, "Calibration",
                          "How errors lie within their predicted Gaussian marginals; NaN where there are none.")
      .def_readonly("coverage50", &Calibration::coverage50, "Share of measurements in their 50 % intervals.")
      .def_readonly("coverage80", &Calibration::coverage80, "In their 80 % intervals.")
      .def_readonly("coverage95", &Calibration::coverage95, "In their 95 % intervals.")
      .def_readonly("coverage50_latent", &Calibration::coverage50_latent, "The same of noise-free targets.")
      .def_readonly("coverage80_latent", &Calibration::coverage80_latent, "In their 80 % intervals.")
      .def_readonly("coverage95_latent", &Calibration::coverage95_latent, "In their 95 % intervals.")
      .def_property_readonly(
          "pit", [](const Calibration& c) { return read_only(to_vector(c.pit)); },
          "Share of measurements in each tenth of their predictive distributions: all 0.1 where errors are as predicted.")
      .def("__repr__", [](const Calibration& c) { return fmt::format("<gp2.Calibration: {}>", coverage_text(c)); })
      .def(pickled<Calibration>());
  py::class_<Evaluation::Part, Calibration>(module, "EvaluationPart", "Figures of some of the points.")
      .def_readonly("n", &Evaluation::Part::n, "Of these points.")
      .def_readonly("nrmse", &Evaluation::Part::nrmse, "Rms error over rms of the test spreads of all points.")
      .def("__repr__",
           [](const Evaluation::Part& of) {
             return fmt::format("<gp2.EvaluationPart of {} points: nrmse {:.4g}; {}>", of.n, of.nrmse, coverage_text(of));
           })
      .def(pickled<Evaluation::Part>());
  py::class_<LeftOutScores>(module, "LeftOutScores", "Scores of the data of one view, where the fit has not seen them.")
      .def_readonly("view", &LeftOutScores::view, "Such as multipliers; empty: the accelerations.")
      .def_readonly("one_by_one", &LeftOutScores::one_by_one, "Each row from all others.")
      .def_readonly(
          "stretches", &LeftOutScores::stretches,
          "Each of five stretches of time from the rest: what a motion elsewhere would meet. None where the rows are in "
          "no order of time.")
      .def(pickled<LeftOutScores>());
  py::class_<CrossValidation, LeftOutScores>(module, "CrossValidation",
                                             "Scores of the data of a fit, where it has not seen them.")
      .def_readonly("other_views", &CrossValidation::other_views, "Of data of other views, as of forces.")
      .def("__repr__", [](const CrossValidation& c) { return fmt::format("<gp2.CrossValidation: {}>", c.text()); })
      .def(pickled<CrossValidation>());
  py::class_<Evaluation, Calibration>(module, "Evaluation", "How well a posterior predicts measured accelerations.")
      .def_readonly("outputs", &Evaluation::outputs, "Names of the accelerations.")
      .def_property_readonly(
          "rmse", [](const Evaluation& e) { return read_only(to_vector(e.rmse)); }, "Per output, physical units.")
      .def_readonly("rmse_normalised", &Evaluation::rmse_normalised, "Mean over outputs of rmse / training std.")
      .def_readonly("nrmse", &Evaluation::nrmse, "Rms error over rms of the test spreads.")
      .def_readonly("max_constraint_error", &Evaluation::max_constraint_error, "max |A ddq - b|, the model's parameters.")
      .def_readonly("max_constraint_error_fitted", &Evaluation::max_constraint_error_fitted, "The same with the fitted ones.")
      .def_readonly("nlpd", &Evaluation::nlpd, "Negative log predictive density of measurements.")
      .def_readonly("nlpd_latent", &Evaluation::nlpd_latent, "The same of noise-free targets.")
      .def_readonly("n_zero_variance", &Evaluation::n_zero_variance,
                    "Marginals without variance, left out of the latent figures.")
      .def_readonly("near", &Evaluation::near, "Of the points near the data.")
      .def_readonly("far", &Evaluation::far, "Of those farther from the data than FAR_FROM_DATA.")
      .def_readonly("n", &Evaluation::n, "Points.")
      .def_readonly("n_missing", &Evaluation::n_missing, "Targets that are not measured, left out of all figures.")
      .def("__repr__",
           [](const Evaluation& e) {
             std::string rmse;
             for (std::size_t k = 0; k < e.outputs.size(); ++k) {
               rmse += fmt::format("{}rmse {} {:.4g}", k == 0 ? "" : ", ", e.outputs[k], e.rmse[static_cast<Index>(k)]);
             }
             return fmt::format("<gp2.Evaluation at {} points: {}; nrmse {:.4g}; max |A ddq - b| {:.2g}>", e.n, rmse, e.nrmse,
                                e.max_constraint_error_fitted);
           })
      .def(pickled<Evaluation>());
}

// ---------------------------------------------------------------- methods of a posterior

void define_files_and_facts(py::class_<PyPosterior>& posterior) {
  using namespace py::literals;
  posterior
      .def_static("load", &load, "path"_a, "system"_a = nullptr,
                  "As gp2.load.\n\nRaises InputError naming the file and what is wrong.")
      .def("save", &save, "path"_a,
           "Write a FIT.json, whole or not at all. Loaded again it gives the same bits, after an update the same to rounding.")
      .def_property_readonly(
          "system", [](const PyPosterior& self) { return PySystem{std::make_shared<const Model>(self.file.model)}; },
          "What was fitted, with the model file's values of parameters.")
      .def_property_readonly(
          "report", [](const PyPosterior& self) { return self.file.report; }, "How the fit went.")
      .def_property_readonly(
          "options",
          [](const PyPosterior& self) -> py::object {
            if (self.file.options.empty()) return py::none();
            return py::module_::import("json").attr("loads")(self.file.options);
          },
          "What the fit was asked, a dict under the names of the options of gp2 fit; None where a file does not say.")
      .def_property_readonly("_has_code", &PyPosterior::has_code)
      .def_readonly("notes", &PyPosterior::notes,
                    "What the reading of the data and the fit had to say; of a file, what the fit had.")
      .def_property_readonly(
          "n_data", [](const PyPosterior& self) { return self.posterior.n_states(); }, "Observed states.")
      .def_property_readonly(
          "negative_log_likelihood", [](const PyPosterior& self) { return self.posterior.negative_log_likelihood(); },
          "-log p(y) of the observations, physical units, without hyper-prior.")
      .def_property_readonly(
          "parameters",
          [](const PyPosterior& self) {
            py::dict values;
            const std::vector<Parameter>& parameters = self.system().parameters();
            for (std::size_t k = 0; k < parameters.size(); ++k) {
              values[py::str(parameters[k].name)] = self.posterior.values().parameters[static_cast<Index>(k)];
            }
            // of a mixture each component has its own
            for (const Hyperparameter& h : self.file.report.hyperparameters) {
              if (h.is_system_parameter()) values[py::str(h.name)] = h.value;
            }
            return values;
          },
          "The system's parameters, with the fitted values of those that were estimated.");
}

void define_predict(py::class_<PyPosterior>& posterior) {
  using namespace py::literals;
  posterior.def(
      "predict",
      [](const PyPosterior& self, const py::object& states, const std::string& view, const PySystem* system,
         const std::optional<std::string>& latent, const std::optional<double>& dt, bool mean_only, const py::object& columns,
         int threads) {
        return predict(self, states, ViewArguments{view, system, latent, dt}, mean_only, columns, threads);
      },
      "states"_a, "view"_a = "constrained", py::kw_only(), "system"_a = nullptr, "latent"_a = py::none(), "dt"_a = py::none(),
      "mean_only"_a = false, "columns"_a = py::none(), "threads"_a = 0,
      R"(Predict a view at states (n, len(state_names)), or at those of a table by column names.

view       'constrained': ddq (d = nq); 'unconstrained': the acceleration without constraints; 'constraint-force': A'λ;
           'multipliers': λ (d = nc); 'next-velocity': dq + dt ddq; 'force': the applied force that was learned, in N or N m
system     another System with the same coordinates, inputs and latents: under its constraints, masses and parameters
latent     only what this latent adds, by its name
dt         time step of 'next-velocity' [s]
mean_only  leaves out std and cov, which cost more by two orders
columns    columns of a table by other names: {"q1": "theta"}
threads    at most so many; 0: all cores. The result does not depend on it

Returns a Prediction with mean (n, d), std (n, d), cov (n, d, d). Of a table, the logger 'gp2' tells where deviations are too small, as
gp2 predict does; arrays of states, which a loop may hand over one by one, are predicted and no more.
Raises InputError for states that are not finite where they are read, or contradict the constraints.)");
}

void define_joint_and_sample(py::class_<PyPosterior>& posterior) {
  using namespace py::literals;
  posterior
      .def(
          "joint",
          [](const PyPosterior& self, const py::object& states, const std::string& view, const PySystem* system,
             const std::optional<std::string>& latent, const std::optional<double>& dt, const py::object& columns) {
            return joint(self, states, ViewArguments{view, system, latent, dt}, columns);
          },
          "states"_a, "view"_a = "constrained", py::kw_only(), "system"_a = nullptr, "latent"_a = py::none(), "dt"_a = py::none(),
          "columns"_a = py::none(), "Mean (n d) and covariance (n d, n d) of all states together, state after state.")
      .def(
          "sample",
          [](const PyPosterior& self, const py::object& states, int n_samples, std::uint64_t seed, const std::string& view,
             const PySystem* system, const std::optional<std::string>& latent, const std::optional<double>& dt,
             const py::object& columns) {
            return sample(self, states, n_samples, seed, ViewArguments{view, system, latent, dt}, columns);
          },
          "states"_a, "n_samples"_a = 1, "seed"_a = 0, "view"_a = "constrained", py::kw_only(), "system"_a = nullptr,
          "latent"_a = py::none(), "dt"_a = py::none(), "columns"_a = py::none(),
          "Draws of a view at all states together (n_samples, n, d). Each obeys A ddq = b. Same seed, same samples.");
}

void define_potential(py::class_<PyPosterior>& posterior) {
  using namespace py::literals;
  posterior.def("potential", &potential_of, "states"_a, "latent"_a, py::kw_only(), "columns"_a = py::none(),
                R"(The energy of a latent with directions = "potential", and its standard deviation: two arrays (n) [J].

It is relative to the first state, for accelerations say nothing of a constant in it.)");
}

void define_inverse_dynamics(py::class_<PyPosterior>& posterior) {
  using namespace py::literals;
  posterior.def("inverse_dynamics", &inverse_dynamics_of, "states"_a, "accelerations"_a = py::none(), py::kw_only(),
                "outputs"_a = py::none(), "system"_a = nullptr, "columns"_a = py::none(),
                R"(The inputs that produce wanted accelerations under the constraints, with their deviation.

states         (n, len(state_names)), whose inputs are where the search begins; or a table with the states and, as its columns
               ddq…, the accelerations that are wanted
accelerations  of an array of states: those wanted (n, d)
outputs        which they are; default: all
system         another System with the same coordinates, inputs and latents

Returns Inputs. Where no inputs produce the accelerations it is those that come nearest, in the sense of Gauss' principle; where several
inputs do the same, or one does nothing, the least change of them, and a note names these inputs. Where an input turns around what it does its deviation is immense or NaN.
Raises NumericalError where none are found.)");
}

/// What takes measured data, or gives them up.
void define_evaluate_and_update(py::class_<PyPosterior>& posterior) {
  using namespace py::literals;
  posterior
      .def("evaluate", &evaluate_posterior, "data"_a, "system"_a = nullptr, "outputs"_a = py::none(), "columns"_a = py::none(),
           "threads"_a = 0, "Compare with measured or true accelerations: the figures of gp2 evaluate.")
      .def("shoot", &shoot_posterior, "data"_a, "duration"_a = py::none(), "stretches"_a = ShootRequest().most_stretches,
           "columns"_a = py::none(), "threads"_a = 0,
           "The estimated parameters anew, by multiple shooting over stretches of a log of consecutive rows (t, coordinates,\n"
           "velocities, inputs), as gp2 shoot: the posterior under them, and a report (dict) with parameters, the rms of what\n"
           "motions are off in each coordinate before and after, duration, stretches, iterations, converged.")
      .def(
          "cross_validate",
          [](const PyPosterior& self) {
            const PyPosterior held = self;
            return unlocked([&] { return cross_validate(held.file, held.posterior); });
          },
          "How well the data predict themselves: each row from all others, and each of five stretches of time from the rest.")
      .def(
          "fewest_components",
          [](const PyPosterior& self, double largest_error, const std::string& view, const PySystem* system,
             const std::optional<std::string>& latent, const std::optional<double>& dt) {
            const ViewRequest request = view_request({view, system, latent, dt});
            PyPosterior held = self;
            unlocked([&] {
              const PredictedView at = predicted_view(held.file, held.posterior.prior(), request);
              const std::vector<int> few = held.posterior.fewest_components(largest_error, at.view);
              held.posterior = held.posterior.components(few);
              std::optional<HyperparameterDraws>& draws = held.file.report.draws;
              if (draws) draws->values = MatrixXd(draws->values(Eigen::all, few));
            });
            held.notes.clear();
            return held;
          },
          "largest_error"_a, "view"_a = "constrained", py::kw_only(), "system"_a = nullptr, "latent"_a = py::none(),
          "dt"_a = py::none(),
          "The mixture of few of its components, for loops that cannot wait for all: of this view, as in predict, within this "
          "share of "
          "a standard deviation, root mean square of means and deviations over up to 300 observed states. Single states may be "
          "off "
          "by more.")
      .def("update", &update_with, "data"_a, "observe"_a = py::none(), "noise_std"_a = py::none(), "columns"_a = py::none(),
           "forget"_a = py::none(), "window"_a = py::none(),
           "Add measured accelerations, in place: O(N²) per row, or O(M²) through M inducing variables. Hyperparameters, "
           "parameters "
           "and scales are held. `forget`: first let what was learned count as this share of it, through inducing points; "
           "`window`: "
           "then leave the newest so many states, of an exact fit.")
      .def(
          "remove_oldest",
          [](PyPosterior& self, int n) {
            change(self, [n](PyPosterior& changed) {
              changed.posterior = remove_oldest(std::move(changed.posterior), changed.file, n);
            });
          },
          "n"_a = 1, "Remove the n observed states that were added first, in place.")
      .def(
          "without_data",
          [](const PyPosterior& self) {
            return PyPosterior{self.file, self.posterior.without_data(), {}};
          },
          "The prior under the same hyperparameters. It can be copied, but not saved or pickled.");
}

std::vector<std::string> export_posterior(const PyPosterior& self, const py::object& folder, const PySystem* system,
                                          const py::kwargs& keywords) {
  ExportRequest request;
  read_keywords("export", keywords, options(request), {"folder", "system"});
  if (system != nullptr) request.view.system = system->model;
  const std::filesystem::path to = path_argument(folder, "folder");
  const PyPosterior held = self;
  const ExportOutcome outcome = unlocked([&] { return export_fit(held.file, held.posterior, request); });
  std::vector<std::pair<std::filesystem::path, std::string>> files;
  std::vector<std::string> written;
  for (const auto& [name, text] : outcome.files) {
    std::error_code not_there;
    if (request.is_of_robot() && std::filesystem::equivalent(to / name, outcome.robot, not_there)) {
      throw InputError(fmt::format("folder {}: {} is the robot's own file, which would be lost; choose another folder or name",
                                   to.string(), (to / name).string()));
    }
    files.emplace_back(to / name, text);
    written.push_back((to / name).string());
  }
  tell(outcome.notes);
  std::error_code error;
  std::filesystem::create_directories(to, error);
  if (error) throw InputError(fmt::format("folder {}: the folder cannot be made: {}", to.string(), error.message()));
  write_files(files);
  return written;
}

void define_export(py::class_<PyPosterior>& posterior) {
  using namespace py::literals;
  ExportRequest request;
  py::options own_signature;
  own_signature.disable_function_signatures();
  posterior.def("export", &export_posterior, "folder"_a, "system"_a = nullptr,
                (signature("export", "self: Posterior, folder: str | os.PathLike, system: System | None = None, *,",
                           options(request), "", "list[str]") +
                 R"(
Write the posterior as C for machines without gp2, or a robot's parameters into its own file, as gp2 export: the paths of the files.
A folder that does not exist is made.

)" + documentation(options(request)))
                    .c_str());
}

}  // namespace

FitFile read_fit(const py::object& path, const PySystem* system) {
  const std::filesystem::path from = path_argument(path);
  const ModelCode code = code_of(system);
  if (system != nullptr && !code) {
    throw InputError(
        "system: it has no functions, which is all that a file cannot hold: load without it, or with the system whose functions "
        "the "
        "fit used; to predict under another system, give it to predict(…, system=)");
  }
  return unlocked([&] { return FitFile::read(from, code); });
}

void add_posterior(py::module_& module) {
  // a class comes before the functions that return it, for their signatures to name it
  add_fit_report(module);
  add_prediction(module);
  add_inputs(module);
  add_evaluation(module);
  add_motion(module);
  add_excitation(module);

  using namespace py::literals;
  py::class_<PyPosterior> posterior(module, "Posterior", "A prior conditioned on data. Made by gp2.fit or gp2.load.");
  define_files_and_facts(posterior);
  define_predict(posterior);
  define_joint_and_sample(posterior);
  define_potential(posterior);
  define_inverse_dynamics(posterior);
  define_evaluate_and_update(posterior);
  posterior.def("__copy__", [](const PyPosterior& self) { return self; });
  posterior.def(
      "__deepcopy__", [](const PyPosterior& self, const py::dict&) { return self; }, "memo"_a);
  posterior.def("__repr__", [](const PyPosterior& self) { return fmt::format("<gp2.Posterior of '{}'>", self.system().name()); });

  module.def(
      "load", &load, "path"_a, "system"_a = nullptr,
      "Read a FIT.json: a Posterior.\n\nsystem: where the fit was of one with Python functions, that one; they are not in the "
      "file.\n\nRaises InputError naming the file and what is wrong.");
  define_export(posterior);
  define_simulate(posterior, module);
  define_excite(module);
}

}  // namespace gp2::python
