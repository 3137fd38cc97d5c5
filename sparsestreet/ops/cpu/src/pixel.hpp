// What the pixel loops share: 2^x, alpha, and the state of a tile.
#pragma once
#include <cmath>

#include "workspace.hpp"

namespace SPLAT_VARIANT {

// 2^x for x in [-126, 0]: rounding and a minimax polynomial of degree 5 on [-1/2, 1/2] (relative error 1.2e-7).
// A conversion and a shift, as these vectorise on every target.
inline float exp2_nonpositive(float x) {
  const int32_t n = int32_t(x - 0.5f);
  const float f = x - float(n);
  float p = 1.3276472454890609e-03f;
  p = p * f + 9.6755409613251686e-03f;
  p = p * f + 5.5507130920886993e-02f;
  p = p * f + 2.4022120237350464e-01f;
  p = p * f + 6.9314694404602051e-01f;
  p = p * f + 1.0f;
  const int32_t bits = (n + 127) << 23;
  float scale;
  std::memcpy(&scale, &bits, sizeof(scale));
  return p * scale;
}
inline double exp2_nonpositive(double x) { return std::exp2(x); }

// The cut-offs, ready for the pixel loops.
template <class T>
struct Cuts {
  T log2_alpha_min, alpha_max, transmittance_min;
  explicit Cuts(const View& v)
      // Without a cut-off the exponent still ends where float does: 2^-126.
      : log2_alpha_min(v.alpha_min > 0 ? T(std::log2(v.alpha_min)) : T(-126)), alpha_max(v.alpha_max),
        transmittance_min(v.transmittance_min) {}
};

// Splats ahead whose record is fetched while one is blended.
constexpr int64_t PREFETCH = 8;
// Pairs between two looks at whether the whole tile is finished.
constexpr int64_t LOOK = 16;

// The part of a splat in one tile: dx per column, and the image rows it reaches.
template <class T>
struct TileSplat {
  T dx[TILE];
  int first, last;  // rows within the tile, inclusive
  TileSplat(const Splat<T>& s, int64_t x0, int64_t y0) {
    const T offset = T(x0) + T(0.5) - s.x;
    for (int i = 0; i < TILE; ++i) dx[i] = offset + T(i);
    first = int(s.first_row > y0 ? s.first_row - y0 : 0);
    last = int(s.last_row < y0 + TILE - 1 ? s.last_row - y0 : TILE - 1);
  }
};

// `gate` decides whether a pixel is still open: the transmittance itself for the inclusive stop, the product that
// includes dropped splats for the exclusive one.
template <class T>
inline bool tile_finished(const T* gate, T least) {
  T most = 0;
  for (int i = 0; i < PIXELS; ++i) most = gate[i] > most ? gate[i] : most;
  return most <= least;
}

// 1 inside the image, 0 outside: pixels outside are finished from the start.
template <class T>
inline void open_tile(T* state, const View& view, int64_t x0, int64_t y0) {
  for (int y = 0; y < TILE; ++y)
    for (int x = 0; x < TILE; ++x) state[y * TILE + x] = T(x0 + x < view.width && y0 + y < view.height);
}

}  // namespace SPLAT_VARIANT
