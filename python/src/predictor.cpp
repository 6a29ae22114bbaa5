#include "gp2/predictor.hpp"

#include <cmath>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <pybind11/stl.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "gp2/error.hpp"
#include "gp2/inference/inverse_dynamics.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/jobs/predict_job.hpp"

namespace gp2::python {

namespace {

using Numbers = py::array_t<double, py::array::c_style>;

// the array itself where it is one of doubles, all of which may be looked at
Numbers numbers_of(const py::object& given, const std::vector<std::string>& names, const char* what) {
  if (Numbers::check_(given) && !py::hasattr(given, "mask")) {
    auto x = py::reinterpret_borrow<Numbers>(given);
    const bool is_aligned = (x.flags() & py::detail::npy_api::NPY_ARRAY_ALIGNED_) != 0;
    if (is_aligned && x.ndim() == 1 && x.shape(0) == std::ssize(names)) return x;
  }
  return vector_argument(given, names, what);
}

// @throws InputError naming the entries that are read and are not finite, where there are some
void require_finite(const Numbers& x, const std::vector<std::string>& names, const std::vector<bool>& reads, const char* what) {
  std::vector<std::string> faults;
  for (std::size_t k = 0; k < names.size(); ++k) {
    const double value = x.data()[k];
    if (reads[k] && !std::isfinite(value)) faults.push_back(fmt::format("{} is {}", names[k], value));
  }
  if (faults.empty()) return;
  throw InputError(fmt::format("{}: {}; what is read must be finite", what, fmt::join(faults, ", ")));
}

// Of the entries of a state, which a prior or a view of it reads.
std::vector<bool> entries_read(const Prior& prior, const View& view) {
  std::vector<bool> reads = prior.reads();
  const std::vector<bool> of_view = view.reads(*prior.system);
  for (std::size_t k = 0; k < reads.size(); ++k) reads[k] = reads[k] || of_view[k];
  return reads;
}

// Whether Python functions, of the fitted system or of another, may run in a call.
bool calls_python(const PyPosterior& posterior, const PySystem* system) { return posterior.has_code() || code_of(system); }

Eigen::Map<const Eigen::VectorXd> map(const Numbers& x) { return {x.data(), x.size()}; }
Eigen::Map<Eigen::VectorXd> map_out(py::array_t<double>& x) { return {x.mutable_data(), x.size()}; }

/// A square matrix in the memory of an array; one that is symmetric, so that rows may be columns.
struct Symmetric {
  explicit Symmetric(Eigen::Index size) : array({size, size}), matrix(array.mutable_data(), size, size) {}
  py::array_t<double> array;
  Eigen::Map<Eigen::MatrixXd> matrix;
};

Predictor::Storage storage_argument(const std::string& storage) {
  if (storage != "double" && storage != "single") {
    throw InputError(fmt::format("storage: expected 'double' or 'single', got '{}'", storage));
  }
  return storage == "single" ? Predictor::Storage::single_precision : Predictor::Storage::double_precision;
}

/// A predictor and the memory of its caller. Python threads take turns, unless Python functions of the model let go of the
/// interpreter's lock: then each call has its own memory.
class PyPredictor {
 public:
  /// @param reads     of the entries of a state, which are read
  /// @param has_code  as calls_python
  PyPredictor(const PyPosterior& posterior, const View& view, const Predictor::Options& options, std::vector<bool> reads,
              bool has_code)
      : predictor_(posterior.posterior, view, options),
        workspace_(predictor_.make_workspace()),
        model_has_code_(has_code),
        names_(posterior.system().state_names()),
        reads_(std::move(reads)) {}

  py::array_t<double> mean(const py::object& state) {
    const auto x = state_of(state);
    py::array_t<double> mean(rows());
    require(x, [&](Predictor::Workspace& workspace) { return predictor_.mean(map(x), map_out(mean), workspace); });
    return mean;
  }

  py::tuple mean_and_std(const py::object& state) {
    const auto x = state_of(state);
    py::array_t<double> mean(rows()), stddev(rows());
    require(x, [&](Predictor::Workspace& workspace) {
      return predictor_.mean_and_stddev(map(x), map_out(mean), map_out(stddev), workspace);
    });
    return py::make_tuple(mean, stddev);
  }

  py::tuple mean_and_cov(const py::object& state) {
    const auto x = state_of(state);
    py::array_t<double> mean(rows());
    Symmetric covariance(rows());
    require(x, [&](Predictor::Workspace& workspace) {
      return predictor_.mean_and_covariance(map(x), map_out(mean), covariance.matrix, workspace);
    });
    return py::make_tuple(mean, covariance.array);
  }

