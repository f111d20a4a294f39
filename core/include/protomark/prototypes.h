// The open map: one prototype a landmark, or one for each of its looks, exact under any history of
// changes.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "protomark/encoder.h"
#include "protomark/map_summary.h"
#include "protomark/matrix_view.h"
#include "protomark/metadata.h"
#include "protomark/search.h"

namespace protomark {

class Changes;
class ContainerReader;
class ContainerWriter;
class Journal;
class JournalContent;

using Position = std::array<double, 3>;

// Some of a landmark's observations, which look alike: their mean in code units, and their number.
struct Look {
  std::vector<float> mean;
  int count;
};

struct MapPart;

// A landmark is kept as the integer sum of its codes and their number n, so that its prototype, the
// mean (Komorowski and Trzcinski, Eq. 1), follows every change without rounding: observations may
// come in any order and in any batches (Eq. 2), be taken back, and landmarks be joined.
//
// A landmark may also have several *looks*: the signs of the first `look_bits` numbers of a code
// say which one an observation belongs to, and each look that occurs keeps a sum and a count of its
// own. That depends on the observation alone, so all of the above holds for each look. A landmark
// is then as far away as the nearest of its looks.
//
// n goes to 255. Before one more is added, sum and n are halved (toward zero, the mean never beyond
// 127), so that an old landmark forgets slowly; from then on its observations cannot be taken back
// exactly.
//
// Search compares codes with prototypes rounded to int8, halves away from zero.
//
// Every function either does all it was asked or throws and changes nothing (memory that runs out
// aside). Calls from several threads are safe. Changes exclude each other, and save, compact, seal,
// split and the map that update reads; commit only while it copies what has changed. A search sees
// the map between two changes or, of a change of more than 2048 observations or landmarks, between
// two pieces of that size: it never waits for longer than one of them takes and searches that began
// before it (docs/sharing.md).
class PrototypeMap {
 public:
  static constexpr int kMaxCount = 255;
  static constexpr std::size_t kMaxLookBits = 16;

  // Codes have `dim` dimensions, one of the encoder's; 0: all of them. `look_bits`
  // is 0 (one prototype a landmark) to 16 and at most dim.
  explicit PrototypeMap(std::shared_ptr<const Encoder> encoder, std::size_t dim = 0,
                        std::size_t look_bits = 0);

  PrototypeMap(PrototypeMap&& other) noexcept;

  const std::shared_ptr<const Encoder>& encoder() const { return encoder_; }
  std::size_t dim() const { return dim_; }
  std::size_t look_bits() const;
  // Landmarks.
  std::size_t size() const;
  // One for each look of each landmark.
  std::size_t prototype_count() const;
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

  // Joins landmark source[i] to into[i], look by look, in this order; the sources leave the map. A
  // landmark keeps its position, or takes the source's where it has none.
  void merge(std::span<const std::int64_t> into, std::span<const std::int64_t> source);
  // Forgets landmarks.
  void discard(std::span<const std::int64_t> landmarks);
  // Joins another map of the same encoder, dim and look_bits, as if its observations had been added
  // here. Its landmark source[i] is landmark into[i] of this map, known or new; the others keep
  // their ids, and landmarks of one id are one landmark. Several that become one are summed look by
  // look, by ascending id there; positions as in merge. Metadata under names that this map lacks is
  // taken over, and "created" becomes the earlier. The other map does not change. Throws
  // UnknownLandmark for a source that it does not have, and std::invalid_argument for one that is
  // named twice and for negative ids.
  void update(const PrototypeMap& other, std::span<const std::int64_t> into = {},
              std::span<const std::int64_t> source = {});

  // Parts of this map, with all that they know of their landmarks, but without an index. A map of
  // the same dim and look_bits that is updated with all of them equals this one without its index.
  //
  // By id: landmarks below boundaries[0], from there to below boundaries[1] and so on, one part
  // more than boundaries, which ascend. Throws std::invalid_argument where they do not.
  std::vector<PrototypeMap> split(std::span<const std::int64_t> boundaries) const;
  // By space: a part for each cube of this edge that has landmarks, by ascending cell, and at last
  // one of the landmarks without a position, where there are any. Throws std::invalid_argument for
  // an edge that is not above 0 or is too small for the map's extent.
  std::vector<MapPart> split(double cell_size) const;

  // World coordinates. Finite; NaN in all three takes a position away.
  void set_positions(std::span<const std::int64_t> landmarks, std::span<const Position> positions);
  // NaN where there is none.
  std::vector<Position> positions(std::span<const std::int64_t> landmarks) const;
  // What the map says of itself; a new map says nothing. Throws std::invalid_argument (metadata.h).
  Metadata metadata() const;
  void set_metadata(Metadata metadata);
  // Observations of each landmark, over all its looks.
  std::vector<std::uint32_t> counts(std::span<const std::int64_t> landmarks) const;
  // Means over all looks, (landmarks x dim), in code units.
  void prototypes(std::span<const std::int64_t> landmarks, MatrixView<float> means) const;
  MapSummary summary() const;
  // The looks of one landmark, by ascending sign bits.
  std::vector<Look> looks(std::int64_t landmark) const;

