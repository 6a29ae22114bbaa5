#pragma once

#include <filesystem>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/actuator.hpp"
#include "gp2/export.hpp"
#include "gp2/mechanics/symbolic_system.hpp"
#include "gp2/prior/latent_spec.hpp"
#include "gp2/robots/robot.hpp"
#include "gp2/view.hpp"

namespace gp2 GP2_API {

class RobotExpressions;

/// What stands in for the file that a model file names as its robot.
using RobotSource = std::function<RobotDescription(const std::string& file)>;

/// Code that gives the equations of a system, which a model file only declares: a CallableSystem, say, or a System of one's own.
/// What it returns must go by the coordinates, inputs and parameters declared.
using MechanicsSource = std::function<std::shared_ptr<const System>(const SystemDeclaration& declaration)>;

/// Code for what a model file only declares.
struct ModelCode {
  MechanicsSource mechanics = {};  // empty: M, A, b and F stand in the file

  struct OfLatent {
    StateCode features = {}, directions = {};  // empty: they stand in the file
  };
  std::map<std::string, OfLatent> latents = {};  // by the name of the latent

  explicit operator bool() const { return mechanics || !latents.empty(); }
};

/// A mechanical system and its prior as text (TOML; docs/model-files.md has every key). The equations of the system may come from
/// code instead; everything else is the same then.
class Model {
 public:
  /// @param code  what the file leaves to it: M, A, b and F, when it is without [mechanics] and [constraints]; features and
  ///   directions of latents, when it has { code = [names] } in their place
  /// @throws InputError with file, line, key, the rule, the value got and the mend; also when code and file both give something,
  ///   or neither, and when the mechanics return nothing, or a system that goes by other coordinates, inputs or parameters.
  static Model read(const std::filesystem::path& path, const ModelCode& code = {});
  /// @param name  stands for the file in messages; its folder is where a relative robot = "FILE" is looked for
  static Model parse(std::string text, std::string name, const ModelCode& code = {});
  static Model parse(std::string text, std::string name, const RobotSource& robot, const ModelCode& code = {});

  /// A model without a file: its text declares what a fit on disk must hold, the rest is code, as for `parse`.
  /// @throws InputError as make_prior; as `parse`; and when the text has no words for a spec: Base::admissible, one bound without
  /// the other, or per_direction beside lengthscales of single features, where the kernel does not imply it.
  static Model from_code(std::shared_ptr<const System> system, const std::vector<LatentSpec>& latents);

  struct Noise {
    std::vector<double> stddev;  // per coordinate; empty when the file states none
    bool estimate = false;
    std::vector<std::pair<double, double>> bounds;  // of an estimate, per coordinate; empty: the protocol's
    std::vector<double> floor;                      // what stated deviations lack, per coordinate; empty: nothing
  };

  /// An entry of [parameters] that follows from others.
  struct DerivedParameter {
    std::string name, text;
    Expression expression;  // of the system's parameters
    double value = 0;       // where these have theirs
  };

  /// One entry of [sampling]: a uniform range, or an expression of other entries.
  struct SamplingRule {
    std::string name;
    std::optional<std::pair<double, double>> range;
    Expression value;  // where there is no range
    int line = 0;
  };

  /// [motion]: how the system is driven while it is sampled. A task y(q) follows straight lines between random targets.
  struct Motion {
    enum class Profile { smooth /* of least jerk */, trapezoid /* of the speed */ };
    struct Target {
      std::string text;
      ConstraintRow row;                               // of y: A = J, b = −J̇ dq, residuals y and ẏ
      std::optional<std::pair<double, double>> range;  // of the targets; none: y stays where it starts
    };
    double rate = 0;                    // samples per second [Hz]
    std::pair<double, double> segment;  // how long a line takes [s]
    Profile profile = Profile::smooth;
    double natural_frequency = 0;  // ω of the controller [rad/s]
    double damping_ratio = 1;      // ζ
    std::vector<Target> targets;
    std::map<std::string, double> start;  // where it begins, before it is moved onto the constraints
  };

  /// [drawing]: points of the mechanism, and lines through some of them, for pictures of its motion.
  struct Drawing {
    std::vector<std::string> names;               // of the points
    std::vector<std::vector<Expression>> points;  // of q, t and parameters: two entries each, or three [m]
    std::vector<std::vector<int>> lines;          // points, one after the other
  };

