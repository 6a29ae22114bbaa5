#pragma once

#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "export/fill_template.hpp"
#include "gp2/export/c_source.hpp"
#include "gp2/mechanics/state_evaluator.hpp"
#include "gp2/predictor.hpp"
#include "inference/posterior_implementation.hpp"

namespace gp2::c_export {

inline constexpr Eigen::Index lanes = 8;

inline Eigen::Index whole(Eigen::Index n) { return (n + lanes - 1) / lanes * lanes; }

// What stands in the C for a latent of a view; the code is the same in every component of a mixture.
struct Term {
  std::size_t latent = 0;      // of the prior
  const Latent* of = nullptr;  // there
  bool is_viewed = true;       // or acts on the load of the motion alone, a part of which is viewed
  Kernel kernel;
  Eigen::Index D = 0, p = 0, F = 0;  // features, directions, functions
  Eigen::Index first = 0;            // of its functions among all
  Eigen::Index n_points = 0;         // the most of all components
  std::unique_ptr<StateFunction::Evaluator> features, directions;
  Eigen::VectorXd admissible;      // s, of directions that the constraint changes; else empty
  bool reads_multipliers = false;  // λ, in directions
  Filling filling;                 // of the templates of a latent

  [[nodiscard]] bool has_directions() const { return of->directions != nullptr; }
  [[nodiscard]] bool is_admissible() const { return admissible.size() > 0; }
  [[nodiscard]] bool features_read_load() const { return features->tapes().n_loads > 0; }
  [[nodiscard]] bool directions_read_load() const { return has_directions() && directions->tapes().n_loads > 0; }  // λ₀
  [[nodiscard]] bool features_vary() const { return reads_features() && !features->tapes().entries->empty(); }
  [[nodiscard]] bool directions_vary() const { return has_directions() && !directions->tapes().entries->empty(); }
  [[nodiscard]] bool is_forced() const { return of->base == Latent::Base::force; }
  [[nodiscard]] bool reads_features() const;
  [[nodiscard]] bool is_se() const;
};

// What each factor of a kernel multiplies the features by.
Eigen::VectorXd scales_of(const KernelColumns& columns);

// Whether a name can stand in C: no keyword, and nothing that the functions call their own.
bool is_identifier(const std::string& text);
std::string in_comment(std::string text);

// The exported C of a view. Each part of it has a file c_….cpp, whose texts c_source.cpp puts into the templates.
class Writer {
 public:
  using Component = std::shared_ptr<const Posterior::Implementation>;

  Writer(const Posterior& posterior, std::vector<Component> components, View view, const CSourceOptions& options);
  Writer(const Writer&) = delete;
  Writer& operator=(const Writer&) = delete;
  [[nodiscard]] CSource write();

 private:
  // c_writer.cpp
  void add_terms();
  void set_names();
  void set_conditions();
  void set_sizes();
  [[nodiscard]] std::string number(double value) const;
  [[nodiscard]] std::string numbers(const double* values, Eigen::Index n) const;
  std::string table(const std::string& type, const std::string& wanted, const std::vector<std::string>& entries);
  std::string table(const std::string& wanted, const double* values, Eigen::Index n);
  std::string function(const std::string& wanted, const std::string& head, const std::string& body);
  [[nodiscard]] const System& system() const { return *prior_.system; }
  [[nodiscard]] bool has(const std::string& condition) const { return filling_.has(condition); }
  std::string& text(const std::string& name) { return filling_.texts[name]; }

  // c_workspace.cpp
  void declare_workspace();
  void add_workspace(const std::string& declaration) { text("workspace") += "  " + declaration + "\n"; }

  // c_learned.cpp
  void write_learned();
  [[nodiscard]] std::string triangle_of(const LatentPosterior& latents, std::size_t k);

  // c_expressions.cpp
  void write_expressions();
  void write_system();
  void write_state_function(Term& term, const std::string& name, StateFunction::Evaluator& of, bool is_differentiated);
  [[nodiscard]] std::string program(const Tape& tape, const std::vector<std::string>& results, bool with_parameters,
                                    const std::vector<std::string>& loads = {}) const;

  // c_kernels.cpp
  void write_kernels();
  void write_of(Term& term, const std::string& what, const std::string& head, const std::string& body);
  void write_kernel(Term& term);
  void write_potential(Term& term);

  // c_latents.cpp
  void write_latents();

  // c_self_test.cpp
  void write_tests();
  void require_single_precision() const;
  [[noreturn]] void throw_untestable(const Eigen::MatrixXd& observed) const;
  [[nodiscard]] Eigen::VectorXd cancelled_at(const Eigen::VectorXd& state) const;
  [[nodiscard]] double steepest_scale() const;
  [[nodiscard]] double rounding_of_variance() const;
  [[nodiscard]] int rank_at(const Eigen::VectorXd& state) const;
  [[nodiscard]] double require_fine_state(const Predictor& predictor, Predictor::Workspace& workspace,
                                          const Eigen::VectorXd& state, const Eigen::VectorXd& mean,
                                          const Eigen::VectorXd& variance, double allowed) const;

  // c_source.cpp
  void write_comments();

  const Posterior& posterior_;
  std::vector<Component> components_;
  View view_;
  CSourceOptions options_;
  Prior prior_;  // where the view looks
  StateLayout layout_;
  std::vector<std::string> inputs_;                           // what C calls the entries of a state, then the parameters
  std::vector<std::string> known_multipliers_, multipliers_;  // and λ₀, λ
  std::vector<Term> terms_;
  bool is_partial_ = false;  // a part of the motion whose load the whole of it makes
  std::unique_ptr<StateEvaluator> values_, derivatives_;
  bool all_rows_ = true;
  Eigen::Index n_functions_ = 0, n_variables_ = 0, n_cross_rows_ = 0;
  Filling filling_;
  std::map<std::string, std::string> known_;  // text of a table or a function -> its name
};

}  // namespace gp2::c_export
