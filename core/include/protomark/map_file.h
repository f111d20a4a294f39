// The sealed map: what a map needs to answer, mapped from its file without parsing.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "protomark/encoder.h"
#include "protomark/map_summary.h"
#include "protomark/matrix_view.h"
#include "protomark/metadata.h"
#include "protomark/prototypes.h"
#include "protomark/search.h"

namespace protomark {

enum class MapKind { open, sealed };

// Throws std::invalid_argument, its text beginning with `map`, unless `encoder`, that of the map,
// gives the same codes as `expected`: descriptors that were encoded by another mean nothing in it.
void expect_encoder(const Encoder& encoder, const Encoder& expected, const std::string& map);
// Throws it unless the encoder takes descriptors of this name ("freak").
void expect_descriptor(const Encoder& encoder, const std::string& descriptor,
                       const std::string& map);

// What a map file holds, by its header. Throws FileError where it is no map.
MapKind map_kind(const std::filesystem::path& path);

// The encoder of a map file, of which nothing else is read. Throws FileError.
std::shared_ptr<const Encoder> map_encoder(const std::filesystem::path& path);

// Names and sizes in bytes of the sections of a model or map file. Throws FileError.
std::vector<std::pair<std::string, std::size_t>> file_sections(const std::filesystem::path& path);

// Checks every checksum of a model or map file, and of the journal beside it. Throws FileError.
void verify_file(const std::filesystem::path& path);

struct FileJournal {
  std::size_t commits;     // since the map file was written
  std::size_t bytes;       // of the whole journal
  std::size_t torn_bytes;  // of a commit that was interrupted, at the end
};

// The journal beside a map file (PrototypeMap::commit), where there is one. Throws FileError.
std::optional<FileJournal> file_journal(const std::filesystem::path& path);

// A sealed map takes dim + 1 bytes a landmark (dimensions padded to a multiple of 4, prototypes to
// one of 16), with 4 bits a number dim / 2 + 1 (dimensions padded to a multiple of 8). Where
// landmarks have several prototypes these take dim or dim / 2 bytes each, and a landmark 2 more. An
// eighth more where ids are not 0 ... n - 1, and the bits of what is missing between them; 12 or 6
// more where landmarks have positions. Reads are safe from any thread.
class SealedMap {
 public:
  // Throws FileError. The large sections are not read; verify_file checks them.
  explicit SealedMap(const std::filesystem::path& path);
  // Opens the bytes of a map file, which stand at a multiple of 64 and stay the caller's for as
  // long as the map is there; `name` is what errors call them.
  SealedMap(std::span<const std::byte> bytes, const std::string& name);
  ~SealedMap();
  SealedMap(SealedMap&&) noexcept;

  const std::shared_ptr<const Encoder>& encoder() const;
  const Metadata& metadata() const;
  std::size_t dim() const;
  // Landmarks.
  std::size_t size() const;
  // One a landmark, or several where looks are told apart.
  std::size_t prototype_count() const;
  // Bits of a prototype's number: 8, or 4 where it was sealed so.
  int code_bits() const;
  // Bits of a position's coordinate: 32, 16, or 0 where no landmark has a position.
  int position_bits() const;
  // With 16 bits, how far a coordinate may be from what the open map had, along each axis; with 32
  // they are rounded to floats, relative to the middle of the map.
  std::optional<Position> position_error() const;
  // Throws FileError where the file's ids do not ascend, which only this looks at.
  std::vector<std::int64_t> ids() const;
  // Number of cells of the index; 0: there is none.
  std::size_t index_cells() const;
  // Cells that are searched for a recall above 0 and at most 1, as measured when the map was sealed
  // (protomark/prototypes.h). Throws std::invalid_argument for another recall, and without an
  // index.
  std::size_t probes(double recall) const;

  // Throw UnknownLandmark. Counts are at most 255. Prototypes are the rounded ones; with 4 bits,
  // the levels nearest to these. Of a landmark with several they are the mean, each counting alike.
  // Positions are NaN where there is none.
  std::vector<std::uint32_t> counts(std::span<const std::int64_t> landmarks) const;
  void prototypes(std::span<const std::int64_t> landmarks, MatrixView<float> means) const;
  // The prototypes of one landmark, with an index in no particular order.
  std::vector<std::vector<float>> looks(std::int64_t landmark) const;
  std::vector<Position> positions(std::span<const std::int64_t> landmarks) const;
  // Reads all counts and positions once, and keeps nothing.
  MapSummary summary() const;

  void search(Descriptors queries, const SearchOptions& options, MatrixView<std::int64_t> ids,
              MatrixView<std::int32_t> distances) const;
  void search_codes(Codes queries, const SearchOptions& options, MatrixView<std::int64_t> ids,
                    MatrixView<std::int32_t> distances) const;

 private:
  struct Content;
  std::unique_ptr<const Content> content_;
};

}  // namespace protomark
