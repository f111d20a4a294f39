// What a map says of itself.
#pragma once

#include <cstddef>
#include <map>
#include <string>

namespace protomark {

// Texts by name, UTF-8. Names and texts are free, but for these names:
//   "frame"    the coordinate frame of the positions and their unit, as in "ENU, metres" or
//              "map (REP 105), metres"
//   "created"  when the map was begun, in UTC: "2026-11-23T03:39:41Z" (ISO 8601)
// No call of this library writes any of them by itself, so that equal maps stay equal.
using Metadata = std::map<std::string, std::string>;

inline constexpr std::size_t kMaxMetadata = 256;          // names
inline constexpr std::size_t kMaxMetadataName = 128;      // bytes, at least 1
inline constexpr std::size_t kMaxMetadataText = 1 << 16;  // bytes

// Throws std::invalid_argument where something is beyond these limits or no UTF-8, and where
// "created" is no such time.
void check_metadata(const Metadata& metadata);

}  // namespace protomark
