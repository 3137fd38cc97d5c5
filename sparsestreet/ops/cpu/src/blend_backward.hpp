// Backward, front to back again: dLoss/d(ln alpha_k) = w_k f_k - alpha_k / (1 - alpha_k) (light still behind k), where
// f = colour and depth against the cotangents and the light behind is the pixel's total minus the prefix. Nothing is
// divided out of the transmittance, so saturated pixels keep their digits. Each pair writes its own slot: no atomics.
#pragma once
#include <omp.h>

#include "pixel.hpp"

namespace SPLAT_VARIANT {

// Cotangents of a tile's pixels and the running state.
template <class T>
struct TileCotangents {
  alignas(64) T transmittance[PIXELS], gate[PIXELS], behind[PIXELS], red[PIXELS], green[PIXELS], blue[PIXELS],
      depth[PIXELS];
};

// Sums over rows of a tile, per column.
template <class T>
struct Columns {
  alignas(64) T s[TILE], sa[TILE], sb[TILE], sa_dy[TILE], sb_dy[TILE], abs_x[TILE], abs_y[TILE], red[TILE], green[TILE],
      blue[TILE], depth[TILE];
};

template <class T, bool EXCLUSIVE>
inline void accumulate_row(const Splat<T>& p, const T* __restrict dx, T dy, const Cuts<T>& cuts, TileCotangents<T>& t,
                           int at, Columns<T>& sums) {
  T* __restrict transmittance = t.transmittance + at;
  T* __restrict gate = t.gate + at;
  T* __restrict behind = t.behind + at;
  const T *__restrict red = t.red + at, *__restrict green = t.green + at, *__restrict blue = t.blue + at;
  const T* __restrict depth = t.depth + at;
  const T along = p.l21 * dy, b = p.l22 * dy, base = p.log2_opacity - b * b;
  for (int i = 0; i < TILE; ++i) {
    const T a = p.l11 * dx[i] + along;
    const T exponent = base - a * a;
    const T raw = exp2_nonpositive(exponent > T(-126) ? exponent : T(-126));
    T alpha = raw < cuts.alpha_max ? raw : cuts.alpha_max;
    alpha = exponent >= cuts.log2_alpha_min ? alpha : T(0);
    if (EXCLUSIVE) {
      gate[i] = gate[i] - alpha * gate[i];
      alpha = gate[i] > cuts.transmittance_min ? alpha : T(0);
    } else {
      alpha = transmittance[i] > cuts.transmittance_min ? alpha : T(0);
    }
    const T weight = alpha * transmittance[i];
    transmittance[i] = transmittance[i] - weight;
    const T blended = weight * (p.color[0] * red[i] + p.color[1] * green[i] + p.color[2] * blue[i] +
                                p.depth * depth[i]);
    behind[i] = behind[i] - blended;
    T s = blended - alpha / (T(1) - alpha) * behind[i];
    s = raw <= cuts.alpha_max ? s : T(0);  // a clamped alpha has no derivative
    const T sa = s * a, sb = s * b;
    sums.s[i] += s;
    sums.sa[i] += sa;
    sums.sb[i] += sb;
    sums.sa_dy[i] += sa * dy;
    sums.sb_dy[i] += sb * dy;
    const T gy = p.l21 * sa + p.l22 * sb;
    sums.abs_x[i] += sa < 0 ? -sa : sa;
    sums.abs_y[i] += gy < 0 ? -gy : gy;
    sums.red[i] += weight * red[i];
    sums.green[i] += weight * green[i];
    sums.blue[i] += weight * blue[i];
    sums.depth[i] += weight * depth[i];
  }
}

template <class T>
inline T total(const T* values) {
  T sum = 0;
  for (int i = 0; i < TILE; ++i) sum += values[i];
  return sum;
}

template <class T>
inline void write_slot(const Columns<T>& c, const T* dx, Slot<T>& slot) {
  T sa_dx = 0;  // dx is the same in every row of a column
  for (int i = 0; i < TILE; ++i) sa_dx += c.sa[i] * dx[i];
  slot = {total(c.s), total(c.sa), total(c.sb), sa_dx, total(c.sa_dy), total(c.sb_dy), total(c.abs_x), total(c.abs_y),
          {total(c.red), total(c.green), total(c.blue)}, total(c.depth)};
}

// Loads the cotangents and the light behind the camera: sum of what was blended plus what got past everything.
template <class T>
void load_tile(TileCotangents<T>& t, const View& view, int64_t x0, int64_t y0, const Layers& image,
               const Layers& cotangents) {
  std::memset(static_cast<void*>(&t), 0, sizeof(t));
  open_tile(t.transmittance, view, x0, y0);
  open_tile(t.gate, view, x0, y0);
  const T *rgb = static_cast<const T*>(image.rgb), *passed = static_cast<const T*>(image.transmittance);
  const T *depth = static_cast<const T*>(image.depth_sum), *v_rgb = static_cast<const T*>(cotangents.rgb);
  const T *v_passed = static_cast<const T*>(cotangents.transmittance);
  const T* v_depth = static_cast<const T*>(cotangents.depth_sum);
  for (int64_t y = y0; y < y0 + TILE && y < view.height; ++y) {
    for (int64_t x = x0; x < x0 + TILE && x < view.width; ++x) {
      const int64_t to = (y - y0) * TILE + x - x0, from = y * view.width + x;
      T behind = 0;
      if (v_rgb) {
        t.red[to] = v_rgb[3 * from], t.green[to] = v_rgb[3 * from + 1], t.blue[to] = v_rgb[3 * from + 2];
        behind += rgb[3 * from] * t.red[to] + rgb[3 * from + 1] * t.green[to] + rgb[3 * from + 2] * t.blue[to];
      }
      if (v_depth) t.depth[to] = v_depth[from], behind += depth[from] * t.depth[to];
      if (v_passed) behind += passed[from] * v_passed[from];
      t.behind[to] = behind;
    }
  }
}

template <class T, bool EXCLUSIVE>
void blend_tile_backward(Workspace<T>& ws, const Cuts<T>& cuts, int64_t tile, int64_t x0, int64_t y0,
                         TileCotangents<T>& t) {
  const int64_t end = ws.tile_end[tile];
  for (int64_t k = ws.tile_begin[tile]; k < end; ++k) {
    if (k + PREFETCH < end) {
      __builtin_prefetch(&ws.splats[ws.pairs[k + PREFETCH].row]);
      __builtin_prefetch(&ws.slots[ws.pairs[k + PREFETCH].slot], 1);
    }
    const Splat<T>& s = ws.splats[ws.pairs[k].row];
    const TileSplat<T> here(s, x0, y0);
    Columns<T> sums;
    std::memset(static_cast<void*>(&sums), 0, sizeof(sums));
    for (int y = here.first; y <= here.last; ++y) {
      accumulate_row<T, EXCLUSIVE>(s, here.dx, T(y0 + y) + T(0.5) - s.y, cuts, t, y * TILE, sums);
    }
    write_slot(sums, here.dx, ws.slots[ws.pairs[k].slot]);
  }
  for (int64_t k = end; k < ws.tile_begin[tile + 1]; ++k) ws.slots[ws.pairs[k].slot] = Slot<T>{};
}

template <class T, bool EXCLUSIVE>
void blend_tiles_backward(Workspace<T>& ws, const View& view, const Layers& image, const Layers& cotangents) {
  const Cuts<T> cuts(view);
#pragma omp parallel for num_threads(view.threads) schedule(dynamic, 1)
  for (int64_t tile = 0; tile < ws.tiles_x * ws.tiles_y; ++tile) {
    const int64_t x0 = tile % ws.tiles_x * TILE, y0 = tile / ws.tiles_x * TILE;
    TileCotangents<T> t;
    load_tile(t, view, x0, y0, image, cotangents);
    blend_tile_backward<T, EXCLUSIVE>(ws, cuts, tile, x0, y0, t);
  }
}

template <class T>
void blend_backward(Workspace<T>& ws, const View& view, const Layers& image, const Layers& cotangents) {
  const double start = omp_get_wtime();
  ws.slots.reserve(ws.pair_count);
  if (view.exclusive_stop)
    blend_tiles_backward<T, true>(ws, view, image, cotangents);
  else
    blend_tiles_backward<T, false>(ws, view, image, cotangents);
  ws.seconds[BLEND_BACKWARD] = omp_get_wtime() - start;
}

}  // namespace SPLAT_VARIANT
