// AVX2: x86 since Haswell and Zen.
#include <immintrin.h>

#include "kernels.h"

namespace protomark::kernels {

const Kernels avx2 = {.name = "avx2"};

}  // namespace protomark::kernels
