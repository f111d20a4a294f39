// Numbers in the order of their keys, a piece at a time, so that the order takes few bytes.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace protomark {

// `each(take)` calls take(number) for n numbers, again each time that it is called, and key(number)
// is another one for each of them. Calls visit(std::span<const std::uint32_t>) with all of them by
// ascending key. Takes 5 bits a number, and their keys are gone through some ten times.
template <typename Each, typename Key, typename Visit>
void visit_sorted(std::size_t n, const Each& each, const Key& key, const Visit& visit) {
  using Value = decltype(key(std::uint32_t{}));
  constexpr std::size_t kPieces = 8, kLeast = 1 << 13, kSample = 1 << 10;
  const auto less = [&](std::uint32_t a, std::uint32_t b) { return key(a) < key(b); };
  const std::size_t piece = std::max(kLeast, (n + kPieces - 1) / kPieces);
  const std::size_t most = piece + piece / 4;
  std::vector<std::uint32_t> numbers;
  numbers.reserve(std::min(n, most));

  std::vector<Value> bounds;  // keys with about a piece between them
  bool sorted = true;
  if (n > most) {
    Value before{};
    std::size_t i = 0;
    each([&](std::uint32_t number) {
      const Value value = key(number);
      sorted = sorted && (i == 0 || before < value);
      before = value;
      if (i++ % ((n + kSample - 1) / kSample) == 0) bounds.push_back(value);
    });
    std::sort(bounds.begin(), bounds.end());
    const std::size_t step = std::max<std::size_t>(1, bounds.size() * piece / n);
    for (i = 0; (i + 1) * step < bounds.size(); ++i) bounds[i] = bounds[(i + 1) * step];
    bounds.resize(i);
  }
  if (n > most && sorted) {
    each([&](std::uint32_t number) {
      numbers.push_back(number);
      if (numbers.size() < piece) return;
      visit(std::span<const std::uint32_t>(numbers));
      numbers.clear();
    });
    if (!numbers.empty()) visit(std::span<const std::uint32_t>(numbers));
    return;
  }

  // A piece is what is above `last` and not above `end`, where there are these.
  Value last{}, end{};
  bool bounded = false;
  auto bound = bounds.begin();
  for (std::size_t seen = 0; seen < n; seen += numbers.size(), last = key(numbers.back())) {
    const bool first = seen == 0;
    while (bound != bounds.end() && !first && !(last < *bound)) ++bound;
    bounded = bound != bounds.end();
    if (bounded) end = *bound;
    numbers.clear();
    each([&](std::uint32_t number) {
      const Value value = key(number);
      if ((bounded && end < value) || (!first && !(last < value))) return;
      if (numbers.size() == most) {  // more than the sample made one expect
        const auto middle = numbers.begin() + static_cast<std::ptrdiff_t>(piece - 1);
        std::nth_element(numbers.begin(), middle, numbers.end(), less);
        bounded = true;
        end = key(*middle);
        numbers.resize(piece);
        if (end < value) return;
      }
      numbers.push_back(number);
    });
    std::sort(numbers.begin(), numbers.end(), less);
    visit(std::span<const std::uint32_t>(numbers));
  }
}

}  // namespace protomark
