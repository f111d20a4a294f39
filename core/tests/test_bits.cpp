// Packed numbers, whatever their width.
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
      // What is full may be taken at any time.
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

  // Checksums of blocks do not depend on the pieces in which words come.
  const auto words = random.integers<std::uint64_t>(3 * CheckedNumbers::kBlock + 7, 0, 1000);
  BlockChecksums checksums;
  for (std::size_t at = 0; at < words.size();) {
    const auto n = std::min(words.size() - at, static_cast<std::size_t>(random.integer(0, 900)));
    checksums.add(std::span(words).subspan(at, n));
    at += n;
  }
  CHECK(checksums.all().size() == 4 && CheckedNumbers::blocks(words.size()) == 4);
  CHECK(checksums.all()[3] ==
        crc32(std::as_bytes(std::span(words).subspan(3 * CheckedNumbers::kBlock))));
  return check::result();
}
