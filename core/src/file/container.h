// The file that models and maps share: a header, a table of sections, the sections.
//
//   header   64 bytes: magic "PROTOMRK", u32 version, u32 kind, u64 file size, u32 number of
//            sections, u32 CRC-32 of header and table (this field taken as 0), 32 bytes of zero
//   table    32 bytes a section: name (8 bytes, padded with 0), u64 offset, u64 size,
//            u32 CRC-32 of the section, u32 zero
//   sections each at a multiple of 64 bytes, in the table's order, gaps filled with zeros
//
// Everything is little-endian. docs/format.md says what each kind holds.
#pragma once

#include <sys/types.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "file/disk.h"

namespace protomark {

enum class FileKind : std::uint32_t {
  encoder = 1,
  open_map = 2,
  sealed_map = 3,
  // A journal is one of the first kind and any number of the others, one after the other.
  journal = 4,
  commit = 5,
  fold = 6
};

const char* describe(FileKind kind);

// Sections to be written as one file. They are in memory and belong to somebody else, or come into
// being piece by piece while the file is written.
class ContainerWriter {
 public:
  using Sink = std::function<void(Bytes)>;
  // Hands the bytes of a section to the sink, from the first to the last.
  using Produce = std::function<void(const Sink&)>;

  // `version` is the oldest format that has all that the file holds (docs/format.md), so that a
  // reader which knows less refuses it, and older ones go on reading everything else.
  explicit ContainerWriter(FileKind kind, std::uint32_t version = 1)
      : kind_(kind), version_(version) {}

  // `bytes` must stay alive until the file is written.
  void add(std::string name, Bytes bytes);
  // Takes the bytes over.
  void add(std::string name, std::vector<std::byte> bytes);
  // `produce` is called each time that the file is written, and must then give `size` bytes.
  void add(std::string name, std::size_t size, Produce produce);

  struct Part {
    std::string name;
    std::size_t size;  // in bytes
  };
  static constexpr std::size_t kUnknownSize = SIZE_MAX;
  using ProduceAll = std::function<void(std::span<const Sink>)>;
  // Sections that come into being side by side: `produce` has a sink for each, and hands them their
  // bytes in any turn. Only the last one's size may be unknown.
  void add_together(std::vector<Part> parts, ProduceAll produce);

  std::vector<std::byte> serialize() const;
  // Writes the file as write_file does, without a copy of the sections. What a producer throws
  // passes through, and the old file is still there. `before` is called with the new file's
  // identity when that is synced and has not taken the place of the old one yet.
  void write(const std::filesystem::path& path,
             const std::function<void(const std::string&)>& before = {}) const;

 private:
  struct Group {
    std::vector<Part> parts;
    ProduceAll produce;
  };
  using Place = std::function<void(std::size_t offset, Bytes)>;
  // Where the sections begin.
  std::size_t head_size() const;
  // Puts the sections to their places and returns what stands before them, which has their
  // checksums.
  std::vector<std::byte> emit(const Place& place) const;

  FileKind kind_;
  std::uint32_t version_;
  std::vector<Group> groups_;
};

// The identity of a file that begins with these bytes: the SHA-256 of its header and section table,
// which have the checksum and size of everything in it. Empty where these are not there.
std::string file_identity(Bytes head);

// Whether bytes begin with a header and section table that match their checksum.
bool has_container_head(Bytes head);

// Writes bytes beside `path`, syncs, renames over it, syncs the folder. On any failure the old file
// is still there and the new one is gone; only where the folder cannot be synced is it the new one
// that is there, and may be lost with the power. A process that is killed leaves
// `path`.<number> behind, which nobody reads. Throws FileError.
void write_file(const std::filesystem::path& path, Bytes bytes);

// A checked view of the bytes of a file. `name` is what errors call it.
class ContainerReader {
 public:
  // Checks header, table and bounds; a section's checksum is checked when it is read. Throws
  // FileError.
  ContainerReader(Bytes file, std::string name);

