// Values at and beyond the limits that docs/limits.md states.
#include <unistd.h>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <limits>
#include <new>

#include "check.h"
#include "file/container.h"
#include "file/sections.h"
#include "protomark/protomark.h"
#include "random.h"
#include "sealing.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

constexpr std::size_t kDim = 12;
constexpr std::int64_t kMostId = std::numeric_limits<std::int64_t>::max();
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr double kInfinity = std::numeric_limits<double>::infinity();

template <typename F>
bool refused(const F& f, const std::string& message) {
  return check::throws<std::invalid_argument>(f, message);
}

using Ids = std::vector<std::int64_t>;

std::vector<std::int8_t> codes_of(std::size_t n, std::uint32_t seed = 1) {
  test::Random random(seed);
  return random.integers<std::int8_t>(n * kDim, -127, 127);
}

Codes view(const std::vector<std::int8_t>& codes) {
  return {codes.data(), codes.size() / kDim, kDim};
}

template <typename Map>
Ids search(const Map& map, const std::vector<std::int8_t>& codes, std::size_t k) {
  return map.search_codes(view(codes), k).ids.data;
}

struct Parts {
  EncoderInfo info{"tiny", "test", "", "", {}};
  std::vector<Layer> layers;
  std::vector<std::size_t> dims{6, 12};
  float scale = 1;

  Parts() {
    test::Random random(1);
    layers = {test::random_layer(random, 64, 40), test::random_layer(random, 40, 12)};
  }
};

void test_encoder() {
  const auto bad = [](const auto& change, const std::string& message) {
    Parts p;
    change(p);
    CHECK(refused([&] { Encoder(p.info, p.layers, p.dims, p.scale); }, message));
  };
  test::Random random(2);
  const auto layer = [&](std::size_t inputs, std::size_t outputs) {
    return test::random_layer(random, inputs, outputs);
  };
  bad([](Parts& p) { p.info.name.clear(); }, "name and descriptor");
  for (const std::string key : {"name", "descriptor", "data", "licence"}) {
    bad([&](Parts& p) { p.info.notes = {{key, "other"}}; }, "no note may have the key '" + key);
  }
  bad([](Parts& p) { p.info.data = "\xff"; }, "its data is not UTF-8");
  bad([](Parts& p) { p.info.notes = {{"key", "\xff"}}; }, "its notes are not UTF-8");
  bad([](Parts& p) { p.layers.clear(); }, "it has 0 layers, 1 to 16");
  bad([&](Parts& p) { p.layers.assign(17, layer(64, 64)); }, "it has 17 layers");
  bad([&](Parts& p) { p.layers = {layer(56, 12)}; }, "64 to 1024 bits");
  bad([&](Parts& p) { p.layers = {layer(1032, 12)}; }, "64 to 1024 bits");
  bad([&](Parts& p) { p.layers = {layer(68, 12)}; }, "a multiple of 8, not 68");
  bad([&](Parts& p) { p.layers[1] = layer(41, 12); }, "layer 1 has 41 inputs, 40 are needed");
  bad([&](Parts& p) { p.layers = {layer(64, 0)}; }, "layer 0 has 0 outputs, 1 to 4096");
  bad([&](Parts& p) { p.layers[0] = layer(64, 4097); }, "layer 0 has 4097 outputs");
  bad([](Parts& p) { p.layers[0].bias.pop_back(); }, "do not match its size");
  bad([](Parts& p) { p.layers[0].shift = 0; }, "shift must be 1 to 62");
  bad([](Parts& p) { p.layers[1].shift = 63; }, "shift must be 1 to 62");
  bad([](Parts& p) { p.layers[1].multipliers[3] = 0; }, "multipliers must be positive");
  bad([](Parts& p) { p.layers[1].bias[2] = std::numeric_limits<std::int32_t>::max(); },
      "sums of output 2 could leave 32 bits");
  bad([](Parts& p) { p.layers[0].bias[0] = std::numeric_limits<std::int32_t>::min(); },
      "could leave 32 bits");
  for (const auto& dims : std::vector<std::vector<std::size_t>>{{}, {0, 12}, {12, 12}, {6}}) {
    bad([&](Parts& p) { p.dims = dims; }, "dims must ascend");
  }
  bad([&](Parts& p) { p.layers[1] = layer(40, 257), p.dims = {257}; }, "at most 256 dimensions");
  for (const float scale : {0.0f, -1.0f, NAN, INFINITY}) {
    bad([&](Parts& p) { p.scale = scale; }, "scale must be positive");
  }

  // The largest shift and sums that just fit.
  Parts p;
  p.layers = {layer(1024, 256)};
  p.dims = {256};
  p.layers[0].shift = 62;
  for (auto& weight : p.layers[0].weights) weight = -128;
  for (auto& bias : p.layers[0].bias) bias = std::numeric_limits<std::int32_t>::min() + 128 * 1024;
  for (auto& m : p.layers[0].multipliers) m = std::numeric_limits<std::int32_t>::max();
  const Encoder encoder(p.info, p.layers, p.dims, p.scale);
  CHECK(encoder.multiply_adds() == 1024 * 256);
  const std::vector<std::uint8_t> descriptor(128, 255);
  std::vector<std::int8_t> code(256);
  encoder.encode({descriptor.data(), 1, 128}, {code.data(), 1, 256});
  CHECK(code == std::vector<std::int8_t>(256, -1));  // -2^31 (2^31 - 1) / 2^62, rounded
  CHECK(encoder.encode({descriptor.data(), 1, 128}).data == code);
  CHECK(encoder.encode({}).rows == 0);  // as OpenCV gives no descriptors

  CHECK(refused([&] { encoder.encode({descriptor.data(), 2, 64}, {code.data(), 2, 128}); },
                "descriptors have 64 bytes, encoder 'tiny' takes 128"));
  CHECK(refused([&] { encoder.encode({descriptor.data(), 1, 128}, {code.data(), 0, 256}); },
                "as many rows"));
  CHECK(refused([&] { encoder.encode({descriptor.data(), 1, 128}, {code.data(), 1, 257}); },
                "gives 1 to 256 dimensions, not 257"));
  CHECK(refused([&] { encoder.encode({descriptor.data(), 1, 128}, {code.data(), 1, 256}, 0); },
                "threads must be at least 1"));
}

