#include "inference/motion_under_load.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

MotionUnderLoad::MotionUnderLoad(const Prior& prior, const VectorXd& parameters, std::optional<int> derivative_in)
    : n_state_(prior.system->layout().size()),
      x_(n_state_ + prior.system->nc()),
      force_(prior.system->nq()),
      forced_slope_(prior.system->nq(), prior.system->nc()) {
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    if (!latent.reads_multipliers()) continue;
    const StateFunction* directions = latent.directions->of_multipliers();
    if (derivative_in) directions = directions->parameter_derivative(*derivative_in);
    OfLatent& of = latents_.emplace_back();
    of.latent = a;
    of.acts_on_forces = latent.base == Latent::Base::force;
    of.directions = directions->make_evaluator(parameters);
    of.c.setZero(latent.size());
    of.B.setZero(directions->size());
    of.dB.setZero(std::ssize(of.directions->entries()));
  }
}

void MotionUnderLoad::move_to(const Ref<const VectorXd>& state, const UdwadiaKalaba& projection, const VectorXd& without_load) {
  x_.head(n_state_) = state;
  projection_ = &projection;
  without_load_ = &without_load;
}

void MotionUnderLoad::evaluate(const VectorXd& lambda, VectorXd& a_bar, MatrixXd& slope) {
  const Index nq = force_.size();
  x_.tail(lambda.size()) = lambda;
  a_bar = *without_load_;
  slope.setZero();
  force_.setZero();
  forced_slope_.setZero();
  for (OfLatent& of : latents_) {
    of.directions->evaluate(x_, of.B);
    of.directions->differentiate(x_, of.dB);
    VectorXd& sum = of.acts_on_forces ? force_ : a_bar;
    MatrixXd& change = of.acts_on_forces ? forced_slope_ : slope;
    sum.noalias() += Map<const MatrixXd>(of.B.data(), nq, of.c.size()).lazyProduct(of.c);
    const auto& entries = of.directions->entries();
    for (std::size_t e = 0; e < entries.size(); ++e) {
      const Index row = entries[e].state_index - n_state_, output = entries[e].output;
      if (row >= 0) change(output % nq, row) += of.dB[static_cast<Index>(e)] * of.c[output / nq];
    }
  }
  projection_->solve_mass_in_place(force_);
  projection_->solve_mass_in_place(forced_slope_);
  a_bar += force_;
  slope += forced_slope_;
}

}  // namespace gp2
