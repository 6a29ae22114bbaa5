#pragma once

#include <memory>
#include <optional>
#include <vector>

#include "gp2/mechanics/state_evaluator.hpp"
#include "gp2/predictor.hpp"
#include "inference/data_distance.hpp"
#include "inference/motion_under_load.hpp"
#include "inference/posterior_implementation.hpp"
#include "inference/predictor_data.hpp"
#include "mechanics/multiplier_solver.hpp"
#include "prior/admissible_directions.hpp"

namespace gp2 {

template <typename Numbers>
bool is_finite(const Numbers& numbers) {
  // 0·x is 0 of a finite number only
  double sum = 0;
  for (const double number : numbers.reshaped()) sum += 0 * number;
  return sum == 0;
}

// What predicts by one component of a mixture, or by all that there is.
struct Predictor::Implementation {
  using Status = Predictor::Status;

  Prior prior;                 // where the view looks
  Eigen::VectorXd parameters;  // there
  View view;
  Options options;
  std::vector<PredictorTerm> terms;
  double time_step = 0;                           // Δt of the view's quantity
  MotionParts parts;                              // that it reads
  std::vector<std::optional<int>> added_entries;  // of the state, to each row of the view
  bool is_constrained = false;                    // ddq or Aᵀλ is one of them
  bool has_force = false;                         // μ or a direction that is multiplied by M⁻¹ …
  bool has_forced_latent = false;                 // … of which the deviation needs the directions
  bool needs_acceleration = false;                // ā itself, which is none where M is singular
  bool reads_multipliers = false;                 // a direction of a latent that is viewed reads λ
  PredictorData<double> in_double;
  PredictorData<float> in_single;
  DataDistance distance;  // of the first component of a mixture alone
  // Of a part of the motion that reads λ: what predicts λ, with which the whole moves.
  std::shared_ptr<const Implementation> multipliers;
  Eigen::Index n_covariance_rows = 0;  // d: of the view, or of the part that this is the whole of

  /// @param part  of which this is to be the whole
  Implementation(const Posterior::Implementation& posterior, View viewed, Options given, const View* part = nullptr);

  // work(data, memory) in the precision of the storage
  template <typename Work>
  void with_data(Workspace::Implementation& w, const Work& work) const;

  // the mean; NaN where the state cannot be evaluated
  Status write_mean(const Eigen::Ref<const Eigen::VectorXd>& state, StateEvaluator& at, Workspace::Implementation& w,
                    Eigen::Ref<Eigen::VectorXd>& mean) const;
  // these follow the mean at the same state
  void write_covariance(const StateEvaluator& at, Workspace::Implementation& w) const;
  void write_jacobian(const Eigen::Ref<const Eigen::VectorXd>& state, const StateEvaluator& at, Workspace::Implementation& w,
                      Eigen::Ref<Eigen::MatrixXd> jacobian) const;

  [[nodiscard]] double distance_at(const Eigen::Ref<const Eigen::VectorXd>& state, Workspace::Implementation& w) const;

  // λ, and what the latents that read it add to the force and to ā
  [[nodiscard]] Status evaluate_load(const Eigen::Ref<const Eigen::VectorXd>& state, const StateEvaluator& at,
                                     Workspace::Implementation& w) const;
  // G of every row at held λ; then what its change with λ adds, and G J D⁻¹
  void write_G(const StateEvaluator& at, Workspace::Implementation& w) const;
  void add_response(Workspace::Implementation& w) const;
  // whether other latents than those that are viewed are part of its deviation, by the load that they make
  [[nodiscard]] bool depends_on_others() const { return multipliers && view.latent; }

  [[nodiscard]] const Latent& latent(const PredictorTerm& term) const { return prior.latents[term.latent]; }
  [[nodiscard]] bool has_mean_force() const { return view.has_mean() && prior.mean == Prior::Mean::force; }
  [[nodiscard]] int n_quantity_rows() const { return view.quantity->n_rows(prior.system->nq(), prior.system->nc()); }

 private:
  // the projection at a state
  Status evaluate_mechanics(StateEvaluator& at, Workspace::Implementation& w) const;
  // ā there
  Status evaluate_prior(const Eigen::Ref<const Eigen::VectorXd>& state, const StateEvaluator& at,
                        Workspace::Implementation& w) const;
  // those of F̄, ddq and Aᵀλ that the view or the Jacobian needs
  void evaluate_motion(const StateEvaluator& at, Workspace::Implementation& w) const;
  // of a view's rows, whose Gᵀ for the latents that it has stands in `viewed`, for others in w
  void write_loadings(const View& of, const Workspace::Implementation& viewed, Workspace::Implementation& w) const;
  void differentiate_prior(const Eigen::Ref<const Eigen::VectorXd>& state, const StateEvaluator& at,
                           Workspace::Implementation& w) const;
  void differentiate_mechanics(const StateEvaluator& at, Workspace::Implementation& w) const;
  void differentiate_motion(const StateEvaluator& at, Workspace::Implementation& w) const;
};

struct Predictor::Workspace::Implementation {
  std::shared_ptr<const Predictor::Implementation> predictor;
  std::unique_ptr<StateEvaluator> values, values_and_derivatives;
  UdwadiaKalaba projection;
  UdwadiaKalaba::Workspace refinement;
  QuantityKind::Workspace quantity;
  AffineMotion affine_motion;

