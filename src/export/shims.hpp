#pragma once

#include <string>

#include "gp2/export/c_source.hpp"
#include "gp2/system.hpp"

namespace gp2 {

/// NAME_casadi.c: external functions of CasADi around NAME.h.
/// @param n_rows  of the view
std::string casadi_source(const std::string& name, const StateLayout& layout, int n_rows, const CSourceOptions& options);

/// NAME_acados.c, whole by itself since acados copies one file: the model, and a step of the constrained acceleration.
/// @param reads_time  whether anything depends on t
std::string acados_source(const CSource& model, const std::string& name, const StateLayout& layout, double time_step,
                          bool reads_time);

}  // namespace gp2
