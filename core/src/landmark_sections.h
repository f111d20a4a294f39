// Landmarks of an open map as sections of a file, be it the whole map or a commit.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "container.h"
#include "map_sections.h"
#include "prototype_store.h"

namespace protomark {

// Some landmarks of a store, which must stay as it is for as long as this is there.
class LandmarkSections {
 public:
  // Takes numbers of landmarks by ascending id.
  LandmarkSections(const PrototypeStore& store, std::vector<std::uint32_t> landmarks);

  MapShape shape() const { return {landmarks_.size(), store_->dim(), {}}; }
  // Adds all sections but the shape to a file that is written while this is there.
  void add_to(ContainerWriter& file) const;

 private:
  // Without looks a row is a landmark.
  std::span<const std::uint32_t> rows() const {
    return store_->look_bits() == 0 ? landmarks_ : rows_;
  }

  const PrototypeStore* store_;
  std::vector<std::uint32_t> landmarks_;
  std::vector<std::uint32_t> rows_;
};

// Reads landmarks that the store does not have; those that it has with the same ids leave it first.
// Throws FileError.
void read_landmarks(const ContainerReader& file, const MapShape& shape, PrototypeStore& store);

}  // namespace protomark
