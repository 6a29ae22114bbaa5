#include <fmt/format.h>
#include <pybind11/stl.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/excite_job.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/jobs/simulate_job.hpp"
#include "options.hpp"
#include "pickles.hpp"

// for pickles
namespace gp2 {

static auto fields(ContactEvent& of) { return std::tie(of.time, of.row, of.kind, of.approach, of.energy_loss); }
static auto fields(StickEvent& of) { return std::tie(of.time, of.surface, of.sticks); }
static auto fields(LowerRank& of) { return std::tie(of.usual, of.lowest, of.states); }
static auto fields(Trajectory& of) {
  return std::tie(of.times, of.states, of.accelerations, of.commands, of.records, of.max_position_drift, of.max_velocity_drift,
                  of.largest_jump, of.jump_time, of.lower_rank, of.start_position_residual, of.start_velocity_residual,
                  of.start_displacement, of.events, of.sticks, of.steps, of.rejected_steps, of.evaluations, of.seconds);
}
static auto fields(MotionUncertainty& of) { return std::tie(of.stddev, of.distance, of.leaves_data); }
static auto fields(MotionEnergy& of) { return std::tie(of.values, of.stddev); }
static auto fields(Excitation::Known& of) { return std::tie(of.name, of.now, of.after, of.random); }
static auto fields(Excitation::LimitUse& of) { return std::tie(of.name, of.lower, of.upper, of.lowest, of.highest, of.share); }
static auto fields(Excitation& of) {
  return std::tie(of.target, of.motion, of.factor, of.random_factor, of.parameters, of.accelerations, of.limits, of.n_motions,
                  of.n_random, of.n_failed, of.highest_frequency, of.leaves_data, of.interrupted, of.seconds, of.notes);
}

}  // namespace gp2