  struct AtState {
    std::unique_ptr<StateFunction::Evaluator> of_features, of_directions;
    MotionUnderLoad::OfLatent* under_load = nullptr;  // in the place of of_directions where they read λ
    Eigen::VectorXd features;                         // φ (D)
    Eigen::VectorXd point;                            // scaled
    Eigen::VectorXd directions;                       // B or B Π (nq·p), none where B = I
    std::optional<AdmissibleDirections> admissible;
    Eigen::VectorXd dfeatures, ddirections;  // their derivatives that do not vanish
    Eigen::VectorXd signal;                  // C g (p)
    Eigen::MatrixXd dsignal;                 // d(C g)/dφ (D × p)
    Eigen::MatrixXd E_dsignal;               // B d(C g)/dφ (nq × D)
  };
  std::vector<AtState> terms;
  Eigen::VectorXd a_bar;                        // ā
  Eigen::VectorXd force;                        // what is multiplied by M⁻¹ in it …
  Eigen::VectorXd a_of_force;                   // … and the product
  Eigen::VectorXd a;                            // ddq, or T ā of one latent alone
  Eigen::VectorXd gap;                          // a − ā
  Eigen::VectorXd of_constraint;                // Aᵀλ = M (a − ā)
  Eigen::VectorXd applied;                      // F̄ = M ā
  Eigen::VectorXd lambda;                       // λ (nc)
  Eigen::MatrixXd L;                            // (nq × nc)
  Eigen::MatrixXd d_of_rest;                    // of dā, what is not multiplied by M⁻¹ (nq × layout size)
  Eigen::MatrixXd d_force;                      // what is
  Eigen::MatrixXd d_forced;                     // … in da alone
  Eigen::MatrixXd d_rows;                       // db − dA a (nc × layout size)
  Eigen::MatrixXd d_a_bar, d_a;                 // dā, da
  Eigen::MatrixXd d_mass_a_bar;                 // M dā
  Eigen::MatrixXd d_of_constraint;              // dM (a − ā), then d(Aᵀλ)
  Eigen::MatrixXd d_applied;                    // dM ā, then dF̄
  Eigen::MatrixXd value, d_value;               // every row of the quantity (× 1), (× layout size)
  Eigen::MatrixXd G;                            // every row (× nq)
  std::unique_ptr<Implementation> multipliers;  // of what predicts λ
  std::optional<MotionUnderLoad> load;          // where λ is read, and for it:
  MultiplierSolver solver;
  LoadResponse response;
  Eigen::VectorXd without_load;               // ā without the latents that read λ
  Eigen::MatrixXd slope, G_lambda, d_lambda;  // J, G_λ, d_λ
  Eigen::MatrixXd GK;                         // G K of every row, of a part G J (× nc)
  Eigen::MatrixXd d_multipliers;              // ∂(G_λ ā + d_λ)/∂x at held λ (nc × layout size)
  Eigen::MatrixXd Gt, M_inverse_Gt;           // Gᵀ of the view (nq × d), of the whole of a part for what that has not
  std::vector<Eigen::MatrixXd> loadings;      // ℓ, per term (F × d)
  Eigen::MatrixXd covariance;                 // of the view, its lower triangle (d × d)
  Eigen::VectorXd coordinates;                // of the distance from the data
  Eigen::VectorXd mean;                       // of a component of a mixture, or of λ (d)
  Eigen::MatrixXd jacobian;                   // likewise (d × layout size)
  PredictorData<double>::Memory in_double;
  PredictorData<float>::Memory in_single;

  explicit Implementation(std::shared_ptr<const Predictor::Implementation> owner);

  [[nodiscard]] MotionColumns motion() const {
    return {columns_of(a), columns_of(a_bar), columns_of(of_constraint), columns_of(applied)};
  }
  [[nodiscard]] MotionColumns dmotion() const {
    return {columns_of(d_a), columns_of(d_a_bar), columns_of(d_of_constraint), columns_of(d_applied)};
  }
  [[nodiscard]] StateMechanics mechanics(const Eigen::Map<const Eigen::MatrixXd>& A) const {
    return {projection, A, predictor->time_step};
  }

 private:
  void reserve_mechanics();
  void reserve_term(const PredictorTerm& term);
};

template <typename Work>
void Predictor::Implementation::with_data(Workspace::Implementation& w, const Work& work) const {
  if (options.storage == Storage::single_precision) {
    work(in_single, w.in_single);
  } else {
    work(in_double, w.in_double);
  }
}

}  // namespace gp2
