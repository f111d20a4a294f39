#include "encoder/codebooks.h"

#include "check.h"
#include "random.h"

using namespace protomark;

namespace {

// Few values give many equal words and ties.
void test_words(test::Random& random, std::size_t width, std::int8_t span) {
  const std::size_t dim = 5 * width;
  const Codebook codebook = test::random_codebook(random, width, dim + 2 * width, span);
  const NearestWords nearest(codebook, dim);
  const std::vector<std::int8_t> table = decode_table(codebook, dim);
  CHECK(table.size() == (dim + 3) / 4 * 4 * 256);
  for (int i = 0; i < 200; ++i) {
    const auto code = random.integers<std::int8_t>(dim, -span - 1, span);
    std::vector<std::uint8_t> words(5 * 3, 99);
    nearest.find(code.data(), words.data(), 3);
    for (std::size_t s = 0; s < 5; ++s) {
      int best = INT_MAX;
      std::size_t expected = 0;
      for (std::size_t word = 0; word < 256; ++word) {
        const int distance =
            squared_distance(&codebook.words[(s * 256 + word) * width], &code[s * width], width);
        if (distance >= best) continue;
        best = distance;
        expected = word;
      }
      CHECK(words[3 * s] == expected && words[3 * s + 1] == 99);
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
