#include "inference/nonlinear_motion.hpp"

#include <memory>
#include <utility>

#include <Eigen/LU>

#include "base/not_a_number.hpp"
#include "mechanics/multiplier_solver.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

const StateFunction* of_multipliers(const Latent& latent) {
  return latent.directions ? latent.directions->of_multipliers() : nullptr;
}

std::vector<MatrixXd> amplitudes_of(const Prior& prior, const std::vector<MatrixXd>& signals) {
  std::vector<MatrixXd> c = signals;
  for (std::size_t a = 0; a < c.size(); ++a) {
    if (prior.latents[a].is_positive) c[a] = c[a].array().exp();  // c' = c
  }
  return c;
}

}  // namespace

/// ā(λ) and ∂ā/∂λ at one state after another.
class NonlinearMotion::Directions {
 public:
  explicit Directions(const NonlinearMotion& of) : of_(of), x_(of.states_.rows() + of.prior_.system->nc()) {
    for (const Latent& latent : of.prior_.latents) {
      const StateFunction* const function = of_multipliers(latent);
      evaluators_.push_back(function != nullptr ? function->make_evaluator(of.parameters_) : nullptr);
    }
  }

  /// @param c  amplitudes, per latent
  void move_to(int i, const std::vector<MatrixXd>& c) {
    i_ = i;
    c_ = &c;
    without_load_ = of_.at_known_load_.mean.col(i);
    for (std::size_t a = 0; a < c.size(); ++a) {
      if (!evaluators_[a]) without_load_ += of_.at_known_load_.E(a, i) * c[a].col(i);
    }
  }

  void evaluate(const VectorXd& lambda, VectorXd& a_bar, MatrixXd& slope) {
    const Index nq = without_load_.size(), n_state = of_.states_.rows();
    const UdwadiaKalaba& projection = of_.mechanics_.projections[static_cast<std::size_t>(i_)];
    x_ << of_.states_.col(i_), lambda;
    a_bar = without_load_;
    slope.setZero(nq, lambda.size());
    forced_slope_ = slope;
    for (std::size_t a = 0; a < evaluators_.size(); ++a) {
      if (!evaluators_[a]) continue;
      const auto c = (*c_)[a].col(i_);
      const auto& entries = evaluators_[a]->entries();
      B_.resize(nq * c.size());
      dB_.resize(std::ssize(entries));
      evaluators_[a]->evaluate(x_, B_);
      evaluators_[a]->differentiate(x_, dB_);
      VectorXd added = Map<const MatrixXd>(B_.data(), nq, c.size()) * c;
      MatrixXd change = MatrixXd::Zero(nq, lambda.size());
      for (std::size_t e = 0; e < entries.size(); ++e) {
        const Index row = entries[e].state_index - n_state, j = entries[e].output % nq, l = entries[e].output / nq;
        if (row >= 0) change(j, row) += dB_[static_cast<Index>(e)] * c[l];
      }
      if (of_.prior_.latents[a].base == Latent::Base::force) {
        projection.solve_mass_in_place(added);
        projection.solve_mass_in_place(change);
      }
      a_bar += added;
      slope += change;
      if (of_.prior_.latents[a].base == Latent::Base::force) forced_slope_ += change;
    }
  }

  /// The part of the slope that has been multiplied by M⁻¹.
  [[nodiscard]] const MatrixXd& forced_slope() const { return forced_slope_; }

 private:
  const NonlinearMotion& of_;
  std::vector<std::unique_ptr<StateFunction::Evaluator>> evaluators_;  // null where λ is not read
  int i_ = 0;
  const std::vector<MatrixXd>* c_ = nullptr;
  VectorXd without_load_, x_, B_, dB_;
  MatrixXd forced_slope_;
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
  Directions directions(*this);
  MultiplierSolver solver;
  at.multipliers.resize(prior_.system->nc(), n_states());
  std::optional<MechanicsBatch::Fault> fault;
  for (int i = 0; i < n_states(); ++i) {
    directions.move_to(i, c);
    const auto motion = [&](const VectorXd& lambda, VectorXd& a_bar, MatrixXd& slope) {
      directions.evaluate(lambda, a_bar, slope);
    };
    if (solver.solve(multipliers_.G(i), multipliers_.offset.col(i), motion)) {
      at.multipliers.col(i) = solver.lambda();
    } else {
      at.multipliers.col(i).setConstant(not_a_number);
      if (!fault) fault = solver.fault(i);
    }
  }
  return fault;
}