  // Learns coarse cells from the map's prototypes, as many as `cells`, at most 65536 and at most as
  // many as there are prototypes; by default a number that fits the map. Prototypes are kept by
  // cell from then on, through every change, and search may take `recall` or `probes`. Once more:
  // learns anew. Throws std::invalid_argument for other `cells`, and for a map without landmarks.
  //
  // Searches go on meanwhile, as prototypes are put into their cells beside the map, which takes as
  // much memory again. With `in_place` they change places within it: that takes 5 to 10 bytes a
  // prototype (and once the largest of the map's arrays where that has no room for half-filled
  // blocks), but searches wait while they do. Cells and answers are the same. Memory that runs out
  // leaves the map as it was either way.
  void build_index(std::optional<std::size_t> cells = std::nullopt, int threads = 1,
                   bool in_place = false);
  void drop_index();
  // Number of cells; 0: there is no index.
  std::size_t index_cells() const;
  // Cells that are searched for a recall above 0 and at most 1, as measured on the map: prototypes
  // of landmarks are searched for among those of all others, and codes as far from them as
  // observations are among all (docs/index.md). Measured once and again when a tenth of the map has
  // changed. Throws std::invalid_argument for another recall, and without an index.
  std::size_t probes(double recall, int threads = 1) const;

  // See protomark/search.h.
  void search(Descriptors queries, const SearchOptions& options, MatrixView<std::int64_t> ids,
              MatrixView<std::int32_t> distances) const;
  void search_codes(Codes queries, const SearchOptions& options, MatrixView<std::int64_t> ids,
                    MatrixView<std::int32_t> distances) const;

  // Writes the map, landmarks by ascending id, so that equal maps (of equal cells) give equal
  // files. Whole or not at all. Onto the file that it was loaded from with a journal: compacts.
  // Throws FileError, also where another map may commit to `path` or has, which would be lost.
  void save(const std::filesystem::path& path) const;
  // Reads a map file and what was committed to the journal beside it. With `journal` the map is the
  // one that may commit to it until it is closed or gone; nobody else can at the same time. Throws
  // FileError.
  static PrototypeMap load(const std::filesystem::path& path, bool journal = false);
  // Reads and checks the bytes of a map file and of its journal; `name` is what errors call them.
  static PrototypeMap parse(std::span<const std::byte> bytes, const std::string& name,
                            std::span<const std::byte> journal = {});

  // The journal is a file beside the map file, <path>.journal (docs/format.md).
  bool has_journal() const;
  // Makes all changes up to here last, at a cost that grows with the number of landmarks that
  // changed: when it has returned, the map file and its journal give this map, whatever happens.
  // Returns the bytes written; nothing is where nothing changed. Throws FileError, and then the map
  // in memory is as before and one may commit again; std::invalid_argument without a journal, as
  // does compact.
  std::size_t commit();
  // Writes the map file anew, as save does, and empties the journal. Whatever happens, the two of
  // them give this map or what was committed last. Throws FileError where the map file cannot be
  // written. Where only the journal cannot be emptied this returns, as everything is in the map
  // file: what stands in the journal holds nothing then, and the next commit tries again.
  void compact();
  // Gives the journal back, and what was not committed stays in memory only.
  void close();
  // Writes a sealed map (protomark/map_file.h) whose prototypes have 8 or 4 bits a number. With 8
  // it gives the same answers; with 4 numbers are rounded to 16 levels that fit this map best,
  // which takes half the bytes. `prototypes` is the largest number of prototypes a landmark has on
  // average over the map, at least 1: looks of a landmark are joined, those first whose joining
  // adds least to the squared distances of all observations to their prototypes (Ward's criterion),
  // until the map fits. One landmark keeps at most 255 looks. Positions have 32 bits a coordinate,
  // as floats relative to their middle, or 16, as whole steps along each axis of the box around
  // them, 65534 from end to end: half a step is the largest error. An index and metadata go along.
  // Throws FileError, and std::invalid_argument for other `bits`, `prototypes` and `position_bits`
  // and for positions further than 3.4e38 from their middle.
  void seal(const std::filesystem::path& path, int bits = 8,
            std::optional<double> prototypes = std::nullopt, int position_bits = 32) const;

 private:
  struct Store;

  static PrototypeMap read(const ContainerReader& file, const JournalContent& journal);
  static PrototypeMap load_with_journal(const std::filesystem::path& path);
  // Writes the map file; `before` is called with its identity before it takes its place.
  void write(const std::filesystem::path& path,
             const std::function<void(const std::string&)>& before) const;
  // The rest of a commit's record.
  std::vector<std::byte> serialize(ContainerWriter& record, const Changes& changes) const;
  Journal& journal() const;
  void fold() const;
  // A map of some of the landmarks, by number.
  PrototypeMap part(std::span<const std::uint32_t> landmarks) const;

  std::shared_ptr<const Encoder> encoder_;
  std::size_t dim_;
  std::unique_ptr<Store> store_;

 public:
  ~PrototypeMap();
};

// Landmarks of one cube of space.
struct MapPart {
  // Coordinate i of a position is in [cell[i], cell[i] + 1) * cell_size; none: it has no position.
  std::optional<std::array<std::int64_t, 3>> cell;
  PrototypeMap map;
};

}  // namespace protomark
