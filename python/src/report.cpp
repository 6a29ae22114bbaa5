#include <filesystem>

#include <pybind11/stl.h>

#include "bindings.hpp"
#include "gp2/base/file.hpp"
#include "gp2/report/plot.hpp"
#include "gp2/report/report_page.hpp"
#include "options.hpp"

namespace gp2::python {

namespace {

// a model as it stands in a file, or at hand
std::shared_ptr<const Model> model_argument(const py::object& system) {
  if (system.is_none()) return nullptr;
  if (py::isinstance<PySystem>(system)) return system.cast<const PySystem&>().model;
  return std::make_shared<const Model>(Model::read(path_argument(system, "system")));
}

std::filesystem::path file_of(const py::object& fit) {
  return path_argument(fit, "fit", "a gp2.Posterior or the path of a FIT.json");
}

Report collected(const py::object& fit, const ReportRequest& request, std::vector<std::string>& notes) {
  if (!py::isinstance<PyPosterior>(fit)) {
    const std::filesystem::path path = file_of(fit);
    return unlocked([&] { return collect_report(path, request, notes); });
  }
  const auto& self = fit.cast<const PyPosterior&>();
  const Posterior posterior = self.posterior;
  FitFile file = self.file;
  file.take_data(posterior);
  return unlocked([&] { return collect_report(std::move(file), posterior, request, notes); });
}

// each fit, under the name it has on the page
std::vector<Report> all_collected(const py::object& fit, const ReportRequest& request, std::vector<std::string>& notes) {
  std::vector<Report> reports;
  if (const py::object named = as_dict(fit); py::isinstance<py::dict>(named)) {
    for (const auto& [name, one] : py::reinterpret_borrow<py::dict>(named)) {
      reports.push_back(collected(py::reinterpret_borrow<py::object>(one), request, notes));
      reports.back().label = py::str(name);
    }
  } else if (py::isinstance<py::list>(fit) || py::isinstance<py::tuple>(fit)) {
    for (const py::handle one : fit) reports.push_back(collected(py::reinterpret_borrow<py::object>(one), request, notes));
  } else {
    reports.push_back(collected(fit, request, notes));
  }
  if (reports.empty()) throw InputError("report: there is no fit");
  return reports;
}

std::string report(const py::object& fit, const py::object& path, const py::object& data, const py::object& system,
                   const py::object& truth, const py::object& columns) {
  ReportRequest request;
  if (!data.is_none()) request.data = to_table(data, "data");
  request.system = model_argument(system);
  request.truth = model_argument(truth);
  request.columns = columns_argument(columns);
  std::vector<std::string> notes;
  const std::vector<Report> found = all_collected(fit, request, notes);
  tell(notes);
  std::string page = report_page(found, [](const std::string& message) { return with_keywords(message); });
  if (!path.is_none()) write_file(path_argument(path), page);
  return page;
}

std::string plot_fit(const py::object& fit, const py::object& path, const py::kwargs& keywords) {
  PlotRequest request;
  read_keywords("plot", keywords, options(request), {"fit", "path"});
  if (!path.is_none()) require_name_of_svg(path_argument(path));
  const auto picture = [&request](const Posterior& posterior, const Model& model) {
    return unlocked([&] { return plot(learned_curve(posterior, request), model); });
  };
  std::string svg;
  if (py::isinstance<PyPosterior>(fit)) {
    const auto& self = fit.cast<const PyPosterior&>();
    const Posterior posterior = self.posterior;
    svg = picture(posterior, self.file.model);
  } else {
    const FitFile file = unlocked([from = file_of(fit)] { return FitFile::read(from); });
    svg = picture(unlocked([&] { return file.posterior(); }), file.model);
  }
  if (!path.is_none()) write_file(path_argument(path), svg);
  return svg;
}

// ---------------------------------------------------------------- what matplotlib draws (gp2/_plots.py)

py::dict curve_of(const PyPosterior& self, const py::kwargs& keywords) {
  using namespace py::literals;
  PlotRequest request;
  read_keywords("plot_learned", keywords, options(request), {"what", "ax"});
  const Posterior posterior = self.posterior;
  const LearnedCurve curve = unlocked([&] { return learned_curve(posterior, request); });
  const LearnedForce& force = curve.force;
  const std::string& name = force.names[static_cast<std::size_t>(curve.row)];
  return py::dict("latent"_a = force.latent, "along"_a = self.file.model.labelled(force.along),
                  "name"_a = self.file.model.labelled(name.substr(0, name.find('@'))), "at"_a = to_vector(force.at),
                  "mean"_a = to_vector(force.mean.row(curve.row)), "std"_a = to_vector(force.stddev.row(curve.row)),
                  "data"_a = to_vector(force.data));
}

py::dict compared(const PyPosterior& self, const py::object& data, const PySystem* system, const py::object& columns) {
  using namespace py::literals;
  ReportRequest request;
  request.data = to_table(data, "data");
  request.system = model_of(system);
  request.columns = columns_argument(columns);
  const PyPosterior held = self;
  std::vector<std::string> notes;
  ReportData found;
  Eigen::VectorXd levels = Eigen::VectorXd::LinSpaced(100, 0, 0.99);
  Eigen::MatrixXd shares;
  {
    const py::gil_scoped_release release;
    found = compare(held.file, held.posterior, request, notes);
    shares = coverage(found, levels);
  }
  tell(notes);
  const auto of_outputs = [&](const Eigen::MatrixXd& all) {
    Eigen::MatrixXd rows(std::ssize(found.rows), all.cols());
    for (std::size_t k = 0; k < found.rows.size(); ++k) rows.row(static_cast<Eigen::Index>(k)) = all.row(found.rows[k]);
    return to_rows(std::move(rows));
  };
  return py::dict("outputs"_a = found.outputs, "measured"_a = to_rows(found.measured), "mean"_a = of_outputs(found.predicted),
                  "std"_a = of_outputs(found.stddev), "noise"_a = to_rows(found.noise_stddev),
                  "levels"_a = to_vector(std::move(levels)), "coverage"_a = to_vector(shares.col(shares.cols() - 1)));
}

}  // namespace

void add_report(py::module_& module) {
  using namespace py::literals;
  module.def("report", &report, "fit"_a, "path"_a = py::none(), py::kw_only(), "data"_a = py::none(), "system"_a = py::none(),
             "truth"_a = py::none(), "columns"_a = py::none(),
             R"(The page of gp2 report as text, which is also written where a path is given: HTML that needs nothing else.

fit      a Posterior, or the path of a FIT.json; a list of them, or a dict by names, stands side by side on the page
path     of the page
data     a table with states and accelerations that the fit has not seen: a test
system   another system with the same coordinates, inputs and latents, which data and truth are of
truth    a system whose [truth] is the true acceleration, shown beside the prediction
columns  columns of data by other names: {"q1": "theta"}

Raises InputError for data and models that do not fit the fit.)");
  module.def("_learned_curve", &curve_of, "posterior"_a);
  module.def("_compared", &compared, "posterior"_a, "data"_a, "system"_a, "columns"_a);

  PlotRequest request;
  py::options own_signature;
  own_signature.disable_function_signatures();
  module.def("plot", &plot_fit, "fit"_a, "path"_a = py::none(),
             (signature("plot", "fit: Posterior | str | os.PathLike, path: str | os.PathLike | None = None, *,", options(request),
                        "", "str") +
              R"(
The picture of gp2 plot as text, which is also written where a path is given: one learned force with its 95 % band, as SVG.

)" + documentation(options(request)) +
              R"(
Posterior.plot_learned draws the same by matplotlib.)")
                 .c_str());
}

}  // namespace gp2::python
