#pragma once

#include <atomic>
#include <chrono>
#include <exception>
#include <future>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <pybind11/pybind11.h>
#include <Eigen/Core>

#include "arrays.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/jobs/derive.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/model.hpp"
#include "gp2/posterior.hpp"

namespace gp2::python {

// One function per group of classes; each adds them to the module.
void add_table(py::module_& module);
void add_system(py::module_& module);
void add_posterior(py::module_& module);
void add_fit(py::module_& module);
void add_fit_report(py::module_& module);
void add_motion(py::module_& module);
void add_excitation(py::module_& module);
void add_predictor(py::module_& module);
void add_report(py::module_& module);

/// What a Python function raises to end the program, KeyboardInterrupt or SystemExit. It is no std::exception: nothing that goes on
/// without a failed call may go on here.
struct Interruption {
  py::error_already_set error;
};

/// gp2.System: a model file.
struct PySystem {
  std::shared_ptr<const Model> model;

  [[nodiscard]] const System& system() const { return *model->system; }
};

/// System(…) and System.from_callables: the text of a model from keywords, and what in it is Python functions.
void add_callables(py::class_<PySystem>& system);

/// Code of a system; none without one.
inline ModelCode code_of(const PySystem* system) { return system == nullptr ? ModelCode() : system->model->code; }

inline std::shared_ptr<const Model> model_of(const PySystem* system) { return system == nullptr ? nullptr : system->model; }

/// gp2.Posterior: what a fit file holds, conditioned.
struct PyPosterior {
  FitFile file;  // without observations: those of `posterior`, which may grow
  Posterior posterior;
  std::vector<std::string> notes;

  [[nodiscard]] const System& system() const { return *file.model.system; }
  /// Whether Python functions may run in a call: those of the fitted system, or of another that it was learned from.
  [[nodiscard]] bool has_code() const {
    return file.model.code || std::ranges::any_of(file.systems, [](const auto& one) { return one && one->code; });
  }
};

/// Methods of a posterior that move, and the functions gp2.simulate and gp2.excite. They have their keywords in signatures of our own.
void define_simulate(py::class_<PyPosterior>& posterior, py::module_& module);
void define_excite(py::module_& module);

/// @throws py::type_error for what cannot be called.
void require_function(const py::object& given, const std::string& name);

/// A FIT.json, read without the interpreter's lock. What is Python functions in it is that of `system`.
FitFile read_fit(const py::object& path, const PySystem* system = nullptr);

/// work() without the interpreter's lock.
template <typename Work>
auto unlocked(const Work& work) {
  const py::gil_scoped_release release;
  return work();
}

/// A str, bytes or os.PathLike. @throws py::type_error naming the argument, and what is expected of it
std::string path_argument(const py::object& path, const std::string& name = "path", const char* expected = "a path");

/// What became of each column of a raw log.
pybind11::dict report_of(const DerivedData& derived, const System& system);

/// A table from a gp2.Table, a path, a frame of pandas or polars, a structured array, or a mapping of column names to arrays.
/// @param what  stands for the argument in messages
/// @param keep  of a file; a gp2.Table is as it was read
CsvTable to_table(const py::object& data, const std::string& what, CsvTable::Keep keep = CsvTable::Keep::numbers);

/// The model's name -> the log's name. @throws py::type_error
std::map<std::string, std::string> columns_argument(const py::object& columns);

/// Beside an array of states. @throws InputError
void require_no_columns(const py::object& columns);

/// Names that an argument lists; None where it is not given.
using GivenNames = std::optional<std::vector<std::string>>;
/// No names stand for all. @throws InputError for an empty list, whose caller does not mean all.
std::vector<std::string> names_or_all(const GivenNames& names, const char* what);

/// @throws InputError when there is a value and it is smaller.
void require_at_least(int smallest, const std::optional<int>& value, const char* what);

/// Tells the notes of a reading: warnings through Python's warnings, the rest through the logger "gp2".
void tell(const std::vector<std::string>& notes);

/// States of an array (n, layout size), looked at in place where they are C-contiguous doubles, or of a table by column names.
class States {
 public:
  /// @throws InputError when an entry that the prior or the view reads is not finite; as Rows and read_log_states.
  /// @param parameters  fitted, of the system that is predicted
  States(const py::object& data, const PredictedView& at, const Eigen::VectorXd& parameters, const py::object& columns);

  [[nodiscard]] Eigen::Map<const Eigen::MatrixXd> matrix() const;  // (layout size × n)

  /// work(), with the table named in what it throws: a posterior knows the number of a state only.
  template <typename Work>
  auto named(const Work& work) const {
    try {
      return work();
    } catch (const InputError& error) {
      if (array_) throw;
      throw InputError(table_ + ": " + error.what());
    }
  }

 private:
  std::optional<Rows> array_;
  Eigen::MatrixXd read_;
  std::string table_;
};

/// A view by its word. @throws InputError listing the words.
View::Quantity quantity_argument(const std::string& word);

/// work(), in another thread and without the GIL. This thread looks for signals and calls poll() twenty times a second; a signal
/// whose handler raises sets `stop`, after which work() is waited for.
/// @param raised  what the handler raised, if it did
template <typename Work, typename Poll>
auto run_interruptibly(const Work& work, std::atomic<bool>& stop, std::exception_ptr& raised, const Poll& poll) {
  auto result = std::async(std::launch::async, work);
  while (true) {
    bool ready = false;
    {
      const py::gil_scoped_release release;
      ready = result.wait_for(std::chrono::milliseconds(50)) == std::future_status::ready;
    }
    try {
      if (!raised && PyErr_CheckSignals() != 0) throw py::error_already_set();
      if (!raised && !ready) poll();
    } catch (...) {
      raised = std::current_exception();
      stop = true;
    }
    if (ready) return result.get();
  }
}

/// Throws what was raised. A Python exception gets what was found until then as an attribute.
[[noreturn]] inline void raise_with(const std::exception_ptr& raised, const char* attribute, const py::object& best) {
  try {
    std::rethrow_exception(raised);
  } catch (py::error_already_set& error) {
    error.value().attr(attribute) = best;
    throw;
  } catch (const Interruption& interruption) {
    interruption.error.value().attr(attribute) = best;
    throw;
  }
}

/// work(), after which there is nothing to give yet: what it throws has None as that attribute.
template <typename Work>
auto before_any(const char* attribute, const Work& work) {
  try {
    return work();
  } catch (...) {
    raise_with(std::current_exception(), attribute, py::none());
  }
}

/// The result of work(const std::atomic<bool>* stop), run as by run_interruptibly. What a signal's handler raises is raised here,
/// whatever work() made of its end.
template <typename Work>
auto run_or_raise(const Work& work) {
  std::atomic<bool> stop = false;
  std::exception_ptr raised;
  try {
    auto result = run_interruptibly([&] { return work(&stop); }, stop, raised, [] {});
    if (!raised) return result;
  } catch (...) {
    if (!raised) throw;
  }
  std::rethrow_exception(raised);
}

}  // namespace gp2::python
