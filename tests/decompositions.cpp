#include "decompositions.hpp"

template class Eigen::JacobiSVD<gp2::test::ExtendedMatrix>;
template class Eigen::FullPivLU<gp2::test::ExtendedMatrix>;
template class Eigen::FullPivLU<Eigen::MatrixXd>;
template Eigen::LLT<gp2::test::ExtendedMatrix>& Eigen::LLT<gp2::test::ExtendedMatrix>::compute<gp2::test::ExtendedMatrix>(
    const Eigen::EigenBase<gp2::test::ExtendedMatrix>& matrix);
template Eigen::LLT<Eigen::MatrixXd>& Eigen::LLT<Eigen::MatrixXd>::compute<Eigen::MatrixXd>(
    const Eigen::EigenBase<Eigen::MatrixXd>& matrix);
