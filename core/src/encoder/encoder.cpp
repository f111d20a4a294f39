#include "protomark/encoder.h"

#include <atomic>
#include <cmath>

#include "base/parallel.h"
#include "encoder/layers.h"
#include "file/journal.h"
#include "file/sections.h"

namespace protomark {
namespace {

constexpr size_t kMinBits = 64;
constexpr size_t kMinNumbers = 16;
constexpr size_t kMaxInputs = 1024;  // bits or numbers
constexpr size_t kMaxDim = 256;
constexpr size_t kMaxWidth = 4096;
constexpr size_t kMaxLayers = 16;
constexpr size_t kMaxWordWidth = 4;

// Descriptors that go through the network together, at most: activations stay in the L2 cache.
constexpr size_t kBatch = 512;
// Threads take multiples of this many descriptors.
constexpr size_t kGrain = 64;

struct Field {
  std::string_view key;
  std::string EncoderInfo::* text;
};
constexpr Field kFields[] = {{"name", &EncoderInfo::name},
                             {"descriptor", &EncoderInfo::descriptor},
                             {"data", &EncoderInfo::data},
                             {"licence", &EncoderInfo::licence}};

void check_layer(const Layer& layer, size_t inputs, size_t index, int64_t largest) {
  const std::string where = text("encoder: layer ", index);
  require(layer.inputs == inputs, where, " has ", layer.inputs, " inputs, ", inputs, " are needed");
  require(layer.outputs >= 1 && layer.outputs <= kMaxWidth, where, " has ", layer.outputs,
          " outputs, 1 to ", kMaxWidth, " are allowed");
  require(layer.weights.size() == layer.inputs * layer.outputs &&
              layer.bias.size() == layer.outputs && layer.multipliers.size() == layer.outputs,
          where, ": weights, bias and multipliers do not match its size");
  require(layer.shift >= 1 && layer.shift <= 62, where, ": shift must be 1 to 62");
  require(std::ranges::all_of(layer.multipliers, [](int32_t m) { return m > 0; }), where,
          ": multipliers must be positive");
  for (size_t o = 0; o < layer.outputs; ++o) {
    const auto [low, high] = sum_range(layer, o);
    require(
        layer.bias[o] + largest * low >= INT32_MIN && layer.bias[o] + largest * high <= INT32_MAX,
        where, ": sums of output ", o, " could leave 32 bits");
  }
}

void check_codebooks(const std::vector<Codebook>& codebooks, size_t dim) {
  std::vector<size_t> widths;
  for (const Codebook& codebook : codebooks) {
    const auto& [width, words] = codebook;
    require(width >= 1 && width <= kMaxWordWidth, "encoder: words of a codebook have 1 to ",
            kMaxWordWidth, " numbers, not ", width);
    require(!words.empty() && words.size() % (Codebook::kWords * width) == 0 &&
                words.size() <= Codebook::kWords * dim,
            "encoder: a codebook has 256 words for each ", width, " numbers of a code");
    require(std::ranges::find(words, -128) == words.end(),
            "encoder: numbers of words must be -127 to 127");
    require(std::ranges::find(widths, width) == widths.end(),
            "encoder: two codebooks have words of ", width, " numbers");
    widths.push_back(width);
  }
}

void check_input(const EncoderInput& input, size_t inputs) {
  const bool bits = input.kind == InputKind::bits, floats = input.kind == InputKind::float32;
  const size_t least = bits ? kMinBits : kMinNumbers;
  require(inputs >= least && inputs <= kMaxInputs && (!bits || inputs % 8 == 0),
          "encoder: a descriptor has ", least, " to ", kMaxInputs,
          bits ? " bits, a multiple of 8" : " numbers", ", not ", inputs);
  require(floats ? input.scale > 0 && std::isfinite(input.scale) : input.scale == 0,
          "encoder: input_scale must be positive for float32 and 0 for others, not ", input.scale);
}

// Returns what is wrong with a vector, or nullptr.
const char* fault_of(const EncoderInput& input, const uint8_t* row, size_t bytes) {
  if (input.kind == InputKind::uint8) {
    return std::all_of(row, row + bytes, [](uint8_t x) { return x == 0; }) ? "is all zeros"
                                                                           : nullptr;
  }
  // Without their signs, the bits of floats ascend as the numbers do, NaN behind infinity.
  int32_t largest = 0;
  for (size_t at = 0; at < bytes; at += sizeof largest) {
    int32_t bits;
    std::memcpy(&bits, row + at, sizeof bits);
    largest = std::max(largest, bits & INT32_MAX);
  }
  const auto magnitude = std::bit_cast<float>(largest);
  if (!std::isfinite(magnitude)) return "has a NaN or an infinity";
  return magnitude * input.scale <= 0.5f ? "is all zeros once quantised" : nullptr;
}

// Writes vectors as the first layer takes them: `inputs` bytes, zeros up to `padded`.
void write_bytes(const EncoderInput& input, Descriptors descriptors, size_t inputs, size_t padded,
                 MatrixView<uint8_t> x) {
  const float scale = input.scale;
  for (size_t i = 0; i < descriptors.rows; ++i) {
    const uint8_t* row = descriptors.row(i);
    uint8_t* to = x.row(i);
    std::memset(to + inputs, 0, padded - inputs);
    if (input.kind == InputKind::uint8) {
      std::memcpy(to, row, inputs);
      continue;
    }
    for (size_t j = 0; j < inputs; ++j) {
      float f;
      std::memcpy(&f, row + j * sizeof f, sizeof f);
      // Clamped by its bits, which compilers vectorise, and rounded by a sum: between 2^23 and 2^24
      // floats are integers.
      const auto product = std::bit_cast<int32_t>(f * scale);
      const int32_t most = std::min(product & INT32_MAX, std::bit_cast<int32_t>(127.0f));
      const auto clamped = std::bit_cast<float>(most | (product & INT32_MIN));
      to[j] = static_cast<uint8_t>(std::bit_cast<uint32_t>(clamped + 0x1.8p23f) + 128);
    }
  }
}

// Returns the field of a key, or the end of kFields for a note.
const Field* field_of(std::string_view key) { return std::ranges::find(kFields, key, &Field::key); }

ContainerWriter file_of(const EncoderInfo& info, Bytes network,
                        const std::vector<Codebook>& codebooks) {
  SectionWriter texts;
  for (const Field& field : kFields) {
    texts.text(std::string(field.key));
    texts.text(info.*field.text);
  }
  for (const auto& [key, note] : info.notes) {
    texts.text(key);
    texts.text(note);
  }
  ContainerWriter file(FileKind::encoder);
  file.add(section::kInfo, texts.bytes());
  file.add(section::kNetwork, network);
  if (codebooks.empty()) return file;
  SectionWriter out;
  for (const auto& [width, words] : codebooks) {
    out.value(static_cast<uint32_t>(width));
    out.value(static_cast<uint32_t>(words.size() / (Codebook::kWords * width)));
    out.values(words.data(), words.size());
  }
  file.add(section::kCodebooks, out.bytes());
  return file;
}

}  // namespace

struct Encoder::Packed {
  std::optional<BitLayer> first;  // if inputs are bits
  std::vector<DenseLayer> dense;  // all others
  size_t widest = 0;

