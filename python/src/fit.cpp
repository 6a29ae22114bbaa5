#include <mutex>

#include <fmt/format.h>
#include <pybind11/stl.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/fit_memory.hpp"
#include "gp2/jobs/fit_problem.hpp"

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

Log log_of(const py::object& data, const std::optional<PySystem>& system, const std::string& what) {
  return {to_table(data, what), system ? system->model : nullptr};
}

// a table of states and accelerations, columns by the model's names; NaN is an empty cell, and a column of it is left out
CsvTable table_of(const py::tuple& arrays, const System& system) {
  if (arrays.size() != 2) throw InputError(fmt::format("data: expected (states, accelerations), got {} arrays", arrays.size()));
  const std::vector<std::string> accelerations = system.acceleration_names();
  const Rows states(arrays[0], system.state_names(), "states"), ddq(arrays[1], accelerations, "accelerations");
  if (states.matrix().cols() != ddq.matrix().cols()) {
    throw InputError(fmt::format("data: {} states, but {} accelerations", states.matrix().cols(), ddq.matrix().cols()));
  }
  std::vector<CsvTable::Column> columns;
  const auto add = [&](const std::vector<std::string>& names, const Eigen::Map<const Eigen::MatrixXd>& rows) {
    for (std::size_t k = 0; k < names.size(); ++k) {
      const auto values = rows.row(static_cast<Eigen::Index>(k));
      if (!values.array().isNaN().all()) columns.push_back({names[k], {values.begin(), values.end()}});
    }
  };
  add(system.state_names(), states.matrix());
  add(accelerations, ddq.matrix());
  return CsvTable::from_columns("data", std::move(columns));
}

std::vector<Log> logs_of(const py::object& data, const System& system) {
  if (py::isinstance<py::tuple>(data)) return {{table_of(data, system), nullptr}};
  if (!py::isinstance<py::list>(data)) {
    if (py::isinstance<PyLog>(data)) return logs_of(py::list(py::make_tuple(data)), system);
    return {log_of(data, std::nullopt, "data")};
  }
  std::vector<Log> logs;
  for (const py::handle entry : data) {
    const std::string what = fmt::format("data[{}]", logs.size());
    if (py::isinstance<PyLog>(entry)) {
      const auto& log = entry.cast<const PyLog&>();
      logs.push_back(log_of(log.data, log.system, what));
    } else if (py::isinstance<py::tuple>(entry)) {
      logs.push_back({table_of(entry.cast<py::tuple>(), system), nullptr});
    } else {
      logs.push_back(log_of(entry.cast<py::object>(), std::nullopt, what));
    }
  }
  return logs;
}

template <typename Choice>
Choice choice(const std::string& given, const std::vector<std::pair<std::string, Choice>>& choices, const std::string& what) {
  std::string words;
  for (const auto& [word, value] : choices) {
    if (word == given) return value;
    words += (words.empty() ? "'" : ", '") + word + "'";
  }
  throw InputError(fmt::format("{}: expected one of {}, got '{}'", what, words, given));
}

struct Arguments {
  std::vector<PySideInformation> also;
  std::vector<std::string> observe;
  std::string mean = "zero";
  std::optional<std::string> prior, baseline;
  py::object noise_std, columns, progress, start;
  std::optional<std::vector<std::string>> estimate;
  std::string protocol = "default";
  bool hyperprior = true, discrepancy = true, project = false, robust = false;
  std::optional<int> max_points, restarts;
  std::optional<double> also_noise_std, dt;
  int max_iterations = 1000, threads = 0;
  std::uint64_t seed = 0;
};

