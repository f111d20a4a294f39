// The learning map: exact prototypes of landmarks under any history of changes.
#pragma once

#include <filesystem>
#include <memory>

#include "protomark/encoder.h"
#include "protomark/search.h"
#include "protomark/types.h"

namespace protomark {

struct MapPart;
struct MapState;

struct IndexOptions {
  // Inverted lists, 1 to 65536 and at most one per prototype; by default as many as fit the map.
  std::optional<size_t> nlist = std::nullopt;
  // Moves prototypes within the map instead of copying it.
  bool in_place = false;
};

struct SealOptions {
  // Bytes that a landmark may take on average for its prototypes and their number (not for
  // position, id and index). By default, and if all of them fit, prototypes are int8 numbers and
  // every appearance is kept, so that the sealed map gives the answers of the learning map. Else
  // they are words of one of the encoder's codebooks, and appearances are merged, those of least
  // merge cost first (Ward's criterion), until they fit; docs/sealing.md says which words.
  std::optional<double> bytes_per_landmark = std::nullopt;
  // Bits per coordinate. 32: floats relative to the middle of the map. 16: steps of a grid over the
  // bounding box, 65534 from end to end along each axis. 0: no positions.
  int position_bits = 32;
  // With bytes_per_landmark, tunes prototypes against each other, so that a landmark is less often
  // mistaken for another (docs/sealing.md). Equal maps and observations give equal files.
  bool tune = true;
  int threads = 1;
};

// The map keeps the integer sum of a landmark's codes and their number n, so that its prototype,
// the mean (Komorowski and Trzcinski, Eq. 1), follows every change exactly: observations may come
// in any order and in any batches (Eq. 2), be subtracted again, and landmarks be merged.
//
// A map may tell *appearances* of a landmark apart: the signs of the first `appearance_bits`
// numbers of a code say which appearance an observation is of, and each one that occurs has a sum
// and a count of its own. A landmark is then as far away as the nearest of its appearances.
//
// n is at most 255. Before one more is added, sum and n are halved (toward zero, the mean never
// beyond 127), so that an old landmark forgets slowly; from then on its observations can no longer
// be subtracted exactly.
//
// Search compares codes with prototypes rounded to int8, halves away from zero.
//
// A function that throws changes nothing (unless memory runs out during a change). Any number of
// threads may use a map (docs/sharing.md). A search sees a change of up to 2048 observations or
// landmarks as a whole, a larger one in pieces of that size.
class PROTOMARK_API PrototypeMap {
 public:
  static constexpr int kMaxCount = 255;
  static constexpr size_t kMaxAppearanceBits = 16;

  // Makes an empty map. `dim` is one of the encoder's dims(), or 0 for the full length;
  // `appearance_bits` is 0 (one prototype per landmark) to 16, and at most dim.
  explicit PrototypeMap(std::shared_ptr<const Encoder> encoder, size_t dim = 0,
                        size_t appearance_bits = 0);
  PrototypeMap(PrototypeMap&& other) noexcept;
  ~PrototypeMap();

  const std::shared_ptr<const Encoder>& encoder() const;
  size_t dim() const;
  size_t appearance_bits() const;
  size_t size() const;             // number of landmarks
  size_t prototype_count() const;  // one per appearance of each landmark
  // Returns the ids of all landmarks in ascending order.
  std::vector<int64_t> ids() const;

  // Adds observations: descriptor i (n x bytes) is of landmark ids[i], 0 or above, existing or new.
  void add(std::span<const int64_t> ids, Descriptors descriptors, int threads = 1);
  // Undoes `add`. A landmark without observations leaves the map. Throws UnknownLandmark, and
  // std::invalid_argument if these observations cannot have been added.
  void subtract(std::span<const int64_t> ids, Descriptors descriptors, int threads = 1);
  // The same for descriptors that are encoded already (n x dim).
  void add_codes(std::span<const int64_t> ids, Codes codes);
  void subtract_codes(std::span<const int64_t> ids, Codes codes);
  // Removes landmarks. Throws UnknownLandmark.
  void remove(std::span<const int64_t> ids);

  // Merges landmark source[i] into landmark into[i], appearance by appearance, in this order; the
  // sources leave the map. A landmark keeps its position, or takes the source's if it has none.
  // Throws UnknownLandmark, and std::invalid_argument for a landmark that was merged before.
  void merge_landmarks(std::span<const int64_t> into, std::span<const int64_t> source);
  // Merges another map of the same encoder, dim and appearance_bits into this one, as if its
  // observations had been added here. Landmark source[i] of the other map becomes landmark into[i]
  // of this one, existing or new; all others keep their ids. If several become one, they are merged
  // by ascending id in the other map, positions as in merge_landmarks. This map takes over metadata
  // under names that it lacks, and the earlier "created". Throws UnknownLandmark for a source, and
  // std::invalid_argument if maps differ, a source is named twice or an id is negative.
  void merge_map(const PrototypeMap& other, std::span<const int64_t> into = {},
                 std::span<const int64_t> source = {});

  // Return parts of this map, without an index. All parts merged into an empty map, in any order,
  // equal this map without its index.
  //
  // Some landmarks, in any order. Throws UnknownLandmark.
  PrototypeMap part(std::span<const int64_t> ids) const;
  // By id: the landmarks below boundaries[0], those from there to below boundaries[1] and so on.
  // Throws std::invalid_argument unless boundaries ascend.
  std::vector<PrototypeMap> split_by_id(std::span<const int64_t> boundaries) const;
  // By space: a part per cube of this edge that holds landmarks, by ascending cell, then one of the
  // landmarks without a position if there are any. Throws std::invalid_argument if `cell_size` is
  // not above 0 or is too small for the extent of the map.
  std::vector<MapPart> split_by_space(double cell_size) const;