  Packed(const std::vector<Layer>& layers, InputKind input) {
    for (const Layer& layer : layers) {
      const bool last = &layer == &layers.back();
      if (input == InputKind::bits && &layer == &layers.front()) {
        widest = first.emplace(layer, last).outputs();
      } else {
        const DenseLayer& packed = dense.emplace_back(layer, last);
        widest = std::max({widest, packed.inputs(), packed.outputs()});
      }
    }
  }
};

Encoder::Encoder(EncoderInfo info, std::vector<Layer> layers, std::vector<size_t> dims, float scale,
                 std::vector<Codebook> codebooks, EncoderInput input)
    : info_(std::move(info)),
      layers_(std::move(layers)),
      dims_(std::move(dims)),
      scale_(scale),
      codebooks_(std::move(codebooks)),
      input_(input) {
  const auto check = [](bool ok, const auto&... what) { require(ok, "encoder: ", what...); };
  check(!info_.name.empty() && !info_.descriptor.empty(), "name and descriptor must be given");
  for (const Field& field : kFields) {
    check(is_utf8(info_.*field.text), "its ", field.key, " is not UTF-8");
  }
  for (const auto& [key, note] : info_.notes) {
    check(is_utf8(key) && is_utf8(note), "its notes are not UTF-8");
    check(field_of(key) == std::end(kFields), "no note may have the key '", key, "'");
  }
  check(!layers_.empty() && layers_.size() <= kMaxLayers, "it has ", layers_.size(),
        " layers, 1 to ", kMaxLayers, " are allowed");
  check_input(input_, inputs());
  for (size_t l = 0; l < layers_.size(); ++l) {
    check_layer(layers_[l], l == 0 ? inputs() : layers_[l - 1].outputs, l,
                l == 0 && input_.kind == InputKind::bits ? 1 : 255);
  }
  check(!dims_.empty() && dims_.front() != 0 && dims_.back() == layers_.back().outputs &&
            std::ranges::adjacent_find(dims_, std::greater_equal<>()) == dims_.end(),
        "dims must ascend and end with the number of outputs");
  check(dim() <= kMaxDim, "a code has at most 256 dimensions");
  check(scale_ > 0 && std::isfinite(scale_), "scale must be positive");
  check_codebooks(codebooks_, dim());
  identity_ = sha256(network_bytes());
  packed_ = std::make_shared<const Packed>(layers_, input_.kind);
}

size_t Encoder::bytes() const {
  if (input_.kind == InputKind::bits) return inputs() / 8;
  return input_.kind == InputKind::uint8 ? inputs() : inputs() * sizeof(float);
}

size_t Encoder::multiply_adds() const {
  size_t sum = 0;
  for (const Layer& layer : layers_) sum += layer.inputs * layer.outputs;
  return sum;
}

Matrix<int8_t> Encoder::encode(Descriptors descriptors, size_t dimensions, int threads) const {
  Matrix<int8_t> codes(descriptors.rows, dimensions == 0 ? dim() : dimensions);
  encode(descriptors, codes.view(), threads);
  return codes;
}

void Encoder::check(Descriptors descriptors, int threads) const {
  // OpenCV's descriptors of an image without keypoints have neither rows nor columns.
  const bool empty = descriptors.rows == 0 && descriptors.columns == 0;
  require(descriptors.columns == bytes() || empty, "descriptors have ", descriptors.columns,
          " bytes, encoder '", info_.name, "' takes ", bytes());
  if (input_.kind == InputKind::bits) return;
  const auto fault = [&](size_t i) { return fault_of(input_, descriptors.row(i), bytes()); };
  std::atomic<size_t> bad = descriptors.rows;  // the first of them
  parallel_for(threads, descriptors.rows, kGrain, [&](size_t i, size_t end) {
    while (i < end && fault(i) == nullptr) ++i;
    size_t known = bad;
    while (i < end && i < known && !bad.compare_exchange_weak(known, i)) continue;
  });
  if (bad == descriptors.rows) return;
  invalid("descriptors: row ", bad, " ", fault(bad), ": leave such rows out");
}

void Encoder::encode(Descriptors descriptors, MatrixView<int8_t> codes, int threads) const {
  check(descriptors, threads);
  require(codes.rows == descriptors.rows, "codes must have as many rows as descriptors");
  require(codes.columns >= 1 && codes.columns <= dim(), "encoder '", info_.name, "' gives 1 to ",
          dim(), " dimensions, not ", codes.columns);
  const kernels::Kernels& kernel = kernels::active();
  const Packed& network = *packed_;
  const size_t depth = layers_.size(), width = network.widest;

  parallel_for(threads, descriptors.rows, kGrain, [&](size_t first, size_t last) {
    // Batches of equal size, as a small last one would cost as much as a large one.
    const size_t batches = (last - first + kBatch - 1) / kBatch;
    const size_t limit = std::min(kBatch, last - first);
    const auto room = std::make_unique_for_overwrite<uint8_t[]>(2 * limit * width);
    for (size_t b = 0; b < batches; ++b) {
      const size_t begin = first + (last - first) * b / batches;
      const size_t n = first + (last - first) * (b + 1) / batches - begin;
      MatrixView<uint8_t> x{room.get(), n, width}, next{room.get() + limit * width, n, width};
      const auto outputs = [&](size_t l) {
        return l + 1 < depth ? layers_[l].outputs : codes.columns;
      };
      const Descriptors batch{descriptors.row(begin), n, bytes()};
      size_t l = 0;
      if (network.first) {
        network.first->run(kernel, batch, outputs(l++), x);
      } else {
        write_bytes(input_, batch, inputs(), network.dense.front().inputs(), x);
      }
      for (const DenseLayer& layer : network.dense) {
        layer.run(kernel, x, outputs(l++), next);
        std::swap(x, next);
      }
      for (size_t i = 0; i < n; ++i) {
        std::memcpy(codes.row(begin + i), x.row(i), codes.columns);
      }
    }
  });
}

// Returns all that decides the codes; its SHA-256 is the encoder's identity.
std::vector<std::byte> Encoder::network_bytes() const {
  SectionWriter out;
  out.value(scale_);
  out.value(static_cast<uint32_t>(dims_.size()));
  for (const size_t d : dims_) out.value(static_cast<uint32_t>(d));
  out.value(static_cast<uint32_t>(layers_.size()));
  for (const Layer& layer : layers_) {
    out.value(static_cast<uint32_t>(layer.inputs));
    out.value(static_cast<uint32_t>(layer.outputs));
    out.value(static_cast<uint32_t>(layer.shift));
    out.values(layer.bias.data(), layer.bias.size());
    out.values(layer.multipliers.data(), layer.multipliers.size());
    out.values(layer.table.data(), layer.table.size());
    out.values(layer.weights.data(), layer.weights.size());
  }
  if (input_.kind != InputKind::bits) out.value(input_);
  return out.bytes();
}

std::vector<std::byte> Encoder::serialize() const {
  return file_of(info_, network_bytes(), codebooks_).serialize();
}

void Encoder::save(const std::filesystem::path& path) const {
  write_guarded(file_of(info_, network_bytes(), codebooks_), path);
}

Encoder Encoder::load(const std::filesystem::path& path) {
  return parse(MappedFile(path).bytes(), path.string());
}

Encoder Encoder::parse(std::span<const std::byte> bytes, const std::string& name) {
  const ContainerReader file(bytes, name);
  file.expect(FileKind::encoder);

  EncoderInfo info;
  for (SectionReader in(file, section::kInfo); !in.empty();) {
    std::string key = in.text();
    std::string value = in.text();
    if (const Field* field = field_of(key); field != std::end(kFields)) {
      info.*field->text = std::move(value);
    } else {
      info.notes.emplace_back(std::move(key), std::move(value));
    }
  }

  SectionReader in(file, section::kNetwork);
  const auto scale = in.value<float>();
  const auto count = in.value<uint32_t>();
  file.require(count <= kMaxDim, "it has too many dims");
  std::vector<size_t> dims;
  for (const uint32_t d : in.values<uint32_t>(count)) dims.push_back(d);
  const auto depth = in.value<uint32_t>();
  file.require(depth <= kMaxLayers, "it has too many layers");
  std::vector<Layer> layers(depth);
  for (Layer& layer : layers) {
    layer.inputs = in.value<uint32_t>();
    layer.outputs = in.value<uint32_t>();
    if (layer.inputs > kMaxWidth || layer.outputs > kMaxWidth) file.fail("a layer is too wide");
    layer.shift = static_cast<int>(std::min<uint32_t>(in.value<uint32_t>(), 63));
    layer.bias = in.values<int32_t>(layer.outputs);
    layer.multipliers = in.values<int32_t>(layer.outputs);
    std::ranges::copy(in.values<uint8_t>(layer.table.size()), layer.table.begin());
    layer.weights = in.values<int8_t>(layer.inputs * layer.outputs);
  }
  EncoderInput input;
  if (!in.empty()) {
    input = in.value<EncoderInput>();
    file.require(input.kind == InputKind::uint8 || input.kind == InputKind::float32,
                 "its kind of input is unknown");
  }
  in.finish();
  std::vector<Codebook> codebooks;
  if (file.has(section::kCodebooks)) {
    for (SectionReader words(file, section::kCodebooks); !words.empty();) {
      const size_t width = words.value<uint32_t>(), subspaces = words.value<uint32_t>();
      file.require(width <= kMaxWordWidth && subspaces <= kMaxDim, "a codebook is too large");
      codebooks.push_back({width, words.values<int8_t>(subspaces * Codebook::kWords * width)});
    }
  }
  try {
    return Encoder(std::move(info), std::move(layers), std::move(dims), scale, std::move(codebooks),
                   input);
  } catch (const std::invalid_argument& error) {
    file.fail(error.what());
  }
}

}  // namespace protomark
