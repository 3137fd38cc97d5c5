// Backward, from the last splat of a pixel to the first: dLoss/d(ln alpha_k) = w_k f_k - alpha_k / (1 - alpha_k) (light
// from behind k), where f = color and depth against the cotangents. The light from behind is summed from the back, its
// small terms first, and the transmittance before a splat is that after it / (1 - alpha): both keep their relative
// digits however deep the stack. (Total minus prefix, from the front, would carry the rounding of the total to the
// faintest splat.) Each pair writes its own slot: no atomics. With gates alpha_k = M_k A_k, A_k being the splat's own, and
// dLoss/dM_k = A_k (T_k f_k - (light from behind k) / (1 - alpha_k)), which is there where M_k is 0.
#pragma once
#include <omp.h>

#include "columns.hpp"
#include "pixel.hpp"

namespace SPLAT_VARIANT {

// Cotangents of a tile's pixels and the running state.
template <class T>
struct TileCotangents {
  alignas(64) T transmittance[PIXELS], last[PIXELS], behind[PIXELS], red[PIXELS], green[PIXELS], blue[PIXELS],
      depth[PIXELS];
};

template <class T, bool GATED>
inline void accumulate_register(const Splat<T>& p, const TilePixels<T>& pixels, const Cuts<T>& cuts,
                                TileCotangents<T>& t, int at, T pair, Slot<Lanes<T>>& sums, Lanes<T>& gate) {
  const Sample<T> q = sample(p, pixels, at, cuts);
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
  if (GATED) gate += drawn * (transmittance * light - inverse * behind);
  const Lanes<T> sa = s * q.a, sb = s * q.b;
  sums.s += s;
  sums.sa += sa;
  sums.sb += sb;
  sums.sa_dx += sa * q.dx;
  sums.sa_dy += sa * q.dy;
  sums.sb_dy += sb * q.dy;
  sums.abs_x += magnitude(sa);
  sums.abs_y += magnitude(p.l21 * sa + p.l22 * sb);
  sums.color[0] += weight * red;
  sums.color[1] += weight * green;
  sums.color[2] += weight * blue;
  sums.depth += weight * depth;
}

// Sums over the lanes.
template <class T>
inline void store_totals(const Slot<Lanes<T>>& sums, Slot<T>& slot) {
  const Lanes<T>* columns = &sums.s;
  for (int c = 0; c < SLOT_COLUMNS<T>; c += LANES<T>) {
    const int count = SLOT_COLUMNS<T> - c < LANES<T> ? SLOT_COLUMNS<T> - c : LANES<T>;
    Lanes<T> square[LANES<T>] = {};
    for (int i = 0; i < count; ++i) square[i] = columns[c + i];
    const Lanes<T> totals = row_sums<T>(square);
    __builtin_memcpy(&slot.s + c, &totals, count * sizeof(T));
  }
}

// Loads the cotangents, and the light that got past everything.
template <class T>
void load_tile(TileCotangents<T>& t, const View& view, int64_t x0, int64_t y0, const T* passed,
               const Layers& cotangents) {
  std::memset(static_cast<void*>(&t), 0, sizeof(t));
  const T *v_rgb = static_cast<const T*>(cotangents.rgb), *v_depth = static_cast<const T*>(cotangents.depth_sum);
  const T* v_passed = static_cast<const T*>(cotangents.transmittance);
  for_each_pixel(view, x0, y0, [&](int to, int64_t from) {
    t.transmittance[to] = passed[from];
    if (v_passed) t.behind[to] = passed[from] * v_passed[from];
    if (v_depth) t.depth[to] = v_depth[from];
    if (v_rgb) t.red[to] = v_rgb[3 * from], t.green[to] = v_rgb[3 * from + 1], t.blue[to] = v_rgb[3 * from + 2];
  });
}

template <class T, bool GATED>
void blend_tile_backward(Workspace<T>& ws, const Cuts<T>& cuts, int64_t tile, const TilePixels<T>& pixels,
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
    Slot<Lanes<T>> sums{};
    Lanes<T> gate{};
    for_each_register<T>(ws.masks[k], [&](int at) {
      accumulate_register<T, GATED>(s, pixels, cuts, t, at, T(k - begin), sums, gate);
    });
    store_totals(sums, ws.slots[ws.pairs[k].slot]);
    if (GATED) ws.gate_slots[ws.pairs[k].slot] = total<T>(gate);
  }
}

template <class T, bool GATED>
void blend_tiles_backward(Workspace<T>& ws, const View& view, const T* transmittance, const Layers& cotangents) {
  const Cuts<T> cuts(view);
#pragma omp parallel for num_threads(view.threads) schedule(dynamic, 1)
  for (int64_t tile = 0; tile < ws.tiles_x * ws.tiles_y; ++tile) {
    const int64_t x0 = tile % ws.tiles_x * TILE, y0 = tile / ws.tiles_x * TILE;
    const TilePixels<T> pixels(x0, y0);
    TileCotangents<T> t;
    load_tile(t, view, x0, y0, transmittance, cotangents);
    std::memcpy(t.last, &ws.last_pairs[tile * PIXELS], sizeof(t.last));
    blend_tile_backward<T, GATED>(ws, cuts, tile, pixels, t);
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
