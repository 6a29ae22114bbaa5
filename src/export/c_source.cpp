#include "gp2/export/c_source.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "export/c_header_template.hpp"
#include "export/c_math_functions.hpp"
#include "export/c_mechanics_template.hpp"
#include "export/c_prediction_template.hpp"
#include "export/c_writer.hpp"
#include "gp2/base/version.hpp"
#include "gp2/error.hpp"
#include "inference/requirements.hpp"

namespace gp2 {

namespace c_export {

// What a reader of the header is told.
void Writer::write_comments() {
  const std::vector<std::string> names =
      view_.names(system(), view_.latent ? prior_.latents[static_cast<std::size_t>(view_.latent->first)].name : "");
  text("title") = in_comment(fmt::format("{}: {} as learned by gp2 {}.", system().name(), fmt::join(names, ", "), version()));
  std::string& about = text("about");
  about += fmt::format(" * The {} view, of {} observed states{}.\n", view_.quantity->word(), posterior_.n_states(),
                       has("mixture") ? fmt::format(", a mixture over {} draws of hyperparameters", components_.size()) : "");
  for (const std::string& line : options_.about) about += " * " + in_comment(line) + "\n";
  std::string& obeyed = text("obeyed");
  for (std::size_t row = 0; row < system().constraint_labels().size(); ++row) {
    const std::string& condition = system().constraint_conditions()[row];
    obeyed += in_comment(fmt::format(" * It obeys {} = 0{}{}.\n", system().constraint_labels()[row],
                                     condition.empty() ? "" : " where ", condition));
  }
  const auto stated = [&](const std::string& name) -> std::string {
    const auto found = options_.units.find(name.substr(0, name.find('@')));
    return found == options_.units.end() ? "" : fmt::format(" [{}]", found->second);
  };
  const auto unit = [&](int k) -> std::string {
    const int nq = layout_.nq;
    const std::string label = stated(system().state_names()[static_cast<std::size_t>(k)]);
    if (k > layout_.t()) return label + " (what acts now, where commands act late)";
    if (!label.empty()) return label;
    if (k == layout_.t()) return " [s]";
    const Coordinate& coordinate = system().coordinates()[static_cast<std::size_t>(k % nq)];
    return coordinate.angle ? (k < nq ? " [rad]" : " [rad/s]") : "";
  };
  for (int k = 0; k < layout_.size(); ++k) {
    text("state") += in_comment(fmt::format(" *   [{}] {}{}\n", k, system().state_names()[static_cast<std::size_t>(k)], unit(k)));
  }
  for (std::size_t r = 0; r < names.size(); ++r)
    text("view") += in_comment(fmt::format(" *   [{}] {}{}\n", r, names[r], stated(names[r])));
  std::vector<std::string> parameters;
  for (const Parameter& parameter : system().parameters()) parameters.push_back(parameter.name + stated(parameter.name));
  text("parameters") = in_comment(parameters.empty() ? "none" : fmt::format("{}", fmt::join(parameters, ", ")));
}

CSource Writer::write() {
  if (options_.single_precision) require_single_precision();
  text("portable") = options_.portable_math ? "@portable@" : "";
  write_comments();
  write_learned();
  write_expressions();
  write_kernels();
  write_latents();
  write_tests();
  CSource out{filled(header_template, filling_), filled(mechanics_template, filling_) + filled(prediction_template, filling_)};
  if (options_.single_precision) use_float_functions(out.source);
  if (options_.portable_math) use_portable_functions(out.source, options_.name);
  return out;
}

}  // namespace c_export

CSource export_c(const Posterior& posterior, const View& view, const CSourceOptions& options) {
  require_view(posterior.prior(), view);
  if (!c_export::is_identifier(options.name)) {
    throw InputError(fmt::format(
        "`name`: must be a name of C, of letters, digits and _, that the code does not use itself, got '{}'", options.name));
  }
  const auto& components = posterior.conditioned();
  if (posterior.n_states() == 0) throw InputError("export to C: nothing was observed, so there is nothing to export");
  return c_export::Writer(posterior, components, view, options).write();
}

}  // namespace gp2
