#include "simulation/contacts.hpp"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "gp2/error.hpp"
#include "gp2/mechanics/symbolic_system.hpp"
#include "gp2/mechanics/udwadia_kalaba.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Kind = ContactEvent::Kind;

std::vector<Contact> contacts_of(const Model& model, const Eigen::Ref<const VectorXd>& parameters) {
  std::vector<Contact> contacts;
  const SymbolicSystem* const system = model.symbolic_system();
  if (system == nullptr) return contacts;
  const std::vector<ConstraintRow>& rows = system->definition().constraints;
  for (std::size_t k = 0; k < rows.size(); ++k) {
    if (!rows[k].contact) continue;
    const Expression e = rows[k].contact->restitution;
    const SystemSymbols symbols = model.symbols();
    const auto restitution = [tape = Tape(std::span(&e, 1), symbols.state_and_parameters()), theta = VectorXd(parameters),
                              name = model.name, text = rows[k].text](const Eigen::Ref<const VectorXd>& state) {
      MatrixXd value;
      tape.evaluate(state, theta, value);
      if (value(0, 0) >= 0 && value(0, 0) <= 1) return value(0, 0);
      throw InputError(
          fmt::format("{}: the restitution of the contact '{}' must lie between 0 and 1, got {}", name, text, value(0, 0)));
    };
    Contact contact = {static_cast<int>(k), rows[k].contact->input};
    const std::vector<Expression> of_state = symbols.state();
    if (std::any_of(of_state.begin(), of_state.end(), [&](const Expression& x) { return model.graph->depends_on(e, x); })) {
      contact.restitution_at = restitution;
    } else {
      contact.restitution = restitution(VectorXd::Zero(system->layout().size()));
    }
    contacts.push_back(std::move(contact));
  }
  return contacts;
}

std::vector<int> gap_residuals(const System& system, const std::vector<Contact>& contacts) {
  const std::vector<System::Residual>& labels = system.residual_labels();
  std::vector<int> residuals;
  for (const Contact& contact : contacts) {
    const auto is_gap = [&](const System::Residual& one, const System::Residual& next) {
      return one.row == contact.row && next.row == contact.row && !one.velocity && next.velocity;
    };
    const auto gap = std::adjacent_find(labels.begin(), labels.end(), is_gap);
    if (gap == labels.end() || contact.input < 0 || contact.input >= system.layout().nu) {
      throw InputError(
          fmt::format("simulate: the contact of row {} of A needs a position-level constraint and one of the {} inputs",
                      contact.row + 1, system.layout().nu));
    }
    residuals.push_back(static_cast<int>(gap - labels.begin()));
  }
  return residuals;
}

MatrixXd gaps_of(const System& system, const std::vector<Contact>& contacts, MatrixXd states, const VectorXd& parameters) {
  if (contacts.empty()) return {0, states.cols()};
  for (const Contact& contact : contacts) states.row(system.layout().u(contact.input)).setOnes();
  return system.residuals(states, parameters)(gap_residuals(system, contacts), Eigen::all);
}

namespace {

double checked_restitution(double value, const Contact& contact) {
  if (value >= 0 && value <= 1) return value;
  throw InputError(
      fmt::format("the restitution of the contact of row {} of A must lie between 0 and 1, got {}", contact.row + 1, value));
}

}  // namespace

Contacts::Contacts(const System& system, const VectorXd& parameters, const SimulateOptions& options)
    : system_(system),
      parameters_(parameters),
      layout_(system.layout()),
      contacts_(options.contacts),
      residuals_(gap_residuals(system, options.contacts)),
      shortest_flight_(options.shortest_flight),
      is_closed_(contacts_.size(), false) {
  for (const Contact& contact : contacts_) {
    if (!contact.restitution_at) checked_restitution(contact.restitution, contact);
  }
}

void Contacts::mark(VectorXd& state, const std::vector<bool>& closed) const {
  for (std::size_t k = 0; k < contacts_.size(); ++k) state[layout_.u(contacts_[k].input)] = closed[k] ? 1 : 0;
}

