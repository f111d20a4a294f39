// The ids of a sealed map's landmarks, which ascend, in few bytes and read in any order.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <utility>
#include <vector>

#include "file/container.h"

namespace protomark {

// Landmark j of a block has the id base + j + rest. Rests do not descend, so a run of ids takes no
// bits at all.
struct IdBlock {
  std::int64_t base;    // the first id
  std::uint64_t place;  // 64 * the first word of its rests + the bits of one, 0 to 63
};
inline constexpr std::size_t kIdBlock = 128;  // landmarks of a block; the last may have fewer

// The bytes of sections `idblocks` and `idrests`, as ids come.
class IdBlockWriter {
 public:
  IdBlockWriter(ContainerWriter::Sink blocks, ContainerWriter::Sink rests)
      : to_blocks_(std::move(blocks)), to_rests_(std::move(rests)) {}

  // Ids ascend.
  void add(std::int64_t id);
  void finish();

  // Of the section `idblocks`.
  static constexpr std::size_t blocks_size(std::size_t landmarks) {
    return (landmarks + kIdBlock - 1) / kIdBlock * sizeof(IdBlock);
  }

 private:
  void end_block();
  void flush();

  ContainerWriter::Sink to_blocks_, to_rests_;
  std::vector<std::int64_t> ids_;  // of the block
  std::vector<IdBlock> blocks_;
  std::vector<std::uint64_t> rests_;
  std::size_t words_ = 0;  // of all rests
};

// Whether ids are 0 to n - 1, which are not written at all; `last` is the largest.
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
