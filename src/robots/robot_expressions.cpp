#include "robots/robot_expressions.hpp"

#include <algorithm>
#include <charconv>
#include <optional>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "gp2/error.hpp"

namespace gp2 {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using Joint = RobotDescription::Joint;

namespace {

constexpr const char* axes = "xyz";

std::string number_name(const char* kind, const std::string& of, const std::string& component = "") {
  return fmt::format("{}(\"{}\"){}{}", kind, of, component.empty() ? "" : ".", component);
}

// Calls visit(name, number) for each number that a model may name; of inertias for the upper triangle.
template <class Robot, class Visit>
void for_each_number(Robot& robot, const Visit& visit) {
  for (auto& body : robot.bodies) {
    visit(number_name("mass", body.name), body.mass);
    for (int i = 0; i < 3; ++i) visit(number_name("com", body.name, {axes[i]}), body.com[i]);
    for (int i = 0; i < 3; ++i) {
      for (int j = i; j < 3; ++j) visit(number_name("inertia", body.name, {axes[i], axes[j]}), body.inertia(i, j));
    }
  }
  for (auto& body : robot.bodies) {
    for (auto& joint : body.joints) {
      visit(number_name("damping", joint.name), joint.damping);
      if (!joint.has_quaternion()) visit(number_name("stiffness", joint.name), joint.stiffness);
      visit(number_name("friction", joint.name), joint.dry_friction);
      visit(number_name("armature", joint.name), joint.armature);
    }
  }
}

}  // namespace

std::vector<std::pair<std::string, double>> robot_numbers(const RobotDescription& robot) {
  std::vector<std::pair<std::string, double>> numbers;
  for_each_number(robot, [&](std::string name, double value) { numbers.emplace_back(std::move(name), value); });
  return numbers;
}

RobotDescription with_numbers(RobotDescription robot, const std::map<std::string, double>& values) {
  for_each_number(robot, [&](const std::string& name, double& number) {
    if (const auto value = values.find(name); value != values.end()) number = value->second;
  });
  for (RobotDescription::Body& body : robot.bodies) body.inertia = body.inertia.selfadjointView<Eigen::Upper>();
  return robot;
}

RobotExpressions::RobotExpressions(RobotDescription robot, ExpressionGraph& graph, const SystemSymbols& symbols,
                                   std::map<std::string, Expression> numbers)
    : robot_(std::move(robot)), graph_(graph), q_(symbols.q), dq_(symbols.dq), ddq_(symbols.ddq), numbers_(std::move(numbers)) {
  const std::size_t n = robot_.coordinates().size();
  if (q_.size() != n) throw InputError(fmt::format("robot '{}': it has {} coordinates, got {}", robot_.name, n, q_.size()));
  add_links();
}

Expression RobotExpressions::number(const std::string& name, double value) const {
  const auto replaced = numbers_.find(name);
  return replaced == numbers_.end() ? graph_.constant(value) : replaced->second;
}

void RobotExpressions::add_links() {
  std::size_t k = 0;  // the coordinate
  for (const RobotDescription::Body& body : robot_.bodies) {
    const Frame parent = body.parent < 0 ? Frame() : frames_[static_cast<std::size_t>(body.parent)];
    Frame frame{parent.link, parent.rotation * body.rotation, parent.position + parent.rotation * body.position};
    for (const Joint& joint : body.joints) {
      switch (joint.type) {
        case Joint::Type::hinge:
        case Joint::Type::slide:
          add_axis(joint, joint.type == Joint::Type::hinge, joint.axis, k, frame);
          break;
        case Joint::Type::free:
          for (int i = 0; i < 3; ++i) add_axis(joint, false, Vector3d::Unit(i), k++, frame);
          [[fallthrough]];
        case Joint::Type::ball:
          add_ball(joint, k, frame);
          k += 3;
          break;
      }
      ++k;
    }
    frames_.push_back(frame);
    if (frame.link >= 0) add_inertia(body, frame);
  }
}

// not moved yet; whatever comes next stands in its frame
RobotExpressions::Link& RobotExpressions::add_link(const Joint& joint, bool turns, const Vector3d& axis, Frame& frame) {
  Link link;
  link.joint = &joint;
  link.turns = turns;
  link.parent = frame.link;
  link.axis = constant(graph_, axis);
  link.rotation = constant(graph_, frame.rotation);
  link.position = constant(graph_, Vector3d(frame.position + frame.rotation * joint.anchor));
  link.mass = link.velocity = link.velocity_rate = graph_.constant(0);
  link.first_moment = constant(graph_, Vector3d(Vector3d::Zero()));
  link.inertia = constant(graph_, Matrix3d(Matrix3d::Zero()));
  links_.push_back(link);
  frame = {static_cast<int>(links_.size()) - 1, Matrix3d::Identity(), -joint.anchor};
  return links_.back();
}

// a hinge or slide whose coordinate is q_k
void RobotExpressions::add_axis(const Joint& joint, bool turns, const Vector3d& axis, std::size_t k, Frame& frame) {
  const Expression moved = q_[k] - graph_.constant(joint.reference);
  const Vector3d direction = frame.rotation * axis;
  Link& link = add_link(joint, turns, axis, frame);
  if (turns) {
    link.rotation = link.rotation * rotation_about(axis, moved);
  } else {
    link.position = link.position + constant(graph_, direction) * moved;
  }
  link.velocity_of = {{k, graph_.constant(1)}};
  link.velocity = dq_[k];
}

// ω = G dp with G = 2 E(p)/|p|², and dG/dt dp = −2 (pᵀdp)/|p|² ω, as E(dp) dp = 0
void RobotExpressions::add_ball(const Joint& joint, std::size_t k, Frame& frame) {
  const ExpressionQuaternion p = quaternion(k), dp = quaternion_rate(k);
  const Expression two_by_square = graph_.constant(2) / dot(p, p);
  const auto E = velocity_matrix(p);
  balls_.emplace_back(k, links_.size());
  for (int i = 0; i < 3; ++i) {
    Link& link = add_link(joint, true, Vector3d::Unit(i), frame);
    link.goes_on = i > 0;
    if (i == 0) link.rotation = link.rotation * rotation_by(p);
    for (std::size_t j = 0; j < 4; ++j) {
      const Expression entry = two_by_square * E.at(static_cast<std::size_t>(i)).at(j);
      link.velocity_of.emplace_back(k + j, entry);
      link.velocity = link.velocity + entry * dq_[k + j];
    }
    link.velocity_rate = -(two_by_square * dot(p, dp) * link.velocity);
  }
}

namespace {

/// m (|r|² 1 − r rᵀ): the inertia of a point
ExpressionMatrix point_inertia(Expression mass, const ExpressionVector& r) {
  ExpressionMatrix out;
  const Expression square = dot(r, r);
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j <= i; ++j) {
      out(i, j) = out(j, i) = mass * (i == j ? square - r[i] * r[i] : -(r[i] * r[j]));
    }
  }
  return out;
}

}  // namespace

