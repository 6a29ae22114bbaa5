#pragma once

#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "gp2/system.hpp"

namespace gp2 {

/// A column of a log and those of which one should be its rate over t; NaN: not measured.
struct RateColumns {
  const Eigen::RowVectorXd& t;
  const std::string& name;
  const Eigen::RowVectorXd& value;
  bool is_angle = false;  // whose values may be wrapped
  const std::vector<Eigen::RowVectorXd>& rates;
  const std::vector<std::string>& names;
  std::size_t own = 0;                              // which of the rates is said to be the column's
  bool may_jump = false;                            // the column, at impacts, of which its rate shows nothing
  const Eigen::RowVectorXd* just_before = nullptr;  // the rate just before each row, where it jumps at rows; null: it does not
  const std::vector<Eigen::RowVectorXd>* values = nullptr;  // the columns of which the rates should be those; null: not known
};

/// What else the rate would have to be for the values to follow from it: a factor, a lag, another column. Empty where it is right,
/// where nothing explains the values better, or where rows are too far apart to tell.
/// @param columns  t increases, but for a few steps
std::string better_rate(const RateColumns& columns);

/// Of a log in the order of time: which velocities are not the rates of their coordinates, and which accelerations not those of
/// their velocities, a sentence each. Empty where t is not known.
/// @param states         (layout size × N)
/// @param accelerations  (nq × N); NaN: not measured
/// @param reads_time     whether the model reads t, which then is in seconds. Else t may be in ms, µs or ns too: in the unit under
///                       which the fewest columns are wrong.
/// @param unit           receives that unit [s]
std::vector<std::string> wrong_rates(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                     const Eigen::Ref<const Eigen::MatrixXd>& accelerations, bool reads_time,
                                     double* unit = nullptr);

/// Of the same log: which single values do not go with their rate, or with that of which they are one, while the rows beside them go
/// with each other; a sentence for each column. None where many do not.
/// @param unit_of_time  as wrong_rates tells it [s]
std::vector<std::string> single_wrong_values(const System& system, const Eigen::Ref<const Eigen::MatrixXd>& states,
                                             const Eigen::Ref<const Eigen::MatrixXd>& accelerations, double unit_of_time);

/// What a column looks like that was clipped.
struct PileUp {
  double value = 0;  // the largest or the smallest
  double share = 0;  // of the rows
};

/// The extreme at which values of a continuous column pile up, neither 0 nor of one that takes a few values only, as one does that is
/// switched, held or coarsely rounded.
std::optional<PileUp> pile_up(const Eigen::Ref<const Eigen::RowVectorXd>& values);
/// That values do, and what it may mean.
std::optional<std::string> pile_up_text(const std::string& name, const Eigen::Ref<const Eigen::RowVectorXd>& values,
                                        const std::string& meaning);
/// The same of an input.
std::optional<std::string> clipped_input(const std::string& input, const Eigen::Ref<const Eigen::RowVectorXd>& values);

/// The same of a velocity; nothing where the system moves on at that speed, as a drive does: its acceleration is small there.
std::optional<std::string> clipped_velocity(const std::string& name, const Eigen::Ref<const Eigen::RowVectorXd>& velocities,
                                            const Eigen::Ref<const Eigen::RowVectorXd>& accelerations);

/// The few values, at most one in 200 and at least one, that lie thirty times as far from the median as any other; none where all
/// others are the same, as those of an input between pulses are.
std::vector<Eigen::Index> far_values(const Eigen::Ref<const Eigen::RowVectorXd>& values);

/// Which of an input's values in some logs these are, if any.
/// @param lines  as place_of
std::optional<std::string> far_values_text(const std::string& input, const std::vector<Eigen::RowVectorXd>& logs,
                                           const std::vector<std::vector<int>>& lines = {});

/// Whether an angle in degrees is wrapped: from sample to sample it jumps by nearly 360, between -180 and 180 or 0 and 360, and
/// moves little else.
bool is_wrapped_in_degrees(const std::vector<double>& angles);

}  // namespace gp2
