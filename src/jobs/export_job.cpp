#include "gp2/jobs/export_job.hpp"

#include <algorithm>
#include <cctype>

#include <fmt/format.h>

#include "base/checksum.hpp"
#include "export/shims.hpp"
#include "gp2/error.hpp"
#include "gp2/export/c_source.hpp"

namespace gp2 {

namespace {

using Target = ExportRequest::Target;

// "a particle on a surface" -> a_particle_on_a_surface
std::string name_of(const System& system) {
  std::string name;
  for (const char c : system.name()) {
    const bool fits = std::isalnum(static_cast<unsigned char>(c)) != 0;
    if (fits || (!name.empty() && name.back() != '_')) name += fits ? c : '_';
  }
  while (name.ends_with('_')) name.pop_back();
  return name.empty() || std::isdigit(static_cast<unsigned char>(name.front())) ? "model_" + name : name;
}

void require_options(const ExportRequest& request, const std::string& name) {
  if (request.to == Target::c) return;
  if (request.single_precision) {
    throw InputError("`float` goes with `to=c`: CasADi and acados compute in double precision");
  }
  if (request.to == Target::casadi) {
    if (name.front() == '_' || name.find("__") != std::string::npos) {
      throw InputError(
          fmt::format("`name`: CasADi takes names that begin with a letter and have single underscores, got '{}'", name));
    }
    return;
  }
  if (request.view.quantity != View::Quantity::constrained_acceleration || request.view.latent) {
    throw InputError("`to=acados` is a step of the whole motion: leave `view` and `latent` out");
  }
  if (!request.view.time_step || !(*request.view.time_step > 0)) {
    throw InputError("`to=acados` needs the time step of the solver: `dt=SECONDS`, positive");
  }
  if (!request.jacobian) throw InputError("`to=acados` needs the Jacobian, which was left out");
}

}  // namespace

std::vector<Option> options(ExportRequest& request) {
  std::vector<Option> table = {
      {"to", choice(request.to, {{"c", Target::c}, {"casadi", Target::casadi}, {"acados", Target::acados}}), "",
       "c: NAME.h and NAME.c, C99 that needs <math.h> alone; casadi: also NAME_casadi.c, an external function with its Jacobian; "
       "acados: NAME_acados.c, a generic discrete step of `dt` with its sensitivities"},
      {"name", &request.name, "NAME", "what the files and every name in them begin with", "that of the system"}};
  for (Option& option : options(request.view)) {
    if (option.name == "dt")
      option = {"dt", option.value, option.sample, "time step of next-velocity, or of the step for acados [s]"};
    table.push_back(std::move(option));
  }
  table.push_back({"std", YesByDefault{&request.stddev}, "",
                   "the function of the standard deviation, which stores n²/2 numbers of n reduced observations"});
  table.push_back({"jacobian", YesByDefault{&request.jacobian}, "", "the function of the Jacobian"});
  table.push_back(
      {"float", &request.single_precision, "", "in single precision; refused where its error would show", "", "single"});
  table.push_back(
      {"draws_within", &request.draws_within, "E",
       "of a fit whose hyperparameters are integrated: few draws, which stand for all within this share of a standard "
       "deviation",
       "all draws"});
  return table;
}

ExportOutcome export_fit(const FitFile& fit, const Posterior& posterior, const ExportRequest& request) {
  ExportOutcome out;
  const std::string name = request.name.empty() ? name_of(*fit.model.system) : request.name;
  require_options(request, name);
  ViewRequest viewed = request.view;
  if (request.to == Target::acados) viewed.time_step.reset();
  const PredictedView at = predicted_view(fit, posterior.prior(), viewed);
  const bool few = request.draws_within && posterior.n_components() > 1;
  const Posterior exported = few ? posterior.components(posterior.fewest_components(*request.draws_within)) : posterior;
  if (few) {
    out.notes.push_back(fmt::format("{} of {} draws stand for all", exported.n_components(), posterior.n_components()));
  }
  const CSourceOptions options{
      name,
      request.stddev && request.to != Target::acados,
      request.jacobian,
      request.single_precision,
      {fmt::format("Model '{}', CRC-64 of its text {}.", at.model->system->name(), checksum(at.model->text))}};
  const CSource c = export_c(exported, at.view, options);
  if (request.to == Target::acados) {
    const std::vector<bool> reads = at.prior.reads();
    const StateLayout layout = at.prior.system->layout();
    out.files.emplace_back(name + "_acados.c",
                           acados_source(c, name, layout, *request.view.time_step, reads[static_cast<std::size_t>(layout.t())]));
    return out;
  }
  out.files = {{name + ".h", c.header}, {name + ".c", c.source}};
  if (request.to == Target::casadi) {
    out.files.emplace_back(name + "_casadi.c", casadi_source(name, at.prior.system->layout(), at.view.size(), options));
  }
  return out;
}

}  // namespace gp2
