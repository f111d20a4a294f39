// Reads and writes plain values and texts in sections of files.
#pragma once

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
    return values<T>(1)[0];
  }
  template <typename T>
  std::vector<T> values(size_t n) {
    file_->require(n <= rest_.size() / sizeof(T), "its section '", section_,
                   "' is shorter than it should be");
    std::vector<T> v(n);
    if (n > 0) std::memcpy(v.data(), rest_.data(), n * sizeof(T));
    rest_ = rest_.subspan(n * sizeof(T));
    return v;
  }
  // Reads a u32 length and that many bytes of UTF-8.
  std::string text() {
    const std::vector<char> bytes = values<char>(value<uint32_t>());
    std::string result(bytes.begin(), bytes.end());
    file_->require(is_utf8(result), "its section '", section_, "' has a text that is not UTF-8");
    return result;
  }
  bool empty() const { return rest_.empty(); }
  size_t size() const { return rest_.size(); }
  void finish() const {
    file_->require(empty(), "its section '", section_, "' is longer than it should be");
  }

 private:
  const ContainerReader* file_;
  std::string section_;
  Bytes rest_;
};

// By default as many values as the section holds.
template <typename T>
std::vector<T> read_section(const ContainerReader& file, const char* name,
                            std::optional<size_t> n = std::nullopt) {
  SectionReader in(file, name);
  std::vector<T> result = in.values<T>(n.value_or(in.size() / sizeof(T)));
  in.finish();
  return result;
}

template <typename T>
T read_value(const ContainerReader& file, const char* name) {
  return read_section<T>(file, name, 1)[0];
}

class SectionWriter {
 public:
  void value(const auto& v) { values(&v, 1); }
  void values(const auto* v, size_t n) {
    const Bytes bytes = std::as_bytes(std::span(v, n));
    bytes_.insert(bytes_.end(), bytes.begin(), bytes.end());
  }
  void text(const std::string& v) {
    value(static_cast<uint32_t>(v.size()));
    values(v.data(), v.size());
  }
  const std::vector<std::byte>& bytes() const { return bytes_; }

 private:
  std::vector<std::byte> bytes_;
};

void add_value(ContainerWriter& file, const char* name, const auto& value) {
  file.add(name, std::as_bytes(std::span(&value, 1)));
}

// Reads packed numbers of up to 57 bits one after the other.
class PackedReader {
 public:
  // The section has `bits` bits, and padding up to a whole word.
  PackedReader(const ContainerReader& file, const char* section, size_t bits)
      : bytes_(file.read(section)) {
    file.require_size(bytes_.size() == packed_bytes(bits, 1), section);
  }

  // Reading beyond the end is the caller's error.
  uint64_t next(int bits) {
    const size_t byte = std::min(at_ / 8, bytes_.size() - sizeof(uint64_t));
    const uint64_t word = load<uint64_t>(bytes_.data() + byte) >> (at_ - 8 * byte);
    at_ += static_cast<size_t>(bits);
    return word & ((uint64_t{1} << bits) - 1);
  }

 private:
  Bytes bytes_;
  size_t at_ = 0;  // bits
};

}  // namespace protomark
