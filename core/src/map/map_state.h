// The state of a learning map, and the guard of its changes.
#pragma once

#include <cstring>

#include "file/journal.h"
#include "map/prototype_store.h"
#include "protomark/prototype_map.h"
#include "search/inverted_lists.h"

namespace protomark {

inline constexpr char kBuildIndex[] = "call build_index first";

struct MeasuredRecall {
  RecallTable table;
  size_t lists_version;
  size_t changes;
};

// Locks, in the order in which a thread takes them, and who holds them:
//   journal_mutex  commit, compact, close, and a save onto the map's own file
//   measuring      the one thread that measures the recall table
//   changing       a change, alone, from the moment it reads the map to its end; shared, all that
//                  read the map for long: save, seal, split, summary, commit while it copies, the
//                  source of a merge, measuring
//   searching      a change, alone, while it writes a piece; shared, searches and short questions
//   recall_mutex   whoever reads or replaces `recall_table`
struct MapState {
  MapState(std::shared_ptr<const Encoder> its_encoder, size_t dim, size_t appearance_bits)
      : encoder(std::move(its_encoder)), store(dim, appearance_bits) {}

  std::shared_ptr<const Encoder> encoder;
  PrototypeStore store;
  Metadata metadata;
  std::mutex journal_mutex, measuring;
  FairSharedMutex changing, searching;

  std::unique_ptr<Journal> journal;  // nullptr without a journal
  // The map file whose journal this is or was, if any. Constant once others have the map.
  std::filesystem::path journaled;

  // Returns how many lists to search for this recall, as measured on the map now, or earlier if
  // little has changed since or others measure or change the map. `lock` holds `searching`, and is
  // released while the recall table is measured.
  size_t nprobe(std::shared_lock<FairSharedMutex>& lock, double recall, int threads);

  PrototypeMap part(std::span<const LandmarkIndex> landmarks) const;

  // Throws std::invalid_argument without a journal.
  Journal& need_journal() const;
  // Writes the map file anew and empties the journal.
  void fold();

 private:
  bool is_stale(const MeasuredRecall& table) const;
  void measure(int threads, bool wait);

  std::mutex recall_mutex;
  std::shared_ptr<const MeasuredRecall> recall_table;
};

inline void check_pairs(size_t ids, size_t others, const char* what) {
  require(ids == others, ids, " landmark ids for ", others, " ", what);
}

inline void check_codes(Codes codes, size_t dim) {
  require(codes.columns == dim, "codes have ", codes.columns, " dimensions, the map has ", dim);
  const size_t n = codes.rows * codes.columns;
  require(n == 0 || std::memchr(codes.data, -128, n) == nullptr,
          "codes must be -127 to 127, one is -128");
}

// Throws FileError.
std::unique_ptr<MapState> read_map(const ContainerReader& file, const JournalContent& journal);

// Finds the two nearest landmarks of each query exactly.
using ExactSearch = std::function<Matches(Codes)>;
// Measures a recall table with two kinds of test queries: prototypes search for another landmark,
// as keypoints do whose landmark is not in the map; and codes as far from these as observations are
// search for any landmark, which is harder in a dense map. For each share of the queries the larger
// number counts. Prototypes are searched as stored(prototype) leaves them.
RecallTable measure_recall(const PrototypeStore& store, const std::function<void(int8_t*)>& stored,
                           const ExactSearch& search);

// A change of a map, beside which only searches go on, between its pieces.
class MapChange {
 public:
  // Observations or landmarks that are changed at a time.
  static constexpr size_t kPiece = 1 << 11;

  explicit MapChange(MapState& state) : MapChange(state, std::unique_lock(state.changing)) {}
  MapChange(MapState& state, std::unique_lock<FairSharedMutex> changing)
      : state_(&state), changing_(std::move(changing)) {}

  // Lets the change write: while the lock is held no search reads the map.
  std::unique_lock<FairSharedMutex> write() { return std::unique_lock(state_->searching); }

  // Calls write_one(i) for all i below n, in pieces that leave all rows in their lists.
  void in_pieces(size_t n, const auto& write_one) {
    for (size_t first = 0; first < n; first += kPiece) {
      const auto lock = write();
      for (size_t i = first; i < std::min(n, first + kPiece); ++i) write_one(i);
      state_->store.reassign(1);
    }
  }

  void set_metadata(Metadata metadata);
  void add(std::span<const int64_t> ids, Codes codes, int threads);
  // Puts rows into the lists of other centroids (without any, drops the index): in a copy of the
  // map, or with `in_place` within it, which takes 5 bytes per row and, if arrays have to grow, the
  // largest of them once more, but makes searches wait.
  void set_quantizer(CoarseQuantizer quantizer, int threads, bool in_place);

 private:
  MapState* state_;
  std::unique_lock<FairSharedMutex> changing_;
};

}  // namespace protomark
