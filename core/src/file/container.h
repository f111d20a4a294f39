// The file format of models, maps and journals: a header, a table of sections, the sections, all
// little-endian. docs/format.md says what each kind of file holds.
#pragma once

#include <algorithm>
#include <bit>
#include <cstring>
#include <map>

#include "base/packed_numbers.h"
#include "file/disk.h"

namespace protomark {

static_assert(std::endian::native == std::endian::little && sizeof(size_t) == 8);

enum class FileKind : uint32_t {
  encoder = 1,
  learning_map = 2,
  sealed_map = 3,
  // A journal is a container of the first of these, followed by any number of the others.
  journal = 4,
  commit = 5,
  fold = 6
};

// Returns a noun, as in "a learning map".
inline const char* describe(FileKind kind) {
  constexpr const char* kKinds[] = {"an encoder", "a learning map",        "a sealed map",
                                    "a journal",  "a record of a journal", "a record of a journal"};
  return kKinds[static_cast<uint32_t>(kind) - 1];
}

struct ContainerHeader {
  char magic[8];  // "PROTOMRK"
  uint32_t version;
  uint32_t kind;
  uint64_t file_size;
  uint32_t sections;
  uint32_t crc;  // CRC-32 of the header, with zero here, and of the section table
  uint8_t reserved[32];
};
static_assert(sizeof(ContainerHeader) == 64);

struct SectionEntry {
  char padded_name[8];  // padded with zeros
  uint64_t offset;      // a multiple of kSectionAlignment
  uint64_t size;
  uint32_t crc;
  uint32_t reserved;

  std::string_view name() const {
    return {padded_name, ::strnlen(padded_name, sizeof(padded_name))};
  }
};
static_assert(sizeof(SectionEntry) == 32);

inline constexpr size_t kSectionAlignment = 64;
inline constexpr uint32_t kMaxSections = 64;
inline constexpr size_t kMaxHead = sizeof(ContainerHeader) + kMaxSections * sizeof(SectionEntry);

constexpr uint64_t align(uint64_t n) {
  return (n + kSectionAlignment - 1) / kSectionAlignment * kSectionAlignment;
}

inline constexpr char kMagic[8] = {'P', 'R', 'O', 'T', 'O', 'M', 'R', 'K'};
inline constexpr uint32_t kVersion = 1;

// Whether bytes begin as every container does, as far as there are any.
inline bool has_magic(Bytes bytes) {
  const Bytes magic = std::as_bytes(std::span(kMagic));
  const size_t n = std::min(bytes.size(), magic.size());
  return std::ranges::equal(bytes.first(n), magic.first(n));
}

// The header and section table that bytes begin with.
struct ContainerHead {
  // Returns nullopt unless both are complete; their checksum may be wrong.
  static std::optional<ContainerHead> parse(Bytes bytes) {
    ContainerHead head;
    if (bytes.size() < sizeof(head.header) || !has_magic(bytes)) return std::nullopt;
    std::memcpy(&head.header, bytes.data(), sizeof(head.header));
    const size_t size = sizeof(head.header) + size_t{head.header.sections} * sizeof(SectionEntry);
    if (head.header.sections > kMaxSections || size > bytes.size()) return std::nullopt;
    head.bytes = bytes.first(size);
    return head;
  }

  ContainerHeader header;
  Bytes bytes;  // header and table

  // Returns the checksum that the header should have.
  uint32_t checksum() const {
    ContainerHeader without = header;
    without.crc = 0;
    return crc32(bytes.subspan(sizeof(header)), crc32(std::as_bytes(std::span(&without, 1))));
  }
  bool has_right_checksum() const { return checksum() == header.crc; }
  // Returns the SHA-256 of header and table, which have the checksum of everything in the file.
  std::string identity() const { return sha256(bytes); }
};

// Collects the sections of a file, in memory or to be produced while the file is written.
class ContainerWriter {
 public:
  // The writers of sections by name; that of a section which is left out takes nothing.
  using Writers = std::map<std::string_view, ValueWriter>;
  struct Part {
    std::string name;
    size_t size;  // in bytes
  };
  static constexpr size_t kUnknownSize = SIZE_MAX;
  using Produce = std::function<void(Writers&)>;

  explicit ContainerWriter(FileKind kind) : kind_(kind) {}