// Steiner: the inertia about the centre of mass stays what it is when mass and centre of mass change
void RobotExpressions::add_inertia(const RobotDescription::Body& body, const Frame& frame) {
  const Expression mass = number(number_name("mass", body.name), body.mass);
  ExpressionVector com;
  ExpressionMatrix inertia;
  for (int i = 0; i < 3; ++i) {
    com[i] = number(number_name("com", body.name, {axes[i]}), body.com[i]);
    for (int j = i; j < 3; ++j) {
      inertia(i, j) = inertia(j, i) = number(number_name("inertia", body.name, {axes[i], axes[j]}), body.inertia(i, j));
    }
  }
  Link& link = links_[static_cast<std::size_t>(frame.link)];
  const ExpressionMatrix R = constant(graph_, frame.rotation);
  com = constant(graph_, frame.position) + R * com;
  link.mass = link.mass + mass;
  link.first_moment = link.first_moment + com * mass;
  link.inertia = link.inertia + rotated_inertia(R, inertia) + point_inertia(mass, com);
}

std::vector<std::vector<Expression>> RobotExpressions::mass_along_axes() const {
  const std::size_t n = links_.size();
  std::vector<Link> composite = links_;  // with everything that hangs on it
  for (std::size_t i = n; i-- > 0;) {
    const Link& child = composite[i];
    if (child.parent < 0) continue;
    Link& parent = composite[static_cast<std::size_t>(child.parent)];
    const ExpressionVector h = child.rotation * child.first_moment, &p = child.position;
    // Σ m (|p + y|² 1 − (p + y)(p + y)ᵀ), with Σ m y = h
    ExpressionMatrix inertia = rotated_inertia(child.rotation, child.inertia) + point_inertia(child.mass, p);
    const Expression p_h = dot(p, h);
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c <= r; ++c) {
        const Expression mixed = r == c ? graph_.constant(2) * (p_h - p[r] * h[r]) : -(p[r] * h[c] + h[r] * p[c]);
        inertia(r, c) = inertia(c, r) = inertia(r, c) + mixed;
      }
    }
    parent.mass = parent.mass + child.mass;
    parent.first_moment = parent.first_moment + h + p * child.mass;
    parent.inertia = parent.inertia + inertia;
  }

  // column i: the forces that accelerate joint i alone by 1, carried down the tree
  std::vector<std::vector<Expression>> M(n, std::vector<Expression>(n, graph_.constant(0)));
  for (std::size_t i = 0; i < n; ++i) {
    const Link& link = composite[i];
    ExpressionVector force = link.turns ? cross(link.axis, link.first_moment) : link.axis * link.mass;
    ExpressionVector moment = link.turns ? link.inertia * link.axis : cross(link.first_moment, link.axis);
    const Expression armature = number(number_name("armature", link.joint->name), link.joint->armature);
    M[i][i] = dot(link.axis, link.turns ? moment : force) + armature;
    for (std::size_t at = i; links_[at].parent >= 0;) {
      const auto parent = static_cast<std::size_t>(links_[at].parent);
      force = links_[at].rotation * force;
      moment = links_[at].rotation * moment + cross(links_[at].position, force);
      M[i][parent] = M[parent][i] = dot(links_[parent].axis, links_[parent].turns ? moment : force);
      at = parent;
    }
  }
  return M;
}

