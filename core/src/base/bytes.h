// Plain values at any address.
#pragma once

#include <cstring>

#include "protomark/types.h"

namespace protomark {

using Bytes = std::span<const std::byte>;

template <typename T>
T load(const void* from) {
  T value;
  std::memcpy(&value, from, sizeof(value));
  return value;
}
void store(void* to, const auto& value) { std::memcpy(to, &value, sizeof(value)); }

}  // namespace protomark
