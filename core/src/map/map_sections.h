// The sections that learning and sealed maps share.
#pragma once

#include "file/container.h"
#include "protomark/encoder.h"

namespace protomark {

struct MapShape {
  uint64_t landmarks = 0;
  uint64_t dim = 0;
  Position origin{};  // of a sealed map's positions
};

// All functions that read throw FileError.
MapShape read_shape(const ContainerReader& file, const Encoder& encoder);
std::shared_ptr<const Encoder> read_encoder(const ContainerReader& file);
void add_metadata(ContainerWriter& file, const Metadata& metadata);
Metadata read_metadata(const ContainerReader& file);
// Merges metadata as PrototypeMap::merge_map does. Throws std::invalid_argument for too many.
Metadata merged(const Metadata& into, const Metadata& other);
// Returns the centroids of inverted lists (nlist x dim); none without an index.
Matrix<int8_t> read_centroids(const ContainerReader& file, size_t dim);
void check_ids(const ContainerReader& file, std::span<const int64_t> ids);

}  // namespace protomark
