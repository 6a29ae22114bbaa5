#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <pybind11/stl.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "gp2/base/file.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/check_job.hpp"
#include "gp2/jobs/derive.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/jobs/generate_job.hpp"
#include "gp2/jobs/resample.hpp"
#include "gp2/jobs/show_job.hpp"
#include "options.hpp"
#include "pickles.hpp"

// for pickles
namespace gp2 {

static auto fields(Finding& of) { return std::tie(of.level, of.text); }

}  // namespace gp2

namespace gp2::python {

py::dict report_of(const DerivedData& derived, const System& system) {
  const auto named = [&](const std::vector<int>& coordinates) {
    py::list names;
    for (const int j : coordinates) names.append(system.coordinates()[static_cast<std::size_t>(j)].name);
    return names;
  };
  py::list series;
  for (const DerivedSeries& one : derived.series) {
    py::dict entry;
    entry["coordinate"] = system.coordinates()[static_cast<std::size_t>(one.coordinate)].name;
    entry["episode"] = derived.episodes[static_cast<std::size_t>(one.episode)];
    entry["lengthscale"] = one.model.lengthscale;
    entry["signal_std"] = one.model.signal_stddev;
    entry["noise_std"] = one.model.noise_stddev;
    entry["bandwidth"] = one.bandwidth;
    entry["resolution"] = one.resolution;
    entry["used"] = one.used;
    entry["missing"] = one.missing;
    entry["repeated"] = one.repeated;
    entry["outliers"] = one.outliers;
    entry["wraps"] = one.wraps;
    entry["gaps"] = one.gaps;
    entry["longest_gap"] = one.longest_gap;
    series.append(entry);
  }
  py::dict report;
  report["series"] = series;
  report["measured"] = named(derived.measured);
  report["completed"] = named(derived.completed);
  report["independent"] = named(derived.independent);
  report["notes"] = with_keywords(derived.notes);
  return report;
}

namespace {

std::vector<std::string> coordinate_names(const System& system) {
  std::vector<std::string> names;
  for (const Coordinate& coordinate : system.coordinates()) names.push_back(coordinate.name);
  return names;
}

// the model's own values, with those given by name
Eigen::VectorXd parameter_values(const System& system, const std::map<std::string, double>& given) {
  Eigen::VectorXd values = system.parameter_values();
  for (const auto& [name, value] : given) {
    const int index = system.parameter_index(name);
    if (index < 0) {
      std::vector<std::string> names;
      for (const Parameter& parameter : system.parameters()) names.push_back(parameter.name);
      throw InputError(
          fmt::format("parameters: '{}' has no parameter '{}'; it has: {}", system.name(), name, fmt::join(names, ", ")));
    }
    values[index] = value;
  }
  return values;
}

// Those with a delay or a lag, known or to be estimated.
std::vector<std::string> late_inputs(const PySystem& self) {
  const std::vector<std::string>& inputs = self.system().inputs();
  std::vector<std::string> late;
  for (std::size_t k = 0; k < inputs.size(); ++k) {
    const Actuator& one = self.model->actuators[k];
    if (!one.is_direct() || one.is_estimated()) late.push_back(inputs[k]);
  }
  return late;
}

py::dict parameters_of(const System& system) {
  py::dict values;
  for (const Parameter& parameter : system.parameters()) values[py::str(parameter.name)] = parameter.value;
  return values;
}

/// M, A, b, F at n states.
struct Mechanics {
  py::array M, A, b, F;
};
auto fields(Mechanics& of) { return std::tie(of.M, of.A, of.b, of.F); }

// The states of a table by its column names, what the model does not read NaN where there is no column of it.
py::array states_of_table(const PySystem& self, const py::object& data, const py::object& columns, const char* what) {
  const CsvTable table = to_table(data, what);
  LogReader reader = open_log(*self.model, table, columns_argument(columns));
  return to_rows(unlocked([&] { return read_whole_log(*self.model, reader).states; }));
}

Rows states_of(const PySystem& self, const py::object& states) {
  const bool is_table = !is_array(states);
  return {is_table ? states_of_table(self, states, py::none(), "states") : states, self.system().state_names(), "states"};
}

// What M, A, b or F read must be there: of a missing entry they would be NaN.
void require_what_mechanics_read(const System& system, const Rows& rows) {
  const auto states = rows.matrix();
  const std::vector<std::string> names = system.state_names();
  const std::vector<bool> mechanics = system.reads(SystemPart::mechanics), force = system.reads(SystemPart::force);
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (!mechanics[k] && !force[k]) continue;
    for (Eigen::Index i = 0; i < states.cols(); ++i) {
      if (!std::isnan(states(static_cast<Eigen::Index>(k), i))) continue;
      throw InputError(fmt::format("states: row {} has no '{}', which M, A, b or F read", i + 1, names[k]));
    }
  }
}

Mechanics evaluate(const PySystem& self, const py::object& states, const py::object& parameters) {
  const System& system = self.system();
  const Rows rows = states_of(self, states);
  require_what_mechanics_read(system, rows);
  const auto given = argument<std::map<std::string, double>>(as_dict(parameters), "parameters", "a dict of names to numbers");
  const Eigen::VectorXd at = parameter_values(system, given);
  SystemValues values = unlocked([&] { return system.evaluate(rows.matrix(), at); });
  return {to_matrices(values.mass, system.nq(), system.nq()), to_matrices(values.constraint_matrix, system.nc(), system.nq()),
          to_rows(std::move(values.constraint_vector)), to_rows(std::move(values.force))};
}

CsvTable generate_table(const PySystem& self, std::optional<int> n, std::uint64_t seed, std::optional<double> noise_stddev,
                        const py::object& grid) {
  const GenerateRequest request{
      n, argument<std::map<std::string, int>>(as_dict(grid), "grid", "a dict of names to whole numbers"), seed, noise_stddev};
  if (n.has_value() != request.grid.empty()) throw InputError("give either n, a number of rows, or grid");
  const GeneratedData data = unlocked([&] { return generate(*self.model, request); });
  return as_table(data, self.system(), fmt::format("data of '{}'", self.system().name()));
}

std::string show_any(const py::object& shown, const py::kwargs& keywords) {
  ShowRequest asked;
  read_keywords("show", keywords, options(asked), {"system"});
  const auto spelled = [](const std::string& note) { return with_keywords(note); };
  if (py::isinstance<PySystem>(shown)) return show(*shown.cast<const PySystem&>().model, asked);
  if (py::isinstance<PyPosterior>(shown)) {
    const auto& self = shown.cast<const PyPosterior&>();
    FitFile fit = self.file;
    fit.take_data(self.posterior);
    return show(fit, asked, spelled);
  }
  const std::string path = path_argument(shown, "system", "a gp2.System, a gp2.Posterior or the path of a file of one");
  const std::string text = read_file(path);
  const std::size_t first = text.find_first_not_of(" \t\r\n");
  const bool is_fit = first != std::string::npos && text[first] == '{';  // JSON
  return is_fit ? show(FitFile::parse(text, path), asked, spelled) : show(Model::parse(text, path), asked);
}

CsvTable resample_table(const PySystem& self, const py::object& data, int n, const py::kwargs& keywords) {
  ResampleOptions asked;
  read_keywords("resample", keywords, options(asked), {"system", "data", "n"});
  asked.n = n;
  const CsvTable table = to_table(data, "data", CsvTable::Keep::text);
  const Resample chosen = run_or_raise([&](const std::atomic<bool>* stop) { return resample(*self.model, table, asked, stop); });
  tell(resample_notes(chosen, table, "chosen"));
  return table.take(chosen.rows);
}

py::tuple derive_table(const PySystem& self, const py::object& data, const py::object& like, const py::kwargs& keywords) {
  DeriveOptions asked;
  read_keywords("derive", keywords, options(asked), {"system", "data", "like"});
  if (!like.is_none()) asked.like = to_table(like, "like", CsvTable::Keep::text);
  const CsvTable table = to_table(data, "data", CsvTable::Keep::text);
  const DerivedData derived = run_or_raise([&](const std::atomic<bool>* stop) {
    asked.stop = stop;
    return derive(*self.model, table, asked);
  });
  tell(derived.notes);
  return py::make_tuple(as_table(derived, self.system(), "derived data"), report_of(derived, self.system()));
}

py::list check_system_and_log(const PySystem& self, const py::object& data, const py::object& columns) {
  std::optional<CsvTable> table;
  if (!data.is_none()) table = to_table(data, "data");
  const CheckOptions options{columns_argument(columns)};
  std::vector<Finding> findings = unlocked([&] { return check(*self.model, table ? &*table : nullptr, options); });
  py::list list;
  for (Finding& finding : findings) {
    finding.text = with_keywords(finding.text);
    list.append(std::move(finding));
  }
  return list;
}

const char* word(Finding::Level level) {
  return level == Finding::Level::good ? "ok" : level == Finding::Level::warning ? "warning" : "error";
}

}  // namespace