FitProblemOptions problem_options(const Arguments& arguments) {
  FitProblemOptions options;
  options.columns = columns_argument(arguments.columns);
  options.observe = arguments.observe;
  options.mean = choice<Prior::Mean>(arguments.mean, {{"zero", Prior::Mean::zero}, {"force", Prior::Mean::force}}, "mean");
  if (arguments.prior) {
    options.base = choice<Latent::Base>(*arguments.prior,
                                        {{"acceleration", Latent::Base::acceleration}, {"force", Latent::Base::force}}, "prior");
  }
  if (arguments.baseline) {
    std::vector<std::pair<std::string, Baseline::Kind>> kinds;
    for (const std::string& word : Baseline::words()) kinds.emplace_back(word, *Baseline::kind_of(word));
    options.baseline = choice(*arguments.baseline, kinds, "baseline");
  }
  options.estimate = arguments.estimate;
  if (py::isinstance<py::str>(arguments.noise_std)) {
    options.estimate_noise =
        choice<bool>(arguments.noise_std.cast<std::string>(), {{"estimate", true}, {"stated", false}}, "noise_std");
    options.trust_stated_noise = !options.estimate_noise;
  } else if (!arguments.noise_std.is_none()) {
    try {
      options.noise_stddev = arguments.noise_std.cast<double>();
    } catch (const py::cast_error&) {
      throw py::type_error(fmt::format("noise_std: expected a positive number, 'estimate' or 'stated', got {}",
                                       std::string(py::repr(arguments.noise_std))));
    }
    if (!(*options.noise_stddev > 0) || !std::isfinite(*options.noise_stddev)) {
      throw InputError(
          fmt::format("noise_std: expected a positive number, 'estimate' or 'stated', got {}", *options.noise_stddev));
    }
  }
  options.protocol.name = choice<Protocol::Name>(
      arguments.protocol, {{"default", Protocol::Name::standard}, {"paper", Protocol::Name::paper}}, "protocol");
  options.protocol.hyperprior = arguments.hyperprior;
  options.discrepancy = arguments.discrepancy;
  options.max_points = arguments.max_points;
  options.also_noise_stddev = arguments.also_noise_std;
  options.time_step = arguments.dt;
  options.project = arguments.project;
  options.robust = arguments.robust;
  options.seed = arguments.seed;
  return options;
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

PyPosterior fit_model(const PySystem& system, const py::object& data, const Arguments& arguments) {
  require_at_least(1, arguments.restarts, "restarts");
  require_at_least(0, arguments.max_iterations, "max_iterations");
  require_at_least(1, arguments.max_points, "max_points");
  require_at_least(0, arguments.threads, "threads");
  const Model& model = *system.model;
  const std::vector<Log> logs = logs_of(data, *model.system);
  std::vector<SideInformation> also;
  for (const PySideInformation& knowledge : arguments.also) {
    const std::string what = fmt::format("also[{}]", also.size());
    also.push_back({quantity_argument(knowledge.view), knowledge.latent, log_of(knowledge.data, knowledge.system, what)});
  }
  const FitProblemOptions asked = problem_options(arguments);
  FitProblem problem = make_fit_problem(model, logs, also, asked);
  if (!arguments.start.is_none()) read_start(path_argument(arguments.start), arguments.max_iterations, problem);
  FitOptions options = default_fit_options(problem);
  options.n_restarts = arguments.restarts.value_or(options.n_restarts);
  options.max_iterations = arguments.max_iterations;
  options.seed = arguments.seed;
  options.n_threads = arguments.threads;
  const std::string asked_json =
      fit_options_json(asked, options, arguments.start.is_none() ? std::vector<Hyperparameter>() : problem.hyperparameters);
  options = within_memory(problem, options, free_memory(), problem.notes);
  tell(problem.notes);
  std::atomic<bool> stop = false;
  options.stop = &stop;
  LastProgress progress;
  if (!arguments.progress.is_none()) options.progress = [&](const Progress& p) { progress.set(p); };
  const auto tell_progress = [&] {
    if (const std::optional<Progress> last = progress.take()) arguments.progress(*last);
  };

  std::exception_ptr raised;
  std::optional<Fit> result;
  try {
    result = run_interruptibly([&] { return fit(problem, options); }, stop, raised, tell_progress);
  } catch (const Error&) {
    if (!raised) throw;  // stopped before there was anything to give
  }
  std::optional<PyPosterior> posterior;
  if (result) {
    std::vector<std::string> notes = distrust_notes(problem, result->report);
    for (std::string& note : notes_of(result->report)) notes.push_back(std::move(note));
    if (!raised) tell(notes);
    problem.notes.insert(problem.notes.end(), notes.begin(), notes.end());
    FitFile file;
    file.model = model;
    file.prior_options = problem.prior_options;
    file.options = asked_json;
    for (const Log& log : logs) file.data_source += (file.data_source.empty() ? "" : ", ") + log.table.name();
    file.systems = std::move(problem.systems);
    file.report = std::move(result->report);
    posterior = PyPosterior{std::move(file), std::move(result->posterior), std::move(problem.notes), system.mechanics};
  }
  if (raised) {
    try {
      std::rethrow_exception(raised);
    } catch (py::error_already_set& error) {
      error.value().attr("posterior") = posterior ? py::cast(std::move(*posterior)) : py::none();
      throw;
    }
  }
  return std::move(*posterior);
}

}  // namespace

void require_at_least(int smallest, const std::optional<int>& value, const char* what) {
  if (value && *value < smallest) throw InputError(fmt::format("{}: must be at least {}, got {}", what, smallest, *value));
}