void test_ids_and_codes(const std::shared_ptr<const Encoder>& encoder) {
  CHECK(refused([] { PrototypeMap(std::shared_ptr<const Encoder>()); }, "needs an encoder"));
  CHECK(refused([&] { PrototypeMap(encoder, 7); }, "no codes of 7 dimensions"));
  CHECK(refused([&] { PrototypeMap(encoder, 6, 7); }, "appearance_bits must be 0 to 6, not 7"));

  PrototypeMap map(encoder);
  const auto codes = codes_of(2);
  const std::vector<std::uint8_t> descriptors(2 * encoder->bytes());
  for (const std::int64_t id : {std::int64_t{-1}, std::numeric_limits<std::int64_t>::min()}) {
    const Ids ids = {0, id};
    CHECK(refused([&] { map.add_codes(ids, view(codes)); }, "is negative"));
    CHECK(refused([&] { map.add(ids, {descriptors.data(), 2, encoder->bytes()}); }, "is negative"));
  }
  CHECK(refused([&] { map.add_codes(Ids{1}, view(codes)); }, "1 landmark ids for 2 codes"));
  CHECK(refused([&] { map.add(Ids{1}, {descriptors.data(), 2, encoder->bytes()}); },
                "1 landmark ids for 2 descriptors"));
  CHECK(refused([&] { map.add_codes(Ids{1, 2}, {codes.data(), 2, 11}); }, "codes have 11"));
  auto low = codes;
  low[5] = -128;
  CHECK(refused([&] { map.add_codes(Ids{1, 2}, view(low)); }, "one is -128"));
  CHECK(map.size() == 0);

  map.add_codes(Ids{0, kMostId}, view(codes));
  CHECK(map.ids() == Ids{0, kMostId});
  CHECK(search(map, codes, 3) == Ids{0, kMostId, -1, kMostId, 0, -1});
  CHECK(check::throws<UnknownLandmark>([&] { map.counts(Ids{-1}); }, "landmark -1"));

  CHECK(refused([&] { search(map, codes, 0); }, "k must be at least 1"));
  for (const std::size_t k : {SIZE_MAX, SIZE_MAX / 2 + 1, SIZE_MAX / 8}) {
    CHECK(check::throws<std::bad_alloc>([&] { search(map, codes, k); }));
  }
  CHECK(check::throws<std::bad_alloc>([&] { search(map, {}, SIZE_MAX); }));
  const auto with = [&](const SearchOptions& options) {
    map.search_codes(view(codes), 1, options);
  };
  SearchOptions options;
  options.threads = 0;
  CHECK(refused([&] { with(options); }, "threads must be at least 1"));
  options = {};
  for (const std::int32_t d : {-1, INT32_MIN}) {
    options.max_distance = d;
    CHECK(refused([&] { with(options); }, "max_distance"));
  }
  options = {};
  for (const double ratio : {0.0, 1.01, std::nan("")}) {
    options.ratio = ratio;
    CHECK(refused([&] { with(options); }, "ratio must be above 0"));
  }
  CHECK(refused([&] { map.search_codes({codes.data(), 2, 6}); }, "queries have 6 dimensions"));
}

