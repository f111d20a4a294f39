// Reads and writes plain values and texts in sections of files.
#pragma once

#include "base/packed_numbers.h"
#include "file/container.h"

namespace protomark {

// Names of sections; docs/format.md says what each of them holds.
namespace section {
// Encoders.
inline constexpr char kInfo[] = "info";
inline constexpr char kNetwork[] = "network";
inline constexpr char kCodebooks[] = "codebook";
// Maps of both kinds, and commits.
inline constexpr char kEncoder[] = "encoder";
inline constexpr char kShape[] = "shape";
inline constexpr char kMetadata[] = "metadata";
inline constexpr char kCounts[] = "counts";
inline constexpr char kPositions[] = "position";
inline constexpr char kCentroids[] = "centroid";
inline constexpr char kIdBlocks[] = "idblocks";
inline constexpr char kIdGaps[] = "idgaps";
// Learning maps and commits.
inline constexpr char kAppearanceBits[] = "appbits";
inline constexpr char kAppearances[] = "appear";
inline constexpr char kSums[] = "sums";
inline constexpr char kSpareBits[] = "spare";
// Sealed maps.
inline constexpr char kRows[] = "rows";
inline constexpr char kPrototypes[] = "protos";
inline constexpr char kWidth[] = "width";
inline constexpr char kSteps[] = "steps";
inline constexpr char kTuned[] = "tuned";
inline constexpr char kListRows[] = "listrows";
inline constexpr char kOwners[] = "owners";
inline constexpr char kOwnerChecksums[] = "ownercrc";
inline constexpr char kRecall[] = "recall";
// Journals.
inline constexpr char kBase[] = "base";
inline constexpr char kChain[] = "chain";
inline constexpr char kRemoved[] = "removed";
}  // namespace section

// Reads plain values from a section, from front to back. All functions throw FileError.
class SectionReader {
 public:
  SectionReader(const ContainerReader& file, std::string_view section)
      : file_(&file), section_(section), rest_(file.read(section)) {}

  template <typename T>
  T value() {
    T v;
    copy(&v, 1);
    return v;
  }
  template <typename T>
  std::vector<T> values(size_t n) {
    check(n, sizeof(T));
    std::vector<T> v(n);
    copy(v.data(), n);
    return v;
  }
  template <typename T>
  void copy(T* to, size_t n) {
    check(n, sizeof(T));
    if (n > 0) std::memcpy(to, rest_.data(), n * sizeof(T));
    rest_ = rest_.subspan(n * sizeof(T));
  }
  // Reads a u32 length and that many bytes of UTF-8.
  std::string text() {
    const std::vector<char> bytes = values<char>(value<uint32_t>());
    std::string result(bytes.begin(), bytes.end());
    if (!is_utf8(result)) file_->fail("its section '", section_, "' has a text that is not UTF-8");
    return result;
  }
  bool empty() const { return rest_.empty(); }
  // Throws FileError if bytes are left.
  void finish() const {
    if (!rest_.empty()) file_->fail("its section '", section_, "' is longer than it should be");
  }

 private:
  void check(size_t n, size_t size) const {
    if (n <= rest_.size() / size) return;
    file_->fail("its section '", section_, "' is shorter than it should be");
  }

  const ContainerReader* file_;
  std::string section_;
  Bytes rest_;
};

// Reads a section of exactly n values.
template <typename T>
std::vector<T> read_section(const ContainerReader& file, const char* name, size_t n) {
  SectionReader in(file, name);
  std::vector<T> result = in.values<T>(n);
  in.finish();
  return result;
}

template <typename T>
T read_value(const ContainerReader& file, const char* name) {
  return read_section<T>(file, name, 1)[0];
}

class SectionWriter {
 public:
  template <typename T>
  void value(const T& v) {
    values(&v, 1);
  }
  template <typename T>
  void values(const T* v, size_t n) {
    const Bytes bytes = std::as_bytes(std::span(v, n));
    bytes_.insert(bytes_.end(), bytes.begin(), bytes.end());
  }
  void text(const std::string& v) {
    value(static_cast<uint32_t>(v.size()));
    values(v.data(), v.size());
  }
  void add_to(ContainerWriter& file, const char* name) { file.add(name, std::move(bytes_)); }
  std::vector<std::byte> take() { return std::move(bytes_); }

 private:
  std::vector<std::byte> bytes_;
};

template <typename T>
void add_value(ContainerWriter& file, const char* name, const T& value) {
  SectionWriter out;
  out.value(value);
  out.add_to(file, name);
}

// Reads packed numbers of up to 57 bits one after the other.
class PackedReader {
 public:
  // The section has `bits` bits, and padding up to a whole word.
  PackedReader(const ContainerReader& file, const char* section, size_t bits)
      : bytes_(file.read(section)) {
    if (bytes_.size() != packed_bytes(bits, 1)) file.fail_size(section);
  }

  // Reading beyond the end is the caller's error.
  uint64_t next(int bits) {
    const size_t byte = std::min(at_ / 8, bytes_.size() - sizeof(uint64_t));
    uint64_t word;
    std::memcpy(&word, bytes_.data() + byte, sizeof(word));
    word >>= at_ - 8 * byte;
    at_ += static_cast<size_t>(bits);
    return word & ((uint64_t{1} << bits) - 1);
  }

 private:
  Bytes bytes_;
  size_t at_ = 0;  // bits
};

// Hands n elements of `width` values each to a sink; fill(i, to) writes the values of element i.
template <typename T, typename Fill>
void put_values(const ContainerWriter::Sink& sink, size_t n, size_t width, const Fill& fill) {
  constexpr size_t kPiece = 1 << 16;  // bytes
  const size_t element = width * sizeof(T);
  const size_t piece = std::min(n, std::max<size_t>(1, kPiece / element));
  std::vector<T> values(piece * width);
  for (size_t first = 0; first < n; first += piece) {
    const size_t end = std::min(n, first + piece);
    for (size_t i = first; i < end; ++i) fill(i, &values[(i - first) * width]);
    sink(std::as_bytes(std::span(values)).first((end - first) * element));
  }
}

// Hands value(element), a T, to a sink for each element of a span.
template <typename T, typename Element, typename Value>
void put_each(const ContainerWriter::Sink& sink, std::span<const Element> elements,
              const Value& value) {
  put_values<T>(sink, elements.size(), 1, [&](size_t i, T* to) { *to = value(elements[i]); });
}

}  // namespace protomark
