#include "gp2/report/plot.hpp"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <functional>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/suggestion.hpp"
#include "gp2/error.hpp"
#include "report/markup.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::VectorXd;

namespace {

// how much is known of a row: its reach in standard deviations
double clearness(const LearnedForce& one, Index row) {
  const double reach = one.mean.row(row).maxCoeff() - one.mean.row(row).minCoeff();
  return reach / std::max(std::sqrt(one.stddev.row(row).array().square().mean()), 1e-300);
}

// "x" of force_x@slide, "coefficient" of coefficient@slide
std::string coordinate_of(const std::string& name) {
  const std::string of = name.substr(0, name.find('@'));
  return of.substr(of.find('_') + 1);
}

std::vector<std::string> distinct(std::vector<std::string> names) {
  std::vector<std::string> out;
  for (std::string& name : names) {
    if (std::ranges::find(out, name) == out.end()) out.push_back(std::move(name));
  }
  return out;
}

// Keeps what has the name that is asked for.
// @param left_out  why some are not among them
void keep(std::vector<LearnedCurve>& curves, const char* option, const std::optional<std::string>& given,
          const std::function<std::string(const LearnedCurve&)>& name_of, const std::vector<std::string>& left_out = {}) {
  if (!given) return;
  std::vector<std::string> known;
  for (const LearnedCurve& one : curves) known.push_back(name_of(one));
  std::erase_if(curves, [&](const LearnedCurve& one) { return name_of(one) != *given; });
  if (!curves.empty()) return;
  known = distinct(std::move(known));
  throw InputError(fmt::format("{}: '{}' is not among what was learned{}; there are: {}{}{}", option, *given,
                               suggestion(*given, known), fmt::join(known, ", "), left_out.empty() ? "" : "; ",
                               fmt::join(left_out, "; ")));
}

// Round numbers within a range, about n of them.
std::vector<double> ticks(double low, double high, int n) {
  const double rough = (high - low) / n;
  const double power = std::pow(10, std::floor(std::log10(rough)));
  double step = 10 * power;
  for (const double factor : {1.0, 2.0, 2.5, 5.0}) {
    if (factor * power >= rough) {
      step = factor * power;
      break;
    }
  }
  std::vector<double> all;
  for (double k = std::ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; ++k) all.push_back(k * step);
  return all;
}

std::string number_text(double value, int digits = 6) {
  std::string text = fmt::format("{:.{}g}", value, digits);
  if (text == "-0") text = "0";
  if (text.starts_with('-')) text.replace(0, 1, "−");
  return text;
}

// Where a value stands on the picture.
struct Axis {
  double low, high;    // values at the ends
  double first, last;  // pixels there
  [[nodiscard]] double operator()(double value) const { return first + (last - first) * (value - low) / (high - low); }
  // of its ticks: more than usual where it is far from 0
  [[nodiscard]] std::string text(double value) const {
    const double ratio = std::max(std::abs(low), std::abs(high)) / (high - low);
    return number_text(value, std::max(6, 3 + static_cast<int>(std::ceil(std::log10(ratio)))));
  }
};

Axis axis_over(double low, double high, double margin, double first, double last) {
  const double size = std::max(std::abs(low), std::abs(high));
  // a range of rounding errors has no ticks
  const double span = high - low > 1e-9 * size ? high - low : size > 0 ? size : 1;
  return {low - margin * span, high + margin * span, first, last};
}

std::string path_of(const VectorXd& x, const VectorXd& y, const Axis& across, const Axis& up) {
  std::string path;
  for (Index i = 0; i < x.size(); ++i) path += fmt::format("{}{:.1f},{:.1f}", i == 0 ? "" : " ", across(x[i]), up(y[i]));
  return path;
}

}  // namespace

