#pragma once

#include <string_view>

/// The files of assets/ and of third_party/uplot, as they were when the library was built (embed_assets.cmake).
namespace gp2::assets {

extern const std::string_view page_html;
extern const std::string_view report_css;
extern const std::string_view report_js;
extern const std::string_view uplot_css;
extern const std::string_view uplot_js;
extern const std::string_view uplot_license;

}  // namespace gp2::assets