  std::string name;                        // for messages
  std::string text;                        // the file's content
  ModelCode code;                          // what the text leaves to it
  std::optional<RobotDescription> robot;   // that the model file names
  std::shared_ptr<ExpressionGraph> graph;  // of every expression here
  std::shared_ptr<const System> system;
  std::vector<Actuator> actuators;  // of each input; of a fit that estimated them with its values
  std::vector<DerivedParameter> derived_parameters;
  std::vector<LatentSpec> latents;
  Noise noise;
  std::optional<Expression> potential;         // V(q, t) [J], for the energy that `simulate` reports
  std::vector<Expression> truth;               // added to M⁻¹F; nq entries, or none without [truth]
  std::vector<Expression> truth_force;         // added to F; likewise
  std::vector<SamplingRule> sampling;          // in an order in which each can be computed; empty without [sampling]
  std::map<std::string, double> newton_start;  // [sampling] start
  std::optional<Motion> motion;                // instead of sampling
  std::optional<Drawing> drawing;
  std::map<std::string, std::string> columns;  // the model's name -> the name in logs
  /// Labels by the name of a quantity, which nothing computes with: [units], and what follows from a coordinate's for its velocity,
  /// its accelerations and, where it is in m or rad, its forces.
  std::map<std::string, std::string> units;

  /// An expression of the model's symbols and [let] names. Points of its robot, site("tip").z say, become what they are in
  /// coordinates and velocities.
  [[nodiscard]] Expression expression(std::string_view text) const;

  /// `units`, and those that are known without being stated: of angles, of the joints of a robot, and what follows from them.
  [[nodiscard]] std::map<std::string, std::string> known_units() const;
  /// The unit in `units` of a quantity, of the view of one latent too (`force_x@friction`). Empty: not stated.
  [[nodiscard]] std::string unit_of(std::string_view quantity) const;
  /// The quantity with its unit, for an axis: "dx [m/s]"; alone where that is not among known_units().
  [[nodiscard]] std::string labelled(const std::string& quantity) const;

  /// The variables of the system in `graph`.
  [[nodiscard]] SystemSymbols symbols() const;

  /// The system as expressions of `graph`; null where its mechanics are code.
  [[nodiscard]] const SymbolicSystem* symbolic_system() const;

 private:
  void define(const std::string& symbol, Expression value);
  /// Points of the robot stay as they are.
  /// @param forbidden  symbols that an error about an unknown one does not list or suggest, with all that depend on them
  /// @param parse  reads the text: parse_expression or parse_condition
  [[nodiscard]] Expression parse_symbols(std::string_view text, const std::vector<Expression>& forbidden = {},
                                         decltype(parse_expression)& parse = parse_expression) const;

  std::shared_ptr<RobotExpressions> robot_expressions_;  // null without a robot
  std::map<std::string, Expression, std::less<>> symbols_;
  std::vector<std::string> symbol_names_;  // to suggest from when a symbol is unknown
  friend class ModelReader;
};

/// The system of a model as expressions. @throws InputError where its mechanics are code.
const SymbolicSystem& require_symbolic_system(const Model& model);

/// The prior of a model file.
/// @throws InputError when a kernel or feature is wrong, or `base` is asked for and the model has several latents.
Prior make_prior(const Model& model, const PriorOptions& options = {});

/// The actuators of `other`: a delay or lag that it marks `estimate = true` is that of the same input of `fitted`.
std::vector<Actuator> shared_actuators(const std::vector<Actuator>& fitted, const Model& other);

/// The system of `other` for the latents of `fitted` to act in. A parameter that `other` marks `estimate = true` and `fitted` has
/// by the same name is one and the same; every other keeps the value of its own file.
/// @param options  those of the prior of `fitted`
/// @throws InputError naming what differs: coordinates, inputs, the number of latents, or a latent's kernel, features or
///   directions; and when a parameter that is one and the same stands in a feature of `other`.
std::shared_ptr<const OtherSystem> make_other_system(const Model& fitted, const Model& other, const PriorOptions& options = {});

}  // namespace gp2
