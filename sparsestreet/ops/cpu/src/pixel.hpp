// What the pixel loops share: alpha, the stop rule, and where a splat meets a tile.
#pragma once
#include "workspace.hpp"

namespace SPLAT_VARIANT {

// The cut-offs, ready for the pixel loops.
template <class T>
struct Cuts {
  T alpha_max, transmittance_min;
  // Even without a stop a pixel ends before its transmittance underflows: backward divides by what got past.
  explicit Cuts(const View& v)
      : alpha_max(v.alpha_max),
        transmittance_min(std::fmax(T(v.transmittance_min), sizeof(T) == 4 ? T(1e-30) : T(1e-280))) {}
};

// Splats ahead whose record is fetched while one is blended.
constexpr int64_t PREFETCH = 8;
// Pairs between two looks at whether the whole tile is finished.
constexpr int64_t LOOK = 16;

// The part of a splat in one tile: dx per column, and the rows of the tile it reaches.
template <class T>
struct TileSplat {
  alignas(64) T dx[TILE];
  int first, last;  // inclusive
  TileSplat(const Splat<T>& s, int64_t x0, int64_t y0) {
    const T offset = T(x0) + T(0.5) - s.x;
    for (int i = 0; i < TILE; ++i) dx[i] = offset + T(i);
    first = int(s.first_row > y0 ? s.first_row - y0 : 0);
    last = int(s.last_row < y0 + TILE - 1 ? s.last_row - y0 : TILE - 1);
  }
};

template <class T>
struct Sample {
  Lanes<T> a;      // first component of L d
  Lanes<T> raw;    // alpha before the clamp
  Lanes<T> alpha;  // 0 past the splat's end
};

// Evaluates a splat in neighboring pixels of one row.
template <class T>
inline Sample<T> sample(const Splat<T>& s, const Lanes<T>& dx, T along, T base, const Cuts<T>& cuts) {
  Sample<T> p;
  p.a = s.l11 * dx + along;
  const Lanes<T> exponent = base - p.a * p.a;
  p.raw = exp2_nonpositive(larger(exponent, same(T(-126))));
  p.alpha = exponent >= s.least_exponent ? smaller(p.raw, same(cuts.alpha_max)) : Lanes<T>{};
  return p;
}

// What of alpha is blended: nothing in finished pixels. Whether a pixel is still open is decided by the transmittance
// itself for the inclusive stop, by the product that includes dropped splats for the exclusive one.
template <class T, bool EXCLUSIVE>
inline Lanes<T> still_open(const Lanes<T>& alpha, const Cuts<T>& cuts, const Lanes<T>& transmittance, T* product) {
  if (!EXCLUSIVE) return transmittance > cuts.transmittance_min ? alpha : Lanes<T>{};
  Lanes<T> passed = load(product);
  passed = passed - alpha * passed;
  store(product, passed);
  return passed > cuts.transmittance_min ? alpha : Lanes<T>{};
}

template <class T>
inline T total(const Lanes<T>& values) {
  T each[LANES<T>], sum = 0;
  store(each, values);
  for (int i = 0; i < LANES<T>; ++i) sum += each[i];
  return sum;
}

template <class T>
inline bool tile_finished(const T* state, T least) {
  T most = 0;
  for (int i = 0; i < PIXELS; ++i) most = state[i] > most ? state[i] : most;
  return most <= least;
}

// 1 inside the image, 0 outside: pixels outside are finished from the start.
template <class T>
inline void open_tile(T* state, const View& view, int64_t x0, int64_t y0) {
  for (int y = 0; y < TILE; ++y)
    for (int x = 0; x < TILE; ++x) state[y * TILE + x] = T(x0 + x < view.width && y0 + y < view.height);
}

}  // namespace SPLAT_VARIANT
