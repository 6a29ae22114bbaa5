#pragma once

#include <string>
#include <string_view>

#include <fmt/format.h>
#include <boost/crc.hpp>

namespace gp2 {

/// CRC-64 of xz, 16 hexadecimal digits. It sees every change within eight bytes in a row, and others but for one in 2⁶⁴.
inline std::string checksum(std::string_view text) {
  boost::crc_optimal<64, 0x42F0E1EBA9EA3693, 0xFFFFFFFFFFFFFFFF, 0xFFFFFFFFFFFFFFFF, true, true> crc;
  crc.process_bytes(text.data(), text.size());
  return fmt::format("{:016x}", crc.checksum());
}

}  // namespace gp2
