#include "gp2/view.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/shape.hpp"
#include "gp2/error.hpp"
#include "mechanics/describe_fault.hpp"
#include "mechanics/pushed_system.hpp"
#include "prior/load_function.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

void require_rows(const View& view, int nq, int nc) {
  const int n_rows = view.quantity->n_rows(nq, nc);
  for (const int row : view.rows) {
    if (row >= 0 && row < n_rows) continue;
    throw InputError(fmt::format("view '{}': there are the rows 0 … {}, got {}", view.quantity->word(), n_rows - 1, row));
  }
}

// that the latents of the fitted system can act there
void require_other_system(const Prior& fitted, const OtherSystem& other) {
  const auto differ = [](const char* what, auto there, auto here) {
    throw InputError(fmt::format("view: its other system has {} {}, the fitted one {}; make_other_system makes one that fits",
                                 there, what, here));
  };
  require_prior(other.prior);
  const System &there = *other.prior.system, &here = *fitted.system;
  if (there.nq() != here.nq()) differ("coordinates", there.nq(), here.nq());
  if (there.layout().nu != here.layout().nu) differ("inputs", there.layout().nu, here.layout().nu);
  if (other.prior.latents.size() != fitted.latents.size()) differ("latents", other.prior.latents.size(), fitted.latents.size());
  for (std::size_t a = 0; a < fitted.latents.size(); ++a) {
    const Latent &mine = fitted.latents[a], &its = other.prior.latents[a];
    const auto kernel = [](const Latent& latent) {
      std::string text = latent.kernel.text();
      std::erase(text, ' ');
      return text;
    };
    if (kernel(its) != kernel(mine) || its.n_features() != mine.n_features() || its.size() != mine.size() ||
        its.n_functions() != mine.n_functions() || its.base != mine.base || its.is_positive != mine.is_positive ||
        its.is_potential != mine.is_potential) {
      throw InputError(
          fmt::format("view: the latent '{}' of its other system is of another kind than '{}' of the fitted one; "
                      "make_other_system makes one that fits",
                      its.name, mine.name));
    }
    if (its.feature_names == mine.feature_names) continue;
    throw InputError(
        fmt::format("view: the latent '{}' of its other system has the features {}, '{}' of the fitted one {}; "
                    "make_other_system makes one that fits",
                    its.name, fmt::join(its.feature_names, ", "), mine.name, fmt::join(mine.feature_names, ", ")));
  }
  if (other.shared.size() != there.parameters().size()) {
    throw InputError(fmt::format("view: its other system has {} parameters, but shared has {} numbers", there.parameters().size(),
                                 other.shared.size()));
  }
  for (const int index : other.shared) {
    if (index != -1) here.require_parameter(index);
  }
}

}  // namespace

void require_view(const Prior& fitted, const View& view) {
  require_prior(fitted);
  if (view.other_system) require_other_system(fitted, *view.other_system);
  const System& system = *prior_of(fitted, view).system;
  require_rows(view, system.nq(), system.nc());
  if (view.rows.empty() && view.quantity->n_rows(system.nq(), system.nc()) > 0) {
    throw InputError(fmt::format("view '{}' is of no rows; View::all has every one", view.quantity->word()));
  }
  const int n_latents = static_cast<int>(fitted.latents.size());
  const LatentRange shown = view.latent.value_or(0);
  if (view.latent && (shown.first < 0 || shown.n < 1 || shown.first > n_latents - shown.n)) {
    throw InputError(fmt::format("view '{}': the prior has {} latents, numbered from 0, got the latent {}", view.quantity->word(),
                                 n_latents, shown.n == 1 ? shown.first : shown.first + shown.n - 1));
  }
  static_cast<void>(view.required_time_step());
}

VectorXd OtherSystem::parameters(const Ref<const VectorXd>& fitted) const {
  VectorXd parameters = prior.system->parameter_values();
  for (std::size_t k = 0; k < shared.size(); ++k) {
    if (shared[k] >= 0) parameters[static_cast<Index>(k)] = fitted[shared[k]];
  }
  return parameters;
}

namespace {

std::shared_ptr<const LoadFunction> load_function(const std::shared_ptr<const StateFunction>& function) {
  return std::dynamic_pointer_cast<const LoadFunction>(function);
}

}  // namespace

bool reads_loads(const Prior& prior) {
  return std::any_of(prior.latents.begin(), prior.latents.end(), [](const Latent& latent) {
    return load_function(latent.features) != nullptr || load_function(latent.directions) != nullptr;
  });
}

View pushed(const Prior& fitted, View view, const VectorXd& push) {
  require_shape("pushed: push", push, prior_of(fitted, view).system->nc(), 1);
  std::vector<int> own(fitted.system->parameters().size());
  std::iota(own.begin(), own.end(), 0);
  OtherSystem there = view.other_system ? *view.other_system : OtherSystem{fitted, std::move(own)};
  there.prior.system = std::make_shared<const PushedSystem>(there.prior.system, push);
  for (Latent& latent : there.prior.latents) {
    for (std::shared_ptr<const StateFunction>* function : {&latent.features, &latent.directions}) {
      if (const auto of_load = load_function(*function)) *function = of_load->under(there.prior.system);
    }
  }
  view.other_system = std::make_shared<const OtherSystem>(std::move(there));
  return view;
}

