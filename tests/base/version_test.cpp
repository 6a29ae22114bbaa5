#include "gp2/base/version.hpp"

#include <gmock/gmock.h>

namespace gp2 {
namespace {

TEST(Version, IsThreeNumbersWithPoints) { EXPECT_THAT(version(), testing::MatchesRegex("[0-9]+\\.[0-9]+\\.[0-9]+")); }

}  // namespace
}  // namespace gp2
