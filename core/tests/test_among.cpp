// Search among some landmarks against search in a map of these alone.
#include <algorithm>

#include "check.h"
#include "protomark/prototype_map.h"
#include "protomark/sealed_map.h"
#include "random.h"
#include "sealing.h"

using namespace protomark;

namespace {