View View::all(Quantity quantity, const System& system) {
  View view{quantity, std::vector<int>(static_cast<std::size_t>(quantity->n_rows(system.nq(), system.nc())))};
  std::iota(view.rows.begin(), view.rows.end(), 0);
  return view;
}

View View::next_velocity(const System& system, double time_step) {
  View view = all(Quantity::next_velocity, system);
  view.time_step = time_step;
  return view;
}

double View::required_time_step() const {
  if (!quantity->needs_time_step()) return 0;
  if (!time_step) throw InputError(fmt::format("view '{}' needs a time step", quantity->word()));
  if (!(*time_step > 0) || !std::isfinite(*time_step)) {
    throw InputError(fmt::format("view '{}': the time step must be positive, got {}", quantity->word(), *time_step));
  }
  return *time_step;
}

std::optional<int> View::added_entry(const StateLayout& layout, int k) const {
  // what a latent adds has no part of the offset
  return latent ? std::nullopt : quantity->added_entry(layout, rows[static_cast<std::size_t>(k)]);
}

std::vector<bool> View::reads(const System& system) const {
  std::vector<bool> reads(static_cast<std::size_t>(system.layout().size()), false);
  for (int k = 0; k < size(); ++k) {
    if (const std::optional<int> entry = added_entry(system.layout(), k)) reads[static_cast<std::size_t>(*entry)] = true;
  }
  return reads;
}

std::vector<std::string> View::names(const System& system, const std::string& latent_name) const {
  require_rows(*this, system.nq(), system.nc());
  std::vector<std::string> names;
  for (const int row : rows) {
    names.push_back(quantity->name(system, row));
    if (latent) names.back() += "@" + latent_name;
  }
  return names;
}

const Prior& prior_of(const Prior& fitted, const View& view) { return view.other_system ? view.other_system->prior : fitted; }

VectorXd parameters_of(const View& view, const Ref<const VectorXd>& fitted) {
  return view.other_system ? view.other_system->parameters(fitted) : VectorXd(fitted);
}

void keep_viewed(const View& view, PriorValues& values) {
  if (!view.has_mean()) values.mean.setZero();
  for (std::size_t a = 0; a < values.directions.size(); ++a) {
    if (!view.has_latent(a)) values.directions[a].setZero();
  }
}

std::optional<std::string> what_needs_acceleration(const Prior& prior, const View& view) {
  if (view.quantity->parts().unconstrained_acceleration) return "the view is of the unconstrained acceleration ā";
  if (prior.mean == Prior::Mean::constant) return "the prior's mean is an acceleration";
  const auto of_acceleration = std::find_if(prior.latents.begin(), prior.latents.end(),
                                            [](const Latent& latent) { return latent.base != Latent::Base::force; });
  if (of_acceleration == prior.latents.end()) return std::nullopt;
  return fmt::format(
      "the latent '{}' acts on the unconstrained acceleration ā: let it act on forces, directions = \"force\" or {{ force = … }}",
      of_acceleration->name);
}

namespace {

std::optional<MechanicsBatch::Fault> singular_fault(const Prior& prior, const View& view, int state) {
  const std::optional<std::string> text = what_needs_acceleration(prior, view);
  if (!text) return std::nullopt;
  MechanicsBatch::Fault fault{state, {}};
  fault.text = fmt::format("the mass matrix M is singular, so that there is no M⁻¹, but {}", *text);
  return fault;
}

}  // namespace

void evaluate_mechanics(const Prior& prior, const View& view, const Ref<const MatrixXd>& states,
                        const Ref<const VectorXd>& parameters, MechanicsBatch& batch) {
  require_prior(prior);
  evaluate_mechanics(*prior.system, states, parameters, batch);
  const int singular = batch.first_singular();
  if (!batch.fault && singular >= 0) batch.fault = singular_fault(prior, view, singular);
}

std::optional<MechanicsBatch::Fault> for_each_mechanics(
    const Prior& prior, const View& view, const Ref<const MatrixXd>& states, const Ref<const VectorXd>& parameters,
    const std::function<void(Index first, const MechanicsBatch& mechanics)>& visit) {
  require_prior(prior);
  int singular = -1;
  const auto fault = for_each_mechanics(*prior.system, states, parameters, 1, [&](Index first, const MechanicsBatch& block) {
    const int one = block.first_singular();
    if (singular < 0 && one >= 0) singular = static_cast<int>(first) + one;
    visit(first, block);
  });
  return fault || singular < 0 ? fault : singular_fault(prior, view, singular);
}

