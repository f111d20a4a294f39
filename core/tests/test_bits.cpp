// Packed numbers of every width.
#include "base/packed_numbers.h"

#include "base/bytes.h"
#include "check.h"
#include "random.h"

using namespace protomark;

int main() {
  constexpr std::size_t kNumbers = 9001;  // several pieces of 4096 words
  test::Random random(4);
  for (int bits = 0; bits < 64; ++bits) {
    const auto limit = static_cast<std::int64_t>((std::uint64_t{1} << bits) - 1);
    const auto values = random.integers<std::uint64_t>(kNumbers, 0, limit);
    std::vector<std::uint64_t> words;
    ValueWriter writer([&](std::span<const std::byte> bytes) {
      const std::size_t before = words.size();
      words.resize(before + bytes.size() / 8);
      if (!bytes.empty()) std::memcpy(&words[before], bytes.data(), bytes.size());
    });
    for (const std::uint64_t value : values) writer.add(value, bits);
    writer.finish();
    CHECK(words.size() == packed_words(kNumbers, bits));
    CHECK(words.size() == (kNumbers * static_cast<unsigned>(bits) + 63) / 64);
    bool equal = true;
    for (std::size_t i = 0; i < values.size(); ++i) {
      equal = equal && packed_number(words.data(), bits, i) == values[i];
    }
    CHECK(equal);
  }

  // Reading any number of a broken block throws; those of other blocks are right.
  auto words = random.integers<std::uint64_t>(3 * CheckedNumbers::kBlock + 7, 0, 1000);
  std::vector<std::uint32_t> checksums;
  for (std::size_t at = 0; at < words.size(); at += CheckedNumbers::kBlock) {
    const std::size_t n = std::min(CheckedNumbers::kBlock, words.size() - at);
    checksums.push_back(crc32(std::as_bytes(std::span(words).subspan(at, n))));
  }
  CHECK(checksums.size() == CheckedNumbers::blocks(words.size()));
  words[CheckedNumbers::kBlock] ^= 1;
  const CheckedNumbers numbers(words, 32, checksums, "test");
  for (std::size_t i = 0; i < 2 * words.size(); ++i) {
    if (i / 2 / CheckedNumbers::kBlock == 1) {
      CHECK(check::throws<FileError>([&] { numbers[i]; }));
    } else {
      CHECK(numbers[i] == (words[i / 2] >> (i % 2 * 32) & 0xffffffff));
    }
  }
  return check::result();
}
