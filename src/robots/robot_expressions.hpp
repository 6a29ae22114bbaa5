#pragma once

#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "gp2/mechanics/symbolic_system.hpp"
#include "gp2/robots/robot.hpp"
#include "gp2/symbolic/expression.hpp"
#include "robots/expression_algebra.hpp"

namespace gp2 {

/// The numbers of a robot that a model may name as parameters, with their values: mass("link7"), com("link7").x,
/// inertia("link7").xx (about the centre of mass, in the body's axes), damping("q1"), stiffness("q1"),
/// friction("q1") (dry), armature("q1").
std::vector<std::pair<std::string, double>> robot_numbers(const RobotDescription& robot);

/// A point of a robot, or an axis of a frame on it, along one axis of the world, as a function of the coordinates q.
///
///     site("tip").z                   height of a site [m]
///     body("link7").x                 of the origin of a body's frame
///     point("link7", 0, 0, 0.1).y     of a point given in a body's frame
///     site("tip").rot_xz              world x component of the frame's own z axis; also of a body
struct RobotQuantity {
  Expression value;                  // r(q)
  std::vector<Expression> jacobian;  // J = ∂r/∂q  (nq)
  Expression rate;                   // J dq
  Expression bias;                   // J̇ dq: its second derivative where ddq = 0
};

/// Kinematics and dynamics of a robot as expressions of its coordinates, by recursion over the tree of bodies in their own
/// frames: M from composite inertias, the bias force by Newton and Euler (Featherstone, Rigid Body Dynamics Algorithms, 2008,
/// chapters 5 and 6). They stay small: of the order of 100 operations per joint and pair of joints on a path.
class RobotExpressions {
 public:
  /// @param symbols  a coordinate per joint of the robot, in its order
  /// @param numbers  expressions in place of numbers of the robot, by their names (robot_numbers)
  /// @throws InputError when sizes differ.
  RobotExpressions(RobotDescription robot, ExpressionGraph& graph, const SystemSymbols& symbols,
                   std::map<std::string, Expression> numbers = {});
  RobotExpressions(const RobotExpressions&) = delete;
  RobotExpressions& operator=(const RobotExpressions&) = delete;

  /// M(q)  (nq × nq)
  [[nodiscard]] std::vector<std::vector<Expression>> mass() const;

  /// What acts without inputs (nq): −(Coriolis, centrifugal and gravity forces) − damping dq − stiffness (q − q_rest) − friction
  /// sign(dq).
  [[nodiscard]] std::vector<Expression> force() const;

  /// Of gravity and springs [J].
  [[nodiscard]] Expression potential();

  /// The variable that stands for a quantity r, its velocity dr or its acceleration ddr, until it is expanded; nothing when the
  /// symbol is not written as one.
  /// @throws InputError as `quantity` does.
  std::optional<Expression> variable(const std::string& symbol);

  /// @param name  as in RobotQuantity, without spaces but one after a comma
  /// @throws InputError when there is no such site, body or component.
  const RobotQuantity& quantity(const std::string& name);

  /// e with every quantity r in it, its velocity dr and acceleration ddr, replaced by what they are in q, dq and ddq.
  Expression expand(Expression e);

  /// derive_constraint for a constraint that may have quantities in it: A ddq = b with A = c_q + c_r J and −c_r J̇ dq in b.
  ConstraintRow derive_constraint(ConstraintLevel level, Expression c, std::string text,
                                  const std::vector<Coordinate>& coordinates, const std::vector<std::string>& inputs,
                                  const std::vector<Parameter>& parameters);

  /// The position constraints that close the robot's loops, as expressions with quantities, and what they go by.
  std::vector<std::pair<Expression, std::string>> loops();

 private:
  /// One joint and what is fixed to it. Its frame's origin is the joint's anchor; its axes are, at the joint's reference, those
  /// of the body that the joint moves.
  struct Link {
    const RobotDescription::Joint* joint = nullptr;
    int parent = -1;                // link, or −1: the world
    ExpressionMatrix rotation;      // of its axes in the parent's frame
    ExpressionVector position;      // of its origin in the parent's frame
    ExpressionVector axis;          // of the joint, in either frame's own axes
    Expression mass;                // of what is fixed to it
    ExpressionVector first_moment;  // Σ m c about its origin
    ExpressionMatrix inertia;       // about its origin
  };
  /// Where the frame of a body stands on its link.
  struct Frame {
    int link = -1;
    Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();
    Eigen::Vector3d position = Eigen::Vector3d::Zero();
  };
  /// A link's motion in the world, accelerations where ddq = 0.
  struct Motion {
    ExpressionMatrix rotation;
    ExpressionVector position, axis, angular_velocity, velocity, angular_acceleration, acceleration;
  };

  [[nodiscard]] bool is_hinge(std::size_t link) const { return links_[link].joint->type == RobotDescription::Joint::Type::hinge; }
  [[nodiscard]] Expression number(const std::string& name, double value) const;
  void add_links();
  void add_inertia(const RobotDescription::Body& body, const Frame& frame);
  const std::vector<Motion>& motions();
  RobotQuantity point(const Frame& frame, const Eigen::Vector3d& offset, int component);
  RobotQuantity direction(const Frame& frame, const Eigen::Vector3d& own_axis, int component);
  [[nodiscard]] std::vector<bool> moves(int link) const;  // which joints move a link

  RobotDescription robot_;
  ExpressionGraph& graph_;
  std::vector<Expression> q_, dq_, ddq_;
  std::map<std::string, Expression> numbers_;
  std::vector<Link> links_;    // one per joint
  std::vector<Frame> frames_;  // one per body
  std::vector<Motion> motions_;
  std::map<std::string, RobotQuantity> quantities_;
};

}  // namespace gp2