// A landmark that a batch names twice is changed twice.
void test_duplicates(const std::shared_ptr<const Encoder>& encoder) {
  const auto codes = codes_of(4);
  PrototypeMap map(encoder), reference(encoder);
  map.add_codes(Ids{5, 5, 5, 9}, view(codes));
  for (std::size_t i = 0; i < 4; ++i) {
    reference.add_codes(Ids{i == 3 ? 9 : 5}, {&codes[i * kDim], 1, kDim});
  }
  CHECK(map.prototypes(Ids{5}) == reference.prototypes(Ids{5}));
  CHECK(map.counts(Ids{5, 5, 9}) == std::vector<std::uint32_t>{3, 3, 1});

  const std::vector<Position> positions = {{1, 2, 3}, {4, 5, 6}};
  map.set_positions(Ids{5, 5}, positions);
  CHECK(map.positions(Ids{5})[0] == positions[1]);

  CHECK(refused([&] { map.subtract_codes(Ids{9, 9}, {codes.data(), 2, kDim}); },
                "has 1 observations, 2 cannot be subtracted"));
  CHECK(refused([&] { map.subtract_codes(Ids{5}, {codes.data(), 0, kDim}); }, "1 landmark ids"));
  CHECK(check::throws<UnknownLandmark>([&] { map.subtract_codes(Ids{7}, {codes.data(), 1, kDim}); },
                                       "landmark 7"));
  const std::vector<std::int8_t> other(kDim, 127);
  map.add_codes(Ids{20, 20}, {codes.data(), 2, kDim});
  auto impossible = codes;
  for (std::size_t d = 0; d < kDim; ++d)
    impossible[d] = codes[d] + codes[kDim + d] > 0 ? -127 : 127;
  CHECK(refused([&] { map.subtract_codes(Ids{20}, {impossible.data(), 1, kDim}); }, "never added"));
  CHECK(map.counts(Ids{5, 9, 20}) == std::vector<std::uint32_t>{3, 1, 2});
  map.subtract_codes(Ids{5, 5}, {codes.data(), 2, kDim});
  CHECK(map.counts(Ids{5}) == std::vector<std::uint32_t>{1});

  map.add_codes(Ids{30, 31, 32, 33}, view(codes));
  CHECK(refused([&] { map.merge_landmarks(Ids{30}, Ids{30}); }, "into itself"));
  CHECK(refused([&] { map.merge_landmarks(Ids{30, 32}, Ids{31, 31}); },
                "31 was merged into another"));
  CHECK(refused([&] { map.merge_landmarks(Ids{30, 31}, Ids{31, 32}); },
                "31 was merged into another"));
  CHECK(refused([&] { map.merge_landmarks(Ids{30}, Ids{}); }, "1 landmark ids for 0 sources"));
  map.merge_landmarks(Ids{30, 30}, Ids{31, 32});
  CHECK(map.counts(Ids{30}) == std::vector<std::uint32_t>{3});
  map.remove(Ids{33, 33, 30});
  CHECK(map.ids() == Ids{5, 9, 20});

  PrototypeMap several(encoder, 0, 2);
  several.add_codes(Ids{1}, {codes.data(), 1, kDim});
  std::vector<std::int8_t> turned(codes.begin(), codes.begin() + kDim);
  for (auto& v : turned) v = static_cast<std::int8_t>(v > 0 ? -1 : 1);
  CHECK(refused([&] { several.subtract_codes(Ids{1}, view(turned)); }, "never added"));
  CHECK(refused([&] { several.subtract_codes(Ids{1, 1}, {codes.data(), 0, kDim}); },
                "2 landmark ids"));
}

