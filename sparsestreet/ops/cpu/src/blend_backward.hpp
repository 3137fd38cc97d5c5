// Backward, from the last splat of a pixel to the first: dLoss/d(ln alpha_k) = w_k f_k - alpha_k / (1 - alpha_k) (light
// from behind k), where f = color and depth against the cotangents. The light from behind is summed from the back, its
// small terms first, and the transmittance before a splat is that after it / (1 - alpha): both keep their relative
// digits however deep the stack. (Total minus prefix, from the front, would carry the rounding of the total to the
// faintest splat.) Each pair writes its own slot: no atomics. With gates alpha_k = M_k A_k, A_k being the splat's own, and
// dLoss/dM_k = A_k (T_k f_k - (light from behind k) / (1 - alpha_k)), which is there where M_k is 0.
#pragma once
#include <omp.h>

#include "pixel.hpp"

namespace SPLAT_VARIANT {

// Cotangents of a tile's pixels and the running state.
template <class T>
struct TileCotangents {
  alignas(64) T transmittance[PIXELS], last[PIXELS], behind[PIXELS], red[PIXELS], green[PIXELS], blue[PIXELS],
      depth[PIXELS];
};

// Sums over the rows of a tile, per column, of some neighboring columns.
template <class T>
struct Columns {
  Lanes<T> s{}, sa{}, sb{}, sa_dy{}, sb_dy{}, abs_x{}, abs_y{}, red{}, green{}, blue{}, depth{}, gate{};
};

template <class T, bool GATED>
inline void accumulate_row(const Splat<T>& p, const Lanes<T>& dx, T dy, const Cuts<T>& cuts, TileCotangents<T>& t,
                           int at, T pair, Columns<T>& sums) {
  const T along = p.l21 * dy, b = p.l22 * dy, base = p.log2_opacity - b * b;
  const Sample<T> q = sample(p, dx, along, base, cuts);
  const Lanes<T> drawn = load(t.last + at) >= pair ? q.alpha : Lanes<T>{};
  const Lanes<T> alpha = GATED ? drawn * p.gate : drawn;
  const Lanes<T> inverse = T(1) / (T(1) - alpha), transmittance = load(t.transmittance + at) * inverse;
  store(t.transmittance + at, transmittance);
  const Lanes<T> red = load(t.red + at), green = load(t.green + at), blue = load(t.blue + at);
  const Lanes<T> depth = load(t.depth + at), weight = alpha * transmittance, behind = load(t.behind + at);
  const Lanes<T> light = p.color[0] * red + p.color[1] * green + p.color[2] * blue + p.depth * depth;
  const Lanes<T> blended = weight * light;
  store(t.behind + at, behind + blended);
  Lanes<T> s = blended - alpha * inverse * behind;
  s = q.raw <= cuts.alpha_max ? s : Lanes<T>{};  // a clamped alpha has no derivative
  if (GATED) sums.gate += drawn * (transmittance * light - inverse * behind);
  const Lanes<T> sa = s * q.a, sb = s * b;
  sums.s += s;
  sums.sa += sa;
  sums.sb += sb;
  sums.sa_dy += sa * dy;
  sums.sb_dy += sb * dy;
  sums.abs_x += magnitude(sa);
  sums.abs_y += magnitude(p.l21 * sa + p.l22 * sb);
  sums.red += weight * red;
  sums.green += weight * green;
  sums.blue += weight * blue;
  sums.depth += weight * depth;
}

template <class T>
inline void add_columns(const Columns<T>& c, const Lanes<T>& dx, Slot<T>& slot) {
  slot.s += total<T>(c.s), slot.sa += total<T>(c.sa), slot.sb += total<T>(c.sb);
  slot.sa_dx += total<T>(c.sa * dx);  // dx is the same in every row of a column
  slot.sa_dy += total<T>(c.sa_dy), slot.sb_dy += total<T>(c.sb_dy);
  slot.abs_x += total<T>(c.abs_x), slot.abs_y += total<T>(c.abs_y);
  slot.color[0] += total<T>(c.red), slot.color[1] += total<T>(c.green), slot.color[2] += total<T>(c.blue);
  slot.depth += total<T>(c.depth);
}

// Loads the cotangents, and the light that got past everything.
template <class T>
void load_tile(TileCotangents<T>& t, const View& view, int64_t x0, int64_t y0, const T* passed,
               const Layers& cotangents) {
  std::memset(static_cast<void*>(&t), 0, sizeof(t));
  const T *v_rgb = static_cast<const T*>(cotangents.rgb), *v_depth = static_cast<const T*>(cotangents.depth_sum);
  const T* v_passed = static_cast<const T*>(cotangents.transmittance);
  for (int64_t y = y0; y < y0 + TILE && y < view.height; ++y) {
    for (int64_t x = x0; x < x0 + TILE && x < view.width; ++x) {
      const int64_t to = (y - y0) * TILE + x - x0, from = y * view.width + x;
      t.transmittance[to] = passed[from];
      if (v_passed) t.behind[to] = passed[from] * v_passed[from];
      if (v_depth) t.depth[to] = v_depth[from];
      if (v_rgb) t.red[to] = v_rgb[3 * from], t.green[to] = v_rgb[3 * from + 1], t.blue[to] = v_rgb[3 * from + 2];
    }
  }
}

template <class T, bool GATED>
void blend_tile_backward(Workspace<T>& ws, const Cuts<T>& cuts, int64_t tile, int64_t x0, int64_t y0,
                         TileCotangents<T>& t) {
  const int64_t begin = ws.tile_begin[tile], end = ws.tile_end[tile];
  for (int64_t k = ws.tile_begin[tile + 1] - 1; k >= end; --k) {
    ws.slots[ws.pairs[k].slot] = Slot<T>{};
    if (GATED) ws.gate_slots[ws.pairs[k].slot] = 0;
  }
  for (int64_t k = end - 1; k >= begin; --k) {
    if (k - PREFETCH >= begin) {
      __builtin_prefetch(&ws.splats[ws.pairs[k - PREFETCH].row]);
      __builtin_prefetch(&ws.slots[ws.pairs[k - PREFETCH].slot], 1);
    }
    const Splat<T>& s = ws.splats[ws.pairs[k].row];
    const TileSplat<T> here(s, x0, y0);
    Slot<T> slot{};
    T gate = 0;
    for (int x = 0; x < TILE; x += LANES<T>) {
      const Lanes<T> dx = load(here.dx + x);
      Columns<T> sums;
      for (int y = here.first; y <= here.last; ++y)
        accumulate_row<T, GATED>(s, dx, T(y0 + y) + T(0.5) - s.y, cuts, t, y * TILE + x, T(k - begin), sums);
      add_columns(sums, dx, slot);
      if (GATED) gate += total<T>(sums.gate);
    }
    ws.slots[ws.pairs[k].slot] = slot;
    if (GATED) ws.gate_slots[ws.pairs[k].slot] = gate;
  }
}

template <class T, bool GATED>
void blend_tiles_backward(Workspace<T>& ws, const View& view, const T* transmittance, const Layers& cotangents) {
  const Cuts<T> cuts(view);
#pragma omp parallel for num_threads(view.threads) schedule(dynamic, 1)
  for (int64_t tile = 0; tile < ws.tiles_x * ws.tiles_y; ++tile) {
    const int64_t x0 = tile % ws.tiles_x * TILE, y0 = tile / ws.tiles_x * TILE;
    TileCotangents<T> t;
    load_tile(t, view, x0, y0, transmittance, cotangents);
    std::memcpy(t.last, &ws.last_pairs[tile * PIXELS], sizeof(t.last));
    blend_tile_backward<T, GATED>(ws, cuts, tile, x0, y0, t);
  }
}

// The slots of each row, in a fixed order; 0 where it was culled.
template <class T>
void sum_gates(const Workspace<T>& ws, const View& view, int64_t rows, T* gates) {
#pragma omp parallel for num_threads(view.threads) schedule(static)
  for (int64_t i = 0; i < rows; ++i) {
    gates[i] = 0;
    for (int32_t k = 0; k < ws.tiles[i].count; ++k) gates[i] += ws.gate_slots[ws.tiles[i].first_slot + k];
  }
}

template <class T>
void blend_backward(Workspace<T>& ws, const View& view, const T* transmittance, const Layers& cotangents, int64_t rows,
                    T* gates) {
  const double start = omp_get_wtime();
  ws.slots.reserve(ws.pair_count);
  if (gates) {
    ws.gate_slots.reserve(ws.pair_count);
    blend_tiles_backward<T, true>(ws, view, transmittance, cotangents);
    sum_gates(ws, view, rows, gates);
  } else {
    blend_tiles_backward<T, false>(ws, view, transmittance, cotangents);
  }
  ws.seconds[BLEND_BACKWARD] = omp_get_wtime() - start;
}

}  // namespace SPLAT_VARIANT
