#include <fmt/format.h>
#include <pybind11/stl.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/excite_job.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/jobs/simulate_job.hpp"
#include "options.hpp"

namespace gp2::python {

using namespace py::literals;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

struct Motion : SimulatedMotion {
  std::shared_ptr<const System> system;
};

// A path, or a table, which has named columns where a Series of numbers by name has none.
bool is_log(const py::object& start) {
  return py::isinstance<py::str>(start) || py::hasattr(start, "__fspath__") || py::hasattr(start, "columns");
}

MotionStart start_argument(const py::object& start, const System& system) {
  if (is_log(start)) return to_table(start, "start");
  if (is_array(start)) {
    const auto values = vector_argument(start, 2 * system.nq(), "start");
    return VectorXd(Eigen::Map<const VectorXd>(values.data(), 2 * system.nq()));
  }
  return argument<std::map<std::string, double>>(as_dict(start), "start", "a dict of names to numbers, or all of q and dq");
}

SimulateRequest simulate_request(const System& system, const py::object& start, const py::object& times, const py::object& inputs,
                                 const py::dict& keywords) {
  SimulateRequest request;
  read_keywords("simulate", keywords, options(request));
  request.start = start_argument(start, system);
  const auto points = vector_argument(times, "times");
  request.times = Eigen::Map<const VectorXd>(points.data(), points.size());
  if (!inputs.is_none()) request.inputs = to_table(inputs, "inputs");
  return request;
}

/// Motions one after the other; Ctrl-C ends them.
std::vector<SimulatedMotion> run_motions(const SimulateJob& job) {
  tell(job.notes);
  std::vector<Trajectory> trajectories = run_or_raise([&](const std::atomic<bool>* stop) { return run_simulation(job, stop); });
  std::vector<SimulatedMotion> motions;
  for (std::size_t k = 0; k < trajectories.size(); ++k) {
    SimulatedMotion& motion = motions.emplace_back(SimulatedMotion{std::move(trajectories[k])});
    const auto& energy = job.motions[k].energy;
    if (energy) motion.energy = unlocked([&] { return energy(motion.trajectory.states); });
  }
  return motions;
}

Motion simulate_model(const PySystem& system, const py::object& start, const py::object& times, const py::object& inputs,
                      const py::kwargs& keywords) {
  const SimulateRequest request = simulate_request(system.system(), start, times, inputs, keywords);
  std::vector<SimulatedMotion> motions = run_motions(prepare_simulation(*system.model, request));
  tell(motion_notes(motions));
  return {std::move(motions[0]), system.model->system};
}

py::object simulate_posterior(const PyPosterior& self, const py::object& start, const py::object& times, const py::object& inputs,
                              const PySystem* system, const py::kwargs& keywords) {
  const SimulateRequest request = simulate_request(self.system(), start, times, inputs, keywords);
  const Posterior posterior = self.posterior;
  const FitSystem asked = system_of(self.file, posterior.prior(), model_of(system));
  const SimulateJob job = unlocked([&] { return prepare_simulation(asked, posterior, request); });
  std::vector<SimulatedMotion> motions = run_motions(job);
  for (SimulatedMotion& motion : motions) {
    motion.uncertainty = unlocked([&] { return motion_uncertainty(posterior, motion.trajectory, asked.other_system); });
  }
  tell(motion_notes(motions));
  std::vector<Motion> out;
  for (SimulatedMotion& motion : motions) out.push_back({std::move(motion), asked.model->system});
  return request.n_samples ? py::cast(std::move(out)) : py::cast(std::move(out[0]));
}

std::string simulate_documentation(const std::string& first, const std::string& last, const std::string& result) {
  SimulateRequest request;
  return signature(
      "simulate",
      first + "start: Mapping[str, float] | ArrayLike | Table, times: ArrayLike, inputs: object = None, " + last + "*,",
      options(request), "", result);
}

// ---------------------------------------------------------------- the next experiment

/// gp2.Excitation
struct PyExcitation {
  Excitation found;
  Motion motion;
  std::shared_ptr<const System> system;
};

Limits limits_argument(const py::object& limits, const std::string& name) {
  if (limits.is_none()) return {};
  return argument<Limits>(as_dict(limits), name, "a dict of names to (lowest, highest)");
}

PyExcitation excite_posterior(const PyPosterior& self, const py::object& start, double duration, const py::object& inputs_within,
                              const py::object& within, const PySystem* system, const py::kwargs& keywords) {
  ExciteRequest request;
  read_keywords("excite", keywords, options(request));
  request.start = start_argument(start, system == nullptr ? self.system() : *system->model->system);
  request.duration = duration;
  request.inputs_within = limits_argument(inputs_within, "inputs_within");
  request.within = limits_argument(within, "within");
  const Posterior posterior = self.posterior;
  const FitSystem driven = system_of(self.file, posterior.prior(), model_of(system));
  std::atomic<bool> stop = false;
  const auto search = [&] {
    Excitation found = excite(driven, posterior, self.file.report.hyperparameters, request, {}, &stop);
    MotionUncertainty uncertainty = motion_uncertainty(posterior, found.motion, driven.other_system);
    return PyExcitation{found, {{found.motion, std::move(uncertainty)}, driven.model->system}, driven.model->system};
  };
  std::exception_ptr raised;
  std::optional<PyExcitation> out;
  try {
    out = run_interruptibly(search, stop, raised, [] {});
  } catch (const Error&) {
    if (!raised) throw;  // stopped before there was a motion
  }
  if (raised) raise_with(raised, "excitation", out ? py::cast(std::move(*out)) : py::none());
  tell(out->found.notes);
  tell(motion_notes({out->motion}));
  return std::move(*out);
}

py::dict known_dict(const std::vector<Excitation::Known>& known) {
  py::dict out;
  for (const Excitation::Known& one : known) {
    out[py::str(one.name)] = py::dict("now"_a = one.now, "after"_a = one.after, "random"_a = one.random);
  }
  return out;
}

py::dict limits_dict(const std::vector<Excitation::LimitUse>& limits) {
  py::dict out;
  for (const Excitation::LimitUse& one : limits) {
    out[py::str(one.name)] = py::dict("lower"_a = one.lower, "upper"_a = one.upper, "lowest"_a = one.lowest,
                                      "highest"_a = one.highest, "share"_a = one.share);
  }
  return out;
}

}  // namespace