std::vector<Option> options(PlotRequest& request) {
  return {
      {"what", &request.what, "LATENT", "latent whose force is plotted", "the force that the data determine best"},
      {"along", &request.along, "NAME",
       "state variable, or feature of several of them, on the horizontal axis; all others have their values in the most typical "
       "row of the training data",
       "the variable along which the force changes most"},
      {"force", &request.force, "COORDINATE",
       "coordinate on which the force acts; `force=coefficient` plots the coefficient of load-dependent friction",
       "the force that the data determine best"},
  };
}

LearnedCurve learned_curve(const Posterior& posterior, const PlotRequest& request) {
  if (posterior.prior().reference) throw InputError("nothing to plot: a baseline learns accelerations, not forces");
  std::vector<LearnedCurve> curves;
  std::vector<std::string> left_out;
  for (const LearnedForce& one : learned_forces(posterior, &left_out)) {
    const double largest = one.mean.cwiseAbs().maxCoeff() + one.stddev.maxCoeff();
    for (Index row = 0; row < one.mean.rows(); ++row) {
      // coordinates that the latent does not act on are left out
      const double size = one.mean.row(row).cwiseAbs().maxCoeff() + one.stddev.row(row).maxCoeff();
      if (size > 1e-12 * largest) curves.push_back({one, row});
    }
  }
  if (curves.empty() && !left_out.empty()) throw InputError(fmt::format("nothing to plot: {}", fmt::join(left_out, "; ")));
  if (curves.empty()) {
    throw InputError(
        "nothing to plot: no latent of the fit depends on a variable that changes in the training data of its own system");
  }
  keep(curves, "`what`", request.what, [](const LearnedCurve& one) { return one.force.latent; });
  keep(curves, "`force`", request.force,
       [](const LearnedCurve& one) { return coordinate_of(one.force.names[static_cast<std::size_t>(one.row)]); });
  keep(
      curves, "`along`", request.along, [](const LearnedCurve& one) { return one.force.along; }, left_out);
  // a coefficient says what was learned, the force what it is under one load
  return *std::ranges::max_element(curves, {}, [](const LearnedCurve& one) {
    return std::pair(one.force.names[static_cast<std::size_t>(one.row)].starts_with("coefficient"),
                     clearness(one.force, one.row));
  });
}

