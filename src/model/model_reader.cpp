#include "model/model_reader.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>
#include <set>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/random.hpp"
#include "base/suggestion.hpp"
#include "gp2/error.hpp"
#include "mechanics/known_multipliers.hpp"
#include "model/name_order.hpp"
#include "model/toml_reader.hpp"
#include "prior/gradient_columns.hpp"
#include "prior/make_prior.hpp"
#include "robots/robot_expressions.hpp"

namespace gp2 {

using Level = ConstraintRow::Level;

namespace {

// mass('link7') -> mass("link7")
std::string robot_number_name(std::string written) {
  std::replace(written.begin(), written.end(), '\'', '"');
  std::erase(written, ' ');
  return written;
}

}  // namespace

/// Reads the tables of a model file one after the other; every complaint carries file, line and key.
class ModelReader : private TomlReader {
 public:
  ModelReader(const toml::table& root, const RobotSource& robot, Model& model)
      : TomlReader(model.name), root_(root), robot_source_(robot), model_(model) {}

  void read() {
    only_keys(root_, "",
              {"name", "robot", "coordinates", "inputs", "parameters", "let", "mechanics", "constraints", "latent", "noise",
               "truth", "sampling", "motion", "columns", "units", "drawing"});
    definition_.graph = model_.graph = std::make_shared<ExpressionGraph>();
    definition_.name = root_.contains("name") ? text(*root_.get("name"), "name") : model_.name;
    read_robot();
    read_coordinates();
    read_inputs();
    refuse_names_of_other_columns();
    read_parameters();
    declare_symbols();
    read_derived_parameters();
    declare_rows();
    read_let();
    if (model_.code.mechanics) {
      ask_for_mechanics();
    } else {
      read_mechanics();
      read_constraints();
      model_.system = std::make_shared<const SymbolicSystem>(definition_);
      if (mass_node_ != nullptr) check_mass_symmetry();
    }
    read_latents();
    require_all_code_is_used();
    read_noise();
    read_truth();
    read_sampling();
    read_motion();
    read_columns();
    read_units();
    // last, so that M, A, b and F are built the same way with these and without
    if (!model_.code.mechanics) read_potential();
    read_drawing();
  }

 private:
  // an expression given as text or as a number, which by some rule does not depend on the forbidden symbols
  Expression expression_without(const toml::node& node, const std::string& key, const std::vector<Expression>& forbidden,
                                const char* rule) const {
    const Expression value = expanded(node, key, forbidden);
    refuse_load(node, key, value);
    allow_only(node, key, value, forbidden, rule);
    return value;
  }

  // of the state, of parameters, and of λ₀ of the system, which is read already
  Expression expression_with_load(const toml::node& node, const std::string& key, const char* rule) const {
    const Expression value = expanded(node, key, symbols_->ddq);
    for (const std::string& load : loads_of(value)) {
      if (const auto fault = row_fault(load, model_.system->nc())) fail(node, key, *fault);
    }
    allow_only(node, key, value, symbols_->ddq, rule);
    return value;
  }

  Expression expanded(const toml::node& node, const std::string& key, const std::vector<Expression>& forbidden) const {
    const Expression value = unexpanded(node, key, forbidden);
    return robot() ? robot()->expand(value) : value;
  }

  [[nodiscard]] std::vector<std::string> loads_of(Expression e) const {
    std::vector<std::string> loads = definition_.graph->variables_of(e);
    std::erase_if(loads, [](const std::string& variable) { return !is_multiplier(variable); });
    return loads;
  }

  void refuse_load(const toml::node& node, const std::string& key, Expression e) const {
    for (const std::string& load : loads_of(e)) {
      fail(node, key,
           fmt::format("{} follows from M, F and the constraints, so that it may stand in features, directions, [truth] and "
                       "[let] only",
                       load));
    }
  }

  // the points of the robot left as they are
  Expression unexpanded(const toml::node& node, const std::string& key, const std::vector<Expression>& forbidden = {}) const {
    if (node.is_number()) return definition_.graph->constant(number(node, key));
    if (!node.is_string()) fail(node, key, fmt::format("expected an expression in quotes, or a number, got {}", written(node)));
    return parsed(node, key, forbidden, parse_expression);
  }

  Expression parsed(const toml::node& node, const std::string& key, const std::vector<Expression>& forbidden,
                    decltype(parse_expression)& parse) const {
    try {
      return model_.parse_symbols(text(node, key), forbidden, parse);
    } catch (const InputError& error) {
      fail(node, key, fmt::format("\"{}\", {}", shortened(text(node, key)), error.what()));
    }
  }

  // what changes while coordinates, t and parameters do not
  [[nodiscard]] std::vector<Expression> of_motion() const {
    std::vector<Expression> symbols = symbols_->dq;
    for (const auto* group : {&symbols_->ddq, &symbols_->u}) symbols.insert(symbols.end(), group->begin(), group->end());
    return symbols;
  }

  // null without a robot
  [[nodiscard]] const std::shared_ptr<RobotExpressions>& robot() const { return model_.robot_expressions_; }

  void declare(const std::string& name, const toml::node& node, const std::string& key) {
    static const std::set<std::string> reserved = {"pi",    "sin",  "cos",  "tan",  "asin",   "acos", "atan",
                                                   "atan2", "sinh", "cosh", "tanh", "exp",    "log",  "sqrt",
                                                   "abs",   "sign", "min",  "max",  "lambda0"};
    if (!is_identifier(name)) {
      fail(node, key, fmt::format("'{}' is not a name: use letters, digits and _, beginning with a letter", name));
    }
    if (reserved.contains(name)) fail(node, key, fmt::format("'{}' is the name of a function or constant; choose another", name));
    if (!names_.insert(name).second) fail(node, key, fmt::format("the name '{}' is taken already; choose another", name));
  }

  void read_robot() {
    if (!root_.contains("robot")) return;
    const toml::node& node = *root_.get("robot");
    if (model_.code.mechanics) fail(node, "robot", "the mechanics of this model are given as code: remove it");
    try {
      model_.robot = robot_source_(text(node, "robot"));
    } catch (const InputError& error) {
      fail(node, "robot", error.what());
    }
    if (model_.robot->joints().empty()) fail(node, "robot", "this robot has no joints: there is nothing that moves");
  }

  // the joints of the robot, unless the file has names of its own for them
  void take_coordinates_of_robot() {
    const toml::node& node = *root_.get("robot");
    for (const std::string& coordinate : model_.robot->coordinates()) {
      if (!is_identifier(coordinate)) {
        fail(node, "robot",
             fmt::format("its joint '{}' has a name that cannot stand in an expression: give names of your own, one "
                         "per joint in the order of the file, with coordinates = [\"q1\", …]",
                         coordinate));
      }
      declare_coordinate({coordinate, false}, node, "robot");
    }
  }

  void declare_coordinate(const Coordinate& coordinate, const toml::node& node, const std::string& key) {
    declare(coordinate.name, node, key);
    declare(coordinate.velocity(), node, key);
    declare(coordinate.acceleration(), node, key);
    definition_.coordinates.push_back(coordinate);
  }

  void read_coordinates() {
    names_.insert("t");
    if (!root_.contains("coordinates")) {
      if (!model_.robot) fail(1, "coordinates", R"(missing; write coordinates = ["q1", "q2"])");
      take_coordinates_of_robot();
      return;
    }
    const toml::node& node = *root_.get("coordinates");
    for (const toml::node& entry : array(node, "coordinates")) {
      Coordinate coordinate;
      if (entry.is_table()) {
        only_keys(*entry.as_table(), "coordinates", {"name", "angle"});
        if (!entry.as_table()->contains("name")) fail(entry, "coordinates", R"(expected { name = "q1", angle = true })");
        coordinate.name = text(*entry.as_table()->get("name"), "coordinates.name");
        if (entry.as_table()->contains("angle")) coordinate.angle = boolean(*entry.as_table()->get("angle"), "coordinates.angle");
      } else {
        coordinate.name = text(entry, "coordinates");
      }
      declare_coordinate(coordinate, entry, "coordinates");
    }
    if (definition_.coordinates.empty()) fail(node, "coordinates", "a system needs at least one coordinate");
    if (!model_.robot) return;
    const std::vector<std::string> of_robot = model_.robot->coordinates();
    if (of_robot.size() != definition_.coordinates.size()) {
      fail(node, "coordinates",
           fmt::format("{} names for the {} coordinates of the robot; they are, in this order: {}",
                       definition_.coordinates.size(), of_robot.size(), fmt::join(of_robot, ", ")));
    }
  }

