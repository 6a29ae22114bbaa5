#include "gp2/predictor.hpp"

#include <fmt/format.h>
#include <pybind11/stl.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "gp2/error.hpp"
#include "gp2/jobs/predict_job.hpp"

namespace gp2::python {

namespace {

/// A predictor and the memory of its caller. Python threads take turns, unless Python functions of the model let go of the
/// interpreter's lock: then each call has its own memory.
class PyPredictor {
 public:
  PyPredictor(const PyPosterior& posterior, const View& view, const Predictor::Options& options)
      : predictor_(posterior.posterior, view, options),
        workspace_(predictor_.make_workspace()),
        model_has_code_(posterior.file.model.code),
        size_(posterior.system().layout().size()) {}

  py::array_t<double> mean(const py::object& state) {
    const auto x = state_of(state);
    py::array_t<double> mean(rows());
    require([&](Predictor::Workspace& workspace) { return predictor_.mean(map(x), map_out(mean), workspace); });
    return mean;
  }

  py::tuple mean_and_std(const py::object& state) {
    const auto x = state_of(state);
    py::array_t<double> mean(rows()), stddev(rows());
    require([&](Predictor::Workspace& workspace) {
      return predictor_.mean_and_stddev(map(x), map_out(mean), map_out(stddev), workspace);
    });
    return py::make_tuple(mean, stddev);
  }

  py::tuple mean_and_jacobian(const py::object& state) {
    const auto x = state_of(state);
    py::array_t<double, py::array::f_style> jacobian({static_cast<py::ssize_t>(rows()), static_cast<py::ssize_t>(size_)});
    py::array_t<double> mean(rows());
    Eigen::Map<Eigen::MatrixXd> columns(jacobian.mutable_data(), rows(), size_);
    require(
        [&](Predictor::Workspace& workspace) { return predictor_.mean_and_jacobian(map(x), map_out(mean), columns, workspace); });
    return py::make_tuple(mean, jacobian);
  }

  double distance_from_data(const py::object& state) {
    const auto x = state_of(state);
    double distance = 0;
    require([&](Predictor::Workspace& workspace) {
      distance = predictor_.distance_from_data(map(x), workspace);
      return Predictor::Status::ok;
    });
    return distance;
  }

 private:
  using State = py::array_t<double, py::array::c_style>;

  [[nodiscard]] Eigen::Index rows() const { return predictor_.view().size(); }

  // the array itself where it is one of doubles
  [[nodiscard]] State state_of(const py::object& state) const {
    if (State::check_(state)) {
      auto x = py::reinterpret_borrow<State>(state);
      if (x.ndim() == 1 && x.shape(0) == size_) return x;
    }
    return vector_argument(state, size_, "state");
  }

  static Eigen::Map<const Eigen::VectorXd> map(const State& x) { return {x.data(), x.size()}; }
  static Eigen::Map<Eigen::VectorXd> map_out(py::array_t<double>& x) { return {x.mutable_data(), x.size()}; }

  template <typename Call>
  void require(const Call& call) {
    if (!model_has_code_) return require_ok(call(workspace_));
    Predictor::Workspace own = predictor_.make_workspace();
    require_ok(call(own));
  }

  static void require_ok(Predictor::Status status) {
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
        throw InputError("state: a number that is read, or what the model makes of it, is not finite");
    }
  }

  Predictor predictor_;
  Predictor::Workspace workspace_;
  bool model_has_code_ = false;
  Eigen::Index size_ = 0;
};

PyPredictor make(const PyPosterior& posterior, const std::string& quantity, const PySystem* system,
                 const std::optional<std::string>& latent, const std::optional<double>& dt, bool std, bool jacobian,
                 const std::string& storage) {
  const ViewRequest request{quantity_argument(quantity), dt, latent, system == nullptr ? nullptr : system->model};
  const View view = predicted_view(posterior.file, posterior.posterior.prior(), request).view;
  if (storage != "double" && storage != "single") {
    throw InputError(fmt::format("storage: expected 'double' or 'single', got '{}'", storage));
  }
  const auto precision = storage == "single" ? Predictor::Storage::single_precision : Predictor::Storage::double_precision;
  return {posterior, view, {std, jacobian, precision}};
}

}  // namespace

void add_predictor(py::module_& module) {
  using namespace py::literals;
  py::class_<PyPredictor>(module, "Predictor", R"(A view at one state after another, for control loops: microseconds a call.

system, latent, dt  as of Posterior.predict
std, jacobian  whether they will be asked for
storage        'double', or 'single': half the memory and faster, constraints still exact; include/gp2/predictor.hpp has its error

A state is (len(state_names)). A state without a prediction raises InputError.)")
      .def(py::init(&make), "posterior"_a, "view"_a = "constrained", py::kw_only(), "system"_a = nullptr, "latent"_a = py::none(),
           "dt"_a = py::none(), "std"_a = true, "jacobian"_a = true, "storage"_a = "double")
      .def("mean", &PyPredictor::mean, "state"_a, "(d)")
      .def("mean_and_std", &PyPredictor::mean_and_std, "state"_a, "(d), (d)")
      .def("mean_and_jacobian", &PyPredictor::mean_and_jacobian, "state"_a,
           "(d), and its exact derivative in the state (d, len(state_names)).")
      .def("distance_from_data", &PyPredictor::distance_from_data, "state"_a,
           "As of Prediction; nan where a feature is not finite.");
}

}  // namespace gp2::python
