#include "export/shims.hpp"

#include <algorithm>
#include <set>
#include <string>
#include <vector>

#include <fmt/format.h>

#include "export/fill_template.hpp"
#include "export/shim_template.hpp"
#include "gp2/base/file.hpp"
#include "symbolic/functions.hpp"

namespace gp2 {

namespace {

// a dense pattern of CasADi in its full form, which everyone reads; or one without entries
std::string pattern(int rows, int columns, bool is_dense = true) {
  std::string text = fmt::format("{}, {}", rows, columns);
  for (int j = 0; j <= columns; ++j) text += fmt::format(", {}", is_dense ? rows * j : 0);
  for (int k = 0; is_dense && k < rows * columns; ++k) text += fmt::format(", {}", k % rows);
  return text;
}

}  // namespace

bool is_casadi_name(const std::string& name) { return name.front() != '_' && name.find("__") == std::string::npos; }

bool is_taken_in_casadi(const std::string& name) {
  static const std::set<std::string> taken = {"NQ", "NU", "NX", "NR", "WORK", "of_coordinates", "of_time", "of_inputs", "of_rows",
                                              "of_nothing", "patterns_in", "names_in", "read_state", "rows_by_coordinates",
                                              "rows_by_time", "rows_by_inputs", "casadi_real", "casadi_int",
                                              // a function `set` would have the size of its memory in `set_work`
                                              "set", "set_work"};
  // functions of the C library that expressions and portable functions call; compilers know those of floats, sqrtf say, as well
  std::vector<std::string> called = {"pow", "frexp", "ldexp", "copysign", "floor"};
  for (const internal::Function& function : internal::functions) called.emplace_back(function.c);
  return taken.contains(name) || std::ranges::any_of(called, [&](const std::string& c) { return name == c || name == c + "f"; });
}

std::string casadi_source(const std::string& name, const StateLayout& layout, int n_rows, const CSourceOptions& options) {
  std::set<std::string> conditions;
  if (options.stddev) conditions.insert("stddev");
  if (options.jacobian) conditions.insert("jacobian");
  if (layout.nu > 0) conditions.insert("inputs");
  const auto declared = [](const std::string& function) {
    return c_export::filled(c_export::casadi_declarations, {{}, {{"function", function}}});
  };
  return c_export::filled(c_export::casadi_template, {conditions,
                                                      {{"name", name},
                                                       {"declarations", declared(name)},
                                                       {"declarations_jac", declared("jac_" + name)},
                                                       {"declarations_std", declared(name + "_std")},
                                                       {"nq", std::to_string(layout.nq)},
                                                       {"nu", std::to_string(layout.nu)},
                                                       {"n_state", std::to_string(layout.size())},
                                                       {"n_rows", std::to_string(n_rows)},
                                                       {"pattern_q", pattern(layout.nq, 1)},
                                                       {"pattern_t", pattern(1, 1)},
                                                       {"pattern_u", pattern(layout.nu, 1)},
                                                       {"pattern_rows", pattern(n_rows, 1)},
                                                       {"pattern_nothing", pattern(n_rows, 1, false)},
                                                       {"pattern_rows_q", pattern(n_rows, layout.nq)},
                                                       {"pattern_rows_t", pattern(n_rows, 1)},
                                                       {"pattern_rows_u", pattern(n_rows, layout.nu)}}});
}

std::string acados_source(const CSource& model, const std::string& name, const StateLayout& layout, double time_step,
                          bool reads_time) {
  std::string source = model.source;
  const std::string include = fmt::format("#include \"{}.h\"\n", name);
  source.erase(source.find(include), include.size());
  std::set<std::string> conditions;
  if (reads_time) conditions.insert("timed");
  return model.header + "\n" + source +
         c_export::filled(c_export::acados_template,
                          {conditions, {{"name", name}, {"nu", std::to_string(layout.nu)}, {"time_step", shortest(time_step)}}});
}

}  // namespace gp2