  void read_inputs() {
    if (!root_.contains("inputs")) return;
    for (const toml::node& entry : array(*root_.get("inputs"), "inputs")) {
      const toml::table* const more = entry.as_table();
      if (more != nullptr) only_keys(*more, "inputs", {"name", "delay", "lag"});
      if (more != nullptr && !more->contains("name"))
        fail(entry, "inputs", R"(expected { name = "u", delay = 0.02, lag = 0.05 })");
      definition_.inputs.push_back(more != nullptr ? text(*more->get("name"), "inputs.name") : text(entry, "inputs"));
      declare(definition_.inputs.back(), entry, "inputs");
      Actuator& actuator = model_.actuators.emplace_back(Actuator::direct(definition_.inputs.back()));
      if (more == nullptr) continue;
      read_lateness(*more, "delay", actuator.delay);
      read_lateness(*more, "lag", actuator.lag);
    }
  }

  // delay = 0.02, or { value = 0.02, bounds = [0, 0.1], estimate = true }
  void read_lateness(const toml::table& input, const std::string& word, Parameter& out) const {
    if (!input.contains(word)) return;
    const toml::node& node = *input.get(word);
    const std::string key = "inputs." + word;
    const Tuned entry = tuned(node, key, {"value", "bounds", "estimate", "prior"});
    if (entry.value != nullptr) out.value = number(*entry.value, entry.key);
    const auto require_not_negative = [&](double seconds) {
      if (seconds >= 0) return;
      fail(node, key, fmt::format("a {} [s] must not be negative, got {}: nothing acts before it is commanded", word, seconds));
    };
    require_not_negative(out.value);
    out.estimate = entry.estimate.value_or(false);
    out.bounds = entry.bounds;
    if (out.bounds) require_not_negative(out.bounds->first);
    require_within(out.value, out.bounds, node, key);
    out.prior = entry.prior;
  }

  // A log or a prediction of the coordinate x has columns x_std, ddx_std, abar_x, … beside those of x itself.
  void refuse_names_of_other_columns() {
    const auto refuse = [&](const std::string& column, const std::string& of) {
      if (!names_.contains(column)) return;
      const char* key = root_.contains("coordinates") ? "coordinates" : "inputs";
      fail(
          1, key,
          fmt::format("the column {} would be a name of this model and what logs and predictions call a quantity of '{}'; choose "
                      "another name",
                      column, of));
    };
    for (const Coordinate& coordinate : definition_.coordinates) {
      for (const std::string& name : {coordinate.name, coordinate.velocity(), coordinate.acceleration()}) {
        refuse(name + "_std", coordinate.name);
      }
      refuse(coordinate.velocity() + "_next", coordinate.name);
      for (const char* prefix : {"abar_", "fc_"}) refuse(prefix + coordinate.name, coordinate.name);
    }
  }

  void read_parameters() {
    if (!root_.contains("parameters")) return;
    for (const auto& [name, node] : entries_of(table(*root_.get("parameters"), "parameters"))) {
      const std::string key = fmt::format("parameters.{}", name);
      declare(name, *node, key);
      if (node->is_string()) continue;  // follows from others
      refuse_text_among_keys(*node, name, key);
      const Tuned entry = tuned(*node, key, {"value", "bounds", "estimate", "of", "prior"});
      Parameter parameter{name, 0, entry.bounds, entry.estimate.value_or(false), entry.prior};
      const toml::table* const more = node->as_table();
      const bool is_of_robot = more != nullptr && more->contains("of");
      if (is_of_robot) parameter.value = read_robot_number(*more->get("of"), key + ".of", name);
      if (entry.value != nullptr) {
        parameter.value = number(*entry.value, entry.key);
      } else if (!is_of_robot) {
        fail(*node, key, "missing value; write { value = 1.0, bounds = [0.5, 2.0], estimate = true }");
      }
      require_within(parameter.value, entry.bounds, *node, key);
      definition_.parameters.push_back(parameter);
    }
  }

  // I2 = { value = "2*m", … }
  void refuse_text_among_keys(const toml::node& node, const std::string& name, const std::string& key) const {
    const toml::table* const entry = node.as_table();
    if (entry == nullptr || !entry->contains("value") || !entry->get("value")->is_string()) return;
    fail(
        node, key,
        fmt::format("a parameter that follows from others has no bounds, no prior and no estimate of its own: write {} = \"{}\", "
                    "and say of those others what is to be estimated",
                    name, shortened(entry->get("value")->as_string()->get())));
  }

  // Parameters that follow from others stand for their expressions wherever they are used.
  void read_derived_parameters() {
    if (!root_.contains("parameters")) return;
    auto entries = entries_of(table(*root_.get("parameters"), "parameters"));
    std::erase_if(entries, [](const auto& entry) { return !entry.second->is_string(); });
    const std::vector<Parameter>& parameters = definition_.parameters;
    std::map<std::string, Expression> values;
    for (const Parameter& parameter : parameters) values.emplace(parameter.name, model_.graph->constant(parameter.value));
    // to suggest from are parameters only
    const std::vector<std::string> all_names = model_.symbol_names_;
    model_.symbol_names_.clear();
    for (const Parameter& parameter : parameters) model_.symbol_names_.push_back(parameter.name);
    define_in_order(entries, "parameters", [&](const std::string& name, const toml::node& node, const std::string& key) {
      const Expression expression = unexpanded(node, key);
      refuse_load(node, key, expression);
      allow_only(node, key, expression, symbols_->state(), "a parameter may follow from other parameters only");
      allow_only(node, key, expression, symbols_->ddq, "a parameter may follow from other parameters only");
      const Expression value = model_.graph->substitute(expression, values);
      if (!value.is_constant()) fail(node, key, "its value is no finite number where the other parameters have theirs");
      model_.derived_parameters.push_back({name, text(node, key), expression, value.constant_value()});
      return expression;
    });
    model_.symbol_names_ = all_names;
    for (const Model::DerivedParameter& derived : model_.derived_parameters) model_.symbol_names_.push_back(derived.name);
  }

  // A number that a fit may adjust, or several that go together, as the file states it: alone, or as a table.
  struct Tuned {
    const toml::node* value = nullptr;  // null: not given
    std::string key;                    // of the value
    std::optional<std::pair<double, double>> bounds = std::nullopt;
    std::optional<bool> estimate = std::nullopt;
    std::optional<Parameter::Belief> prior = std::nullopt;
  };

  /// @param keys  that its table may have; "initial", where it is among them, is another word for "value", bounds may be equal
  ///   and priors are of logarithms
  /// @param has_one_range  of bounds; else the caller reads them
  Tuned tuned(const toml::node& node, const std::string& key, const std::vector<std::string>& keys,
              bool has_one_range = true) const {
    if (!node.is_table()) return {&node, key};
    const toml::table& entry = *node.as_table();
    only_keys(entry, key, keys);
    const bool is_positive = std::find(keys.begin(), keys.end(), "initial") != keys.end();
    Tuned out;
    for (const char* word : {"value", "initial"}) {
      if (!entry.contains(word)) continue;
      if (out.value != nullptr) fail(entry, key, "value and initial are two words for one number: leave out one");
      out.value = entry.get(word);
      out.key = fmt::format("{}.{}", key, word);
    }
    if (entry.contains("bounds") && has_one_range) out.bounds = range(*entry.get("bounds"), key + ".bounds", is_positive);
    if (entry.contains("estimate")) out.estimate = boolean(*entry.get("estimate"), key + ".estimate");
    if (out.bounds && out.bounds->first == out.bounds->second && out.estimate.value_or(false)) {
      fail(node, key, fmt::format("its bounds [{0}, {0}] hold it: widen them, or leave out estimate = true", out.bounds->first));
    }
    if (entry.contains("prior")) out.prior = belief(*entry.get("prior"), key + ".prior", !is_positive);
    return out;
  }

  using Bounds = std::optional<std::pair<double, double>>;
  void require_within(double value, const Bounds& bounds, const toml::node& node, const std::string& key) const {
    if (!bounds || (value >= bounds->first && value <= bounds->second)) return;
    fail(node, key, fmt::format("the value {} is outside its bounds [{}, {}]", value, bounds->first, bounds->second));
  }

  // { mean = 2, stddev = 0.1 } of a parameter, or { median = 2, log_stddev = 0.1 } of one that is positive
  Parameter::Belief belief(const toml::node& node, const std::string& key, bool normal_too = true) const {
    const toml::table& entry = table(node, key);
    Parameter::Belief out;
    out.of_logarithm = !normal_too || !entry.contains("mean");
    const std::array<const char*, 2> keys = {out.of_logarithm ? "median" : "mean", out.of_logarithm ? "log_stddev" : "stddev"};
    only_keys(entry, key, {keys[0], keys[1]});
    for (const char* name : keys) {
      if (entry.contains(name)) continue;
      fail(node, key,
           fmt::format("missing {}; write {}{{ median = 2.0, log_stddev = 0.1 }}, the second of its logarithm", name,
                       normal_too ? "{ mean = 2.0, stddev = 0.1 }, or, of a positive one, " : ""));
    }
    out.median = number(*entry.get(keys[0]), fmt::format("{}.{}", key, keys[0]));
    out.stddev = number(*entry.get(keys[1]), fmt::format("{}.{}", key, keys[1]));
    if (!(out.stddev > 0)) fail(node, key, fmt::format("{} must be positive, got {}", keys[1], out.stddev));
    if (out.of_logarithm && !(out.median > 0)) fail(node, key, fmt::format("median must be positive, got {}", out.median));
    return out;
  }