std::vector<Expression> RobotExpressions::on_coordinates(const std::vector<Expression>& along_axes) const {
  std::vector<Expression> out(q_.size(), graph_.constant(0));
  for (std::size_t i = 0; i < links_.size(); ++i) {
    for (const auto& [k, coefficient] : links_[i].velocity_of) out[k] = out[k] + coefficient * along_axes[i];
  }
  return out;
}

Expression RobotExpressions::quaternion_mass(const std::vector<std::vector<Expression>>& along_axes, std::size_t link) const {
  return graph_.constant(4.0 / 3) * (along_axes[link][link] + along_axes[link + 1][link + 1] + along_axes[link + 2][link + 2]);
}

std::vector<std::vector<Expression>> RobotExpressions::mass() const {
  const std::vector<std::vector<Expression>> along_axes = mass_along_axes();
  if (balls_.empty()) return along_axes;

  // Gᵀ M_v G, with the lower triangle in both halves
  const std::size_t nq = q_.size();
  std::vector<std::vector<Expression>> rows;  // M_v G
  rows.reserve(along_axes.size());
  for (const std::vector<Expression>& row : along_axes) rows.push_back(on_coordinates(row));
  std::vector<std::vector<Expression>> M(nq, std::vector<Expression>(nq));
  for (std::size_t j = 0; j < nq; ++j) {
    std::vector<Expression> column;
    for (const std::vector<Expression>& row : rows) column.push_back(row[j]);
    column = on_coordinates(column);
    for (std::size_t i = j; i < nq; ++i) M[i][j] = M[j][i] = column[i];
  }

  // + c p pᵀ
  for (const auto& [k, link] : balls_) {
    const Expression c = quaternion_mass(along_axes, link);
    for (std::size_t i = k; i < k + 4; ++i) {
      for (std::size_t j = k; j <= i; ++j) M[i][j] = M[j][i] = M[i][j] + c * (q_[i] * q_[j]);
    }
  }
  return M;
}

