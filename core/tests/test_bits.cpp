// Packed numbers of every width.
#include "base/packed_numbers.h"

#include "base/checksums.h"
#include "check.h"
#include "random.h"

using namespace protomark;

int main() {
  test::Random random(4);
  for (int bits = 0; bits < 64; ++bits) {
    const auto limit = static_cast<std::int64_t>((std::uint64_t{1} << bits) - 1);
    const auto values = random.integers<std::uint64_t>(1001, 0, limit);
    BitPacker packer;
    std::vector<std::uint64_t> words;
    for (std::size_t i = 0; i < values.size(); ++i) {
      packer.add(values[i], bits);
      if (i % 100 != 0) continue;
      // Full words may be taken at any time.
      words.insert(words.end(), packer.words().begin(), packer.words().end());
      packer.words().clear();
    }
    packer.align();
    words.insert(words.end(), packer.words().begin(), packer.words().end());
    CHECK(words.size() == packed_words(values.size(), bits));
    CHECK(words.size() == (1001u * static_cast<unsigned>(bits) + 63) / 64);
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