  // mass("link7") or com('link7').x: a number of the robot that is this parameter from now on; gives the robot's own value
  double read_robot_number(const toml::node& node, const std::string& key, const std::string& parameter) {
    const std::string of = robot_number_name(text(node, key));
    if (!model_.robot) fail(node, key, "only a model with a robot = \"FILE\" has such numbers; give a value instead");
    const auto [other, is_new] = robot_parameters_.emplace(of, parameter);
    if (!is_new) fail(node, key, fmt::format("{} is the parameter '{}' already", of, other->second));
    for (const auto& [name, value] : robot_numbers(*model_.robot)) {
      if (name == of) return value;
    }
    std::vector<std::string> bodies, joints;
    for (const RobotDescription::Body& body : model_.robot->bodies) bodies.push_back(body.name);
    for (const RobotDescription::Joint* joint : model_.robot->joints()) joints.push_back(joint->name);
    fail(node, key,
         fmt::format(
             "the robot has no number '{}'; there are mass(\"BODY\"), com(\"BODY\").x, inertia(\"BODY\").xx with the bodies {}, "
             "and damping(\"JOINT\"), stiffness, friction, armature with the joints {}",
             shortened(of), fmt::join(bodies, ", "), fmt::join(joints, ", ")));
  }

  void declare_symbols() {
    symbols_.emplace(*definition_.graph, definition_.coordinates, definition_.inputs, definition_.parameters);
    if (model_.robot) {
      std::map<std::string, Expression> numbers;
      for (const auto& [of, parameter] : robot_parameters_) numbers.emplace(of, definition_.graph->variable(parameter));
      model_.robot_expressions_ =
          std::make_shared<RobotExpressions>(*model_.robot, *definition_.graph, *symbols_, std::move(numbers));
    }
    for (Expression symbol : symbols_->state_and_parameters()) model_.define(symbol.variable_name(), symbol);
    for (Expression symbol : symbols_->ddq) model_.define(symbol.variable_name(), symbol);
  }

  void read_let() {
    if (!root_.contains("let")) return;
    const auto entries = entries_of(table(*root_.get("let"), "let"));
    for (const auto& [name, node] : entries) declare(name, *node, fmt::format("let.{}", name));
    define_in_order(entries, "let",
                    [&](const std::string&, const toml::node& node, const std::string& key) { return unexpanded(node, key); });
  }

  // Names may stand in any order and use each other, but not in a circle.
  /// @param read  the expression of an entry, when those it uses are defined
  template <class Entries, class Read>
  void define_in_order(const Entries& entries, const char* section, const Read& read) {
    const auto key_of = [&](const std::string& name) { return fmt::format("{}.{}", section, name); };
    std::map<std::string, std::size_t> position;
    for (const auto& entry : entries) position.emplace(entry.first, position.size());
    std::vector<std::vector<std::size_t>> uses;
    for (const auto& [name, node] : entries) {
      uses.emplace_back();
      if (!node->is_string()) continue;
      for (const std::string& word : words_of(node->as_string()->get())) {
        if (const auto other = position.find(word); other != position.end()) uses.back().push_back(other->second);
      }
    }
    const Order order = order_by_use(uses);
    if (!order.circle.empty()) {
      const auto& [name, node] = entries[order.circle.front()];
      fail(*node, key_of(name), "defined in terms of itself" + circle_text(order.circle, entries));
    }
    for (const std::size_t k : order.positions) {
      const auto& [name, node] = entries[k];
      model_.define(name, read(name, *node, key_of(name)));
    }
  }

  // ": a uses b uses a"
  template <class Entries>
  static std::string circle_text(const std::vector<std::size_t>& circle, const Entries& entries) {
    constexpr std::size_t enough = 8;
    std::string text = ": ";
    for (std::size_t k = 0; k < std::min(circle.size(), enough); ++k) text += fmt::format("{} uses ", entries[circle[k]].first);
    if (circle.size() > enough) text += "… uses ";
    return text + entries[circle.front()].first;
  }

  void ask_for_mechanics() {
    for (const char* key : {"mechanics", "constraints"}) {
      if (root_.contains(key)) {
        fail(*root_.get(key), key,
             fmt::format("the mechanics of this model are given as code: remove [{}], or read the file without that code", key));
      }
    }
    model_.system =
        model_.code.mechanics({definition_.name, definition_.coordinates, definition_.inputs, definition_.parameters});
    if (!model_.system) throw InputError("the code that is to give the mechanics returned no system");
    require_as_declared(*model_.system);
  }

  // the rest of the file speaks of what it declares itself
  void require_as_declared(const System& system) const {
    const auto require_same = [](const char* what, const std::string& declared, const std::string& got) {
      if (declared == got) return;
      throw InputError(
          fmt::format("the system that code returned has the {} {}, but this file declares {}; give it those of "
                      "the declaration",
                      what, got.empty() ? "(none)" : got, declared.empty() ? "(none)" : declared));
    };
    const auto coordinates = [](const std::vector<Coordinate>& all) {
      std::vector<std::string> names;
      for (const Coordinate& c : all) names.push_back(c.angle ? c.name + " (an angle)" : c.name);
      return fmt::format("{}", fmt::join(names, ", "));
    };
    const auto parameters = [](const std::vector<Parameter>& all) {
      std::vector<std::string> names;
      for (const Parameter& p : all) {
        names.push_back(fmt::format("{} = {}", p.name, p.value));
        if (p.bounds) names.back() += fmt::format(" in [{}, {}]", p.bounds->first, p.bounds->second);
        if (p.estimate) names.back() += " (estimated)";
      }
      return fmt::format("{}", fmt::join(names, ", "));
    };
    require_same("coordinates", coordinates(definition_.coordinates), coordinates(system.coordinates()));
    require_same("inputs", fmt::format("{}", fmt::join(definition_.inputs, ", ")),
                 fmt::format("{}", fmt::join(system.inputs(), ", ")));
    require_same("parameters", parameters(definition_.parameters), parameters(system.parameters()));
  }

  void read_mechanics() {
    if (!root_.contains("mechanics") && model_.robot) {
      take_mechanics_of_robot(nullptr);
      return;
    }
    if (!root_.contains("mechanics")) fail(1, "mechanics", "missing; a model needs [mechanics] with mass = [[…], …]");
    const toml::table& mechanics = table(*root_.get("mechanics"), "mechanics");
    if (model_.robot) {
      take_mechanics_of_robot(&mechanics);
      return;
    }
    only_keys(mechanics, "mechanics", {"mass", "force", "coriolis", "potential"});
    read_mass(mechanics);
    definition_.force = read_forces(mechanics, "mechanics");
    if (mechanics.contains("coriolis") && boolean(*mechanics.get("coriolis"), "mechanics.coriolis")) add_coriolis_force();
  }

  // Lagrange's equations: F_i −= Σ_j dM_ij/dt dq_j − ½ Σ_jk ∂M_jk/∂q_i dq_j dq_k
  void add_coriolis_force() {
    ExpressionGraph& graph = *model_.graph;
    const std::vector<Expression>&q = symbols_->q, &dq = symbols_->dq;
    const auto& M = definition_.mass;
    for (std::size_t i = 0; i < q.size(); ++i) {
      for (std::size_t j = 0; j < q.size(); ++j) {
        Expression rate = graph.differentiate(M[i][j], symbols_->t);
        Expression half = graph.constant(0);
        for (std::size_t k = 0; k < q.size(); ++k) {
          rate = rate + graph.differentiate(M[i][j], q[k]) * dq[k];
          half = half + graph.differentiate(M[j][k], q[i]) * dq[k];
        }
        definition_.force[i] = definition_.force[i] - (rate - graph.constant(0.5) * half) * dq[j];
      }
    }
  }

