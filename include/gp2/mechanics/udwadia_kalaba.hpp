#pragma once

#include <functional>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/export.hpp"
#include "gp2/system.hpp"

namespace gp2 GP2_API {

/// The Udwadia–Kalaba equation at one state (Geist & Trimpe 2020, eq. 4):
///
///     ddq = L b + T ā,    L = M⁻¹Aᵀ(A M⁻¹Aᵀ)⁺,    T = I − L A,
///
/// computed without forming A M⁻¹Aᵀ: with M = C Cᵀ and B = A C⁻ᵀ, rows of B scaled to unit norm, a rank-revealing QR of Bᵀ gives
/// orthonormal bases of range(Bᵀ) and of its complement Z, and T = C⁻ᵀ Z Zᵀ Cᵀ. Any number of rows, redundant ones too.
///
/// Where M is singular (a massless coordinate; more coordinates than the bodies need) there is no ā, but a force F̄ still has one
/// motion if M is positive semidefinite and [M; A] has full column rank (Udwadia & Phohomsiri 2006). Then
///
///     M' = M + AᵀΣA,    Σ = diag(σ_1 … σ_nc) > 0,
///
/// is positive definite and stands for M in all that follows. The force AᵀΣb that it adds to M ddq = F̄ + Aᵀλ, as A ddq = b, is
/// one that the constraint takes up: ddq = T M'⁻¹F̄ + L b whatever Σ, and only λ, smaller by Σb than that of M', shows it.
/// T M'⁻¹ and L are the blocks of [(I − A⁺A) M; A]⁺. Each row is weighed by the masses that it holds together, so that neither
/// its scale nor units matter.
///
/// For control loops, `compute` takes one object to the next state. Const member functions may be called from several threads.
/// All functions that take matrices or vectors throw InputError when a size is wrong.
class UdwadiaKalaba {
 public:
  /// Directions of range(Bᵀ) whose pivot is below this fraction of the largest count as redundant.
  static constexpr double rank_tolerance = 1e-10;
  /// M, or M', counts as singular where a squared pivot of its Cholesky factorisation is below this fraction of its diagonal
  /// entry: half of the digits are lost there. An M that is positive definite beyond that, and that A does not complete, is used
  /// as it is.
  static constexpr double mass_tolerance = 1e-8;

  UdwadiaKalaba() = default;
  /// @param M  mass matrix        (nq × nq), symmetric positive definite, or semidefinite as above
  /// @param A  constraint matrix  (nc × nq)
  /// @param b  constraint vector  (nc)
  UdwadiaKalaba(const Eigen::Ref<const Eigen::MatrixXd>& M, const Eigen::Ref<const Eigen::MatrixXd>& A,
                const Eigen::Ref<const Eigen::VectorXd>& b) {
    compute(M, A, b);
  }

  /// The same at another state. Allocates nothing where the sizes are those of the call before.
  /// @param largest_rank  System::largest_rank_of(A): further directions of range(Bᵀ) count as redundant, and rows that have any may
  ///                      differ from b by the error of the state
  void compute(const Eigen::Ref<const Eigen::MatrixXd>& M, const Eigen::Ref<const Eigen::MatrixXd>& A,
               const Eigen::Ref<const Eigen::VectorXd>& b, int largest_rank = std::numeric_limits<int>::max());

  /// Memory of the functions below that take one: they allocate nothing where the sizes are those of the call before. One
  /// workspace serves any number of objects, of one thread.
  class Workspace {
    friend class UdwadiaKalaba;
    Eigen::VectorXd rows_;                    // (nc)
    Eigen::MatrixXd null_space_, null_rows_;  // (nc × nc)
    Eigen::VectorXd reflection_;              // (nc)
    Eigen::VectorXi order_;                   // (nc)
  };

  /// What M is to working precision.
  enum class Mass {
    positive_definite,
    singular,      // semidefinite, and [M; A] has full column rank: M' stands for M
    undetermined,  // semidefinite, but [M; A] leaves a direction in which nothing determines ddq
    indefinite,    // or not finite
  };
  [[nodiscard]] Mass mass_kind() const { return mass_kind_; }
  [[nodiscard]] bool mass_is_positive_definite() const { return mass_kind_ == Mass::positive_definite; }
  [[nodiscard]] bool mass_is_singular() const { return mass_kind_ == Mass::singular; }
  /// When it is not, nothing below is valid.
  [[nodiscard]] bool motion_is_determined() const { return mass_is_positive_definite() || mass_is_singular(); }

