#pragma once

#include <cstdint>
#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "gp2/baselines/baseline.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/fit.hpp"
#include "gp2/model.hpp"

namespace gp2 GP2_API {

/// A fitted model as a file: the model's text, the options its prior was made with, the data and the hyperparameters. The
/// posterior is computed anew from these, so a file loaded gives the same bits as before it was saved. Of a fit through inducing points
/// it holds what all data say, and of many data some.
struct FitFile {
  /// An empty one, for who fills in its members.
  FitFile() = default;
  /// The file of a fit, of which file.posterior() is the posterior.
  ///
  /// @param prior_options  that the prior of the fit was made with
  /// @param systems        as the member
  /// @throws InputError naming what differs: a model, prior_options or systems that make another prior than the fit has, or
  ///   hyperparameters of another posterior.
  FitFile(Model model, FitPriorOptions prior_options, const Fit& fit, std::vector<std::shared_ptr<const Model>> systems = {});

  /// 13: a kernel of latents along directions; 12: a discrepancy that grows outside the data; 11: a discrepancy that the constraint
  /// admits, centres of features, the logs; 10: what many observations say, in their place; 9: inducing points; 8: sums over
  /// states; 7: draws of hyperparameters; 6: a checksum and options, values that are not measured; 5: robots; 4: values with a noise
  /// of their own; 3: mechanics that are code; 2: observations of other systems. All of them are read; 13 is written.
  static constexpr int format_version = 13;

  Model model;
  FitPriorOptions prior_options;
  std::string library;      // version that wrote the file; empty: it is not from one
  std::string data_source;  // where the data came from, for people
  /// What it was learned from, as far as that is files; rows that were added from arrays stand there without a checksum.
  std::vector<LogFile> logs;
  std::vector<Observations> observations;
  /// Per Observations: the model file of its view's other system; null where it has none. May be shorter.
  std::vector<std::shared_ptr<const Model>> systems;
  FitReport report;     // with the fitted hyperparameters
  std::string options;  // what was asked of the fit, a JSON object (options_json); empty: not known
  /// What the fit said of itself and these data when it ended; nothing where it has not, or the data have changed since.
  std::optional<std::vector<std::string>> notes;

  [[nodiscard]] Prior prior() const { return make_prior(model, prior_options); }
  /// States that were fitted to, per Observations: more than `observations` have, where the file holds what they say in their place.
  [[nodiscard]] std::vector<std::int64_t> n_states() const;
  /// Whether it was learned from a log with the content of this one.
  [[nodiscard]] bool has_learned(const LogFile& log) const;
  /// The data of a posterior of this fit, which may have more since: they stand in `observations` and `report`.
  void take_data(const Posterior& posterior);
  /// The prior conditioned on the data, under the fitted hyperparameters or as the mixture over their draws.
  /// @throws InputError as model_values.
  [[nodiscard]] Posterior posterior() const;

  /// Written whole or not at all. @throws InputError when that fails, or `systems` lacks the model of another system.
  void write(const std::filesystem::path& path) const;
  /// @param code  what the models of the fit left to code (Model::code), which a file cannot hold. It must be the code of the fit, and is
  ///   compared with what that said at a few states of the data. The declaration's name tells mechanics of which model they are asked
  ///   for.
  /// @throws InputError naming the file and what is wrong: not a fit, of a newer format, cut short, changed after it was written
  ///   (its checksum is of another content; the text says how a change that is meant is made good), with values out of place,
  ///   with code where there is none to give or none given where there is, or with other code than that of the fit.
  static FitFile read(const std::filesystem::path& path, const ModelCode& code = {});
  /// @param text  what the file holds
  /// @param name  stands for the file in messages
  static FitFile parse(std::string_view text, const std::string& name);
};

/// Starting values for hyperparameters by name, from {"name": value, …} or a FitFile.
/// @param others  names that mean something else to the caller
/// @returns the values of `others`, and what else a fit has estimated: parameters of its system, delays and lags
/// @throws InputError naming the file, an unknown name (with those there are), or a value outside its bounds.
std::map<std::string, double> read_start_values(const std::filesystem::path& path, std::vector<Hyperparameter>& hyperparameters,
                                                const std::vector<std::string>& others = {});
/// The same from values at hand.
/// @param source  stands for them in messages
/// @param others  names that the caller takes too, which the error of an unknown one lists
void set_start_values(const std::map<std::string, double>& values, const std::string& source,
                      std::vector<Hyperparameter>& hyperparameters, const std::vector<std::string>& others = {});

}  // namespace gp2
