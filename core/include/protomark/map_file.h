// What a file holds, and whether it is whole.
#pragma once

#include <filesystem>
#include <memory>
#include <utility>

#include "protomark/encoder.h"
#include "protomark/types.h"

namespace protomark {

enum class MapKind { learning, sealed };

// Reads the kind of a map file from its header. Throws FileError if it is not a map.
PROTOMARK_API MapKind map_kind(const std::filesystem::path& path);

// Reads only the encoder of a map file. Throws FileError.
PROTOMARK_API std::shared_ptr<const Encoder> map_encoder(const std::filesystem::path& path);

// Throw std::invalid_argument unless a map's `encoder` has the identity of `expected`, or takes
// descriptors of this name ("freak"); errors begin with `map`.
PROTOMARK_API void expect_encoder(const Encoder& encoder, const Encoder& expected,
                                  const std::string& map);
PROTOMARK_API void expect_descriptor(const Encoder& encoder, const std::string& descriptor,
                                     const std::string& map);

// Returns the names and sizes in bytes of a file's sections. Throws FileError.
PROTOMARK_API std::vector<std::pair<std::string, size_t>> file_sections(
    const std::filesystem::path& path);

// Checks every checksum of a model or map file, and of the journal beside it. Throws FileError.
PROTOMARK_API void verify_file(const std::filesystem::path& path);

struct FileJournal {
  size_t commits;     // since the map file was written
  size_t bytes;       // of the whole journal
  size_t torn_bytes;  // at its end, of a commit that was interrupted
};

// Describes the journal beside a map file (PrototypeMap::commit). Throws FileError.
PROTOMARK_API std::optional<FileJournal> file_journal(const std::filesystem::path& path);

}  // namespace protomark
