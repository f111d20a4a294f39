#include "search/driver.h"

#include <stdexcept>

namespace protomark {

void write_answer(const Neighbours& nearest, std::span<const std::int32_t> norms,
                  std::optional<std::int32_t> max_distance, std::optional<double> ratio,
                  MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances) {
  const std::int32_t limit = max_distance.value_or(INT32_MAX);
  for (std::size_t q = 0; q < nearest.queries(); ++q) {
    const std::int32_t norm = norms.empty() ? 0 : norms[q];
    const std::int64_t* found = nearest.ids(q);
    const std::int32_t* found_at = nearest.distances(q);
    const bool accepted = !ratio || nearest.k() < 2 || found[1] < 0 ||
                          found_at[0] + norm < *ratio * *ratio * (found_at[1] + norm);
    for (std::size_t j = 0; j < ids.columns; ++j) {
      const bool reported = accepted && found[j] >= 0 && found_at[j] + norm <= limit;
      ids.row(q)[j] = reported ? found[j] : -1;
      distances.row(q)[j] = reported ? found_at[j] + norm : INT32_MAX;
    }
  }
}

void check_answer(std::size_t queries, std::optional<std::int32_t> max_distance,
                  const MatrixView<std::int64_t>& ids, const MatrixView<std::int32_t>& distances) {
  if (ids.columns == 0) throw std::invalid_argument("k must be at least 1");
  if (ids.rows != queries || distances.rows != queries || ids.columns != distances.columns) {
    throw std::invalid_argument("ids and distances must be queries x k");
  }
  if (max_distance && *max_distance < 0) {
    throw std::invalid_argument("max_distance must not be negative");
  }
}

}  // namespace protomark