std::vector<Expression> RobotExpressions::force() const {
  const std::size_t n = links_.size();
  const ExpressionVector zero = constant(graph_, Vector3d(Vector3d::Zero()));
  // gravity is an acceleration of the world upwards
  const ExpressionVector world_acceleration = constant(graph_, Vector3d(-robot_.gravity));
  const Expression two = graph_.constant(2);
  std::vector<ExpressionVector> omega(n), alpha(n), acceleration(n), force(n), moment(n);  // in the link's own axes
  std::vector<ExpressionVector> before(n);                                                 // ω without the joint's

  // outwards: motion where ddq = 0, and what it takes
  for (std::size_t i = 0; i < n; ++i) {
    const Link& link = links_[i];
    const ExpressionMatrix to_link = transposed(link.rotation);
    const bool in_world = link.parent < 0;
    const auto parent = static_cast<std::size_t>(in_world ? 0 : link.parent);
    const ExpressionVector &omega_p = in_world ? zero : omega[parent], &alpha_p = in_world ? zero : alpha[parent];
    const ExpressionVector& acceleration_p = in_world ? world_acceleration : acceleration[parent];
    const ExpressionVector carried = to_link * omega_p, joint_velocity = link.axis * link.velocity;
    before[i] = link.goes_on ? before[parent] : carried;
    omega[i] = link.turns ? carried + joint_velocity : carried;
    alpha[i] = to_link * alpha_p;
    if (link.turns) alpha[i] = alpha[i] + cross(before[i], joint_velocity) + link.axis * link.velocity_rate;
    acceleration[i] = to_link * (acceleration_p + cross(alpha_p, link.position) + cross(omega_p, cross(omega_p, link.position)));
    if (!link.turns) acceleration[i] = acceleration[i] + cross(carried, joint_velocity) * two;

    const ExpressionVector& h = link.first_moment;
    force[i] = acceleration[i] * link.mass + cross(alpha[i], h) + cross(omega[i], cross(omega[i], h));
    moment[i] = link.inertia * alpha[i] + cross(omega[i], link.inertia * omega[i]) + cross(h, acceleration[i]);
  }

  // inwards: what the joints have to carry
  std::vector<Expression> out(n);
  for (std::size_t i = n; i-- > 0;) {
    const Link& link = links_[i];
    const Joint& joint = *link.joint;
    const Expression bias = dot(link.axis, link.turns ? moment[i] : force[i]);
    const Expression spring = number(number_name("stiffness", joint.name), joint.stiffness) * stretch(link);
    const Expression damper = number(number_name("damping", joint.name), joint.damping) * link.velocity;
    const Expression friction =
        number(number_name("friction", joint.name), joint.dry_friction) * graph_.apply(Operation::sign, link.velocity);
    out[i] = -bias - spring - damper - friction;
    if (link.parent < 0) continue;
    const auto parent = static_cast<std::size_t>(link.parent);
    const ExpressionVector carried = link.rotation * force[i];
    force[parent] = force[parent] + carried;
    moment[parent] = moment[parent] + link.rotation * moment[i] + cross(link.position, carried);
  }
  out = on_coordinates(out);
  if (balls_.empty()) return out;
  const std::vector<std::vector<Expression>> along_axes = mass_along_axes();
  for (const auto& [k, link] : balls_) {
    const Expression weight = quaternion_mass(along_axes, link) * dot(quaternion_rate(k), quaternion_rate(k));
    for (std::size_t i = k; i < k + 4; ++i) out[i] = out[i] - weight * q_[i];
  }
  return out;
}

// of a joint's spring; balls have none
Expression RobotExpressions::stretch(const Link& link) const {
  if (link.joint->has_quaternion()) return graph_.constant(0);
  return q_[link.velocity_of.front().first] - graph_.constant(link.joint->spring_reference);
}

Expression RobotExpressions::potential() {
  const std::vector<Motion>& motion = motions();
  const ExpressionVector gravity = constant(graph_, robot_.gravity);
  Expression potential = graph_.constant(0);
  for (std::size_t i = 0; i < links_.size(); ++i) {
    const Link& link = links_[i];
    potential = potential - dot(gravity, motion[i].position * link.mass + motion[i].rotation * link.first_moment);
    const Expression stiffness = number(number_name("stiffness", link.joint->name), link.joint->stiffness);
    potential = potential + graph_.constant(0.5) * stiffness * (stretch(link) * stretch(link));
  }
  return potential;
}

