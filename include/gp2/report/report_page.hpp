#pragma once

#include <functional>
#include <string>

#include "gp2/export.hpp"
#include "gp2/jobs/report_job.hpp"

namespace gp2 GP2_API {

/// How a face spells the options that a message names in backticks (respelled).
using Spelling = std::function<std::string(const std::string& message)>;

/// The report for the page's script: JSON in which no text can end a script element.
std::string report_json(const Report& report, const Spelling& spelled);

/// The report as one HTML file that needs nothing else.
std::string report_page(const Report& report, const Spelling& spelled);

}  // namespace gp2
