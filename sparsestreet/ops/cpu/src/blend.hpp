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
inline void blend_register(const Splat<T>& s, const TilePixels<T>& pixels, const Cuts<T>& cuts, TileColors<T>& c,
                           int at, T pair) {
  const Lanes<T> transmittance = load(c.transmittance + at);
  const Lanes<T> drawn = sample(s, pixels, at, cuts).alpha;
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

// Answers the index after the last pair that was looked at.
template <class T, bool EXCLUSIVE, bool GATED>
int64_t blend_tile(Workspace<T>& ws, const Cuts<T> cuts, int64_t tile, const TilePixels<T>& pixels, TileColors<T>& c,
                   int64_t& samples) {
  const T* state = EXCLUSIVE ? c.product : c.transmittance;
  const auto visit = [&](int64_t k, const Splat<T>& given) {
    const Splat<T> s = given;  // a copy: no store to the tile can change it
    samples += __builtin_popcountll(ws.masks[k]) * BLOCK_PIXELS;
    for_each_register<T>(ws.masks[k], [&](int at) {
      blend_register<T, EXCLUSIVE, GATED>(s, pixels, cuts, c, at, T(k - ws.tile_begin[tile]));
    });
  };
  return for_each_pair(ws, tile, pixels, state, cuts.transmittance_min, visit);
}

template <class T>
void write_tile(const TileColors<T>& c, const View& view, int64_t x0, int64_t y0, const Layers& image) {
  T *rgb = static_cast<T*>(image.rgb), *transmittance = static_cast<T*>(image.transmittance);
  T* depth = static_cast<T*>(image.depth_sum);
  for_each_pixel(view, x0, y0, [&](int from, int64_t to) {
    rgb[3 * to] = c.red[from], rgb[3 * to + 1] = c.green[from], rgb[3 * to + 2] = c.blue[from];
    transmittance[to] = c.transmittance[from], depth[to] = c.depth[from];
  });
}

// What write_tile wrote, without depths.
template <class T>
void read_tile(TileColors<T>& c, const View& view, int64_t x0, int64_t y0, const Layers& image) {
  const T *rgb = static_cast<const T*>(image.rgb), *transmittance = static_cast<const T*>(image.transmittance);
  for_each_pixel(view, x0, y0, [&](int to, int64_t from) {
    c.red[to] = rgb[3 * from], c.green[to] = rgb[3 * from + 1], c.blue[to] = rgb[3 * from + 2];
    c.transmittance[to] = transmittance[from];
  });
}

template <class T, bool EXCLUSIVE, bool GATED>
void blend_tiles(Workspace<T>& ws, const View& view, const Layers& image) {
  const Cuts<T> cuts(view);
  int64_t samples = 0;
  ws.last_pairs.reserve(ws.tiles_x * ws.tiles_y * PIXELS);
#pragma omp parallel for num_threads(view.threads) schedule(dynamic, 1) reduction(+ : samples)
  for (int64_t tile = 0; tile < ws.tiles_x * ws.tiles_y; ++tile) {
    const int64_t x0 = tile % ws.tiles_x * TILE, y0 = tile / ws.tiles_x * TILE;
    const TilePixels<T> pixels(x0, y0);
    TileColors<T> c;
    std::memset(static_cast<void*>(&c), 0, sizeof(c));
    for (T& pair : c.last) pair = -1;
    open_tile(c.transmittance, view, pixels);
    if (EXCLUSIVE) open_tile(c.product, view, pixels);
    sort_tile(ws, tile);
    ws.tile_end[tile] = blend_tile<T, EXCLUSIVE, GATED>(ws, cuts, tile, pixels, c, samples);
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

// Of each pixel that is finished: the row of the splat that finished it, and its depth; others stay as they are. After
// an inclusive blend, whose lists are still there.
template <class T>
void write_finishers(const Workspace<T>& ws, const View& view, const T* transmittance, const Finishers& out) {
  T* depth = static_cast<T*>(out.depth);
#pragma omp parallel for num_threads(view.threads) schedule(static)
  for (int64_t tile = 0; tile < ws.tiles_x * ws.tiles_y; ++tile) {
    for_each_pixel(view, tile % ws.tiles_x * TILE, tile / ws.tiles_x * TILE, [&](int at, int64_t pixel) {
      if (transmittance[pixel] > T(view.transmittance_min)) return;
      const int64_t row = ws.pairs[ws.tile_begin[tile] + int64_t(ws.last_pairs[tile * PIXELS + at])].row;
      out.rows[pixel] = row, depth[pixel] = ws.splats[row].depth;
    });
  }
}

}  // namespace SPLAT_VARIANT
