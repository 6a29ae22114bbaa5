#include <mutex>

#include <fmt/format.h>
#include <pybind11/stl.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/derive.hpp"
#include "gp2/jobs/excite_job.hpp"
#include "gp2/jobs/export_job.hpp"
#include "gp2/jobs/fit_job.hpp"
#include "gp2/jobs/raw_fit.hpp"
#include "gp2/jobs/resample.hpp"
#include "gp2/jobs/show_job.hpp"
#include "gp2/jobs/simulate_job.hpp"
#include "gp2/report/plot.hpp"
#include "options.hpp"

namespace gp2::python {

namespace {

/// A log and the system it was measured on, where that is another.
struct PyLog {
  py::object data;
  std::optional<PySystem> system;
};

/// Another quantity that is measured or known.
struct PySideInformation {
  std::string view;
  py::object data;
  std::string latent;
  std::optional<PySystem> system;
};

// a table of states and accelerations, columns by the model's names; NaN is an empty cell, and a state's column of it is left out
CsvTable table_of(const py::tuple& arrays, const System& system) {
  if (arrays.size() != 2) throw InputError(fmt::format("data: expected (states, accelerations), got {} arrays", arrays.size()));
  const std::vector<std::string> accelerations = system.acceleration_names();
  const Rows states(arrays[0], system.state_names(), "states"), ddq(arrays[1], accelerations, "accelerations");
  if (states.matrix().cols() != ddq.matrix().cols()) {
    throw InputError(fmt::format("data: {} states, but {} accelerations", states.matrix().cols(), ddq.matrix().cols()));
  }
  if (states.matrix().cols() == 0) throw InputError("data: there are no rows");
  std::vector<CsvTable::Column> columns;
  const auto add = [&](const std::string& name, const auto& values) {
    columns.push_back({name, {values.begin(), values.end()}});
  };
  const std::vector<std::string> names = system.state_names();
  for (std::size_t k = 0; k < names.size(); ++k) {
    const auto values = states.matrix().row(static_cast<Eigen::Index>(k));
    if (!values.array().isNaN().all()) add(names[k], values);
  }
  for (std::size_t k = 0; k < accelerations.size(); ++k) add(accelerations[k], ddq.matrix().row(static_cast<Eigen::Index>(k)));
  return CsvTable::from_columns("data", std::move(columns));
}

// A gp2.Log, a table, or a tuple of arrays.
Log log_of(const py::object& given, const System& fitted, const std::string& what) {
  const PyLog log = py::isinstance<PyLog>(given) ? given.cast<PyLog>() : PyLog{given, {}};
  const std::shared_ptr<const Model> other = log.system ? log.system->model : nullptr;
  if (!py::isinstance<py::tuple>(log.data)) return {to_table(log.data, what), other};
  return {table_of(log.data, other ? *other->system : fitted), other, false};
}

std::vector<Log> logs_of(const py::object& data, const System& fitted) {
  if (!py::isinstance<py::list>(data)) return {log_of(data, fitted, "data")};
  std::vector<Log> logs;
  for (const py::handle entry : data) {
    logs.push_back(log_of(py::reinterpret_borrow<py::object>(entry), fitted, fmt::format("data[{}]", logs.size())));
  }
  return logs;
}

void require_progress(const py::object& progress) {
  if (!progress.is_none()) require_function(progress, "progress");
}

/// What the optimiser said last; it speaks from other threads.
class LastProgress {
 public:
  void set(const Progress& progress) {
    const std::lock_guard lock(mutex_);
    last_ = progress;
  }
  std::optional<Progress> take() {
    const std::lock_guard lock(mutex_);
    return std::exchange(last_, std::nullopt);
  }

