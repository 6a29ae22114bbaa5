#pragma once

#include <string>
#include <vector>

#include <fmt/format.h>
#include <fmt/ranges.h>

namespace gp2::test {

/// A chain of n rods that hangs from a pin, in maximal coordinates: 3 n of them, 2 n constraints at position level, each rod 1/n
/// metres long. The whole of it in text, as a user would write it.
inline std::string chain_of_links(int n) {
  using Texts = std::vector<std::string>;
  const auto list = [](const Texts& texts) { return fmt::format("[\"{}\"]", fmt::join(texts, "\", \"")); };
  Texts coordinates, mass, force, truth, constraints, features;
  std::string sampling;
  for (int k = 1; k <= n; ++k) {
    for (const char* name : {"x", "y", "a"}) coordinates.push_back(fmt::format("{}{}", name, k));
    for (const char* name : {"a", "da"}) features.push_back(fmt::format("{}{}", name, k));
    force.insert(force.end(), {"0", "-9.81*m", "0"});
    // friction in the pin above
    truth.insert(truth.end(), {"0", "0", fmt::format("-0.3*da{}", k)});
    // a pin at the end of the rod before; angles from straight down
    const std::string before = k == 1 ? "" : fmt::format(" - x{0} - h*sin(a{0})", k - 1);
    const std::string above = k == 1 ? "" : fmt::format(" - y{0} + h*cos(a{0})", k - 1);
    constraints.push_back(fmt::format("x{0} - h*sin(a{0}){1}", k, before));
    constraints.push_back(fmt::format("y{0} + h*cos(a{0}){1}", k, above));
    sampling += fmt::format("a{0} = [-0.5, 0.5]\nda{0} = [-1, 1]\n", k);
  }
  Texts rows;
  for (int i = 0; i < 3 * n; ++i) {
    Texts row(static_cast<std::size_t>(3 * n), "0");
    row[static_cast<std::size_t>(i)] = i % 3 == 2 ? "m*(2*h)^2/12" : "m";
    rows.push_back(list(row));
  }
  return fmt::format(R"toml(
name        = "chain of {0} links"
coordinates = {1}
[parameters]
m = {2:.17g}   # kg, of a link
h = {3:.17g}   # m, half its length
[mechanics]
mass  = [{4}]
force = {5}
[constraints]
position = {6}
[[latent]]
kernel     = "se"
features   = {7}
directions = "acceleration"
[noise]
ddq = 0.05
[truth]
acceleration = {8}
[sampling]
{9})toml",
                     n, list(coordinates), 1.0 / n, 0.5 / n, fmt::join(rows, ", "), list(force), list(constraints),
                     list(features), list(truth), sampling);
}

}  // namespace gp2::test
