// Which instruction set the kernels use.
#pragma once

namespace protomark {

// "avx512", "avx2", "neon", "portable", ...: the best that this CPU runs, or the one that the
// environment variable PROTOMARK_ISA names. Throws std::invalid_argument where that is unknown or
// does not run here. All give the same bytes.
const char* instruction_set();

}  // namespace protomark
