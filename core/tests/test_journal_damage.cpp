// Damaged journals: a torn last record is left out, anything else refused.
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <new>

#include "base/bytes.h"
#include "file/container.h"
#include "file/sections.h"
#include "journal_files.h"

using namespace protomark;
using namespace protomark::test;

// Fails for sizes that no test needs. Inlined, new and delete look mismatched to g++.
[[gnu::noinline]] void* operator new(std::size_t size) {
  void* memory = size > std::size_t{1} << 30 ? nullptr : std::malloc(size);
  return memory != nullptr ? memory : throw std::bad_alloc();
}
[[gnu::noinline]] void operator delete(void* memory) noexcept { std::free(memory); }
[[gnu::noinline]] void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }

namespace {

void torn_tails(std::size_t appearance_bits) {
  const Commits c(appearance_bits);
  // Cut off anywhere.
  for (std::size_t size = 0; size <= c.whole.size(); ++size) {
    std::size_t commits = 0;
    while (commits < 3 && c.lengths[commits + 1] <= size) ++commits;
    CHECK(c.opened({c.whole.begin(), c.whole.begin() + static_cast<std::ptrdiff_t>(size)}) ==
          c.states[commits]);
  }
  // Broken anywhere in the last record; padding does not count.
  std::size_t left_out = 0;
  for (std::size_t at = c.lengths[2]; at < c.whole.size(); ++at) {
    for (const int bits : {0xff, 0x01}) {
      Content broken = c.whole;
      broken[at] = static_cast<char>(broken[at] ^ bits);
      Content state;
      try {
        state = c.opened(broken);
      } catch (const std::exception& error) {
        std::printf("byte %zu: %s\n", at, error.what());
      }
      CHECK(state == c.states[2] || state == c.states[3]);
      left_out += state == c.states[2] ? 1 : 0;
    }
  }
  CHECK(left_out > (c.whole.size() - c.lengths[2]));
  // Broken before that: refused, whatever the byte, unless it is padding.
  std::size_t refused = 0;
  for (std::size_t at = 0; at < c.lengths[2]; ++at) {
    Content broken = c.whole;
    broken[at] = static_cast<char>(broken[at] ^ 0xff);
    try {
      CHECK(c.opened(broken) == c.states[3]);
    } catch (const FileError& error) {
      CHECK(std::string(error.what()).starts_with("map.journal: "));
      ++refused;
    }
  }
  CHECK(refused > c.lengths[2] / 2);
  // Opening with the journal cuts the torn record off.
  Content torn = c.whole;
  torn.resize(torn.size() - 70);
  write(journal, torn);
  CHECK(file_journal(path)->torn_bytes == torn.size() - c.lengths[2]);
  CHECK(fs::file_size(journal) == torn.size());
  PrototypeMap map = PrototypeMap::load(path, true);
  CHECK(fs::file_size(journal) == c.lengths[2]);
  CHECK(bytes_of(map) == c.states[2]);
  add(map, 12);
  map.commit();
  CHECK(bytes_of(map) == c.states[3]);
  CHECK(read(journal) == c.whole);
  CHECK(file_journal(path)->commits == 3 && file_journal(path)->torn_bytes == 0);
}

Content joined(std::initializer_list<std::span<const char>> parts) {
  Content result;
  for (const auto part : parts) result.insert(result.end(), part.begin(), part.end());
  return result;
}

template <typename Change>
Content with_container(std::span<const char> record, Change change) {
  const ContainerReader reader(std::as_bytes(record), "record");
  ContainerWriter writer(reader.kind());
  for (const auto& [name, size] : reader.sections()) {
    std::vector<std::byte> content(reader.read(name).begin(), reader.read(name).end());
    change(name, content);
    if (!content.empty()) writer.add(name, std::move(content));
  }
  const auto bytes = writer.serialize();
  Content result(bytes.size());
  std::memcpy(result.data(), bytes.data(), bytes.size());
  return result;
}

void refused() {
  const Commits c(0);
  const auto all = std::span<const char>(c.whole);
  const auto head = all.first(c.lengths[0]);
  const auto record = [&](std::size_t i) {
    return all.subspan(c.lengths[i], c.lengths[i + 1] - c.lengths[i]);
  };
  const auto fails = [&](const Content& content, const std::string& why) {
    CHECK(check::throws<FileError>([&] { c.opened(content); }, why));
  };
  const std::string second = "record at byte " + std::to_string(c.lengths[1]);
  fails(joined({head, record(1)}), "it does not follow the one before it");
  fails(joined({head, record(0), record(0)}), second + ": it does not follow");
  fails(joined({head, record(0), record(2)}), second + ": it does not follow");
  fails(joined({head, record(0), head}), second + ": it is a journal");
  fails(
      joined({head, record(0), std::vector<char>(64), record(2)}),
      second + " is broken, and another one follows at byte " + std::to_string(c.lengths[1] + 64));
  fails(joined({record(0)}), "it holds a record of a journal, not a journal");
  fails(joined({c.base}), "it holds a learning map, not a journal");
  fails(Content(1000, 'x'), "not a Protomark file");

  // A record of a later version is not a torn one.
  for (const std::size_t field : {std::size_t{8}, std::size_t{12}}) {
    Content newer(record(2).begin(), record(2).end());
    newer[field] = 77;
    const auto sections = static_cast<std::size_t>(newer[24]);
    std::memset(&newer[28], 0, 4);
    const auto crc = crc32(std::as_bytes(std::span(newer)).first(64 + 32 * sections));
    std::memcpy(&newer[28], &crc, 4);
    fails(joined({head, record(0), record(1), newer}),
          field == 8 ? "format version 77" : "of a kind that this Protomark does not know");
  }
  // Right checksums and wrong content.
  const auto broken_second = [&](const std::string& section, const std::string& why) {
    const auto changed =
        with_container(record(1), [&](const std::string& name, std::vector<std::byte>& content) {
          if (name == section) content.resize(content.size() - 1);
        });
    fails(joined({head, record(0), changed}), why);
  };
  broken_second("removed", second + ": its section 'removed' is longer");
  broken_second("idblocks", "its section 'idblocks'");
  broken_second("sums", "its section 'sums'");
  broken_second("chain", "its section 'chain' is shorter");
  const auto impossible =
      with_container(record(1), [&](const std::string& name, std::vector<std::byte>& content) {
        if (name == "counts") content[0] = std::byte{0};
      });
  fails(joined({head, record(0), impossible}), "has an impossible prototype");
}

// The content of an interrupted commit does not count as a record behind it.
void containers_within_a_torn_record() {
  const Commits c(0);
  const auto all = std::span<const char>(c.whole);
  const auto commit = [](std::uint64_t number, const Content& text) {
    SectionWriter chain;
    chain.value(number);
    chain.value(std::uint64_t{0});
    ContainerWriter file(FileKind::commit);
    file.add("chain", chain.bytes());
    file.add("metadata", std::as_bytes(std::span(text)));
    const auto bytes = file.serialize();
    const auto* data = reinterpret_cast<const char*>(bytes.data());
    return Content(data, data + bytes.size());
  };
  const Content earlier(c.whole.begin(), c.whole.begin() + static_cast<long>(c.lengths[1]));
  const Content later = commit(5, {});
  for (const Content& text : {earlier, later}) {
    const Content record = commit(4, text);
    for (std::size_t size = 0; size < record.size(); size += 16) {
      CHECK(c.opened(joined({all, std::span(record).first(size)})) == c.states[3]);
    }
    Content broken = record;
    broken[128] = 0;  // the chain
    CHECK(c.opened(joined({all, broken})) == c.states[3]);
    CHECK(check::throws<FileError>(
        [&] { c.opened(joined({all, broken, later})); },
        "another one follows at byte " + std::to_string(all.size() + record.size())));
  }
  // If its header did not reach the disk, no earlier record follows.
  Content broken = commit(4, earlier);
  std::fill_n(broken.begin(), 64, 0);
  CHECK(c.opened(joined({all, broken})) == c.states[3]);
  CHECK(check::throws<FileError>([&] { c.opened(joined({all, broken, later})); },
                                 "at byte " + std::to_string(all.size() + broken.size())));
}

// Sparse files that claim to be large.
void holes() {
  begin(0);
  PrototypeMap::load(path, true).close();
  const Content head = read(journal);
  const PrototypeMap other(test::random_encoder());
  const auto refused = [&](const Content& content, const std::string& why) {
    write(journal, content);
    fs::resize_file(journal, std::uintmax_t{8} << 30);
    CHECK(check::throws<FileError>([] { PrototypeMap::load(path); }, why));
    CHECK(check::throws<FileError>([] { PrototypeMap::load(path, true); }, why));
    CHECK(check::throws<FileError>([&] { other.save(path); }, why));
  };
  refused({}, "map.pmk.journal: not a Protomark file");
  refused(Content(head.begin(), head.begin() + 64), "map.pmk.journal: ");
  refused(head, "map.pmk.journal: cannot be read: its 8589934592 bytes do not fit into memory");
  fs::remove(journal);
}

// The error states how many commits may be in the map file already.
void commits_to_other_map_files() {
  const Commits c(0);
  const auto all = std::span<const char>(c.whole);
  ContainerWriter fold(FileKind::fold);
  SectionWriter chain;
  std::uint32_t checksum;
  std::memcpy(&checksum, &c.whole[c.lengths[1] + 28], 4);
  chain.value(std::uint64_t{3});
  chain.value(checksum);
  chain.value(std::uint32_t{0});
  fold.add("chain", chain.bytes());
  fold.add("base", std::vector<std::byte>(64, std::byte{'a'}));
  const auto bytes = fold.serialize();
  Content folded(all.begin(), all.begin() + static_cast<std::ptrdiff_t>(c.lengths[2]));
  const auto* data = reinterpret_cast<const char*>(bytes.data());
  folded.insert(folded.end(), data, data + bytes.size());
  const auto third = with_container(all.subspan(c.lengths[2]),
                                    [&](const std::string& name, std::vector<std::byte>& content) {
                                      if (name != "chain") return;
                                      const std::uint64_t number = 4;
                                      std::memcpy(content.data(), &number, 8);
                                      std::memcpy(&content[8], &bytes[28], 4);
                                    });
  Content longer = folded;
  longer.insert(longer.end(), third.begin(), third.end());

  CHECK(c.opened(longer) == c.states[3]);  // the fold did not take place
  CHECK(c.opened(folded) == c.states[2]);
  PrototypeMap other(test::random_encoder());
  add(other, 99);
  other.save(folder / "other.pmk");
  write(path, read(folder / "other.pmk"));
  write(journal, longer);
  CHECK(check::throws<FileError>([] { PrototypeMap::load(path); },
                                 "holds 3 commits to another map file than the one beside it, of "
                                 "which the first 2 may be in that file already"));
  write(journal, folded);
  CHECK(bytes_of(PrototypeMap::load(path)) == bytes_of(other));
}

}  // namespace

int main() {
  for (const std::size_t appearance_bits : {0, 3}) torn_tails(appearance_bits);
  refused();
  containers_within_a_torn_record();
  holes();
  commits_to_other_map_files();
  fs::remove_all(folder);
  return check::result();
}
