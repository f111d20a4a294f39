// The order of an index is checked where it is read: right answers, or an error.
#include "file/labels.h"

#include <unistd.h>

#include <atomic>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <numeric>
#include <thread>

#include "check.h"
#include "file/bit_numbers.h"
#include "file/container.h"
#include "file/sections.h"
#include "protomark/error.h"
#include "protomark/map_file.h"
#include "random.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

const fs::path path =
    fs::temp_directory_path() / ("protomark_order_" + std::to_string(::getpid()) + ".pmk");
constexpr std::size_t kQueries = 3;

std::vector<std::byte> read_file() {
  std::ifstream file(path, std::ios::binary);
  const std::vector<char> bytes{std::istreambuf_iterator<char>(file), {}};
  std::vector<std::byte> result(bytes.size());
  std::memcpy(result.data(), bytes.data(), bytes.size());
  return result;
}

// Not in place: another map may have the old file mapped.
void write_bytes(const std::vector<std::byte>& bytes) { write_file(path, bytes); }

// The file with some sections other, or gone where `change` is false; checksums are right.
template <typename Change>
std::vector<std::byte> changed(const std::vector<std::byte>& bytes, const Change& change) {
  const ContainerReader file(bytes, "f");
  ContainerWriter writer(file.kind(), 4);
  for (const auto& [name, size] : file.sections()) {
    const Bytes content = file.read(name);
    std::vector<std::byte> own(content.begin(), content.end());
    if (change(name, own)) writer.add(name, std::move(own));
  }
  return writer.serialize();
}

struct Answers {
  std::vector<std::int64_t> ids = std::vector<std::int64_t>(2 * kQueries);
  std::vector<std::int32_t> distances = std::vector<std::int32_t>(2 * kQueries);
  bool operator==(const Answers&) const = default;
};

template <typename Map>
Answers search(const Map& map, Codes queries, std::optional<std::size_t> probes, int threads = 1) {
  Answers result;
  SearchOptions options;
  options.nprobe = probes;
  options.threads = threads;
  map.search_codes(queries, options, {result.ids.data(), kQueries, 2},
                   {result.distances.data(), kQueries, 2});
  return result;
}

}  // namespace

int main() {
  test::Random random(6);
  PrototypeMap map(test::random_encoder());
  constexpr std::size_t kLandmarks = 20'000;
  std::vector<std::int64_t> ids(kLandmarks);
  std::iota(ids.begin(), ids.end(), std::int64_t{5});
  const auto codes = random.integers<std::int8_t>(kLandmarks * 12, -127, 127);
  map.add_codes(ids, {codes.data(), kLandmarks, 12});
  map.build_index(50);
  map.seal(path);
  const auto whole = read_file();
  const auto asked = random.integers<std::int8_t>(kQueries * 12, -127, 127);
  const Codes queries{asked.data(), kQueries, 12};
  const Answers exact = search(map, queries, std::nullopt), some = search(map, queries, 3);
  {
    const SealedMap sealed(path);
    CHECK(search(sealed, queries, std::nullopt) == exact && search(sealed, queries, 3) == some);
    CHECK(search(sealed, queries, 3, 4) == some);
  }

  // Where the order stands, and its checksums.
  const ContainerReader file(whole, "f");
  const Bytes order = *file.map_if_there(section::kOrder);
  const auto at = static_cast<std::size_t>(order.data() - whole.data());
  const std::size_t blocks = (order.size() + kOrderBlock - 1) / kOrderBlock;
  CHECK(blocks > 5 && order_checksums_size(order.size()) == 4 * blocks);
  CHECK(file.map_if_there(section::kOrderChecksums)->size() == 4 * blocks);

  std::size_t answered = 0, refused = 0;
  for (std::size_t block = 0; block < blocks; ++block) {
    auto broken = whole;
    const std::size_t byte = std::min(block * kOrderBlock + 1000, order.size() - 1);
    broken[at + byte] ^= std::byte{0x40};
    write_bytes(broken);
    const std::string why = path.string() +
                            ": its section 'order' does not match its checksum, in the block at "
                            "byte " +
                            std::to_string(block * kOrderBlock);
    const SealedMap sealed(path);  // none of it is read
    for (const auto& [probes, right] :
         {std::pair(std::optional<std::size_t>(3), some), {std::nullopt, exact}}) {
      for (const int threads : {1, 3}) {
        try {
          CHECK(search(sealed, queries, probes, threads) == right);
          ++answered;
        } catch (const FileError& error) {
          CHECK(std::string(error.what()).starts_with(why));
          ++refused;
        }
      }
    }
    std::vector<float> means(kLandmarks * 12);
    const MatrixView<float> all{means.data(), kLandmarks, 12};
    CHECK(check::throws<FileError>([&] { sealed.prototypes(ids, all); }, why));
    CHECK(check::throws<FileError>([] { verify_file(path); }, "section 'order'"));
  }
  std::printf("%zu answers, %zu refused\n", answered, refused);
  CHECK(answered > 0 && refused > 0);

  // Threads that meet a block at the same time.
  write_bytes(whole);
  {
    const SealedMap sealed(path);
    std::atomic<int> wrong{0};
    std::vector<std::thread> threads;
    for (int i = 0; i < 4; ++i) {
      threads.emplace_back([&] { wrong += search(sealed, queries, 3) == some ? 0 : 1; });
    }
    for (std::thread& thread : threads) thread.join();
    CHECK(wrong == 0);
  }

  // The checksums themselves are checked when the map is opened.
  auto broken = whole;
  broken[static_cast<std::size_t>(file.map_if_there(section::kOrderChecksums)->data() -
                                  whole.data())] ^= std::byte{1};
  write_bytes(broken);
  CHECK(check::throws<FileError>([] { SealedMap{path}; }, "section 'ordersum' does not match"));
  write_bytes(changed(whole, [](const std::string& name, auto& content) {
    if (name == section::kOrderChecksums) content.resize(content.size() - 4);
    return true;
  }));
  CHECK(check::throws<FileError>([] { SealedMap{path}; }, "'ordersum' has the wrong size"));
  write_bytes(changed(whole, [](const std::string& name, auto& content) {
    if (name == section::kOrder) content.resize(content.size() - 1);
    return true;
  }));
  CHECK(check::throws<FileError>([] { SealedMap{path}; }, "'order' has the wrong size"));

  // A file from before there were these is read as a whole.
  const auto old =
      changed(whole, [](const std::string& name, auto&) { return name != "ordersum"; });
  write_bytes(old);
  CHECK(search(SealedMap(path), queries, 3) == some);
  broken = old;
  const ContainerReader old_file(old, "f");
  const Bytes old_order = *old_file.map_if_there(section::kOrder);
  broken[static_cast<std::size_t>(old_order.data() - old.data()) + 3000] ^= std::byte{1};
  write_bytes(broken);
  CHECK(check::throws<FileError>([] { SealedMap{path}; }, "section 'order' does not match"));
  fs::remove(path);
  return check::result();
}