  void read_mass(const toml::table& mechanics) {
    const std::size_t nq = definition_.coordinates.size();
    if (!mechanics.contains("mass")) fail(mechanics, "mechanics", "missing mass = [[…], …]");
    mass_node_ = mechanics.get("mass");
    const toml::array& rows = array(*mass_node_, "mechanics.mass");
    if (rows.size() != nq) {
      fail(*mass_node_, "mechanics.mass", fmt::format("expected {} rows, one per coordinate, got {}", nq, rows.size()));
    }
    for (std::size_t i = 0; i < nq; ++i) {
      const std::string key = fmt::format("mechanics.mass row {}", i + 1);
      const toml::array& entries = array(*rows.get(i), key);
      if (entries.size() != nq) fail(entries, key, fmt::format("expected {} entries, got {}", nq, entries.size()));
      definition_.mass.emplace_back();
      for (std::size_t j = 0; j < nq; ++j) {
        const std::string entry_key = fmt::format("mechanics.mass row {} column {}", i + 1, j + 1);
        definition_.mass.back().push_back(expression_without(*entries.get(j), entry_key, of_motion(),
                                                             "the mass matrix may depend on coordinates, t and parameters only"));
      }
    }
  }

  // M and F are the robot's; inputs act on its joints one by one, unless [mechanics] says how they act
  void take_mechanics_of_robot(const toml::table* mechanics) {
    const std::size_t nq = definition_.coordinates.size();
    definition_.mass = robot()->mass();
    definition_.force = robot()->force();
    std::vector<Expression> applied(nq, definition_.graph->constant(0));
    if (mechanics != nullptr) {
      if (mechanics->contains("mass")) {
        fail(*mechanics->get("mass"), "mechanics.mass", "the mass matrix is the robot's: remove it, or remove robot = …");
      }
      only_keys(*mechanics, "mechanics", {"force", "force_on", "potential"});
      applied = read_forces(*mechanics, "mechanics");
    }
    const bool inputs_are_written = mechanics != nullptr && mechanics->contains("force");
    const std::vector<Expression>& u = symbols_->u;
    if (!inputs_are_written && !u.empty()) {
      if (u.size() != robot()->n_axes()) {
        fail(*root_.get("inputs"), "inputs",
             fmt::format("{} inputs for {} axes of joints: give one per axis, or say in [mechanics] force = [ … ] how they act",
                         u.size(), robot()->n_axes()));
      }
      const std::vector<Expression> of_inputs = robot()->on_coordinates(u);
      for (std::size_t j = 0; j < nq; ++j) applied[j] = applied[j] + of_inputs[j];
    }
    for (std::size_t j = 0; j < nq; ++j) definition_.force[j] = applied[j] + definition_.force[j];
  }

  // force = [ … ], one per coordinate, with a robot one per axis of its joints, and force_on = { 'site("tip").x' = … }: a force
  // along a quantity r acts on the coordinates as (∂r/∂q)ᵀ force
  std::vector<Expression> read_forces(const toml::table& entries, const std::string& section) const {
    const std::size_t nq = definition_.coordinates.size();
    // λ₀ is that of the known force
    const auto read = [&](const toml::node& node, const std::string& key) {
      return section == "truth" ? expression_with_load(node, key, "a force may not depend on accelerations")
                                : expression_without(node, key, symbols_->ddq, "a force may not depend on accelerations");
    };
    std::vector<Expression> forces(nq, definition_.graph->constant(0));
    if (entries.contains("force")) {
      const toml::node& node = *entries.get("force");
      const toml::array& force = array(node, section + ".force");
      const std::size_t n = robot() ? robot()->n_axes() : nq;
      if (force.size() != n) {
        fail(node, section + ".force",
             fmt::format("expected {} entries, one per {}, got {}", n, n == nq ? "coordinate" : "axis of the joints",
                         force.size()));
      }
      std::vector<Expression> given;
      for (std::size_t j = 0; j < n; ++j) given.push_back(read(*force.get(j), fmt::format("{}.force entry {}", section, j + 1)));
      forces = robot() ? robot()->on_coordinates(given) : given;
    }
    if (!entries.contains("force_on")) return forces;
    const toml::node& node = *entries.get("force_on");
    if (!robot()) fail(node, section + ".force_on", "only a model with a robot = \"FILE\" has points for a force to act on");
    for (const auto& [name, entry] : entries_of(table(node, section + ".force_on"))) {
      const std::string key = fmt::format("{}.force_on.{}", section, name);
      const Expression force = read(*entry, key);
      for (std::size_t j = 0; j < nq; ++j) forces[j] = forces[j] + robot_quantity(*entry, key, name).jacobian[j] * force;
    }
    return forces;
  }

  const RobotQuantity& robot_quantity(const toml::node& node, const std::string& key, const std::string& name) const {
    try {
      const Expression variable = model_.parse_symbols(name);
      if (variable.operation() == Operation::variable) return robot()->quantity(variable.variable_name());
    } catch (const InputError& error) {
      fail(node, key, error.what());
    }
    fail(node, key, "expected a point of the robot, such as 'site(\"tip\").x'");
  }

  void read_potential() {
    if (robot()) model_.potential = robot()->potential();
    if (!root_.contains("mechanics")) return;
    const toml::table& mechanics = *root_.get("mechanics")->as_table();
    if (!mechanics.contains("potential")) return;
    const toml::node& node = *mechanics.get("potential");
    const Expression potential = expression_without(node, "mechanics.potential", of_motion(),
                                                    "the potential may depend on coordinates, t and parameters only");
    model_.potential = model_.potential ? *model_.potential + potential : potential;
  }

  void read_drawing() {
    if (!root_.contains("drawing")) return;
    const toml::table& drawing = table(*root_.get("drawing"), "drawing");
    only_keys(drawing, "drawing", {"points", "lines"});
    if (!drawing.contains("points")) fail(drawing, "drawing", R"(missing points, as in points = { tip = ["x", "y"] })");
    Model::Drawing out;
    for (const auto& [name, node] : entries_of(table(*drawing.get("points"), "drawing.points"))) {
      const std::string key = fmt::format("drawing.points.{}", name);
      const toml::array& entries = array(*node, key);
      const std::size_t size = out.points.empty() ? entries.size() : out.points.front().size();
      if (entries.size() != size || size < 2 || size > 3) {
        fail(*node, key, fmt::format("expected two coordinates [m], or three, of every point alike, got {}", entries.size()));
      }
      out.names.push_back(name);
      out.points.emplace_back();
      for (const toml::node& entry : entries) {
        out.points.back().push_back(
            expression_without(entry, key, of_motion(), "a point may depend on coordinates, t and parameters only"));
      }
    }
    if (drawing.contains("lines")) {
      for (const toml::node& node : array(*drawing.get("lines"), "drawing.lines"))
        out.lines.push_back(line_through(node, out.names));
    }
    model_.drawing = std::move(out);
  }

  [[nodiscard]] std::vector<int> line_through(const toml::node& node, const std::vector<std::string>& points) const {
    std::vector<int> line;
    for (const toml::node& entry : array(node, "drawing.lines")) {
      const std::string name = text(entry, "drawing.lines");
      const auto found = std::find(points.begin(), points.end(), name);
      if (found == points.end())
        fail(entry, "drawing.lines", fmt::format("'{}' is none of drawing.points{}", name, suggestion(name, points)));
      line.push_back(static_cast<int>(found - points.begin()));
    }
    return line;
  }

  void allow_only(const toml::node& node, const std::string& key, Expression e, const std::vector<Expression>& forbidden,
                  const char* rule) const {
    const std::vector<std::string> used = definition_.graph->variables_of(e);
    for (Expression symbol : forbidden) {
      if (std::binary_search(used.begin(), used.end(), symbol.variable_name())) {
        fail(node, key, fmt::format("{}, but this entry depends on '{}'", rule, symbol.variable_name()));
      }
    }
  }

  // M = Mᵀ at random points, to rounding: entries may be written differently on the two sides
  void check_mass_symmetry() const {
    constexpr int n_points = 10;
    RandomStream random(1);
    Eigen::MatrixXd points(model_.system->layout().size(), n_points);
    for (double& value : points.reshaped()) value = 2 * random.uniform() - 1;
    const SystemValues values = model_.system->evaluate(points, model_.system->parameter_values());
    const auto entry = [&](Eigen::Index row, Eigen::Index column) {
      return written(
          *mass_node_->as_array()->get(static_cast<std::size_t>(row))->as_array()->get(static_cast<std::size_t>(column)));
    };
    for (int i = 0; i < n_points; ++i) {
      const auto M = values.M(i);
      for (Eigen::Index row = 0; row < M.rows(); ++row) {
        for (Eigen::Index column = 0; column < row; ++column) {
          // a positive definite M has M_rc² < M_rr M_cc
          const double size = std::max(std::abs(M(row, column)), std::sqrt(std::abs(M(row, row) * M(column, column))));
          if (std::abs(M(row, column) - M(column, row)) <= 1e-10 * size || !std::isfinite(size)) continue;
          fail(*mass_node_, "mechanics.mass",
               fmt::format("not symmetric: row {} column {} is {}, but row {} column {} is {}; write the same on both sides",
                           column + 1, row + 1, entry(column, row), row + 1, column + 1, entry(row, column)));
        }
      }
    }
  }

