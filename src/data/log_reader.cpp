#include "gp2/data/log_reader.hpp"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/not_a_number.hpp"
#include "base/number_range.hpp"
#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;

namespace {

// "1" of "q1" for prefix "q"; empty when the name is not prefix + digits
std::string number_after(const std::string& prefix, const std::string& name) {
  if (!name.starts_with(prefix) || name.size() == prefix.size()) return "";
  const std::string rest = name.substr(prefix.size());
  return rest.find_first_not_of("0123456789") == std::string::npos ? rest : "";
}

// The numbers of a column, each as `number` reads its cell.
Eigen::RowVectorXd numbers_of(const CsvTable& table, int column, double (CsvTable::*number)(int, int) const) {
  Eigen::RowVectorXd values(table.n_rows());
  for (int row = 0; row < table.n_rows(); ++row) {
    values[row] = (table.*number)(row, column);
    if (!(std::abs(values[row]) > largest_number)) continue;
    throw InputError(fmt::format("{}: {:.3g} is too large: at most {:.0e} can be computed with", table.place(row, column),
                                 values[row], largest_number));
  }
  return values;
}

void require_a_number(const Eigen::RowVectorXd& values, const CsvTable& table, int column, const char* mend) {
  if (!values.array().isNaN().all()) return;
  throw InputError(fmt::format("{}: column '{}': every cell is empty, so nothing is measured there; {}", table.name(),
                               table.header()[static_cast<std::size_t>(column)], mend));
}

}  // namespace

LogReader::LogReader(const CsvTable& table, const System& system, const std::map<std::string, std::string>& columns)
    : table_(table), system_(system), given_(columns), columns_(columns) {
  std::vector<std::string> own_names = system.state_names();
  for (const Coordinate& coordinate : system.coordinates()) own_names.push_back(coordinate.acceleration());

  for (const Coordinate& coordinate : system.coordinates()) {
    // a renamed coordinate brings its derivatives along
    if (const auto renamed = columns.find(coordinate.name); renamed != columns.end()) {
      columns_.emplace(coordinate.velocity(), "d" + renamed->second);
      columns_.emplace(coordinate.acceleration(), "dd" + renamed->second);
      aliases_[coordinate.velocity()] = {renamed->second + "_dot"};
      aliases_[coordinate.acceleration()] = {renamed->second + "_ddot"};
    }
    const std::string number = number_after("q", coordinate.name);
    if (!number.empty()) {
      for (const char* velocity : {"qd", "v", "qvel"}) aliases_[coordinate.velocity()].push_back(velocity + number);
      for (const char* acceleration : {"qdd", "a", "qacc"}) aliases_[coordinate.acceleration()].push_back(acceleration + number);
    }
    aliases_[coordinate.velocity()].push_back(coordinate.name + "_dot");
    aliases_[coordinate.acceleration()].push_back(coordinate.name + "_ddot");
  }
  for (const std::string& input : system.inputs()) {
    const std::string number = number_after("u", input);
    if (!number.empty()) aliases_[input] = {"tau" + number};
    if (input == "u") aliases_[input] = {"tau"};
  }
  aliases_["t"] = {"time", "timestamp", "__time"};
  // in a model with a coordinate v1, the column v1 is that coordinate, not the velocity of q1
  for (auto& [name, aliases] : aliases_) {
    std::erase_if(aliases, [&](const std::string& alias) {
      return std::find(own_names.begin(), own_names.end(), alias) != own_names.end();
    });
  }
}

int LogReader::find(const std::string& name) const {
  if (const auto renamed = columns_.find(name); renamed != columns_.end()) {
    if (const int column = table_.find(renamed->second); column >= 0) return column;
  }
  if (const int column = table_.find(name); column >= 0) return column;
  if (const auto aliases = aliases_.find(name); aliases != aliases_.end()) {
    for (const std::string& alias : aliases->second) {
      if (const int column = table_.find(alias); column >= 0) return column;
    }
  }
  return -1;
}

// What to do first about a missing column. Where a log has no rate of its kind at all, none has another name: they are to be computed.
const char* LogReader::mend_for_missing(const std::string& name) const {
  const auto lacks_all = [&](const auto& name_of) {
    bool is_of_kind = false, has_one = false;
    for (const Coordinate& coordinate : system_.coordinates()) {
      const std::string rate = name_of(coordinate);
      is_of_kind = is_of_kind || rate == name;
      has_one = has_one || has(rate);
    }
    return is_of_kind && !has_one;
  };
  if (lacks_all([](const Coordinate& one) { return one.acceleration(); }))
    return "It has no accelerations: gp2 derive computes them from positions over time, as a fit of a raw log does; or";
  // a raw log may lack coordinates that the constraints decide
  const std::vector<Coordinate>& coordinates = system_.coordinates();
  const bool is_raw = std::ranges::count(coordinates, name, &Coordinate::name) > 0 &&
                      std::ranges::any_of(coordinates, [&](const Coordinate& one) { return has(one.name); }) &&
                      std::ranges::none_of(coordinates, [&](const Coordinate& one) { return has(one.velocity()); });
  if (is_raw || lacks_all([](const Coordinate& one) { return one.velocity(); }))
    return "It has no velocities: gp2 derive computes them from positions over time, as a fit of a raw log does; or";
  return "Rename it, or";
}

