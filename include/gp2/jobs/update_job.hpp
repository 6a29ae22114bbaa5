#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/jobs/fit_memory.hpp"
#include "gp2/jobs/option.hpp"

namespace gp2 GP2_API {

/// How more data are added to a fit, its hyperparameters held.
struct UpdateRequest {
  std::vector<std::string> observe;            // accelerations; empty: those that the fit observed
  std::optional<double> noise_stddev;          // of each; not given: as the log states it, else as in the fit
  std::map<std::string, std::string> columns;  // model's name -> log's name, before the model's own [columns]
  std::optional<double> forget;                // before: what was learned counts as this share of it
  std::optional<int> window;                   // after: the newest states that are left
};
std::vector<Option> options(UpdateRequest& request);

/// What a log adds to the observations of a fit.
/// @param posterior  of the fit
/// @param notes      receives what the reading has to say; rows that measure nothing are left out
/// @throws InputError when the log lacks a column, or the noise of what it measures is not known.
Observations more_observations(const FitFile& fit, const Posterior& posterior, const CsvTable& log, const UpdateRequest& request,
                               std::vector<std::string>& notes);

/// Before more observations are added: an exact posterior of all must find the memory that it takes. Small ones always do.
/// @param free   as free_memory()
/// @param given  as is_given
/// @throws InputError with the rows that would fit
void require_memory_of_more(const Posterior& posterior, const Observations& more, const std::string& log,
                            const std::function<std::optional<double>()>& free,
                            const std::function<bool(double, int)>& given = is_given);

/// update(), with a word where what went through inducing points has none near the new observations. The range of the discrepancy (T23),
/// in the posterior and in the fit, becomes that of all rows.
/// @param fit  whose report loses the draws of the hyperparameters under which there is no posterior of all; and learns the log's name
/// @throws InputError as require_memory_of_more; NumericalError as update().
Posterior with_more(Posterior&& posterior, FitFile& fit, Observations more, const CsvTable& log, std::vector<std::string>& notes);

/// remove_oldest() of a posterior and its fit, whose report keeps the distrusted values among what is left. Logs of which nothing is left
/// are struck from the fit.
Posterior remove_oldest(Posterior&& posterior, FitFile& fit, int n);

/// Before more observations are added: what a window leaves behind goes, of what was learned and of what is added.
/// @throws InputError as keep_newest.
void make_room(Posterior& posterior, FitFile& fit, Observations& more, const UpdateRequest& request);

/// Leaves the newest states that a window asks for, and the logs that they are of.
/// @throws InputError as remove_oldest, and for a window that is not positive, or of a fit through inducing points or to windows of a raw
///   log.
void keep_newest(Posterior& posterior, FitFile& fit, const UpdateRequest& request);

struct UpdateOutcome {
  FitFile fit;
  std::int64_t n_added = 0, n_states = 0;  // states: of the logs as far as they are in the fit then, and of the fit
  std::vector<std::string> notes;
};

/// The fit with these logs too, one after the other: update, forget and remove_oldest of its posterior.
/// @throws InputError as more_observations, forget and remove_oldest; NumericalError as update.
UpdateOutcome update(FitFile fit, const std::vector<CsvTable>& logs, const UpdateRequest& request);

}  // namespace gp2