std::map<std::string, std::string> columns_argument(const py::object& columns) {
  if (columns.is_none()) return {};
  return argument<std::map<std::string, std::string>>(as_dict(columns), "columns", "a dict of the model's names to the log's");
}

void require_no_columns(const py::object& columns) {
  if (columns_argument(columns).empty()) return;
  throw InputError("columns: renames columns of a table, but states are an array, whose columns have no names");
}

View::Quantity quantity_argument(const std::string& given) {
  const std::optional<View::Quantity> quantity = View::Quantity::of_word(given);
  if (!quantity)
    throw InputError(fmt::format("view: expected one of {}, got '{}'", fmt::join(View::Quantity::words(), ", "), given));
  return *quantity;
}

void tell(const std::vector<std::string>& notes) {
  const std::string mark = "warning: ";
  for (const std::string& note : with_keywords(notes)) {
    if (note.starts_with(mark)) {
      if (PyErr_WarnEx(PyExc_UserWarning, note.substr(mark.size()).c_str(), 1) != 0) throw py::error_already_set();
    } else {
      py::module_::import("logging").attr("getLogger")("gp2").attr("info")("%s", note);
    }
  }
}

States::States(const py::object& data, const PredictedView& at, const Eigen::VectorXd& parameters, const py::object& columns) {
  const System& system = *at.prior.system;
  if (!is_array(data)) {
    const CsvTable table = to_table(data, "states");
    const std::map<std::string, std::string> names = columns_argument(columns);
    LogStates log =
        unlocked([&] { return read_log_states(at.prior, at.view, *at.model, table, names, {}, at.actuators, parameters); });
    tell(log.notes);
    table_ = table.name();
    read_ = std::move(log.states);
    return;
  }
  require_no_columns(columns);
  const std::vector<std::string> names = system.state_names();
  array_.emplace(data, names, "states");
  const auto states = matrix();
  std::vector<bool> reads = at.prior.reads();
  const std::vector<bool> of_view = at.view.reads(system);
  for (std::size_t k = 0; k < reads.size(); ++k) {
    if (!reads[k] && !of_view[k]) continue;
    if (states.cols() > 1 && states.row(static_cast<Eigen::Index>(k)).array().isNaN().all()) {
      throw InputError(fmt::format("states: missing column '{}': no row has a number there", names[k]));
    }
    for (Eigen::Index i = 0; i < states.cols(); ++i) {
      const double value = states(static_cast<Eigen::Index>(k), i);
      if (std::isfinite(value)) continue;
      throw InputError(fmt::format("states: row {}, column {} ({}): {} is not a finite number", i + 1, k + 1, names[k], value));
    }
  }
}

