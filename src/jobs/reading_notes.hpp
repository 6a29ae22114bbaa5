#pragma once

#include <map>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/actuator.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "jobs/readings.hpp"

// What a person should know of the states and values that were read from a log.
namespace gp2 {

/// Warns of states that are off a constraint.
/// @param fit  the options of the fit that the log is read for: values of parameters that it estimates are not known yet;
///   null: none
void note_violation(const System& system, const Eigen::MatrixXd& states, const Eigen::VectorXd& parameters,
                    const std::string& log, std::vector<std::string>& notes, const FitProblemOptions* fit = nullptr);

/// The likelihood would refuse these states too, but it does not know their rows in the log. Warns where a constraint
/// lets go at some of them.
/// @param rows  of the log, of each state
/// @throws InputError naming the row of a state at which the mechanics are not defined.
void require_mechanics_at(const LoggedSystem& logged, const View& view, const Eigen::MatrixXd& states,
                          const std::vector<int>& rows, const std::string& log, std::vector<std::string>& notes);

/// Warns of accelerations that follow from others, which are no measurements; which of them count may change from row to row.
/// @param accelerations  all of the system; empty: not all are measured, or nothing constrains them
void note_dependence(const LoggedSystem& logged, const Readings& readings, const FitProblemOptions& options,
                     const Eigen::MatrixXd& accelerations, const std::string& log, std::vector<std::string>& notes);

/// What is wrong with rows, if more than a twentieth, that are at rest where dry friction of a model jumps: there and in the row before or
/// behind all velocities are 0 and the coordinates the same, as far as they are known, and measured values a quarter of the largest of
/// their column at most. Empty where nothing is.
std::string text_of_rest(const Model& model, const Eigen::VectorXd& parameters, const Eigen::MatrixXd& states,
                         const Eigen::MatrixXd& values);
/// Warns of that: friction at rest is whatever holds, up to a limit.
void note_rest(const Model& model, const Eigen::VectorXd& parameters, const Eigen::MatrixXd& states,
               const Eigen::MatrixXd& values, const std::string& log, std::vector<std::string>& notes);

/// Columns of a log in order of time that are the same in a stretch of eight rows or more, and hardly ever elsewhere from one row to the
/// next, a sentence each. A coordinate, a velocity or an acceleration contradicts there what its rate, or that of which it is one, says;
/// an input is neither 0 nor at an extreme, and the system moves.
/// @param states         (layout size × N); NaN: not known
/// @param accelerations  (nq × N); NaN: not measured
std::vector<std::string> stuck_channels(const System& system, const Eigen::MatrixXd& states,
                                        const Eigen::MatrixXd& accelerations);

/// That inputs act at a wrong time where t is in another unit than their delays and lags; nothing where it is in seconds, or where no
/// input that is read acts late.
/// @param reads         which entries of a state are read
/// @param unit_of_time  as wrong_rates tells it [s]
std::optional<std::string> text_of_late_inputs(const System& system, const std::vector<bool>& reads,
                                               const std::vector<Actuator>& actuators, double unit_of_time);

/// Warns of that.
/// @param columns    as checked
/// @param actuators  of the inputs of the log
/// @param unit       receives the unit of time [s], if given
/// @returns columns of the log that are not the rates of what they should be over its time, whether or not a prior reads that
std::vector<std::string> note_late_inputs(const Prior& prior, const CsvTable& log,
                                          const std::map<std::string, std::string>& columns,
                                          const std::vector<Actuator>& actuators, std::vector<std::string>& notes,
                                          double* unit = nullptr);

/// Warns of wrong rates, of delays in another unit than t, and of channels that are stuck for a while.
/// @param actuators  of the inputs of the log
/// @returns whether rates or delays are wrong, which makes sound inputs look wrong
bool note_channels(const Prior& prior, const CsvTable& log, const std::map<std::string, std::string>& columns,
                   const std::vector<Actuator>& actuators, std::vector<std::string>& notes);

/// Of each multiplier that latents of a model read while its constraint follows from others: which share of the load is its own is then
/// a choice.
/// @param mechanics  at some states
std::vector<std::string> shared_load_texts(const Model& model, const System& system, const MechanicsBatch& mechanics);
/// Warns of those at some of the states of a log.
void note_shared_loads(const LoggedSystem& logged, const Eigen::MatrixXd& states, const std::string& log,
                       std::vector<std::string>& notes);

}  // namespace gp2