  ConstraintRow derive(Level level, Expression c, std::string text) const {
    if (!robot()) return derive_constraint(level, c, std::move(text), *symbols_);
    return robot()->derive_constraint(level, c, std::move(text), definition_.coordinates, definition_.inputs,
                                      definition_.parameters);
  }

  // what derive_constraint refuses
  [[nodiscard]] std::vector<Expression> forbidden_in(Level level) const {
    if (level == Level::position) return of_motion();
    if (level == Level::acceleration) return {};
    std::vector<Expression> symbols = symbols_->ddq;
    symbols.insert(symbols.end(), symbols_->u.begin(), symbols_->u.end());
    return symbols;
  }

  // calls f(level, entry, key) for each constraint of the file, in the order of the rows
  template <class Function>
  void for_each_constraint(Function f) const {
    if (!root_.contains("constraints")) return;
    const toml::table& constraints = table(*root_.get("constraints"), "constraints");
    only_keys(constraints, "constraints", {"position", "velocity", "acceleration"});
    const std::pair<const char*, Level> levels[] = {
        {"position", Level::position}, {"velocity", Level::velocity}, {"acceleration", Level::acceleration}};
    for (const auto& [level_name, level] : levels) {
      if (!constraints.contains(level_name)) continue;
      const toml::array& rows = array(*constraints.get(level_name), fmt::format("constraints.{}", level_name));
      for (std::size_t k = 0; k < rows.size(); ++k)
        f(level, *rows.get(k), fmt::format("constraints.{} entry {}", level_name, k + 1));
    }
  }

  // lambda(NAME) is lambda(i) of the row i that is called so
  void declare_rows() {
    if (model_.code.mechanics) return;
    std::size_t row = 0;
    for_each_constraint([&](Level, const toml::node& entry, const std::string& key) {
      ++row;
      const toml::node* const node = entry.is_table() ? entry.as_table()->get("name") : nullptr;
      if (node == nullptr) return;
      const std::string name = text(*node, key + ".name");
      declare(name, *node, key + ".name");
      const std::size_t of_robot = robot() ? robot()->constraints().size() : 0;
      for (const char* symbol : {"lambda0", "lambda"}) {
        const Expression multiplier = definition_.graph->variable(fmt::format("{}({})", symbol, of_robot + row));
        model_.symbols_.emplace(fmt::format("{}({})", symbol, name), multiplier);
      }
    });
  }

  void read_constraints() {
    if (robot()) {
      for (auto& [c, name] : robot()->constraints())
        definition_.constraints.push_back(derive(Level::position, c, std::move(name)));
    }
    for_each_constraint([&](Level level, const toml::node& entry, const std::string& key) {
      definition_.constraints.push_back(read_constraint(level, entry, key));
    });
  }

  // "c", or { expr = "c", noise = 0.05, when = "gap <= 0" }, or { expr = "c", contact = "touch", restitution = 0.8 }
  ConstraintRow read_constraint(Level level, const toml::node& entry, const std::string& key) const {
    if (!entry.is_table()) return read_exact_constraint(level, entry, key);
    const toml::table& more = *entry.as_table();
    only_keys(more, key, {"expr", "name", "noise", "when", "contact", "restitution"});
    if (!more.contains("expr") || more.size() < 2) {
      fail(entry, key,
           "expected { expr = \"dx*sin(heading) - dy*cos(heading)\", noise = 0.05 }, or when = \"gap <= 0\", or contact = "
           "\"touch\" in the place of noise");
    }
    ConstraintRow row = read_exact_constraint(level, *more.get("expr"), key);
    if (more.contains("noise")) {
      row.noise = number(*more.get("noise"), key + ".noise");
      if (row.noise < 0) fail(*more.get("noise"), key + ".noise", "a standard deviation must not be negative");
    }
    if (more.contains("when")) {
      const toml::node& when = *more.get("when");
      switch_constraint(row, read_condition(when, key + ".when"), text(when, key + ".when"));
    }
    read_contact(level, more, key, row);
    return row;
  }

  // contact = "touch", an input that is 1 in contact and 0 apart, and restitution
  void read_contact(Level level, const toml::table& more, const std::string& key, ConstraintRow& row) const {
    if (!more.contains("contact")) {
      if (more.contains("restitution")) {
        fail(*more.get("restitution"), key + ".restitution", "belongs to a contact: name its input, contact = \"touch\"");
      }
      return;
    }
    const toml::node& node = *more.get("contact");
    const std::string name = text(node, key + ".contact");
    const auto input = std::find(definition_.inputs.begin(), definition_.inputs.end(), name);
    if (input == definition_.inputs.end()) {
      fail(node, key + ".contact",
           fmt::format("'{0}' is no input of this model: declare inputs = [\"{0}\"], which is 1 in contact and 0 apart",
                       shortened(name)));
    }
    if (level != Level::position) fail(node, key + ".contact", "a contact is a gap, of position level: write it in position");
    if (more.contains("when")) fail(node, key + ".contact", "says when the constraint is there: remove when");
    const auto index = static_cast<std::size_t>(input - definition_.inputs.begin());
    const bool is_taken =
        std::any_of(definition_.constraints.begin(), definition_.constraints.end(),
                    [&](const ConstraintRow& one) { return one.contact && one.contact->input == static_cast<int>(index); });
    if (is_taken) fail(node, key + ".contact", fmt::format("'{}' is another contact's input: each needs its own", name));
    if (!model_.actuators[index].is_direct()) {
      fail(node, key + ".contact", fmt::format("'{}' is a contact, which has neither a delay nor a lag: remove them", name));
    }
    const std::string condition = name + " > 0.5";
    switch_constraint(row, model_.parse_symbols(condition, {}, parse_condition), condition);
    row.contact = {static_cast<int>(index), definition_.graph->constant(0)};
    if (!more.contains("restitution")) return;
    const toml::node& restitution = *more.get("restitution");
    std::vector<Expression> forbidden = symbols_->u;
    forbidden.insert(forbidden.end(), symbols_->ddq.begin(), symbols_->ddq.end());
    row.contact->restitution = expression_without(restitution, key + ".restitution", forbidden,
                                                  "a restitution may not depend on inputs or accelerations");
    const Expression& e = row.contact->restitution;
    if (e.is_constant() && !(e.constant_value() >= 0 && e.constant_value() <= 1)) {
      fail(restitution, key + ".restitution", fmt::format("must lie between 0 and 1, got {}", e.constant_value()));
    }
  }

  // Whether an input says that there is contact.
  [[nodiscard]] bool is_contact(const std::string& input) const {
    return std::any_of(definition_.constraints.begin(), definition_.constraints.end(), [&](const ConstraintRow& row) {
      return row.contact && definition_.inputs[static_cast<std::size_t>(row.contact->input)] == input;
    });
  }

  // "gap <= 0", of a state and parameters
  Expression read_condition(const toml::node& node, const std::string& key) const {
    const Expression active = parsed(node, key, symbols_->ddq, parse_condition);
    refuse_load(node, key, active);
    const Expression value = robot() ? robot()->expand(active) : active;
    allow_only(node, key, value, symbols_->ddq, "a condition may not depend on accelerations");
    if (value.is_constant(0)) fail(node, key, "never holds: remove the constraint");
    return value;
  }

  ConstraintRow read_exact_constraint(Level level, const toml::node& node, const std::string& key) const {
    const Expression c = unexpanded(node, key, forbidden_in(level));
    refuse_load(node, key, c);
    try {
      return derive(level, c, node.is_string() ? text(node, key) : to_string(c));
    } catch (const InputError& error) {
      fail(node, key, error.what());
    }
  }

  // A hyperparameter of a latent: equal bounds hold it at their value.
  /// @param relative  whether its values are factors of a default scale
  Latent::Range latent_range(const toml::node& node, const std::string& key, bool relative) const {
    const Tuned entry = tuned(node, key, {"value", "initial", "bounds", "estimate", "prior"});
    const auto require_positive = [&](const toml::node& at, const std::string& at_key, double value) {
      if (value > 0) return;
      if (!relative) fail(at, at_key, fmt::format("a lengthscale must be positive, got {}", value));
      fail(at, at_key, fmt::format("values are factors of the default scale and must be positive, got {}", value));
    };
    Latent::Range out;
    if (entry.bounds) {
      std::tie(out.lower, out.upper) = *entry.bounds;
      require_positive(node, key + ".bounds", out.lower);
    }
    if (entry.value != nullptr) {
      out.initial = number(*entry.value, entry.key);
      require_positive(*entry.value, entry.key, out.initial);
      require_within(out.initial, entry.bounds, node, key);
    }
    if (entry.prior) std::tie(out.median, out.log_stddev) = std::pair(entry.prior->median, entry.prior->stddev);
    if (node.is_table() && entry.estimate.value_or(true)) return out;
    const bool is_held = out.upper > 0 && out.lower == out.upper;
    if (out.initial == 0 && !is_held)
      fail(node, key, "estimate = false needs the value to hold: { value = 1, estimate = false }");
    if (out.initial > 0) out.lower = out.upper = out.initial;
    return out;
  }

