// Systems from keywords, whose mechanics or latents may be Python functions.

#include "gp2/mechanics/callable_system.hpp"

#include <algorithm>
#include <iterator>
#include <mutex>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <pybind11/stl.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "gp2/error.hpp"
#include "options.hpp"

namespace gp2::python {

using Eigen::Index;
using Eigen::MatrixXd;

namespace {

/// A Python function that C++ may copy, call and let go of without the GIL.
class Function {
 public:
  explicit Function(py::object function)
      : function_(new py::object(std::move(function)), [](py::object* last) {
          const py::gil_scoped_acquire acquire;
          delete last;
        }) {}

  /// with the GIL held
  template <typename... Arguments>
  py::object operator()(Arguments&&... arguments) const {
    try {
      return (*function_)(std::forward<Arguments>(arguments)...);
    } catch (const py::error_already_set& error) {
      if (error.matches(PyExc_Exception)) throw;
      throw Interruption{error};
    }
  }

 private:
  std::shared_ptr<py::object> function_;
};

/// The turn of a thread to call functions, with the GIL. The GIL alone does not keep calls apart, because Python switches threads
/// within a function.
class Turn {
 public:
  Turn() {
    if (!mutex().try_lock()) {
      // a thread that waits must not hold the GIL: the function whose turn it is needs it
      std::optional<py::gil_scoped_release> release;
      if (PyGILState_Check() == 1) release.emplace();
      mutex().lock();
    }
    acquire_.emplace();
  }
  ~Turn() {
    acquire_.reset();
    mutex().unlock();
  }
  Turn(const Turn&) = delete;
  Turn& operator=(const Turn&) = delete;

 private:
  // one for the whole process, because functions of several systems may share what they work on; recursive, because a function may
  // evaluate another system
  static std::recursive_mutex& mutex() {
    static std::recursive_mutex one;
    return one;
  }

