#include "file/ids.h"

#include <algorithm>
#include <limits>
#include <numeric>
#include <set>
#include <vector>

#include "check.h"
#include "file/container.h"
#include "file/sections.h"
#include "protomark/protomark.h"
#include "random.h"

using namespace protomark;

namespace {

constexpr std::int64_t kMostId = std::numeric_limits<std::int64_t>::max();
using Ids = std::vector<std::int64_t>;

std::vector<std::byte> file_of(const Ids& ids) {
  ContainerWriter file(FileKind::sealed_map);
  if (!IdBlockWriter::needed(ids.size(), ids.empty() ? -1 : ids.back())) return file.serialize();
  std::vector<ContainerWriter::Part> parts;
  IdBlockWriter::add_to(parts, ids.size());
  file.add(std::move(parts), [&](ContainerWriter::Writers& writers) {
    IdBlockWriter to(writers);
    for (const std::int64_t id : ids) to.add(id);
    to.finish();
  });
  return file.serialize();
}

std::size_t bytes_of(const Ids& ids) {
  std::size_t total = 0;
  const auto bytes = file_of(ids);
  for (const auto& [name, size] : ContainerReader(bytes, "f").sections()) total += size;
  return total;
}

LandmarkIndex index(std::size_t i) { return {static_cast<std::uint32_t>(i)}; }

bool unknown(const LandmarkIds& ids, std::int64_t id) {
  return check::throws<UnknownLandmark>([&] { ids.find(id); });
}

void test_round_trip(const Ids& ids) {
  const auto bytes = file_of(ids);
  const ContainerReader file(bytes, "f");
  file.verify();
  const LandmarkIds read(file, ids.size());
  CHECK(read.all() == ids);
  CHECK(read.are_indices() == (ids.empty() || ids.back() == std::int64_t(ids.size()) - 1));
  bool same = true;
  for (std::size_t i = 0; i < ids.size(); ++i) same = same && read[index(i)] == ids[i];
  for (std::size_t i = 0; i < ids.size(); ++i) same = same && read.find(ids[i]) == index(i);
  CHECK(same);
  const std::set<std::int64_t> existing(ids.begin(), ids.end());
  for (const std::int64_t id : ids) {
    for (const std::int64_t near : {id - 1, id == kMostId ? 0 : id + 1}) {
      CHECK(existing.count(near) != 0 || unknown(read, near));
    }
  }
  CHECK(unknown(read, -1));
  CHECK(unknown(read, std::numeric_limits<std::int64_t>::min()));
  CHECK(existing.count(kMostId) != 0 || unknown(read, kMostId));
}

Ids run(std::int64_t first, std::size_t n, std::int64_t step = 1) {
  Ids ids(n);
  for (std::size_t i = 0; i < n; ++i) ids[i] = first + static_cast<std::int64_t>(i) * step;
  return ids;
}

void test_round_trips() {
  for (const std::size_t n : {0, 1, 2, 127, 128, 129, 255, 256, 257, 1000}) {
    test_round_trip(run(0, n));
    test_round_trip(run(1, n));
    test_round_trip(run(5, n, 7));
    if (n > 0) test_round_trip(run(kMostId - std::int64_t(n) + 1, n));
    Ids widest = run(0, n);
    if (n > 0) widest.back() = kMostId;
    test_round_trip(widest);
  }
  // Every width that a gap can have.
  for (int bits = 0; bits < 63; ++bits) {
    Ids ids = run(0, 200);
    for (std::size_t i = 100; i < ids.size(); ++i) ids[i] += (std::int64_t{1} << bits) - 1;
    test_round_trip(ids);
  }
  test::Random random(3);
  for (const std::int64_t most : {std::int64_t{5000}, std::int64_t{1} << 40, kMostId}) {
    const auto drawn = random.integers<std::int64_t>(3000, 0, most);
    const std::set<std::int64_t> distinct(drawn.begin(), drawn.end());
    test_round_trip({distinct.begin(), distinct.end()});
  }
}

void test_sizes() {
  CHECK(bytes_of(run(0, 1280)) == 0);
  CHECK(bytes_of(run(1, 1280)) == 10 * 16);  // runs take blocks alone
  CHECK(bytes_of(run(0, 1280, 2)) == 10 * (16 + 128 * 7 / 8));
}

// A file with these blocks and words, of n landmarks.
bool broken(std::size_t n, const std::vector<IdBlock>& blocks,
            const std::vector<std::uint64_t>& words, const std::string& message) {
  ContainerWriter file(FileKind::sealed_map);
  file.add(section::kIdBlocks, std::as_bytes(std::span(blocks)));
  file.add(section::kIdGaps, std::as_bytes(std::span(words)));
  const auto bytes = file.serialize();
  const ContainerReader read(bytes, "f");
  return check::throws<FileError>([&] { LandmarkIds(read, n).all(); }, "f: " + message);
}

void test_broken_files() {
  const std::uint64_t one = 64;  // the next word
  CHECK(broken(129, {{5, 0}}, {}, "its section 'idblocks' has the wrong size"));
  CHECK(broken(128, {{5, 0}, {500, 0}}, {}, "its section 'idblocks' has the wrong size"));
  CHECK(broken(2, {{-1, 0}}, {}, "it has a negative landmark id"));
  CHECK(broken(2, {{5, one}}, {0}, "its blocks of ids do not follow each other"));
  CHECK(broken(2, {{5, ~std::uint64_t{0}}}, {}, "its blocks of ids do not follow each other"));
  CHECK(broken(2, {{5, 63}}, {0}, "its section 'idgaps' has the wrong size"));
  CHECK(broken(2, {{5, 1}}, {0, 0}, "its section 'idgaps' has the wrong size"));
  CHECK(broken(2, {{5, 0}}, {0}, "its section 'idgaps' has the wrong size"));
  CHECK(broken(129, {{5, 0}, {132, 0}}, {}, "its landmark ids do not ascend"));
  CHECK(broken(129, {{5, 0}, {4, 0}}, {}, "its landmark ids do not ascend"));
  CHECK(broken(2, {{kMostId, 0}}, {}, "its landmark ids do not ascend"));
  // Only the gaps are wrong.
  CHECK(broken(2, {{5, 2}}, {0b0011}, "its landmark ids do not ascend"));
  CHECK(broken(2, {{kMostId - 1, 1}}, {0b10}, "its landmark ids do not ascend"));
  CHECK(broken(2, {{kMostId - 1, 63}}, {~std::uint64_t{0}, ~std::uint64_t{0}},
               "its landmark ids do not ascend"));
  CHECK(broken(129, {{5, 1}, {133, 128}}, {0, std::uint64_t{1} << 63},
               "its landmark ids do not ascend"));

  ContainerWriter file(FileKind::sealed_map);
  file.add(section::kIdBlocks, std::vector<std::byte>(16));
  const auto bytes = file.serialize();
  const ContainerReader read(bytes, "f");
  CHECK(check::throws<FileError>([&] { LandmarkIds(read, 1); }, "it lacks the section 'idgaps'"));
}

}  // namespace

int main() {
  test_round_trips();
  test_sizes();
  test_broken_files();
  return check::result();
}