Eigen::Map<const Eigen::MatrixXd> States::matrix() const {
  if (array_) return array_->matrix();
  return {read_.data(), read_.rows(), read_.cols()};
}

namespace {

void add_mechanics_and_finding(py::module_& module) {
  py::class_<Mechanics>(module, "Mechanics", "M(q,t) ddq = F + constraint forces, subject to A ddq = b, at n states.")
      .def_readonly("M", &Mechanics::M, "Mass matrix (n, nq, nq).")
      .def_readonly("A", &Mechanics::A, "Constraint matrix (n, nc, nq).")
      .def_readonly("b", &Mechanics::b, "Constraint vector (n, nc).")
      .def_readonly("F", &Mechanics::F, "Known part of the applied force (n, nq) [N or N m].")
      .def("__repr__", [](const Mechanics& of) { return fmt::format("<gp2.Mechanics at {} states>", of.M.shape(0)); })
      .def(pickled<Mechanics>());

  py::class_<Finding>(module, "Finding", "One thing a check looked at.")
      .def_property_readonly(
          "level", [](const Finding& finding) { return word(finding.level); }, "'ok', 'warning' or 'error'.")
      .def_readonly("text", &Finding::text, "What was found, and the mend where there is one.")
      .def("__repr__", [](const Finding& finding) { return fmt::format("{}: {}", word(finding.level), finding.text); })
      .def(pickled<Finding>());
}

void define_model_files(py::class_<PySystem>& system) {
  system
      .def_static(
          "load",
          [](const py::object& path) { return PySystem{std::make_shared<const Model>(Model::read(path_argument(path)))}; },
          py::arg("path"), "Read a model file.\n\nRaises InputError with file, line, key, the rule, the value got and the mend.")
      .def_static(
          "parse",
          [](const std::string& text, const std::string& name, const std::optional<std::string>& robot) {
            if (!robot) return PySystem{std::make_shared<const Model>(Model::parse(text, name))};
            const RobotSource source = [&](const std::string&) { return robot_from_json(*robot); };
            return PySystem{std::make_shared<const Model>(Model::parse(text, name, source))};
          },
          py::arg("text"), py::arg("name") = "text", py::arg("robot") = py::none(),
          "The same from the text of a model file; `name` stands for it in messages, `robot` (see the property) for its file.")
      .def_property_readonly(
          "robot",
          [](const PySystem& self) { return self.model->robot ? std::optional(to_json(*self.model->robot)) : std::nullopt; },
          "The robot of the model as JSON text; None without one.");
}

void define_names_and_parameters(py::class_<PySystem>& system) {
  system
      .def_property_readonly(
          "name", [](const PySystem& self) { return self.system().name(); }, "Of the model.")
      .def_property_readonly(
          "text", [](const PySystem& self) { return self.model->text; }, "The model file's text.")
      .def_property_readonly(
          "coordinates", [](const PySystem& self) { return coordinate_names(self.system()); }, "Names, in the order of q.")
      .def_property_readonly(
          "inputs", [](const PySystem& self) { return self.system().inputs(); }, "Names, in the order of u.")
      .def_property_readonly("late_inputs", &late_inputs, "Names of the inputs that act later than they are commanded.")
      .def_property_readonly(
          "parameters", [](const PySystem& self) { return parameters_of(self.system()); }, "Name to value.")
      .def_property_readonly(
          "units", [](const PySystem& self) { return self.model->units; },
          "Name of a quantity to its label: those of [units], and of velocities, accelerations and forces that follow.")
      .def_property_readonly(
          "constraints", [](const PySystem& self) { return self.system().constraint_labels(); }, "As written; one per row of A.")
      .def_property_readonly(
          "state_names", [](const PySystem& self) { return self.system().state_names(); },
          "Columns of an array of states: q, dq, t, u.")
      .def_property_readonly(
          "acceleration_names", [](const PySystem& self) { return self.system().acceleration_names(); },
          "Columns of an array of accelerations: ddq.");
}

/// Values at states, and tables of them.
void define_evaluate_and_generate(py::class_<PySystem>& system) {
  system
      .def("evaluate", &evaluate, py::arg("states"), py::arg("parameters") = py::dict(),
           "M, A, b, F at states (n, len(state_names)), or at those of a table by column names, with parameters by name where "
           "they\n"
           "are not the model's own.\n\n"
           "Raises InputError where a state lacks what M, A, b or F read.")
      .def(
          "true_acceleration",
          [](const PySystem& self, const py::object& states) {
            const Rows rows = states_of(self, states);
            return to_rows(unlocked([&] { return true_acceleration(*self.model, rows.matrix()); }));
          },
          py::arg("states"),
          "ddq of the model as it is written, with its [truth] (n, nq), at states as of evaluate.\n\n"
          "Raises InputError when there is no [truth].")
      .def("generate", &generate_table, py::arg("n") = py::none(), py::arg("seed") = 1, py::arg("noise_std") = py::none(),
           py::arg("grid") = py::dict(),
           "Draw states from the model's [sampling] and measure ddq: a Table.\n\n"
           "noise_std: of ddq; default: the model's own. grid: points per range instead of n draws.")
      .def(
          "states",
          [](const PySystem& self, const py::object& data, const py::object& columns) {
            return states_of_table(self, data, columns, "data");
          },
          py::arg("data"), py::arg("columns") = py::none(),
          "States (n, len(state_names)) of a table by its column names. What the constraints, the mass matrix and the latents do "
          "not\n"
          "read may be missing: NaN.");
}

/// These have their keywords in signatures of our own; the setting for that ends with this function.
void define_show_derive_and_resample(py::module_& module) {
  ShowRequest of_show;
  DeriveOptions of_derive;
  ResampleOptions of_resample;
  py::options own_signature;
  own_signature.disable_function_signatures();
  module.def("show", &show_any, py::arg("system"),
             (signature("show", "system: System | Posterior | str | os.PathLike, *,", options(of_show), "", "str") + R"(
M, F, the constraints with the A and b derived from them, the parameters and the latents, as text to print; of a fit, first what it
was learned from and what it found.

system  a System or a Posterior, or the path of a file of one

)" + documentation(options(of_show)))
                 .c_str());
  module.def("derive", &derive_table, py::arg("system"), py::arg("data"), py::arg("like") = py::none(),
             (signature("derive", "system: System, data: object, like: object = None, *,", options(of_derive), "",
                        "tuple[Table, dict[str, Any]]") +
              R"(
A raw log of t and positions as states and accelerations with a standard deviation for each value: a Table for fit, and a report
(dict): what was found of each coordinate in each episode, what was completed from the constraints, which accelerations are
independent, notes. docs/raw-logs.md.

like  another raw log: this one goes through the filter that is found for that one, so that what is learned from one and tested
      on the other has gone through the same

)" + documentation(options(of_derive)))
                 .c_str());
  module.def("resample", &resample_table, py::arg("system"), py::arg("data"), py::arg("n"),
             (signature("resample", "system: System, data: object, n: int, *,", options(of_resample), "", "Table") + R"(
The n rows of a table that cover its states best, whole, in the order of choice: farthest points in the features of the system's
latents, or in expressions given, each divided by its standard deviation. The first is the row nearest to the mean or, with a
seed, a random one. Rows without a number in some feature are left out.

)" + documentation(options(of_resample)))
                 .c_str());
}

}  // namespace

