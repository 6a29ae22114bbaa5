#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>

#include <fmt/format.h>

namespace gp2 {

/// CRC-64 of xz, 16 hexadecimal digits, of a text that comes piece by piece. It sees every change within eight bytes in a row, and
/// others but for one in 2⁶⁴. Eight bytes are taken at a time: a log of hundreds of megabytes must not wait for it.
class Checksum {
 public:
  void add(std::string_view text) {
    for (; text.size() >= 8; text.remove_prefix(8)) {
      for (std::size_t k = 0; k < 8; ++k) remainder_ ^= std::uint64_t{static_cast<unsigned char>(text[k])} << 8 * k;
      std::uint64_t next = 0;
      for (std::size_t k = 0; k < 8; ++k) next ^= tables[7 - k][remainder_ >> 8 * k & 0xFF];
      remainder_ = next;
    }
    for (const char c : text) remainder_ = remainder_ >> 8 ^ tables[0][(remainder_ ^ static_cast<unsigned char>(c)) & 0xFF];
  }
  [[nodiscard]] std::string text() const { return fmt::format("{:016x}", ~remainder_); }

 private:
  // [k][b]: what byte b leaves once k more bytes of zero have followed
  static constexpr std::array<std::array<std::uint64_t, 256>, 8> tables = [] {
    std::array<std::array<std::uint64_t, 256>, 8> out{};
    for (std::uint64_t byte = 0; byte < 256; ++byte) {
      std::uint64_t remainder = byte;
      for (int bit = 0; bit < 8; ++bit) remainder = remainder >> 1 ^ ((remainder & 1) != 0 ? 0xC96C5795D7870F42 : 0);
      out[0][byte] = remainder;
    }
    for (std::size_t k = 1; k < 8; ++k) {
      for (std::size_t byte = 0; byte < 256; ++byte) out[k][byte] = out[k - 1][byte] >> 8 ^ out[0][out[k - 1][byte] & 0xFF];
    }
    return out;
  }();
  std::uint64_t remainder_ = ~std::uint64_t{0};
};

inline std::string checksum(std::string_view text) {
  Checksum of_text;
  of_text.add(text);
  return of_text.text();
}

}  // namespace gp2
