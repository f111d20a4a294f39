// The encoder: an integer network from descriptors to int8 codes, the same bytes on every machine.
#pragma once

#include <filesystem>
#include <memory>
#include <utility>

#include "protomark/types.h"

namespace protomark {

// A fully connected layer:
//   sum  = bias[o] + sum_i weights[o][i] * x[i]
//   t    = (sum * multipliers[o] + 2^(shift - 1)) >> shift      (64-bit product)
//   next = table[clamp(t, -128, 127) + 128]                     (hidden layers)
//   code = clamp(t, -127, 127)                                  (last layer)
// x are the descriptor's bits, 0 or 1, or its bytes in the first layer, and the bytes that the
// layer before gave in later ones.
struct Layer {
  size_t inputs = 0;
  size_t outputs = 0;
  std::vector<int8_t> weights;  // outputs x inputs
  std::vector<int32_t> bias;
  std::vector<int32_t> multipliers;  // positive
  int shift = 1;                     // 1 to 62
  std::array<uint8_t, 256> table{};
};

// What descriptors consist of. Each float32 number f becomes a byte first, the product a float:
//   x = clamp(rint(f * scale), -127, 127) + 128                 (halves to the even integer)
enum class InputKind : uint32_t { bits, uint8, float32 };

struct EncoderInput {
  InputKind kind = InputKind::bits;
  float scale = 0;  // positive for float32, 0 for others
  bool operator==(const EncoderInput&) const = default;
};

// The words of a product quantizer (Jegou et al. 2011, doi:10.1109/TPAMI.2010.57), by which sealed
// maps write prototypes: in a code, a byte names one of 256 words for each `width` numbers.
struct Codebook {
  static constexpr size_t kWords = 256;

  size_t width = 0;           // numbers per word, 1 to 4
  std::vector<int8_t> words;  // subspaces x kWords x width, -127 to 127

  size_t subspaces() const { return words.size() / (kWords * width); }
  // Returns whether codes of `dim` numbers are whole words of this codebook.
  bool covers(size_t dim) const { return dim % width == 0 && dim / width <= subspaces(); }
  bool operator==(const Codebook&) const = default;
};

struct EncoderInfo {
  std::string name;        // of the model, not empty
  std::string descriptor;  // that it takes, as in "freak", not empty
  std::string data;        // what it was trained on
  std::string licence;
  std::vector<std::pair<std::string, std::string>> notes;  // other texts, by other names
};

class PROTOMARK_API Encoder {
 public:
  // `dims` are the lengths at which a code serves alone, ascending, the last one the number of
  // outputs; a code times `scale` is the real value; `codebooks` are of distinct widths. Throws
  // std::invalid_argument if layers, codebooks or input do not fit together, a sum could exceed 32
  // bits, or a note is named like a field of EncoderInfo.
  Encoder(EncoderInfo info, std::vector<Layer> layers, std::vector<size_t> dims, float scale,
          std::vector<Codebook> codebooks = {}, EncoderInput input = {});

  // Reads and checks a model file. Throws FileError.
  static Encoder load(const std::filesystem::path& path);
  // Reads and checks the bytes of a model file; errors call it `name`.
  static Encoder parse(std::span<const std::byte> bytes, const std::string& name);
  // Writes a model file, whole or not at all. Throws FileError.
  void save(const std::filesystem::path& path) const;
  // Returns the bytes of the model file.
  std::vector<std::byte> serialize() const;

  const EncoderInfo& info() const { return info_; }
  const std::vector<Layer>& layers() const { return layers_; }
  const EncoderInput& input() const { return input_; }
  // The numbers of a descriptor, or its bits.
  size_t inputs() const { return layers_.front().inputs; }
  // The size of a descriptor in memory.
  size_t bytes() const;
  size_t bits() const { return 8 * bytes(); }
  size_t dim() const { return dims_.back(); }
  const std::vector<size_t>& dims() const { return dims_; }
  float scale() const { return scale_; }
  const std::vector<Codebook>& codebooks() const { return codebooks_; }
  // The SHA-256 of the network, in hexadecimal; encoders of equal identity give equal codes.
  const std::string& identity() const { return identity_; }
  // Multiply-adds per descriptor.
  size_t multiply_adds() const;

  // Throws std::invalid_argument unless descriptors are rows of bytes() bytes and, if they are
  // vectors, each row is finite and not zeros alone, also once quantised.
  void check(Descriptors descriptors, int threads = 1) const;
  // Encodes descriptors (n x bytes; floats as they are in memory, at any address) to codes
  // (n x dim), the first numbers of full ones; 0 stands for the full length, and dims() are those
  // that serve best alone. Throws std::invalid_argument as check() does, or if shapes do not fit.
  Matrix<int8_t> encode(Descriptors descriptors, size_t dim = 0, int threads = 1) const;
  // Encodes into memory of the caller; dim is codes.columns.
  void encode(Descriptors descriptors, MatrixView<int8_t> codes, int threads = 1) const;

 private:
  struct Packed;  // the layers as the kernels take them

  std::vector<std::byte> network_bytes() const;

  EncoderInfo info_;
  std::vector<Layer> layers_;
  std::vector<size_t> dims_;
  float scale_;
  std::vector<Codebook> codebooks_;
  EncoderInput input_;
  std::string identity_;
  std::shared_ptr<const Packed> packed_;
};

}  // namespace protomark
