#include "files/json_values.hpp"

#include <bit>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <iterator>
#include <limits>

#include "base/checksum.hpp"
#include "base/not_a_number.hpp"

namespace gp2::fit_json {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

// What reads JSON goes down a level by calling itself: a file must not make it go down without end.
constexpr int max_depth = 64;

ParsedJson parse_json(std::string_view text, const std::filesystem::path& path) {
  const auto check_depth = [&](int depth, ParsedJson::parse_event_t, const ParsedJson&) {
    if (depth > max_depth) throw InputError(fmt::format("{}: nested deeper than {} levels", path.string(), max_depth));
    return true;
  };
  ParsedJson json = ParsedJson::parse(text, check_depth, false);
  const std::string ending = path.extension().string();
  if (json.is_discarded() && (ending == ".toml" || ending == ".csv")) {
    throw InputError(fmt::format("{}: not valid JSON but {}, by its name: a FIT.json is wanted here, which gp2 fit writes",
                                 path.string(), ending == ".csv" ? "a table" : "a model file"));
  }
  if (json.is_discarded()) {
    throw InputError(
        fmt::format("{}: not valid JSON: the file is cut short or damaged; write it again with gp2 fit", path.string()));
  }
  return json;
}

// It guards against damage and slips of the pen, not against intent, so no cryptographic digest, and no library for one, is needed:
// who means a change is told the checksum to write.
std::string checksum_of(const ParsedJson& json) {
  return checksum(json.dump(-1, ' ', false, ParsedJson::error_handler_t::replace));
}

std::string shown(const ParsedJson& json) { return json.is_structured() ? json.type_name() : json.dump(); }

int integer(const ParsedJson& json) {
  constexpr auto largest = std::numeric_limits<int>::max();
  if (!json.is_number_integer()) throw InputError(fmt::format("{} stands where a whole number must", shown(json)));
  if (std::abs(json.get<double>()) > largest) throw InputError(fmt::format("{} is too large", shown(json)));
  return json.get<int>();
}

double number(const ParsedJson& json) {
  if (!json.is_number()) throw InputError(fmt::format("{} stands where a number must", shown(json)));
  return json.get<double>();
}

double number_or_missing(const ParsedJson& json) { return json.is_null() ? not_a_number : number(json); }

double number_or_infinity(const ParsedJson& json) {
  return json.is_null() ? std::numeric_limits<double>::infinity() : number(json);
}

const ParsedJson& array(const ParsedJson& json) {
  if (!json.is_array()) throw InputError(fmt::format("{} stands where an array must", shown(json)));
  return json;
}

Json vector_json(const VectorXd& values) { return std::vector<double>(values.begin(), values.end()); }

VectorXd vector_from(const ParsedJson& json, ReadNumber entry) {
  VectorXd values(static_cast<Index>(array(json).size()));
  std::transform(json.begin(), json.end(), values.begin(), entry);
  return values;
}

Json columns_json(const MatrixXd& matrix) {
  Json json = Json::array();
  for (Index k = 0; k < matrix.cols(); ++k) json.push_back(vector_json(matrix.col(k)));
  return json;
}

Json rows_json(const MatrixXd& matrix, const std::vector<std::string>& names) {
  Json json = Json::object();
  for (Index k = 0; k < matrix.rows(); ++k) json[names[static_cast<std::size_t>(k)]] = vector_json(matrix.row(k));
  return json;
}

MatrixXd rows_from(const ParsedJson& json, const std::vector<std::string>& names, const std::vector<bool>& needed, Index n,
                   ReadNumber entry) {
  if (!json.is_object()) throw InputError("expected an object of named arrays");
  // sizes first: a damaged n must not ask for memory
  for (const auto& [name, values] : json.items()) {
    if (std::find(names.begin(), names.end(), name) == names.end())
      throw InputError(fmt::format("'{}' is not of this model", name));
    if (!values.is_array() || values.size() != static_cast<std::size_t>(n)) {
      throw InputError(fmt::format("'{}' has {} values, expected {}", name, values.size(), n));
    }
  }
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (needed[k] && !json.contains(names[k])) throw InputError(fmt::format("the values of '{}' are missing", names[k]));
  }
  MatrixXd matrix = MatrixXd::Constant(static_cast<Index>(names.size()), n, not_a_number);
  for (std::size_t k = 0; k < names.size(); ++k) {
    if (!json.contains(names[k])) continue;
    const Json& values = json.at(names[k]);
    std::transform(values.begin(), values.end(), matrix.row(static_cast<Index>(k)).begin(), entry);
    if (n == 0) continue;
    const double largest =
        matrix.row(static_cast<Index>(k)).array().isNaN().select(0, matrix.row(static_cast<Index>(k)).cwiseAbs()).maxCoeff();
    if (largest > largest_number) {
      throw InputError(fmt::format("'{}' holds a number of the size {:.3g}; at most {:.0e} can be computed with", names[k],
                                   largest, largest_number));
    }
  }
  return matrix;
}

std::string bits_of(const Eigen::Ref<const VectorXd>& values) {
  std::string text;
  text.reserve(16 * static_cast<std::size_t>(values.size()));
  for (const double value : values) fmt::format_to(std::back_inserter(text), "{:016x}", std::bit_cast<std::uint64_t>(value));
  return text;
}

VectorXd bits_from(const ParsedJson& json, Index n) {
  const auto& text = json.get_ref<const std::string&>();
  if (std::ssize(text) != 16 * n) throw InputError(fmt::format("{} hexadecimal digits, expected {}", text.size(), 16 * n));
  VectorXd values(n);
  for (Index k = 0; k < n; ++k) {
    const char* const first = text.data() + 16 * k;
    std::uint64_t bits = 0;
    const auto [end, error] = std::from_chars(first, first + 16, bits, 16);
    values[k] = std::bit_cast<double>(bits);
    if (end != first + 16 || error != std::errc() || !std::isfinite(values[k])) {
      throw InputError(
          fmt::format("'{}' is not a finite number in hexadecimal digits", text.substr(16 * static_cast<std::size_t>(k), 16)));
    }
  }
  return values;
}

std::string triangle_bits(const MatrixXd& L) {
  std::string text;
  for (Index k = 0; k < L.cols(); ++k) text += bits_of(L.col(k).tail(L.rows() - k));
  return text;
}

MatrixXd triangle_from(const ParsedJson& json, Index n) {
  const VectorXd values = bits_from(json, n * (n + 1) / 2);
  MatrixXd L = MatrixXd::Zero(n, n);
  for (Index k = 0, at = 0; k < n; at += n - k, ++k) L.col(k).tail(n - k) = values.segment(at, n - k);
  return L;
}

}  // namespace gp2::fit_json
