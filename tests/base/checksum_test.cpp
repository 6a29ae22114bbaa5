#include "base/checksum.hpp"

#include <gtest/gtest.h>

namespace gp2 {
namespace {

TEST(Checksum, IsThatOfXz) {
  EXPECT_EQ(checksum(""), "0000000000000000");
  EXPECT_EQ(checksum("123456789"), "995dc9bbdf1939fa") << "the check value of CRC-64/XZ";
}

TEST(Checksum, DoesNotDependOnTheCuts) {
  std::string text;
  for (int k = 0; k < 100; ++k) text += static_cast<char>(k * k * 31 % 251);
  for (std::size_t cut = 0; cut <= text.size(); ++cut) {
    Checksum in_two;
    in_two.add(std::string_view(text).substr(0, cut));
    in_two.add(std::string_view(text).substr(cut));
    EXPECT_EQ(in_two.text(), checksum(text)) << cut;
    Checksum first, second;
    first.add(std::string_view(text).substr(0, cut));
    second.add(std::string_view(text).substr(cut));
    first.append(second, text.size() - cut);
    EXPECT_EQ(first.text(), checksum(text)) << cut;
  }
}

}  // namespace
}  // namespace gp2
