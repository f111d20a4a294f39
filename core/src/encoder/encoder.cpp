#include "protomark/encoder.h"

#include <cmath>

#include "base/parallel.h"
#include "encoder/layers.h"
#include "file/journal.h"
#include "file/sections.h"

namespace protomark {
namespace {

constexpr size_t kMinBits = 64;
constexpr size_t kMaxBits = 1024;
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

void check_layer(const Layer& layer, size_t inputs, size_t index) {
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
  const int64_t largest = index == 0 ? 1 : 255;
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
  BitLayer first;
  std::vector<DenseLayer> later;
  size_t widest;

  explicit Packed(const std::vector<Layer>& layers)
      : first(layers.front(), layers.size() == 1), widest(first.outputs()) {
    for (size_t l = 1; l < layers.size(); ++l) {
      later.emplace_back(layers[l], l + 1 == layers.size());
      widest = std::max(widest, later.back().outputs());
    }
  }
};

Encoder::Encoder(EncoderInfo info, std::vector<Layer> layers, std::vector<size_t> dims, float scale,
                 std::vector<Codebook> codebooks)
    : info_(std::move(info)),
      layers_(std::move(layers)),
      dims_(std::move(dims)),
      scale_(scale),
      codebooks_(std::move(codebooks)) {
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
  const size_t bits = layers_.front().inputs;
  check(bits >= kMinBits && bits <= kMaxBits && bits % 8 == 0,
        "a descriptor has 64 to 1024 bits, a multiple of 8, not ", bits);
  for (size_t l = 0; l < layers_.size(); ++l) {
    check_layer(layers_[l], l == 0 ? bits : layers_[l - 1].outputs, l);
  }
  check(!dims_.empty() && dims_.front() != 0 && dims_.back() == layers_.back().outputs &&
            std::ranges::adjacent_find(dims_, std::greater_equal<>()) == dims_.end(),
        "dims must ascend and end with the number of outputs");
  check(dim() <= kMaxDim, "a code has at most 256 dimensions");
  check(scale_ > 0 && std::isfinite(scale_), "scale must be positive");
  check_codebooks(codebooks_, dim());
  identity_ = sha256(network_bytes());
  packed_ = std::make_shared<const Packed>(layers_);
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

void Encoder::encode(Descriptors descriptors, MatrixView<int8_t> codes, int threads) const {
  // OpenCV's descriptors of an image without keypoints have neither rows nor columns.
  const bool empty = descriptors.rows == 0 && descriptors.columns == 0;
  require(descriptors.columns == bytes() || empty, "descriptors have ", descriptors.columns,
          " bytes, encoder '", info_.name, "' takes ", bytes());
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
      network.first.run(kernel, {descriptors.row(begin), n, bytes()}, outputs(0), x);
      for (size_t l = 1; l < depth; ++l) {
        network.later[l - 1].run(kernel, x, outputs(l), next);
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
    return Encoder(std::move(info), std::move(layers), std::move(dims), scale,
                   std::move(codebooks));
  } catch (const std::invalid_argument& error) {
    file.fail(error.what());
  }
}

}  // namespace protomark
