#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/simulation/generate.hpp"

namespace gp2 GP2_API {

struct GenerateRequest {
  std::optional<int> n;             // rows, drawn at random
  std::map<std::string, int> grid;  // instead: the number of points of every range in [sampling]
  std::uint64_t seed = 1;
  std::optional<double> noise_stddev;  // of every ddq; not given: the model's [noise]
};
std::vector<Option> options(GenerateRequest& request);

/// States drawn from a model's [sampling], and measured.
/// @throws InputError when the noise is not known or negative, n is not positive; as generate().
GeneratedData generate(const Model& model, const GenerateRequest& request);

}  // namespace gp2
