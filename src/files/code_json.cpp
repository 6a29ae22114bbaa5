#include "files/fit_json.hpp"

namespace gp2::fit_json {

using Eigen::Index;
using Eigen::MatrixXd;

namespace {

std::vector<PriorPart> parts_at_first(const PriorAt& at, const Observations& group) {
  constexpr Index most_states = 3;
  return parts_at(at, group.states().leftCols(std::min(most_states, group.states().cols())));
}

}  // namespace

Json code_json(const PriorAt& at, const Observations& group) {
  Json json = Json::array();
  for (const PriorPart& part : parts_at_first(at, group)) {
    json.push_back({{"what", part.what}, {"values", columns_json(part.values)}});
  }
  return json;
}

void require_code(const ParsedJson& json, const PriorAt& at, const Observations& group) {
  // code that ran on another machine rounds otherwise, also where a number is 0 but for rounding
  constexpr double of_part = 1e-5, of_all = 1e-8;
  const std::vector<PriorPart> parts = parts_at_first(at, group);
  double largest = 0;
  for (const PriorPart& part : parts) largest = std::max(largest, part.values.lpNorm<Eigen::Infinity>());
  for (std::size_t p = 0; p < parts.size(); ++p) {
    const auto& [what, values] = parts[p];
    if (p >= array(json).size() || json[p].at("what") != what)
      throw InputError(fmt::format("the code given is not that of this fit, which has not {}", what));
    const auto column = [](const ParsedJson& numbers) { return vector_from(numbers, number_or_missing); };
    const double tolerance = of_part * values.lpNorm<Eigen::Infinity>() + of_all * largest;
    for (Index i = 0; i < values.cols(); ++i) {
      const Eigen::VectorXd fitted = column(array(json[p].at("values")).at(static_cast<std::size_t>(i)));
      for (Index k = 0; k < values.rows(); ++k) {
        const double is = values(k, i), was = k < fitted.size() ? fitted[k] : std::nan("");
        if (std::abs(is - was) <= tolerance || (std::isnan(is) && std::isnan(was))) continue;
        throw InputError(fmt::format(
            "the code given is not that of this fit: at state {} of its data an entry of {} is {:.9g}, where the fit had {:.9g}",
            i + 1, what, is, was));
      }
    }
  }
}

}  // namespace gp2::fit_json
