// The open map: one prototype a landmark, exact under any history of changes.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <shared_mutex>
#include <span>
#include <vector>

#include "protomark/encoder.h"
#include "protomark/matrix_view.h"
#include "protomark/search.h"

namespace protomark {

using Position = std::array<double, 3>;

// A landmark is kept as the integer sum of its codes and their number n, so that its prototype, the
// mean (Komorowski and Trzcinski, Eq. 1), follows every change without rounding: observations may
// come in any order and in any batches (Eq. 2), be taken back, and landmarks be joined.
//
// n goes to 255. Before one more is added, sum and n are halved (toward zero), so that an old
// landmark forgets slowly; from then on its observations cannot be taken back exactly.
//
// Search compares codes with prototypes rounded to int8, halves away from zero.
//
// Every function either does all it was asked or throws and changes nothing (memory that runs out
// aside). Calls from several threads are safe: changes exclude each other and searches.
class PrototypeMap {
 public:
  static constexpr int kMaxCount = 255;

  // Codes have `dim` dimensions, one of the encoder's; 0: all of them.
  explicit PrototypeMap(std::shared_ptr<const Encoder> encoder, std::size_t dim = 0);

  PrototypeMap(PrototypeMap&& other) noexcept;

  const std::shared_ptr<const Encoder>& encoder() const { return encoder_; }
  std::size_t dim() const { return dim_; }
  std::size_t size() const;
  // Ascending.
  std::vector<std::int64_t> ids() const;

  // Adds observation i, a descriptor of landmark landmarks[i]; unknown landmarks are new. Ids are
  // not negative.
  void add(std::span<const std::int64_t> landmarks, Descriptors descriptors, int threads = 1);
  // Takes observations back. A landmark without observations leaves the map. Throws
  // UnknownLandmark, and std::invalid_argument where these cannot have been added.
  void remove(std::span<const std::int64_t> landmarks, Descriptors descriptors, int threads = 1);
  // The same for descriptors that are encoded already.
  void add_codes(std::span<const std::int64_t> landmarks, Codes codes);
  void remove_codes(std::span<const std::int64_t> landmarks, Codes codes);

  // Joins landmark source[i] to into[i], in this order; the sources leave the map. A landmark keeps
  // its position, or takes the source's where it has none.
  void merge(std::span<const std::int64_t> into, std::span<const std::int64_t> source);
  // Forgets landmarks.
  void discard(std::span<const std::int64_t> landmarks);
  // Joins another map of the same encoder and dim: landmarks of both are summed, the rest taken
  // over.
  void update(const PrototypeMap& other);

  // World coordinates. Finite; NaN in all three takes a position away.
  void set_positions(std::span<const std::int64_t> landmarks, std::span<const Position> positions);
  // NaN where there is none.
  std::vector<Position> positions(std::span<const std::int64_t> landmarks) const;
  std::vector<std::uint8_t> counts(std::span<const std::int64_t> landmarks) const;
  // Means, (landmarks x dim), in code units.
  void prototypes(std::span<const std::int64_t> landmarks, MatrixView<float> means) const;

  // See protomark/search.h.
  void search(Descriptors queries, const SearchOptions& options, MatrixView<std::int64_t> ids,
              MatrixView<float> distances) const;
  void search_codes(Codes queries, const SearchOptions& options, MatrixView<std::int64_t> ids,
                    MatrixView<float> distances) const;

  // Writes the map, landmarks by ascending id, so that equal maps give equal files. Whole or not at
  // all. Throws FileError.
  void save(const std::filesystem::path& path) const;
  static PrototypeMap load(const std::filesystem::path& path);
  // Writes a sealed map (protomark/map_file.h) whose prototypes have 8 or 4 bits a number. With 8
  // it gives the same answers; with 4 numbers are rounded to 16 levels that fit this map best,
  // which takes half the bytes. Throws FileError, and std::invalid_argument for other `bits`.
  void seal(const std::filesystem::path& path, int bits = 8) const;

 private:
  struct Store;

  std::shared_ptr<const Encoder> encoder_;
  std::size_t dim_;
  std::unique_ptr<Store> store_;

 public:
  ~PrototypeMap();
};

}  // namespace protomark