void add_system(py::module_& module) {
  // a class comes before the functions that return it, for their signatures to name it
  add_mechanics_and_finding(module);

  py::class_<PySystem> system(module, "System", R"(A constrained mechanical system and its prior.

System.load("surface.toml") reads a model file; System(coordinates=…, mass=…, …) takes the same from strings and numbers:

    gp2.System(
        coordinates=["x", "z"],                  # or {"name": "q1", "angle": True}
        inputs=["push"],
        parameters={"m": 0.2, "h": {"value": 0.5, "bounds": [0.3, 0.7], "estimate": True}},
        mass=[["m", "0"], ["0", "m"]],
        force=["push", "-9.81*m"],               # the known part of the applied force
        constraints=["z - h*x^2"],               # = 0; or {"position": […], "velocity": […], "acceleration": […]}
        latents=[{"features": ["x", "dx"]}],     # the unknown; default: one on the acceleration, of the whole state
        noise=0.05,                              # standard deviation of a measured ddq
    )

Further keywords: name, let, potential, truth, sampling, motion, columns, units. Each is the table of that name in a model file.
Features and directions of a latent may be functions, of a contact Jacobian say:

    {"name": "contact",
     "features": {"names": ["slip"], "function": slip},      # slip(states) -> (n, 1)
     "directions": {"force": {"names": ["tangent"], "function": tangent}}}

tangent(states, parameters) -> (n, nq, 1), parameters {name: value}. A function may have "reads", the names of the entries of a
state that it reads (default: all), and one of directions "derivatives": f(states, parameters, name), in one parameter, exact
(default: central differences). A fit is saved without them: gp2.load(path, system=this).

With robot="arm.xml" (MJCF or URDF) coordinates are its joints unless given, and mass is its own; docs/robots.md.

Raises InputError with the key, the rule, the value got and the mend.)");
  add_callables(system);
  define_model_files(system);
  define_names_and_parameters(system);
  define_evaluate_and_generate(system);
  system.def("__repr__", [](const PySystem& self) {
    return fmt::format("<gp2.System '{}': coordinates {}; {} constraints>", self.system().name(),
                       fmt::join(coordinate_names(self.system()), ", "), self.system().nc());
  });

  module.def("check", &check_system_and_log, py::arg("system"), py::arg("data") = py::none(), py::arg("columns") = py::none(),
             "Is a system well-posed, and does a log fit it? A list of Finding: rank, definiteness, derivatives; data on the\n"
             "constraint, dependent columns. Without data at states drawn from the model's [sampling].");
  define_show_derive_and_resample(module);
}

}  // namespace gp2::python
