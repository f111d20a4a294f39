#include "encoder/codebooks.h"

#include <climits>

#include "base/quantize.h"
#include "check.h"
#include "random.h"

using namespace protomark;

namespace {

// Few values give many equal words and ties.
void test_words(test::Random& random, std::size_t width, std::int8_t span) {
  const std::size_t dim = 5 * width;
  const Codebook codebook = test::random_codebook(random, width, dim + 2 * width, span);
  const NearestWords nearest(codebook, dim);
  CHECK(nearest.words() == 5);
  const std::vector<std::int8_t> table = decode_table(codebook, dim);
  CHECK(table.size() == (dim + 3) / 4 * 4 * 256);
  for (std::size_t n = 1; n <= 16; ++n) {
    const auto codes = random.integers<std::int8_t>(n * dim, -span - 1, span);
    std::vector<std::uint8_t> words(5 * n);
    nearest.find(codes.data(), dim, n, words.data());
    for (std::size_t at = 0; at < words.size(); ++at) {
      const std::size_t s = at / n, i = at % n;
      int best = INT_MAX;
      std::size_t expected = 0;
      for (std::size_t word = 0; word < 256; ++word) {
        const int distance = squared_distance(&codebook.words[(s * 256 + word) * width],
                                              &codes[i * dim + s * width], width);
        if (distance >= best) continue;
        best = distance;
        expected = word;
      }
      CHECK(words[at] == expected);
      for (std::size_t j = 0; j < width; ++j) {
        CHECK(table[(s * width + j) * 256 + expected] ==
              codebook.words[(s * 256 + expected) * width + j]);
      }
    }
  }
  for (std::size_t i = dim * 256; i < table.size(); ++i) CHECK(table[i] == 0);
}

void test_files() {
  const auto encoder = test::random_encoder();
  CHECK(encoder->codebooks().size() == 2);
  const auto with = [&](std::vector<Codebook> codebooks) {
    return Encoder(encoder->info(), encoder->layers(), encoder->dims(), encoder->scale(),
                   std::move(codebooks));
  };
  for (const Encoder& e : {*encoder, with({}), with({encoder->codebooks()[1]})}) {
    const Encoder read = Encoder::parse(e.serialize(), "file");
    CHECK(read.codebooks() == e.codebooks());
    CHECK(read.identity() == encoder->identity());
  }
  const auto bad = [&](std::vector<Codebook> codebooks, const std::string& message) {
    try {
      with(std::move(codebooks));
      CHECK(false);
    } catch (const std::invalid_argument& error) {
      CHECK(std::string(error.what()).find(message) != std::string::npos);
    }
  };
  const auto book = [](std::size_t width, std::size_t numbers) {
    return Codebook{width, std::vector<std::int8_t>(numbers, 1)};
  };
  for (const std::size_t width : {0, 5})
    bad({book(width, 2560)}, "words of a codebook have 1 to 4");
  for (const std::size_t numbers : {0, 256, 513, 14 * 256}) {
    bad({book(2, numbers)}, "256 words for each 2 numbers");
  }
  bad({book(2, 512), book(3, 768), book(2, 1024)}, "two codebooks have words of 2 numbers");
  Codebook low = book(2, 512);
  low.words[9] = -128;
  bad({low}, "numbers of words must be -127 to 127");
  const Codebook& three = encoder->codebooks()[1];
  CHECK(three.width == 3 && three.covers(6) && three.covers(12));
  CHECK(!three.covers(4) && !three.covers(15));
}

}  // namespace

int main() {
  test::Random random(3);
  for (std::size_t width = 1; width <= 4; ++width) {
    for (const std::int8_t span : {0, 2, 30, 127}) test_words(random, width, span);
  }
  test_files();
  return check::result();
}
