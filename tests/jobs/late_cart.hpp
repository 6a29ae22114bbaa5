#pragma once

#include <cstdint>
#include <string>

#include "gp2/data/csv.hpp"
#include "gp2/model.hpp"

namespace gp2::test {

/// A cart of 1.5 kg with friction that no model knows, driven by a force u.
/// @param input  as a model file has it: "\"u\"", "{ name = \"u\", delay = 0.02 }"
Model late_cart(const std::string& input, bool estimates_mass = false);

/// Its motion under a force of eight frequencies up to 4 Hz: t, x, dx, ddx with noise, and u as commanded.
CsvTable late_cart_log(double delay, double lag, double rate, double seconds, std::uint64_t seed, double noise_stddev = 0.05);

}  // namespace gp2::test
