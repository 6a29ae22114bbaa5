#pragma once

#include <array>
#include <filesystem>
#include <string>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"

namespace gp2 GP2_API {

/// A robot as numbers: a tree of rigid bodies, the joints that move them, named points on them, and what closes loops. It is what
/// a MJCF or URDF file says; the expressions of M, F, A and b follow from it (robot_expressions.hpp).
///
/// A body's frame stands in the frame of its parent by `position` and `rotation`, then its joints move it, one after the other;
/// an axis and an anchor are given in the body's own frame. Bodies come after their parents; index −1 is the world.
struct RobotDescription {
  struct Joint {
    enum class Type {
      hinge,  // turns about an axis through its anchor
      slide,  // moves along its axis
      ball,   // turns about its anchor; its coordinates are a quaternion
      free    // of a body of the world, which alone says where it is: its coordinates are position and quaternion
    };
    std::string name;
    Type type = Type::hinge;
    Eigen::Vector3d axis = Eigen::Vector3d::UnitZ();   // unit vector, of a hinge or slide
    Eigen::Vector3d anchor = Eigen::Vector3d::Zero();  // [m]
    double reference = 0;                              // its coordinate where nothing is moved [rad or m]
    double armature = 0;                               // inertia of the rotor, as the joint feels it [kg m² or kg]
    double damping = 0;                                // [N m s/rad or N s/m]
    double stiffness = 0;                              // [N m/rad or N/m]
    double spring_reference = 0;                       // its coordinate where the spring is at rest [rad or m]
    double dry_friction = 0;                           // force against the motion, whatever its speed [N m or N]

    [[nodiscard]] bool has_quaternion() const { return type == Type::ball || type == Type::free; }
    [[nodiscard]] std::vector<std::string> coordinates() const;  // j; j_x, j_y, j_z of a free joint, then j_qw, j_qx, j_qy, j_qz
  };

  struct Body {
    std::string name;
    int parent = -1;
    Eigen::Vector3d position = Eigen::Vector3d::Zero();      // in the parent's frame [m]
    Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();  // columns: own axes in the parent's frame
    std::vector<Joint> joints;                               // in the order in which they act; none: fixed to the parent
    double mass = 0;                                         // [kg]
    Eigen::Vector3d com = Eigen::Vector3d::Zero();           // centre of mass in the body's frame [m]
    Eigen::Matrix3d inertia = Eigen::Matrix3d::Zero();       // about the centre of mass, in the axes of the body's frame [kg m²]
  };

  /// A named point of a body with axes of its own.
  struct Site {
    std::string name;
    int body = -1;
    Eigen::Vector3d position = Eigen::Vector3d::Zero();      // in the body's frame [m]
    Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();  // columns: own axes in the body's frame
  };

  /// A point of one body stays at a point of another (3 rows).
  struct Connect {
    std::string name;
    std::array<int, 2> bodies = {-1, -1};
    std::array<Eigen::Vector3d, 2> anchors = {Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero()};  // in each body's frame [m]
  };

  /// Besides, the second body keeps its orientation in the first (6 rows).
  struct Weld {
    Connect connect;
    Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();  // columns: the second body's axes in the first's frame
  };

  /// One length or angle is a polynomial of another (1 row): y − y₀ = Σ_k a_k (x − x₀)^k; without x it is y − y₀ = a₀.
  /// A length or angle is Σ coefficient · coordinate (a joint, or a fixed tendon) + Σ factor · |p_second − p_first| (a tendon
  /// through sites; a pulley divides).
  struct Coupling {
    struct Segment {
      int first = 0, second = 0;  // sites
      double factor = 1;
    };
    struct Length {
      std::vector<std::pair<std::string, double>> joints;  // names and coefficients
      std::vector<Segment> segments;
      double reference = 0;  // y₀ or x₀
    };
    std::string name;
    Length y;
    std::vector<Length> x;  // one or none
    std::array<double, 5> polynomial = {0, 1, 0, 0, 0};
  };

  std::string name;
  std::vector<Body> bodies;  // without the world
  std::vector<Site> sites;
  std::vector<Connect> connects;
  std::vector<Weld> welds;
  std::vector<Coupling> couplings;
  Eigen::Vector3d gravity = {0, 0, -9.81};  // [m/s²]
  std::vector<std::string> notes;           // what of the file has no place here: limits, contacts, actuators, …

  [[nodiscard]] std::vector<const Joint*> joints() const;       // of all bodies, in their order
  [[nodiscard]] std::vector<std::string> coordinates() const;   // of all joints
  [[nodiscard]] int body_index(const std::string& name) const;  // −1 when there is none
};

/// Whether this build has MuJoCo and so can read robots.
bool can_read_robots();

/// Reads a MJCF or URDF file with MuJoCo (2.2.2 to 3.x), which also knows its defaults, includes and units; the simulator is used
/// for nothing else. Bodies, joints and sites without a name get one: body_3, joint_2, site_1, counted as MuJoCo does (the world
/// is body 0). Entries of axes and rotations within 1e-9 of 0 or ±1 are taken as exact (a right angle written as 1.5707963268);
/// a note says so when that is more than rounding. Of a URDF file, links fixed to others stay bodies of their own (unless it asks
/// MuJoCo for `fusestatic`), and a joint's `mimic` becomes a coupling. Meshes need not be there where inertias are.
///
/// @throws InputError when this build has no MuJoCo, with MuJoCo's own words when it refuses the file, and naming what has no
///   place in a RobotDescription: springs of ball and free joints, tendons held by an equality that wrap around geoms, springs, dampers,
///   friction or armature of tendons, forces and inertias that only later versions of MuJoCo know, motion in a fluid.
RobotDescription read_robot(const std::filesystem::path& path);

/// The description as JSON text, exact to the last bit, and back: a fitted model keeps its robot this way and needs no MuJoCo.
std::string to_json(const RobotDescription& robot);
/// @throws InputError naming the entry that is missing or wrong.
RobotDescription robot_from_json(const std::string& json);

}  // namespace gp2