 private:
  std::mutex mutex_;
  std::optional<Progress> last_;
};

std::vector<SideInformation> side_information_of(const py::object& also) {
  if (py::isinstance<PySideInformation>(also)) return side_information_of(py::make_tuple(also));
  std::vector<SideInformation> out;
  if (also.is_none()) return out;
  for (const py::handle entry : also) {
    const std::string what = fmt::format("also[{}]", out.size());
    if (!py::isinstance<PySideInformation>(entry)) {
      throw py::type_error(
          fmt::format("{}: expected a gp2.SideInformation, got {}", what, std::string(py::str(py::type::handle_of(entry)))));
    }
    const auto& one = entry.cast<const PySideInformation&>();
    out.push_back(
        {quantity_argument(one.view), one.latent, {to_table(one.data, what), one.system ? one.system->model : nullptr}});
  }
  return out;
}

// None, or a function
py::object take_progress(py::dict& keywords) {
  const auto progress = take<py::object>(keywords, "progress", py::none());
  require_progress(progress);
  return progress;
}

/// Runs a fit without the interpreter's lock; Ctrl-C ends it with the best so far.
PyPosterior run(const FitJob& job, const py::object& progress_callback) {
  std::atomic<bool> stop = false;
  LastProgress progress;
  std::function<void(const Progress&)> note_progress;
  if (!progress_callback.is_none()) note_progress = [&](const Progress& p) { progress.set(p); };
  const auto tell_progress = [&] {
    if (const std::optional<Progress> last = progress.take()) progress_callback(*last);
  };

  std::exception_ptr raised;
  std::optional<FitOutcome> outcome;
  try {
    tell(job.notes);
    outcome = run_interruptibly([&] { return run_fit(job, note_progress, &stop); }, stop, raised, tell_progress);
    if (!raised) tell(outcome->notes);
  } catch (...) {  // there may be nothing to give, or a warning that is an error, which is no reason to lose the fit
    if (!raised) raised = std::current_exception();
  }
  std::optional<PyPosterior> posterior;
  if (outcome) {
    std::vector<std::string> notes = job.notes;
    notes.insert(notes.end(), outcome->notes.begin(), outcome->notes.end());
    outcome->file.observations.clear();
    posterior = PyPosterior{std::move(outcome->file), std::move(outcome->posterior), with_keywords(std::move(notes))};
  }
  if (raised) raise_with(raised, "posterior", posterior ? py::cast(std::move(*posterior)) : py::none());
  return std::move(*posterior);
}

FitJob prepared(FitRequest request) {
  return before_any("posterior", [&] { return unlocked([&] { return prepare_fit(std::move(request)); }); });
}

PyPosterior fit_model(const PySystem& system, const py::object& data, const py::kwargs& kwargs) {
  py::dict keywords = kwargs;
  FitRequest request;
  const py::object progress = take_progress(keywords);
  const auto also = take<py::object>(keywords, "also", py::tuple());
  const auto commands = take<py::object>(keywords, "commands", py::none());
  read_keywords("fit", keywords, options(request), {"system", "data", "commands", "also", "progress"});
  if (!commands.is_none()) request.problem.commands = to_table(commands, "commands");
  request.model = *system.model;
  request.logs = logs_of(data, system.system());
  request.also = side_information_of(also);
  require_use_of_commands(request);
  return run(prepared(std::move(request)), progress);
}

py::tuple fit_raw(const PySystem& system, const py::object& data, const py::kwargs& kwargs) {
  py::dict keywords = kwargs;
  FitRequest request;
  RawFitOptions raw;
  const py::object progress = take_progress(keywords);
  read_keywords("fit_raw", keywords, options(request, raw), {"system", "data", "progress"});
  request.model = *system.model;
  const CsvTable table = to_table(data, "data", CsvTable::Keep::text);
  std::vector<std::string> notes;
  const LearnedLog log = before_any("posterior", [&] {
    LearnedLog learned = run_or_raise([&](const std::atomic<bool>* stop) { return learn_and_smooth(request, table, raw, stop); });
    notes = learned.data.notes;
    notes.insert(notes.end(), learned.notes.begin(), learned.notes.end());
    tell(notes);
    return learned;
  });
  py::dict report = report_of(log.data, system.system());
  report["notes"] = with_keywords(std::move(notes));
  report["gains"] = log.gains;
  CsvTable smoothed = as_table(log.data, system.system(), "smoothed data");
  const FitJob job =
      before_any("posterior", [&] { return unlocked([&] { return prepare_raw_fit(log, std::move(request), "raw data"); }); });
  return py::make_tuple(run(job, progress), std::move(smoothed), std::move(report));
}

PyPosterior fit_again(const py::object& path, const py::object& data, const py::object& commands, const py::object& also,
                      const PySystem* system, int threads, const py::object& checkpoint, const py::object& progress) {
  require_progress(progress);
  const FitFile file = read_fit(path, system);
  const auto started = [&](FitJob job) {
    if (!checkpoint.is_none()) job.checkpoint = path_argument(checkpoint, "checkpoint");
    return run(job, progress);
  };
  if (data.is_none()) {
    if (!side_information_of(also).empty()) throw InputError("`again`: `also` goes with `data`");
    if (!commands.is_none()) throw InputError("`again`: `commands` goes with `data`");
    return started(before_any("posterior", [&] { return unlocked([&] { return prepare_fit_again(file, threads); }); }));
  }
  FitRequest request = request_of(file);
  request.threads = threads;
  request.data_source.clear();
  if (!commands.is_none()) request.problem.commands = to_table(commands, "commands");
  request.logs = logs_of(data, *request.model.system);
  request.also = side_information_of(also);
  require_use_of_commands(request);
  return started(before_any("posterior", [&] { return unlocked([&] { return prepare_fit_again(file, std::move(request)); }); }));
}

std::string fit_documentation() {
  FitRequest request;
  const std::vector<Option> table = options(request);
  return signature(
             "fit",
             "system: System, data: object, *, commands: object = None, also: SideInformation | Sequence[SideInformation] = [],",
             table, ", progress: Callable[[Progress], object] | None = None", "Posterior") +
         R"(
Fit a system to measured accelerations.

data        a path, Table, frame of pandas or polars, structured array or mapping with columns named as the model's (or aliases); or (states, accelerations),
            arrays (n, len(state_names)) and (n, nq), or frames and mappings with columns of these names; or a list of these and of Log, empty where `also` is all there is. NaN, in a table None too, of an acceleration is "not measured"
commands    where inputs act late and `data` are rows of a longer log: that log, t and inputs, and `episode` where there is one.
            Inputs of tables are commands; those of arrays are what acts
also        a SideInformation, or a list of them: other quantities, measured or known
progress    called with a Progress some times a second

)" + documentation(table) +
         R"(
Returns a Posterior with its report. Same seed, same bits, for any number of threads. The interpreter's lock is released; Ctrl-C
raises KeyboardInterrupt, whose attribute `posterior` is the best so far (None when there is none yet). A fit that would take
more memory than is free is refused, with the rows that would fit.
Raises InputError for data or options that do not fit; NumericalError when nothing could be fitted.)";
}