  // Factors of a default scale.
  Latent::Range relative_range(const toml::table& latent, const std::string& name) const {
    if (!latent.contains(name)) return {};
    const toml::node& node = *latent.get(name);
    const std::string key = "latent." + name;
    if (!node.is_table()) {
      fail(node, key, fmt::format("expected a table such as {{ initial = 1, bounds = [0.1, 10] }}, got {}", written(node)));
    }
    return latent_range(node, key, true);
  }

  // "per direction", "shared", or { dx = 0.5, dz = { value = 2, bounds = [1, 4] } }, in the units of the features
  void read_lengthscales(const toml::node& node, LatentSpec& latent) const {
    const std::string section = "latent.lengthscales";
    std::vector<std::string> features;
    for (const std::string& feature : latent.features) {
      const std::vector<std::string> names =
          latent.feature_code ? std::vector<std::string>{feature} : expand_angle(feature, definition_.coordinates);
      features.insert(features.end(), names.begin(), names.end());
    }
    if (node.is_string()) {
      const std::string word = text(node, section);
      if (word != "shared" && word != "per direction") {
        fail(node, section,
             fmt::format(R"(expected "shared", "per direction" or a table such as {{ dx = 0.5 }}, got "{}")", shortened(word)));
      }
      latent.per_direction = word == "per direction";
      return;
    }
    const Kernel kernel = Kernel::parse(latent.kernel.empty() ? PriorOptions().kernel : latent.kernel, features);
    for (const auto& [name, entry] : entries_of(table(node, section))) {
      const std::string key = fmt::format("{}.{}", section, name);
      latent.lengthscales.emplace_back(name, latent_range(*entry, key, false));
      try {
        static_cast<void>(lengthscales_of(latent, kernel, features, definition_.coordinates));
      } catch (const InputError& error) {
        fail(*entry, key, error.what());
      }
    }
  }

  void read_latents() {
    if (!root_.contains("latent")) {
      add_default_latent();
      return;
    }
    if (root_.get("latent")->is_table())
      fail(*root_.get("latent"), "latent", "write [[latent]], with two brackets: there may be several");
    std::set<std::string> names;
    for (const toml::node& node : array(*root_.get("latent"), "latent")) {
      const toml::table& entry = table(node, "latent");
      only_keys(entry, "latent",
                {"name", "kernel", "features", "directions", "positive", "lengthscale", "lengthscales", "signal_stddev"});
      LatentSpec latent;
      latent.name =
          entry.contains("name") ? text(*entry.get("name"), "latent.name") : fmt::format("latent {}", model_.latents.size() + 1);
      if (!names.insert(latent.name).second) fail(node, "latent.name", fmt::format("'{}' is taken already", latent.name));
      if (latent.name == "discrepancy")
        fail(node, "latent.name", "'discrepancy' is the name of the latent that gp2 adds; take another");
      latent.kernel = entry.contains("kernel") ? text(*entry.get("kernel"), "latent.kernel") : "";
      if (entry.contains("features")) read_features(*entry.get("features"), latent);
      if (entry.contains("directions")) read_directions(*entry.get("directions"), latent);
      if (entry.contains("positive")) read_positive(*entry.get("positive"), latent);
      if (latent.features.empty()) {
        if (!latent.is_potential) fail(node, "latent", R"(missing features = ["q1", …])");
        for (const Coordinate& coordinate : definition_.coordinates) latent.features.push_back(coordinate.name);
      }
      if (latent.is_potential) require_potential(entry, node, latent);
      latent.lengthscale = relative_range(entry, "lengthscale");
      latent.signal_stddev = relative_range(entry, "signal_stddev");
      try {
        if (entry.contains("kernel")) static_cast<void>(Kernel::parse(latent.kernel, latent.features));
      } catch (const InputError& error) {
        fail(entry.contains("kernel") ? *entry.get("kernel") : node, "latent.kernel", error.what());
      }
      if (entry.contains("lengthscales")) read_lengthscales(*entry.get("lengthscales"), latent);
      if (latent.is_potential && latent.per_direction.value_or(false)) {
        fail(*entry.get("lengthscales"), "latent.lengthscales",
             "a potential is one function, whose lengthscales all directions share; leave \"per direction\" out");
      }
      model_.latents.push_back(std::move(latent));
    }
    if (model_.latents.empty()) add_default_latent();
  }

  // V(φ(q, t)), which the force −Jᵀ∇V is of
  void require_potential(const toml::table& entry, const toml::node& at, const LatentSpec& latent) const {
    const toml::node& features = entry.contains("features") ? *entry.get("features") : at;
    if (latent.feature_code) {
      fail(features, "latent.features", "a potential needs features that are expressions, so that they can be differentiated");
    }
    if (features.is_array()) {
      for (const toml::node& feature : array(features, "latent.features")) {
        const Expression value = expression_with_load(feature, "latent.features", "a feature may not depend on accelerations");
        refuse_load(feature, "latent.features", value);
        allow_only(feature, "latent.features", value, of_motion(), "a potential depends on coordinates and t alone");
      }
    }
    if (!entry.contains("kernel")) return;
    const toml::node& kernel = *entry.get("kernel");
    bool is_possible = false;
    try {
      is_possible = has_gradient(Kernel::parse(latent.kernel, latent.features));
    } catch (const InputError& error) {
      fail(kernel, "latent.kernel", error.what());
    }
    if (is_possible) return;
    fail(kernel, "latent.kernel",
         fmt::format("the kernel of a potential is a sum of se, matern52, rq and linear, got \"{}\"", shortened(latent.kernel)));
  }

  // [expressions], or { code = [names] }
  void read_features(const toml::node& node, LatentSpec& latent) const {
    const std::string key = "latent.features";
    std::set<std::string> expanded;
    const auto add = [&](const toml::node& entry, const std::string& feature, const std::vector<std::string>& names) {
      latent.features.push_back(feature);
      // lengthscales go by the names of features
      for (const std::string& name : names) {
        if (!expanded.insert(name).second) fail(entry, key, fmt::format("'{}' stands twice; remove one", name));
      }
    };
    if (node.is_table()) {
      latent.feature_code = code_of(node, key, latent.name, &ModelCode::OfLatent::features);
      for (const std::string& name : names_of_code(node, key)) add(node, name, {name});
    } else {
      for (const toml::node& entry : array(node, key)) {
        const Expression value = expression_with_load(entry, key, "a feature may not depend on accelerations");
        const std::string feature = written_expression(entry, key, value);
        add(entry, feature, expand_angle(feature, definition_.coordinates));
      }
    }
    if (latent.features.empty()) fail(node, key, "a latent needs at least one feature");
  }

  std::string written_expression(const toml::node& node, const std::string& key, Expression value) const {
    return node.is_string() ? text(node, key) : to_string(value);
  }

  // { code = [names] }: one name for each number or column that code gives
  std::vector<std::string> names_of_code(const toml::node& node, const std::string& key) const {
    const toml::table& entry = table(node, key);
    only_keys(entry, key, {"code"});
    if (!entry.contains("code")) fail(node, key, R"(expected { code = ["name", …] })");
    std::vector<std::string> names;
    for (const toml::node& name : array(*entry.get("code"), key + ".code")) names.push_back(text(name, key + ".code"));
    return names;
  }

  StateCode code_of(const toml::node& node, const std::string& key, const std::string& latent,
                    StateCode ModelCode::OfLatent::*part) const {
    const auto found = model_.code.latents.find(latent);
    if (found != model_.code.latents.end() && found->second.*part) return found->second.*part;
    fail(node, key, fmt::format("those of '{}' are code, and none is given: read the file where that code is", latent));
  }

  // what code gives, the file must leave to it
  void require_all_code_is_used() const {
    for (const auto& entry : model_.code.latents) {
      const std::string& name = entry.first;
      const auto found =
          std::find_if(model_.latents.begin(), model_.latents.end(), [&](const LatentSpec& one) { return one.name == name; });
      if (found == model_.latents.end())
        throw InputError(fmt::format("code is given for the latent '{}', but there is none", name));
      if (entry.second.features && !found->feature_code) {
        throw InputError(fmt::format("code is given for the features of the latent '{}', but the file has them", name));
      }
      if (entry.second.directions && !found->direction_code) {
        throw InputError(fmt::format("code is given for the directions of the latent '{}', but the file has them", name));
      }
    }
  }

