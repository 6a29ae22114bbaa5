// Sums of pieces of rows: the same bits whoever adds them.
#include "inference/piece_sums.hpp"

#include <cmath>
#include <memory>
#include <thread>
#include <vector>

#include <gtest/gtest.h>

#include "thread_ranks.hpp"

namespace gp2 {
namespace {

using Eigen::VectorXd;
using test::ThreadRanks;

TEST(Pieces, AreEightUntilEachHasBlocksEnoughAndCoverAllBlocks) {
  EXPECT_EQ(Pieces(0).n, 8);
  EXPECT_EQ(Pieces(3).n, 8);
  EXPECT_EQ(Pieces(127).n, 8);
  EXPECT_EQ(Pieces(128).n, 16);
  EXPECT_EQ(Pieces(512).n, 64);
  EXPECT_EQ(Pieces(3907).n, 256);
  EXPECT_EQ(Pieces(100'000).n, 256);
  for (const Eigen::Index n : {0, 3, 700, 3907}) {
    const Pieces pieces(n);
    EXPECT_EQ(pieces.first(0), 0);
    EXPECT_EQ(pieces.first(pieces.n), n);
  }
}

// few are added up by each rank, many in slices
constexpr int few = 50, many = 1003;

// numbers of which every order of adding makes another sum
VectorSum of_piece(int piece, int n) { return {VectorXd::LinSpaced(n, 1, 2).array().pow(40.0 * std::sin(1.0 + piece))}; }

VectorXd total(int n_pieces, const Workers& workers, int n, bool backwards = false) {
  PieceSums<VectorSum> sums(n_pieces, {VectorXd::Zero(n)});
  for (int k = 0; k < n_pieces; ++k) {
    const int piece = backwards ? n_pieces - 1 - k : k;
    if (workers.owns(piece, n_pieces)) sums.put(piece, of_piece(piece, n));
  }
  return sums.total(workers).sum;
}

TEST(PieceSums, OfEightPiecesAreAddedOneAfterAnother) {
  VectorXd sum = VectorXd::Zero(few);
  for (int piece = 0; piece < 8; ++piece) sum += of_piece(piece, few).sum;
  EXPECT_EQ(total(8, {}, few), sum);
}

TEST(PieceSums, HaveTheSameBitsForAnyNumberOfRanksAndAnyOrder) {
  for (const auto& [n_pieces, n] :
       {std::pair(8, few), std::pair(16, few), std::pair(64, few), std::pair(8, many), std::pair(64, many)}) {
    const VectorXd alone = total(n_pieces, {}, n);
    EXPECT_EQ(total(n_pieces, {}, n, true), alone);
    VectorXd one_by_one = VectorXd::Zero(n);
    for (int piece = 0; piece < n_pieces; ++piece) one_by_one += of_piece(piece, n).sum;
    EXPECT_LE((one_by_one - alone).cwiseAbs().maxCoeff(), 1e-13 * alone.cwiseAbs().maxCoeff());
    EXPECT_EQ(one_by_one == alone, n_pieces == 8) << "whether the numbers tell the order";
    for (const int n_ranks : {2, 3, 8, 11, 70}) {
      ThreadRanks::Meeting meeting(n_ranks);
      std::vector<VectorXd> sums(static_cast<std::size_t>(n_ranks));
      {
        std::vector<std::jthread> threads;
        for (int rank = 0; rank < n_ranks; ++rank) {
          threads.emplace_back([&, rank, n_pieces = n_pieces, n = n] {
            const Workers workers(1, std::make_shared<ThreadRanks>(meeting, rank));
            sums[static_cast<std::size_t>(rank)] = total(n_pieces, workers, n, rank % 2 == 1);
            EXPECT_EQ(workers.sum(rank), n_ranks * (n_ranks - 1) / 2);
          });
        }
      }
      for (const VectorXd& sum : sums)
        EXPECT_EQ(sum, alone) << n_pieces << " pieces of " << n << " numbers, " << n_ranks << " ranks";
    }
  }
}

}  // namespace
}  // namespace gp2
