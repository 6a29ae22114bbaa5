#include "export/c_latent_templates.hpp"

#include <algorithm>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "export/c_writer.hpp"

namespace gp2::c_export {

// What each latent adds to the mean, its deviation and its Jacobian.
void Writer::write_latents() {
  std::size_t a = 0;
  for (Term& term : terms_) {
    const auto set = [&](const std::string& name, bool holds) {
      if (holds) term.filling.conditions.insert(name);
    };
    set("is_potential", term.of->is_potential);
    set("is_positive", term.of->is_positive);
    set("is_admissible", term.is_admissible());
    set("has_directions", term.has_directions());
    set("reads_multipliers", term.reads_multipliers);
    set("features_read_load", term.features_read_load());
    set("directions_read_load", term.directions_read_load());
    set("features_vary", term.features_vary());
    set("directions_vary", term.directions_vary());
    term.filling.outer = &filling_;
    term.filling.texts.merge(std::map<std::string, std::string>{
        {"a", std::to_string(a)},
        {"D", std::to_string(term.D)},
        {"p", std::to_string(term.p)},
        {"Dp", std::to_string(term.D * term.p)},
        {"F", std::to_string(term.F)},
        {"first", std::to_string(term.first)},
        {"latent", in_comment(term.of->name.empty() ? std::to_string(a + 1) : term.of->name)},
        {"kernel", in_comment(term.kernel.text())},
        {"feature_names", in_comment(fmt::format("{}", fmt::join(term.of->feature_names, ", ")))},
        {"state_of_features", term.features_read_load() ? "w->x" : "state"},
        {"state_of_directions", term.reads_multipliers        ? "w->y"
                                : term.directions_read_load() ? "w->x"
                                                              : "state"},
        {"to", term.is_forced() ? "force" : "a_bar"},
        {"d_to", term.is_forced() ? "d_force" : "d_of_rest"},
        {"part", term.is_forced() ? "force" : "rest"},
        {"G", fmt::format("{}Gt{}", term.is_forced() ? "M_inverse_" : "", term.is_viewed ? "" : "_of_others")},
        {"slope", term.has_directions() ? "sum" : fmt::format("w->dsignal[d + {} * i]", term.D)},
    });
    ++a;
  }
  // latents that are not viewed are there where the load of the whole motion is looked for and, `always`, in its deviation
  const auto write = [&](const std::string& name, std::string_view form, bool is_asked, bool always) {
    std::string& of_all = text(name);
    for (const Term& term : terms_) {
      if (!is_asked) continue;
      const std::string code = filled(form, term.filling);
      of_all += term.is_viewed || always ? code : fmt::format("  if (!w->is_part) {{\n{}  }}\n", code);
    }
  };
  write("signals", signal_template, true, false);
  write("under_load", under_load_template, has("nonlinear"), false);
  write("loadings", loading_template, has("stddev"), true);
  write("cross_by_row", cross_by_row_template, has("stddev") && !has("by_function"), true);
  write("cross_by_function", cross_by_function_template, has("stddev") && has("by_function"), true);
  write("dsignals", dsignal_template, has("jacobian"), false);
  const auto any = [&](const auto& holds) { return std::any_of(terms_.begin(), terms_.end(), holds); };
  if (any([](const Term& term) { return term.features_vary() || term.directions_vary(); })) {
    filling_.conditions.insert("dsignals_read_component");
  }
  if (any([](const Term& term) {
        return (term.features_vary() && !term.features_read_load()) ||
               (term.directions_vary() && !term.directions_read_load() && !term.reads_multipliers);
      })) {
    filling_.conditions.insert("dsignals_read_state");
  }
  if (has("constant")) text("mu") = numbers(prior_.constant_mean.data(), prior_.constant_mean.size());
}

}  // namespace gp2::c_export
