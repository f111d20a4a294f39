// A learning map as it is in its file and in the journal beside it.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "file/container.h"
#include "file/journal_content.h"
#include "map/prototype_store.h"
#include "protomark/encoder.h"

namespace protomark {

// Landmarks as the sections of a file, be it a whole map or a commit. The store must not change as
// long as this is there.
class LandmarkSections {
 public:
  // All landmarks.
  explicit LandmarkSections(const PrototypeStore& store);
  // Some landmarks, by ascending id.
  LandmarkSections(const PrototypeStore& store, std::vector<LandmarkIndex> landmarks);

  // Adds all sections to a file that is written as long as this is there.
  void add_to(ContainerWriter& file) const;

 private:
  void put(std::span<const ContainerWriter::Sink> sinks, bool positions) const;
  void put_piece(std::span<const ContainerWriter::Sink> sinks,
                 std::span<const LandmarkIndex> landmarks, bool positions) const;

  const PrototypeStore* store_;
  std::optional<std::vector<LandmarkIndex>> some_;  // nullopt: all
  std::size_t landmark_count_, row_count_ = 0;
};

// The signs that tell appearances apart; 0 if the file has none.
std::size_t read_appearance_bits(const ContainerReader& file, std::size_t dim);

// What a map file and its journal hold beside landmarks.
struct LearningMapContent {
  Metadata metadata;
  std::vector<std::int8_t> centroids;  // empty without an index
};

// Reads a map file and the commits to it into an empty store of its dimension and appearance bits,
// in a time proportional to the bytes read, whatever these are. Throws FileError.
LearningMapContent read_learning_map(const ContainerReader& file, const JournalContent& journal,
                                     const Encoder& encoder, PrototypeStore& store);

}  // namespace protomark
