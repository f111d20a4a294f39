// The owners of rows in an index are checked as they are read: right answers, or an error.
#include "base/packed_numbers.h"

#include <unistd.h>

#include <atomic>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <numeric>
#include <thread>

#include "check.h"
#include "file/container.h"
#include "file/sections.h"
#include "protomark/protomark.h"
#include "random.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

const fs::path path =
    fs::temp_directory_path() / ("protomark_owners_" + std::to_string(::getpid()) + ".pmk");
constexpr std::size_t kQueries = 3;

std::vector<std::byte> read_file() {
  std::ifstream file(path, std::ios::binary);
  const std::vector<char> bytes{std::istreambuf_iterator<char>(file), {}};
  std::vector<std::byte> result(bytes.size());
  std::memcpy(result.data(), bytes.data(), bytes.size());
  return result;
}

// Not in place: another map may have the old file mapped.
void write_bytes(const std::vector<std::byte>& bytes) {
  TemporaryFile file(path);
  file.write(0, bytes);
  file.sync();
  file.replace_target();
}

// The file with other sections, or without those for which `change` is false; checksums are right.
template <typename Change>
std::vector<std::byte> changed(const std::vector<std::byte>& bytes, const Change& change) {
  const ContainerReader file(bytes, "f");
  ContainerWriter writer(file.kind());
  for (const auto& [name, size] : file.sections()) {
    const Bytes content = file.read(name);
    std::vector<std::byte> own(content.begin(), content.end());
    if (change(name, own)) writer.add(name, std::move(own));
  }
  return writer.serialize();
}

template <typename Map>
Matches search(const Map& map, Codes queries, std::optional<std::size_t> nprobe, int threads = 1) {
  SearchOptions options;
  options.nprobe = nprobe;
  options.threads = threads;
  return map.search_codes(queries, 2, options);
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
  map.build_index({50});
  map.seal(path);
  const auto whole = read_file();
  const auto asked = random.integers<std::int8_t>(kQueries * 12, -127, 127);
  const Codes queries{asked.data(), kQueries, 12};
  const Matches exact = search(map, queries, std::nullopt), approximate = search(map, queries, 3);
  {
    const SealedMap sealed(path);
    CHECK(search(sealed, queries, std::nullopt) == exact &&
          search(sealed, queries, 3) == approximate);
    CHECK(search(sealed, queries, 3, 4) == approximate);
  }

  // The offsets of the owners and of their checksums.
  const ContainerReader file(whole, "f");
  const Bytes owners = file.map(section::kOwners);
  const auto at = static_cast<std::size_t>(owners.data() - whole.data());
  const std::size_t block_bytes = 8 * CheckedNumbers::kBlock;
  const std::size_t blocks = (owners.size() + block_bytes - 1) / block_bytes;
  CHECK(blocks > 5 && CheckedNumbers::blocks(owners.size() / 8) == blocks);
  CHECK(file.map(section::kOwnerChecksums).size() == 4 * blocks);

  std::size_t answered = 0, refused = 0;
  for (std::size_t block = 0; block < blocks; ++block) {
    auto broken = whole;
    const std::size_t byte = std::min(block * block_bytes + 1000, owners.size() - 1);
    broken[at + byte] ^= std::byte{0x40};
    write_bytes(broken);
    const std::string why = path.string() +
                            ": its section 'owners' does not match its checksum, in the block at "
                            "byte " +
                            std::to_string(block * block_bytes);
    const SealedMap sealed(path);  // none of it is read
    for (const auto& [nprobe, right] :
         {std::pair(std::optional<std::size_t>(3), approximate), {std::nullopt, exact}}) {
      for (const int threads : {1, 3}) {
        try {
          CHECK(search(sealed, queries, nprobe, threads) == right);
          ++answered;
        } catch (const FileError& error) {
          CHECK(std::string(error.what()).starts_with(why));
          ++refused;
        }
      }
    }
    CHECK(check::throws<FileError>([&] { sealed.prototypes(ids); }, why));
    CHECK(check::throws<FileError>([] { verify_file(path); }, "section 'owners'"));
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
      threads.emplace_back([&] { wrong += search(sealed, queries, 3) == approximate ? 0 : 1; });
    }
    for (std::thread& thread : threads) thread.join();
    CHECK(wrong == 0);
  }

  // The checksums themselves are checked when the map is opened.
  auto broken = whole;
  broken[static_cast<std::size_t>(file.map(section::kOwnerChecksums).data() - whole.data())] ^=
      std::byte{1};
  write_bytes(broken);
  CHECK(check::throws<FileError>([] { SealedMap{path}; }, "section 'ownercrc' does not match"));
  write_bytes(changed(whole, [](const std::string& name, auto& content) {
    if (name == section::kOwnerChecksums) content.resize(content.size() - 4);
    return true;
  }));
  CHECK(check::throws<FileError>([] { SealedMap{path}; }, "'ownercrc' has the wrong size"));
  write_bytes(changed(whole, [](const std::string& name, auto& content) {
    if (name == section::kOwners) content.resize(content.size() - 1);
    return true;
  }));
  CHECK(check::throws<FileError>([] { SealedMap{path}; }, "'owners' has the wrong size"));

  fs::remove(path);
  return check::result();
}
