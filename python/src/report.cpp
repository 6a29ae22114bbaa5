#include "gp2/report/report_page.hpp"

#include <filesystem>

#include "bindings.hpp"
#include "gp2/base/file.hpp"
#include "options.hpp"

namespace gp2::python {

namespace {

// a model as it stands in a file, or at hand
std::shared_ptr<const Model> model_argument(const py::object& system) {
  if (system.is_none()) return nullptr;
  if (py::isinstance<PySystem>(system)) return system.cast<const PySystem&>().model;
  return std::make_shared<const Model>(Model::read(path_argument(system)));
}

Report collected(const py::object& fit, const ReportRequest& request, std::vector<std::string>& notes) {
  if (!py::isinstance<PyPosterior>(fit)) {
    const std::filesystem::path path = path_argument(fit);
    const py::gil_scoped_release release;
    return collect_report(path, request, notes);
  }
  const auto& self = fit.cast<const PyPosterior&>();
  const Posterior posterior = self.posterior;
  FitFile file = self.file;
  file.take_data(posterior);
  const py::gil_scoped_release release;
  return collect_report(std::move(file), posterior, request, notes);
}

// each fit, under the name it has on the page
std::vector<Report> all_collected(const py::object& fit, const ReportRequest& request, std::vector<std::string>& notes) {
  std::vector<Report> reports;
  if (py::isinstance<py::dict>(fit)) {
    for (const auto& [name, one] : fit.cast<py::dict>()) {
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
}

}  // namespace gp2::python