std::string fit_raw_documentation() {
  FitRequest request;
  RawFitOptions raw;
  const std::vector<Option> table = options(request, raw);
  return signature("fit_raw", "system: System, data: object, *,", table, ", progress: Callable[[Progress], object] | None = None",
                   "tuple[Posterior, Table, dict[str, Any]]") +
         R"(
Fit a system to a raw log of t and positions, as `gp2 fit --raw` does it: smoothed and learned from by turns, then fitted to what the
positions tell of accelerations over windows of time. Gives the Posterior; the log smoothed, a Table; and a report (dict) as that of
derive, with `gains`, the log likelihood of positions that the fits have not seen, of each pass that was kept. docs/raw-logs.md.

data        a path, Table, frame, structured array or mapping: t, positions, inputs
progress    as in fit

)" + documentation(table);
}

}  // namespace

std::vector<std::string> names_or_all(const GivenNames& names, const char* what) {
  if (names && names->empty()) {
    throw InputError(fmt::format("{}: expected at least one name, got []; None stands for the default", what));
  }
  return names.value_or(std::vector<std::string>());
}

void require_at_least(int smallest, const std::optional<int>& value, const char* what) {
  if (value && *value < smallest) throw InputError(fmt::format("{}: must be at least {}, got {}", what, smallest, *value));
}