Contacts::Gaps Contacts::gaps_at(VectorXd state) const {
  constexpr double of_rounding = 1e-14;
  mark(state, std::vector<bool>(contacts_.size(), true));
  const VectorXd residuals = system_.residuals(state, parameters_).col(0);
  const SystemValues values = system_.evaluate(state, parameters_);
  const auto n = static_cast<Index>(contacts_.size());
  Gaps out{VectorXd(n), VectorXd(n), VectorXd(n), MatrixXd(n, layout_.nq), VectorXd(n)};
  for (Index k = 0; k < n; ++k) {
    const auto contact = static_cast<std::size_t>(k);
    const int row = contacts_[contact].row;
    out.value[k] = residuals[residuals_[contact]];
    out.rate[k] = residuals[residuals_[contact] + 1];
    out.A.row(k) = values.A(0).row(row);
    out.b[k] = values.b(0)[row];
    const auto rounding = [&](const auto& moved) { return of_rounding * out.A.row(k).cwiseAbs().dot(moved.cwiseAbs()); };
    out.margin[k] = rounding(state.head(layout_.nq));
    // a contact that was just made neither opens nor closes
    if (std::abs(out.rate[k]) <= 10 * rounding(state.segment(layout_.dq(0), layout_.nq))) out.rate[k] = 0;
  }
  return out;
}

void Contacts::start(VectorXd& state, const Acceleration& acceleration, std::vector<ContactEvent>& events) {
  constexpr double digits_of_a_log = 1e-6;
  const Gaps gaps = gaps_at(state);
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const auto row = static_cast<Index>(k);
    const double lengths = 1 + gaps.A.row(row).cwiseAbs().dot(state.head(layout_.nq).cwiseAbs());
    const double speeds = 1 + gaps.A.row(row).cwiseAbs().dot(state.segment(layout_.dq(0), layout_.nq).cwiseAbs());
    if (gaps.value[row] < -digits_of_a_log * lengths) {
      throw InputError(
          fmt::format("simulate: the start is beyond the contact '{}', whose gap is {:.6g}: start where it is not negative, or "
                      "change its sign",
                      system_.constraint_labels()[static_cast<std::size_t>(contacts_[k].row)], gaps.value[row]));
    }
    is_closed_[k] = gaps.value[row] <= digits_of_a_log * lengths && std::abs(gaps.rate[row]) <= digits_of_a_log * speeds;
  }
  // none of these is a contact that was made or released on the way
  std::vector<ContactEvent> of_start;
  release(state, acceleration, of_start);
  settle(state, acceleration, events);
}

bool Contacts::is_hit(const VectorXd& state) const {
  const Gaps gaps = gaps_at(state);
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const auto row = static_cast<Index>(k);
    if (!is_closed_[k] && gaps.value[row] < -gaps.margin[row] && gaps.rate[row] < 0) return true;
  }
  return false;
}

// With one contact opened and all others held c̈ = −λ/Λ_kk, Λ = (A M⁻¹Aᵀ)⁻¹: it opens exactly where its multiplier would pull.
double Contacts::opening(VectorXd state, std::size_t contact, const Acceleration& acceleration) const {
  constexpr double rounding = 1e-12;
  std::vector<bool> closed = is_closed_;
  closed[contact] = false;
  const Gaps gaps = gaps_at(state);
  mark(state, closed);
  const VectorXd ddq = acceleration(state);
  const auto row = static_cast<Index>(contact);
  const double value = gaps.A.row(row).dot(ddq) - gaps.b[row];
  const double size = gaps.A.row(row).cwiseAbs().dot(ddq.cwiseAbs()) + std::abs(gaps.b[row]);
  return std::abs(value) <= rounding * size ? 0 : value;
}

bool Contacts::is_released(const VectorXd& state, const Acceleration& acceleration) const {
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    if (is_closed_[k] && opening(state, k, acceleration) > 0) return true;
  }
  return false;
}

VectorXd Contacts::margins(const VectorXd& state, const Acceleration& acceleration) const {
  VectorXd out = VectorXd::Ones(static_cast<Index>(contacts_.size()));
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    if (is_closed_[k]) out[static_cast<Index>(k)] = -opening(state, k, acceleration);
  }
  return out;
}

void Contacts::release(VectorXd& state, const Acceleration& acceleration, std::vector<ContactEvent>& events) {
  for (bool has_changed = true; has_changed;) {
    has_changed = false;
    for (std::size_t k = 0; k < contacts_.size(); ++k) {
      if (!is_closed_[k] || !(opening(state, k, acceleration) > 0)) continue;
      is_closed_[k] = false;
      has_changed = true;
      events.push_back({state[layout_.t()], contacts_[k].row, Kind::released, 0, 0});
    }
  }
  mark(state);
}

// Δdq = M⁻¹Aᵀ(A M⁻¹Aᵀ)⁺ r: L b of T2 with r for b
std::optional<VectorXd> Contacts::jump(const VectorXd& state, const VectorXd& r) const {
  const SystemValues values = system_.evaluate(state, parameters_);
  const UdwadiaKalaba projection(values.M(0), values.A(0), r);
  if (!projection.motion_is_determined()) return std::nullopt;
  return jump_ ? jump_(state, r) : projection.Lb();
}

