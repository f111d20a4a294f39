// Declarations that the files of the module share.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/stl/filesystem.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>

#include <filesystem>

#include "arrays.h"

namespace protomark::python {

using Path = std::filesystem::path;
// For calls that may wait for another thread or a disk, so that others run Python meanwhile.
using ReleaseGil = nb::call_guard<nb::gil_scoped_release>;

// Runs `work` without the GIL, and returns its result.
template <typename Work>
auto without_gil(const Work& work) {
  const nb::gil_scoped_release release;
  return work();
}

// Texts by name, as a read-only mapping.
nb::object from_metadata(const Metadata& metadata);
Metadata to_metadata(nb::handle object);

void bind_encoder(nb::module_& m);
void bind_prototype_map(nb::module_& m);
void bind_sealed_map(nb::module_& m);
void bind_hamming(nb::module_& m);
void bind_matching(nb::module_& m);
void bind_files(nb::module_& m);

}  // namespace protomark::python
