// The ascending ids of a sealed map's landmarks, in little space and with random access.
#pragma once

#include <utility>

#include "base/packed_numbers.h"
#include "base/rows.h"
#include "file/container.h"

namespace protomark {

// Landmark j of a block has the id first_id + j + gap j, where gap j counts the ids missing up to
// there. Ids without gaps take no bits.
struct IdBlock {
  std::int64_t first_id;
  std::uint64_t gaps;  // 64 * their first word + bits per gap, 0 to 63
};
inline constexpr std::size_t kIdBlock = 128;  // landmarks; the last block may have fewer

// Writes the sections `idblocks` and `idgaps` from ascending ids.
class IdBlockWriter {
 public:
  IdBlockWriter(ContainerWriter::Sink blocks, ContainerWriter::Sink gaps)
      : block_sink_(std::move(blocks)), gap_sink_(std::move(gaps)) {}

  void add(std::int64_t id);
  void finish();

  // Returns the size of the section `idblocks` in bytes.
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

class LandmarkIds {
 public:
  LandmarkIds() = default;
  // Checks everything but the gaps, which are checked as they are read. `file` must outlive this.
  // Throws FileError.
  LandmarkIds(const ContainerReader& file, std::size_t n);

  // Whether each landmark's id is its index.
  bool are_indices() const { return blocks_.empty(); }
  // Throws FileError if the id is not below those of the next block.
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
