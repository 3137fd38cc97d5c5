// Forward: each tile's splats, nearest first, into its pixels.
#pragma once
#include <omp.h>

#include "pixel.hpp"
#include "tile_order.hpp"

namespace SPLAT_VARIANT {

template <class T>
struct TileColors {
  alignas(64) T transmittance[PIXELS], product[PIXELS], red[PIXELS], green[PIXELS], blue[PIXELS], depth[PIXELS];
  alignas(64) T last[PIXELS];  // the last pair that was blended, counted in the tile
};

// GATED: the row's gate multiplies its alpha. Backward reaches what a gate of 0 hides, up to where the pixel ends.
template <class T, bool EXCLUSIVE, bool GATED>
inline void blend_row(const Splat<T>& s, const T* dx, T dy, const Cuts<T>& cuts, TileColors<T>& c, int row, T pair) {
  const T b = s.l22 * dy, along = s.l21 * dy, base = s.log2_opacity - b * b;
  for (int x = 0; x < TILE; x += LANES<T>) {
    const int at = row * TILE + x;
    const Lanes<T> transmittance = load(c.transmittance + at);
    const Lanes<T> drawn = sample(s, load(dx + x), along, base, cuts).alpha;
    const Lanes<T> alpha = still_open<T, EXCLUSIVE>(GATED ? drawn * s.gate : drawn, cuts, transmittance, c.product + at);
    const Lanes<T> weight = alpha * transmittance;
    Lanes<T> reached = alpha;
    if (GATED) reached = (EXCLUSIVE ? load(c.product + at) : transmittance) > cuts.transmittance_min ? drawn : Lanes<T>{};
    store(c.last + at, reached > Lanes<T>{} ? same(pair) : load(c.last + at));
    store(c.transmittance + at, transmittance - weight);
    store(c.red + at, load(c.red + at) + weight * s.color[0]);
    store(c.green + at, load(c.green + at) + weight * s.color[1]);
    store(c.blue + at, load(c.blue + at) + weight * s.color[2]);
    store(c.depth + at, load(c.depth + at) + weight * s.depth);
  }
}

// Answers the index after the last pair that was looked at.
template <class T, bool EXCLUSIVE, bool GATED>
int64_t blend_tile(const Workspace<T>& ws, const Cuts<T> cuts, int64_t tile, int64_t x0, int64_t y0,
                   TileColors<T>& c, int64_t& samples) {
  const int64_t begin = ws.tile_begin[tile], end = ws.tile_begin[tile + 1];
  for (int64_t k = begin; k < end; ++k) {
    if ((k - begin) % LOOK == 0 &&
        tile_finished(EXCLUSIVE ? c.product : c.transmittance, cuts.transmittance_min))
      return k;
    if (k + PREFETCH < end) __builtin_prefetch(&ws.splats[ws.pairs[k + PREFETCH].row]);
    const Splat<T> s = ws.splats[ws.pairs[k].row];  // a copy: no store to the tile can change it
    const TileSplat<T> here(s, x0, y0);
    samples += (here.last - here.first + 1) * TILE;
    for (int y = here.first; y <= here.last; ++y)
      blend_row<T, EXCLUSIVE, GATED>(s, here.dx, T(y0 + y) + T(0.5) - s.y, cuts, c, y, T(k - begin));
  }
  return end;
}

template <class T>
void write_tile(const TileColors<T>& c, const View& view, int64_t x0, int64_t y0, const Layers& image) {
  T *rgb = static_cast<T*>(image.rgb), *transmittance = static_cast<T*>(image.transmittance);
  T* depth = static_cast<T*>(image.depth_sum);
  for (int64_t y = y0; y < y0 + TILE && y < view.height; ++y) {
    for (int64_t x = x0; x < x0 + TILE && x < view.width; ++x) {
      const int64_t from = (y - y0) * TILE + x - x0, to = y * view.width + x;
      rgb[3 * to] = c.red[from], rgb[3 * to + 1] = c.green[from], rgb[3 * to + 2] = c.blue[from];
      transmittance[to] = c.transmittance[from], depth[to] = c.depth[from];
    }
  }
}

// What write_tile wrote, without depths.
template <class T>
void read_tile(TileColors<T>& c, const View& view, int64_t x0, int64_t y0, const Layers& image) {
  const T *rgb = static_cast<const T*>(image.rgb), *transmittance = static_cast<const T*>(image.transmittance);
  for (int64_t y = y0; y < y0 + TILE && y < view.height; ++y) {
    for (int64_t x = x0; x < x0 + TILE && x < view.width; ++x) {
      const int64_t to = (y - y0) * TILE + x - x0, from = y * view.width + x;
      c.red[to] = rgb[3 * from], c.green[to] = rgb[3 * from + 1], c.blue[to] = rgb[3 * from + 2];
      c.transmittance[to] = transmittance[from];
    }
  }
}

template <class T, bool EXCLUSIVE, bool GATED>
void blend_tiles(Workspace<T>& ws, const View& view, const Layers& image) {
  const Cuts<T> cuts(view);
  int64_t samples = 0;
  ws.last_pairs.reserve(ws.tiles_x * ws.tiles_y * PIXELS);
#pragma omp parallel for num_threads(view.threads) schedule(dynamic, 1) reduction(+ : samples)
  for (int64_t tile = 0; tile < ws.tiles_x * ws.tiles_y; ++tile) {
    const int64_t x0 = tile % ws.tiles_x * TILE, y0 = tile / ws.tiles_x * TILE;
    TileColors<T> c;
    std::memset(static_cast<void*>(&c), 0, sizeof(c));
    for (T& pair : c.last) pair = -1;
    open_tile(c.transmittance, view, x0, y0);
    if (EXCLUSIVE) open_tile(c.product, view, x0, y0);
    sort_tile(ws, tile);
    ws.tile_end[tile] = blend_tile<T, EXCLUSIVE, GATED>(ws, cuts, tile, x0, y0, c, samples);
    write_tile(c, view, x0, y0, image);
    std::memcpy(&ws.last_pairs[tile * PIXELS], c.last, sizeof(c.last));
  }
  ws.samples = samples;
}

template <class T>
void blend(Workspace<T>& ws, const View& view, bool gated, const Layers& image) {
  const double start = omp_get_wtime();
  if (view.exclusive_stop)
    gated ? blend_tiles<T, true, true>(ws, view, image) : blend_tiles<T, true, false>(ws, view, image);
  else
    gated ? blend_tiles<T, false, true>(ws, view, image) : blend_tiles<T, false, false>(ws, view, image);
  ws.seconds[BLEND] = omp_get_wtime() - start;
}

}  // namespace SPLAT_VARIANT
