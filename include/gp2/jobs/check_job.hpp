#pragma once

#include <map>
#include <string>
#include <vector>

#include "gp2/data/csv.hpp"
#include "gp2/export.hpp"
#include "gp2/jobs/option.hpp"
#include "gp2/mechanics/check.hpp"
#include "gp2/model.hpp"

namespace gp2 GP2_API {

struct CheckOptions {
  std::map<std::string, std::string> columns;  // model's name -> log's name, before the model's own [columns]
};
std::vector<Option> options(CheckOptions& options);

/// Is a model well-posed, and does a log fit it? Its mechanics, what its prior asks of them, the columns of the log, states on the
/// constraint, accelerations on A ddq = b, dependent columns.
/// @param log  null: at states drawn from the model's [sampling] or met in its [motion]
/// @throws InputError for columns that are missing, as LogReader.
std::vector<Finding> check(const Model& model, const CsvTable* log, const CheckOptions& options = {});

}  // namespace gp2