MechanicsBatch require_mechanics(const Prior& prior, const View& view, const Ref<const MatrixXd>& states,
                                 const Ref<const VectorXd>& parameters) {
  MechanicsBatch batch;
  evaluate_mechanics(prior, view, states, parameters, batch);
  if (batch.fault) throw InputError(internal::describe_fault(*prior.system, states, *batch.fault));
  return batch;
}

namespace {

// ∂A/∂p, for any number of motions
class ParameterChange final : public ConstraintChange {
 public:
  explicit ParameterChange(const SystemValues::ConstBlock& dA) : dA_(dA) {}
  void add_product(const Ref<const MatrixXd>& x, Ref<MatrixXd> out) const override { out.noalias() += dA_ * x; }
  void subtract_transposed_product(const Ref<const MatrixXd>& y, Ref<MatrixXd> out) const override {
    out.noalias() -= dA_.transpose() * y;
  }

 private:
  SystemValues::ConstBlock dA_;
};

// The rows of the view at every state, and the columns of N.
// @param write  write(i, projection, G, d) writes every row of G and d (× 1) of a motion, or of their derivatives; where G is null d
//               alone, of what noise of deviation 1 makes of one constraint: db is no part of it
template <typename Write>
ViewValues collect(const View& view, const MechanicsBatch& mechanics, const Write& write) {
  const auto nq = static_cast<int>(mechanics.values.force.rows()),
             nc = static_cast<int>(mechanics.values.constraint_vector.rows());
  require_rows(view, nq, nc);
  std::vector<Index> soft;
  for (Index row = 0; row < mechanics.constraint_noise.size() && !view.latent; ++row) {
    if (mechanics.constraint_noise[row] > 0) soft.push_back(row);
  }
  const int n_rows = view.quantity->n_rows(nq, nc), n_states = mechanics.values.n_states();
  ViewValues out{MatrixXd(view.size() * nq, n_states), MatrixXd(view.size(), n_states),
                 MatrixXd(view.size() * std::ssize(soft), n_states)};
  MatrixXd G(n_rows, nq), d(n_rows, 1);
  UdwadiaKalaba unit;
  for (int i = 0; i < n_states; ++i) {
    write(i, mechanics.projections[static_cast<std::size_t>(i)], &G, d);
    Eigen::Map<MatrixXd>(out.matrix.col(i).data(), view.size(), nq) = G(view.rows, Eigen::all);
    out.offset.col(i) = d(view.rows, 0);
    for (std::size_t k = 0; k < soft.size(); ++k) {
      unit.compute(mechanics.values.M(i), mechanics.values.A(i),
                   mechanics.constraint_noise[soft[k]] * VectorXd::Unit(nc, soft[k]));
      write(i, unit, nullptr, d);
      out.slip.col(i).segment(static_cast<Index>(k) * view.size(), view.size()) = d(view.rows, 0);
    }
  }
  // what a latent adds has no part of the offset
  if (view.latent) out.offset.setZero();
  return out;
}

}  // namespace

ViewValues evaluate_view(const View& view, const MechanicsBatch& mechanics, const Ref<const MatrixXd>& states) {
  QuantityKind::Workspace workspace;
  AffineMotion motion;
  ViewValues out = collect(view, mechanics, [&](int i, const UdwadiaKalaba& projection, MatrixXd* G, MatrixXd& d) {
    const StateMechanics at{projection, mechanics.values.A(i), view.required_time_step()};
    motion.evaluate(projection, mechanics.values.M(i), view.quantity->parts());
    if (G != nullptr) view.quantity->evaluate(at, motion.linear(), *G, workspace);
    view.quantity->evaluate(at, motion.constant(), d, workspace);
  });
  const StateLayout layout{static_cast<int>(mechanics.values.force.rows()), 0};
  for (int k = 0; k < view.size(); ++k) {
    if (const std::optional<int> entry = view.added_entry(layout, k)) out.offset.row(k) += states.row(*entry);
  }
  return out;
}

ViewValues differentiate_view(const View& view, const MechanicsBatch& mechanics, const SystemValues& derivative) {
  QuantityKind::Workspace workspace;
  AffineMotion motion, dmotion;
  return collect(view, mechanics, [&](int i, const UdwadiaKalaba& projection, MatrixXd* G, MatrixXd& d) {
    const StateMechanics at{projection, mechanics.values.A(i), view.required_time_step()};
    if (G != nullptr) view.quantity->require_parameter_derivatives(at);
    const auto M = mechanics.values.M(i);
    const ParameterChange dA(derivative.A(i));
    VectorXd db = derivative.b(i);
    if (G == nullptr) db.setZero();
    motion.evaluate(projection, M, view.quantity->parts());
    dmotion.differentiate(projection, M, derivative.M(i), derivative.A(i), db, view.quantity->parts());
    if (G != nullptr) view.quantity->differentiate(at, motion.linear(), dmotion.linear(), dA, *G, workspace);
    view.quantity->differentiate(at, motion.constant(), dmotion.constant(), dA, d, workspace);
  });
}

}  // namespace gp2