  std::optional<py::gil_scoped_acquire> acquire_;
};

using Shape = std::vector<py::ssize_t>;

/// What a function returned for one quantity, as doubles; an extent of −1 may be any. @throws InputError naming function, quantity
/// and shapes.
py::array_t<double, py::array::c_style> returned(const py::object& object, const char* function, const char* quantity,
                                                 const char* wanted, const Shape& shape) {
  const py::array array = py::array::ensure(without_mask(object));
  if (!array) PyErr_Clear();
  const bool fits =
      array && std::equal(shape.begin(), shape.end(), array.shape(), array.shape() + array.ndim(),
                          [](py::ssize_t wanted_extent, py::ssize_t got) { return wanted_extent < 0 || wanted_extent == got; });
  const char kind = fits ? array.dtype().kind() : 'O';
  if (!fits || (kind != 'f' && kind != 'i' && kind != 'u')) {
    std::string got = std::string(py::str(py::type::of(object)));
    if (array) {
      got = fmt::format("({}) of {}", fmt::join(array.shape(), array.shape() + array.ndim(), ", "),
                        std::string(py::str(array.dtype())));
    }
    std::vector<std::string> extents;
    for (const py::ssize_t extent : shape) extents.push_back(extent < 0 ? "any" : std::to_string(extent));
    throw InputError(fmt::format("{}: {} must be numbers of shape {} = ({}), got {}", function, quantity, wanted,
                                 fmt::join(extents, ", "), got));
  }
  return py::array_t<double, py::array::c_style | py::array::forcecast>::ensure(array);
}

py::dict by_name(const std::vector<Parameter>& parameters, const CallableSystem::Parameters& values) {
  py::dict out;
  for (std::size_t k = 0; k < parameters.size(); ++k) out[py::str(parameters[k].name)] = values[static_cast<Index>(k)];
  return out;
}

// A row-major matrix per state, as functions return them, in column-major columns.
MatrixXd column_major(const py::array_t<double, py::array::c_style>& array) {
  const Index n = array.shape(0), rows = array.shape(1), columns = array.shape(2);
  const Eigen::Map<const MatrixXd> row_major(array.data(), rows * columns, n);
  MatrixXd blocks(rows * columns, n);
  for (Index i = 0; i < n; ++i) {
    blocks.col(i).reshaped(rows, columns) = row_major.col(i).reshaped(columns, rows).transpose();
  }
  return blocks;
}

/// (M, A, b, F) of a function. M and A hold a row-major matrix per state, SystemValues column-major ones.
SystemValues values_of(const py::object& result, const char* function, Index n, Index nq, Index nc) {
  if (!py::isinstance<py::sequence>(result) || py::len(result) != 4) {
    throw InputError(fmt::format("{}: expected (M, A, b, F), got {}", function, std::string(py::str(py::type::of(result)))));
  }
  const py::sequence parts = result;
  SystemValues values;
  // of A and b where no constraint is named
  const auto require_nothing = [&](const py::object& part, const char* quantity) {
    if (part.is_none()) return;
    const py::array array = py::array::ensure(part);
    if (array && array.size() == 0) return;
    PyErr_Clear();
    throw InputError(fmt::format(
        "{}: {} is not empty, but no constraint is named: give constraints=[…], a name for each row of A", function, quantity));
  };
  const auto matrices = [&](const py::object& part, const char* quantity, const char* wanted, Index rows) {
    if (rows == 0) {
      require_nothing(part, quantity);
      return MatrixXd(0, n);
    }
    return column_major(returned(part, function, quantity, wanted, {n, rows, nq}));
  };
  const auto vectors = [&](const py::object& part, const char* quantity, const char* wanted, Index rows) {
    if (rows == 0) {
      require_nothing(part, quantity);
      return MatrixXd(0, n);
    }
    const auto array = returned(part, function, quantity, wanted, {n, rows});
    return MatrixXd(Eigen::Map<const MatrixXd>(array.data(), rows, n));
  };
  values.mass = matrices(parts[0], "M", "(n, nq, nq)", nq);
  values.constraint_matrix = matrices(parts[1], "A", "(n, nc, nq)", nc);
  values.constraint_vector = vectors(parts[2], "b", "(n, nc)", nc);
  values.force = vectors(parts[3], "F", "(n, nq)", nq);
  return values;
}

std::vector<std::string> names_argument(py::handle given, const std::string& what) {
  return argument<std::vector<std::string>>(given, what, "a list of names");
}

// names of rows of A, or {"position": names, "velocity": names, "acceleration": names}
std::vector<CallableSystem::Constraint> constraints_of(const py::object& given) {
  std::vector<CallableSystem::Constraint> constraints;
  const auto add = [&](const py::handle names, const std::string& what, ConstraintLevel level) {
    for (const auto& name : names_argument(names, what)) constraints.push_back({name, level});
  };
  const py::object by_level = as_dict(given);
  if (!py::isinstance<py::dict>(by_level)) {
    add(by_level, "constraints", ConstraintLevel::acceleration);
    return constraints;
  }
  const auto levels = py::reinterpret_borrow<py::dict>(by_level);
  for (const auto& [key, names] : levels) {
    const std::string word = py::str(key);
    if (word != "position" && word != "velocity" && word != "acceleration")
      throw InputError(fmt::format("constraints: expected 'position', 'velocity' or 'acceleration', got '{}'", word));
  }
  // rows have this order, whatever that of the dict
  for (const auto& [word, level] :
       {std::pair("position", ConstraintLevel::position), std::pair("velocity", ConstraintLevel::velocity),
        std::pair("acceleration", ConstraintLevel::acceleration)}) {
    if (levels.contains(word)) add(levels[word], fmt::format("constraints['{}']", word), level);
  }
  return constraints;
}

MechanicsSource source_of(const py::object& mechanics, const py::object& constraints, const py::object& derivatives,
                          const py::object& residuals, const std::optional<std::vector<std::string>>& reads) {
  const std::vector<CallableSystem::Constraint> rows = constraints_of(constraints);
  const auto nc = static_cast<Index>(rows.size());
  Index n_residuals = 0;
  for (const CallableSystem::Constraint& row : rows) {
    n_residuals += row.level == ConstraintLevel::position ? 2 : row.level == ConstraintLevel::velocity ? 1 : 0;
  }
  const auto optional = [](const py::object& function) {
    return function.is_none() ? std::nullopt : std::optional(Function(function));
  };
  return [=, mechanics = Function(mechanics), derivatives = optional(derivatives),
          residuals = optional(residuals)](const SystemDeclaration& declaration) {
    CallableSystem::Definition definition;
    definition.declaration = declaration;
    definition.constraints = rows;
    definition.mechanics_reads = definition.force_reads = definition.residuals_read = reads;
    const auto nq = static_cast<Index>(declaration.coordinates.size());
    const std::vector<Parameter> parameters = declaration.parameters;
    using States = CallableSystem::States;
    using Parameters = CallableSystem::Parameters;
    definition.evaluate = [=](const States& states, const Parameters& values) {
      const Turn turn;
      return values_of(mechanics(to_rows(states), by_name(parameters, values)), "mechanics", states.cols(), nq, nc);
    };
    if (derivatives) {
      definition.differentiate = [=](const States& states, const Parameters& values, int index) {
        const Turn turn;
        const std::string& name = parameters[static_cast<std::size_t>(index)].name;
        return values_of((*derivatives)(to_rows(states), by_name(parameters, values), name), "derivatives", states.cols(), nq,
                         nc);
      };
    }
    if (residuals) {
      definition.residuals = [=](const States& states, const Parameters& values) -> MatrixXd {
        const Turn turn;
        const py::object result = (*residuals)(to_rows(states), by_name(parameters, values));
        const auto array = returned(result, "residuals", "the result", "(n, rows)", {states.cols(), n_residuals});
        return Eigen::Map<const MatrixXd>(array.data(), n_residuals, states.cols());
      };
    }
    return std::make_shared<const CallableSystem>(std::move(definition));
  };
}

/// {"names": …, "function": …, "derivatives": …, "reads": …} of a latent.
struct LatentFunction {
  Index n_names = 0;
  Function function;
  std::optional<Function> derivatives;
  std::optional<std::vector<std::string>> reads;

