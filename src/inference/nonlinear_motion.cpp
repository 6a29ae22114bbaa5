#include "inference/nonlinear_motion.hpp"

#include <utility>

#include "base/not_a_number.hpp"
#include "inference/motion_under_load.hpp"
#include "mechanics/multiplier_solver.hpp"

namespace gp2 {

using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

std::vector<MatrixXd> amplitudes_of(const Prior& prior, const std::vector<MatrixXd>& signals) {
  std::vector<MatrixXd> c = signals;
  for (std::size_t a = 0; a < c.size(); ++a) {
    if (prior.latents[a].is_positive) c[a] = c[a].array().exp();  // c' = c
  }
  return c;
}

}  // namespace

/// The motion at one state after another.
class NonlinearMotion::Under {
 public:
  /// @param derivative_in  of E in a parameter, in the place of E
  Under(const NonlinearMotion& of, const std::vector<MatrixXd>& c, std::optional<int> derivative_in = std::nullopt)
      : of_(of),
        c_(c),
        load_(of.prior_, of.parameters_, derivative_in),
        a_bar_(of.prior_.system->nq()),
        J_(a_bar_.size(), of.prior_.system->nc()) {}

  void move_to(int i) {
    without_load_ = of_.at_known_load_.mean.col(i);
    auto loaded = load_.latents().begin();
    for (std::size_t a = 0; a < c_.size(); ++a) {
      if (loaded != load_.latents().end() && loaded->latent == a) {
        loaded++->c = c_[a].col(i);
      } else {
        without_load_ += of_.at_known_load_.E(a, i) * c_[a].col(i);
      }
    }
    load_.move_to(of_.states_.col(i), of_.mechanics_.projections[static_cast<std::size_t>(i)], without_load_);
  }

  void evaluate(const VectorXd& lambda, VectorXd& a_bar, MatrixXd& slope) { load_.evaluate(lambda, a_bar, slope); }

  /// J at λ, and its part that has been multiplied by M⁻¹.
  const MatrixXd& slope(const VectorXd& lambda) {
    evaluate(lambda, a_bar_, J_);
    return J_;
  }
  [[nodiscard]] const MatrixXd& forced_slope() const { return load_.forced_slope(); }

 private:
  const NonlinearMotion& of_;
  const std::vector<MatrixXd>& c_;
  MotionUnderLoad load_;
  VectorXd without_load_, a_bar_;
  MatrixXd J_;
};

NonlinearMotion::NonlinearMotion(const Prior& prior, MatrixXd states, VectorXd parameters, const MechanicsBatch& mechanics,
                                 PriorValues at_known_load)
    : prior_(prior),
      states_(std::move(states)),
      parameters_(std::move(parameters)),
      mechanics_(mechanics),
      of_multipliers_(View::multipliers(*prior.system)),
      at_known_load_(std::move(at_known_load)),
      multipliers_(evaluate_view(of_multipliers_, mechanics, states_)) {}

Linearisation::OfGroup NonlinearMotion::without_signals() const {
  Linearisation::OfGroup none;
  for (const Latent& latent : prior_.latents) none.signals.emplace_back(MatrixXd::Zero(latent.size(), n_states()));
  return none;
}

std::optional<MechanicsBatch::Fault> NonlinearMotion::solve(Linearisation::OfGroup& at) const {
  const std::vector<MatrixXd> c = amplitudes_of(prior_, at.signals);
  Under under(*this, c);
  MultiplierSolver solver;
  at.multipliers.resize(prior_.system->nc(), n_states());
  std::optional<MechanicsBatch::Fault> fault;
  for (int i = 0; i < n_states(); ++i) {
    under.move_to(i);
    const auto motion = [&](const VectorXd& lambda, VectorXd& a_bar, MatrixXd& slope) { under.evaluate(lambda, a_bar, slope); };
    if (solver.solve(multipliers_.G(i), multipliers_.offset.col(i), motion)) {
      at.multipliers.col(i) = solver.lambda();
    } else {
      at.multipliers.col(i).setConstant(not_a_number);
      if (!fault) fault = solver.fault(i);
    }
  }
  return fault;
}

// Ẽ_a and o of positive latents, c' = c, from E_a and μ; or their derivatives
void NonlinearMotion::linearise_amplitudes(const Linearisation::OfGroup& at, const std::vector<MatrixXd>& c, int i,
                                           PriorValues& prior) const {
  for (std::size_t a = 0; a < c.size(); ++a) {
    if (!prior_.latents[a].is_positive) continue;
    Map<MatrixXd> E(prior.directions[a].col(i).data(), prior.mean.rows(), c[a].rows());
    prior.mean.col(i) += E * (c[a].col(i) - c[a].col(i).cwiseProduct(at.signals[a].col(i)));
    E = E * c[a].col(i).asDiagonal();
  }
}

