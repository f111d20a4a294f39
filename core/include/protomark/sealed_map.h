// The sealed map: answers searches from a small file that it maps into memory.
#pragma once

#include <filesystem>
#include <memory>

#include "protomark/encoder.h"
#include "protomark/search.h"
#include "protomark/types.h"

namespace protomark {

// Bytes per landmark: dim per prototype (dimensions padded to a multiple of 4), or one for each
// word of a codebook; one for their number if landmarks have several; 12 or 6 for its position, if
// the map has positions; an eighth and the bits of the gaps between ids, unless ids are 0 ... n
// - 1. Any number of threads may use a sealed map.
class PROTOMARK_API SealedMap {
 public:
  // Maps a file. Does not read the large sections, which verify_file checks. Throws FileError.
  explicit SealedMap(const std::filesystem::path& path);
  // Opens the bytes of a map file, which begin at a multiple of 64 in memory and must outlive the
  // map; errors call the file `name`.
  SealedMap(std::span<const std::byte> bytes, const std::string& name);
  SealedMap(SealedMap&&) noexcept;
  ~SealedMap();

  const std::shared_ptr<const Encoder>& encoder() const;
  const Metadata& metadata() const;
  // Numbers of a prototype, which may be fewer than those of the learning map.
  size_t dim() const;
  size_t size() const;  // number of landmarks
  size_t prototype_count() const;
  // Words of the encoder's codebook per prototype; 0: numbers are int8, as in the learning map.
  size_t words() const;
  // Whether prototypes were tuned against each other (SealOptions).
  bool tuned() const;
  // Bytes per landmark as SealOptions counts them; 0 for an empty map.
  double bytes_per_landmark() const;
  // Bits per coordinate: 32, 16, or 0 if no landmark has a position.
  int position_bits() const;
  // With 16 bits, how far a position may be from that of the learning map along each axis. With 32
  // bits, coordinates relative to the middle of the map are rounded to floats.
  std::optional<Position> position_error() const;
  // Returns all ids in ascending order. Throws FileError if a broken file has them in another one.
  std::vector<int64_t> ids() const;

  // Number of inverted lists; 0 means no index.
  size_t nlist() const;
  // Returns how many lists a search with this recall, above 0 and at most 1, visits, as measured
  // when the map was sealed. Throws std::invalid_argument for another recall, and without an index.
  size_t nprobe(double recall) const;

  // Return positions, and prototypes as stored (n x dim, in code units), of a landmark with several
  // their plain mean. Throw UnknownLandmark.
  std::vector<Position> positions(std::span<const int64_t> ids) const;
  Matrix<float> prototypes(std::span<const int64_t> ids) const;
  // Returns the prototypes of a landmark (appearances x dim, in code units), with an index in no
  // particular order. Throws UnknownLandmark.
  Matrix<float> appearances(int64_t id) const;
  // Returns a summary without observations, which a sealed map does not count.
  MapSummary summary() const;

  // Finds the k nearest landmarks of each query (protomark/search.h).
  Matches search(Descriptors queries, size_t k = 2, const SearchOptions& options = {}) const {
    return search_codes(encoder()->encode(queries, dim(), options.threads), k, options);
  }
  Matches search_codes(Codes queries, size_t k = 2, const SearchOptions& options = {}) const;

 private:
  struct Content;
  const Content& unchanged() const;

  std::unique_ptr<const Content> content_;
};

}  // namespace protomark
