// The ids of a sealed map's landmarks, which ascend, in few bytes and with random access.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <utility>
#include <vector>

#include "base/packed_numbers.h"
#include "base/rows.h"
#include "file/container.h"

namespace protomark {

// Landmark j of a block has the id first_id + j + gap j, where gap j counts the ids that are
// missing up to there. A run of ids has no gaps and takes no bits for them.
struct IdBlock {
  std::int64_t first_id;
  std::uint64_t gaps;  // 64 * their first word + bits per gap, 0 to 63
};
inline constexpr std::size_t kIdBlock = 128;  // landmarks; the last block may have fewer

// Writes sections `idblocks` and `idgaps` while ids come in ascending order.
class IdBlockWriter {
 public:
  IdBlockWriter(ContainerWriter::Sink blocks, ContainerWriter::Sink gaps)
      : block_sink_(std::move(blocks)), gap_sink_(std::move(gaps)) {}

  void add(std::int64_t id);
  void finish();

  // Size of the section `idblocks` in bytes.
  static constexpr std::size_t blocks_size(std::size_t landmarks) {
    return (landmarks + kIdBlock - 1) / kIdBlock * sizeof(IdBlock);
  }

 private:
  void end_block();
  void flush();

  ContainerWriter::Sink block_sink_, gap_sink_;
  std::vector<std::int64_t> ids_;  // of the block
  std::vector<IdBlock> blocks_;
  BitPacker gaps_;
  std::size_t words_ = 0;  // of all gaps
};

// Whether ids are 0 to n - 1, which are not stored; `last` is the largest.
bool ids_are_indices(std::size_t n, std::int64_t last);

class LandmarkIds {
 public:
  LandmarkIds() = default;
  // Checks everything but the gaps, which are checked when they are read. `file` must outlive this.
  // Throws FileError.
  LandmarkIds(const ContainerReader& file, std::size_t n);

  // Whether each landmark's id is its index.
  bool are_indices() const { return blocks_.empty(); }
  // Throws FileError if the id is impossible.
  std::int64_t operator[](LandmarkIndex landmark) const;
  // Throws UnknownLandmark.
  LandmarkIndex find(std::int64_t id) const;
  // Returns all ids. Throws FileError unless they ascend.
  std::vector<std::int64_t> all() const;

 private:
  std::size_t block_size(std::size_t b) const;
  std::uint64_t end_of(std::size_t b) const;
  void check_blocks() const;

  const ContainerReader* file_ = nullptr;
  std::size_t n_ = 0;
  std::span<const IdBlock> blocks_;
  std::span<const std::uint64_t> words_;
};

}  // namespace protomark