void add_motion(py::module_& module) {
  py::class_<Motion>(module, "Motion", "A motion at the times asked for.")
      .def_property_readonly(
          "t", [](const Motion& m) { return to_vector(m.trajectory.times); }, "(n) [s]")
      .def_property_readonly(
          "states", [](const Motion& m) { return to_rows(m.trajectory.states); },
          "(n, len(state_names)); of inputs that act late what acts.")
      .def_property_readonly(
          "q", [](const Motion& m) { return to_rows(m.trajectory.states.topRows(m.trajectory.accelerations.rows())); }, "(n, nq)")
      .def_property_readonly(
          "dq",
          [](const Motion& m) {
            const Index nq = m.trajectory.accelerations.rows();
            return to_rows(m.trajectory.states.middleRows(nq, nq));
          },
          "(n, nq)")
      .def_property_readonly(
          "ddq", [](const Motion& m) { return to_rows(m.trajectory.accelerations); }, "(n, nq)")
      .def_property_readonly(
          "std",
          [](const Motion& m) -> py::object {
            if (!m.uncertainty) return py::none();
            return to_rows(m.uncertainty->stddev);
          },
          "Standard deviations of ddq along the motion, as the posterior has it (n, nq); None of a model's own motion.")
      .def_property_readonly(
          "distance_from_data",
          [](const Motion& m) -> py::object {
            if (!m.uncertainty) return py::none();
            return to_vector(m.uncertainty->distance);
          },
          "As of Prediction, along the motion (n); None as std.")
      .def_property_readonly(
          "energy",
          [](const Motion& m) -> py::object {
            if (!m.energy) return py::none();
            return to_vector(m.energy->values);
          },
          "Kinetic and potential energy along the motion (n) [J]; None where the model has no potential.")
      .def_property_readonly(
          "energy_std",
          [](const Motion& m) -> py::object {
            if (!m.energy || m.energy->stddev.size() == 0) return py::none();
            return to_vector(m.energy->stddev);
          },
          "Its standard deviations, of a potential that was learned, against the first state (n) [J]; else None.")
      .def_property_readonly(
          "multipliers", [](const Motion& m) { return to_rows(m.trajectory.records); }, "lambda of the constraints (n, nc)")
      .def_property_readonly(
          "max_position_drift", [](const Motion& m) { return m.trajectory.max_position_drift; },
          "Largest |c| of position constraints at the times of `t`.")
      .def_property_readonly(
          "max_velocity_drift", [](const Motion& m) { return m.trajectory.max_velocity_drift; },
          "Largest |dc/dt| of these, or |c| of velocity constraints, there.")
      .def_property_readonly(
          "n_lower_rank", [](const Motion& m) { return m.trajectory.lower_rank.states.size(); },
          "Times at which the constraints have a lower rank than at others.")
      .def_property_readonly(
          "table", [](const Motion& m) { return as_table(m.trajectory, *m.system, "motion"); },
          "t, q, dq, ddq and the inputs as commanded: fit takes it as a log, simulate as inputs.")
      .def_property_readonly(
          "steps", [](const Motion& m) { return m.trajectory.steps; }, "Of the integrator.")
      .def_property_readonly(
          "rejected_steps", [](const Motion& m) { return m.trajectory.rejected_steps; },
          "Whose error was above the tolerance, or that had no finite acceleration.")
      .def_property_readonly(
          "evaluations", [](const Motion& m) { return m.trajectory.evaluations; }, "Of the acceleration.");
}

