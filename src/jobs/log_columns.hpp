#pragma once

#include <map>
#include <string>
#include <vector>

#include "gp2/data/csv.hpp"
#include "gp2/data/log_reader.hpp"
#include "gp2/model.hpp"
#include "gp2/posterior.hpp"

// Which columns of a log a model reads.
namespace gp2 {

/// Names of columns: those given, then the model's own [columns].
std::map<std::string, std::string> columns_of(const Model& model, std::map<std::string, std::string> columns);

/// @throws InputError for a renaming that finds nothing, which is a slip of the pen: the model's [columns] may name columns that
/// these logs lack, `columns` may not.
void check_columns(const System& system, const std::vector<const CsvTable*>& logs,
                   const std::map<std::string, std::string>& columns);

/// Those of `columns` that one of these logs has.
std::map<std::string, std::string> columns_in(const std::vector<const CsvTable*>& logs, const System& system,
                                              std::map<std::string, std::string> columns);

/// columns_of, for logs that are read together.
/// @throws InputError as check_columns.
std::map<std::string, std::string> checked_columns(const Model& model, const std::vector<const CsvTable*>& logs,
                                                   const std::map<std::string, std::string>& columns);

/// Whether a log has a column for this, with something in it; an empty one counts as read too.
bool has_values(LogReader& reader, const std::string& name);

/// After the reading is done: what was read under another name, and which columns were not read.
void note_reading(const LogReader& reader, std::vector<std::string>& notes);

/// The accelerations to compare predictions with where none are asked for: those that any observation of the fit has, as far as the
/// log has them.
/// @param notes  receives what is left out
std::vector<std::string> outputs_to_compare(const Posterior& posterior, const Model& model, const CsvTable& log,
                                            const std::map<std::string, std::string>& columns, std::vector<std::string>& notes);

}  // namespace gp2