  FileKind kind() const { return kind_; }
  const std::string& name() const { return name_; }
  // Of header and table, and thereby of everything.
  std::uint32_t checksum() const { return checksum_; }
  std::string identity() const { return file_identity(file_); }
  // In bytes, padding included.
  std::size_t size() const { return file_.size(); }
  // Throws FileError where the file is of another kind.
  void expect(FileKind kind) const;

  // A section, checked against its checksum. Throws FileError where it is missing or broken.
  Bytes read(std::string_view section) const;
  std::optional<Bytes> read_if_there(std::string_view section) const;
  // A section whose checksum nobody has checked; for what is mapped and too large to read.
  std::optional<Bytes> map_if_there(std::string_view section) const;
  // Names and sizes in bytes, in file order.
  std::vector<std::pair<std::string, std::size_t>> sections() const;
  // Checks every section. Throws FileError.
  void verify() const;
  // An error about this file.
  [[noreturn]] void fail(const std::string& what) const;

 private:
  struct Section {
    std::string name;
    std::size_t offset;
    std::size_t size;
    std::uint32_t crc;
  };
  const Section* find(std::string_view name) const;
  Bytes checked(const Section& section) const;

  Bytes file_;
  std::string name_;
  FileKind kind_;
  std::uint32_t checksum_ = 0;
  std::vector<Section> sections_;
};

// A file mapped read-only.
class MappedFile {
 public:
  // Throws FileError where the file cannot be read.
  explicit MappedFile(const std::filesystem::path& path);
  ~MappedFile();
  MappedFile(const MappedFile&) = delete;
  MappedFile& operator=(const MappedFile&) = delete;

  Bytes bytes() const { return {static_cast<const std::byte*>(data_), size_}; }
  // Whether this file still has that name.
  bool is_at(const std::filesystem::path& path) const;

 private:
  void* data_ = nullptr;
  std::size_t size_ = 0;
  dev_t device_ = 0;
  ino_t inode_ = 0;
};

// Reads plain values from a section front to back; running past the end throws FileError.
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
  std::vector<T> values(std::size_t n) {
    if (n > rest_.size() / sizeof(T)) too_short();
    std::vector<T> v(n);
    copy(v.data(), n);
    return v;
  }
  template <typename T>
  void copy(T* to, std::size_t n) {
    if (n > rest_.size() / sizeof(T)) too_short();
    take(to, n * sizeof(T));
  }
  // A u32 length and that many bytes of UTF-8.
  std::string text();
  bool empty() const { return rest_.empty(); }
  // Throws FileError where bytes are left.
  void finish() const;

 private:
  [[noreturn]] void too_short() const;
  void take(void* to, std::size_t n);

  const ContainerReader* file_;
  std::string section_;
  Bytes rest_;
};

// Hands n elements of `width` values each to a sink. `fill(i, to)` gives the values of element i.
template <typename T, typename Fill>
void put_values(const ContainerWriter::Sink& sink, std::size_t n, std::size_t width,
                const Fill& fill) {
  constexpr std::size_t kPiece = 1 << 16;  // bytes
  const std::size_t element = width * sizeof(T);
  const std::size_t some = std::min(n, std::max<std::size_t>(1, kPiece / element));
  std::vector<T> values(some * width);
  for (std::size_t first = 0; first < n; first += some) {
    const std::size_t end = std::min(n, first + some);
    for (std::size_t i = first; i < end; ++i) fill(i, &values[(i - first) * width]);
    sink(std::as_bytes(std::span(values)).first((end - first) * element));
  }
}

// Collects plain values for a section.
class SectionWriter {
 public:
  template <typename T>
  void value(const T& v) {
    values(&v, 1);
  }
  template <typename T>
  void values(const T* v, std::size_t n) {
    const auto* p = reinterpret_cast<const std::byte*>(v);
    bytes_.insert(bytes_.end(), p, p + n * sizeof(T));
  }
  // As SectionReader reads it.
  void text(const std::string& v) {
    value(static_cast<std::uint32_t>(v.size()));
    values(v.data(), v.size());
  }
  std::vector<std::byte> take() { return std::move(bytes_); }

 private:
  std::vector<std::byte> bytes_;
};

}  // namespace protomark
