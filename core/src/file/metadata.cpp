#include "protomark/metadata.h"

#include <algorithm>
#include <array>
#include <chrono>
#include <stdexcept>
#include <string_view>

#include "base/utf8.h"
#include "file/sections.h"

namespace protomark {
namespace {

constexpr char kCreated[] = "created";

[[noreturn]] void invalid(const std::string& what) {
  throw std::invalid_argument("metadata: " + what);
}

// Of exactly one form, so that the order of texts is that of times.
bool is_utc_time(std::string_view text) {
  constexpr std::string_view kForm = "0000-00-00T00:00:00Z";
  const auto fits = [](char c, char form) {
    return form == '0' ? c >= '0' && c <= '9' : c == form;
  };
  if (!std::equal(text.begin(), text.end(), kForm.begin(), kForm.end(), fits)) return false;
  const auto number = [&](std::size_t at, std::size_t digits) {
    int value = 0;
    for (const char c : text.substr(at, digits)) value = 10 * value + (c - '0');
    return value;
  };
  const std::chrono::year_month_day day{std::chrono::year(number(0, 4)),
                                        std::chrono::month(static_cast<unsigned>(number(5, 2))),
                                        std::chrono::day(static_cast<unsigned>(number(8, 2)))};
  return day.ok() && number(11, 2) < 24 && number(14, 2) < 60 && number(17, 2) < 60;
}

}  // namespace

void check_metadata(const Metadata& metadata) {
  if (metadata.size() > kMaxMetadata) {
    invalid("a map has at most " + std::to_string(kMaxMetadata) + " names, not " +
            std::to_string(metadata.size()));
  }
  for (const auto& [name, text] : metadata) {
    if (!is_utf8(name) || !is_utf8(text)) invalid("names and texts must be UTF-8");
    if (name.empty() || name.size() > kMaxMetadataName) {
      invalid("a name has 1 to " + std::to_string(kMaxMetadataName) + " bytes, not " +
              std::to_string(name.size()));
    }
    if (text.size() > kMaxMetadataText) {
      invalid("'" + name + "' has " + std::to_string(text.size()) + " bytes, at most " +
              std::to_string(kMaxMetadataText) + " are allowed");
    }
    if (name == kCreated && !is_utc_time(text)) {
      invalid("'created' must be a time in UTC such as 2026-11-23T03:39:41Z, not '" + text + "'");
    }
  }
}

Metadata joined(const Metadata& own, const Metadata& other) {
  Metadata result = own;
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
  file.add(section::kMetadata, out.take());
}

Metadata read_metadata(const ContainerReader& file) {
  Metadata result;
  if (!file.map_if_there(section::kMetadata)) return result;
  for (SectionReader in(file, section::kMetadata); !in.empty();) {
    std::string name = in.text();
    if (!result.empty() && name <= result.rbegin()->first) {
      file.fail("the names of its metadata do not ascend");
    }
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

}  // namespace protomark
