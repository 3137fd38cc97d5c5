// What the pixel loops share: alpha and the stop rule.
#pragma once
#include "blocks.hpp"

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

template <class T>
struct Sample {
  Lanes<T> dx, dy, a, b;  // d and L d
  Lanes<T> raw;           // alpha before the clamp
  Lanes<T> alpha;         // 0 past the splat's end
};

// Evaluates a splat in a register of pixels.
template <class T>
inline Sample<T> sample(const Splat<T>& s, const TilePixels<T>& pixels, int at, const Cuts<T>& cuts) {
  Sample<T> p;
  p.dx = load(pixels.x + at) - s.x, p.dy = load(pixels.y + at) - s.y;
  p.a = s.l11 * p.dx + s.l21 * p.dy, p.b = s.l22 * p.dy;
  const Lanes<T> exponent = s.log2_opacity - p.b * p.b - p.a * p.a;
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
  T sum = 0;
  for (int i = 0; i < LANES<T>; ++i) sum += values[i];
  return sum;
}

// 1 inside the image, 0 outside: pixels outside are finished from the start.
template <class T>
inline void open_tile(T* state, const View& view, const TilePixels<T>& pixels) {
  const T width = T(view.width), height = T(view.height);
  for (int at = 0; at < PIXELS; ++at) state[at] = T(pixels.x[at] < width && pixels.y[at] < height);
}

}  // namespace SPLAT_VARIANT
