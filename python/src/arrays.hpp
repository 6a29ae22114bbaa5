#pragma once

#include <optional>
#include <string>
#include <vector>

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <Eigen/Core>

#include "gp2/system.hpp"

namespace gp2::python {

namespace py = pybind11;

/// Numbers as the library takes them: column i is row i of a NumPy array (n, d). C-contiguous doubles are looked at in place, all
/// else that holds real numbers is converted. The columns of a table are found by their names; one that it lacks is NaN.
class Rows {
 public:
  /// @param what  stands for the argument in messages
  /// @throws py::type_error when the array does not hold real numbers; InputError when it is not (n, names.size()), or when a table
  ///   has a column of another name, one twice, or one whose name is no text.
  Rows(const py::object& array, const std::vector<std::string>& names, const std::string& what);

  [[nodiscard]] Eigen::Map<const Eigen::MatrixXd> matrix() const;  // (d × n)

 private:
  py::array_t<double, py::array::c_style> array_;
};

/// A masked array as one that is NaN where it is masked, or an empty text where it does not hold real numbers; all else as it is.
py::object without_mask(const py::object& array);

/// A mapping of any type, a pandas Series too, as a dict; all else as it is.
py::object as_dict(const py::object& given);

/// A vector of `size` numbers. @throws as Rows.
py::array_t<double, py::array::c_style> vector_argument(const py::object& array, Eigen::Index size, const std::string& what);

/// A vector of one number for each name; those of a mapping or a pandas Series are found by their names, as columns by Rows.
/// @throws as Rows.
py::array_t<double, py::array::c_style> vector_argument(const py::object& array, const std::vector<std::string>& names,
                                                        const std::string& what);

/// The same of any size.
py::array_t<double, py::array::c_style> vector_argument(const py::object& array, const std::string& what);

/// The names of the columns of a mapping, a frame, a table of Arrow or a structured array, keys as they are; nothing of what is no table, or has only
/// whole numbers for names.
std::optional<py::list> column_names(const py::object& data);

/// @throws InputError for a name that is no text, or that stands twice.
void require_names(const py::list& names, const std::string& what);

/// Whether an argument is an array rather than a table: a list or tuple, or what has a shape, but no named columns.
bool is_array(const py::object& data);

/// (n, d) from a matrix (d × n), whose memory it takes over.
py::array to_rows(Eigen::MatrixXd columns);
/// (n, r, c) from a matrix of n columns, each a column-major matrix (r × c).
py::array to_matrices(const Eigen::MatrixXd& blocks, Eigen::Index rows, Eigen::Index columns);
py::array to_vector(Eigen::VectorXd values);

/// The array, not to be written to. For copies of what an object holds: what is written to a copy would be lost.
py::array read_only(py::array array);

}  // namespace gp2::python
