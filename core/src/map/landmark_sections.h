// Landmarks of an open map as sections of a file, be it the whole map or a commit.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "base/id_set.h"
#include "file/container.h"
#include "file/sections.h"
#include "map/prototype_store.h"

namespace protomark {

// Landmarks of a store, which must stay as it is for as long as this is there.
class LandmarkSections {
 public:
  // All of them.
  explicit LandmarkSections(const PrototypeStore& store);
  // Those of these numbers, by ascending id.
  LandmarkSections(const PrototypeStore& store, std::vector<std::uint32_t> landmarks);

  MapShape shape() const { return {size_, store_->dim(), {}}; }
  // Adds all sections but the shape to a file that is written while this is there.
  void add_to(ContainerWriter& file) const;

 private:
  void visit(const PrototypeStore::Visit& visit) const;
  void put(std::span<const ContainerWriter::Sink> sinks, bool placed) const;

  const PrototypeStore* store_;
  std::optional<std::vector<std::uint32_t>> some_;  // none: all
  std::size_t size_;
  std::size_t rows_ = 0;
};

// Reads landmarks, but those that are `known`, of which the store has none otherwise; all are
// checked. Throws FileError.
void read_landmarks(const ContainerReader& file, const MapShape& shape, const IdSet& known,
                    PrototypeStore& store);

}  // namespace protomark
