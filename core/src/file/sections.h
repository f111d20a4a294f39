// The sections that open and sealed maps share.
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "file/container.h"
#include "protomark/metadata.h"
#include "protomark/prototypes.h"

namespace protomark {

namespace section {
inline constexpr char kEncoder[] = "encoder";    // a whole model file
inline constexpr char kShape[] = "shape";        // MapShape
inline constexpr char kMetadata[] = "metadata";  // texts, name and value; absent for none
inline constexpr char kIds[] = "ids";            // int64, ascending; sealed: before version 4
// Sealed, both absent for 0 ... n - 1 (landmark_ids.h).
inline constexpr char kIdBlocks[] = "idblocks";  // IdBlock, of 128 landmarks each
inline constexpr char kIdRests[] = "idrests";    // uint64, bits of the rests
inline constexpr char kCounts[] = "counts";      // uint8; open: of rows; sealed: of landmarks
// Where landmarks have several prototypes, rows of each: open uint32, sealed uint8.
inline constexpr char kRows[] = "rows";
inline constexpr char kLookBits[] = "lookbits";  // open, where not 0: u32
inline constexpr char kLooks[] = "looks";        // open: uint16, of each row
inline constexpr char kSums[] = "sums";          // open: int16, rows x dim
inline constexpr char kPrototypes[] = "protos";  // sealed: packed (protomark/search.h)
inline constexpr char kLevels[] = "levels";      // sealed, 4 bits a number: u32 4, u32 half-step
inline constexpr char kCells[] = "cells";        // int8, centroids, cells x dim
inline constexpr char kCellRows[] = "cellrows";  // sealed, with cells: uint32, rows of each
inline constexpr char kOrder[] = "order";        // ... landmark of each place (bit_numbers.h)
inline constexpr char kOrderChecksums[] = "ordersum";  // ... uint32, of its blocks
inline constexpr char kProbes[] = "probes";            // ... uint32, RecallTable
// Open: 3 x float64; sealed: 3 x float32, with steps 3 x uint16.
inline constexpr char kPositions[] = "position";
inline constexpr char kSteps[] = "steps";  // sealed, positions of 16 bits: 3 x float64
inline constexpr char kBase[] = "base";    // journal, fold: identity of a map file
inline constexpr char kChain[] = "chain";  // commit, fold: what stands before it
inline constexpr char kGone[] = "gone";    // commit: int64, ids of landmarks that went
}  // namespace section

struct MapShape {
  std::size_t landmarks = 0;
  std::size_t dim = 0;
  Position origin{};  // what a sealed map's positions are relative to
};

std::vector<std::byte> write_shape(const MapShape& shape);
MapShape read_shape(const ContainerReader& file, const Encoder& encoder);
std::shared_ptr<const Encoder> read_encoder(const ContainerReader& file);
// Nothing where there is none.
void add_metadata(ContainerWriter& file, const Metadata& metadata);
Metadata read_metadata(const ContainerReader& file);
// What a map says of itself when another has been joined to it: its own texts, those of the other
// under other names, the earlier of both creations. Throws std::invalid_argument where these are
// too many.
Metadata joined(const Metadata& own, const Metadata& other);
// What 4-bit prototypes stand for.
std::vector<std::byte> write_levels(int half_step);
int read_levels(const ContainerReader& file);
// Signs that tell looks apart; 0 where the file says nothing of them.
std::vector<std::byte> write_look_bits(std::size_t look_bits);
std::size_t read_look_bits(const ContainerReader& file, std::size_t dim);
// Centroids, (cells x dim); empty where there is no index.
std::vector<std::int8_t> read_cells(const ContainerReader& file, std::size_t dim);
// Throws FileError unless ids are ascending and not negative.
void check_ids(const ContainerReader& file, std::span<const std::int64_t> ids);
// The steps of positions in 16 bits (PositionGrid).
std::vector<std::byte> write_steps(const Position& step);
Position read_steps(const ContainerReader& file, const Position& origin);

// The sum of the numbers of rows of all landmarks. Throws FileError where a landmark has none, or
// where these are more than a map can hold.
template <typename T>
std::size_t count_rows(const ContainerReader& file, std::span<const T> rows_of) {
  std::uint64_t total = 0;
  for (const T n : rows_of) {
    if (n == 0) file.fail("it has a landmark without prototypes");
    total += n;
    if (total > UINT32_MAX) file.fail("it claims more prototypes than a map can hold");
  }
  return total;
}

// A section of exactly n values.
template <typename T>
std::vector<T> read_section(const ContainerReader& file, const char* name, std::size_t n) {
  SectionReader in(file, name);
  std::vector<T> result = in.values<T>(n);
  in.finish();
  return result;
}

}  // namespace protomark
