#pragma once

#include <algorithm>
#include <array>
#include <filesystem>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <fmt/format.h>
#include <Eigen/Core>
#include <nlohmann/json.hpp>

#include "base/number_range.hpp"
#include "gp2/error.hpp"

// Numbers, choices and matrices in JSON. What reads them says by an InputError what stands where something else must.
namespace gp2::fit_json {

using Json = nlohmann::ordered_json;  // written: keys in the order that a person reads. NaN and ∞ become null
using ParsedJson = nlohmann::json;    // read: keys are found in no time, however many a file claims

// a choice and its name in the file
template <class Choice>
using Named = std::pair<Choice, const char*>;

template <class Choice, std::size_t n>
const char* name_of(const std::array<Named<Choice>, n>& choices, Choice choice) {
  return std::find_if(choices.begin(), choices.end(), [&](const auto& known) { return known.first == choice; })->second;
}

template <class Choice, std::size_t n>
Choice choice_from(const ParsedJson& json, const std::array<Named<Choice>, n>& choices, const char* what) {
  const auto name = json.get<std::string>();
  const auto known = std::find_if(choices.begin(), choices.end(), [&](const auto& other) { return name == other.second; });
  if (known == choices.end()) throw InputError(fmt::format("'{}' is no {}", name, what));
  return known->first;
}

/// @param path  stands for the file in messages
ParsedJson parse_json(std::string_view text, const std::filesystem::path& path);

// Over the compact text with sorted keys, in which only what is meant counts.
std::string checksum_of(const ParsedJson& json);

// a value to show in a message
std::string shown(const ParsedJson& json);

// a whole number, where Json itself would round or wrap
int integer(const ParsedJson& json);
double number(const ParsedJson& json);
// null: NaN
double number_or_missing(const ParsedJson& json);
// null: a restart without a finite start has the objective ∞
double number_or_infinity(const ParsedJson& json);
using ReadNumber = double (*)(const ParsedJson&);

// an array, where a loop would also take other values
const ParsedJson& array(const ParsedJson& json);

Json vector_json(const Eigen::VectorXd& values);
Eigen::VectorXd vector_from(const ParsedJson& json, ReadNumber entry = number);

// one array per column
Json columns_json(const Eigen::MatrixXd& matrix);
/// @param column  reads one, of n entries
template <class Column>
Eigen::MatrixXd columns_from(const ParsedJson& json, std::size_t n, const Column& column) {
  Eigen::MatrixXd out(static_cast<Eigen::Index>(n), static_cast<Eigen::Index>(array(json).size()));
  for (Eigen::Index k = 0; k < out.cols(); ++k) out.col(k) = column(json[static_cast<std::size_t>(k)]);
  return out;
}

// one named array per row
Json rows_json(const Eigen::MatrixXd& matrix, const std::vector<std::string>& names);
/// @param n  columns expected
Eigen::MatrixXd rows_from(const ParsedJson& json, const std::vector<std::string>& names, const std::vector<bool>& needed,
                          Eigen::Index n, ReadNumber entry = number);

// Doubles to the bit, sixteen hexadecimal digits each: matrices are read in no time.
std::string bits_of(const Eigen::Ref<const Eigen::VectorXd>& values);
/// @param n  numbers expected
Eigen::VectorXd bits_from(const ParsedJson& json, Eigen::Index n);
// of a lower triangle, column by column
std::string triangle_bits(const Eigen::MatrixXd& L);
Eigen::MatrixXd triangle_from(const ParsedJson& json, Eigen::Index n);

}  // namespace gp2::fit_json
