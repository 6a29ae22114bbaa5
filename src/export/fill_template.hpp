#pragma once

#include <map>
#include <set>
#include <string>
#include <string_view>

namespace gp2::c_export {

/// What a template of c_template.hpp becomes: the lines whose conditions hold, with the texts in their places. A line that is
/// nothing but an empty text goes.
std::string filled(std::string_view form, const std::set<std::string>& conditions,
                   const std::map<std::string, std::string>& texts);

}  // namespace gp2::c_export
