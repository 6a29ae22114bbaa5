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

/// A fit as C for a machine that has no gp2, or what it found of a robot in the robot's own file.
struct ExportRequest {
  enum class Target {
    c,       // NAME.h, NAME.c
    casadi,  // and NAME_casadi.c: an external function with its Jacobian
    acados,  // NAME_acados.c alone: a discrete step with its sensitivities
    mjcf,    // NAME.xml: the robot's file with the numbers that the model has as parameters, fitted or held
    urdf,    // NAME.urdf: likewise
  };

  Target to = Target::c;
  std::string name;   // of the functions; empty: the system's
  std::string robot;  // of mjcf, urdf: the robot's file; empty: the one that the model names, beside the model's
  ViewRequest view;   // its time step is that of an acados step too
  bool stddev = true;
  bool jacobian = true;
  bool single_precision = false;
  bool portable_math = false;
  std::optional<double> draws_within;  // of a mixture: as Posterior::fewest_components

  [[nodiscard]] bool is_of_robot() const { return to == Target::mjcf || to == Target::urdf; }
};
std::vector<Option> options(ExportRequest& request);

struct ExportOutcome {
  std::vector<std::pair<std::string, std::string>> files;  // name, content
  std::vector<std::string> notes;
  std::string robot;  // of mjcf, urdf: the robot's file, which was read
};

/// Of mjcf and urdf: a copy of the robot's file, every byte as it is but for the numbers that the model has as parameters and a comment
/// behind each element with some. MuJoCo reads it back and must find these numbers.
/// @throws InputError as read_robot; when the model has no robot, or no number of it as a parameter; when the file is not the robot
///   of the fit, or of the other format; naming a joint or body that the file itself does not have; when its compiler would change the numbers.
ExportOutcome export_robot(const FitFile& fit, const ExportRequest& request);

/// @param posterior  of the fit
/// @throws InputError as export_c, predicted_view and export_robot, and where options do not go together.
ExportOutcome export_fit(const FitFile& fit, const Posterior& posterior, const ExportRequest& request);

}  // namespace gp2
