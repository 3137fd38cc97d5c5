// What a view would change by without each row, gathered while its gradients are: a pixel is linear in the alpha of each
// of its splats, so the change is exactly -alpha dC/dalpha = (light behind) alpha / (1 - alpha) - w c, and backward comes
// by all of that (leave_one_out.hpp computes the same from the front, in a pass of its own).
#pragma once
#include "pixel.hpp"

namespace SPLAT_VARIANT {

// The light from behind the splat at hand, and how much a squared change counts, of a tile's pixels.
template <class T>
struct TileChanges {
  alignas(64) T behind[3][PIXELS], weights[COUNTINGS][PIXELS];
};

// Sums over the rows of a tile, per column. WAYS: how many countings weigh any pixel of the tile; the others are 0.
template <class T>
struct ChangeColumns {
  Lanes<T> weight{}, largest{}, squared[COUNTINGS]{};
};

// The same number, behind which the compiler sees no formula: what is shared with the formulas of gradients would let it
// regroup these, and their bits would depend on whether changes are gathered.
template <class V>
inline V apart(const V& value) {
#if defined(__clang__)
  return __arithmetic_fence(value);
#else
  return __builtin_assoc_barrier(value);
#endif
}

template <class T, int WAYS>
inline void accumulate_change(const Splat<T>& p, const Lanes<T>& weight, const Lanes<T>& through, TileChanges<T>& t,
                              int at, ChangeColumns<T>& sums) {
  Lanes<T> square{};
  for (int channel = 0; channel < 3; ++channel) {
    const Lanes<T> own = weight * p.color[channel], behind = load(t.behind[channel] + at);
    const Lanes<T> change = behind * through - own;
    store(t.behind[channel] + at, behind + own);
    sums.largest = larger(sums.largest, magnitude(change));
    square += change * change;
  }
  for (int i = 0; i < WAYS; ++i) sums.squared[i] += load(t.weights[i] + at) * square;
  sums.weight += weight;
}

template <class T>
inline T total(const Lanes<T>& values) {
  T each[LANES<T>], sum = 0;
  store(each, values);
  for (int i = 0; i < LANES<T>; ++i) sum += each[i];
  return sum;
}

template <class T>
inline T most(const Lanes<T>& values) {
  T each[LANES<T>], largest = 0;
  store(each, values);
  for (int i = 0; i < LANES<T>; ++i) largest = each[i] > largest ? each[i] : largest;
  return largest;
}

template <class T, int WAYS>
inline void add_changes(const ChangeColumns<T>& c, ChangeSlot<T>& slot) {
  const T largest = most<T>(c.largest);
  slot.weight += total<T>(c.weight), slot.largest = largest > slot.largest ? largest : slot.largest;
  for (int i = 0; i < WAYS; ++i) slot.squared[i] += total<T>(c.squared[i]);
}

// Behind the last splat there is what the background sends through all of them. Answers up to which counting any pixel
// of the tile has a weight: few tiles show all that is told apart.
template <class T>
int load_changes(TileChanges<T>& t, const View& view, int64_t x0, int64_t y0, const T* passed, const Gathered& of) {
  std::memset(static_cast<void*>(&t), 0, sizeof(t));
  const T *background = static_cast<const T*>(of.background), *weights = static_cast<const T*>(of.pixel_weights);
  int ways = 1;
  for (int64_t y = y0; y < y0 + TILE && y < view.height; ++y) {
    for (int64_t x = x0; x < x0 + TILE && x < view.width; ++x) {
      const int64_t to = (y - y0) * TILE + x - x0, from = y * view.width + x;
      for (int i = 0; i < COUNTINGS; ++i) {
        t.weights[i][to] = weights[i * view.height * view.width + from];
        if (t.weights[i][to] != 0 && i >= ways) ways = i + 1;
      }
      for (int channel = 0; background && channel < 3; ++channel)
        t.behind[channel][to] = passed[from] * background[3 * from + channel];
    }
  }
  return ways;
}

// The slots of each row, in a fixed order; 0 where it was culled.
template <class T>
void sum_changes(const Workspace<T>& ws, const View& view, int64_t rows, const Gathered& out) {
#pragma omp parallel for num_threads(view.threads) schedule(static)
  for (int64_t i = 0; i < rows; ++i) {
    double weight = 0, largest = 0, squared[COUNTINGS] = {};
    for (int32_t k = 0; k < ws.tiles[i].count; ++k) {
      const ChangeSlot<T>& slot = ws.gathered_slots[ws.tiles[i].first_slot + k];
      weight += slot.weight, largest = slot.largest > largest ? slot.largest : largest;
      for (int c = 0; c < COUNTINGS; ++c) squared[c] += slot.squared[c];
    }
    out.weight[i] = weight, out.largest[i] = largest;
    for (int c = 0; c < COUNTINGS; ++c) out.squared[COUNTINGS * i + c] = squared[c];
  }
}

}  // namespace SPLAT_VARIANT
