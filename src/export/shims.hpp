#pragma once

#include <string>

#include "gp2/export/c_source.hpp"
#include "gp2/system.hpp"

namespace gp2 {

/// Whether CasADi takes a function of this name: it begins with a letter and has single underscores.
bool is_casadi_name(const std::string& name);
/// Whether NAME_casadi.c, or the libraries that it calls, have a function or a constant of this name.
bool is_taken_in_casadi(const std::string& name);

/// NAME_casadi.c: external functions of CasADi around NAME.h.
/// @param n_rows  of the view
std::string casadi_source(const std::string& name, const StateLayout& layout, int n_rows, const CSourceOptions& options);

/// NAME_acados.c, whole by itself since acados copies one file: the model, and a step of the constrained acceleration.
/// @param reads_time  whether anything depends on t
std::string acados_source(const CSource& model, const std::string& name, const StateLayout& layout, double time_step,
                          bool reads_time);

}  // namespace gp2
