#include "gp2/jobs/export_job.hpp"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <filesystem>
#include <map>
#include <optional>

#include <fmt/format.h>

#include "base/checksum.hpp"
#include "export/c_writer.hpp"
#include "export/fitted_robot.hpp"
#include "export/shims.hpp"
#include "gp2/base/file.hpp"
#include "gp2/error.hpp"
#include "gp2/export/c_source.hpp"
#include "gp2/training/laplace.hpp"
#include "model/model_reader.hpp"
#include "robots/robot_expressions.hpp"
#include "robots/robot_xml.hpp"

namespace gp2 {

namespace {

using Target = ExportRequest::Target;

// "a particle on a surface" -> a_particle_on_a_surface
std::string name_of(const System& system, Target to) {
  std::string name;
  for (const char c : system.name()) {
    const bool fits = std::isalnum(static_cast<unsigned char>(c)) != 0;
    if (fits || (!name.empty() && name.back() != '_')) name += fits ? c : '_';
  }
  while (name.ends_with('_')) name.pop_back();
  const bool fits = c_export::is_identifier(name) && (to != Target::casadi || !is_taken_in_casadi(name));
  return fits ? name : "model_" + name;
}

const char* word(Target robot) { return robot == Target::urdf ? "urdf" : "mjcf"; }

void require_options(const ExportRequest& request, const std::string& name) {
  if (request.is_of_robot()) {
    const ViewRequest whole;
    if (request.view.quantity != whole.quantity || request.view.latent || request.view.time_step || request.view.system ||
        request.single_precision || request.portable_math || request.draws_within || !request.stddev || !request.jacobian) {
      throw InputError(
          fmt::format("`to={}` writes parameters, not functions: it goes with `robot` and `name` only", word(request.to)));
    }
    return;
  }
  if (request.draws_within && !(*request.draws_within > 0)) {
    throw InputError(fmt::format("`draws_within`: must be positive, got {}", *request.draws_within));
  }
  if (!request.robot.empty()) throw InputError("`robot` goes with `to=mjcf` and `to=urdf`");
  if (request.to == Target::c) return;
  if (request.single_precision) {
    throw InputError("`float` goes with `to=c`: CasADi and acados compute in double precision");
  }
  if (request.to == Target::casadi) {
    if (!is_casadi_name(name)) {
      throw InputError(
          fmt::format("`name`: CasADi takes names that begin with a letter and have single underscores, got '{}'", name));
    }
    if (is_taken_in_casadi(name)) {
      throw InputError(fmt::format("`name`: the code for CasADi uses '{}' itself; choose another", name));
    }
    return;
  }
  if (request.view.quantity != View::Quantity::constrained_acceleration || request.view.latent) {
    throw InputError("`to=acados` is a step of the whole motion: leave `view` and `latent` out");
  }
  if (!request.view.time_step || !(*request.view.time_step > 0) || std::isinf(*request.view.time_step)) {
    throw InputError("`to=acados` needs the time step of the solver: `dt=SECONDS`, positive and finite");
  }
  if (!request.jacobian) throw InputError("`to=acados` needs the Jacobian, which was left out");
}

// ---- a robot's own file

// The numbers that the model has as parameters, at their fitted or held values; those held at the robot's own stay as they stand.
std::vector<FittedNumber> fitted_numbers(const FitFile& fit, const std::map<std::string, std::string>& parameter_of) {
  std::map<std::string, FittedNumber> of_parameters;
  const std::vector<Parameter>& parameters = fit.model.system->parameters();
  for (const Parameter& parameter : parameters) of_parameters[parameter.name].value = parameter.value;
  for (std::size_t k = 0; k < fit.report.hyperparameters.size(); ++k) {
    const Hyperparameter& h = fit.report.hyperparameters[k];
    if (!h.is_system_parameter()) continue;
    const ParameterUncertainty known = parameter_uncertainty(fit.report, k);
    FittedNumber& number = of_parameters[parameters[static_cast<std::size_t>(h.index)].name];
    number.value = known.is_of_draws ? known.mean : h.value;
    number.is_estimated = !h.is_fixed();
    number.stddev = known.stddev;
  }
  std::vector<FittedNumber> numbers;
  for (const auto& [name, own] : robot_numbers(*fit.model.robot)) {
    const auto parameter = parameter_of.find(name);
    if (parameter == parameter_of.end()) continue;
    FittedNumber number = of_parameters.at(parameter->second);
    number.name = name;
    if (number.is_estimated || number.value != own) numbers.push_back(std::move(number));
  }
  return numbers;
}

struct NumberDifference {
  std::string name;
  double is = 0, expected = 0;
};

// Of inertias within what another MuJoCo makes of the same file.
std::optional<NumberDifference> first_difference(const RobotDescription& robot, const RobotDescription& expected) {
  const auto numbers = robot_numbers(robot), others = robot_numbers(expected);
  for (std::size_t k = 0; k < std::max(numbers.size(), others.size()); ++k) {
    if (k == numbers.size()) return NumberDifference{others[k].first, std::nan(""), others[k].second};
    const auto& [name, value] = numbers[k];
    if (k == others.size() || others[k].first != name) return NumberDifference{name, value, std::nan("")};
    double scale = std::abs(value) + std::abs(others[k].second);
    for (const RobotDescription::Body& body : expected.bodies) {
      if (name.starts_with(fmt::format("inertia(\"{}\")", body.name))) scale = body.inertia.trace();
    }
    if (!(std::abs(value - others[k].second) <= 1e-8 * scale)) return NumberDifference{name, value, others[k].second};
  }
  return std::nullopt;
}

}  // namespace

ExportOutcome export_robot(const FitFile& fit, const ExportRequest& request) {
  const std::string name = request.name.empty() ? name_of(*fit.model.system, request.to) : request.name;
  require_options(request, name);
  const char* const to = word(request.to);
  if (!fit.model.robot) throw InputError(fmt::format("`to={}` writes into the file of a robot, but the model has none", to));
  const RobotNames names = robot_names(fit.model);
  const std::filesystem::path path = request.robot.empty() ? std::filesystem::path(fit.model.name).parent_path() / names.file
                                                           : std::filesystem::path(request.robot);
  const std::vector<FittedNumber> numbers = fitted_numbers(fit, names.parameters);
  if (numbers.empty()) {
    throw InputError(
        fmt::format("`to={}`: no parameter of the model changes a number of its robot; write [parameters] m7 = {{ of = "
                    "'mass(\"link7\")', estimate = true }} and fit again",
                    to));
  }
  if (request.robot.empty() && !std::filesystem::exists(path)) {
    throw InputError(
        fmt::format("`robot`: the robot's file is not at '{}', where the model had it; say where it is", path.string()));
  }
  const std::string text = read_file(path);
  const bool is_urdf = read_robot_xml(text, path).is_urdf;
  if (is_urdf != (request.to == Target::urdf)) {
    throw InputError(fmt::format("`to={}`: '{}' is a file of the other format; use `to={}`", to, path.string(),
                                 word(is_urdf ? Target::urdf : Target::mjcf)));
  }
  if (const auto other = first_difference(read_robot(path), *fit.model.robot)) {
    throw InputError(fmt::format("`robot`: '{}' is not the robot of the fit: its {} is {}, there it is {}", path.string(),
                                 other->name, other->is, other->expected));
  }
  FittedRobot written = (is_urdf ? fitted_urdf : fitted_mjcf)(text, path.string(), *fit.model.robot, numbers);
  if (written.is_physical) {
    if (const auto other = first_difference(read_robot(path, written.text), written.robot)) {
      throw InputError(
          fmt::format("{}: MuJoCo would read {} = {} where {} is written: its compiler changes it by settotalmass, boundmass, "
                      "boundinertia or balanceinertia, or fuses bodies by fusestatic; remove these",
                      path.string(), other->name, other->is, other->expected));
    }
  }
  if (text.find(is_urdf ? " filename=" : " file=") != std::string::npos) {
    written.notes.push_back(fmt::format("the file refers to others: put it into the folder of {}", path.string()));
  }
  return {{{name + (is_urdf ? ".urdf" : ".xml"), std::move(written.text)}}, std::move(written.notes), path.string()};
}

std::vector<Option> options(ExportRequest& request) {
  std::vector<Option> of_view = options(request.view);
  for (Option& option : of_view) {
    if (option.name == "dt")
      option = {"dt", option.value, option.sample, "time step of next-velocity, or of the acados model [s]"};
  }
  const std::vector<Option> files = {
      {"to",
       choice(request.to, {{"c", Target::c},
                           {"casadi", Target::casadi},
                           {"acados", Target::acados},
                           {"mjcf", Target::mjcf},
                           {"urdf", Target::urdf}}),
       "",
       "format; c: NAME.h and NAME.c, C99 that needs only <math.h>; casadi: also NAME_casadi.c, an external function with its "
       "Jacobian; acados: NAME_acados.c, generic discrete dynamics with step `dt` and their sensitivities; mjcf, urdf: the "
       "robot's file with the parameter values of the fit"},
      {"name", &request.name, "NAME", "prefix of the files and of all names in them", "the system's name"},
      {"robot", &request.robot, "FILE", "the robot's file, for mjcf and urdf",
       "the file that the model names, next to the model file"}};
  const std::vector<Option> functions = {
      {"std", YesByDefault{&request.stddev}, "",
       "the standard deviation, which needs n²/2 stored numbers for n reduced observations"},
      {"jacobian", YesByDefault{&request.jacobian}, "", "the Jacobian"},
      {"float", &request.single_precision, "", "single precision; an error if rounding would matter", "", "single"},
      {"portable_math", &request.portable_math, "",
       "bit-identical results on every machine and compiler: own exp, sin and others instead of those of <math.h>"},
      {"draws_within", &request.draws_within, "E",
       "for integrated hyperparameters: export only as many draws as keep the rms error of the view below this fraction of its "
       "standard deviation, over up to 300 observed states; single states may be off by more",
       "all draws"}};
  return joined({files, of_view, functions});
}

ExportOutcome export_fit(const FitFile& fit, const Posterior& posterior, const ExportRequest& request) {
  ExportOutcome out;
  const std::string name = request.name.empty() ? name_of(*fit.model.system, request.to) : request.name;
  require_options(request, name);
  if (request.is_of_robot()) return export_robot(fit, request);
  ViewRequest viewed = request.view;
  if (request.to == Target::acados) viewed.time_step.reset();
  const PredictedView at = predicted_view(fit, posterior.prior(), viewed);
  out.notes = at.notes;
  const bool few = request.draws_within && posterior.n_components() > 1;
  const Posterior exported = few ? posterior.components(posterior.fewest_components(*request.draws_within, at.view)) : posterior;
  if (few) {
    out.notes.push_back(fmt::format("{} of {} draws represent all", exported.n_components(), posterior.n_components()));
  } else if (request.draws_within) {
    out.notes.emplace_back("`draws_within` changes nothing: the fit has one set of hyperparameters, not draws of them");
  }
  const CSourceOptions options{
      name,
      request.stddev && request.to != Target::acados,
      request.jacobian,
      request.single_precision,
      request.portable_math,
      {fmt::format("Model '{}', CRC-64 of its text {}.", at.model->system->name(), checksum(at.model->text))},
      at.model->units};
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
