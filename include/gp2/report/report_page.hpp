#pragma once

#include <string>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/jobs/report_job.hpp"

namespace gp2 GP2_API {

/// Reports for the page's script: a JSON array in which no text can end a script element.
std::string report_json(const std::vector<Report>& reports, const Spelling& spelled);

/// Reports as one HTML file that needs nothing else; of several fits, with a section that has them side by side.
/// @param reports  at least one
std::string report_page(const std::vector<Report>& reports, const Spelling& spelled);

}  // namespace gp2
