#include "protomark/protomark.h"

#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <iterator>
#include <memory>

#include "base/text.h"
#include "check.h"
#include "file/container.h"
#include "file/sections.h"
#include "map/map_sections.h"
#include "random.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

std::shared_ptr<const Encoder> encoder(std::uint32_t seed = 1, const char* descriptor = "test") {
  test::Random random(seed);
  return std::make_shared<const Encoder>(
      Encoder({"tiny", descriptor, "", "", {}}, {test::random_layer(random, 64, 12)}, {12}, 1));
}

std::vector<char> bytes_of(const fs::path& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

bool refused(const Metadata& metadata, const std::string& message) {
  PrototypeMap map(encoder());
  const bool thrown =
      check::throws<std::invalid_argument>([&] { map.set_metadata(metadata); }, message);
  return thrown && map.metadata().empty();
}

void test_utf8() {
  for (const char* good :
       {"", "metres", "\x7f", "\xc2\x80", "\xdf\xbf", "\xe0\xa0\x80", "\xed\x9f\xbf",
        "\xee\x80\x80", "\xef\xbf\xbf", "\xf0\x90\x80\x80", "\xf4\x8f\xbf\xbf", "Z\xc3\xbcrich"}) {
    CHECK(is_utf8(good));
  }
  for (const char* bad : {"\x80", "\xbf", "\xc0\x80", "\xc1\xbf", "\xc2", "\xc2\x41",
                          "\xe0\x9f\xbf", "\xe2\x82", "\xed\xa0\x80", "\xf0\x8f\xbf\xbf",
                          "\xf0\x90\x80", "\xf4\x90\x80\x80", "\xf5\x80\x80\x80", "\xff"}) {
    CHECK(!is_utf8(bad));
  }
  CHECK(is_utf8(std::string("a\0b", 3)));
}

void test_limits() {
  Metadata most;
  for (std::size_t i = 0; i < kMaxMetadata; ++i) most[std::to_string(i)] = "";
  most["0"] = std::string(kMaxMetadataText, 'x');
  most.erase("1");
  most[std::string(kMaxMetadataName, 'n')] = "";
  check_metadata(most);
  most["one more"] = "";
  CHECK(refused(most, "at most 256 names, not 257"));
  CHECK(refused({{"", "x"}}, "a name has 1 to 128 bytes, not 0"));
  CHECK(refused({{std::string(kMaxMetadataName + 1, 'n'), ""}}, "a name has 1 to 128 bytes"));
  CHECK(refused({{"x", std::string(kMaxMetadataText + 1, 'x')}}, "'x' has 65537 bytes"));
  CHECK(refused({{"\xff", ""}}, "must be UTF-8"));
  CHECK(refused({{"x", "\xff"}}, "must be UTF-8"));
  for (const char* time : {"1970-01-01T00:00:00Z", "2024-02-29T23:59:59Z"}) {
    check_metadata({{"created", time}});
  }
  for (const char* time :
       {"", "now", "2026-11-23", "2026-11-23T03:39:41", "2026-11-23T03:39:41+00:00",
        "2026-11-23 03:39:41Z", "2023-02-29T00:00:00Z", "2026-13-01T00:00:00Z",
        "2026-00-01T00:00:00Z", "2026-01-00T00:00:00Z", "2026-01-01T24:00:00Z",
        "2026-01-01T00:60:00Z", "2026-01-01T00:00:60Z", "2026-11-23T03:39:41Z "}) {
    CHECK(refused({{"created", time}}, "must be a time in UTC"));
  }
}

// Files have the metadata of the map, and no section without any.
void test_files(const fs::path& path) {
  PrototypeMap map(encoder());
  const std::int64_t id = 3;
  const std::vector<std::int8_t> code(12, 5);
  map.add_codes(std::span(&id, 1), {code.data(), 1, 12});
  map.save(path);
  const auto silent = bytes_of(path);
  const Metadata metadata{{"frame", "ENU, m\xc3\xa8tres"},
                          {"created", "2026-11-23T03:39:41Z"},
                          {"empty", ""},
                          {"zero", std::string("a\0b", 3)}};
  map.set_metadata(metadata);
  map.save(path);
  verify_file(path);
  const PrototypeMap read = PrototypeMap::load(path);
  CHECK(read.metadata() == metadata);
  const auto talking = bytes_of(path);
  read.save(path);
  CHECK(bytes_of(path) == talking);
  read.seal(path);
  CHECK(SealedMap(path).metadata() == metadata);
  map.set_metadata({});
  map.save(path);
  CHECK(bytes_of(path) == silent);
  map.seal(path);
  CHECK(SealedMap(path).metadata().empty());
}

void test_update() {
  PrototypeMap here(encoder()), there(encoder());
  here.set_metadata({{"frame", "ENU"}, {"created", "2026-02-01T00:00:00Z"}, {"a", "here"}});
  there.set_metadata({{"frame", "ECEF"}, {"created", "2026-01-31T00:00:00Z"}, {"b", "there"}});
  here.merge_map(there);
  CHECK(here.metadata() ==
        Metadata{
            {"frame", "ENU"}, {"created", "2026-01-31T00:00:00Z"}, {"a", "here"}, {"b", "there"}});
  PrototypeMap later(encoder()), silent(encoder());
  later.set_metadata({{"created", "2027-01-01T00:00:00Z"}});
  here.merge_map(later);
  CHECK(here.metadata().at("created") == "2026-01-31T00:00:00Z");
  silent.merge_map(later);
  CHECK(silent.metadata() == later.metadata());
  later.merge_map(PrototypeMap(encoder()));
  CHECK(silent.metadata() == later.metadata());

  // Together too many: nothing is changed.
  Metadata many;
  for (std::size_t i = 0; i < kMaxMetadata; ++i) many[std::to_string(i)] = "";
  PrototypeMap full(encoder());
  full.set_metadata(many);
  const std::int64_t id = 3;
  const std::vector<std::int8_t> code(12, 5);
  here.add_codes(std::span(&id, 1), {code.data(), 1, 12});
  CHECK(check::throws<std::invalid_argument>([&] { full.merge_map(here); }, "at most 256 names"));
  CHECK(full.size() == 0 && full.metadata() == many);
}

// A file of an empty map with these bytes as its section `metadata`.
Metadata parsed(const std::vector<std::byte>& section) {
  ContainerWriter file(FileKind::learning_map);
  const auto tiny = encoder();
  file.add(section::kEncoder, tiny->serialize());
  add_value(file, section::kShape, MapShape{0, 12, {}});
  file.add(section::kMetadata, section);
  for (const char* name : {section::kCounts, section::kSpareBits, section::kSums}) {
    file.add(name, std::vector<std::byte>());
  }
  return PrototypeMap::parse(file.serialize(), "input").metadata();
}

void test_broken_files() {
  const auto pairs = [](std::initializer_list<std::pair<std::string, std::string>> texts) {
    SectionWriter out;
    for (const auto& [name, text] : texts) {
      out.text(name);
      out.text(text);
    }
    return out.bytes();
  };
  const auto broken = [](const std::vector<std::byte>& section, const std::string& message) {
    return check::throws<FileError>([&] { parsed(section); }, "input: " + message);
  };
  CHECK(parsed(pairs({{"a", "1"}, {"b", "2"}})) == Metadata{{"a", "1"}, {"b", "2"}});
  CHECK(parsed({}).empty());
  CHECK(broken(pairs({{"b", "1"}, {"a", "2"}}), "the names of its metadata do not ascend"));
  CHECK(broken(pairs({{"a", "1"}, {"a", "2"}}), "the names of its metadata do not ascend"));
  CHECK(broken(pairs({{"a", "\xff"}}), "its section 'metadata' has a text that is not UTF-8"));
  CHECK(broken(pairs({{"", "1"}}), "metadata: a name has 1 to 128 bytes"));
  CHECK(broken(pairs({{"created", "today"}}), "metadata: 'created' must be a time in UTC"));
  SectionWriter many;
  for (std::size_t i = 0; i <= kMaxMetadata; ++i) {
    many.text(std::to_string(1000 + i));
    many.text("");
  }
  CHECK(broken(many.bytes(), "metadata: a map has at most 256 names"));
  auto cut = pairs({{"a", "1"}});
  cut.pop_back();
  CHECK(broken(cut, "its section 'metadata' is shorter than it should be"));
  SectionWriter huge;
  huge.value(std::uint32_t{0xffffffff});
  CHECK(broken(huge.bytes(), "its section 'metadata' is shorter than it should be"));
}

void test_expectations() {
  const auto own = encoder(), same = encoder(), other = encoder(2);
  expect_encoder(*own, *same, "m.pmk");
  CHECK(check::throws<std::invalid_argument>(
      [&] { expect_encoder(*own, *other, "m.pmk"); },
      "m.pmk: it was made with encoder 'tiny' (identity " + own->identity().substr(0, 12) + ")"));
  expect_descriptor(*own, "test", "m.pmk");
  CHECK(check::throws<std::invalid_argument>([&] { expect_descriptor(*own, "orb", "m.pmk"); },
                                             "m.pmk: it is a map of test descriptors, not of orb"));
  CHECK(check::throws<std::invalid_argument>([&] { encoder(1, "\xff"); }, "not UTF-8"));
}

}  // namespace

int main() {
  const fs::path path =
      fs::temp_directory_path() / ("protomark_metadata_" + std::to_string(::getpid()));
  test_utf8();
  test_limits();
  test_files(path);
  test_update();
  test_broken_files();
  test_expectations();
  fs::remove(path);
  return check::result();
}