  py::tuple mean_and_jacobian(const py::object& state) {
    const auto x = state_of(state);
    py::array_t<double, py::array::f_style> jacobian({static_cast<py::ssize_t>(rows()), std::ssize(names_)});
    py::array_t<double> mean(rows());
    Eigen::Map<Eigen::MatrixXd> columns(jacobian.mutable_data(), rows(), std::ssize(names_));
    require(x, [&](Predictor::Workspace& workspace) {
      return predictor_.mean_and_jacobian(map(x), map_out(mean), columns, workspace);
    });
    return py::make_tuple(mean, jacobian);
  }

  double distance_from_data(const py::object& state) {
    const auto x = state_of(state);
    double distance = 0;
    require(x, [&](Predictor::Workspace& workspace) {
      distance = predictor_.distance_from_data(map(x), workspace);
      if (!std::isnan(distance)) return Predictor::Status::ok;
      Eigen::VectorXd mean(rows());
      return predictor_.mean(map(x), mean, workspace);
    });
    return distance;
  }

 private:
  [[nodiscard]] Eigen::Index rows() const { return predictor_.view().size(); }

  [[nodiscard]] Numbers state_of(const py::object& state) const { return numbers_of(state, names_, "state"); }

  template <typename Call>
  void require(const Numbers& state, const Call& call) {
    if (!model_has_code_) return require_ok(call(workspace_), state);
    Predictor::Workspace own = predictor_.make_workspace();
    require_ok(call(own), state);
  }

  void require_ok(Predictor::Status status, const Numbers& state) const {
    switch (status) {
      case Predictor::Status::ok:
        return;
      case Predictor::Status::mass_not_positive_definite:
        throw InputError("state: the mass matrix is not positive definite there");
      case Predictor::Status::motion_undetermined:
        throw InputError(
            "state: the mass matrix is singular there, and the constraints leave a direction in which nothing determines ddq");
      case Predictor::Status::no_unconstrained_acceleration:
        throw InputError(
            "state: the mass matrix is singular there, so that there is no unconstrained acceleration, which the view or a "
            "latent is "
            "of");
      case Predictor::Status::contradicting_constraints:
        throw InputError("state: the constraints contradict each other there: no acceleration satisfies A ddq = b");
      case Predictor::Status::not_finite:
        require_finite(state, names_, reads_, "state");
        throw InputError("state: a number that is read, or what the model makes of it, is not finite");
    }
  }

  Predictor predictor_;
  Predictor::Workspace workspace_;
  bool model_has_code_ = false;
  std::vector<std::string> names_;  // of a state
  std::vector<bool> reads_;         // of its entries, which are read
};

PyPredictor make(const PyPosterior& posterior, const std::string& quantity, const PySystem* system,
                 const std::optional<std::string>& latent, const std::optional<double>& dt, bool std, bool jacobian,
                 const std::string& storage) {
  const ViewRequest request{quantity_argument(quantity), dt, latent, model_of(system)};
  const PredictedView at = predicted_view(posterior.file, posterior.posterior.prior(), request);
  return {posterior,
          at.view,
          {std, jacobian, storage_argument(storage)},
          entries_read(at.prior, at.view),
          calls_python(posterior, system)};
}

/// Inverse dynamics and the memory of its caller, as PyPredictor.
class PySolver {
 public:
  /// @param reads     of the entries of a state, which must be finite
  /// @param has_code  as calls_python
  PySolver(const PyPosterior& posterior, const View& view, const InverseDynamicsSolver::Options& options, std::vector<bool> reads,
           bool has_code)
      : solver_(posterior.posterior, view, options),
        workspace_(solver_.make_workspace()),
        model_has_code_(has_code),
        names_(posterior.system().state_names()),
        wanted_names_(view.names(posterior.system())),
        reads_(std::move(reads)),
        nu_(posterior.system().layout().nu) {}

  py::array_t<double> inputs(const py::object& state, const py::object& accelerations) {
    py::array_t<double> inputs(nu_);
    require(state, accelerations, [&](const auto& x, const auto& wanted, InverseDynamicsSolver::Workspace& workspace) {
      return solver_.inputs(x, wanted, map_out(inputs), workspace);
    });
    return inputs;
  }

  py::tuple inputs_and_cov(const py::object& state, const py::object& accelerations) {
    py::array_t<double> inputs(nu_);
    Symmetric covariance(nu_);
    require(state, accelerations, [&](const auto& x, const auto& wanted, InverseDynamicsSolver::Workspace& workspace) {
      return solver_.inputs_and_covariance(x, wanted, map_out(inputs), covariance.matrix, workspace);
    });
    return py::make_tuple(inputs, covariance.array);
  }