  // one latent on the acceleration, over everything a state has but the time
  void add_default_latent() {
    LatentSpec latent;
    latent.name = "unconstrained acceleration";
    for (Expression symbol : symbols_->state()) {
      if (!(symbol == symbols_->t) && !is_contact(symbol.variable_name())) latent.features.push_back(symbol.variable_name());
    }
    model_.latents.push_back(std::move(latent));
  }

  // "acceleration", "force", [[…], …] (nq rows), or { force = [[…], …] }
  void read_directions(const toml::node& node, LatentSpec& latent) const {
    const std::string key = "latent.directions";
    const toml::node* matrix = &node;
    if (node.is_string()) {
      const std::string value = text(node, key);
      if (value != "acceleration" && value != "force" && value != "potential") {
        fail(node, key,
             fmt::format(R"(expected "acceleration", "force", "potential" or a matrix of expressions [[…], …], got "{}")",
                         shortened(value)));
      }
      latent.is_potential = value == "potential";
      latent.base = value != "acceleration" ? Latent::Base::force : Latent::Base::acceleration;
      return;
    }
    if (node.is_table() && !node.as_table()->contains("code")) {
      only_keys(*node.as_table(), key, {"force", "acceleration"});
      if (node.as_table()->size() != 1) fail(node, key, "expected { force = [[…], …] } or { acceleration = [[…], …] }");
      latent.base = node.as_table()->contains("force") ? Latent::Base::force : Latent::Base::acceleration;
      matrix = &node.as_table()->begin()->second;
    }
    if (matrix->is_table()) {
      latent.direction_code = code_of(*matrix, key, latent.name, &ModelCode::OfLatent::directions);
      latent.direction_names = names_of_code(*matrix, key);
      if (latent.direction_names.empty()) fail(*matrix, key, "directions that are code need a name for each column");
      return;
    }
    const toml::array& rows = array(*matrix, key);
    const std::size_t nq = definition_.coordinates.size();
    if (rows.size() != nq) fail(*matrix, key, fmt::format("expected {} rows, one per coordinate, got {}", nq, rows.size()));
    for (const toml::node& row_node : rows) {
      const toml::array& row = array(row_node, key);
      if (row.empty() || row.size() != array(*rows.get(0), key).size()) {
        fail(row_node, key, "every row needs the same number of entries, at least one");
      }
      latent.directions.emplace_back();
      for (const toml::node& entry : row) {
        const Expression value = expression_with_load(entry, key, "a direction may not depend on accelerations");
        latent.directions.back().push_back(written_expression(entry, key, value));
      }
    }
  }

  void read_positive(const toml::node& node, LatentSpec& latent) const {
    const std::string key = "latent.positive";
    latent.is_positive = boolean(node, key);
    if (!latent.is_positive || !latent.directions.empty() || latent.direction_code) return;
    fail(node, key, "a positive latent needs directions of its own, which it acts along: directions = { force = [[…], …] }");
  }

  void read_noise() {
    if (!root_.contains("noise")) return;
    const toml::table& noise = table(*root_.get("noise"), "noise");
    only_keys(noise, "noise", {"ddq"});
    if (!noise.contains("ddq")) return;
    const toml::node& node = *noise.get("ddq");
    const std::string key = "noise.ddq";
    Model::Noise& out = model_.noise;
    const toml::table* const more = node.as_table();
    if (more != nullptr && more->contains("floor")) out.floor = each_noise(*more->get("floor"), key + ".floor");
    if (more != nullptr && more->contains("bounds")) out.bounds = each_range(*more->get("bounds"), key + ".bounds");
    const Tuned entry = tuned(node, key, {"value", "initial", "bounds", "estimate", "floor"}, false);
    out.estimate = entry.estimate.value_or(false);
    if (entry.value == nullptr) {
      if (out.floor.empty() || out.estimate) fail(node, key, "missing initial: where the estimate starts");
      return;
    }
    out.stddev = each_noise(*entry.value, key);
    for (std::size_t j = 0; j < out.stddev.size(); ++j) {
      if (!out.bounds.empty()) require_within(out.stddev[j], out.bounds[j], node, key);
      if (out.floor.empty() || out.stddev[j] >= out.floor[j]) continue;
      fail(node, key, fmt::format("the value {} is below its floor {}", out.stddev[j], out.floor[j]));
    }
  }

  // One [lower, upper], or one per coordinate.
  std::vector<std::pair<double, double>> each_range(const toml::node& node, const std::string& key) const {
    const std::size_t nq = definition_.coordinates.size();
    const toml::array& entries = array(node, key);
    std::vector<std::pair<double, double>> ranges;
    const bool is_one = entries.empty() || !entries.get(0)->is_array();
    for (std::size_t j = 0; j < (is_one ? 1 : entries.size()); ++j) ranges.push_back(range(is_one ? node : *entries.get(j), key));
    if (is_one) ranges.resize(nq, ranges.front());
    if (ranges.size() != nq) {
      fail(node, key, fmt::format("expected one range or {}, one per coordinate, got {}", nq, ranges.size()));
    }
    for (const auto& one : ranges) {
      if (!(one.first > 0)) fail(node, key, fmt::format("a noise standard deviation must be positive, got {}", one.first));
    }
    return ranges;
  }

  // One positive number, or one per coordinate.
  std::vector<double> each_noise(const toml::node& node, const std::string& key) const {
    const std::size_t nq = definition_.coordinates.size();
    std::vector<double> values;
    if (const toml::array* const entries = node.as_array()) {
      for (const toml::node& entry : *entries) values.push_back(number(entry, key));
      if (values.size() != nq) {
        fail(node, key, fmt::format("expected one value or {}, one per coordinate, got {}", nq, values.size()));
      }
    } else {
      values.assign(nq, number(node, key));
    }
    for (const double value : values) {
      if (!(value > 0)) fail(node, key, fmt::format("a noise standard deviation must be positive, got {}", value));
    }
    return values;
  }

  void read_truth() {
    if (!root_.contains("truth")) return;
    const toml::table& truth = table(*root_.get("truth"), "truth");
    only_keys(truth, "truth", {"acceleration", "force", "force_on"});
    if (truth.empty()) fail(truth, "truth", "missing acceleration = [ … ] or force = [ … ]");
    const std::size_t nq = definition_.coordinates.size();
    model_.truth.assign(nq, definition_.graph->constant(0));
    model_.truth_force = read_forces(truth, "truth");
    if (!truth.contains("acceleration")) return;
    const toml::array& rows = array(*truth.get("acceleration"), "truth.acceleration");
    if (rows.size() != nq) {
      fail(rows, "truth.acceleration", fmt::format("expected {} entries, one per coordinate, got {}", nq, rows.size()));
    }
    for (std::size_t j = 0; j < nq; ++j) {
      const toml::node& row = *rows.get(j);
      model_.truth[j] = expression_with_load(row, "truth.acceleration", "the true acceleration may not depend on itself");
    }
  }

  void read_sampling() {
    if (!root_.contains("sampling")) return;
    const toml::table& sampling = table(*root_.get("sampling"), "sampling");
    // names that are not of the state are auxiliary draws, visible to expressions here only
    std::set<std::string> drawable;
    for (Expression symbol : symbols_->state()) drawable.insert(symbol.variable_name());
    const auto visible = model_.symbols_;
    const auto visible_names = model_.symbol_names_;
    for (const auto& [name, node] : entries_of(sampling)) {
      if (name == "start" || drawable.contains(name)) continue;
      declare(name, *node, fmt::format("sampling.{}", name));
      model_.define(name, definition_.graph->variable(name));
    }

    std::vector<Model::SamplingRule> rules;
    for (const auto& [name, node] : entries_of(sampling)) {
      const std::string key = fmt::format("sampling.{}", name);
      if (name == "start") {
        model_.newton_start = read_start(table(*node, key), key);
        continue;
      }
      Model::SamplingRule rule{name, std::nullopt, {}, line_of(*node)};
      if (node->is_array()) {
        rule.range = range(*node, key);
      } else {
        rule.value = expression_without(*node, key, symbols_->ddq, "a sample may not depend on accelerations");
      }
      rules.push_back(std::move(rule));
    }
    model_.symbols_ = visible;
    model_.symbol_names_ = visible_names;
    sort_rules(std::move(rules));
  }

  // where coordinates and velocities begin
  std::map<std::string, double> read_start(const toml::table& start, const std::string& section) const {
    std::map<std::string, double> values;
    for (const auto& [name, node] : entries_of(start)) {
      const std::string key = fmt::format("{}.{}", section, name);
      const bool known = std::any_of(definition_.coordinates.begin(), definition_.coordinates.end(),
                                     [&name = name](const Coordinate& c) { return c.name == name || c.velocity() == name; });
      if (!known) fail(*node, key, fmt::format("'{}' is neither a coordinate nor a velocity of this model", name));
      values[name] = number(*node, key);
    }
    return values;
  }

