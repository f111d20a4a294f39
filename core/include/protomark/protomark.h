// All of Protomark.
#pragma once

#include "protomark/encoder.h"        // IWYU pragma: export
#include "protomark/hamming.h"        // IWYU pragma: export
#include "protomark/map_file.h"       // IWYU pragma: export
#include "protomark/matching.h"       // IWYU pragma: export
#include "protomark/prototype_map.h"  // IWYU pragma: export
#include "protomark/sealed_map.h"     // IWYU pragma: export
#include "protomark/search.h"         // IWYU pragma: export
#include "protomark/types.h"          // IWYU pragma: export
