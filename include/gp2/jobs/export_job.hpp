#pragma once

#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/jobs/predict_job.hpp"
#include "gp2/posterior.hpp"

namespace gp2 GP2_API {

/// A fit as C for a machine that has no gp2.
struct ExportRequest {
  enum class Target {
    c,       // NAME.h, NAME.c
    casadi,  // and NAME_casadi.c: an external function with its Jacobian
    acados,  // NAME_acados.c alone: a discrete step with its sensitivities
  };

  Target to = Target::c;
  std::string name;  // of the functions; empty: the system's
  ViewRequest view;  // its time step is that of an acados step too
  bool stddev = true;
  bool jacobian = true;
  bool single_precision = false;
  std::optional<double> draws_within;  // of a mixture: as Posterior::fewest_components
};
std::vector<Option> options(ExportRequest& request);

struct ExportOutcome {
  std::vector<std::pair<std::string, std::string>> files;  // name, content
  std::vector<std::string> notes;
};

/// @param posterior  of the fit
/// @throws InputError as export_c and predicted_view, and where options do not go together.
ExportOutcome export_fit(const FitFile& fit, const Posterior& posterior, const ExportRequest& request);

}  // namespace gp2