  // Sets world coordinates, which are finite; NaN in all three removes the position.
  void set_positions(std::span<const int64_t> ids, std::span<const Position> positions);
  // Replaces the metadata, of which a new map has none. Throws as check_metadata.
  void set_metadata(Metadata metadata);
  Metadata metadata() const;

  // Return positions, numbers of observations over all appearances, and means over all appearances
  // (n x dim, in code units). Throw UnknownLandmark.
  std::vector<Position> positions(std::span<const int64_t> ids) const;
  std::vector<uint32_t> counts(std::span<const int64_t> ids) const;
  Matrix<float> prototypes(std::span<const int64_t> ids) const;
  // Return the prototypes of a landmark (appearances x dim, in code units) and the number of
  // observations of each, by ascending sign bits of the appearance. Throw UnknownLandmark.
  Matrix<float> appearances(int64_t id) const;
  std::vector<uint32_t> appearance_counts(int64_t id) const;
  MapSummary summary() const;

  // Learns the centroids of inverted lists from the map's prototypes, anew if there is an index,
  // and keeps prototypes by list from then on, through every change, so that a search may take
  // `recall` or `nprobe`. Throws std::invalid_argument for another nlist and for an empty map.
  //
  // Searches go on meanwhile, as prototypes are put into lists in a copy of the map, which takes as
  // much memory again. `in_place` takes 5 to 10 bytes per prototype instead (and the largest of the
  // map's arrays once more if that has no room for half-filled blocks), but searches wait while
  // prototypes move. Lists and answers are the same. If memory runs out the map is as before.
  void build_index(const IndexOptions& options = {}, int threads = 1);
  void drop_index();
  // Number of inverted lists; 0 means no index.
  size_t nlist() const;
  // Returns how many lists a search with this recall, above 0 and at most 1, visits, as measured on
  // the map (docs/large-maps.md), and again when a tenth of it has changed. Throws
  // std::invalid_argument for another recall, and without an index.
  size_t nprobe(double recall, int threads = 1) const;

  // Returns the squared distance of each code to one landmark, as a search measures it: what guided
  // matching needs, which knows near which landmarks a keypoint is. Throws UnknownLandmark, and
  // std::invalid_argument unless there is a code of `dim()` numbers per id.
  std::vector<int32_t> distances(std::span<const int64_t> ids, Codes codes) const;

  // Finds the k nearest landmarks of each query (protomark/search.h).
  Matches search(Descriptors queries, size_t k = 2, const SearchOptions& options = {}) const {
    return search_codes(encoder()->encode(queries, dim(), options.threads), k, options);
  }
  Matches search_codes(Codes queries, size_t k = 2, const SearchOptions& options = {}) const;

  // Writes the map, whole or not at all; equal maps (with equal centroids) give equal files.
  // Compacts if `path` is the file that the map was loaded from with a journal. Throws FileError,
  // also if another map has the journal of `path`, or that holds commits, which would be lost.
  void save(const std::filesystem::path& path) const;
  // Reads a map file and what was committed to the journal beside it. With `journal` the map alone
  // may commit to it until it is closed or destroyed. Throws FileError.
  static PrototypeMap load(const std::filesystem::path& path, bool journal = false);
  // Reads and checks the bytes of a map file and of its journal; errors call the file `name`.
  static PrototypeMap parse(std::span<const std::byte> bytes, const std::string& name,
                            std::span<const std::byte> journal = {});

  // The journal is the file <path>.journal beside the map file (docs/format.md).
  bool has_journal() const;
  // Makes all changes so far durable, at a cost that grows with the number of landmarks that
  // changed: once it has returned, the map file and its journal give this map, whatever happens.
  // Returns the number of bytes written, 0 if nothing changed. Throws FileError, after which one
  // may commit again, and std::invalid_argument without a journal.
  size_t commit();
  // Writes the map file anew and empties the journal. Whatever happens, the two of them give this
  // map or what was committed last. Throws FileError if the map file cannot be written, and
  // std::invalid_argument without a journal. If only the journal cannot be emptied it returns: its
  // commits no longer count, and the next commit tries again.
  void compact();
  // Releases the journal. Changes that were not committed stay in memory only.
  void close();

  // Writes a sealed map (protomark/sealed_map.h), with the index and metadata. A landmark keeps at
  // most 255 appearances. Throws FileError, and std::invalid_argument for other options, for fewer
  // bytes_per_landmark than the fewest words of a prototype take, if they need codebooks and the
  // encoder has none, and for positions further than 3.4e38 from the middle of the map.
  //
  // Prototypes are tuned by observations: descriptor i (n x bytes) is of landmark ids[i]; those of
  // landmarks that the map does not hold are ignored. Without any, they are tuned by the map's
  // appearances if only one prototype per landmark fits, and else left as they are. seal_codes
  // takes codes of the map's dim instead.
  void seal(const std::filesystem::path& path, const SealOptions& options = {},
            std::span<const int64_t> ids = {}, Descriptors descriptors = {}) const;
  void seal_codes(const std::filesystem::path& path, const SealOptions& options,
                  std::span<const int64_t> ids, Codes codes) const;

 private:
  friend struct MapState;
  explicit PrototypeMap(std::unique_ptr<MapState> state);

  std::unique_ptr<MapState> state_;
};

// The landmarks of one cube of space.
struct MapPart {
  // Coordinate i of each position is in [cell[i], cell[i] + 1) * cell_size. nullopt: no positions.
  std::optional<std::array<int64_t, 3>> cell;
  PrototypeMap map;
};

}  // namespace protomark