const std::vector<RobotExpressions::Motion>& RobotExpressions::motions() {
  const std::scoped_lock lock(growing_);
  if (!motions_.empty()) return motions_;
  const ExpressionVector zero = constant(graph_, Vector3d(Vector3d::Zero()));
  const Motion world{constant(graph_, Matrix3d(Matrix3d::Identity())), zero, zero, zero, zero, zero, zero};
  ExpressionVector before = zero;  // angular velocity without the joint's
  for (const Link& link : links_) {
    const Motion& parent = link.parent < 0 ? world : motions_[static_cast<std::size_t>(link.parent)];
    const ExpressionVector &omega = parent.angular_velocity, &alpha = parent.angular_acceleration;
    Motion motion = parent;
    const ExpressionVector r = parent.rotation * link.position;
    motion.rotation = parent.rotation * link.rotation;
    motion.position = parent.position + r;
    motion.axis = motion.rotation * link.axis;
    motion.velocity = parent.velocity + cross(omega, r);
    motion.acceleration = parent.acceleration + cross(alpha, r) + cross(omega, cross(omega, r));
    const ExpressionVector joint_velocity = motion.axis * link.velocity;
    if (!link.goes_on) before = omega;
    if (link.turns) {
      motion.angular_velocity = omega + joint_velocity;
      motion.angular_acceleration = alpha + cross(before, joint_velocity) + motion.axis * link.velocity_rate;
    } else {
      motion.velocity = motion.velocity + joint_velocity;
      motion.acceleration = motion.acceleration + cross(omega, joint_velocity) * graph_.constant(2);
    }
    motions_.push_back(motion);
  }
  return motions_;
}

std::vector<bool> RobotExpressions::moves(int link) const {
  std::vector<bool> moves(links_.size(), false);
  for (; link >= 0; link = links_[static_cast<std::size_t>(link)].parent) moves[static_cast<std::size_t>(link)] = true;
  return moves;
}

RobotQuantity RobotExpressions::point(const Frame& frame, const Vector3d& offset, int component) {
  const Expression zero = graph_.constant(0);
  const Vector3d on_link = frame.position + frame.rotation * offset;
  RobotQuantity out{graph_.constant(on_link[component]), std::vector<Expression>(q_.size(), zero), zero, zero};
  if (frame.link < 0) return out;
  const Motion& motion = motions()[static_cast<std::size_t>(frame.link)];
  const ExpressionVector r = motion.rotation * constant(graph_, on_link), position = motion.position + r;
  const ExpressionVector &omega = motion.angular_velocity, &alpha = motion.angular_acceleration;
  out.value = position[component];
  out.rate = (motion.velocity + cross(omega, r))[component];
  out.bias = (motion.acceleration + cross(alpha, r) + cross(omega, cross(omega, r)))[component];
  const std::vector<bool> moved_by = moves(frame.link);
  std::vector<Expression> along_axes(links_.size(), zero);
  for (std::size_t j = 0; j < links_.size(); ++j) {
    if (!moved_by[j]) continue;
    const ExpressionVector& axis = motions_[j].axis;
    along_axes[j] = (links_[j].turns ? cross(axis, position - motions_[j].position) : axis)[component];
  }
  out.jacobian = on_coordinates(along_axes);
  return out;
}

RobotQuantity RobotExpressions::direction(const Frame& frame, const Vector3d& own_axis, int component) {
  const Expression zero = graph_.constant(0);
  const Vector3d on_link = frame.rotation * own_axis;
  RobotQuantity out{graph_.constant(on_link[component]), std::vector<Expression>(q_.size(), zero), zero, zero};
  if (frame.link < 0) return out;
  const Motion& motion = motions()[static_cast<std::size_t>(frame.link)];
  const ExpressionVector e = motion.rotation * constant(graph_, on_link);
  const ExpressionVector &omega = motion.angular_velocity, &alpha = motion.angular_acceleration;
  out.value = e[component];
  out.rate = cross(omega, e)[component];
  out.bias = (cross(alpha, e) + cross(omega, cross(omega, e)))[component];
  const std::vector<bool> moved_by = moves(frame.link);
  std::vector<Expression> along_axes(links_.size(), zero);
  for (std::size_t j = 0; j < links_.size(); ++j) {
    if (moved_by[j] && links_[j].turns) along_axes[j] = cross(motions_[j].axis, e)[component];
  }
  out.jacobian = on_coordinates(along_axes);
  return out;
}