  [[nodiscard]] const Eigen::MatrixXd& mass() const { return mass_; }    // M' or, where M is positive definite, M  (nq × nq)
  [[nodiscard]] int rank() const { return rank_; }                       // of A
  [[nodiscard]] int n_zero_rows() const { return n_zero_rows_; }         // rows of A that vanish at this state; they are dropped
  [[nodiscard]] double inconsistency() const { return inconsistency_; }  // largest |A L b − b|, rows of B of unit norm
  [[nodiscard]] double size_of_b() const { return size_of_b_; }          // largest |b|, rows of B of unit norm

  /// Whether no acceleration satisfies A ddq = b: |A L b − b| is above `consistency_tolerance` of what accelerates the system at
  /// this state, |b| and the applied force F (nq), and above `rounding`. Not of rows that are known to be redundant.
  [[nodiscard]] bool is_contradictory(const Eigen::Ref<const Eigen::VectorXd>& F,
                                      double rounding = std::numeric_limits<double>::min()) const;
  static constexpr double consistency_tolerance = 1e-6;

  [[nodiscard]] const Eigen::MatrixXd& T() const { return T_; }    // (nq × nq)
  [[nodiscard]] const Eigen::VectorXd& Lb() const { return Lb_; }  // (nq) [ddq]

  /// L as a matrix (nq × nc). With redundant rows it is one of the generalised inverses with A L A = A; only L b is unique.
  [[nodiscard]] Eigen::MatrixXd L() const;
  /// The same, written to L (nq × nc). Allocates nothing.
  void write_L(Eigen::Ref<Eigen::MatrixXd> L) const;

  /// K = (Aᵀ)⁺ on the forces of constraints: λ = K Aᵀλ (nc × nq). Of the multipliers of redundant rows it gives those of minimum
  /// norm.
  [[nodiscard]] Eigen::MatrixXd multipliers_of_force() const;
  /// The same, written to K. Allocates nothing where the sizes are those of the call before.
  void write_multipliers_of_force(Eigen::MatrixXd& K, Workspace& workspace) const;

  /// M⁻¹ v, or M'⁻¹ v.
  [[nodiscard]] Eigen::MatrixXd solve_mass(const Eigen::Ref<const Eigen::MatrixXd>& v) const;
  /// v := M⁻¹ v or M'⁻¹ v, v (nq × any). Allocates nothing.
  void solve_mass_in_place(Eigen::Ref<Eigen::MatrixXd> v) const;

  /// The constrained acceleration of an unconstrained one, L b + T ā, with one step of refinement onto A ddq = b, but where
  /// redundant rows contradict each other by the error of a measured state.
  [[nodiscard]] Eigen::VectorXd constrain(const Eigen::Ref<const Eigen::VectorXd>& a_bar) const;
  /// The same, written to ddq (nq), which must not overlap a_bar.
  void constrain(const Eigen::Ref<const Eigen::VectorXd>& a_bar, Eigen::Ref<Eigen::VectorXd> ddq, Workspace& workspace) const;

  /// dM' = dM + dAᵀΣA + AᵀΣdA, or dM where M is positive definite. Here and below Σ is held: no ddq and no force depends on it.
  [[nodiscard]] Eigen::MatrixXd differentiate_mass(const Eigen::Ref<const Eigen::MatrixXd>& dM,
                                                   const Eigen::Ref<const Eigen::MatrixXd>& dA) const;

  struct Derivative {
    Eigen::MatrixXd T;   // dT     (nq × nq)
    Eigen::VectorXd Lb;  // d(L b) (nq)
  };
  /// dT and d(L b) for changes dM, dA, db that keep the rank of A:
  ///
  ///     d(L b) = T M⁻¹(dAᵀ Λb − dM L b) + L (db − dA L b),    Λ = (A M⁻¹Aᵀ)⁺
  ///     dT     = −T M⁻¹(dAᵀ Λ A − dM (I − T)) − L dA T
  [[nodiscard]] Derivative differentiate(const Eigen::Ref<const Eigen::MatrixXd>& dM, const Eigen::Ref<const Eigen::MatrixXd>& dA,
                                         const Eigen::Ref<const Eigen::VectorXd>& db) const;