  void add(std::string name, Bytes bytes) {
    add({{std::move(name), bytes.size()}}, [owned = std::vector(bytes.begin(), bytes.end())](
                                               Writers& to) { to.begin()->second.add_all(owned); });
  }
  // Sections that are produced side by side, each time that the file is written: `produce` gets
  // their writers. Only the size of the last one may be unknown.
  void add(std::vector<Part> parts, Produce produce) {
    groups_.push_back({std::move(parts), std::move(produce)});
  }

  std::vector<std::byte> serialize() const {
    std::vector<std::byte> result(head_size());
    const auto head = emit([&](size_t offset, Bytes bytes) {
      result.resize(std::max(result.size(), offset + bytes.size()));
      std::copy(bytes.begin(), bytes.end(), result.begin() + static_cast<std::ptrdiff_t>(offset));
    });
    std::copy(head.begin(), head.end(), result.begin());
    return result;
  }
  // Writes the file beside `path`, syncs it, renames it to `path` and syncs the folder. If that or
  // a producer fails, the old file stays; only if the folder cannot be synced is the new one there,
  // and a power cut may undo that. A process that is killed leaves `path`.<number> behind, which
  // nobody reads. Calls `before` with the identity of the synced file. Throws FileError.
  void write(const std::filesystem::path& path,
             const std::function<void(const std::string&)>& before = {}) const {
    TemporaryFile file(path);
    const auto head = emit([&](size_t offset, Bytes bytes) { file.write(offset, bytes); });
    file.write(0, head);
    file.sync();
    if (before) before(ContainerHead::parse(head)->identity());
    file.replace_target();
  }

 private:
  struct Group {
    std::vector<Part> parts;
    Produce produce;
  };
  using Put = std::function<void(size_t offset, Bytes)>;
  size_t head_size() const {
    size_t sections = 0;
    for (const Group& group : groups_) sections += group.parts.size();
    return align(sizeof(ContainerHeader) + sections * sizeof(SectionEntry));
  }
  // Puts the sections to their offsets and returns header and table, which have their checksums.
  std::vector<std::byte> emit(const Put& put) const {
    constexpr std::array<std::byte, kSectionAlignment> zeros{};
    std::vector<SectionEntry> table;
    uint64_t offset = head_size();
    for (const Group& group : groups_) {
      const size_t first = table.size();
      for (const auto& [name, size] : group.parts) {
        SectionEntry entry{};
        std::memcpy(entry.padded_name, name.data(),
                    std::min(sizeof(entry.padded_name), name.size()));
        entry.offset = offset;
        table.push_back(entry);
        if (size != kUnknownSize) offset = align(offset + size);
      }
      Writers writers;
      for (size_t i = first; i < table.size(); ++i) {
        writers.emplace(group.parts[i - first].name, [&put, &entry = table[i]](Bytes bytes) {
          entry.crc = crc32(bytes, entry.crc);
          put(entry.offset + entry.size, bytes);
          entry.size += bytes.size();
        });
      }
      group.produce(writers);
      for (auto& [name, writer] : writers) writer.finish();
      for (size_t i = 0; i < group.parts.size(); ++i) {
        const auto& [name, size] = group.parts[i];
        const SectionEntry& entry = table[first + i];
        if (size != kUnknownSize && entry.size != size) {
          throw std::logic_error(
              text("section '", name, "' has ", entry.size, " bytes, not ", size));
        }
        const uint64_t end = entry.offset + entry.size;
        offset = align(end);
        put(end, Bytes(zeros).first(offset - end));
      }
    }
    ContainerHeader header{};
    std::memcpy(header.magic, kMagic, sizeof(kMagic));
    header.version = kVersion;
    header.kind = static_cast<uint32_t>(kind_);
    header.file_size = offset;
    header.sections = static_cast<uint32_t>(table.size());
    std::vector<std::byte> head(head_size());
    store(head.data(), header);
    std::ranges::copy(std::as_bytes(std::span(table)), head.begin() + sizeof(header));
    const size_t table_end = sizeof(header) + table.size() * sizeof(SectionEntry);
    header.crc = ContainerHead{header, Bytes(head).first(table_end)}.checksum();
    store(head.data(), header);
    return head;
  }

