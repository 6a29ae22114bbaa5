#pragma once

#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"

namespace gp2 GP2_API {

/// Where each quantity of a state stands in its column of numbers x = [q; dq; t; u]. A batch of N states is a matrix (size() ×
/// N). An entry that no expression of the model reads may be NaN ("not measured").
struct StateLayout {
  int nq = 0;  // coordinates
  int nu = 0;  // inputs

  [[nodiscard]] int q(int j) const { return j; }
  [[nodiscard]] int dq(int j) const { return nq + j; }
  [[nodiscard]] int t() const { return 2 * nq; }
  [[nodiscard]] int u(int k) const { return 2 * nq + 1 + k; }
  [[nodiscard]] int size() const { return 2 * nq + 1 + nu; }
};

/// A number of the model that may be estimated from data.
struct Parameter {
  /// What is believed of it before the data: a normal density of the value, or of its logarithm.
  struct Belief {
    double median = 0, stddev = 0;
    bool of_logarithm = false;
  };

  std::string name;
  double value = 0;
  std::optional<std::pair<double, double>> bounds;  // hard limits when estimated
  bool estimate = false;                            // the model file's wish; a fit may override it
  std::optional<Belief> prior = std::nullopt;       // weighed when estimated
};

/// A coordinate and the names its velocity and acceleration go by.
struct Coordinate {
  std::string name;    // q1
  bool angle = false;  // a feature of this name means its sine and cosine

  [[nodiscard]] std::string velocity() const { return "d" + name; }
  [[nodiscard]] std::string acceleration() const { return "dd" + name; }
};

/// What a system goes by, but for its equations.
struct SystemDeclaration {
  std::string name;
  std::vector<Coordinate> coordinates;
  std::vector<std::string> inputs;
  std::vector<Parameter> parameters;
};

/// At which level a constraint is given.
enum class ConstraintLevel {
  position,      // c(q, t) = 0, differentiated twice along the motion
  velocity,      // c(q, dq, t) = 0, differentiated once
  acceleration,  // c(q, dq, ddq, t, u) = 0, linear in ddq
};

/// M, A, b, F, or their derivatives in one parameter, at N states: column i of each member is state i, matrices column-major.
struct SystemValues {
  using ConstBlock = Eigen::Map<const Eigen::MatrixXd>;
  using ConstColumn = Eigen::Ref<const Eigen::VectorXd>;

  Eigen::MatrixXd mass;               // M  (nq·nq × N)
  Eigen::MatrixXd constraint_matrix;  // A  (nc·nq × N)
  Eigen::MatrixXd constraint_vector;  // b  (nc × N)
  Eigen::MatrixXd force;              // F  (nq × N) [N or N m]

  [[nodiscard]] int n_states() const { return static_cast<int>(force.cols()); }
  [[nodiscard]] ConstBlock M(int i) const { return {mass.col(i).data(), force.rows(), force.rows()}; }
  [[nodiscard]] ConstBlock A(int i) const { return {constraint_matrix.col(i).data(), constraint_vector.rows(), force.rows()}; }
  [[nodiscard]] ConstColumn b(int i) const { return constraint_vector.col(i); }
  [[nodiscard]] ConstColumn F(int i) const { return force.col(i); }
};

class StateEvaluator;

/// What a reader of a state asks for; see System::reads.
enum class SystemPart { mechanics /* M, A, b */, force, residuals };

/// A constrained mechanical system: M(q,t) ddq = F + constraint forces, subject to A(q,dq,t) ddq = b(q,dq,t).
/// Immutable; every member function may be called from several threads at once.
class System {
 public:
  /// @param constraint_noise       constraint_noise(); empty: every constraint is exact
  /// @param constraint_conditions  constraint_conditions(); empty: every constraint holds always
  System(std::string name, std::vector<Coordinate> coordinates, std::vector<std::string> inputs,
         std::vector<Parameter> parameters, std::vector<std::string> constraint_labels, Eigen::VectorXd constraint_noise = {},
         std::vector<std::string> constraint_conditions = {});
  virtual ~System() = default;
  System(const System&) = delete;
  System& operator=(const System&) = delete;