void add_fit(py::module_& module) {
  using namespace py::literals;
  py::class_<PyLog>(module, "Log", "Data measured on another system than the one that is fitted.")
      .def(py::init([](py::object data, std::optional<PySystem> system) {
             return PyLog{std::move(data), std::move(system)};
           }),
           "data"_a, "system"_a = py::none());
  py::class_<PySideInformation>(module, "SideInformation",
                                "Another quantity that is measured or known: the columns of a view that a table has.")
      .def(py::init([](std::string view, py::object data, std::string latent, std::optional<PySystem> system) {
             return PySideInformation{std::move(view), std::move(data), std::move(latent), std::move(system)};
           }),
           "view"_a, "data"_a, "latent"_a = "", "system"_a = py::none());
  py::class_<Progress>(module, "Progress", "What the optimiser tells while it runs.")
      .def_readonly("restart", &Progress::restart)
      .def_readonly("n_restarts", &Progress::n_restarts)
      .def_readonly("iteration", &Progress::iteration)
      .def_readonly("best", &Progress::best, "Lowest objective so far.")
      .def_readonly("seconds", &Progress::seconds)
      .def_readonly("fraction", &Progress::fraction, "Of the work, estimated.");

  module.def(
      "fit",
      [](const PySystem& system, const py::object& data, const std::vector<PySideInformation>& also,
         const std::vector<std::string>& observe, const std::string& mean, const std::optional<std::string>& prior,
         const std::optional<std::string>& baseline, const py::object& noise_std,
         const std::optional<std::vector<std::string>>& estimate, const std::string& protocol, bool hyperprior, bool discrepancy,
         bool project, bool robust, const py::object& columns, const std::optional<int>& max_points,
         const std::optional<double>& also_noise_std, const std::optional<double>& dt, const std::optional<int>& restarts,
         int max_iterations, const py::object& start, std::uint64_t seed, int threads, const py::object& progress) {
        return fit_model(system, data,
                         {also,     observe,        mean,     prior,          baseline,    noise_std, columns, progress,
                          start,    estimate,       protocol, hyperprior,     discrepancy, project,   robust,  max_points,
                          restarts, also_noise_std, dt,       max_iterations, threads,     seed});
      },
      "system"_a, "data"_a, py::kw_only(), "also"_a = std::vector<PySideInformation>(), "observe"_a = std::vector<std::string>(),
      "mean"_a = "zero", "prior"_a = py::none(), "baseline"_a = py::none(), "noise_std"_a = py::none(), "estimate"_a = py::none(),
      "protocol"_a = "default", "hyperprior"_a = true, "discrepancy"_a = true, "project"_a = false, "robust"_a = false,
      "columns"_a = py::none(), "max_points"_a = py::none(), "also_noise_std"_a = py::none(), "dt"_a = py::none(),
      "restarts"_a = py::none(), "max_iterations"_a = 1000, "start"_a = py::none(), "seed"_a = 0, "threads"_a = 0,
      "progress"_a = py::none(),
      R"(Fit a system to measured accelerations.

data        a path, Table, pandas frame or mapping with columns named as the model's (or aliases); or (states, accelerations),
            arrays (n, len(state_names)) and (n, nq); or a list of these and of Log. NaN, or None, of an acceleration is "not measured"
also        list of SideInformation: other quantities, measured or known
observe     accelerations to learn from; default: those with a column ddNAME_std, or all
mean        'zero', or 'force': the model's known force is relied on
prior       'acceleration' or 'force': where the latent acts; default: as the model says
baseline    'se', 'icm' or 'lmc': learn ddq without mechanics
noise_std   standard deviation of every observed ddq, or 'estimate'; default: of each value, where data have columns
            ddNAME_std, times a factor that is estimated ('stated': as they are), or the model's
estimate    names of parameters; default: those the model wants estimated
project     move states onto position and velocity constraints, with the model's parameters, before anything else
robust      distrust values that disagree with all others; report.distrusted lists them
columns     {model's name: log's name}
restarts    runs of the optimiser; default: 5, of a baseline 30
max_iterations  per run; 0 conditions at the starting values
start       path of starting values, JSON or FIT.json
progress    called with a Progress some times a second

Returns a Posterior with its report. Same seed, same bits, for any number of threads. The interpreter's lock is released; Ctrl-C
raises KeyboardInterrupt, whose attribute `posterior` is the best so far (None when there is none yet). A fit that would take
more memory than is free is refused, with the rows that would fit.
Raises InputError for data or options that do not fit, with the text of the command; NumericalError when nothing could be fitted.)");
}

}  // namespace gp2::python
