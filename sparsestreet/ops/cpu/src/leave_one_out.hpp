// How far a view moves when one row alone is taken away. A pixel is linear in the alpha of each of its splats, so the
// change is exactly -alpha dC/dalpha = -w c + (light behind) alpha / (1 - alpha).
#pragma once
#include "blend.hpp"

namespace SPLAT_VARIANT {

// What is seen behind a splat, total (over the background) minus all up to it, and how much each pixel counts.
template <class T>
struct TileBehind {
  alignas(64) T color[3][PIXELS], pixel_weight[PIXELS];
};

template <class T>
inline void behind_everything(const TileColors<T>& total, const View& view, const Backdrop& sky_image, int64_t x0,
                              int64_t y0, TileBehind<T>& behind) {
  const T* blended[3] = {total.red, total.green, total.blue};
  const T *background = static_cast<const T*>(sky_image.rgb), *weights = static_cast<const T*>(sky_image.pixel_weights);
  for_each_pixel(view, x0, y0, [&](int at, int64_t pixel) {
    behind.pixel_weight[at] = weights ? weights[pixel] : T(1);
    for (int channel = 0; channel < 3; ++channel) {
      const T back = background ? background[3 * pixel + channel] : T(0);
      behind.color[channel][at] = blended[channel][at] + total.transmittance[at] * back;
    }
  });
}

template <class T, bool EXCLUSIVE>
inline void remove_register(const Splat<T>& s, const TilePixels<T>& pixels, const Cuts<T>& cuts, TileColors<T>& c,
                            TileBehind<T>& behind, int at, Lanes<T>& largest, Lanes<T>& squared) {
  const Lanes<T> transmittance = load(c.transmittance + at), drawn = sample(s, pixels, at, cuts).alpha;
  const Lanes<T> alpha = still_open<T, EXCLUSIVE>(drawn, cuts, transmittance, c.product + at);
  const Lanes<T> weight = alpha * transmittance, through = alpha / (T(1) - alpha);
  store(c.transmittance + at, transmittance - weight);
  Lanes<T> sum{};
  for (int channel = 0; channel < 3; ++channel) {
    const Lanes<T> own = weight * s.color[channel], rest = load(behind.color[channel] + at) - own;
    store(behind.color[channel] + at, rest);
    const Lanes<T> change = rest * through - own;
    largest = larger(largest, magnitude(change));
    sum += change * change;
  }
  squared += load(behind.pixel_weight + at) * sum;
}

template <class T, bool EXCLUSIVE>
void remove_tile(Workspace<T>& ws, const View& view, const Cuts<T>& cuts, int64_t tile, const Backdrop& sky_image) {
  const int64_t x0 = tile % ws.tiles_x * TILE, y0 = tile / ws.tiles_x * TILE;
  const TilePixels<T> pixels(x0, y0);
  TileColors<T> c;
  TileBehind<T> behind{};
  std::memset(static_cast<void*>(&c), 0, sizeof(c));
  open_tile(c.transmittance, view, pixels), open_tile(c.product, view, pixels);
  int64_t samples = 0;
  sort_tile(ws, tile);
  const int64_t end = blend_tile<T, EXCLUSIVE, false>(ws, cuts, tile, pixels, c, samples);
  behind_everything(c, view, sky_image, x0, y0, behind);
  open_tile(c.transmittance, view, pixels), open_tile(c.product, view, pixels);
  for (int64_t k = ws.tile_begin[tile]; k < ws.tile_begin[tile + 1]; ++k) {
    const Splat<T>& s = ws.splats[ws.pairs[k].row];
    Lanes<T> largest{}, squared{};
    for_each_register<T>(k < end ? ws.masks[k] : BlockMask(0), [&](int at) {
      remove_register<T, EXCLUSIVE>(s, pixels, cuts, c, behind, at, largest, squared);
    });
    typename Workspace<T>::Change change{0, 0};
    for (int i = 0; i < LANES<T>; ++i) {
      change.largest = largest[i] > change.largest ? double(largest[i]) : change.largest;
      change.squared += double(squared[i]);
    }
    ws.change_slots[ws.pairs[k].slot] = change;
  }
}

template <class T>
void remove_rows(Workspace<T>& ws, const View& view, int64_t rows, const Backdrop& sky_image, const Changes& out) {
  const double start = omp_get_wtime();
  const Cuts<T> cuts(view);
  ws.change_slots.reserve(ws.pair_count);
#pragma omp parallel for num_threads(view.threads) schedule(dynamic, 1)
  for (int64_t tile = 0; tile < ws.tiles_x * ws.tiles_y; ++tile) {
    if (view.exclusive_stop)
      remove_tile<T, true>(ws, view, cuts, tile, sky_image);
    else
      remove_tile<T, false>(ws, view, cuts, tile, sky_image);
  }
#pragma omp parallel for num_threads(view.threads) schedule(static)
  for (int64_t i = 0; i < rows; ++i) {
    typename Workspace<T>::Change sum{0, 0};
    for (int32_t k = 0; k < ws.tiles[i].count; ++k) {
      const auto& slot = ws.change_slots[ws.tiles[i].first_slot + k];
      sum.largest = slot.largest > sum.largest ? slot.largest : sum.largest, sum.squared += slot.squared;
    }
    out.largest[i] = sum.largest, out.squared[i] = sum.squared;
  }
  ws.seconds[COUNT] = omp_get_wtime() - start;
}

}  // namespace SPLAT_VARIANT
