#pragma once

#include <map>
#include <mutex>
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
/// The robot with these values in the place of its own.
RobotDescription with_numbers(RobotDescription robot, const std::map<std::string, double>& values);

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
  /// @param symbols  the coordinates of the robot's joints, in their order
  /// @param numbers  expressions in place of numbers of the robot, by their names (robot_numbers)
  /// @throws InputError when sizes differ.
  RobotExpressions(RobotDescription robot, ExpressionGraph& graph, const SystemSymbols& symbols,
                   std::map<std::string, Expression> numbers = {});
  RobotExpressions(const RobotExpressions&) = delete;
  RobotExpressions& operator=(const RobotExpressions&) = delete;

  /// M(q)  (nq × nq). With v = G dq the velocities along the axes of the joints it is Gᵀ M_v G; where a joint has a quaternion p,
  /// which G does not read along p, the mass c p pᵀ is added (T43).
  [[nodiscard]] std::vector<std::vector<Expression>> mass() const;

  /// What acts without inputs (nq): −(Coriolis, centrifugal and gravity forces) − damping dq − stiffness (q − q_rest) − friction
  /// sign(dq); with −c p |dp|² for a quaternion p, so that its constraint has nothing to do (T43).
  [[nodiscard]] std::vector<Expression> force() const;

  /// The axes of the joints: one of a hinge or slide, three of a ball, in the axes of its body, six of a free joint, three in those of
  /// the world and three in those of its body.
  [[nodiscard]] std::size_t n_axes() const { return links_.size(); }

  /// What forces and torques along the axes are as forces on the coordinates: Gᵀ f  (nq).
  [[nodiscard]] std::vector<Expression> on_coordinates(const std::vector<Expression>& along_axes) const;

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

  /// The position constraints of the robot, as expressions with quantities, and what they go by: quaternions have length 1, loops
  /// stay closed.
  std::vector<std::pair<Expression, std::string>> constraints();

 private:
  /// One axis of a joint and what is fixed to it. Its frame's origin is the joint's anchor; its axes are, at the joint's
  /// reference, those of the body that the joint moves. A ball is three links in one place, of which the first turns by the
  /// quaternion and the last has the mass.
  struct Link {
    const RobotDescription::Joint* joint = nullptr;
    bool turns = true;                                            // else it slides
    bool goes_on = false;                                         // second or third axis of a ball
    int parent = -1;                                              // link, or −1: the world
    std::vector<std::pair<std::size_t, Expression>> velocity_of;  // v = Σ coefficient dq_k: a row of G
    Expression velocity;                                          // v
    Expression velocity_rate;                                     // dv/dt where ddq = 0
    ExpressionMatrix rotation;                                    // of its axes in the parent's frame
    ExpressionVector position;                                    // of its origin in the parent's frame
    ExpressionVector axis;                                        // of the joint, in either frame's own axes
    Expression mass;                                              // of what is fixed to it
    ExpressionVector first_moment;                                // Σ m c about its origin
    ExpressionMatrix inertia;                                     // about its origin
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

  [[nodiscard]] Expression number(const std::string& name, double value) const;
  [[nodiscard]] ExpressionQuaternion quaternion(std::size_t k) const { return {q_[k], q_[k + 1], q_[k + 2], q_[k + 3]}; }
  [[nodiscard]] ExpressionQuaternion quaternion_rate(std::size_t k) const { return {dq_[k], dq_[k + 1], dq_[k + 2], dq_[k + 3]}; }
  void add_links();
  Link& add_link(const RobotDescription::Joint& joint, bool turns, const Eigen::Vector3d& axis, Frame& frame);
  void add_axis(const RobotDescription::Joint& joint, bool turns, const Eigen::Vector3d& axis, std::size_t k, Frame& frame);
  void add_ball(const RobotDescription::Joint& joint, std::size_t k, Frame& frame);
  [[nodiscard]] std::vector<std::vector<Expression>> mass_along_axes() const;  // M_v
  [[nodiscard]] Expression quaternion_mass(const std::vector<std::vector<Expression>>& along_axes, std::size_t link) const;  // c
  [[nodiscard]] Expression stretch(const Link& link) const;
  void add_inertia(const RobotDescription::Body& body, const Frame& frame);
  const std::vector<Motion>& motions();
  RobotQuantity point(const Frame& frame, const Eigen::Vector3d& offset, int component);
  RobotQuantity direction(const Frame& frame, const Eigen::Vector3d& own_axis, int component);
  [[nodiscard]] std::vector<bool> moves(int link) const;  // which joints move a link

  RobotDescription robot_;
  ExpressionGraph& graph_;
  std::vector<Expression> q_, dq_, ddq_;
  std::map<std::string, Expression> numbers_;
  std::vector<Link> links_;                                 // one per axis of a joint
  std::vector<std::pair<std::size_t, std::size_t>> balls_;  // first coordinate and first link of each quaternion
  std::vector<Frame> frames_;                               // one per body
  std::recursive_mutex growing_;                            // of what is made where it is asked for first:
  std::vector<Motion> motions_;
  std::map<std::string, RobotQuantity> quantities_;
};

}  // namespace gp2
