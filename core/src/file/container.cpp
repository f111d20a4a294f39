#include "file/container.h"

#include <bit>

namespace protomark {
namespace {

static_assert(std::endian::native == std::endian::little && sizeof(size_t) == 8);

constexpr char kMagic[8] = {'P', 'R', 'O', 'T', 'O', 'M', 'R', 'K'};
constexpr uint32_t kVersion = 1;

constexpr uint64_t align(uint64_t n) {
  return (n + kSectionAlignment - 1) / kSectionAlignment * kSectionAlignment;
}

uint32_t head_checksum(ContainerHeader header, Bytes table) {
  header.crc = 0;
  return crc32(table, crc32(std::as_bytes(std::span(&header, 1))));
}

}  // namespace

const char* describe(FileKind kind) {
  constexpr const char* kKinds[] = {"an encoder", "a learning map",        "a sealed map",
                                    "a journal",  "a record of a journal", "a record of a journal"};
  return kKinds[static_cast<uint32_t>(kind) - 1];
}

bool has_magic(Bytes bytes) {
  const Bytes magic = std::as_bytes(std::span(kMagic));
  const size_t n = std::min(bytes.size(), magic.size());
  return std::ranges::equal(bytes.first(n), magic.first(n));
}

bool ContainerHead::has_right_checksum() const {
  return head_checksum(header, bytes.subspan(sizeof(header))) == header.crc;
}

size_t ContainerWriter::head_size() const {
  size_t sections = 0;
  for (const Group& group : groups_) sections += group.parts.size();
  return align(sizeof(ContainerHeader) + sections * sizeof(SectionEntry));
}

std::vector<std::byte> ContainerWriter::emit(const Put& put) const {
  constexpr std::array<std::byte, kSectionAlignment> zeros{};
  std::vector<SectionEntry> table;
  uint64_t offset = head_size();
  for (const Group& group : groups_) {
    const size_t first = table.size();
    for (const auto& [name, size] : group.parts) {
      SectionEntry entry{};
      std::memcpy(entry.padded_name, name.data(), std::min(sizeof(entry.padded_name), name.size()));
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
        throw std::logic_error(text("section '", name, "' has ", entry.size, " bytes, not ", size));
      }
      const uint64_t end = entry.offset + entry.size;
      offset = align(end);
      put(end, Bytes(zeros).first(offset - end));
    }
  }
  const Bytes table_bytes = std::as_bytes(std::span(table));
  ContainerHeader header{};
  std::memcpy(header.magic, kMagic, sizeof(kMagic));
  header.version = kVersion;
  header.kind = static_cast<uint32_t>(kind_);
  header.file_size = offset;
  header.sections = static_cast<uint32_t>(table.size());
  header.crc = head_checksum(header, table_bytes);

  std::vector<std::byte> head(head_size());
  std::memcpy(head.data(), &header, sizeof(header));
  std::copy(table_bytes.begin(), table_bytes.end(), head.begin() + sizeof(header));
  return head;
}

ContainerReader::ContainerReader(Bytes file, std::string name)
    : file_(file), name_(std::move(name)) {
  ContainerHeader header;
  require(file_.size() >= sizeof(header) && has_magic(file_), "not a Protomark file");
  std::memcpy(&header, file_.data(), sizeof(header));
  require(header.version == kVersion, "format version ", header.version,
          ", this Protomark reads version ", kVersion);
  const bool more = file_.size() > header.file_size;
  require(!more || header.kind != static_cast<uint32_t>(FileKind::journal),
          "it is the journal of a map: name the map file beside it");
  require(header.file_size == file_.size(), "it should have ", header.file_size, " bytes and has ",
          file_.size(), more ? "" : ": it is cut off");
  const auto head = ContainerHead::parse(file_);
  require(head.has_value(), "its header is broken");
  require(head->has_right_checksum(), "its header does not match its checksum");
  require(header.kind >= 1 && header.kind <= static_cast<uint32_t>(FileKind::fold),
          "it is of a kind that this Protomark does not know");
  head_ = *head;
  kind_ = static_cast<FileKind>(header.kind);

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

Bytes ContainerReader::read(std::string_view section) const {
  const Bytes bytes = map(section);
  require(crc32(bytes) == find(section)->crc, "its section '", section,
          "' does not match its checksum");
  return bytes;
}

}  // namespace protomark