void test_positions(const std::shared_ptr<const Encoder>& encoder, const fs::path& path) {
  PrototypeMap map(encoder);
  map.add_codes(Ids{1, 2}, view(codes_of(2)));
  for (const Position& p : {Position{kNaN, 0, 0}, Position{0, kInfinity, 0},
                            Position{0, 0, -kInfinity}, Position{kNaN, kNaN, kInfinity}}) {
    CHECK(refused([&] { map.set_positions(Ids{2}, std::span(&p, 1)); },
                  "position of landmark 2 is not finite"));
  }
  const Position far = {1e300, 0, 0}, near = {-1e300, 0, 0}, none = {kNaN, kNaN, kNaN};
  map.set_positions(Ids{1}, std::span(&far, 1));
  map.set_positions(Ids{2}, std::span(&near, 1));
  map.save(path);
  CHECK(PrototypeMap::load(path).positions(Ids{1, 2}) == (std::vector{far, near}));
  for (const int bits : {32, 16}) {
    CHECK(refused([&] { map.seal(path, {.position_bits = bits}); }, "too far apart"));
  }
  CHECK(refused([&] { map.seal(path, {.position_bits = 24}); }, "must be 32, 16 or 0, not 24"));
  map.set_positions(Ids{2}, std::span(&none, 1));
  for (const int bits : {32, 16}) {
    map.seal(path, {.position_bits = bits});
    const SealedMap sealed(path);
    CHECK(sealed.position_bits() == bits);
    CHECK(sealed.positions(Ids{1})[0] == far);
    CHECK(std::isnan(sealed.positions(Ids{2})[0][1]));
    CHECK(sealed.summary().landmarks_with_position == 1 && sealed.summary().extent->back() == far);
  }
  CHECK((SealedMap(path).position_error() == Position{0, 0, 0}));
  map.set_positions(Ids{1}, std::span(&none, 1));
  map.seal(path, {.position_bits = 16});
  CHECK(SealedMap(path).position_bits() == 0 && !SealedMap(path).position_error());
}

