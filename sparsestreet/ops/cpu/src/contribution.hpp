// What each row adds to a view: sum of weights, touched pixels, dominated pixels. A pass of its own, so that training
// does not pay for it.
#pragma once
#include <omp.h>

#include "pixel.hpp"

namespace SPLAT_VARIANT {

template <class T>
struct TileCounters {
  alignas(64) T transmittance[PIXELS], gate[PIXELS], best[PIXELS];
  int64_t best_pair[PIXELS];
};

// Weight of splat s in one pixel; moves the pixel's state on.
template <class T>
inline T pixel_weight(const Splat<T>& s, T dx, T dy, const Cuts<T>& cuts, bool exclusive, T& transmittance, T& gate) {
  const T a = s.l11 * dx + s.l21 * dy, b = s.l22 * dy;
  const T exponent = s.log2_opacity - b * b - a * a;
  if (exponent < cuts.log2_alpha_min) return 0;
  const T raw = exp2_nonpositive(exponent > T(-126) ? exponent : T(-126));
  const T alpha = raw < cuts.alpha_max ? raw : cuts.alpha_max;
  if (exclusive) gate -= alpha * gate;
  if ((exclusive ? gate : transmittance) <= cuts.transmittance_min) return 0;
  const T weight = alpha * transmittance;
  transmittance -= weight;
  return weight;
}

template <class T>
void count_tile(Workspace<T>& ws, const View& view, const Cuts<T>& cuts, int64_t tile) {
  const int64_t x0 = tile % ws.tiles_x * TILE, y0 = tile / ws.tiles_x * TILE;
  TileCounters<T> c;
  open_tile(c.transmittance, view, x0, y0), open_tile(c.gate, view, x0, y0);
  for (int i = 0; i < PIXELS; ++i) c.best[i] = 0, c.best_pair[i] = -1;
  for (int64_t k = ws.tile_begin[tile]; k < ws.tile_begin[tile + 1]; ++k) {
    const Splat<T>& s = ws.splats[ws.pairs[k].row];
    const TileSplat<T> here(s, x0, y0);
    typename Workspace<T>::Count count{0, 0, 0};
    for (int y = here.first; y <= here.last; ++y) {
      for (int x = 0; x < TILE; ++x) {
        const int at = y * TILE + x;
        const T weight = pixel_weight(s, here.dx[x], T(y0 + y) + T(0.5) - s.y, cuts, view.exclusive_stop,
                                      c.transmittance[at], c.gate[at]);
        count.weight += double(weight), count.pixels += weight > 0;
        // Strictly more: of equal weights the nearer splat keeps the pixel.
        if (weight > c.best[at]) c.best[at] = weight, c.best_pair[at] = k;
      }
    }
    ws.count_slots[ws.pairs[k].slot] = count;
  }
  for (int i = 0; i < PIXELS; ++i)
    if (c.best_pair[i] >= 0) ++ws.count_slots[ws.pairs[c.best_pair[i]].slot].dominant;
}

template <class T>
void count_contributions(Workspace<T>& ws, const View& view, int64_t rows, const Counters& out) {
  const double start = omp_get_wtime();
  const Cuts<T> cuts(view);
  ws.count_slots.reserve(ws.pair_count);
#pragma omp parallel for num_threads(view.threads) schedule(dynamic, 1)
  for (int64_t tile = 0; tile < ws.tiles_x * ws.tiles_y; ++tile) count_tile(ws, view, cuts, tile);
#pragma omp parallel for num_threads(view.threads) schedule(static)
  for (int64_t i = 0; i < rows; ++i) {
    typename Workspace<T>::Count sum{0, 0, 0};
    for (int32_t k = 0; k < ws.counts[i]; ++k) {
      const auto& slot = ws.count_slots[ws.first_slot[i] + k];
      sum.weight += slot.weight, sum.pixels += slot.pixels, sum.dominant += slot.dominant;
    }
    out.weight[i] = sum.weight, out.pixels[i] = sum.pixels, out.dominant[i] = sum.dominant;
  }
  ws.seconds[COUNT] = omp_get_wtime() - start;
}

}  // namespace SPLAT_VARIANT
