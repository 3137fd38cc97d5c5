// Weighted means over pixels of one number each, and what their gradients need.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "buffer.hpp"
#include "interface.h"

namespace SPLAT_VARIANT {

constexpr int64_t BLOCK_PIXELS = 4096;

// A pixel's number, its derivative, and whether it counts.
template <class T>
struct PixelNumber {
  T value, slope;
  bool counts;
};

template <class T, bool INVERSE>
inline PixelNumber<T> depth_number(const splat::PixelTerm& term, T rendered, T measured) {
  const bool valid =
      (measured > T(term.numbers[0])) & (measured < T(term.numbers[1])) & (rendered > T(term.numbers[2]));
  // 1 m stands where none is.
  const T r = valid ? rendered : T(1), m = valid ? measured : T(1);
  const T error = INVERSE ? 1 / r - 1 / m : r - m, slope = INVERSE ? -1 / (r * r) : T(1);
  return {std::abs(error), error > 0 ? slope : error < 0 ? -slope : T(0), valid};
}

template <class T>
inline PixelNumber<T> sky_number(const splat::PixelTerm& term, T alpha, bool sky) {
  const T eps = T(term.numbers[0]), floor = T(term.numbers[1]), right = sky ? 1 - alpha : alpha;
  const T held = right < floor ? floor : right, slope = 1 / (held + eps);  // NaN remains
  return {-std::log((held + eps) / (1 + eps)), sky ? slope : -slope, true};
}

// Blocks do not depend on the number of threads, and their sums are added in order.
template <class T, class Truth, class NumberOf>
void mean_over_pixels(const splat::PixelTerm& term, const T* predicted, const Truth* truth, T* slopes, T* mean, T* share,
                      NumberOf number_of) {
  const int64_t blocks = (term.pixels + BLOCK_PIXELS - 1) / BLOCK_PIXELS;
  Buffer<double> sums;
  sums.reserve(2 * blocks);
#pragma omp parallel for num_threads(term.threads) schedule(static)
  for (int64_t block = 0; block < blocks; ++block) {
    const int64_t end = std::min(term.pixels, (block + 1) * BLOCK_PIXELS);
    double sum = 0, count = 0;
    for (int64_t i = block * BLOCK_PIXELS; i < end; ++i) {
      const PixelNumber<T> number = number_of(term, predicted[i], truth[i]);
      sum += number.counts ? double(number.value) : 0.0, count += number.counts;
      if (slopes) slopes[i] = number.slope;
    }
    sums[2 * block] = sum, sums[2 * block + 1] = count;
  }
  double sum = 0, count = 0;
  for (int64_t block = 0; block < blocks; ++block) sum += sums[2 * block], count += sums[2 * block + 1];
  const double each = term.weight / std::max(count, 1.0);
  *mean = T(each * sum), *share = T(each);
}

template <class T>
void pixel_mean(const splat::PixelTerm& term, const void* predicted, const void* truth, void* slopes, void* mean,
                void* share) {
  const auto over = [&](auto* recorded, auto number_of) {
    mean_over_pixels(term, static_cast<const T*>(predicted), recorded, static_cast<T*>(slopes), static_cast<T*>(mean),
                     static_cast<T*>(share), number_of);
  };
  const T* measured = static_cast<const T*>(truth);
  if (term.kind == splat::DEPTH)
    over(measured, [](const auto& t, T r, T m) { return depth_number<T, false>(t, r, m); });
  else if (term.kind == splat::INVERSE_DEPTH)
    over(measured, [](const auto& t, T r, T m) { return depth_number<T, true>(t, r, m); });
  else
    over(static_cast<const uint8_t*>(truth), [](const auto& t, T a, uint8_t s) { return sky_number<T>(t, a, s); });
}

}  // namespace SPLAT_VARIANT