// All functions work for maps without landmarks and with one.
void test_small_maps(const std::shared_ptr<const Encoder>& encoder, const fs::path& folder) {
  const auto queries = codes_of(2, 7);
  for (const std::size_t appearance_bits : {0, 3}) {
    for (const std::size_t n : {0, 1}) {
      PrototypeMap map(encoder, 0, appearance_bits);
      const auto codes = codes_of(n);
      const Ids ids(n, kMostId);
      map.add_codes(ids, view(codes));
      map.add({}, {nullptr, 0, encoder->bytes()});
      map.subtract_codes({}, {nullptr, 0, kDim});
      map.merge_landmarks({}, {});
      map.remove({});
      map.set_positions({}, {});
      PrototypeMap other(encoder, 0, appearance_bits);
      other.merge_map(map);
      map.merge_map(PrototypeMap(encoder, 0, appearance_bits));
      const Ids expected = n == 0 ? Ids{-1, -1, -1, -1} : Ids{kMostId, -1, kMostId, -1};
      map.save(folder / "open");
      verify_file(folder / "open");
      for (const PrototypeMap& m : {std::cref(map), std::cref(other)}) {
        CHECK(m.size() == n && m.ids() == ids && m.prototype_count() == n);
        CHECK(search(m, queries, 2) == expected);
      }
      const PrototypeMap read = PrototypeMap::load(folder / "open");
      CHECK(read.ids() == ids && search(read, queries, 2) == expected);
      for (const SealOptions& options : {SealOptions(), test::in_words(map)}) {
        map.seal(folder / "sealed", options);
        verify_file(folder / "sealed");
        const SealedMap sealed(folder / "sealed");
        CHECK(sealed.ids() == ids && search(sealed, queries, 2) == expected);
        CHECK(sealed.positions(ids).size() == n);
      }
      CHECK(search(map, {}, 2).empty());
      for (const double bytes : {1.99, kNaN}) {
        CHECK(refused([&] { map.seal(folder / "sealed", {.bytes_per_landmark = bytes}); },
                      "bytes_per_landmark must be at least 2"));
      }
      map.subtract_codes(ids, view(codes));
      CHECK(map.size() == 0);
    }
  }
}

void test_merge_map(const std::shared_ptr<const Encoder>& encoder) {
  PrototypeMap map(encoder);
  CHECK(refused([&] { map.merge_map(map); }, "merged into itself"));
  CHECK(refused([&] { map.merge_map(PrototypeMap(encoder, 6)); }, "dimensions cannot be merged"));
  CHECK(refused([&] { map.merge_map(PrototypeMap(test::random_encoder(64, 12, 9))); },
                "different encoders"));
  CHECK(refused([&] { map.merge_map(PrototypeMap(encoder, 12, 1)); }, "0 and 1 appearance bits"));
}

// Sections of a file as a malicious writer may make them.
class File {
 public:
  explicit File(const fs::path& path) {
    const MappedFile mapped(path);
    const ContainerReader reader(mapped.bytes(), "file");
    kind_ = reader.kind();
    for (const auto& [name, size] : reader.sections()) {
      const Bytes bytes = reader.read(name);
      sections_.emplace_back(name, std::vector(bytes.begin(), bytes.end()));
    }
  }
  std::vector<std::byte>& operator[](const std::string& name) {
    for (auto& [key, bytes] : sections_) {
      if (key == name) return bytes;
    }
    return sections_.emplace_back(name, std::vector<std::byte>{}).second;
  }
  template <typename T>
  File&& set(const std::string& name, std::size_t at, T value) && {
    std::memcpy(&(*this)[name].at(at), &value, sizeof(value));
    return std::move(*this);
  }
  File&& resize(const std::string& name, std::size_t size) && {
    (*this)[name].resize(size);
    return std::move(*this);
  }
  File&& drop(const std::string& name) && {
    std::erase_if(sections_, [&](const auto& s) { return s.first == name; });
    return std::move(*this);
  }
  // Calls f with its bytes, at a multiple of 64 as a mapped file's are.
  template <typename F>
  void with_bytes(const F& f) const {
    ContainerWriter writer(kind_);
    for (const auto& [name, bytes] : sections_) writer.add(name, Bytes(bytes));
    const auto bytes = writer.serialize();
    std::vector<std::byte> room(bytes.size() + 64);
    void* start = room.data();
    std::size_t space = room.size();
    std::align(64, bytes.size(), start, space);
    std::memcpy(start, bytes.data(), bytes.size());
    f(Bytes(static_cast<const std::byte*>(start), bytes.size()));
  }
  // Returns the error of opening, or nothing.
  std::string error() const {
    try {
      with_bytes([&](Bytes bytes) {
        if (kind_ == FileKind::encoder) {
          Encoder::parse(bytes, "file");
        } else if (kind_ == FileKind::learning_map) {
          PrototypeMap::parse(bytes, "file");
        } else {
          SealedMap(bytes, "file");
        }
      });
    } catch (const FileError& error) {
      return error.what();
    }
    return "";
  }

