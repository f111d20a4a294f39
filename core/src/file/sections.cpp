#include "file/sections.h"

#include <cstring>

#include "base/utf8.h"

namespace protomark {

std::string SectionReader::text() {
  const auto n = value<std::uint32_t>();
  check(n, 1);
  std::string result(n, '\0');
  take(result.data(), n);
  if (!is_utf8(result)) file_->fail("its section '" + section_ + "' has a text that is not UTF-8");
  return result;
}

void SectionReader::finish() const {
  if (!rest_.empty()) file_->fail("its section '" + section_ + "' is longer than it should be");
}

void SectionReader::check(std::size_t n, std::size_t size) const {
  if (n <= rest_.size() / size) return;
  file_->fail("its section '" + section_ + "' is shorter than it should be");
}

void SectionReader::take(void* to, std::size_t n) {
  if (n > 0) std::memcpy(to, rest_.data(), n);
  rest_ = rest_.subspan(n);
}

}  // namespace protomark