  FileKind kind_;
  std::vector<Group> groups_;
};

// A checked view of the bytes of a file, which errors call `name`. All functions throw FileError.
class ContainerReader {
 public:
  // Checks header, table and bounds.
  ContainerReader(Bytes file, std::string name) : file_(file), name_(std::move(name)) {
    ContainerHeader header;
    require(file_.size() >= sizeof(header) && has_magic(file_), "not a Protomark file");
    std::memcpy(&header, file_.data(), sizeof(header));
    require(header.version == kVersion, "format version ", header.version,
            ", this Protomark reads version ", kVersion);
    const bool more = file_.size() > header.file_size;
    require(!more || header.kind != static_cast<uint32_t>(FileKind::journal),
            "it is the journal of a map: name the map file beside it");
    require(header.file_size == file_.size(), "it should have ", header.file_size,
            " bytes and has ", file_.size(), more ? "" : ": it is cut off");
    const auto head = ContainerHead::parse(file_);
    require(head.has_value(), "its header is broken");
    require(head->has_right_checksum(), "its header does not match its checksum");
    require(header.kind >= 1 && header.kind <= static_cast<uint32_t>(FileKind::fold),
            "it is of a kind that this Protomark does not know");
    head_ = *head;

    uint64_t end = head_.bytes.size();
    for (size_t at = sizeof(header); at < head_.bytes.size(); at += sizeof(SectionEntry)) {
      SectionEntry entry;
      std::memcpy(&entry, head_.bytes.data() + at, sizeof(entry));
      require(entry.offset % kSectionAlignment == 0 && entry.offset >= end &&
                  entry.offset <= file_.size() && entry.size <= file_.size() - entry.offset,
              "its section table is broken");
      end = entry.offset + entry.size;
      // Errors print names, which must not send commands to a terminal.
      require(std::ranges::all_of(entry.name(), [](char c) { return c >= ' ' && c <= '~'; }),
              "its section table is broken: a name is not printable ASCII");
      require(!has(entry.name()), "it has two sections '", entry.name(), "'");
      sections_.push_back(entry);
    }
  }

  FileKind kind() const { return static_cast<FileKind>(head_.header.kind); }
  const std::string& name() const { return name_; }
  // Of header and table, and thereby of everything.
  uint32_t checksum() const { return head_.header.crc; }
  std::string identity() const { return head_.identity(); }
  size_t size() const { return file_.size(); }
  void expect(FileKind kind) const {
    require(this->kind() == kind, "it holds ", describe(this->kind()), ", not ", describe(kind));
  }

  bool has(std::string_view section) const { return find(section) != nullptr; }
  // Returns a section after checking its checksum.
  Bytes read(std::string_view section) const {
    const Bytes bytes = map(section);
    require(crc32(bytes) == find(section)->crc, "its section '", section,
            "' does not match its checksum");
    return bytes;
  }
  // Returns a section without reading it, for those that are large and mapped.
  Bytes map(std::string_view section) const {
    const SectionEntry* found = find(section);
    require(found != nullptr, "it lacks the section '", section, "'");
    return file_.subspan(found->offset, found->size);
  }
  // The same as n values of a type, for which the file's bytes must be aligned.
  template <typename T>
  std::span<const T> read(std::string_view section, size_t n) const {
    return as<T>(section, read(section), n);
  }
  template <typename T>
  std::span<const T> map(std::string_view section, size_t n) const {
    return as<T>(section, map(section), n);
  }
  std::vector<std::pair<std::string, size_t>> sections() const {
    std::vector<std::pair<std::string, size_t>> result;
    for (const SectionEntry& entry : sections_) result.emplace_back(entry.name(), entry.size);
    return result;
  }
  void verify() const {
    for (const SectionEntry& entry : sections_) read(entry.name());
  }
  // Throw FileError about this file, two of them unless a condition holds.
  [[noreturn]] void fail(const auto&... what) const { throw FileError(text(name_, ": ", what...)); }
  void require(bool condition, const auto&... what) const {
    if (!condition) fail(what...);
  }
  void require_size(bool condition, std::string_view section) const {
    require(condition, "its section '", section, "' has the wrong size");
  }

 private:
  template <typename T>
  std::span<const T> as(std::string_view section, Bytes bytes, size_t n) const {
    require_size(bytes.size() % sizeof(T) == 0 && bytes.size() / sizeof(T) == n, section);
    return {reinterpret_cast<const T*>(bytes.data()), n};
  }
  const SectionEntry* find(std::string_view name) const {
    const auto found = std::ranges::find(sections_, name, &SectionEntry::name);
    return found == sections_.end() ? nullptr : &*found;
  }

  Bytes file_;
  std::string name_;
  ContainerHead head_{};
  std::vector<SectionEntry> sections_;
};

}  // namespace protomark
