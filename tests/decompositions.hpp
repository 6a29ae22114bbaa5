#pragma once

#include <Eigen/Dense>

#include "base/decompositions.hpp"

namespace gp2::test {
using ExtendedMatrix = Eigen::Matrix<long double, Eigen::Dynamic, Eigen::Dynamic>;
}

// What several tests use of Eigen's decompositions is compiled once, in decompositions.cpp.
extern template class Eigen::JacobiSVD<gp2::test::ExtendedMatrix>;
extern template class Eigen::FullPivLU<gp2::test::ExtendedMatrix>;
extern template class Eigen::FullPivLU<Eigen::MatrixXd>;
extern template Eigen::LLT<gp2::test::ExtendedMatrix>& Eigen::LLT<gp2::test::ExtendedMatrix>::compute<gp2::test::ExtendedMatrix>(
    const Eigen::EigenBase<gp2::test::ExtendedMatrix>& matrix);
extern template Eigen::LLT<Eigen::MatrixXd>& Eigen::LLT<Eigen::MatrixXd>::compute<Eigen::MatrixXd>(
    const Eigen::EigenBase<Eigen::MatrixXd>& matrix);
