#pragma once

#include <memory>
#include <vector>

#include "files/json_values.hpp"
#include "files/prior_difference.hpp"
#include "gp2/files/fit_file.hpp"

// The parts of a FIT.json, each written by …_json and read by …_from.
namespace gp2::fit_json {

// model_json.cpp
Json model_json(const Model& model);
Model model_from(const ParsedJson& json, const ModelCode& given);
Json prior_json(const FitPriorOptions& options);
FitPriorOptions prior_from(const ParsedJson& json);

// hyperparameter_json.cpp
Json hyperparameters_json(const std::vector<Hyperparameter>& hyperparameters, const Prior& prior);
// As they are labelled: locate_in_model finds the entry of a loading.
std::vector<Hyperparameter> hyperparameters_from(const ParsedJson& json);
// Every hyperparameter belongs to something the model has, once, and every kernel and signal has its values.
void locate_in_model(std::vector<Hyperparameter>& hyperparameters, const Prior& prior,
                     const std::vector<Observations>& observations);

// observations_json.cpp
/// @param other  the model of its view's other system; null: none
Json observations_json(const Observations& group, const Prior& fitted, const Model* other);
Observations observations_from(const ParsedJson& json, const Prior& fitted, std::shared_ptr<const OtherSystem> other_system);

// code_json.cpp: what code that a file cannot hold says at a few states of the data
Json code_json(const PriorAt& at, const Observations& group);
/// @throws InputError naming what the code given says otherwise.
void require_code(const ParsedJson& json, const PriorAt& at, const Observations& group);

Json logs_json(const std::vector<LogFile>& logs);
std::vector<LogFile> logs_from(const ParsedJson& json);

// report_json.cpp, without hyperparameters and actuators
Json report_json(const FitReport& report);
/// @param report        has the hyperparameters; all else of it is read
/// @param observations  that they are of
void read_report(const ParsedJson& json, const Prior& prior, const std::vector<Observations>& observations, FitReport& report);
Json actuators_json(const std::vector<ActuatorEstimate>& estimates);
// Of the actuators of a model, which get these values.
std::vector<ActuatorEstimate> actuators_from(const ParsedJson& json, std::vector<Actuator>& actuators);

// inducing_json.cpp; what a summary is of is read apart from it, since it needs the points and the draws
Json inducing_json(const InducingReport& inducing);
InducingReport inducing_from(const ParsedJson& json, const Prior& prior);
/// @param report  has the hyperparameters, their draws and the inducing points
std::shared_ptr<const InducingSummary> summary_from(const ParsedJson& json, const Prior& prior,
                                                    const std::vector<Observations>& observations, const FitReport& report);

}  // namespace gp2::fit_json