void NonlinearMotion::linearise(const View& view, const Linearisation::OfGroup& at, ViewValues& viewed,
                                PriorValues& prior) const {
  const std::vector<MatrixXd> c = amplitudes_of(prior_, at.signals);
  prior = evaluate_prior(prior_, states_, parameters_, mechanics_, &at.multipliers);
  keep_viewed(view, prior);
  Directions directions(*this);
  VectorXd a_bar;
  MatrixXd J;
  for (int i = 0; i < n_states(); ++i) {
    // μ that the view has none of acts on λ all the same
    const VectorXd hidden = at_known_load_.mean.col(i) - prior.mean.col(i);
    for (std::size_t a = 0; a < c.size(); ++a) {
      if (!prior_.latents[a].is_positive) continue;
      Map<MatrixXd> E(prior.directions[a].col(i).data(), prior.mean.rows(), c[a].rows());
      prior.mean.col(i) += E * (c[a].col(i) - c[a].col(i).cwiseProduct(at.signals[a].col(i)));
      E = E * c[a].col(i).asDiagonal();
    }
    if (view.latent || at.multipliers.rows() == 0) continue;  // of one latent: at λ*, of which all are part
    directions.move_to(i, c);
    directions.evaluate(at.multipliers.col(i), a_bar, J);
    const auto G_lambda = multipliers_.G(i);
    const MatrixXd D = MatrixXd::Identity(J.cols(), J.cols()) - G_lambda * J;
    const MatrixXd GK = viewed.G(i) * D.transpose().partialPivLu().solve(J.transpose()).transpose();
    viewed.offset.col(i) += GK * (G_lambda * hidden + multipliers_.offset.col(i) - at.multipliers.col(i));
    Map<MatrixXd>(viewed.matrix.col(i).data(), viewed.offset.rows(), J.rows()) += GK * G_lambda;
  }
}

void NonlinearMotion::differentiate(const Linearisation::OfGroup& at, const SystemValues& derivative, int index,
                                    const ViewValues& viewed, ViewValues& d_viewed, PriorValues& d_prior) const {
  const std::vector<MatrixXd> c = amplitudes_of(prior_, at.signals);
  const PriorValues values = evaluate_prior(prior_, states_, parameters_, mechanics_, &at.multipliers);
  const ViewValues d_multipliers = differentiate_view(of_multipliers_, mechanics_, derivative);
  d_prior = differentiate_prior(prior_, states_, parameters_, mechanics_, values, derivative, index, &at.multipliers);
  const Index nq = prior_.system->nq();
  Directions directions(*this);
  VectorXd a_bar;
  MatrixXd J;
  for (int i = 0; i < n_states(); ++i) {
    for (std::size_t a = 0; a < c.size(); ++a) {
      if (!prior_.latents[a].is_positive) continue;
      Map<MatrixXd> dE(d_prior.directions[a].col(i).data(), nq, c[a].rows());
      d_prior.mean.col(i) += dE * (c[a].col(i) - c[a].col(i).cwiseProduct(at.signals[a].col(i)));
      dE = dE * c[a].col(i).asDiagonal();
    }
    if (at.multipliers.rows() == 0) continue;
    // dJ = −M⁻¹dM J; of a J on the acceleration it is 0
    const UdwadiaKalaba& projection = mechanics_.projections[static_cast<std::size_t>(i)];
    directions.move_to(i, c);
    directions.evaluate(at.multipliers.col(i), a_bar, J);
    const MatrixXd dJ =
        -projection.solve_mass(projection.differentiate_mass(derivative.M(i), derivative.A(i)) * directions.forced_slope());
    const auto G = viewed.G(i), G_lambda = multipliers_.G(i);
    const auto dG = d_viewed.G(i), dG_lambda = d_multipliers.G(i);
    const Eigen::PartialPivLU<MatrixXd> D_T((MatrixXd::Identity(J.cols(), J.cols()) - G_lambda * J).transpose());
    const auto over_D = [&](const MatrixXd& X) -> MatrixXd { return D_T.solve(X.transpose()).transpose(); };
    const MatrixXd K = over_D(J), dK = over_D(dJ + K * (dG_lambda * J + G_lambda * dJ));
    const VectorXd gap = multipliers_.offset.col(i) - at.multipliers.col(i);
    d_viewed.offset.col(i) += dG * (K * gap) + G * (dK * gap + K * d_multipliers.offset.col(i));
    const MatrixXd d_matrix = dG + dG * K * G_lambda + G * (dK * G_lambda + K * dG_lambda);
    Map<MatrixXd>(d_viewed.matrix.col(i).data(), d_viewed.offset.rows(), nq) = d_matrix;
  }
}

}  // namespace gp2
