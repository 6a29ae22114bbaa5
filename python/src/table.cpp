#include <cmath>
#include <filesystem>
#include <new>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <pybind11/stl.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "gp2/base/file.hpp"
#include "gp2/error.hpp"

namespace gp2::python {

namespace {

bool is_missing(const py::handle& cell) {
  if (cell.is_none() || std::string(py::str(py::type::handle_of(cell).attr("__name__"))) == "NAType") return true;  // pandas.NA
  // NaN of any type, also pandas.NaT, differs from itself
  const auto other = py::reinterpret_steal<py::object>(PyObject_RichCompare(cell.ptr(), cell.ptr(), Py_NE));
  const int differs = other ? PyObject_IsTrue(other.ptr()) : -1;
  if (differs < 0) PyErr_Clear();
  return differs == 1;
}

// a column of a table; NaN stands for an empty cell, as pandas reads one
CsvTable::Column to_column(std::string name, const py::object& values, const std::string& what) {
  py::array array = py::array::ensure(without_mask(values));
  // a field of a struct of MATLAB's is an array within one of a single object
  if (array && array.size() == 1 && array.dtype().kind() == 'O') {
    if (const py::object inside = array.attr("item")(); py::isinstance<py::array>(inside)) array = inside;
  }
  if (array && array.ndim() == 2 && (array.shape(0) == 1 || array.shape(1) == 1)) array = array.attr("ravel")();  // of MATLAB
  if (!array || array.ndim() != 1) {
    PyErr_Clear();
    throw InputError(fmt::format("{}: expected one-dimensional", what));
  }
  CsvTable::Column column{std::move(name), {}};
  const char kind = array.dtype().kind();
  if (kind == 'f' || kind == 'i' || kind == 'u' || kind == 'b') {
    const auto numbers = py::array_t<double, py::array::c_style | py::array::forcecast>::ensure(array);
    if (!numbers) throw std::bad_alloc();
    column.numbers.assign(numbers.data(), numbers.data() + numbers.size());
  } else {  // text, or what must not be read
    for (const py::handle cell : array) column.cells.push_back(is_missing(cell) ? "" : std::string(py::str(cell)));
  }
  return column;
}

CsvTable read_table(const py::object& path, CsvTable::Keep keep) {
  const std::filesystem::path from = path_argument(path);
  return unlocked([&] { return CsvTable::read(from, keep); });
}

bool is_path(const py::object& given) { return py::isinstance<py::str>(given) || py::hasattr(given, "__fspath__"); }

// of its own name, or of another one that is given
CsvTable make_table(const py::object& columns, const std::optional<std::string>& name) {
  if (name && is_path(columns)) return CsvTable::parse(read_file(path_argument(columns)), *name);
  CsvTable table = to_table(columns, name.value_or("data"), CsvTable::Keep::text);
  return !name || *name == table.name() ? table : table.renamed(*name);
}

py::array column_of(const CsvTable& table, const std::string& name) {
  const int column = table.find(name);
  if (column < 0) {
    throw py::key_error(fmt::format("{} has no column '{}'; it has: {}", table.name(), name, fmt::join(table.header(), ", ")));
  }
  if (table.is_text(column)) {
    py::list cells;
    for (int i = 0; i < table.n_rows(); ++i) cells.append(table.cell(i, column));
    return read_only(py::module_::import("numpy").attr("array")(cells));
  }
  Eigen::VectorXd values(table.n_rows());
  for (int i = 0; i < table.n_rows(); ++i) values[i] = table.number_or_empty(i, column);
  return read_only(to_vector(std::move(values)));
}

}  // namespace

std::string path_argument(const py::object& path, const std::string& name, const char* expected) {
  if (!is_path(path) && !py::isinstance<py::bytes>(path)) {
    throw py::type_error(fmt::format("{}: expected {}, got {}", name, expected, std::string(py::repr(path))));
  }
  return py::bytes(py::module_::import("os").attr("fsencode")(path));
}

CsvTable to_table(const py::object& data, const std::string& what, CsvTable::Keep keep) {
  if (py::isinstance<CsvTable>(data)) return data.cast<CsvTable>();
  if (is_path(data)) return read_table(data, keep);
  const std::optional<py::list> names = column_names(data);
  if (!names) {
    throw py::type_error(
        fmt::format("{}: expected a gp2.Table, the path of a CSV file, a frame of pandas or polars, a structured array, or a "
                    "mapping of column names to arrays; got {}",
                    what, std::string(py::str(py::type::of(data)))));
  }
  require_names(*names, what);
  std::vector<CsvTable::Column> columns;
  for (const py::handle key : *names) {
    std::string name = py::str(key);
    // what scipy.io.loadmat says of the file itself
    if (name.starts_with("__") && name.ends_with("__")) continue;
    const std::string column = fmt::format("{}['{}']", what, name);
    columns.push_back(to_column(std::move(name), data[key], column));
  }
  return CsvTable::from_columns(what, std::move(columns));
}

void add_table(py::module_& module) {
  py::class_<CsvTable>(module, "Table", "Columns by name, as read from a CSV file. A mapping of names to arrays (n,).")
      .def(py::init(&make_table), py::arg("columns"), py::arg("name") = py::none(),
           "From a frame of pandas or polars, a structured array, a mapping of column names to arrays of one length, say of\n"
           "scipy.io.loadmat, or the path of a CSV file. All numbers become doubles: of whole numbers above 2^53 the last digits "
           "are\n"
           "rounded, as in a file. name: default: that of a file or Table, else 'data'.")
      .def_property_readonly("name", &CsvTable::name, "Stands for the table in messages.")
      .def_property_readonly("columns", &CsvTable::header, "Names of the columns, in their order.")
      .def("keys", &CsvTable::header, "Names of the columns, in their order.")
      .def("__len__", &CsvTable::n_rows, "Number of rows.")
      .def(
          "__iter__", [](const CsvTable& table) { return py::iter(py::cast(table.header())); }, "Names of the columns.")
      .def("__contains__",
           [](const CsvTable& table, const py::object& name) {
             return py::isinstance<py::str>(name) && table.find(name.cast<std::string>()) >= 0;
           })
      .def("__getitem__", &column_of, py::arg("name"),
           "A column (n,), NaN where the cell is empty; of strings where no cell is a number. It is a copy, not to be written "
           "to.\n\n"
           "Raises KeyError when there is none, InputError when some cells are numbers and one is not.")
      // names and cells of a file need not be UTF-8
      .def(py::pickle(
          [](const CsvTable& table) {
            return py::make_tuple(py::bytes(table.name()), py::bytes(table.text()), table.has_lines());
          },
          [](const py::tuple& state) {
            CsvTable table = CsvTable::parse(std::string(state[1].cast<py::bytes>()), std::string(state[0].cast<py::bytes>()));
            const bool has_lines = state.size() < 3 || state[2].cast<bool>();
            return has_lines ? table : table.without_lines();
          }))
      .def("__repr__", [](const CsvTable& table) {
        return fmt::format("<gp2.Table '{}': {} rows of {}>", table.name(), table.n_rows(), fmt::join(table.header(), ", "));
      });
  module.def(
      "read_csv", [](const py::object& path) { return read_table(path, CsvTable::Keep::text); }, py::arg("path"),
      "Read a CSV file with one header line.\n\nRaises InputError naming file and line: unreadable or empty file, ragged row,\n"
      "repeated or empty column name. Cells are looked at when they are used.");
}

}  // namespace gp2::python