  [[nodiscard]] const std::string& name() const { return name_; }
  [[nodiscard]] const std::vector<Coordinate>& coordinates() const { return coordinates_; }
  [[nodiscard]] const std::vector<std::string>& inputs() const { return inputs_; }
  [[nodiscard]] const std::vector<Parameter>& parameters() const { return parameters_; }
  [[nodiscard]] const std::vector<std::string>& constraint_labels() const { return constraint_labels_; }  // one per row of A
  /// ς of soft constraints: motions of the system obey A ddq = b, measured ones A ddq = b + ς ε, ε ~ N(0, I), as where a wheel
  /// slips (nc) [unit of the row]. 0 where a constraint is exact.
  [[nodiscard]] const Eigen::VectorXd& constraint_noise() const { return constraint_noise_; }
  [[nodiscard]] bool has_constraint_noise() const { return (constraint_noise_.array() > 0).any(); }
  /// Of each row of A the condition under which it is there, as written, "gap <= 0"; empty: always. Elsewhere it and its entry of b
  /// are zero, so that it is dropped.
  [[nodiscard]] const std::vector<std::string>& constraint_conditions() const { return constraint_conditions_; }
  [[nodiscard]] bool is_conditional(int row) const { return !constraint_conditions_[static_cast<std::size_t>(row)].empty(); }
  [[nodiscard]] bool has_conditional_constraints() const;
  /// The largest rank of A where the constraints hold and every condition is met: that of the rows that are always there, and one
  /// more for each conditional row. Off the constraints, as measured states are, rows that follow from others on them seem to be
  /// independent: what they have beyond this rank is the error of the state, and no constraint. nc where it is not known.
  [[nodiscard]] virtual int largest_rank() const { return nc(); }
  /// The same at a state: less the conditional rows that are 0 in its A (nc × nq). nc where largest_rank() is. Allocates nothing.
  [[nodiscard]] int largest_rank_of(const Eigen::Ref<const Eigen::MatrixXd>& A) const;
  [[nodiscard]] int nq() const { return static_cast<int>(coordinates_.size()); }
  [[nodiscard]] int nc() const { return static_cast<int>(constraint_labels_.size()); }
  [[nodiscard]] StateLayout layout() const { return {nq(), static_cast<int>(inputs_.size())}; }
  [[nodiscard]] std::vector<std::string> state_names() const;         // q1 … dq1 … t u1 …, in the order of the layout
  [[nodiscard]] std::vector<std::string> acceleration_names() const;  // ddq1 …
  [[nodiscard]] Eigen::VectorXd parameter_values() const;             // the model's own values
  [[nodiscard]] int parameter_index(const std::string& name) const;   // −1 when there is none

  /// @throws InputError when columns are not as large as a state.
  void require_states(const Eigen::Ref<const Eigen::MatrixXd>& states) const;
  /// @throws InputError when there is not a number for each of parameters().
  void require_parameters(const Eigen::Ref<const Eigen::VectorXd>& parameters) const;
  /// @throws InputError when there is no parameters()[index].
  void require_parameter(int index) const;

  /// M, A, b, F at N states.
  /// @param states      (layout().size() × N)
  /// @param parameters  (parameters().size())
  /// @throws InputError when a size is wrong; so do those below.
  [[nodiscard]] virtual SystemValues evaluate(const Eigen::Ref<const Eigen::MatrixXd>& states,
                                              const Eigen::Ref<const Eigen::VectorXd>& parameters) const = 0;

  /// The same, into the memory of earlier values. SymbolicSystem allocates nothing where the sizes are the same.
  virtual void evaluate_into(const Eigen::Ref<const Eigen::MatrixXd>& states, const Eigen::Ref<const Eigen::VectorXd>& parameters,
                             SystemValues& values) const;

  /// M, A, b, F at one state after another, and where asked their derivatives in the state; see state_evaluator.hpp, which also
  /// says what this default does and how exact it is.
  /// @param parameters  (parameters().size())
  [[nodiscard]] virtual std::unique_ptr<StateEvaluator> make_evaluator(const Eigen::Ref<const Eigen::VectorXd>& parameters,
                                                                       bool derivatives) const;

  /// ∂M/∂p, ∂A/∂p, ∂b/∂p, ∂F/∂p at N states for parameter p = parameters()[index]: exact, but where a CallableSystem says
  /// otherwise.
  [[nodiscard]] virtual SystemValues differentiate(const Eigen::Ref<const Eigen::MatrixXd>& states,
                                                   const Eigen::Ref<const Eigen::VectorXd>& parameters, int index) const = 0;

  /// How far states are off the constraints: rows of `residual_labels()` × N; zero on the constraint.
  [[nodiscard]] virtual Eigen::MatrixXd residuals(const Eigen::Ref<const Eigen::MatrixXd>& states,
                                                  const Eigen::Ref<const Eigen::VectorXd>& parameters) const = 0;
  struct Residual {
    int row = 0;            // of A
    bool velocity = false;  // ċ = 0 or a velocity-level constraint; otherwise c = 0
    std::string text;
  };
  [[nodiscard]] virtual const std::vector<Residual>& residual_labels() const = 0;

  /// Which entries of a state the named part reads (size layout().size()).
  [[nodiscard]] virtual std::vector<bool> reads(SystemPart part) const = 0;

  /// Whether M, A, b or F may depend on parameters()[index].
  [[nodiscard]] virtual bool depends_on_parameter(int /*index*/) const { return true; }

 private:
  std::string name_;
  std::vector<Coordinate> coordinates_;
  std::vector<std::string> inputs_;
  std::vector<Parameter> parameters_;
  std::vector<std::string> constraint_labels_;
  Eigen::VectorXd constraint_noise_;
  std::vector<std::string> constraint_conditions_;
};

}  // namespace gp2