namespace gp2::python {

using namespace py::literals;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

/// gp2.Motion
struct Motion : SimulatedMotion {
  CsvTable table;
  std::vector<std::string> constraints, surfaces;  // which events are of
};

auto fields(Motion& of) { return std::tie(of.trajectory, of.uncertainty, of.energy, of.table, of.constraints, of.surfaces); }

/// With what is named after the system that moved.
Motion named(SimulatedMotion motion, const System& system, const SwitchingFunctions& switching) {
  CsvTable table = as_table(motion.trajectory, system, "motion");
  return {std::move(motion), std::move(table), system.constraint_labels(), switching.names()};
}

// A path, or a table: what has columns, a structured array, or a mapping whose values have a length.
bool is_log(const py::object& start) {
  if (py::isinstance<py::str>(start) || py::hasattr(start, "__fspath__") || py::hasattr(start, "columns")) return true;
  const std::optional<py::list> names = column_names(start);
  if (!names || names->empty()) return false;
  if (py::isinstance<py::array>(start)) return true;
  const py::object first = start[(*names)[0]];
  const bool has_length = PyObject_Size(first.ptr()) >= 0;
  if (!has_length) PyErr_Clear();
  return has_length && !py::isinstance<py::str>(first);
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
  read_keywords("simulate", keywords, options(request), {"start", "times", "inputs", "system"});
  request.start = start_argument(start, system);
  const auto points = vector_argument(times, "times");
  request.times = Eigen::Map<const VectorXd>(points.data(), points.size());
  if (!inputs.is_none()) request.inputs = to_table(inputs, "inputs");
  return request;
}

std::exception_ptr numerical_error(const std::string& text) {
  const py::object type = py::module_::import("gp2._gp2").attr("NumericalError");
  PyErr_SetObject(type.ptr(), type(with_keywords(text)).ptr());
  return std::make_exception_ptr(py::error_already_set());
}

using Uncertainty = std::function<MotionUncertainty(const Trajectory&)>;

/// The motions of a job, one after the other: a Motion, or a list of them; Ctrl-C ends them. What is raised where one cannot go on,
/// or by Ctrl-C, has what was reached as its attribute `motion`.
py::object run_motions(const SimulateJob& job, bool are_many, const Uncertainty& uncertainty) {
  std::vector<Trajectory> trajectories;
  std::atomic<bool> stop = false;
  std::exception_ptr raised;
  try {
    tell(job.notes);
    trajectories = run_interruptibly([&] { return run_simulation(job, &stop); }, stop, raised, [] {});
  } catch (UnfinishedMotion& error) {
    trajectories = std::move(error.motions);
    if (!raised) raised = numerical_error(error.what());
    if (trajectories.back().times.size() == 0) trajectories.pop_back();  // it did not begin
  } catch (...) {
    if (!raised) raised = std::current_exception();
  }
  std::vector<SimulatedMotion> motions;
  for (Trajectory& trajectory : trajectories) motions.push_back(SimulatedMotion{std::move(trajectory)});
  // what fails after the motions is no reason to lose them
  try {
    for (std::size_t k = 0; k < motions.size(); ++k) {
      SimulatedMotion& motion = motions[k];
      const auto& energy = job.motions[k].energy;
      if (energy) motion.energy = unlocked([&] { return energy(motion.trajectory.states); });
      if (uncertainty) motion.uncertainty = unlocked([&] { return uncertainty(motion.trajectory); });
    }
    tell(motion_notes(motions));
    if (PyErr_CheckSignals() != 0) throw py::error_already_set();
  } catch (...) {
    if (!raised) raised = std::current_exception();
  }
  py::list out;
  for (SimulatedMotion& motion : motions) out.append(named(std::move(motion), *job.system, job.options.switching));
  const py::object result = are_many ? py::object(out) : out.empty() ? py::none() : py::object(out[0]);
  if (raised) raise_with(raised, "motion", result);
  return result;
}

py::object simulate_model(const PySystem& system, const py::object& start, const py::object& times, const py::object& inputs,
                          const py::kwargs& keywords) {
  const SimulateRequest request = simulate_request(system.system(), start, times, inputs, keywords);
  const SimulateJob job = before_any("motion", [&] { return prepare_simulation(*system.model, request); });
  return run_motions(job, /*are_many=*/false, {});
}

py::object simulate_posterior(const PyPosterior& self, const py::object& start, const py::object& times, const py::object& inputs,
                              const PySystem* system, const py::kwargs& keywords) {
  const SimulateRequest request = simulate_request(self.system(), start, times, inputs, keywords);
  const Posterior posterior = self.posterior;
  const FitSystem asked = system_of(self.file, posterior.prior(), model_of(system));
  const SimulateJob job =
      before_any("motion", [&] { return unlocked([&] { return prepare_simulation(asked, posterior, request); }); });
  return run_motions(job, request.n_samples.has_value(),
                     [&](const Trajectory& motion) { return motion_uncertainty(posterior, motion, asked.other_system); });
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
  CsvTable table;
};
auto fields(PyExcitation& of) { return std::tie(of.found, of.motion, of.table); }

Limits limits_argument(const py::object& limits, const std::string& name) {
  if (limits.is_none()) return {};
  return argument<Limits>(as_dict(limits), name, "a dict of names to (lowest, highest)");
}

PyExcitation excite_posterior(const PyPosterior& self, const py::object& start, double duration, const py::object& inputs_within,
                              const py::object& within, const PySystem* system, const py::kwargs& keywords) {
  ExciteRequest request;
  read_keywords("excite", keywords, options(request), {"posterior", "start", "duration", "inputs_within", "within", "system"});
  request.start = start_argument(start, system == nullptr ? self.system() : *system->model->system);
  request.duration = duration;
  request.inputs_within = limits_argument(inputs_within, "inputs_within");
  request.within = limits_argument(within, "within");
  const Posterior posterior = self.posterior;
  const FitSystem driven = system_of(self.file, posterior.prior(), model_of(system));
  std::atomic<bool> stop = false;
  const auto search = [&] {
    Excitation found = excite(driven, posterior, self.file.report.hyperparameters, request, {}, &stop);
    SimulatedMotion motion{found.motion, motion_uncertainty(posterior, found.motion, driven.other_system)};
    const System& moved = *driven.model->system;
    return PyExcitation{found, named(std::move(motion), moved, switching_functions(*driven.model, /*of_latents=*/true)),
                        as_table(found.motion, moved, "excitation")};
  };
  std::exception_ptr raised;
  std::optional<PyExcitation> out;
  try {
    out = run_interruptibly(search, stop, raised, [] {});
    if (!raised) {
      tell(out->found.notes);
      tell(motion_notes({out->motion}));
    }
  } catch (...) {  // there may be no motion, or a warning that is an error, which is no reason to lose it
    if (!raised) raised = std::current_exception();
  }
  if (raised) raise_with(raised, "excitation", out ? py::cast(std::move(*out)) : py::none());
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

// as the JSON of gp2 simulate has them
py::list contact_events(const Motion& motion) {
  const auto word_of = [](ContactEvent::Kind kind) {
    return kind == ContactEvent::Kind::impact ? "impact" : kind == ContactEvent::Kind::made ? "made" : "released";
  };
  py::list events;
  for (const ContactEvent& one : motion.trajectory.events) {
    events.append(py::dict("t"_a = one.time, "contact"_a = motion.constraints[static_cast<std::size_t>(one.row)],
                           "kind"_a = word_of(one.kind), "approach"_a = one.approach, "energy_loss"_a = one.energy_loss));
  }
  return events;
}

py::list stick_events(const Motion& motion) {
  py::list events;
  for (const StickEvent& one : motion.trajectory.sticks) {
    events.append(py::dict("t"_a = one.time, "surface"_a = motion.surfaces[static_cast<std::size_t>(one.surface)],
                           "kind"_a = one.sticks ? "sticks" : "slips"));
  }
  return events;
}

}  // namespace

void add_motion(py::module_& module) {
  py::class_<Motion>(module, "Motion", "A motion at the times asked for. Its arrays are copies, not to be written to.")
      .def_property_readonly(
          "t", [](const Motion& m) { return read_only(to_vector(m.trajectory.times)); }, "(n) [s]")
      .def_property_readonly(
          "states", [](const Motion& m) { return read_only(to_rows(m.trajectory.states)); },
          "(n, len(state_names)); of inputs that act late what acts.")
      .def_property_readonly(
          "q", [](const Motion& m) { return read_only(to_rows(m.trajectory.states.topRows(m.trajectory.accelerations.rows()))); },
          "(n, nq)")
      .def_property_readonly(
          "dq",
          [](const Motion& m) {
            const Index nq = m.trajectory.accelerations.rows();
            return read_only(to_rows(m.trajectory.states.middleRows(nq, nq)));
          },
          "(n, nq)")
      .def_property_readonly(
          "ddq", [](const Motion& m) { return read_only(to_rows(m.trajectory.accelerations)); }, "(n, nq)")
      .def_property_readonly(
          "std",
          [](const Motion& m) -> py::object {
            if (!m.uncertainty) return py::none();
            return read_only(to_rows(m.uncertainty->stddev));
          },
          "Standard deviations of ddq along the motion, as the posterior has it (n, nq); None of a model's own motion.")
      .def_property_readonly(
          "distance_from_data",
          [](const Motion& m) -> py::object {
            if (!m.uncertainty) return py::none();
            return read_only(to_vector(m.uncertainty->distance));
          },
          "As of Prediction, along the motion (n); None as std.")
      .def_property_readonly(
          "energy",
          [](const Motion& m) -> py::object {
            if (!m.energy) return py::none();
            return read_only(to_vector(m.energy->values));
          },
          "Kinetic and potential energy along the motion (n) [J]; None where the model has no potential.")
      .def_property_readonly(
          "energy_std",
          [](const Motion& m) -> py::object {
            if (!m.energy || m.energy->stddev.size() == 0) return py::none();
            return read_only(to_vector(m.energy->stddev));
          },
          "Its standard deviations, of a potential that was learned, against the first state (n) [J]; else None.")
      .def_property_readonly(
          "multipliers", [](const Motion& m) { return read_only(to_rows(m.trajectory.records)); },
          "lambda of the constraints (n, nc)")
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
          "start_displacement", [](const Motion& m) { return m.trajectory.start_displacement; },
          "By how much, at most, the projection of the start onto the constraints changed a coordinate or velocity.")
      .def_property_readonly(
          "contact_events", &contact_events,
          "What happened to contacts, in the order of time: dicts of t, contact (the constraint as written), kind "
          "('impact', 'made' or 'released'), approach (the speed before an impact) and energy_loss [J].")
      .def_property_readonly(
          "stick_events", &stick_events,
          "Where dry friction starts to hold the motion and lets it go: dicts of t, surface (what is 0 while it "
          "holds) and kind ('sticks' or 'slips').")
      .def_readonly("table", &Motion::table,
                    "t, q, dq, ddq and the inputs as commanded: fit takes it as a log, simulate as inputs.")
      .def_property_readonly(
          "steps", [](const Motion& m) { return m.trajectory.steps; }, "Of the integrator.")
      .def_property_readonly(
          "rejected_steps", [](const Motion& m) { return m.trajectory.rejected_steps; },
          "Whose error was above the tolerance, or that had no finite acceleration.")
      .def_property_readonly(
          "evaluations", [](const Motion& m) { return m.trajectory.evaluations; }, "Of the acceleration.")
      .def("__repr__",
           [](const Motion& m) {
             const VectorXd& t = m.trajectory.times;
             return fmt::format("<gp2.Motion of {} coordinates at {} times, t = {:g} to {:g} s>",
                                m.trajectory.accelerations.rows(), t.size(), t.minCoeff(), t.maxCoeff());
           })
      .def(pickled<Motion>());
}

void add_excitation(py::module_& module) {
  py::class_<PyExcitation>(module, "Excitation", "A motion to drive a system along, and what measuring it is expected to tell.")
      .def_readonly("motion", &PyExcitation::motion, "As the fit predicts it.")
      .def_readonly("table", &PyExcitation::table, "t, q, dq, ddq and the inputs: simulate takes it as inputs.")
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
          "seconds", [](const PyExcitation& e) { return e.found.seconds; }, "That the search took.")
      .def("__repr__",
           [](const PyExcitation& e) {
             return fmt::format("<gp2.Excitation: standard deviations divided by {:.3g}, by {:.3g} after a random motion>",
                                e.found.factor, e.found.random_factor);
           })
      .def(pickled<PyExcitation>());
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
Returns a Motion, or with n_samples a list of them. Raises NumericalError, with the time, when it cannot go on; its attribute `motion` is
what was reached: a Motion up to there (None where there is none), or with n_samples the list up to that one.)")
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
