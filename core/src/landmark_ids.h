// The ids of a sealed map's landmarks, which ascend, in few bytes and read in any order.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <span>
#include <vector>

#include "container.h"

namespace protomark {

// Landmark j of a block has the id base + j + rest. Rests do not descend, so a run of ids takes no
// bits at all.
struct IdBlock {
  std::int64_t base;    // the first id
  std::uint64_t place;  // 64 * the first word of its rests + the bits of one, 0 to 63
};
inline constexpr std::size_t kIdBlock = 128;  // landmarks of a block; the last may have fewer

// Adds `id(0)` to `id(n - 1)`, which ascend; nothing where they are 0 to n - 1. Takes n / 8 bytes
// until the file is written, and `id` must hold as long.
void add_ids(ContainerWriter& file, std::size_t n, std::function<std::int64_t(std::size_t)> id);
// Whether it adds nothing.
bool ids_are_numbers(std::size_t n, std::int64_t last);

class LandmarkIds {
 public:
  LandmarkIds() = default;
  // Checks everything but rests, which are checked when they are read. `file` must outlive this.
  // Throws FileError.
  LandmarkIds(const ContainerReader& file, std::size_t n);

  // Whether each landmark's id is its number.
  bool are_numbers() const { return plain_.empty() && blocks_.empty(); }
  // The id of landmark `number`. Throws FileError where it is impossible.
  std::int64_t operator[](std::size_t number) const;
  // The number of a landmark. Throws UnknownLandmark.
  std::size_t find(std::int64_t id) const;
  // Throws FileError where they do not ascend.
  std::vector<std::int64_t> all() const;

 private:
  std::size_t block_size(std::size_t b) const;
  std::uint64_t end_of(std::size_t b) const;
  void check_blocks() const;

  const ContainerReader* file_ = nullptr;
  std::size_t n_ = 0;
  std::span<const std::int64_t> plain_;  // of versions before 4
  std::span<const IdBlock> blocks_;
  std::span<const std::uint64_t> words_;
};

}  // namespace protomark
