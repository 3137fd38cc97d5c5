// How far a view moves when one row alone is taken away. A pixel is linear in the alpha of each of its splats, so the
// change is exactly -alpha dC/dalpha = -w c + (light behind) alpha / (1 - alpha). In a training step lists and image are
// there already. The loop stands beside that of the gradients, whose bits must not depend on it; one loop for both was
// slower.
#pragma once
#include "blend.hpp"

namespace SPLAT_VARIANT {

// What is seen behind a splat, total (over the background) minus all up to it, and how much each pixel counts.
template <class T>
struct TileBehind {
  alignas(64) T color[3][PIXELS], pixel_weights[COUNTINGS][PIXELS];
};

// Sums over the pixels of a tile, per lane.
template <class T>
struct ChangeColumns {
  Lanes<T> largest{}, weight{}, squared[COUNTINGS]{};
};

// Answers up to which counting any pixel of the tile has a weight: few tiles show all that is told apart.
template <class T, int WAYS>
inline int behind_everything(const TileColors<T>& total, const View& view, const Backdrop& sky_image, int64_t x0,
                             int64_t y0, TileBehind<T>& behind) {
  const T* blended[3] = {total.red, total.green, total.blue};
  const T *background = static_cast<const T*>(sky_image.rgb), *weights = static_cast<const T*>(sky_image.pixel_weights);
  int ways = 1;
  for_each_pixel(view, x0, y0, [&](int at, int64_t pixel) {
    for (int k = 0; k < WAYS; ++k) {
      behind.pixel_weights[k][at] = weights ? weights[k * view.width * view.height + pixel] : T(1);
      if (k >= ways && behind.pixel_weights[k][at] != 0) ways = k + 1;
    }
    for (int channel = 0; channel < 3; ++channel) {
      const T back = background ? background[3 * pixel + channel] : T(0);
      behind.color[channel][at] = blended[channel][at] + total.transmittance[at] * back;
    }
  });
  return ways;
}

template <class T, bool EXCLUSIVE, int WAYS>
inline void remove_register(const Splat<T>& s, const TilePixels<T>& pixels, const Cuts<T>& cuts, TileColors<T>& c,
                            TileBehind<T>& behind, int at, ChangeColumns<T>& sums) {
  const Lanes<T> transmittance = load(c.transmittance + at), drawn = sample(s, pixels, at, cuts).alpha;
  const Lanes<T> alpha = still_open<T, EXCLUSIVE>(drawn, cuts, transmittance, c.product + at);
  const Lanes<T> weight = alpha * transmittance, through = alpha / (T(1) - alpha);
  store(c.transmittance + at, transmittance - weight);
  Lanes<T> square{}, largest{};  // of its own: a chain through all channels of all blocks would wait for each link
  for (int channel = 0; channel < 3; ++channel) {
    const Lanes<T> own = weight * s.color[channel], rest = load(behind.color[channel] + at) - own;
    store(behind.color[channel] + at, rest);
    const Lanes<T> change = rest * through - own;
    largest = larger(largest, magnitude(change));
    square += change * change;
  }
  for (int k = 0; k < WAYS; ++k) sums.squared[k] += load(behind.pixel_weights[k] + at) * square;
  sums.largest = larger(sums.largest, largest);
  sums.weight += weight;
}

template <class T, bool EXCLUSIVE, int WAYS>
void remove_pairs(Workspace<T>& ws, const Cuts<T> cuts, int64_t tile, const TilePixels<T>& pixels, TileColors<T>& c,
                  TileBehind<T>& behind) {
  const int64_t end = ws.tile_end[tile];
  for (int64_t k = ws.tile_begin[tile]; k < end; ++k) {
    if (k + PREFETCH < end) {
      __builtin_prefetch(&ws.splats[ws.pairs[k + PREFETCH].row]);
      __builtin_prefetch(&ws.change_slots[ws.pairs[k + PREFETCH].slot], 1);
    }
    const Splat<T> s = ws.splats[ws.pairs[k].row];  // a copy: no store to the tile can change it
    ChangeColumns<T> sums;
    for_each_register<T>(ws.masks[k], [&](int at) {
      remove_register<T, EXCLUSIVE, WAYS>(s, pixels, cuts, c, behind, at, sums);
    });
    T largest = 0;
    for (int i = 0; i < LANES<T>; ++i) largest = sums.largest[i] > largest ? sums.largest[i] : largest;
    typename Workspace<T>::Change change{largest, total<T>(sums.weight), {}};
    for (int i = 0; i < WAYS; ++i) change.squared[i] = total<T>(sums.squared[i]);
    ws.change_slots[ws.pairs[k].slot] = change;
  }
  for (int64_t k = end; k < ws.tile_begin[tile + 1]; ++k) ws.change_slots[ws.pairs[k].slot] = {};
}

// Blends a tile, or takes up what blending has given.
template <class T, bool EXCLUSIVE>
void draw_tile(Workspace<T>& ws, const View& view, const Cuts<T>& cuts, int64_t tile, const TilePixels<T>& pixels,
               int64_t x0, int64_t y0, const Layers* drawn, TileColors<T>& c) {
  std::memset(static_cast<void*>(&c), 0, sizeof(c));
  if (drawn) return read_tile(c, view, x0, y0, *drawn);
  open_tile(c.transmittance, view, pixels), open_tile(c.product, view, pixels);
  int64_t samples = 0;
  sort_tile(ws, tile);
  ws.tile_end[tile] = blend_tile<T, EXCLUSIVE, false>(ws, cuts, tile, pixels, c, samples);
}

template <class T, bool EXCLUSIVE, int WAYS>
void remove_tile(Workspace<T>& ws, const View& view, const Cuts<T>& cuts, int64_t tile, const Backdrop& sky_image,
                 const Layers* drawn) {
  const int64_t x0 = tile % ws.tiles_x * TILE, y0 = tile / ws.tiles_x * TILE;
  const TilePixels<T> pixels(x0, y0);
  TileColors<T> c;
  TileBehind<T> behind{};
  draw_tile<T, EXCLUSIVE>(ws, view, cuts, tile, pixels, x0, y0, drawn, c);
  const int ways = behind_everything<T, WAYS>(c, view, sky_image, x0, y0, behind);
  open_tile(c.transmittance, view, pixels), open_tile(c.product, view, pixels);
  if (ways == 1)
    remove_pairs<T, EXCLUSIVE, 1>(ws, cuts, tile, pixels, c, behind);
  else
    remove_pairs<T, EXCLUSIVE, WAYS>(ws, cuts, tile, pixels, c, behind);
}

// Sums the slots of each row, in a fixed order; 0 where it was culled.
template <class T, int WAYS>
void sum_changes(const Workspace<T>& ws, const View& view, int64_t rows, const Changes& out) {
#pragma omp parallel for num_threads(view.threads) schedule(static)
  for (int64_t i = 0; i < rows; ++i) {
    double largest = 0, weight = 0, squared[WAYS] = {};
    for (int32_t k = 0; k < ws.tiles[i].count; ++k) {
      const auto& slot = ws.change_slots[ws.tiles[i].first_slot + k];
      largest = slot.largest > largest ? slot.largest : largest, weight += slot.weight;
      for (int way = 0; way < WAYS; ++way) squared[way] += slot.squared[way];
    }
    out.largest[i] = largest, out.weight[i] = weight;
    for (int way = 0; way < WAYS; ++way) out.squared[WAYS * i + way] = squared[way];
  }
}

template <class T, int WAYS>
void remove_rows(Workspace<T>& ws, const View& view, int64_t rows, const Backdrop& sky_image, const Layers* drawn,
                 const Changes& out) {
  const double start = omp_get_wtime();
  const Cuts<T> cuts(view);
  ws.change_slots.reserve(ws.pair_count);
#pragma omp parallel for num_threads(view.threads) schedule(dynamic, 1)
  for (int64_t tile = 0; tile < ws.tiles_x * ws.tiles_y; ++tile) {
    if (view.exclusive_stop)
      remove_tile<T, true, WAYS>(ws, view, cuts, tile, sky_image, drawn);
    else
      remove_tile<T, false, WAYS>(ws, view, cuts, tile, sky_image, drawn);
  }
  sum_changes<T, WAYS>(ws, view, rows, out);
  ws.seconds[COUNT] = omp_get_wtime() - start;
}

}  // namespace SPLAT_VARIANT