void require_name_of_svg(const std::filesystem::path& path) {
  std::string ending = path.extension().string();
  std::ranges::transform(ending, ending.begin(), [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  if (ending.empty() || ending == ".svg") return;
  throw InputError(fmt::format("{}: the picture is SVG: name a file that ends in .svg", path.string()));
}

std::string plot(const LearnedCurve& curve, const Model& model) {
  constexpr double width = 640, height = 400, left = 76, right = 620, top = 62, bottom = 336;
  constexpr Index max_marks = 300;
  constexpr double within95 = 1.96;
  const LearnedForce& force = curve.force;
  const VectorXd mean = force.mean.row(curve.row), half = within95 * force.stddev.row(curve.row);
  const VectorXd low = mean - half, high = mean + half;
  const Axis across = axis_over(force.at.minCoeff(), force.at.maxCoeff(), 0.03, left, right);
  const Axis up = axis_over(low.minCoeff(), high.maxCoeff(), 0.08, bottom, top);
  const std::string name = force.names[static_cast<std::size_t>(curve.row)];
  const std::string label = model.labelled(name.substr(0, name.find('@')));
  const std::string rows_text = fmt::format("{}{}", force.data.size(), force.are_all_rows ? "" : " of the");
  const std::string heading = shortened(fmt::format("{} – {}", force.latent, model.system->name()), 62);

  std::string svg = fmt::format(
      "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{0}\" height=\"{1}\" viewBox=\"0 0 {0} {1}\" role=\"img\" "
      "font-family=\"system-ui, 'Segoe UI', Roboto, 'Noto Sans', 'DejaVu Sans', sans-serif\" font-size=\"13\" fill=\"#59636b\">\n"
      "<title>{2}</title>\n"
      "<desc>What was learned along {3}, with its 95 % band: from {4} to {5}. Marks at the foot are {6} rows it was learned "
      "from.</desc>\n"
      "<rect width=\"{0}\" height=\"{1}\" fill=\"#ffffff\"/>\n",
      width, height, markup_text(heading), markup_text(force.along), number_text(mean.minCoeff()), number_text(mean.maxCoeff()),
      rows_text);
  // grid and numbers
  for (const double value : ticks(up.low, up.high, 6)) {
    svg += fmt::format(
        "<path d=\"M{:.0f},{:.1f}H{:.0f}\" stroke=\"{}\"/><text x=\"{:.0f}\" y=\"{:.1f}\" text-anchor=\"end\">{}</text>\n", left,
        up(value), right, value == 0 ? "#9aa3a9" : "#e8eaeb", left - 8, up(value) + 4.5, up.text(value));
  }
  for (const double value : ticks(across.low, across.high, 7)) {
    svg += fmt::format(
        "<path d=\"M{:.1f},{:.0f}V{:.0f}\" stroke=\"#e8eaeb\"/><text x=\"{:.1f}\" y=\"{:.0f}\" "
        "text-anchor=\"middle\">{}</text>\n",
        across(value), top, bottom, across(value), bottom + 20, across.text(value));
  }
  // band and mean
  const VectorXd back = force.at.reverse();
  svg += fmt::format("<polygon class=\"band\" fill=\"#0072b2\" fill-opacity=\"0.18\" points=\"{} {}\"/>\n",
                     path_of(force.at, high, across, up), path_of(back, low.reverse(), across, up));
  svg += fmt::format("<polyline class=\"mean\" fill=\"none\" stroke=\"#0072b2\" stroke-width=\"2\" points=\"{}\"/>\n",
                     path_of(force.at, mean, across, up));
  // where the data are
  std::string marks;
  const Index stride = (force.data.size() + max_marks - 1) / max_marks;
  for (Index i = 0; i < force.data.size(); i += stride) marks += fmt::format("M{:.1f},{:.0f}v-8", across(force.data[i]), bottom);
  svg += fmt::format("<path class=\"data\" d=\"{}\" stroke=\"#59636b\" stroke-opacity=\"0.55\"/>\n", marks);
  // words
  svg += fmt::format("<text x=\"{:.0f}\" y=\"24\" font-size=\"16\" font-weight=\"600\" fill=\"#1d2327\">{}</text>\n", left,
                     markup_text(heading));
  svg += fmt::format(
      "<path d=\"M{0:.0f},42h20\" stroke=\"#0072b2\" stroke-width=\"2\"/><text x=\"{1:.0f}\" y=\"46\">learned</text>"
      "<rect x=\"{2:.0f}\" y=\"36\" width=\"20\" height=\"12\" fill=\"#0072b2\" fill-opacity=\"0.18\"/><text x=\"{3:.0f}\" "
      "y=\"46\">95 % "
      "band</text><path d=\"M{4:.0f},48v-8m5,8v-8m7,8v-8\" stroke=\"#59636b\" stroke-opacity=\"0.55\"/><text x=\"{5:.0f}\" "
      "y=\"46\">{6} rows "
      "of training</text>\n",
      left, left + 26, left + 96, left + 122, left + 208, left + 228, rows_text);
  svg += fmt::format("<text x=\"{:.0f}\" y=\"{:.0f}\" text-anchor=\"middle\" fill=\"#1d2327\">{}</text>\n", (left + right) / 2,
                     bottom + 48, markup_text(model.labelled(force.along)));
  svg += fmt::format(
      "<text transform=\"translate(20,{:.0f}) rotate(-90)\" text-anchor=\"middle\" fill=\"#1d2327\">{}</text>\n</svg>\n",
      (top + bottom) / 2, markup_text(label));
  return svg;
}

}  // namespace gp2
