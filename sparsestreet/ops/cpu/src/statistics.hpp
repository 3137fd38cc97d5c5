// What one view adds to the statistics of rows: the norm of the gradient on screen, scaled to half the image, a visit,
// and the largest radius. Rows that were not drawn, or whose gradient is not finite, have neither norm nor visit.
#pragma once
#include <cmath>
#include <cstdint>
#include <limits>

#include "interface.h"

namespace SPLAT_VARIANT {

// Squares of a large gradient are beyond float.
inline float norm_of(float x, float y) { return float(std::sqrt(double(x) * double(x) + double(y) * double(y))); }
inline double norm_of(double x, double y) { return std::hypot(x, y); }

template <class T>
void add_statistics(const splat::ScreenView& view, const splat::RowStatistics& into) {
  const T *gradient = static_cast<const T*>(view.gradient), *radii = static_cast<const T*>(view.radii);
  const T half_width = T(view.half_width), half_height = T(view.half_height), longer = T(view.longer);
  const T *watched = static_cast<const T*>(into.watched), infinity = std::numeric_limits<T>::infinity();
  T *sum = static_cast<T*>(into.gradient_sum), *largest = static_cast<T*>(into.largest_screen);
  T* watched_sum = static_cast<T*>(into.watched_sum);
  const bool every = view.visits_all;
#pragma omp parallel for simd num_threads(view.threads) schedule(static)
  for (int64_t row = 0; row < view.rows; ++row) {
    const T norm = norm_of(gradient[2 * row] * half_width, gradient[2 * row + 1] * half_height);
    const bool drawn = (radii[row] > 0) & (norm < infinity);
    if (sum) {
      const T share = radii[row] / longer;
      sum[row] += drawn ? norm : T(0);
      into.visits[row] += every | drawn;
      largest[row] = share > largest[row] ? share : largest[row];
    }
    if (watched) {
      const T size = std::abs(watched[row]);
      watched_sum[row] += (drawn & (size < infinity)) ? size : T(0);
    }
  }
}

}  // namespace SPLAT_VARIANT