void NonlinearMotion::linearise(const View& view, const Linearisation::OfGroup& at, ViewValues& viewed,
                                PriorValues& prior) const {
  const std::vector<MatrixXd> c = amplitudes_of(prior_, at.signals);
  prior = evaluate_prior(prior_, states_, parameters_, mechanics_, &at.multipliers);
  if (view.latent) return linearise_part(view, at, c, prior);
  keep_viewed(view, prior);
  // μ that the view has none of acts on λ all the same
  const MatrixXd hidden = at_known_load_.mean - prior.mean;
  Under under(*this, c);
  LoadResponse response;
  if (viewed.has_slip()) add_to_slip(at.noise_about ? *at.noise_about : at, viewed);
  for (int i = 0; i < n_states(); ++i) {
    linearise_amplitudes(at, c, i, prior);
    if (at.multipliers.rows() == 0) continue;
    under.move_to(i);
    const auto G_lambda = multipliers_.G(i);
    response.compute(under.slope(at.multipliers.col(i)), G_lambda);
    const MatrixXd GK = viewed.G(i) * response.K();
    viewed.offset.col(i) += GK * (G_lambda * hidden.col(i) + multipliers_.offset.col(i) - at.multipliers.col(i));
    Map<MatrixXd>(viewed.matrix.col(i).data(), viewed.offset.rows(), prior.mean.rows()) += GK * G_lambda;
  }
}

void NonlinearMotion::linearise_part(const View& view, const Linearisation::OfGroup& at, const std::vector<MatrixXd>& c,
                                     PriorValues& prior) const {
  PriorValues whole = prior;
  keep_viewed(view, prior);
  std::vector<MatrixXd> c_viewed = c;
  for (std::size_t a = 0; a < c.size(); ++a) {
    if (!view.has_latent(a)) c_viewed[a].setZero();
  }
  Under under(*this, c), under_viewed(*this, c_viewed);
  LoadResponse response;
  for (int i = 0; i < n_states(); ++i) {
    linearise_amplitudes(at, c, i, prior);
    linearise_amplitudes(at, c, i, whole);
    if (at.multipliers.rows() == 0) continue;
    under.move_to(i);
    under_viewed.move_to(i);
    const auto G_lambda = multipliers_.G(i);
    response.compute(under.slope(at.multipliers.col(i)), G_lambda, under_viewed.slope(at.multipliers.col(i)));
    const MatrixXd& K = response.K();
    prior.mean.col(i) += K * (G_lambda * whole.mean.col(i) + multipliers_.offset.col(i) - at.multipliers.col(i));
    for (std::size_t a = 0; a < c.size(); ++a) {
      Map<MatrixXd>(prior.directions[a].col(i).data(), prior.mean.rows(), c[a].rows()) += K * (G_lambda * whole.E(a, i));
    }
  }
}

void NonlinearMotion::add_to_slip(const Linearisation::OfGroup& at, ViewValues& viewed) const {
  const std::vector<MatrixXd> c = amplitudes_of(prior_, at.signals);
  Under under(*this, c);
  LoadResponse response;
  for (int i = 0; i < n_states(); ++i) {
    under.move_to(i);
    response.compute(under.slope(at.multipliers.col(i)), multipliers_.G(i));
    viewed.slip.col(i) += (viewed.G(i) * response.K() * multipliers_.N(i)).reshaped();
  }
}

void NonlinearMotion::differentiate(const Linearisation::OfGroup& at, const SystemValues& derivative, int index,
                                    const ViewValues& viewed, ViewValues& d_viewed, PriorValues& d_prior) const {
  const std::vector<MatrixXd> c = amplitudes_of(prior_, at.signals);
  const PriorValues values = evaluate_prior(prior_, states_, parameters_, mechanics_, &at.multipliers);
  // Only latents that read the multipliers depend on them; those of redundant rows have no derivative.
  const bool is_under_load = std::ranges::any_of(prior_.latents, &Latent::reads_multipliers);
  const ViewValues d_multipliers = is_under_load ? differentiate_view(of_multipliers_, mechanics_, derivative) : ViewValues();
  d_prior = differentiate_prior(prior_, states_, parameters_, mechanics_, values, derivative, index, &at.multipliers);
  Under under(*this, c), derivative_under(*this, c, index);
  LoadResponse response;
  for (int i = 0; i < n_states(); ++i) {
    linearise_amplitudes(at, c, i, d_prior);
    if (!is_under_load) continue;
    under.move_to(i);
    derivative_under.move_to(i);
    const MatrixXd& J = under.slope(at.multipliers.col(i));
    // dJ = ∂(∂E/∂p c)/∂λ − M⁻¹dM J, the latter of the part of J that acts on forces
    const UdwadiaKalaba& projection = mechanics_.projections[static_cast<std::size_t>(i)];
    const MatrixXd dJ =
        derivative_under.slope(at.multipliers.col(i)) -
        projection.solve_mass(projection.differentiate_mass(derivative.M(i), derivative.A(i)) * under.forced_slope());
    const auto G = viewed.G(i), G_lambda = multipliers_.G(i);
    const auto dG = d_viewed.G(i), dG_lambda = d_multipliers.G(i);
    response.compute(J, G_lambda);
    const MatrixXd &K = response.K(), dK = response.over_D(dJ + K * (dG_lambda * J + G_lambda * dJ));
    const VectorXd gap = multipliers_.offset.col(i) - at.multipliers.col(i);
    if (viewed.has_slip()) {
      d_viewed.slip.col(i) += ((dG * K + G * dK) * multipliers_.N(i) + G * (K * d_multipliers.N(i))).reshaped();
    }
    d_viewed.offset.col(i) += dG * (K * gap) + G * (dK * gap + K * d_multipliers.offset.col(i));
    const MatrixXd d_matrix = dG + dG * K * G_lambda + G * (dK * G_lambda + K * dG_lambda);
    Map<MatrixXd>(d_viewed.matrix.col(i).data(), d_viewed.offset.rows(), G.cols()) = d_matrix;
  }
}

}  // namespace gp2
