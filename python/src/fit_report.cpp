#include <algorithm>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <pybind11/stl.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "gp2/jobs/show_job.hpp"
#include "gp2/training/laplace.hpp"
#include "pickles.hpp"

// for pickles
namespace gp2 {

static auto fields(HyperPrior& of) { return std::tie(of.form, of.median, of.stddev, of.family, of.correlation); }
static auto fields(Hyperparameter::Follower& of) { return std::tie(of.latent, of.column, of.share); }
static auto fields(Hyperparameter& of) {
  return std::tie(of.kind, of.owner, of.index, of.column_scale, of.name, of.unit, of.value, of.lower, of.upper, of.positive,
                  of.size, of.hyperprior, of.followers);
}
static auto fields(RestartReport& of) {
  return std::tie(of.objective, of.negative_log_likelihood, of.iterations, of.evaluations, of.failed_evaluations, of.converged,
                  of.termination);
}
static auto fields(LaplaceUncertainty& of) {
  return std::tie(of.stddev, of.correlation, of.held, of.undetermined, of.distance_from_optimum);
}
static auto fields(HyperparameterDraws& of) {
  return std::tie(of.values, of.mean, of.stddev, of.lower, of.upper, of.r_hat, of.effective_size, of.correlation, of.n_chains,
                  of.evaluations, of.acceptance, of.n_impossible);
}
static auto fields(ActuatorEstimate& of) { return std::tie(of.name, of.value, of.stddev, of.lower, of.upper, of.moves); }
static auto fields(DistrustedValue& of) { return std::tie(of.group, of.row, of.state, of.distance, of.noise_factor); }
// what Python is told of it: not the points themselves
static auto fields(InducingReport& of) { return std::tie(of.n_variables, of.left_out, of.n_start); }
static auto fields(FitReport& of) {
  return std::tie(of.hyperparameters, of.negative_log_likelihood, of.objective, of.converged, of.termination, of.iterations,
                  of.best_restart, of.n_escapes, of.restarts, of.uncertainty, of.draws, of.actuators, of.distrusted, of.inducing,
                  of.seconds);
}

}  // namespace gp2

