// Weighted means over pixels of one number each, and what their gradients need; errors of colors, and what of both images
// D-SSIM compares.
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

template <class T>
void compare_colors(const splat::Colors& colors, void* seen, void* truth, void* error) {
  const T* image = static_cast<const T*>(colors.image);
  T *xs = static_cast<T*>(seen), *ys = static_cast<T*>(truth);
  const int white = int(colors.white);
  const int64_t blocks = (colors.numbers + BLOCK_PIXELS - 1) / BLOCK_PIXELS;
  Buffer<double> sums;
  sums.reserve(blocks);
#pragma omp parallel for num_threads(colors.threads) schedule(static)
  for (int64_t block = 0; block < blocks; ++block) {
    const int64_t end = std::min(colors.numbers, (block + 1) * BLOCK_PIXELS);
    double sum = 0;
#pragma omp simd reduction(+ : sum)
    for (int64_t i = block * BLOCK_PIXELS; i < end; ++i) {
      const int level = colors.recorded[i];
      const T y = T(level) / 255, x = (level >= white) & (image[i] > y) ? y : image[i];
      xs[i] = x, ys[i] = y;
      sum += std::abs(x - y);
    }
    sums[block] = sum;
  }
  double sum = 0;
  for (int64_t block = 0; block < blocks; ++block) sum += sums[block];
  *static_cast<T*>(error) = T(colors.scale * sum);
}

template <class T>
void compare_colors_backward(const splat::Colors& colors, const void* truth, const void* v_value, void* v_image) {
  const T *image = static_cast<const T*>(colors.image), *ys = static_cast<const T*>(truth);
  const T pull = T(*static_cast<const T*>(v_value) * colors.scale);
  T* v = static_cast<T*>(v_image);
  const int white = int(colors.white);
#pragma omp parallel for simd num_threads(colors.threads) schedule(static)
  for (int64_t i = 0; i < colors.numbers; ++i) {
    const T x = image[i], y = ys[i], moved = v[i] + (x > y ? pull : x < y ? -pull : T(0));
    v[i] = (colors.recorded[i] >= white) & (x > y) ? T(0) : moved;
  }
}

}  // namespace SPLAT_VARIANT
