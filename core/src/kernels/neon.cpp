// NEON with dot products (ARMv8.2 and later): phones since 2018, Apple silicon, Graviton 2.
#include <arm_neon.h>

#include "kernels.h"

namespace protomark::kernels {

const Kernels neon = {.name = "neon"};

}  // namespace protomark::kernels
