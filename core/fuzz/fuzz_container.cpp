#include "aligned_copy.h"
#include "expect.h"
#include "file/container.h"
#include "protomark/protomark.h"

using namespace protomark;

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const fuzz::AlignedCopy input(data, size);
  try {
    const ContainerReader file(input.bytes(), "input");
    bool whole = true;
    for (const auto& [name, bytes] : file.sections()) {
      EXPECT(file.map(name).size() == bytes);
      try {
        EXPECT(file.read(name).size() == bytes);
      } catch (const FileError&) {
        whole = false;
      }
    }
    try {
      file.verify();
      EXPECT(whole);
    } catch (const FileError&) {
      EXPECT(!whole);
    }
  } catch (const FileError&) {
  }
  return 0;
}
