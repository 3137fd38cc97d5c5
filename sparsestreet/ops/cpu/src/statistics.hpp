// What one view adds to the statistics of rows: the norm of the gradient on screen, scaled to half the image, a visit,
// and the largest radius. Rows that were not drawn, or whose gradient is not finite, have neither norm nor visit.
#pragma once
#include <cmath>
#include <cstdint>
#include <limits>

#include "interface.h"

namespace SPLAT_VARIANT {

template <class T>
constexpr T INFINITE = std::numeric_limits<T>::infinity();

// Squares of a large gradient are beyond float.
inline float norm_of(float x, float y) { return float(std::sqrt(double(x) * double(x) + double(y) * double(y))); }
inline double norm_of(double x, double y) { return std::hypot(x, y); }

// A row's norm, or infinity where it has no say.
template <class T>
inline T drawn_norm(const splat::ScreenView& view, int64_t row) {
  const T *gradient = static_cast<const T*>(view.gradient), *radii = static_cast<const T*>(view.radii);
  const T norm = norm_of(gradient[2 * row] * T(view.half_width), gradient[2 * row + 1] * T(view.half_height));
  return radii[row] > 0 && norm < INFINITE<T> ? norm : INFINITE<T>;
}

template <class T>
void add_statistics(const splat::ScreenView& view, const splat::RowStatistics& into) {
  if (into.visits) {
    const T *radii = static_cast<const T*>(view.radii), longer = T(view.longer);
    T *sum = static_cast<T*>(into.gradient_sum), *largest = static_cast<T*>(into.largest_screen);
    int64_t* visits = into.visits;
    const int64_t every = view.visits_all;
#pragma omp parallel for simd num_threads(view.threads) schedule(static)
    for (int64_t row = 0; row < view.rows; ++row) {
      const T norm = drawn_norm<T>(view, row), share = radii[row] / longer;
      const bool drawn = norm < INFINITE<T>;
      sum[row] += drawn ? norm : T(0);
      visits[row] += drawn ? 1 : every;
      largest[row] = share > largest[row] ? share : largest[row];
    }
  }
  if (into.watched) {
    const T* watched = static_cast<const T*>(into.watched);
    T* sum = static_cast<T*>(into.watched_sum);
#pragma omp parallel for simd num_threads(view.threads) schedule(static)
    for (int64_t row = 0; row < view.rows; ++row) {
      const T size = std::abs(watched[row]);
      sum[row] += drawn_norm<T>(view, row) < INFINITE<T> && size < INFINITE<T> ? size : T(0);
    }
  }
}

}  // namespace SPLAT_VARIANT
