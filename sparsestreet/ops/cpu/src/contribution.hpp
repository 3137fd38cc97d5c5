// What each row adds to a view: sum of weights, touched pixels, dominated pixels. A pass of its own, so that training
// does not pay for it.
#pragma once
#include <omp.h>

#include "pixel.hpp"
#include "tile_order.hpp"

namespace SPLAT_VARIANT {

template <class T>
struct TileCounters {
  alignas(64) T transmittance[PIXELS], product[PIXELS], best[PIXELS];
  int64_t best_pair[PIXELS];
};

// Blends a register of pixels and keeps, per pixel, the pair that weighed most so far.
template <class T, bool EXCLUSIVE>
inline void count_register(const Splat<T>& s, const TilePixels<T>& pixels, const Cuts<T>& cuts, TileCounters<T>& c,
                           int at, int64_t pair, typename Workspace<T>::Count& count) {
  const Lanes<T> transmittance = load(c.transmittance + at);
  const Lanes<T> alpha = sample(s, pixels, at, cuts).alpha;
  const Lanes<T> weight =
      transmittance * still_open<T, EXCLUSIVE>(alpha, cuts, transmittance, c.product + at);
  store(c.transmittance + at, transmittance - weight);
  for (int i = 0; i < LANES<T>; ++i) {
    count.weight += double(weight[i]), count.pixels += weight[i] > 0;
    // Strictly more: of equal weights the nearer splat keeps the pixel.
    if (weight[i] > c.best[at + i]) c.best[at + i] = weight[i], c.best_pair[at + i] = pair;
  }
}

template <class T, bool EXCLUSIVE>
void count_tile(Workspace<T>& ws, const View& view, const Cuts<T>& cuts, int64_t tile) {
  const int64_t x0 = tile % ws.tiles_x * TILE, y0 = tile / ws.tiles_x * TILE;
  const TilePixels<T> pixels(x0, y0);
  TileCounters<T> c;
  sort_tile(ws, tile);
  open_tile(c.transmittance, view, pixels), open_tile(c.product, view, pixels);
  for (int i = 0; i < PIXELS; ++i) c.best[i] = 0, c.best_pair[i] = -1;
  const T* state = EXCLUSIVE ? c.product : c.transmittance;
  const auto visit = [&](int64_t k, const Splat<T>& s) {
    typename Workspace<T>::Count count{0, 0, 0};
    for_each_register<T>(ws.masks[k], [&](int at) {
      count_register<T, EXCLUSIVE>(s, pixels, cuts, c, at, k, count);
    });
    ws.count_slots[ws.pairs[k].slot] = count;
  };
  int64_t end = for_each_pair(ws, tile, pixels, state, cuts.transmittance_min, visit);
  for (; end < ws.tile_begin[tile + 1]; ++end) ws.count_slots[ws.pairs[end].slot] = {0, 0, 0};
  for (int i = 0; i < PIXELS; ++i)
    if (c.best_pair[i] >= 0) ++ws.count_slots[ws.pairs[c.best_pair[i]].slot].dominant;
}

template <class T>
void count_contributions(Workspace<T>& ws, const View& view, int64_t rows, const Counters& out) {
  const double start = omp_get_wtime();
  const Cuts<T> cuts(view);
  ws.count_slots.reserve(ws.pair_count);
#pragma omp parallel for num_threads(view.threads) schedule(dynamic, 1)
  for (int64_t tile = 0; tile < ws.tiles_x * ws.tiles_y; ++tile) {
    if (view.exclusive_stop)
      count_tile<T, true>(ws, view, cuts, tile);
    else
      count_tile<T, false>(ws, view, cuts, tile);
  }
#pragma omp parallel for num_threads(view.threads) schedule(static)
  for (int64_t i = 0; i < rows; ++i) {
    typename Workspace<T>::Count sum{0, 0, 0};
    for (int32_t k = 0; k < ws.tiles[i].count; ++k) {
      const auto& slot = ws.count_slots[ws.tiles[i].first_slot + k];
      sum.weight += slot.weight, sum.pixels += slot.pixels, sum.dominant += slot.dominant;
    }
    out.weight[i] = sum.weight, out.pixels[i] = sum.pixels, out.dominant[i] = sum.dominant;
  }
  ws.seconds[COUNT] = omp_get_wtime() - start;
}

}  // namespace SPLAT_VARIANT
