#pragma once

#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "gp2/model.hpp"
#include "model/toml_value.hpp"
#include "robots/robot_expressions.hpp"

namespace gp2 {

/// What the readers of the tables of a model file share: the file, the model that they fill, its names and its expressions.
class ModelReader {
 public:
  ModelReader(const TomlValue& root, Model& filled) : file(root), model(filled) {}

  TomlValue file;                                       // its root
  Model& model;                                         // each reader adds its part
  SymbolicSystem::Definition definition;                // of the system, as far as it has been read
  std::map<std::string, std::string> robot_parameters;  // number of the robot -> parameter in its place
  std::optional<SystemSymbols> symbols;                 // of the state and the parameters, once these are read

  [[nodiscard]] std::size_t nq() const { return definition.coordinates.size(); }
  [[nodiscard]] RobotExpressions* robot() const { return model.robot_expressions_.get(); }  // null without a robot

  // names
  /// Complains of what is no name, or one that something has already.
  void declare(const std::string& name, const TomlValue& at);
  /// What goes behind "choose another" where names are those of the robot's file; else nothing.
  [[nodiscard]] const char* way_to_rename() const;
  /// From now on coordinates, velocities, accelerations, t, inputs and parameters may stand in expressions.
  void define_symbols();
  /// A name that stands for an expression from now on.
  void define(const std::string& name, Expression value) { model.define(name, value); }
  std::map<std::string, Expression, std::less<>>& defined() { return model.symbols_; }
  /// Names that messages about an unknown one suggest from.
  std::vector<std::string>& suggested_names() { return model.symbol_names_; }

  /// The rows of a matrix.
  [[nodiscard]] std::vector<TomlValue> rows_per_coordinate(const TomlValue& matrix) const;

  // expressions, as text or as a number
  /// @param rule  why none of `forbidden` may stand in it
  [[nodiscard]] Expression expression_without(const TomlValue& value, const std::vector<Expression>& forbidden,
                                              const char* rule) const;
  /// Of the state, of parameters, and of the multipliers of the system, which is read already: of λ₀ or of λ, but not of both.
  /// @param multiplier  the first that the function read, of which this is an entry; empty: none yet
  [[nodiscard]] Expression expression_with_multipliers(const TomlValue& value, std::string& multiplier, const char* rule) const;
  /// Of the state, of parameters and of λ₀.
  [[nodiscard]] Expression feature(const TomlValue& value) const;
  /// The points of the robot are left as they are.
  [[nodiscard]] Expression unexpanded(const TomlValue& value, const std::vector<Expression>& forbidden = {}) const;
  [[nodiscard]] Expression parsed(const TomlValue& value, const std::vector<Expression>& forbidden,
                                  decltype(parse_expression)& parse) const;
  [[nodiscard]] Expression parsed(const std::string& text, decltype(parse_expression)& parse = parse_expression) const {
    return model.parse_symbols(text, {}, parse);
  }
  /// As the file has it.
  [[nodiscard]] static std::string text_of(const TomlValue& value, Expression e) {
    return value.is_text() ? value.text() : to_string(e);
  }
  void refuse_multipliers(const TomlValue& value, Expression e) const;
  void allow_only(const TomlValue& value, Expression e, const std::vector<Expression>& forbidden, const char* rule) const;
  /// What changes while coordinates, t and parameters do not: dq, ddq and u.
  [[nodiscard]] std::vector<Expression> of_motion() const;
  [[nodiscard]] std::vector<Expression> accelerations_and_inputs() const;
  [[nodiscard]] ConstraintRow derive(ConstraintRow::Level level, Expression c, std::string text) const;

 private:
  [[nodiscard]] Expression expanded(const TomlValue& value, const std::vector<Expression>& forbidden) const;
  [[nodiscard]] std::vector<std::string> multipliers_of(Expression e) const;

  std::set<std::string> names_ = {"t"};
};

// The readers of one key or table.
void read_robot(ModelReader& reader, const RobotSource& robot);
void read_coordinates(ModelReader& reader);
void read_inputs(ModelReader& reader, const TomlValue& inputs);
void read_parameters(ModelReader& reader, const TomlValue& parameters);
void read_let(ModelReader& reader, const TomlValue& let);
void read_mechanics(ModelReader& reader);
void read_constraints(ModelReader& reader);
void read_latents(ModelReader& reader);
void read_noise(ModelReader& reader, const TomlValue& noise);
void read_truth(ModelReader& reader, const TomlValue& truth);
void read_sampling(ModelReader& reader, const TomlValue& sampling);
void read_motion(ModelReader& reader, const TomlValue& motion);
void read_columns(ModelReader& reader, const TomlValue& columns);
void read_units(ModelReader& reader, const TomlValue& units);
void read_drawing(ModelReader& reader, const TomlValue& drawing);

/// A log or a prediction of the coordinate x has columns x_std, ddx_std, abar_x, … beside those of x itself, and a simulated motion
/// has columns energy, lambda1, … beside those of the state.
void refuse_names_of_other_columns(const ModelReader& reader);
/// Parameters that follow from others stand for their expressions wherever they are used.
void read_derived_parameters(ModelReader& reader, const TomlValue& parameters);
/// lambda(NAME) is lambda(i) of the row i that is called so.
void declare_constraint_names(ModelReader& reader);
void ask_code_for_mechanics(ModelReader& reader);
void check_mass_symmetry(const ModelReader& reader);
void read_potential(ModelReader& reader);

/// force = [ … ], one per coordinate, with a robot one per axis of its joints, and force_on = { 'site("tip").x' = … }: a force
/// along a quantity r acts on the coordinates as (∂r/∂q)ᵀ force.
/// @param multiplier  as for expression_with_multipliers; null: none may stand there
std::vector<Expression> read_forces(const ModelReader& reader, const TomlValue& table, std::string* multiplier = nullptr);

/// Positions of entries, each after those whose names it uses; complains of a circle.
/// @param words  of each entry
/// @param fault  of an entry in a circle: "defined in terms of itself"
std::vector<std::size_t> positions_by_use(const std::vector<std::pair<std::string, TomlValue>>& entries,
                                          const std::vector<std::vector<std::string>>& words, const char* fault);

/// mass('link7') as the number of a robot is called: mass("link7").
std::string robot_number_name(std::string_view written);

}  // namespace gp2