namespace {

/// KIND("of", numbers…).component
struct QuantityName {
  std::string kind, of, component;
  std::vector<double> numbers;
};

QuantityName parse_quantity(const std::string& name) {
  QuantityName out;
  const std::size_t open = name.find('('), first = name.find('"'), last = name.find('"', first + 1), close = name.rfind(')');
  if (open == std::string::npos || first != open + 1 || last == std::string::npos || close == std::string::npos || close < last) {
    throw InputError(
        fmt::format("'{}' must be written as site(\"NAME\").x, body(\"NAME\").x or point(\"BODY\", 0, 0, 0.1).x", name));
  }
  out.kind = name.substr(0, open);
  out.of = name.substr(first + 1, last - first - 1);
  if (close + 2 <= name.size()) out.component = name.substr(close + 2);
  std::size_t at = last + 1;
  while (at < close) {
    const std::size_t end = std::min(name.find(',', at + 1), close);
    std::size_t begin = at + 1;
    while (begin < end && name[begin] == ' ') ++begin;
    double value = 0;
    const auto [stop, error] = std::from_chars(name.data() + begin, name.data() + end, value);
    if (error != std::errc() || stop != name.data() + end) {
      throw InputError(fmt::format("'{}': '{}' is not a number", name, name.substr(begin, end - begin)));
    }
    out.numbers.push_back(value);
    at = end;
  }
  return out;
}

int axis_index(char letter) { return letter >= 'x' && letter <= 'z' ? letter - 'x' : -1; }

template <class Things>
std::string names_of(const Things& things) {
  std::vector<std::string> names;
  for (const auto& thing : things) names.push_back(thing.name);
  return names.empty() ? "none" : fmt::format("{}", fmt::join(names, ", "));
}

}  // namespace

const RobotQuantity& RobotExpressions::quantity(const std::string& name) {
  const std::scoped_lock lock(growing_);
  if (const auto known = quantities_.find(name); known != quantities_.end()) return known->second;
  const QuantityName parts = parse_quantity(name);

  // where it is fixed
  Frame frame;
  Vector3d offset = Vector3d::Zero();
  if (parts.kind == "site") {
    const auto site =
        std::find_if(robot_.sites.begin(), robot_.sites.end(), [&](const auto& other) { return other.name == parts.of; });
    if (site == robot_.sites.end()) {
      throw InputError(fmt::format("robot '{}' has no site '{}'; sites: {}. A point without a name is point(\"BODY\", x, y, z)",
                                   robot_.name, parts.of, names_of(robot_.sites)));
    }
    if (site->body >= 0) frame = frames_[static_cast<std::size_t>(site->body)];
    frame.position += frame.rotation * site->position;
    frame.rotation = frame.rotation * site->rotation;
  } else {
    const int body = robot_.body_index(parts.of);
    if (body < 0 && parts.of != "world") {
      throw InputError(
          fmt::format("robot '{}' has no body '{}'; bodies: world, {}", robot_.name, parts.of, names_of(robot_.bodies)));
    }
    if (body >= 0) frame = frames_[static_cast<std::size_t>(body)];
  }
  const bool is_point = parts.kind == "point";
  if (parts.numbers.size() != (is_point ? 3U : 0U)) {
    throw InputError(fmt::format(
        "'{}': {}", name,
        is_point ? "a point needs its body and 3 numbers: point(\"BODY\", x, y, z)"
                 : fmt::format("{} takes a name only; for a point of a body write point(\"BODY\", x, y, z)", parts.kind)));
  }
  if (is_point) offset = {parts.numbers[0], parts.numbers[1], parts.numbers[2]};

  // which number of it
  const std::string& component = parts.component;
  if (component.size() == 1 && axis_index(component[0]) >= 0) {
    return quantities_.emplace(name, point(frame, offset, axis_index(component[0]))).first->second;
  }
  if (!is_point && component.size() == 6 && component.starts_with("rot_") && axis_index(component[4]) >= 0 &&
      axis_index(component[5]) >= 0) {
    const Vector3d own_axis = Vector3d::Unit(axis_index(component[5]));
    return quantities_.emplace(name, direction(frame, own_axis, axis_index(component[4]))).first->second;
  }
  throw InputError(fmt::format("'{}': '{}' is no component; there are x, y, z{}", name, component,
                               is_point ? "" : " and rot_xx … rot_zz (rot_xz: the world's x component of the frame's z axis)"));
}