int LogReader::require(const std::string& name) {
  const int column = find(name);
  if (column < 0) {
    std::vector<std::string> tried = {name};
    if (const auto renamed = columns_.find(name); renamed != columns_.end()) tried.insert(tried.begin(), renamed->second);
    if (const auto aliases = aliases_.find(name); aliases != aliases_.end()) {
      tried.insert(tried.end(), aliases->second.begin(), aliases->second.end());
    }
    throw InputError(fmt::format("{}: missing column '{}' (looked for {}); the file has: {}. {} give `map=LOGNAME={}`",
                                 table_.name(), name, fmt::join(tried, ", "), fmt::join(table_.header(), ", "),
                                 mend_for_missing(name), name));
  }
  const std::string& found = table_.header()[static_cast<std::size_t>(column)];
  const auto [used, is_new] = used_.emplace(column, name);
  if (!is_new && used->second != name) {
    throw InputError(fmt::format("{}: column '{}' is read as {} and as {}; each needs a column of its own (`map=LOGNAME={}`)",
                                 table_.name(), found, used->second, name, name));
  }
  return column;
}

MatrixXd LogReader::states(const std::vector<bool>& reads) { return read_states(reads, &CsvTable::number); }

MatrixXd LogReader::states_with_gaps(const std::vector<bool>& reads) { return read_states(reads, &CsvTable::number_or_nan); }

MatrixXd LogReader::read_states(const std::vector<bool>& reads, Number number) {
  const std::vector<std::string> names = system_.state_names();
  MatrixXd states = MatrixXd::Constant(static_cast<Index>(names.size()), table_.n_rows(), not_a_number);
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (!reads[k]) continue;
    states.row(static_cast<Index>(k)) = numbers_of(table_, require(names[k]), number);
  }
  return states;
}

MatrixXd LogReader::values(const std::vector<std::string>& names) {
  MatrixXd values(static_cast<Index>(names.size()), table_.n_rows());
  for (std::size_t k = 0; k < names.size(); ++k) {
    values.row(static_cast<Index>(k)) = numbers_of(table_, require(names[k]), &CsvTable::number);
  }
  return values;
}

MatrixXd LogReader::measurements(const std::vector<std::string>& names) {
  MatrixXd values(static_cast<Index>(names.size()), table_.n_rows());
  for (std::size_t k = 0; k < names.size(); ++k) {
    const int column = require(names[k]);
    const auto row_of_values = static_cast<Index>(k);
    values.row(row_of_values) = numbers_of(table_, column, &CsvTable::number_or_empty);
    require_a_number(values.row(row_of_values), table_, column,
                     "choose others with `observe` of a fit, `outputs` of an evaluation");
  }
  return values;
}

bool LogReader::measures(const std::string& name) const {
  const int column = find(name);
  return column >= 0 && !table_.is_empty(column);
}

std::string LogReader::stddev_column(const std::string& name) const {
  const int column = find(name);
  if (column < 0) return "";
  for (const std::string& candidate : {table_.header()[static_cast<std::size_t>(column)] + "_std", name + "_std"}) {
    if (table_.find(candidate) >= 0) return candidate;
  }
  return "";
}

MatrixXd LogReader::stddevs(const std::vector<std::string>& names) {
  MatrixXd stddevs(static_cast<Index>(names.size()), table_.n_rows());
  for (std::size_t k = 0; k < names.size(); ++k) {
    const int column = table_.find(stddev_column(names[k]));
    used_.emplace(column, names[k] + "_std");
    stddevs.row(static_cast<Index>(k)) = numbers_of(table_, column, &CsvTable::number_or_empty);
    for (int row = 0; row < table_.n_rows(); ++row) {
      const double stddev = stddevs(static_cast<Index>(k), row);
      if (stddev <= 0) {
        throw InputError(
            fmt::format("{}: the standard deviation of {} must be positive, got {}; leave the cell empty where nothing is "
                        "measured",
                        table_.place(row, column), names[k], stddev));
      }
    }
    require_a_number(stddevs.row(static_cast<Index>(k)), table_, column, "leave the column out");
  }
  return stddevs;
}

int LogReader::episode_column() {
  const int column = table_.find("episode");
  if (column >= 0) used_.emplace(column, "episode");
  return column;
}

std::vector<std::string> LogReader::notes() const {
  const bool has_given = std::ranges::any_of(given_, [&](const auto& one) { return table_.find(one.second) >= 0; });
  std::vector<std::string> notes;
  for (const auto& [column, name] : used_) {
    const std::string& found = table_.header()[static_cast<std::size_t>(column)];
    const auto given = given_.find(name);
    // a table with none of the given names may be one of gp2's own
    if (has_given && given != given_.end() && given->second != found) {
      notes.push_back(fmt::format("warning: {}: no column '{}', which is to be {}: column '{}' is read instead", table_.name(),
                                  given->second, name, found));
    } else if (found != name && !name.ends_with("_std")) {
      notes.push_back(fmt::format("column '{}' taken as {}", found, name));
    }
  }
  return notes;
}

std::vector<std::string> LogReader::unused_columns() const {
  std::vector<std::string> unused;
  for (int column = 0; column < table_.n_columns(); ++column) {
    if (!used_.contains(column)) unused.push_back(table_.header()[static_cast<std::size_t>(column)]);
  }
  return unused;
}

}  // namespace gp2
