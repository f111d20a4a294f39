#include "file/container.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cerrno>
#include <cstring>
#include <stdexcept>

#include "base/crc32.h"
#include "base/sha256.h"
#include "base/utf8.h"
#include "protomark/error.h"

namespace protomark {
namespace {

static_assert(std::endian::native == std::endian::little,
              "the file format is little-endian; a big-endian machine needs byte swaps here");
static_assert(sizeof(std::size_t) == 8, "sizes of maps and their products need 64 bits");

constexpr char kMagic[8] = {'P', 'R', 'O', 'T', 'O', 'M', 'R', 'K'};
constexpr std::uint32_t kNewestVersion = 4;
constexpr std::size_t kAlignment = 64;
constexpr std::uint32_t kMaxSections = 64;
constexpr auto kLastKind = static_cast<std::uint32_t>(FileKind::fold);

struct Header {
  char magic[8];
  std::uint32_t version;
  std::uint32_t kind;
  std::uint64_t file_size;
  std::uint32_t sections;
  std::uint32_t crc;
  std::uint8_t reserved[32];
};
static_assert(sizeof(Header) == 64);

struct Entry {
  char name[8];
  std::uint64_t offset;
  std::uint64_t size;
  std::uint32_t crc;
  std::uint32_t reserved;
};
static_assert(sizeof(Entry) == 32);

template <typename T>
Bytes as_bytes(const T& v) {
  return std::as_bytes(std::span(&v, 1));
}

constexpr std::uint64_t align(std::uint64_t n) {
  return (n + kAlignment - 1) / kAlignment * kAlignment;
}

}  // namespace

const char* describe(FileKind kind) {
  switch (kind) {
    case FileKind::encoder:
      return "an encoder";
    case FileKind::open_map:
      return "an open map";
    case FileKind::sealed_map:
      return "a sealed map";
    case FileKind::journal:
      return "a journal";
    case FileKind::commit:
    case FileKind::fold:
      return "a record of a journal";
  }
  return "something unknown";
}

void ContainerWriter::add(std::string name, Bytes bytes) {
  add(std::move(name), bytes.size(), [bytes](const Sink& sink) { sink(bytes); });
}

void ContainerWriter::add(std::string name, std::vector<std::byte> bytes) {
  const std::size_t size = bytes.size();
  add(std::move(name), size, [owned = std::move(bytes)](const Sink& sink) { sink(owned); });
}

void ContainerWriter::add(std::string name, std::size_t size, Produce produce) {
  add_together({{std::move(name), size}},
               [produce = std::move(produce)](std::span<const Sink> sinks) { produce(sinks[0]); });
}

void ContainerWriter::add_together(std::vector<Part> parts, ProduceAll produce) {
  groups_.push_back({std::move(parts), std::move(produce)});
}

std::size_t ContainerWriter::head_size() const {
  std::size_t sections = 0;
  for (const Group& group : groups_) sections += group.parts.size();
  return align(sizeof(Header) + sections * sizeof(Entry));
}

std::vector<std::byte> ContainerWriter::emit(const Place& place) const {
  constexpr std::array<std::byte, kAlignment> zeros{};
  std::vector<Entry> table;
  std::uint64_t offset = head_size();
  for (const Group& group : groups_) {
    const std::size_t first = table.size();
    for (const auto& [name, size] : group.parts) {
      Entry entry{};
      std::memcpy(entry.name, name.data(), std::min(sizeof(entry.name), name.size()));
      entry.offset = offset;
      table.push_back(entry);
      if (size != kUnknownSize) offset = align(offset + size);
    }
    std::vector<Sink> sinks;
    for (std::size_t i = first; i < table.size(); ++i) {
      sinks.emplace_back([&place, &entry = table[i]](Bytes bytes) {
        entry.crc = crc32(bytes, entry.crc);
        place(entry.offset + entry.size, bytes);
        entry.size += bytes.size();
      });
    }
    group.produce(sinks);
    for (std::size_t i = 0; i < group.parts.size(); ++i) {
      const auto& [name, size] = group.parts[i];
      const Entry& entry = table[first + i];
      if (size != kUnknownSize && entry.size != size) {
        throw std::logic_error("section '" + name + "' has " + std::to_string(entry.size) +
                               " bytes, not " + std::to_string(size));
      }
      const std::uint64_t end = entry.offset + entry.size;
      offset = align(end);
      place(end, Bytes(zeros).first(offset - end));
    }
  }
  Header header{};
  std::memcpy(header.magic, kMagic, sizeof(kMagic));
  header.version = version_;
  header.kind = static_cast<std::uint32_t>(kind_);
  header.file_size = offset;
  header.sections = static_cast<std::uint32_t>(table.size());
  header.crc = crc32(std::as_bytes(std::span(table)), crc32(as_bytes(header)));

  std::vector<std::byte> head(head_size());
  std::memcpy(head.data(), &header, sizeof(header));
  if (!table.empty()) {
    std::memcpy(head.data() + sizeof(header), table.data(), table.size() * sizeof(Entry));
  }
  return head;
}

std::vector<std::byte> ContainerWriter::serialize() const {
  std::vector<std::byte> result(head_size());
  const auto head = emit([&](std::size_t offset, Bytes bytes) {
    result.resize(std::max(result.size(), offset + bytes.size()));
    std::copy(bytes.begin(), bytes.end(), result.begin() + static_cast<std::ptrdiff_t>(offset));
  });
  std::copy(head.begin(), head.end(), result.begin());
  return result;
}

void ContainerWriter::write(const std::filesystem::path& path,
                            const std::function<void(const std::string&)>& before) const {
  TemporaryFile file(path);
  const auto head = emit([&](std::size_t offset, Bytes bytes) { file.write(offset, bytes); });
  file.write(0, head);
  file.sync();
  if (before) before(file_identity(head));
  file.replace_target();
}

namespace {

// Header and section table, where they are there.
std::optional<Bytes> head_of(Bytes file) {
  Header header;
  if (file.size() < sizeof(header)) return std::nullopt;
  std::memcpy(&header, file.data(), sizeof(header));
  const std::size_t size = sizeof(header) + std::size_t{header.sections} * sizeof(Entry);
  if (header.sections > kMaxSections || size > file.size()) return std::nullopt;
  return file.first(size);
}

}  // namespace

std::string file_identity(Bytes head) {
  const auto bytes = head_of(head);
  return bytes ? sha256(*bytes) : "";
}

bool has_container_head(Bytes head) {
  const auto bytes = head_of(head);
  if (!bytes) return false;
  Header header;
  std::memcpy(&header, bytes->data(), sizeof(header));
  const std::uint32_t crc = std::exchange(header.crc, 0);
  return crc32(bytes->subspan(sizeof(header)), crc32(as_bytes(header))) == crc;
}

void write_file(const std::filesystem::path& path, Bytes bytes) {
  TemporaryFile file(path);
  file.write(0, bytes);
  file.sync();
  file.replace_target();
}

ContainerReader::ContainerReader(Bytes file, std::string name)
    : file_(file), name_(std::move(name)), kind_(FileKind::encoder) {
  if (file_.size() < sizeof(Header) || std::memcmp(file_.data(), kMagic, sizeof(kMagic)) != 0) {
    fail("not a Protomark file");
  }
  Header header;
  std::memcpy(&header, file_.data(), sizeof(header));
  if (header.version < 1 || header.version > kNewestVersion) {
    fail("format version " + std::to_string(header.version) +
         ", this Protomark reads versions 1 to " + std::to_string(kNewestVersion));
  }
  if (header.sections > kMaxSections) fail("its header is broken");
  const std::size_t table_size = header.sections * sizeof(Entry);
  if (header.file_size != file_.size()) {
    fail("it should have " + std::to_string(header.file_size) + " bytes and has " +
         std::to_string(file_.size()) + (file_.size() < header.file_size ? ": it is cut off" : ""));
  }
  if (file_.size() < sizeof(Header) + table_size) fail("its header is broken");
  const Bytes table = file_.subspan(sizeof(Header), table_size);
  const std::uint32_t crc = std::exchange(header.crc, 0);
  if (crc32(table, crc32(as_bytes(header))) != crc) fail("its header does not match its checksum");
  if (header.kind < 1 || header.kind > kLastKind)
    fail("it is of a kind that this Protomark does not know");
  kind_ = static_cast<FileKind>(header.kind);
  checksum_ = crc;

  std::uint64_t end = sizeof(Header) + table_size;
  for (std::uint32_t i = 0; i < header.sections; ++i) {
    Entry entry;
    std::memcpy(&entry, table.data() + i * sizeof(Entry), sizeof(Entry));
    if (entry.offset % kAlignment != 0 || entry.offset < end || entry.offset > file_.size() ||
        entry.size > file_.size() - entry.offset) {
      fail("its section table is broken");
    }
    end = entry.offset + entry.size;
    const std::string section(entry.name, ::strnlen(entry.name, sizeof(entry.name)));
    // Names go into errors and lists, where others could say anything to a terminal.
    if (!std::ranges::all_of(section, [](char c) { return c >= ' ' && c <= '~'; })) {
      fail("its section table is broken: a name is not printable ASCII");
    }
    if (find(section) != nullptr) fail("it has two sections '" + section + "'");
    sections_.push_back({section, entry.offset, entry.size, entry.crc});
  }
}

void ContainerReader::expect(FileKind kind) const {
  if (kind_ != kind) fail(std::string("it holds ") + describe(kind_) + ", not " + describe(kind));
}

const ContainerReader::Section* ContainerReader::find(std::string_view name) const {
  const auto found = std::find_if(sections_.begin(), sections_.end(),
                                  [&](const Section& s) { return s.name == name; });
  return found == sections_.end() ? nullptr : &*found;
}

Bytes ContainerReader::checked(const Section& section) const {
  const Bytes bytes = file_.subspan(section.offset, section.size);
  if (crc32(bytes) != section.crc) {
    fail("its section '" + section.name + "' does not match its checksum");
  }
  return bytes;
}

Bytes ContainerReader::read(std::string_view section) const {
  if (const auto bytes = read_if_there(section)) return *bytes;
  fail("it lacks the section '" + std::string(section) + "'");
}

std::optional<Bytes> ContainerReader::read_if_there(std::string_view section) const {
  const Section* found = find(section);
  if (found == nullptr) return std::nullopt;
  return checked(*found);
}

std::optional<Bytes> ContainerReader::map_if_there(std::string_view section) const {
  const Section* found = find(section);
  if (found == nullptr) return std::nullopt;
  return file_.subspan(found->offset, found->size);
}

std::vector<std::pair<std::string, std::size_t>> ContainerReader::sections() const {
  std::vector<std::pair<std::string, std::size_t>> result;
  for (const Section& section : sections_) result.emplace_back(section.name, section.size);
  return result;
}

void ContainerReader::verify() const {
  for (const Section& section : sections_) checked(section);
}

void ContainerReader::fail(const std::string& what) const { throw FileError(name_ + ": " + what); }

MappedFile::MappedFile(const std::filesystem::path& path) {
  const auto fail = [&]() -> void {
    const std::string why = system_error();
    throw FileError(path.string() + ": cannot be read: " + why);
  };
  const int descriptor = ::open(path.c_str(), O_RDONLY | O_NONBLOCK | O_CLOEXEC);
  if (descriptor < 0) fail();
  struct stat status;
  if (::fstat(descriptor, &status) != 0 || !S_ISREG(status.st_mode)) {
    ::close(descriptor);
    throw FileError(path.string() + ": not a file");
  }
  size_ = static_cast<std::size_t>(status.st_size);
  device_ = status.st_dev;
  inode_ = status.st_ino;
  if (size_ > 0) {
    data_ = ::mmap(nullptr, size_, PROT_READ, MAP_SHARED, descriptor, 0);
    if (data_ == MAP_FAILED) {
      data_ = nullptr;
      ::close(descriptor);
      fail();
    }
  }
  ::close(descriptor);
}

MappedFile::~MappedFile() {
  if (data_ != nullptr) ::munmap(data_, size_);
}

bool MappedFile::is_at(const std::filesystem::path& path) const {
  struct stat status;
  return ::stat(path.c_str(), &status) == 0 && status.st_dev == device_ && status.st_ino == inode_;
}

std::string SectionReader::text() {
  const auto n = value<std::uint32_t>();
  if (n > rest_.size()) too_short();
  std::string result(n, '\0');
  take(result.data(), n);
  if (!is_utf8(result)) file_->fail("its section '" + section_ + "' has a text that is no UTF-8");
  return result;
}

void SectionReader::finish() const {
  if (!rest_.empty()) file_->fail("its section '" + section_ + "' is longer than it should be");
}

void SectionReader::too_short() const {
  file_->fail("its section '" + section_ + "' is shorter than it should be");
}

void SectionReader::take(void* to, std::size_t n) {
  if (n > 0) std::memcpy(to, rest_.data(), n);
  rest_ = rest_.subspan(n);
}

}  // namespace protomark