namespace {

bool is_quantity(const std::string& name) {
  return name.starts_with("site(") || name.starts_with("body(") || name.starts_with("point(");
}

/// The quantity that a variable is, and how often it is differentiated; none: another variable.
std::optional<std::pair<std::string, int>> quantity_of(const std::string& variable) {
  for (int order = 0; order <= 2 && static_cast<std::size_t>(order) < variable.size(); ++order) {
    if (order > 0 && variable[static_cast<std::size_t>(order) - 1] != 'd') break;
    std::string name = variable.substr(static_cast<std::size_t>(order));
    if (is_quantity(name)) return std::pair(std::move(name), order);
  }
  return std::nullopt;
}

}  // namespace

std::optional<Expression> RobotExpressions::variable(const std::string& symbol) {
  const auto named = quantity_of(symbol);
  if (!named) return std::nullopt;
  quantity(named->first);
  return graph_.variable(symbol);
}

Expression RobotExpressions::expand(Expression e) {
  std::map<std::string, Expression> replacements;
  for (const std::string& variable : graph_.variables_of(e)) {
    const auto named = quantity_of(variable);
    if (!named) continue;
    const RobotQuantity& r = quantity(named->first);
    Expression value = named->second == 0 ? r.value : named->second == 1 ? r.rate : r.bias;
    for (std::size_t j = 0; named->second == 2 && j < ddq_.size(); ++j) value = value + r.jacobian[j] * ddq_[j];
    replacements.emplace(variable, value);
  }
  return replacements.empty() ? e : graph_.substitute(e, replacements);
}

ConstraintRow RobotExpressions::derive_constraint(ConstraintLevel level, Expression c, std::string text,
                                                  const std::vector<Coordinate>& coordinates,
                                                  const std::vector<std::string>& inputs,
                                                  const std::vector<Parameter>& parameters) {
  // the quantities that c reads count as coordinates first
  std::vector<Coordinate> extended = coordinates;
  for (const std::string& variable : graph_.variables_of(c)) {
    const auto named = quantity_of(variable);
    const auto is_it = [&](const Coordinate& coordinate) { return coordinate.name == named->first; };
    if (named && std::none_of(extended.begin(), extended.end(), is_it)) extended.push_back({named->first, false});
  }
  const SystemSymbols symbols(graph_, extended, inputs, parameters);
  ConstraintRow row = gp2::derive_constraint(level, c, std::move(text), symbols);

  // c_q ddq + c_r (J ddq + J̇ dq) = b
  for (Expression& entry : row.A) entry = expand(entry);
  row.b = expand(row.b);
  for (Expression& residual : row.residuals) residual = expand(residual);
  for (std::size_t k = coordinates.size(); k < extended.size(); ++k) {
    const RobotQuantity& r = quantity(extended[k].name);
    for (std::size_t j = 0; j < coordinates.size(); ++j) row.A[j] = row.A[j] + row.A[k] * r.jacobian[j];
    row.b = row.b - row.A[k] * r.bias;
  }
  row.A.resize(coordinates.size());
  return row;
}

namespace {

using NamedExpressions = std::vector<std::pair<Expression, std::string>>;

std::string body_name(const RobotDescription& robot, int body) {
  return body < 0 ? "world" : robot.bodies[static_cast<std::size_t>(body)].name;
}

Expression component_of(ExpressionGraph& graph, const std::string& of, const std::string& component) {
  return graph.variable(fmt::format("{}.{}", of, component));
}

// both anchors are one point
void add_connect(const RobotDescription& robot, ExpressionGraph& graph, const RobotDescription::Connect& connect,
                 NamedExpressions& rows) {
  const auto anchor = [&](std::size_t k) {
    const Vector3d& at = connect.anchors[k];
    return fmt::format("point(\"{}\", {}, {}, {})", body_name(robot, connect.bodies[k]), at.x(), at.y(), at.z());
  };
  for (int i = 0; i < 3; ++i) {
    rows.emplace_back(component_of(graph, anchor(0), {axes[i]}) - component_of(graph, anchor(1), {axes[i]}),
                      fmt::format("{}.{}", connect.name, axes[i]));
  }
}

ExpressionMatrix rotation_of(ExpressionGraph& graph, const std::string& body) {
  ExpressionMatrix R;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      R(i, j) = component_of(graph, fmt::format("body(\"{}\")", body), fmt::format("rot_{}{}", axes[i], axes[j]));
    }
  }
  return R;
}