 private:
  template <typename Call>
  void require(const py::object& state, const py::object& accelerations, const Call& call) {
    const Numbers x = numbers_of(state, names_, "state");
    const Numbers wanted = numbers_of(accelerations, wanted_names_, "accelerations");
    if (!model_has_code_) return require_ok(call(map(x), map(wanted), workspace_), x, wanted);
    InverseDynamicsSolver::Workspace own = solver_.make_workspace();
    require_ok(call(map(x), map(wanted), own), x, wanted);
  }

  void require_ok(InverseDynamicsSolver::Status status, const Numbers& state, const Numbers& wanted) const {
    switch (status) {
      case InverseDynamicsSolver::Status::ok:
        return;
      case InverseDynamicsSolver::Status::no_prediction:
        require_finite(state, names_, reads_, "state");
        throw InputError("state: there is no prediction with these inputs; Predictor.mean_and_jacobian says why");
      case InverseDynamicsSolver::Status::not_finite:
        require_finite(wanted, wanted_names_, std::vector<bool>(wanted_names_.size(), true), "accelerations");
        throw InputError("accelerations: one that is wanted is not a finite number");
      case InverseDynamicsSolver::Status::not_found:
        throw NumericalError("state: no inputs are found that produce the accelerations, or come nearest to them");
    }
  }

  InverseDynamicsSolver solver_;
  InverseDynamicsSolver::Workspace workspace_;
  bool model_has_code_ = false;
  std::vector<std::string> names_, wanted_names_;  // of a state, and of its accelerations
  std::vector<bool> reads_;                        // of the entries of a state, which must be finite
  Eigen::Index nu_ = 0;
};

PySolver make_solver(const PyPosterior& posterior, const GivenNames& outputs, const PySystem* system, bool cov,
                     const std::string& storage) {
  const FitSystem at = system_of(posterior.file, posterior.posterior.prior(), model_of(system));
  View view{View::Quantity::constrained_acceleration,
            acceleration_rows(*at.model->system, names_or_all(outputs, "outputs"), "`outputs`")};
  view.other_system = at.other_system;
  std::vector<bool> reads = entries_read(at.prior, view);
  const StateLayout layout = at.model->system->layout();
  for (int k = 0; k < layout.nu; ++k)
    reads[static_cast<std::size_t>(layout.u(k))] = false;  // the search begins at 0 where one is NaN
  return {posterior, view, {cov, storage_argument(storage)}, std::move(reads), calls_python(posterior, system)};
}

}  // namespace

void add_predictor(py::module_& module) {
  using namespace py::literals;
  py::class_<PyPredictor>(module, "Predictor", R"(A view at one state after another, for control loops: microseconds a call.

system, latent, dt  as of Posterior.predict
std, jacobian  whether they will be asked for
storage        'double', or 'single': half the memory and faster, constraints still exact; include/gp2/predictor.hpp has its error

A state is (len(state_names)). A state without a prediction raises InputError. The predictor is made from the posterior as it is
now: after update or remove_oldest make a new one.)")
      .def(py::init(&make), "posterior"_a, "view"_a = "constrained", py::kw_only(), "system"_a = nullptr, "latent"_a = py::none(),
           "dt"_a = py::none(), "std"_a = true, "jacobian"_a = true, "storage"_a = "double")
      .def("mean", &PyPredictor::mean, "state"_a, "(d)")
      .def("mean_and_std", &PyPredictor::mean_and_std, "state"_a, "(d), (d)")
      .def("mean_and_cov", &PyPredictor::mean_and_cov, "state"_a, "(d), (d, d)")
      .def("mean_and_jacobian", &PyPredictor::mean_and_jacobian, "state"_a,
           "(d), and its exact derivative in the state (d, len(state_names)).")
      .def("distance_from_data", &PyPredictor::distance_from_data, "state"_a, "As of Prediction.");

  py::class_<PySolver>(module, "InverseDynamicsSolver",
                       R"(Posterior.inverse_dynamics at one state after another, for control loops: microseconds a call.

outputs  which accelerations are wanted; default: all
system   another System with the same coordinates, inputs and latents
cov      whether it will be asked for
storage  as of Predictor

A state is (len(state_names)); its inputs are where the search begins. Made from the posterior as it is now, as Predictor. Raises NumericalError where no inputs are found.)")
      .def(py::init(&make_solver), "posterior"_a, py::kw_only(), "outputs"_a = py::none(), "system"_a = nullptr, "cov"_a = true,
           "storage"_a = "double")
      .def("inputs", &PySolver::inputs, "state"_a, "accelerations"_a, "(len(system.inputs))")
      .def("inputs_and_cov", &PySolver::inputs_and_cov, "state"_a, "accelerations"_a, "And their covariance, a square array.");
}

}  // namespace gp2::python