void add_excitation(py::module_& module) {
  py::class_<PyExcitation>(module, "Excitation", "A motion to drive a system along, and what measuring it is expected to tell.")
      .def_readonly("motion", &PyExcitation::motion, "As the fit predicts it.")
      .def_property_readonly(
          "table", [](const PyExcitation& e) { return as_table(e.found.motion, *e.system, "excitation"); },
          "t, q, dq, ddq and the inputs: simulate takes it as inputs.")
      .def_property_readonly(
          "parameters", [](const PyExcitation& e) { return known_dict(e.found.parameters); },
          "Standard deviation of each estimated parameter: now, after this motion, after a random one (median).")
      .def_property_readonly(
          "accelerations", [](const PyExcitation& e) { return known_dict(e.found.accelerations); },
          "The same of accelerations, root mean square where motions within the limits go; of target='accelerations'.")
      .def_property_readonly(
          "limits", [](const PyExcitation& e) { return limits_dict(e.found.limits); },
          "Of each limit: lower, upper; lowest and highest of the motion; the share that it uses.")
      .def_property_readonly(
          "factor", [](const PyExcitation& e) { return e.found.factor; }, "By what factor deviations fall.")
      .def_property_readonly(
          "random_factor", [](const PyExcitation& e) { return e.found.random_factor; }, "By a random motion (median).")
      .def_property_readonly(
          "highest_frequency", [](const PyExcitation& e) { return e.found.highest_frequency; }, "Of inputs [Hz].")
      .def_property_readonly(
          "leaves_data", [](const PyExcitation& e) { return e.found.leaves_data; },
          "When the motion first is far from the data [s]; None: never.")
      .def_property_readonly(
          "n_motions", [](const PyExcitation& e) { return e.found.n_motions; }, "That were tried.")
      .def_property_readonly(
          "n_random", [](const PyExcitation& e) { return e.found.n_random; },
          "Random ones within the limits, which stand beside it.")
      .def_property_readonly(
          "n_failed", [](const PyExcitation& e) { return e.found.n_failed; }, "That could not be integrated.")
      .def_property_readonly(
          "seconds", [](const PyExcitation& e) { return e.found.seconds; }, "That the search took.");
}

/// These have their keywords in signatures of our own; the setting for that ends with this function.
void define_simulate(py::class_<PyPosterior>& posterior, py::module_& module) {
  SimulateRequest motion;
  const std::string motion_options = documentation(options(motion));
  py::options own_signature;
  own_signature.disable_function_signatures();
  posterior.def("simulate", &simulate_posterior, "start"_a, "times"_a, "inputs"_a = py::none(), "system"_a = nullptr,
                (simulate_documentation("self: Posterior, ", "system: System | None = None, ", "Motion | list[Motion]") + R"(
Integrate the mean's motion, or n_samples motions, each of one function drawn from the posterior.

start   {"q1": 0.4, "dq1": 1.0}: what is not named follows from the constraints; or all of q and dq; or a table or the path of
        one, whose first row it is
times   at which states are wanted (n) [s]; the first is the start
inputs  a table with t and every input, linear in between, that covers the motion; default: zero
system  another System with the same coordinates, inputs and latents: its motion

)" + motion_options +
                 R"(
Returns a Motion, or with n_samples a list of them. Raises NumericalError, with the time, when it cannot go on.)")
                    .c_str());
  module.def("simulate", &simulate_model, "system"_a, "start"_a, "times"_a, "inputs"_a = py::none(),
             (simulate_documentation("system: System, ", "", "Motion") +
              "\nIntegrate a system by its own force and [truth]. As Posterior.simulate.")
                 .c_str());
}

void define_excite(py::module_& module) {
  ExciteRequest request;
  py::options own_signature;
  own_signature.disable_function_signatures();
  module.def(
      "excite", &excite_posterior, "posterior"_a, "start"_a, "duration"_a, "inputs_within"_a, "within"_a = py::none(),
      "system"_a = nullptr,
      (signature(
           "excite",
           "posterior: Posterior, start: Mapping[str, float] | ArrayLike | Table, duration: float, inputs_within: Mapping[str, "
           "tuple[float, float]], within: Mapping[str, tuple[float, float]] | None = None, system: System | None = None, *,",
           options(request), "", "Excitation") +
       R"(
Find the motion, within limits, that measuring will tell most of what is not known: which experiment next.

start          as of Posterior.simulate
duration       [s]
inputs_within  {"u": (-5, 5)}: lowest and highest value of every input
within         {"q": (-1, 1), "dq": (-3, 3)}: of coordinates, velocities and accelerations; default: they may go anywhere
system         another System with the same coordinates, inputs and latents, which is driven

)" + documentation(options(request)) +
       R"(
Returns an Excitation. Same seed, same motion, for any number of threads. Ctrl-C raises KeyboardInterrupt, whose attribute
`excitation` is the best so far (None when there is none yet).
Raises InputError for limits that do not fit, or that no motion keeps; NumericalError when none could be integrated.)")
          .c_str());
}

}  // namespace gp2::python