 private:
  FileKind kind_;
  std::vector<std::pair<std::string, std::vector<std::byte>>> sections_;
};

void test_claims(const std::shared_ptr<const Encoder>& encoder, const fs::path& folder) {
  const fs::path learning = folder / "open", sealed = folder / "sealed", model = folder / "model";
  PrototypeMap map(encoder, 0, 2);
  const auto codes = codes_of(30);
  Ids ids;
  for (std::int64_t i = 0; i < 30; ++i) ids.push_back(10 * (i / 3));
  map.add_codes(ids, view(codes));
  const Position p = {1, 2, 3};
  map.set_positions(Ids{0}, std::span(&p, 1));
  map.save(learning);
  map.seal(sealed, test::in_words(map));
  encoder->save(model);
  CHECK(File(learning).error().empty() && File(sealed).error().empty() &&
        File(model).error().empty());

  const auto says = [](const File& file, const std::string& part) {
    const bool found = !part.empty() && file.error().find(part) != std::string::npos;
    if (!found) std::printf("message was: %s\n", file.error().c_str());
    return found;
  };
  for (const fs::path& path : {learning, sealed}) {
    CHECK(says(File(path).set("shape", 0, std::uint64_t{1} << 32), "more landmarks than a map"));
    CHECK(says(File(path).set("shape", 0, std::uint64_t{UINT32_MAX}), "section"));
    CHECK(says(File(path).set("shape", 0, UINT64_MAX), "more landmarks than a map"));
    CHECK(says(File(path).set("shape", 8, std::uint64_t{13}), "dimension does not fit"));
    CHECK(says(File(path).set("shape", 16, kInfinity), "origin is not finite"));
    CHECK(says(File(path).resize("shape", 39), "'shape' is shorter"));
    CHECK(says(File(path).resize("shape", 41), "'shape' is longer"));
    CHECK(says(File(path).set("idblocks", 0, std::int64_t{-1}), "negative landmark id"));
    CHECK(says(File(path).set("idblocks", 0, kMostId), "do not ascend"));
    CHECK(says(File(path).resize("idblocks", 15), "section 'idblocks'"));
    CHECK(says(File(path).drop("encoder"), "lacks the section 'encoder'"));
    CHECK(says(File(path).resize("encoder", 10), "encoder: not a Protomark file"));
  }
  CHECK(says(File(learning).set("appbits", 0, std::uint32_t{13}), "13 bits, not 1 to 12"));
  CHECK(says(File(learning).set("appbits", 0, std::uint32_t{0}), "0 bits"));
  CHECK(says(File(learning).set("appear", 0, std::uint64_t{0}), "do not ascend"));
  CHECK(says(File(learning).set("appear", 0, UINT64_MAX), "prototypes of no landmark"));
  CHECK(says(File(learning).resize("appear", 9), "'appear' has the wrong size"));
  CHECK(says(File(learning).resize("counts", 9), "'counts' has the wrong size"));
  File endless(learning);
  const std::size_t end = endless["counts"].size() * 3 - 1;
  endless["appear"][end / 8] ^= std::byte{1} << end % 8;
  CHECK(says(endless, "landmark without prototypes"));
  CHECK(says(File(learning).set("counts", 0, std::uint8_t{0}), "impossible prototype"));
  CHECK(says(File(learning).set("sums", 0, std::int16_t{0x80}), "impossible prototype"));
  CHECK(says(File(learning).set("sums", 15, std::uint8_t{1}), "impossible prototype"));  // padding
  CHECK(says(File(learning).resize("sums", 100), "'sums' has the wrong size"));
  CHECK(says(File(learning).set("spare", 0, UINT64_MAX), "'sums' has the wrong size"));
  CHECK(says(File(learning).resize("spare", 9), "'spare' has the wrong size"));
  CHECK(says(File(learning).set("position", 0, kNaN), "no finite position"));
  CHECK(says(File(learning).set("position", 8, kInfinity), "no finite position"));
  CHECK(says(File(sealed).set("rows", 0, std::uint8_t{0}), "landmark without prototypes"));
  for (const std::uint32_t width : {0, 1, 4}) {
    CHECK(says(File(sealed).set("width", 0, width), "its encoder has no codebook for words of"));
  }
  CHECK(says(File(sealed).set("width", 0, std::uint32_t{3}), "'protos' has the wrong size"));
  CHECK(says(File(sealed).resize("width", 8), "'width' is longer"));
  CHECK(says(File(sealed).resize("protos", 64), "'protos' has the wrong size"));
  CHECK(says(File(sealed).resize("position", 13), "'position' has the wrong size"));
  CHECK(says(File(sealed).drop("protos"), "lacks the section 'protos'"));
  CHECK(says(File(sealed).resize("steps", 23), "'steps' is shorter"));
  CHECK(says(File(sealed).resize("steps", 24), "'position' has the wrong size"));
  for (const double step : {-1.0, kNaN, kInfinity, 1e305}) {
    CHECK(says(File(sealed).resize("steps", 24).set("steps", 16, step), "steps of its positions"));
  }
  CHECK(says(File(model).set("network", 0, -1.0f), "scale must be positive"));
  CHECK(says(File(model).set("network", 4, std::uint32_t{257}), "too many dims"));
  CHECK(says(File(model).set("network", 16, std::uint32_t{17}), "too many layers"));
  CHECK(says(File(model).set("network", 20, std::uint32_t{4097}), "a layer is too wide"));
  CHECK(says(File(model).set("info", 0, UINT32_MAX), "'info' is shorter"));
  CHECK(says(File(model).set("codebook", 0, std::uint32_t{5}), "a codebook is too large"));
  CHECK(says(File(model).set("codebook", 4, std::uint32_t{257}), "a codebook is too large"));
  CHECK(says(File(model).resize("codebook", 8 + 7 * 512).set("codebook", 4, std::uint32_t{7}),
             "256 words for each 2 numbers"));
  CHECK(says(File(model).set("codebook", 8, std::uint8_t{0x80}), "must be -127 to 127"));
  CHECK(says(File(model).resize("codebook", 4), "'codebook' is shorter"));
  for (const float x : {INFINITY, NAN}) {
    File(sealed).set("position", 4, x).with_bytes([](Bytes bytes) {
      const Position read = SealedMap(bytes, "file").positions(Ids{0})[0];
      CHECK(std::isnan(read[0]) && std::isnan(read[1]) && std::isnan(read[2]));
    });
  }
  // An unknown section is skipped.
  CHECK(File(learning).resize("later", 100).error().empty());
  CHECK(File(sealed).resize("later", 100).error().empty());

  CHECK(check::throws<FileError>([&] { map_kind(model); }, "it holds an encoder"));
  CHECK(file_sections(model).size() == 3 && file_sections(model)[0].first == "info");
  std::vector<std::byte> bytes(65);
  CHECK(refused([&] { SealedMap(std::span(bytes).subspan(1), "x"); }, "multiple of 64"));
}

}  // namespace

int main() {
  const fs::path folder =
      fs::temp_directory_path() / ("protomark_limits_" + std::to_string(::getpid()));
  fs::create_directory(folder);
  const auto encoder = test::random_encoder();
  test_encoder();
  test_ids_and_codes(encoder);
  test_duplicates(encoder);
  test_positions(encoder, folder / "map");
  test_small_maps(encoder, folder);
  test_merge_map(encoder);
  test_claims(encoder, folder);
  fs::remove_all(folder);
  return check::result();
}
