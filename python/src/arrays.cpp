#include "arrays.hpp"

#include <algorithm>
#include <limits>
#include <memory>
#include <new>
#include <set>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "bindings.hpp"
#include "gp2/error.hpp"

namespace gp2::python {

namespace {

using DoubleArray = py::array_t<double, py::array::c_style>;
// an array over the bytes of a file may begin anywhere
constexpr int readable_in_place = int{py::array::c_style} | int{py::detail::npy_api::NPY_ARRAY_ALIGNED_};

std::string shape_text(const py::array& array) {
  std::vector<py::ssize_t> shape(array.shape(), array.shape() + array.ndim());
  return fmt::format("({}{})", fmt::join(shape, ", "), shape.size() == 1 ? "," : "");
}

// itself where it holds C-contiguous doubles at addresses of doubles
DoubleArray doubles(const py::object& object, const std::string& what) {
  const py::array array = py::array::ensure(without_mask(object));
  if (!array) {
    PyErr_Clear();
    throw py::type_error(fmt::format("{}: expected an array of numbers, got {}", what, std::string(py::str(object.get_type()))));
  }
  const char kind = array.dtype().kind();
  if (kind != 'f' && kind != 'i' && kind != 'u') {
    throw py::type_error(
        fmt::format("{}: expected an array of real numbers, got one of dtype {}", what, std::string(py::str(array.dtype()))));
  }
  DoubleArray values = py::array_t<double, readable_in_place | py::array::forcecast>::ensure(array);
  if (!values) throw std::bad_alloc();
  return values;
}

// an array that owns `values`
template <typename Values>
py::array own(Values values, const std::vector<py::ssize_t>& shape) {
  auto* kept = new Values(std::move(values));
  const py::capsule owner(kept, [](void* memory) { delete static_cast<Values*>(memory); });
  return py::array_t<double>(shape, kept->data(), owner);
}

constexpr double not_a_number = std::numeric_limits<double>::quiet_NaN();

void require_known(const std::string& name, const std::vector<std::string>& names, const std::string& what) {
  if (std::ranges::count(names, name) > 0) return;
  throw InputError(fmt::format("{}: unknown column '{}'; there may be: {}", what, name, fmt::join(names, ", ")));
}

// An array as it is; of a table its columns in the order of `names`.
py::object in_order(const py::object& data, const std::vector<std::string>& names, const std::string& what) {
  if (!column_names(data)) return data;
  const CsvTable table = to_table(data, what);
  for (const std::string& name : table.header()) require_known(name, names, what);
  Eigen::MatrixXd values = Eigen::MatrixXd::Constant(std::ssize(names), table.n_rows(), not_a_number);
  for (std::size_t k = 0; k < names.size(); ++k) {
    const int column = table.find(names[k]);
    for (int i = 0; column >= 0 && i < table.n_rows(); ++i) {
      values(static_cast<Eigen::Index>(k), i) = table.number_or_empty(i, column);
    }
  }
  return to_rows(std::move(values));
}

}  // namespace

py::object without_mask(const py::object& array) {
  if (!py::hasattr(array, "mask") || !py::hasattr(array, "filled") || !py::hasattr(array, "dtype")) return array;
  const auto kind = array.attr("dtype").attr("kind").cast<std::string>();
  const bool is_real = kind == "f" || kind == "i" || kind == "u";
  return is_real ? array.attr("astype")("float64").attr("filled")(not_a_number)
                 : array.attr("astype")("object").attr("filled")("");
}

py::object as_dict(const py::object& given) { return py::hasattr(given, "keys") ? py::object(py::dict(given)) : given; }

Rows::Rows(const py::object& array, const std::vector<std::string>& names, const std::string& what)
    : array_(doubles(in_order(array, names, what), what)) {
  const auto d = static_cast<py::ssize_t>(names.size());
  if (array_.ndim() != 2 || array_.shape(1) != d) {
    const bool one = array_.ndim() == 1 && array_.shape(0) == d;
    throw InputError(fmt::format("{}: expected shape (n, {}), columns {}; got {}{}", what, d, fmt::join(names, ", "),
                                 shape_text(array_), one ? "; of one row write array[None, :]" : ""));
  }
}

Eigen::Map<const Eigen::MatrixXd> Rows::matrix() const { return {array_.data(), array_.shape(1), array_.shape(0)}; }

py::array_t<double, py::array::c_style> vector_argument(const py::object& array, Eigen::Index size, const std::string& what) {
  DoubleArray values = doubles(array, what);
  if (values.ndim() != 1 || values.shape(0) != size) {
    throw InputError(fmt::format("{}: expected shape ({},), got {}", what, size, shape_text(values)));
  }
  return values;
}

py::array_t<double, py::array::c_style> vector_argument(const py::object& array, const std::string& what) {
  DoubleArray values = doubles(array, what);
  if (values.ndim() != 1) throw InputError(fmt::format("{}: expected shape (n,), got {}", what, shape_text(values)));
  return values;
}

py::array_t<double, py::array::c_style> vector_argument(const py::object& array, const std::vector<std::string>& names,
                                                        const std::string& what) {
  const std::optional<py::list> given = column_names(array);
  if (!given) return vector_argument(array, std::ssize(names), what);
  require_names(*given, what);
  Eigen::VectorXd values = Eigen::VectorXd::Constant(std::ssize(names), not_a_number);
  for (const py::handle key : *given) {
    const std::string name = py::str(key);
    require_known(name, names, what);
    const py::object value = array[key];
    try {
      values[std::ranges::find(names, name) - names.begin()] = value.cast<double>();
    } catch (const py::cast_error&) {
      throw py::type_error(fmt::format("{}['{}']: expected a number, got {}", what, name, std::string(py::repr(value))));
    }
  }
  return to_vector(std::move(values));
}

bool is_array(const py::object& data) {
  if (py::isinstance<py::list>(data) || py::isinstance<py::tuple>(data)) return true;
  return py::hasattr(data, "shape") && !column_names(data);
}

std::optional<py::list> column_names(const py::object& data) {
  if (py::isinstance<py::array>(data)) {
    const py::object names = data.attr("dtype").attr("names");
    return names.is_none() ? std::nullopt : std::optional(py::list(names));
  }
  py::list names;
  if (py::hasattr(data, "keys")) {
    names = py::list(data.attr("keys")());
  } else if (py::hasattr(data, "column_names")) {  // of Arrow, whose `columns` are the values
    names = py::list(data.attr("column_names"));
  } else if (py::hasattr(data, "columns")) {
    names = py::list(data.attr("columns"));
  } else {
    return std::nullopt;
  }
  const bool are_numbers =
      std::all_of(names.begin(), names.end(), [](py::handle name) { return PyIndex_Check(name.ptr()) != 0; });
  return are_numbers && !names.empty() ? std::nullopt : std::optional(std::move(names));
}

void require_names(const py::list& names, const std::string& what) {
  std::set<std::string> seen;
  for (const py::handle one : names) {
    if (!py::isinstance<py::str>(one)) {
      throw InputError(fmt::format("{}: column names must be text, got {}", what, std::string(py::repr(one))));
    }
    const std::string name = py::str(one);
    if (!seen.insert(name).second) throw InputError(fmt::format("{}: the column '{}' stands twice", what, name));
  }
}

py::array to_rows(Eigen::MatrixXd columns) {
  const std::vector<py::ssize_t> shape = {columns.cols(), columns.rows()};
  return own(std::move(columns), shape);
}

py::array to_matrices(const Eigen::MatrixXd& blocks, Eigen::Index rows, Eigen::Index columns) {
  Eigen::MatrixXd row_major(blocks.rows(), blocks.cols());
  for (Eigen::Index i = 0; i < blocks.cols(); ++i) {
    row_major.col(i).reshaped(columns, rows) = blocks.col(i).reshaped(rows, columns).transpose();
  }
  const std::vector<py::ssize_t> shape = {blocks.cols(), rows, columns};
  return own(std::move(row_major), shape);
}

py::array to_vector(Eigen::VectorXd values) {
  const std::vector<py::ssize_t> shape = {values.size()};
  return own(std::move(values), shape);
}

py::array read_only(py::array array) {
  array.attr("flags").attr("writeable") = false;
  return array;
}

}  // namespace gp2::python