namespace gp2::python {

using namespace py::literals;

namespace {

py::list actuators_of(const FitReport& self) {
  py::list out;
  for (const ActuatorEstimate& one : self.actuators) {
    out.append(py::dict("name"_a = one.name, "value"_a = one.value, "std"_a = one.stddev, "lower"_a = one.lower,
                        "upper"_a = one.upper, "at_bound"_a = one.at_lower() || one.at_upper(), "moves"_a = one.moves));
  }
  return out;
}

py::object inducing_of(const FitReport& self) {
  if (!self.inducing) return py::none();
  return py::dict("n_variables"_a = self.inducing->n_variables, "left_out"_a = to_vector(self.inducing->left_out),
                  "n_start"_a = self.inducing->n_start);
}

py::list distrusted_values(const FitReport& self) {
  py::list list;
  for (const DistrustedValue& value : self.distrusted) {
    list.append(py::dict("log"_a = value.group, "row"_a = value.row, "state"_a = value.state, "distance"_a = value.distance,
                         "noise_factor"_a = value.noise_factor));
  }
  return list;
}

py::dict standard_errors(const FitReport& self) {
  py::dict errors;
  for (std::size_t k = 0; (self.uncertainty || self.draws) && k < self.hyperparameters.size(); ++k) {
    const Hyperparameter& h = self.hyperparameters[k];
    if (h.is_system_parameter()) errors[py::str(h.name)] = parameter_uncertainty(self, k).stddev;
  }
  return errors;
}

std::vector<std::string> names_of(const FitReport& self) {
  std::vector<std::string> names;
  for (const Hyperparameter& h : self.hyperparameters) names.push_back(h.name);
  return names;
}

std::size_t index_of(const FitReport& self, const std::string& name) {
  const std::vector<std::string> names = names_of(self);
  const auto found = std::ranges::find(names, name);
  if (found != names.end()) return static_cast<std::size_t>(found - names.begin());
  throw py::key_error(fmt::format("no hyperparameter '{}'; there are: {}", name, fmt::join(names, ", ")));
}

double correlation(const FitReport& self, const std::string& a, const std::string& b) {
  return parameter_correlation(self, index_of(self, a), index_of(self, b));
}

// name -> what the draws say of a hyperparameter; None where there are none
py::object draws_of(const FitReport& self) {
  if (!self.draws) return py::none();
  py::dict all;
  for (std::size_t h = 0; h < self.hyperparameters.size(); ++h) {
    const auto k = static_cast<Eigen::Index>(h);
    const HyperparameterDraws& draws = *self.draws;
    all[py::str(self.hyperparameters[h].name)] =
        py::dict("values"_a = to_vector(Eigen::VectorXd(draws.values.row(k))), "mean"_a = draws.mean[k],
                 "std"_a = draws.stddev[k], "interval95"_a = py::make_tuple(draws.lower[k], draws.upper[k]),
                 "r_hat"_a = draws.r_hat[k], "effective_size"_a = draws.effective_size[k]);
  }
  return all;
}

double value_of(const FitReport& self, const std::string& name) { return self.hyperparameters[index_of(self, name)].value; }

// As `gp2 fit` prints it, but for the model's units, which a report does not hold.
std::string text_of(const FitReport& self) {
  std::string text = gp2::text_of(self, Model{});
  text.pop_back();  // the end of the last line
  return text;
}

void define_report(py::class_<FitReport>& report) {
  report.def_readonly("hyperparameters", &FitReport::hyperparameters, "Fitted values, list of Hyperparameter.")
      .def_readonly("negative_log_likelihood", &FitReport::negative_log_likelihood,
                    "-log p(y) at the fit, physical units, all constants, without hyper-prior. After an update "
                    "Posterior.negative_log_likelihood is that of the rows there are now.")
      .def_readonly("objective", &FitReport::objective, "With hyper-priors: what was minimised.")
      .def_readonly("converged", &FitReport::converged, "Whether the optimiser met its tolerances.")
      .def_readonly("termination", &FitReport::termination, "Which inequality stopped the optimiser.")
      .def_readonly("iterations", &FitReport::iterations, "Of the best restart.")
      .def_readonly("best_restart", &FitReport::best_restart, "Number of the run, from 0, that ended lowest.")
      .def_readonly("restarts", &FitReport::restarts, "How each run ended, list of RestartReport.")
      .def_property_readonly(
          "distrusted", &distrusted_values,
          "Values that a robust fit distrusts, the farthest first: `log` and `state` count from 0, `row` among the observed.")
      .def_property_readonly(
          "actuators", &actuators_of,
          "Delays and lags of inputs that were estimated, in s: dicts of name, value, std (nan at a bound, inf where the data do "
          "not determine it), lower, upper, at_bound, and moves, by how much its error shifts each estimated parameter, which "
          "standard_errors count.")
      .def_property_readonly(
          "inducing", &inducing_of,
          "Of a fit through inducing points: n_variables, left_out, of each latent what they leave of its variance at all "
          "rows, in units of the noise (twice the nats by which the likelihood is too low, about), and n_start, the rows "
          "that hyperparameters were fitted to before all; else None.")
      .def_readonly("seconds", &FitReport::seconds, "That the fit took.")
      .def_property_readonly("standard_errors", &standard_errors,
                             "Of estimated parameters, by name: inf where the data do not determine one, nan where it is at a "
                             "bound. Of the draws, where "
                             "all that are estimated were drawn.")
      .def_property_readonly(
          "draws", &draws_of,
          "Of hyperparameters='integrate': by name a dict of values (one for each component of the posterior), mean, "
          "std, interval95, r_hat and effective_size; else None.")
      .def("correlation", &correlation, "a"_a, "b"_a, "Of the errors of two hyperparameters; nan where one is not determined.")
      .def("__getitem__", &value_of)
      .def("keys", &names_of, "Names of the hyperparameters.")
      .def("__contains__",
           [](const FitReport& self, const py::object& name) {
             return py::isinstance<py::str>(name) && std::ranges::count(names_of(self), name.cast<std::string>()) > 0;
           })
      .def(
          "__iter__", [](const FitReport& self) { return py::iter(py::cast(names_of(self))); }, "Names of the hyperparameters.")
      .def("__repr__", &text_of)
      .def(pickled<FitReport>());
}

}  // namespace

void add_fit_report(py::module_& module) {
  py::class_<Hyperparameter>(module, "Hyperparameter", "One number that training adjusts, in physical units.")
      .def_readonly("name", &Hyperparameter::name, "As report[name] takes it.")
      .def_readonly("unit", &Hyperparameter::unit, "Of the value; empty: none.")
      .def_readonly("value", &Hyperparameter::value, "Fitted.")
      .def_readonly("lower", &Hyperparameter::lower, "Bound of the search.")
      .def_readonly("upper", &Hyperparameter::upper, "Bound of the search.")
      .def_property_readonly("at_bound", &Hyperparameter::at_bound, "Whether the value lies at a bound.")
      .def("__repr__",
           [](const Hyperparameter& h) {
             return fmt::format("<{} = {:.6g} in [{:.3g}, {:.3g}]{}>", h.name, h.value, h.lower, h.upper,
                                h.is_fixed()   ? ", held"
                                : h.at_bound() ? ", at its bound"
                                               : "");
           })
      .def(pickled<Hyperparameter>());
  py::class_<RestartReport>(module, "RestartReport", "How one run of the optimiser ended.")
      .def_readonly("objective", &RestartReport::objective, "-log p(y) with hyper-priors, at its end.")
      .def_readonly("negative_log_likelihood", &RestartReport::negative_log_likelihood, "-log p(y) at its end.")
      .def_readonly("iterations", &RestartReport::iterations, "Of the optimiser.")
      .def_readonly("evaluations", &RestartReport::evaluations, "Of the objective and its gradient.")
      .def_readonly("failed_evaluations", &RestartReport::failed_evaluations, "That gave no number.")
      .def_readonly("converged", &RestartReport::converged, "Whether it met its tolerances.")
      .def_readonly("termination", &RestartReport::termination, "Which inequality stopped it.")
      .def("__repr__",
           [](const RestartReport& of) {
             return fmt::format("<gp2.RestartReport: objective {:.6g} after {} iterations, {}>", of.objective, of.iterations,
                                of.termination);
           })
      .def(pickled<RestartReport>());
  py::class_<FitReport> report(module, "FitReport", "How a fit went; report['name'] is a fitted hyperparameter.");
  define_report(report);
}

}  // namespace gp2::python