  LatentFunction(const py::dict& given, const std::string& what) : function(given["function"]) {
    for (const auto& [key, value] : given) {
      const std::string word = py::str(key);
      if (word != "names" && word != "function" && word != "derivatives" && word != "reads") {
        throw InputError(fmt::format("{}: expected 'names', 'function', 'derivatives' or 'reads', got '{}'", what, word));
      }
    }
    require_function(given["function"], what);
    if (!given.contains("names")) throw InputError(what + ": missing 'names', one for each number that the function gives");
    n_names = std::ssize(names_argument(given["names"], what + ": names"));
    if (given.contains("derivatives") && !given["derivatives"].is_none()) {
      require_function(given["derivatives"], what + ": derivatives");
      derivatives.emplace(given["derivatives"]);
    }
    if (given.contains("reads") && !given["reads"].is_none()) reads = names_argument(given["reads"], what + ": reads");
  }
};

StateCode features_code(const LatentFunction& of, const std::string& what) {
  StateCode code;
  code.reads = of.reads;
  code.evaluate = [=](const StateCode::States& states, const StateCode::Parameters&) -> MatrixXd {
    const Turn turn;
    const auto array =
        returned(of.function(to_rows(states)), what.c_str(), "features", "(n, names)", {states.cols(), of.n_names});
    return Eigen::Map<const MatrixXd>(array.data(), of.n_names, states.cols());
  };
  return code;
}

StateCode directions_code(const LatentFunction& of, const std::string& what, const std::vector<std::string>& names) {
  // of parameters only names and values are known before there is a system
  const auto named = [names](const StateCode::Parameters& values) {
    py::dict out;
    for (std::size_t k = 0; k < names.size(); ++k) out[py::str(names[k])] = values[static_cast<Index>(k)];
    return out;
  };
  const auto matrices = [=](const py::object& result, Index n) {
    return column_major(returned(result, what.c_str(), "directions", "(n, nq, names)", {n, -1, of.n_names}));
  };
  StateCode code;
  code.reads = of.reads;
  code.evaluate = [=](const StateCode::States& states, const StateCode::Parameters& parameters) {
    const Turn turn;
    return matrices(of.function(to_rows(states), named(parameters)), states.cols());
  };
  if (of.derivatives) {
    code.differentiate = [=](const StateCode::States& states, const StateCode::Parameters& parameters, int index) {
      const Turn turn;
      const std::string& name = names[static_cast<std::size_t>(index)];
      return matrices((*of.derivatives)(to_rows(states), named(parameters), name), states.cols());
    };
  }
  return code;
}

std::optional<LatentFunction> function_in(const py::object& given, const std::string& what) {
  const py::object parts = as_dict(given);
  if (!py::isinstance<py::dict>(parts) || !parts.contains("function")) return std::nullopt;
  return LatentFunction(py::reinterpret_borrow<py::dict>(parts), what);
}

// what is functions among keywords of System
std::map<std::string, ModelCode::OfLatent> latents_code(const py::kwargs& kwargs) {
  std::map<std::string, ModelCode::OfLatent> out;
  if (!kwargs.contains("latents") || kwargs["latents"].is_none()) return out;
  std::vector<std::string> parameters;
  if (kwargs.contains("parameters") && !kwargs["parameters"].is_none()) {
    for (const auto& [name, value] : py::dict(kwargs["parameters"])) {
      if (!py::isinstance<py::str>(value)) parameters.push_back(py::str(name));  // text follows from the others
    }
  }
  int number = 0;
  for (const py::handle latent : kwargs["latents"]) {
    ++number;
    const py::dict given(py::reinterpret_borrow<py::object>(latent));
    const std::string name = given.contains("name") ? std::string(py::str(given["name"])) : fmt::format("latent {}", number);
    const std::string what = fmt::format("latent '{}'", name);
    ModelCode::OfLatent code;
    if (given.contains("features")) {
      if (const auto function = function_in(given["features"], what + ": features")) {
        if (function->derivatives) throw InputError(what + ": features hold no estimated parameters: leave out 'derivatives'");
        code.features = features_code(*function, what);
      }
    }
    if (given.contains("directions")) {
      py::object directions = as_dict(given["directions"]);
      for (const char* base : {"force", "acceleration"}) {
        if (py::isinstance<py::dict>(directions) && directions.contains(base)) directions = directions[base];
      }
      if (const auto function = function_in(directions, what + ": directions")) {
        code.directions = directions_code(*function, what, parameters);
      }
    }
    if (code.features || code.directions) out[name] = std::move(code);
  }
  return out;
}

PySystem from_keywords(const py::kwargs& kwargs, const char* name, ModelCode code) {
  // an iterator gives its items once, and two read them here
  if (kwargs.contains("latents") && py::isinstance<py::iterator>(kwargs["latents"]))
    kwargs["latents"] = py::list(kwargs["latents"]);
  const py::object model_text = py::module_::import("gp2._model_text").attr("model_text");
  const py::dict known = model_text.attr("__kwdefaults__");
  for (const auto& [keyword, value] : kwargs) {
    if (!known.contains(keyword)) refuse_keyword("System", keyword.cast<std::string>(), py::list(known));
  }
  const py::object text = model_text(**kwargs);
  code.latents = latents_code(kwargs);
  return {std::make_shared<const Model>(Model::parse(text.cast<std::string>(), name, code))};
}

PySystem from_callables(const py::object& mechanics, const py::object& constraints, const py::object& derivatives,
                        const py::object& residuals, const std::optional<std::vector<std::string>>& reads,
                        const py::kwargs& kwargs) {
  require_function(mechanics, "mechanics");
  if (!derivatives.is_none()) require_function(derivatives, "derivatives");
  if (!residuals.is_none()) require_function(residuals, "residuals");
  for (const char* key : {"mass", "force"}) {
    if (kwargs.contains(key)) throw InputError(fmt::format("{}: the mechanics are code here; leave it out", key));
  }
  return from_keywords(kwargs, "System.from_callables(…)", {source_of(mechanics, constraints, derivatives, residuals, reads)});
}

}  // namespace

void require_function(const py::object& given, const std::string& name) {
  if (PyCallable_Check(given.ptr()) == 1) return;
  throw py::type_error(fmt::format("{}: expected a function, got {}", name, std::string(py::str(py::type::of(given)))));
}

void add_callables(py::class_<PySystem>& system) {
  using namespace py::literals;
  system.def(py::init([](const py::kwargs& kwargs) { return from_keywords(kwargs, "System(…)", {}); }));
  system.def_static("from_callables", &from_callables, "mechanics"_a, "constraints"_a = py::tuple(), "derivatives"_a = py::none(),
                    "residuals"_a = py::none(), "reads"_a = py::none(),
                    R"(A system whose equations are functions, say of Pinocchio, MuJoCo or Drake.

mechanics(states, parameters) -> (M, A, b, F)
    states (n, len(state_names)), parameters {name: value}; M (n, nq, nq), A (n, nc, nq), b (n, nc), F (n, nq); A and b may be
    None where nothing constrains
constraints
    names of the rows of A; or {"position": […], "velocity": […], "acceleration": […]}, rows in that order
derivatives(states, parameters, name) -> (dM, dA, db, dF)
    in one parameter, exact; default: central differences
residuals(states, parameters) -> (n, rows)
    c1, dc1/dt, c2, dc2/dt, … of the constraints at position level, then c of each at velocity level; without them motions are not projected, and
    rows that follow from others must be left out if states are measured
reads
    names of the entries of a state that the functions read; a log needs these columns. Default: all, t too

Every other keyword is that of System: coordinates, inputs, parameters, latents, noise, …; mass and force are left out.
What the functions return is checked at every call. They are called one at a time in the whole process, with the interpreter's lock.
So none of them may fit or predict, in several threads, with a system that has functions itself: it would wait for its own end.
A fit of such a system is saved without them: gp2.load(path, system=this).

Raises InputError naming the function, what was expected and what it returned.)");
}

}  // namespace gp2::python