  void read_motion() {
    if (!root_.contains("motion")) return;
    const toml::table& entries = table(*root_.get("motion"), "motion");
    only_keys(entries, "motion",
              {"rate", "segment", "profile", "natural_frequency", "damping_ratio", "targets", "hold", "start"});
    if (root_.contains("sampling")) {
      fail(entries, "motion", "states are drawn by [sampling] or met on the way by [motion]: remove one of the two");
    }
    if (model_.code.mechanics) fail(entries, "motion", "only a model with its mechanics as text can be driven: remove it");
    if (definition_.inputs.empty())
      fail(entries, "motion", "a model without inputs cannot be driven; give inputs, or use [sampling]");
    Model::Motion motion;
    const auto positive = [&](const char* name, double otherwise) {
      const std::string key = fmt::format("motion.{}", name);
      if (!entries.contains(name) && otherwise > 0) return otherwise;
      if (!entries.contains(name)) fail(entries, "motion", fmt::format("missing {} = …", name));
      const double value = number(*entries.get(name), key);
      if (!(value > 0)) fail(*entries.get(name), key, fmt::format("must be positive, got {}", value));
      return value;
    };
    motion.rate = positive("rate", 0);
    motion.natural_frequency = positive("natural_frequency", 10);
    motion.damping_ratio = positive("damping_ratio", 1);
    if (!entries.contains("segment"))
      fail(entries, "motion", "missing segment = [shortest, longest], how long a line takes in s");
    motion.segment = range(*entries.get("segment"), "motion.segment");
    if (!(motion.segment.first > 0)) fail(*entries.get("segment"), "motion.segment", "a line takes a positive time");
    if (entries.contains("profile")) {
      const std::string profile = text(*entries.get("profile"), "motion.profile");
      if (profile != "smooth" && profile != "trapezoid") {
        fail(*entries.get("profile"), "motion.profile",
             fmt::format(R"(expected "smooth" or "trapezoid", got "{}")", shortened(profile)));
      }
      if (profile == "trapezoid") motion.profile = Model::Motion::Profile::trapezoid;
    }
    if (!entries.contains("targets")) fail(entries, "motion", "missing targets = { q1 = [lower, upper], … }");
    for (const auto& [name, node] : entries_of(table(*entries.get("targets"), "motion.targets"))) {
      const std::string key = fmt::format("motion.targets.{}", name);
      motion.targets.push_back(read_target(*node, key, name));
      motion.targets.back().range = range(*node, key);
    }
    if (motion.targets.empty()) fail(*entries.get("targets"), "motion.targets", "a motion needs at least one target");
    if (entries.contains("hold")) {
      for (const toml::node& node : array(*entries.get("hold"), "motion.hold")) {
        motion.targets.push_back(read_target(node, "motion.hold", text(node, "motion.hold")));
      }
    }
    if (entries.contains("start")) motion.start = read_start(table(*entries.get("start"), "motion.start"), "motion.start");
    model_.motion = std::move(motion);
  }

  // a function y(q) of the coordinates, twice differentiated along the motion as a constraint is
  Model::Motion::Target read_target(const toml::node& node, const std::string& key, const std::string& written_target) const {
    try {
      const Expression y = model_.parse_symbols(written_target);
      refuse_load(node, key, y);
      return {written_target, derive(Level::position, y, written_target), std::nullopt};
    } catch (const LocatedError&) {
      throw;
    } catch (const InputError& error) {
      fail(node, key, fmt::format("\"{}\" must be a function of the coordinates: {}", shortened(written_target), error.what()));
    }
  }

  // each rule after those it uses
  void sort_rules(std::vector<Model::SamplingRule> rules) {
    std::map<std::string, std::size_t> position;
    for (const Model::SamplingRule& rule : rules) position.emplace(rule.name, position.size());
    std::vector<std::vector<std::size_t>> uses(rules.size());
    std::vector<std::pair<std::string, int>> entries;
    for (std::size_t k = 0; k < rules.size(); ++k) {
      entries.emplace_back(rules[k].name, rules[k].line);
      if (rules[k].range) continue;
      for (const std::string& name : definition_.graph->variables_of(rules[k].value)) {
        if (const auto other = position.find(name); other != position.end()) uses[k].push_back(other->second);
      }
    }
    const Order order = order_by_use(uses);
    if (!order.circle.empty()) {
      const auto& [name, line] = entries[order.circle.front()];
      fail(line, fmt::format("sampling.{}", name), "drawn in terms of itself" + circle_text(order.circle, entries));
    }
    for (const std::size_t k : order.positions) model_.sampling.push_back(std::move(rules[k]));
  }

  void read_columns() {
    if (!root_.contains("columns")) return;
    std::set<std::string> known, taken;
    for (Expression symbol : symbols_->state()) known.insert(symbol.variable_name());
    for (Expression symbol : symbols_->ddq) known.insert(symbol.variable_name());
    for (const auto& [name, node] : entries_of(table(*root_.get("columns"), "columns"))) {
      const std::string key = fmt::format("columns.{}", name);
      if (!known.contains(name)) fail(*node, key, "not a coordinate, velocity, acceleration, input or t of this model");
      const std::string column = text(*node, key);
      if (!taken.insert(column).second) fail(*node, key, fmt::format("the column '{}' is another name's already", column));
      model_.columns[name] = column;
    }
  }

  void read_units() {
    if (!root_.contains("units")) return;
    constexpr std::size_t longest = 30;
    std::set<std::string> known(definition_.inputs.begin(), definition_.inputs.end());
    for (const Coordinate& coordinate : definition_.coordinates) {
      known.insert(coordinate.name);
      if (coordinate.angle) model_.units[coordinate.name] = "rad";
    }
    for (const Parameter& parameter : definition_.parameters) known.insert(parameter.name);
    for (const Model::DerivedParameter& derived : model_.derived_parameters) known.insert(derived.name);
    for (const auto& [name, node] : entries_of(table(*root_.get("units"), "units"))) {
      const std::string key = fmt::format("units.{}", name);
      if (!known.contains(name)) {
        fail(*node, key,
             fmt::format("not a coordinate, input or parameter of this model; units of velocities and accelerations follow{}",
                         suggestion(name, known)));
      }
      const std::string unit = text(*node, key);
      const bool is_label = !unit.empty() && unit.size() <= longest &&
                            std::none_of(unit.begin(), unit.end(), [](unsigned char c) { return c < 32 || c == 127; });
      if (!is_label) fail(*node, key, R"(expected a short text, as in x = "m")");
      if (model_.units.contains(name) && unit != model_.units[name])
        fail(*node, key, "this coordinate is an angle, whose sine and cosine are features: it is in rad");
      model_.units[name] = unit;
    }
    model_.units["t"] = "s";
    for (const Coordinate& coordinate : definition_.coordinates) derive_units(coordinate);
  }

  // m: m/s, m/s², N
  void derive_units(const Coordinate& coordinate) const {
    const auto stated = model_.units.find(coordinate.name);
    if (stated == model_.units.end()) return;
    const std::string unit = stated->second;
    const std::string numerator = unit.find_first_of("/ *") == std::string::npos ? unit : fmt::format("({})", unit);
    for (const std::string& velocity : {coordinate.velocity(), coordinate.velocity() + "_next"})
      model_.units[velocity] = numerator + "/s";
    for (const std::string& acceleration : {coordinate.acceleration(), "abar_" + coordinate.name})
      model_.units[acceleration] = numerator + "/s²";
    const char* const force = unit == "m" ? "N" : unit == "rad" ? "N m" : nullptr;
    if (force == nullptr) return;
    for (const char* view : {"force_", "fc_"}) model_.units[view + coordinate.name] = force;
  }

  const toml::table& root_;
  const RobotSource& robot_source_;
  std::map<std::string, std::string> robot_parameters_;  // number of the robot -> parameter
  Model& model_;
  SymbolicSystem::Definition definition_;
  std::set<std::string> names_;
  std::optional<SystemSymbols> symbols_;
  const toml::node* mass_node_ = nullptr;
};

RobotNames robot_names(const Model& model) {
  const toml::table root = toml::parse(model.text, model.name);
  RobotNames names;
  names.file = root["robot"].value_or(std::string());
  if (const toml::table* const parameters = root["parameters"].as_table()) {
    for (const auto& [parameter, node] : *parameters) {
      const toml::table* const entry = node.as_table();
      if (entry == nullptr || !entry->contains("of")) continue;
      names.parameters[robot_number_name((*entry)["of"].value_or(std::string()))] = parameter.str();
    }
  }
  return names;
}

void read_model(const toml::table& root, const RobotSource& robot, Model& model) { ModelReader(root, robot, model).read(); }

}  // namespace gp2
