// Mutates the content of a file (docs/format.md) and usually corrects its checksums, so that the
// fuzzer gets past them.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <random>
#include <vector>

#include "base/bytes.h"
#include "base/packed_numbers.h"
#include "file/container.h"
#include "file/sections.h"
#include "protomark/protomark.h"

// Of libFuzzer.
extern "C" std::size_t LLVMFuzzerMutate(std::uint8_t* data, std::size_t size, std::size_t max_size);

namespace protomark::fuzz {
namespace {

using Random = std::minstd_rand;
using Content = std::vector<std::byte>;

struct File {
  FileKind kind;
  std::vector<std::pair<std::string, Content>> sections;

  // Throws FileError where these are not the bytes of a file with a good header.
  explicit File(Bytes bytes) {
    const ContainerReader reader(bytes, "input");
    kind = reader.kind();
    for (const auto& [name, size] : reader.sections()) {
      const Bytes content = reader.map(name);
      sections.emplace_back(name, Content(content.begin(), content.end()));
    }
  }

  Content serialize() const {
    ContainerWriter writer(kind);
    for (const auto& [name, content] : sections) writer.add(name, Bytes(content));
    return writer.serialize();
  }
};

// Mutates bytes as libFuzzer does without knowing a format.
void mutate(Content& bytes, std::size_t most) {
  const std::size_t size = bytes.size();
  bytes.resize(std::max(size, std::min(2 * size + 16, most)));
  bytes.resize(LLVMFuzzerMutate(reinterpret_cast<std::uint8_t*>(bytes.data()), size, bytes.size()));
}

// Mutates header and table, and corrects their checksum.
Content mutate_table(Bytes file) {
  Content bytes(file.begin(), file.end());
  std::uint32_t sections;
  std::memcpy(&sections, &bytes[24], sizeof(sections));
  const std::size_t size = 64 + 32 * std::size_t{sections};
  Content head(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(size));
  LLVMFuzzerMutate(reinterpret_cast<std::uint8_t*>(head.data()), size, size);
  std::memset(&head[28], 0, 4);
  const std::uint32_t crc = crc32(head);
  std::memcpy(&head[28], &crc, sizeof(crc));
  std::copy(head.begin(), head.end(), bytes.begin());
  return bytes;
}

// Corrects the checksums of the owners of rows.
void repair_owners(File& file) {
  const auto find = [&](const char* name) {
    const auto found =
        std::ranges::find(file.sections, name, [](const auto& s) { return s.first; });
    return found == file.sections.end() ? nullptr : &found->second;
  };
  const Content* owners = find(section::kOwners);
  Content* checksums = find(section::kOwnerChecksums);
  if (owners == nullptr || checksums == nullptr) return;
  constexpr std::size_t kBlock = CheckedNumbers::kBlock * sizeof(std::uint64_t);
  std::vector<std::uint32_t> right;
  for (Bytes rest = *owners; !rest.empty(); rest = rest.subspan(std::min(kBlock, rest.size()))) {
    right.push_back(crc32(rest.first(std::min(kBlock, rest.size()))));
  }
  const Bytes repaired = std::as_bytes(std::span(right));
  checksums->assign(repaired.begin(), repaired.end());
}

Content mutate_file(Bytes bytes, Random& random, std::size_t most) {
  const auto one_in = [&](unsigned n) { return random() % n == 0; };
  File file(bytes);
  auto& sections = file.sections;
  if (one_in(16)) return mutate_table(bytes);
  if (one_in(32)) file.kind = static_cast<FileKind>(1 + random() % 6);
  if (sections.empty()) return file.serialize();
  auto& [name, content] = sections[random() % sections.size()];
  if (one_in(16)) {
    std::swap(content, sections[random() % sections.size()].second);
  } else if (one_in(16)) {
    content.clear();
  } else if (one_in(16)) {
    sections.erase(sections.begin() + static_cast<std::ptrdiff_t>(random() % sections.size()));
  } else if (name == "encoder" && !one_in(8)) {
    try {
      content = mutate_file(content, random, most);
    } catch (const FileError&) {
      mutate(content, most);
    }
  } else {
    mutate(content, most);
  }
  if (!one_in(8)) repair_owners(file);
  return file.serialize();
}

// The containers of a journal, and the bytes after the last whole one.
std::vector<Content> split(Bytes bytes) {
  std::vector<Content> result;
  while (!bytes.empty()) {
    const auto head = ContainerHead::parse(bytes);
    std::uint64_t size = head && head->has_right_checksum() ? head->header.file_size : 0;
    if (size == 0 || size > bytes.size()) size = bytes.size();
    const Bytes part = bytes.first(size);
    result.emplace_back(part.begin(), part.end());
    bytes = bytes.subspan(size);
  }
  return result;
}

// Links a record to the one before it.
void chain(Content& record, std::uint64_t number, const Content& previous) {
  File file(record);
  for (auto& [name, content] : file.sections) {
    if (name != "chain" || content.size() != 16) continue;
    std::memcpy(content.data(), &number, sizeof(number));
    std::memcpy(&content[8], &previous[28], sizeof(std::uint32_t));
  }
  record = file.serialize();
}

Content mutate_journal(std::vector<Content> parts, Random& random, std::size_t most) {
  const auto one_in = [&](unsigned n) { return random() % n == 0; };
  const auto any = [&] {
    return parts.begin() + static_cast<std::ptrdiff_t>(random() % parts.size());
  };
  if (one_in(8)) {
    parts.insert(any(), Content(*any()));
  } else if (one_in(8)) {
    parts.erase(any());
  } else if (one_in(8)) {
    std::iter_swap(any(), any());
  } else {
    Content& part = *any();
    try {
      part = mutate_file(part, random, most);
    } catch (const FileError&) {
      mutate(part, most);
    }
  }
  const bool repaired = !one_in(8);
  Content result;
  for (std::size_t i = 0; i < parts.size(); ++i) {
    try {
      if (repaired && i > 0 && parts[i - 1].size() >= 32) chain(parts[i], i, parts[i - 1]);
    } catch (const FileError&) {  // a torn tail
    }
    result.insert(result.end(), parts[i].begin(), parts[i].end());
  }
  return result;
}

// Sections of the same name, from one file or the other.
Content cross(Bytes one, Bytes other, Random& random) {
  File file(one);
  for (auto& section : File(other).sections) {
    if (random() % 2 != 0) continue;
    const auto mine = std::find_if(file.sections.begin(), file.sections.end(),
                                   [&](const auto& s) { return s.first == section.first; });
    if (mine != file.sections.end()) {
      mine->second = std::move(section.second);
    } else {
      file.sections.push_back(std::move(section));
    }
  }
  return file.serialize();
}

std::size_t put(const Content& from, std::uint8_t* to, std::size_t most) {
  if (from.size() > most) return 0;
  std::memcpy(to, from.data(), from.size());
  return from.size();
}

}  // namespace
}  // namespace protomark::fuzz

