#include "map/map_sections.h"

#include <chrono>
#include <cmath>

#include "file/journal.h"
#include "file/sections.h"
#include "protomark/map_file.h"
#include "search/coarse_quantizer.h"

namespace protomark {
namespace {

constexpr char kCreated[] = "created";

// Times have exactly one form, so that texts are in the order of times.
bool is_utc_time(std::string_view text) {
  constexpr std::string_view kForm = "0000-00-00T00:00:00Z";
  if (!std::ranges::equal(text, kForm, [](char c, char form) {
        return form == '0' ? c >= '0' && c <= '9' : c == form;
      })) {
    return false;
  }
  const auto number = [&](size_t at, size_t digits) {
    int value = 0;
    for (const char c : text.substr(at, digits)) value = 10 * value + (c - '0');
    return value;
  };
  const std::chrono::year_month_day day{std::chrono::year(number(0, 4)),
                                        std::chrono::month(static_cast<unsigned>(number(5, 2))),
                                        std::chrono::day(static_cast<unsigned>(number(8, 2)))};
  return day.ok() && number(11, 2) < 24 && number(14, 2) < 60 && number(17, 2) < 60;
}

MapKind kind_of(const ContainerReader& file) {
  const bool learning = file.kind() == FileKind::learning_map;
  file.require(learning || file.kind() == FileKind::sealed_map, "it holds ", describe(file.kind()),
               ", not a map");
  return learning ? MapKind::learning : MapKind::sealed;
}

}  // namespace

void check_metadata(const Metadata& metadata) {
  require(metadata.size() <= kMaxMetadata, "metadata: a map has at most ", kMaxMetadata,
          " names, not ", metadata.size());
  for (const auto& [name, text] : metadata) {
    require(is_utf8(name) && is_utf8(text), "metadata: names and texts must be UTF-8");
    require(!name.empty() && name.size() <= kMaxMetadataName, "metadata: a name has 1 to ",
            kMaxMetadataName, " bytes, not ", name.size());
    require(text.size() <= kMaxMetadataText, "metadata: '", name, "' has ", text.size(),
            " bytes, at most ", kMaxMetadataText, " are allowed");
    require(name != kCreated || is_utc_time(text),
            "metadata: 'created' must be a time in UTC such as 2026-11-23T03:39:41Z, not '", text,
            "'");
  }
}

Metadata merged(const Metadata& into, const Metadata& other) {
  Metadata result = into;
  result.insert(other.begin(), other.end());
  if (const auto created = other.find(kCreated); created != other.end()) {
    result[kCreated] = std::min(result[kCreated], created->second);
  }
  check_metadata(result);
  return result;
}

void add_metadata(ContainerWriter& file, const Metadata& metadata) {
  if (metadata.empty()) return;
  SectionWriter out;
  for (const auto& [name, text] : metadata) {
    out.text(name);
    out.text(text);
  }
  file.add(section::kMetadata, out.bytes());
}

Metadata read_metadata(const ContainerReader& file) {
  Metadata result;
  if (!file.has(section::kMetadata)) return result;
  for (SectionReader in(file, section::kMetadata); !in.empty();) {
    std::string name = in.text();
    file.require(result.empty() || name > result.rbegin()->first,
                 "the names of its metadata do not ascend");
    result.emplace_hint(result.end(), std::move(name), in.text());
    if (result.size() > kMaxMetadata) break;
  }
  try {
    check_metadata(result);
  } catch (const std::invalid_argument& error) {
    file.fail(error.what());
  }
  return result;
}

MapShape read_shape(const ContainerReader& file, const Encoder& encoder) {
  const auto shape = read_value<MapShape>(file, section::kShape);
  file.require(shape.landmarks <= UINT32_MAX, "it claims more landmarks than a map can hold");
  file.require(shape.dim >= 1 && shape.dim <= encoder.dim(),
               "its dimension does not fit its encoder");
  file.require(std::ranges::all_of(shape.origin, [](double x) { return std::isfinite(x); }),
               "its origin is not finite");
  return shape;
}

std::shared_ptr<const Encoder> read_encoder(const ContainerReader& file) {
  return std::make_shared<const Encoder>(
      Encoder::parse(file.read(section::kEncoder), file.name() + ": encoder"));
}

Matrix<int8_t> read_centroids(const ContainerReader& file, size_t dim) {
  if (!file.has(section::kCentroids)) return {};
  const size_t size = file.map(section::kCentroids).size(), lists = size / dim;
  file.require_size(lists >= 1 && lists <= CoarseQuantizer::kMaxLists && size % dim == 0,
                    section::kCentroids);
  Matrix<int8_t> centroids(lists, dim);
  centroids.data = read_section<int8_t>(file, section::kCentroids);
  file.require(std::ranges::find(centroids.data, -128) == centroids.data.end(),
               "its centroids are impossible");
  return centroids;
}

void check_ids(const ContainerReader& file, std::span<const int64_t> ids) {
  file.require(ids.empty() || ids.front() >= 0, "it has a negative landmark id");
  file.require(std::ranges::adjacent_find(ids, std::greater_equal<>()) == ids.end(),
               "its landmark ids do not ascend");
}

MapKind map_kind(const std::filesystem::path& path) {
  return kind_of(ContainerReader(MappedFile(path).bytes(), path.string()));
}

std::shared_ptr<const Encoder> map_encoder(const std::filesystem::path& path) {
  const MappedFile mapped(path);
  const ContainerReader file(mapped.bytes(), path.string());
  kind_of(file);
  return read_encoder(file);
}

void expect_encoder(const Encoder& encoder, const Encoder& expected, const std::string& map) {
  if (encoder.identity() == expected.identity()) return;
  const auto describe = [](const Encoder& e) {
    return "'" + e.info().name + "' (identity " + e.identity().substr(0, 12) + ")";
  };
  invalid(map, ": it was made with encoder ", describe(encoder), ", not with ", describe(expected),
          ": use the map's encoder, or build the map with the other");
}

void expect_descriptor(const Encoder& encoder, const std::string& descriptor,
                       const std::string& map) {
  if (encoder.info().descriptor == descriptor) return;
  invalid(map, ": it is a map of ", encoder.info().descriptor, " descriptors, not of ", descriptor);
}

std::vector<std::pair<std::string, size_t>> file_sections(const std::filesystem::path& path) {
  return ContainerReader(MappedFile(path).bytes(), path.string()).sections();
}

void verify_file(const std::filesystem::path& path) {
  const JournaledFile both(path);
  both.file->verify();
  both.journal.commits(both.file->identity());
}

std::optional<FileJournal> file_journal(const std::filesystem::path& path) {
  const JournaledFile both(path);
  const JournalContent& journal = both.journal;
  if (journal.size() == 0) return std::nullopt;
  return FileJournal{journal.commits(both.file->identity()).size(), journal.size(),
                     journal.size() - journal.end()};
}

}  // namespace protomark