void add_fit(py::module_& module) {
  using namespace py::literals;
  py::class_<PyLog>(module, "Log", "Data measured on another system than the one that is fitted.")
      .def(py::init([](py::object data, std::optional<PySystem> system) {
             return PyLog{std::move(data), std::move(system)};
           }),
           "data"_a, "system"_a = py::none(), "data: as of fit, without lists and other Logs.")
      .def("__repr__",
           [](const PyLog& log) {
             return log.system ? fmt::format("<gp2.Log of '{}'>", log.system->system().name()) : std::string("<gp2.Log>");
           })
      .def("__reduce__", [](const py::object& self) {
        const auto& log = self.cast<const PyLog&>();
        return py::make_tuple(py::type::of(self), py::make_tuple(log.data, log.system));
      });
  py::class_<PySideInformation>(module, "SideInformation",
                                "Another quantity that is measured or known: the columns of a view that a table has.")
      .def(py::init([](std::string view, py::object data, std::string latent, std::optional<PySystem> system) {
             return PySideInformation{std::move(view), std::move(data), std::move(latent), std::move(system)};
           }),
           "view"_a, "data"_a, "latent"_a = "", "system"_a = py::none())
      .def("__repr__", [](const PySideInformation& one) { return fmt::format("<gp2.SideInformation on {}>", one.view); })
      .def("__reduce__", [](const py::object& self) {
        const auto& one = self.cast<const PySideInformation&>();
        return py::make_tuple(py::type::of(self), py::make_tuple(one.view, one.data, one.latent, one.system));
      });
  py::class_<Progress>(module, "Progress", "What the optimiser tells while it runs.")
      .def_readonly("restart", &Progress::restart, "From 0.")
      .def_readonly("n_restarts", &Progress::n_restarts, "How many runs of the optimiser there are.")
      .def_readonly("iteration", &Progress::iteration, "Of this run.")
      .def_readonly("best", &Progress::best, "Lowest objective so far.")
      .def_readonly("seconds", &Progress::seconds, "Since the fit began.")
      .def_readonly("is_drawing", &Progress::is_drawing, "Whether hyperparameters are drawn, after the restarts.")
      .def_readonly("n_states", &Progress::n_states,
                    "Of those of a long log that are fitted by turns, with a best of their own; 0: all at once.")
      .def_readonly("fraction", &Progress::fraction, "Of the work, estimated.");

  {
    py::options own_signature;
    own_signature.disable_function_signatures();
    module.def("fit", &fit_model, "system"_a, "data"_a, fit_documentation().c_str());
  }
  {
    py::options own_signature;
    own_signature.disable_function_signatures();
    module.def("fit_raw", &fit_raw, "system"_a, "data"_a, fit_raw_documentation().c_str());
  }
  module.def(
      "fit_again", &fit_again, "path"_a, "data"_a = py::none(), py::kw_only(), "commands"_a = py::none(), "also"_a = py::list(),
      "system"_a = nullptr, "threads"_a = 0, "checkpoint"_a = py::none(), "progress"_a = py::none(),
      "Repeat the fit in a FIT.json with the options it was made with, from its data or from those given: the same bits.\n\n"
      "system: as in gp2.load; all else as in gp2.fit. A robust fit needs its data. Files that are not those of the fit are "
      "warned of.");
  module.def(
      "_stub_of_options",
      [](const std::string& job) {
        FitRequest fit;
        SimulateRequest simulate;
        DeriveOptions derive;
        FitRequest fit_of_raw;
        RawFitOptions raw;
        ResampleOptions resample;
        ShowRequest show;
        ExciteRequest excite;
        ExportRequest exported;
        PlotRequest plot;
        const std::map<std::string, std::vector<Option>> tables = {
            {"fit", options(fit)},           {"simulate", options(simulate)},
            {"derive", options(derive)},     {"fit_raw", options(fit_of_raw, raw)},
            {"resample", options(resample)}, {"show", options(show)},
            {"excite", options(excite)},     {"export", options(exported)},
            {"plot", options(plot)}};
        return stub_lines(tables.at(job));
      },
      "job"_a);
}

}  // namespace gp2::python
