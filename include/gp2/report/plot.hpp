#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "gp2/export.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/jobs/report_job.hpp"
#include "gp2/posterior.hpp"

namespace gp2 GP2_API {

/// Which of the learned forces. What is not given is chosen: what the data determine best, where it changes most.
struct PlotRequest {
  std::optional<std::string> what;   // latent
  std::optional<std::string> along;  // entry of the state, or feature, as LearnedForce has it
  std::optional<std::string> force;  // coordinate on which the force acts
};

/// what, along, force.
std::vector<Option> options(PlotRequest& request);

/// One of learned_forces: the curve, and its row.
struct LearnedCurve {
  LearnedForce force;
  Eigen::Index row = 0;
};

/// @throws InputError where there is no such curve, naming those there are.
LearnedCurve learned_curve(const Posterior& posterior, const PlotRequest& request);

/// @throws InputError for a file whose name says that it is another kind of picture than SVG.
void require_name_of_svg(const std::filesystem::path& path);

/// The curve with its 95 % band, and the training data along the axis, as an SVG image that needs nothing else.
/// @param model  of the fit: its name is the title, its units stand at the axes
std::string plot(const LearnedCurve& curve, const Model& model);

}  // namespace gp2
