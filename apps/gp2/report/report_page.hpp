#pragma once

#include <string>

#include "gp2/jobs/report_job.hpp"

namespace gp2::command {

/// The report for the page's script: JSON in which no text can end a script element.
std::string report_json(const Report& report);

/// The page: one HTML file that needs nothing else.
std::string report_page(const Report& report);

}  // namespace gp2::command