void add_weld(const RobotDescription& robot, ExpressionGraph& graph, const RobotDescription::Weld& weld, NamedExpressions& rows) {
  add_connect(robot, graph, weld.connect, rows);
  // E = R_12ᵀ R₁ᵀ R₂ is the identity where its skew part vanishes
  const auto rotation = [&](std::size_t k) { return rotation_of(graph, body_name(robot, weld.connect.bodies[k])); };
  const ExpressionMatrix E = transposed(constant(graph, weld.rotation)) * (transposed(rotation(0)) * rotation(1));
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    rows.emplace_back(E(k, j) - E(j, k), fmt::format("{}.rot_{}", weld.connect.name, axes[i]));
  }
}

// between the two sites of a segment
Expression squared_distance(const RobotDescription& robot, ExpressionGraph& graph,
                            const RobotDescription::Coupling::Segment& segment) {
  Expression square = graph.constant(0);
  for (int i = 0; i < 3; ++i) {
    const auto at = [&](int site) {
      return component_of(graph, fmt::format("site(\"{}\")", robot.sites[static_cast<std::size_t>(site)].name), {axes[i]});
    };
    const Expression d = at(segment.second) - at(segment.first);
    square = square + d * d;
  }
  return square;
}

Expression length_of(const RobotDescription& robot, ExpressionGraph& graph, const std::vector<Expression>& q,
                     const RobotDescription::Coupling::Length& length) {
  const std::vector<std::string> coordinates = robot.coordinates();
  Expression sum = graph.constant(-length.reference);
  for (const auto& [name, coefficient] : length.joints) {
    const auto coordinate = std::find(coordinates.begin(), coordinates.end(), name);
    sum = sum + graph.constant(coefficient) * q[static_cast<std::size_t>(coordinate - coordinates.begin())];
  }
  for (const RobotDescription::Coupling::Segment& segment : length.segments) {
    const Expression square = squared_distance(robot, graph, segment);
    sum = sum + graph.constant(segment.factor) * graph.apply(Operation::sqrt, square);
  }
  return sum;
}

void add_coupling(const RobotDescription& robot, ExpressionGraph& graph, const std::vector<Expression>& q,
                  const RobotDescription::Coupling& coupling, NamedExpressions& rows) {
  Expression polynomial = graph.constant(coupling.polynomial[0]);
  if (!coupling.x.empty()) {
    const Expression x = length_of(robot, graph, q, coupling.x.front());
    for (std::size_t k = 1; k < coupling.polynomial.size(); ++k) {
      const Expression power = graph.apply(Operation::power, x, graph.constant(static_cast<double>(k)));
      polynomial = polynomial + graph.constant(coupling.polynomial[k]) * power;
    }
  }
  rows.emplace_back(length_of(robot, graph, q, coupling.y) - polynomial, coupling.name);
}

}  // namespace

std::vector<std::pair<Expression, std::string>> RobotExpressions::constraints() {
  NamedExpressions rows;
  for (const auto& [k, link] : balls_) {
    rows.emplace_back(dot(quaternion(k), quaternion(k)) - graph_.constant(1),
                      fmt::format("{}.quaternion", links_[link].joint->name));
  }
  for (const RobotDescription::Connect& connect : robot_.connects) add_connect(robot_, graph_, connect, rows);
  for (const RobotDescription::Weld& weld : robot_.welds) add_weld(robot_, graph_, weld, rows);
  for (const RobotDescription::Coupling& coupling : robot_.couplings) add_coupling(robot_, graph_, q_, coupling, rows);
  return rows;
}

}  // namespace gp2