using namespace protomark;

extern "C" std::size_t LLVMFuzzerCustomMutator(std::uint8_t* data, std::size_t size,
                                               std::size_t max_size, unsigned seed) {
  fuzz::Random random(seed);
  if (random() % 32 != 0) {
    try {
      const auto input = std::as_bytes(std::span(data, size));
      auto parts = fuzz::split(input);
      const auto mutated = parts.size() > 1
                               ? fuzz::mutate_journal(std::move(parts), random, max_size)
                               : fuzz::mutate_file(input, random, max_size);
      if (const std::size_t n = fuzz::put(mutated, data, max_size); n > 0) return n;
    } catch (const FileError&) {  // not a file any more: mutated as it is
    }
  }
  return LLVMFuzzerMutate(data, size, max_size);
}

extern "C" std::size_t LLVMFuzzerCustomCrossOver(const std::uint8_t* one, std::size_t one_size,
                                                 const std::uint8_t* other, std::size_t other_size,
                                                 std::uint8_t* out, std::size_t max_size,
                                                 unsigned seed) {
  fuzz::Random random(seed);
  try {
    return fuzz::put(fuzz::cross(std::as_bytes(std::span(one, one_size)),
                                 std::as_bytes(std::span(other, other_size)), random),
                     out, max_size);
  } catch (const FileError&) {
    return 0;
  }
}