double Contacts::impact(VectorXd& state, const std::vector<bool>& hit, const VectorXd& restitution) {
  const Gaps gaps = gaps_at(state);
  VectorXd wanted = VectorXd::Zero(std::ssize(contacts_));  // changes of the rates of gaps
  std::vector<bool> active = is_closed_;
  for (std::size_t k = 0; k < active.size(); ++k) {
    const auto row = static_cast<Index>(k);
    if (hit[k]) wanted[row] = -(1 + restitution[row]) * gaps.rate[row];
    active[k] = active[k] || hit[k];
  }
  const auto change_with = [&](const std::vector<bool>& closed) {
    mark(state, closed);
    VectorXd r = VectorXd::Zero(system_.nc());
    for (std::size_t k = 0; k < closed.size(); ++k) {
      if (closed[k]) r[contacts_[k].row] = wanted[static_cast<Index>(k)];
    }
    return jump(state, r);
  };
  while (true) {
    // a contact only pushes: one whose gap would open more without it is let go
    std::size_t worst = contacts_.size();
    double most = 0;
    for (std::size_t k = 0; k < contacts_.size() && std::count(active.begin(), active.end(), true) > 1; ++k) {
      constexpr double rounding = 1e-9;
      if (!active[k]) continue;
      std::vector<bool> others = active;
      others[k] = false;
      const std::optional<VectorXd> change = change_with(others);
      if (!change) continue;
      const auto row = static_cast<Index>(k);
      const double more = gaps.A.row(row).dot(*change) - wanted[row];
      if (more <= most + rounding * gaps.A.row(row).cwiseAbs().dot(change->cwiseAbs())) continue;
      most = more;
      worst = k;
    }
    if (worst < contacts_.size()) {
      active[worst] = is_closed_[worst] = false;
      continue;
    }
    const std::optional<VectorXd> change = change_with(active);
    if (!change) throw NumericalError("nothing determines what an impact does to the velocities");
    auto dq = state.segment(layout_.dq(0), layout_.nq);
    const double loss = -change->dot(system_.evaluate(state, parameters_).M(0) * (dq + *change / 2));
    dq += *change;
    return loss;
  }
}

void Contacts::settle(VectorXd& state, const Acceleration& acceleration, std::vector<ContactEvent>& events) {
  const Gaps gaps = gaps_at(state);
  const auto n = static_cast<Index>(contacts_.size());
  std::vector<bool> hit(contacts_.size(), false);
  VectorXd restitution = VectorXd::Zero(n);
  for (Index k = 0; k < n; ++k) {
    const auto contact = static_cast<std::size_t>(k);
    hit[contact] = !is_closed_[contact] && gaps.value[k] < -gaps.margin[k] && gaps.rate[k] < 0;
    if (!hit[contact]) continue;
    const Contact& of = contacts_[contact];
    restitution[k] = of.restitution_at ? checked_restitution(of.restitution_at(state), of) : of.restitution;
  }
  if (std::find(hit.begin(), hit.end(), true) == hit.end()) {
    release(state, acceleration, events);
    return;
  }
  const VectorXd before = state;
  const std::vector<bool> was_closed = is_closed_;
  double loss = impact(state, hit, restitution);
  mark(state);
  const auto is_back_at_once = [&](std::size_t contact) {
    const double back = opening(state, contact, acceleration);
    return back < 0 && 2 * rates(state)[static_cast<Index>(contact)] <= -back * shortest_flight_;
  };
  // a rebound that is over at once is none
  std::vector<bool> stays = hit;
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    double& e = restitution[static_cast<Index>(k)];
    stays[k] = hit[k] && (e == 0 || is_back_at_once(k));
    if (stays[k]) e = 0;
  }
  if (std::find(stays.begin(), stays.end(), true) != stays.end()) {
    state = before;
    is_closed_ = was_closed;
    loss = impact(state, hit, restitution);
    for (std::size_t k = 0; k < contacts_.size(); ++k) is_closed_[k] = is_closed_[k] || stays[k];
    mark(state);
  }
  // nor is a foot lifted by a box that rocks onto the other, ever faster, once it is down again at once
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    if (was_closed[k] && !is_closed_[k]) is_closed_[k] = is_back_at_once(k);
  }
  mark(state);
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    if (was_closed[k] && !is_closed_[k]) events.push_back({state[layout_.t()], contacts_[k].row, Kind::released, 0, 0});
    if (!hit[k]) continue;
    events.push_back({state[layout_.t()], contacts_[k].row, stays[k] ? Kind::made : Kind::impact,
                      -gaps.rate[static_cast<Index>(k)], std::exchange(loss, 0)});
  }
  release(state, acceleration, events);
}

}  // namespace gp2
