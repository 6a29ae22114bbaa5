#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>

#include <fmt/format.h>

namespace gp2 {

// polynomials modulo that of CRC-64; bit k is the coefficient of x⁶³⁻ᵏ
namespace crc64 {

constexpr std::uint64_t times_x(std::uint64_t a) { return a >> 1 ^ ((a & 1) != 0 ? 0xC96C5795D7870F42 : 0); }

constexpr std::uint64_t product(std::uint64_t a, std::uint64_t b) {
  std::uint64_t product = 0;
  for (int k = 0; k < 64; ++k) product = times_x(product) ^ ((b >> k & 1) != 0 ? a : 0);
  return product;
}

}  // namespace crc64

/// CRC-64 of xz, 16 hexadecimal digits, of a text that comes piece by piece. It sees every change within eight bytes in a row, and
/// others but for one in 2⁶⁴. Eight bytes are taken at a time: a log of hundreds of megabytes must not wait for it.
class Checksum {
 public:
  Checksum() = default;
  explicit Checksum(std::uint64_t remainder) : remainder_(remainder) {}

  void add(std::string_view text) {
    for (; text.size() >= 8; text.remove_prefix(8)) {
      for (std::size_t k = 0; k < 8; ++k) remainder_ ^= std::uint64_t{static_cast<unsigned char>(text[k])} << 8 * k;
      std::uint64_t next = 0;
      for (std::size_t k = 0; k < 8; ++k) next ^= tables[7 - k][remainder_ >> 8 * k & 0xFF];
      remainder_ = next;
    }
    for (const char c : text) remainder_ = remainder_ >> 8 ^ tables[0][(remainder_ ^ static_cast<unsigned char>(c)) & 0xFF];
  }
  /// What a text of n_bytes that follows has for itself: a byte of zero multiplies what is there by x⁸.
  void append(const Checksum& next, std::uint64_t n_bytes) {
    std::uint64_t shift = std::uint64_t{1} << 63, power = std::uint64_t{1} << 55;  // 1, x⁸
    for (; n_bytes > 0; n_bytes /= 2, power = crc64::product(power, power)) {
      if (n_bytes % 2 == 1) shift = crc64::product(shift, power);
    }
    remainder_ = crc64::product(remainder_ ^ none, shift) ^ next.remainder_;
  }
  bool operator==(const Checksum&) const = default;
  [[nodiscard]] std::uint64_t remainder() const { return remainder_; }
  [[nodiscard]] std::string text() const { return fmt::format("{:016x}", ~remainder_); }

 private:
  static constexpr std::uint64_t none = ~std::uint64_t{0};  // of no text
  // [k][b]: what byte b leaves once k more bytes of zero have followed
  static constexpr std::array<std::array<std::uint64_t, 256>, 8> tables = [] {
    std::array<std::array<std::uint64_t, 256>, 8> out{};
    for (std::uint64_t byte = 0; byte < 256; ++byte) {
      std::uint64_t remainder = byte;
      for (int bit = 0; bit < 8; ++bit) remainder = crc64::times_x(remainder);
      out[0][byte] = remainder;
    }
    for (std::size_t k = 1; k < 8; ++k) {
      for (std::size_t byte = 0; byte < 256; ++byte) out[k][byte] = out[k - 1][byte] >> 8 ^ out[0][out[k - 1][byte] & 0xFF];
    }
    return out;
  }();
  std::uint64_t remainder_ = none;
};

inline std::string checksum(std::string_view text) {
  Checksum of_text;
  of_text.add(text);
  return of_text.text();
}

}  // namespace gp2
