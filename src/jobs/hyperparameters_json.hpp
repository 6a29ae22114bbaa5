#pragma once

#include <string>

#include <nlohmann/json.hpp>

#include "gp2/fit.hpp"
#include "gp2/jobs/show_job.hpp"

namespace gp2 {

/// Each hyperparameter of a fit with its bounds and its unit, as `gp2 fit --json` prints them and a report holds them.
inline nlohmann::ordered_json hyperparameters_json(const FitReport& report, const Model& model) {
  nlohmann::ordered_json all = nlohmann::ordered_json::array();
  for (const Hyperparameter& h : report.hyperparameters) {
    const std::string unit = unit_of(h, model);
    all.push_back({{"name", h.name},
                   {"value", h.value},
                   {"lower", h.lower},
                   {"upper", h.upper},
                   {"unit", unit.empty() ? h.unit : unit},
                   {"at_bound", h.at_bound()}});
  }
  return all;
}

}  // namespace gp2