 private:
  double factorise_mass(const Eigen::Ref<const Eigen::MatrixXd>& M, const Eigen::Ref<const Eigen::MatrixXd>& A);
  void complete_mass(const Eigen::Ref<const Eigen::MatrixXd>& M, const Eigen::Ref<const Eigen::MatrixXd>& A);
  void decompose_rows(int largest_rank);
  void invert_R_transposed();
  Mass mass_kind_ = Mass::positive_definite;
  int rank_ = 0;
  int n_zero_rows_ = 0;
  bool is_off_constraints_ = false;  // redundant rows seem to be independent
  double inconsistency_ = 0;
  double size_of_b_ = 0;
  Eigen::MatrixXd mass_;         // M or M'                  (nq × nq)
  Eigen::VectorXd row_mass_;     // σ                        (nc)
  Eigen::MatrixXd mass_factor_;  // C in the lower triangle  (nq × nq)
  Eigen::VectorXd row_scale_;    // 1 / norm of each row of B, 0 for a zero row
  Eigen::MatrixXd A_unit_;       // rows of A so scaled      (nc × nq)
  Eigen::VectorXd b_unit_;       // b so scaled              (nc)
  Eigen::MatrixXd L_unit_;       // L of the scaled rows     (nq × nc)
  Eigen::MatrixXd ML_unit_;      // M L of the scaled rows   (nq × nc)
  Eigen::MatrixXd T_;
  Eigen::VectorXd Lb_;
  // memory of the decompositions
  Eigen::VectorXd residual_;                  // (nc)
  Eigen::VectorXd weight_;                    // (nq)
  Eigen::MatrixXd A_T_;                       // (nc × nq)
  Eigen::MatrixXd rows_, R_transposed_;       // (nq × nc), (nc × min(nq, nc))
  Eigen::VectorXd reflection_, reflection2_;  // (min(nq, nc))
  Eigen::VectorXi order_, order2_;            // (nc), (min(nq, nc))
};

/// The Udwadia–Kalaba equation at N states.
struct MechanicsBatch {
  SystemValues values;
  std::vector<UdwadiaKalaba> projections;
  Eigen::VectorXd constraint_noise;  // of the system
  double size_of_b_elsewhere = 0;    // of states that these are a part of: an input, by which rounding is judged

  /// The first state at which M is singular, −1: none.
  [[nodiscard]] int first_singular() const;

  /// What makes the numbers unusable: the first state at which M is indefinite, nothing determines ddq in some direction, the
  /// constraints are inconsistent, or redundant though some are soft: what one row slips, the others would deny.
  struct Fault {
    int state = 0;
    std::string text;
  };
  std::optional<Fault> fault;
};

/// @param states      (system.layout().size() × N)
/// @param parameters  (system.parameters().size())
MechanicsBatch evaluate_mechanics(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                  const Eigen::Ref<const Eigen::VectorXd>& parameters);

/// The same, into the memory of an earlier batch: allocates nothing where the sizes are the same. After a fault, what belongs to
/// later states is left as it was.
void evaluate_mechanics(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                        const Eigen::Ref<const Eigen::VectorXd>& parameters, MechanicsBatch& batch);

/// The same of any number of states, block after block in the memory of a few. What is rounding is judged over all of them.
/// @param visit  called with the number of the first state of each block and its mechanics, where no state of it has a fault of its
///               own; by several threads at a time, in any order
/// @returns the fault, by its state among all
/// @throws InputError as the system, which names a state by its number among all; what `visit` throws
std::optional<MechanicsBatch::Fault> for_each_mechanics(
    const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states, const Eigen::Ref<const Eigen::VectorXd>& parameters,
    int n_threads, const std::function<void(Eigen::Index first, const MechanicsBatch& mechanics)>& visit);

/// The same, where a fault is an error.
/// @throws InputError naming the state and the rule; where nothing determines ddq in some direction, this direction too.
MechanicsBatch require_mechanics(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                 const Eigen::Ref<const Eigen::VectorXd>& parameters);

}  // namespace gp2
