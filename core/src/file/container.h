// The file that models, maps and journals share: a header, a table of sections, the sections. All
// is little-endian; docs/format.md says what each kind of file holds.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <filesystem>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "base/text.h"
#include "file/disk.h"
#include "protomark/types.h"

namespace protomark {

enum class FileKind : std::uint32_t {
  encoder = 1,
  learning_map = 2,
  sealed_map = 3,
  // A journal is a container of the first kind, followed by any number of the others.
  journal = 4,
  commit = 5,
  fold = 6
};

// As in "a learning map".
const char* describe(FileKind kind);

struct ContainerHeader {
  char magic[8];  // "PROTOMRK"
  std::uint32_t version;
  std::uint32_t kind;
  std::uint64_t file_size;
  std::uint32_t sections;
  std::uint32_t crc;  // CRC-32 of the header, with zero here, and the section table
  std::uint8_t reserved[32];
};
static_assert(sizeof(ContainerHeader) == 64);

struct SectionEntry {
  char padded_name[8];   // ends where it is full, or with zeros
  std::uint64_t offset;  // a multiple of kSectionAlignment
  std::uint64_t size;
  std::uint32_t crc;
  std::uint32_t reserved;

  std::string_view name() const {
    return {padded_name, ::strnlen(padded_name, sizeof(padded_name))};
  }
};
static_assert(sizeof(SectionEntry) == 32);

inline constexpr std::size_t kSectionAlignment = 64;
inline constexpr std::uint32_t kMaxSections = 64;
inline constexpr std::size_t kMaxHead =
    sizeof(ContainerHeader) + kMaxSections * sizeof(SectionEntry);

// Whether bytes begin as every container does, or would if there were more of them.
bool has_magic(Bytes bytes);

// The header and section table that bytes begin with.
struct ContainerHead {
  // nullopt unless they are there as a whole; their checksum may be wrong.
  static std::optional<ContainerHead> parse(Bytes bytes);

  ContainerHeader header;
  Bytes bytes;  // header and table

  bool has_right_checksum() const;
  // The SHA-256 of header and table, which have the size and checksum of everything in the file.
  std::string identity() const;
};

// Sections to be written as one file. They are in memory, or come into being piece by piece while
// the file is written.
class ContainerWriter {
 public:
  using Sink = std::function<void(Bytes)>;
  // Hands the bytes of a section to the sink in order.
  using Produce = std::function<void(const Sink&)>;

  explicit ContainerWriter(FileKind kind) : kind_(kind) {}

  // `bytes` must stay alive until the file is written.
  void add(std::string name, Bytes bytes);
  void add(std::string name, std::vector<std::byte> bytes);
  // `produce` is called each time that the file is written, and gives `size` bytes.
  void add(std::string name, std::size_t size, Produce produce);

  struct Part {
    std::string name;
    std::size_t size;  // in bytes
  };
  static constexpr std::size_t kUnknownSize = SIZE_MAX;
  using ProduceAll = std::function<void(std::span<const Sink>)>;
  // Sections that come into being side by side: `produce` has a sink for each, and hands bytes to
  // any of them in turn. Only the size of the last one may be unknown.
  void add_together(std::vector<Part> parts, ProduceAll produce);

  std::vector<std::byte> serialize() const;
  // Writes the file, whole or not at all, without copying sections: beside `path`, then synced,
  // renamed and its folder synced. If that or a producer fails, the old file is still there; only
  // if the folder cannot be synced is the new one there, and may be lost with the power. A process
  // that is killed leaves `path`.<number> behind, which nobody reads. `before` is called with the
  // identity of the new file once that is synced, before it takes the place of the old one. Throws
  // FileError.
  void write(const std::filesystem::path& path,
             const std::function<void(const std::string&)>& before = {}) const;

 private:
  struct Group {
    std::vector<Part> parts;
    ProduceAll produce;
  };
  using Put = std::function<void(std::size_t offset, Bytes)>;
  std::size_t head_size() const;
  // Puts the sections to their offsets and returns the head, which has their checksums.
  std::vector<std::byte> emit(const Put& put) const;

  FileKind kind_;
  std::vector<Group> groups_;
};

// A checked view of the bytes of a file. Errors call the file `name`. All functions throw
// FileError.
class ContainerReader {
 public:
  // Checks header, table and bounds; a section's checksum is checked when the section is read.
  ContainerReader(Bytes file, std::string name);

  FileKind kind() const { return kind_; }
  const std::string& name() const { return name_; }
  // The checksum and identity of the head, and thereby of everything.
  std::uint32_t checksum() const { return head_.header.crc; }
  std::string identity() const { return head_.identity(); }
  // In bytes, padding included.
  std::size_t size() const { return file_.size(); }
  // Throws if the file is of another kind.
  void expect(FileKind kind) const;

  bool has(std::string_view section) const { return find(section) != nullptr; }
  // A section that matches its checksum.
  Bytes read(std::string_view section) const;
  // A section whose checksum was not looked at, for what is mapped and too large to read.
  Bytes map(std::string_view section) const;
  // The same as n values of a type, which the file's bytes must be aligned for.
  template <typename T>
  std::span<const T> read(std::string_view section, std::size_t n) const {
    return as<T>(section, read(section), n);
  }
  template <typename T>
  std::span<const T> map(std::string_view section, std::size_t n) const {
    return as<T>(section, map(section), n);
  }
  // Names and sizes in bytes, in file order.
  std::vector<std::pair<std::string, std::size_t>> sections() const;
  // Checks every section.
  void verify() const;
  // Throw FileError about this file.
  template <typename... Parts>
  [[noreturn]] void fail(const Parts&... what) const {
    throw FileError(text(name_, ": ", what...));
  }
  [[noreturn]] void fail_size(std::string_view section) const {
    fail("its section '", section, "' has the wrong size");
  }

 private:
  template <typename T>
  std::span<const T> as(std::string_view section, Bytes bytes, std::size_t n) const {
    if (bytes.size() % sizeof(T) != 0 || bytes.size() / sizeof(T) != n) fail_size(section);
    return {reinterpret_cast<const T*>(bytes.data()), n};
  }
  const SectionEntry* find(std::string_view name) const;
  const SectionEntry& get(std::string_view name) const;
  Bytes checked(const SectionEntry& section) const;

  Bytes file_;
  std::string name_;
  FileKind kind_ = FileKind::encoder;
  ContainerHead head_{};
  std::vector<SectionEntry> sections_;
};

}  // namespace protomark
