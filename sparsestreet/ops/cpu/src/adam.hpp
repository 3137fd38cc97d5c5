// One step of Adam for the rows whose gradient is finite (Kingma & Ba 2015, algorithm 1). A gradient is read once: a
// block of it is looked at, and is still in the cache when its rows step.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "interface.h"
#include "lanes.hpp"

namespace SPLAT_VARIANT {

constexpr int64_t BLOCK_NUMBERS = 2048;  // 8 kB of float32: they stay in the first cache

template <class T>
inline T fused(T a, T b, T c) {
#ifdef __FMA__
  return std::fma(a, b, c);
#else
  return a * b + c;
#endif
}

// x - x is 0 for finite numbers, NaN for all others. Four registers of sums, so that no addition waits for the last.
template <class T>
inline bool finite(const T* values, int64_t count) {
  constexpr int N = LANES<T>;
  Lanes<T> sums[4] = {};
  int64_t i = 0;
  for (; i + 4 * N <= count; i += 4 * N)
    for (int k = 0; k < 4; ++k) sums[k] += load(values + i + k * N) - load(values + i + k * N);
  T sum = 0;
  for (; i < count; ++i) sum += values[i] - values[i];
  const Lanes<T> all = (sums[0] + sums[1]) + (sums[2] + sums[3]);
  for (int lane = 0; lane < N; ++lane) sum += all[lane];
  return sum == 0;
}

// Rounded as torch's fused Adam rounds on processors with fused multiplication: in the last numbers of a tensor, which
// fill no register of eight, it fuses the other product.
template <class T>
inline void step_numbers(const splat::AdamRows& a, int64_t begin, int64_t end) {
  T *p = static_cast<T*>(a.parameter), *m = static_cast<T*>(a.exp_avg), *v = static_cast<T*>(a.exp_avg_sq);
  const T* g = static_cast<const T*>(a.gradient);
  const T share = T(a.share), beta = T(a.beta), square_share = T(a.square_share);
  const T root = T(a.root), eps = T(a.eps), size = -T(a.size);
  const int64_t numbers = a.rows * a.width, whole = numbers - numbers % 8;
  const auto finish = [&](int64_t i, T second) {
    const T first = fused(share, g[i] - m[i], m[i]);
    m[i] = first, v[i] = second;
    p[i] += size * first / (std::sqrt(second) / root + eps);
  };
  const int64_t split = std::max(begin, std::min(end, whole));
#pragma omp simd
  for (int64_t i = begin; i < split; ++i) finish(i, fused(square_share * g[i], g[i], v[i] * beta));
  for (int64_t i = split; i < end; ++i) finish(i, fused(v[i], beta, square_share * g[i] * g[i]));
}

inline int64_t rows_of_block(int64_t width) { return std::max<int64_t>(1, BLOCK_NUMBERS / width); }

// One block of a table: where a number in it is not finite, row by row.
template <class T>
void step_block(const splat::AdamRows& a, int64_t row) {
  const T* g = static_cast<const T*>(a.gradient);
  const int64_t width = a.width, last = std::min(row + rows_of_block(width), a.rows);
  if (finite(g + row * width, (last - row) * width)) {
    step_numbers<T>(a, row * width, last * width);
    return;
  }
  int64_t refused = 0, first = std::numeric_limits<int64_t>::max();
  for (int64_t one = row; one < last; ++one) {
    if (finite(g + one * width, width)) {
      step_numbers<T>(a, one * width, (one + 1) * width);
    } else {
      ++refused, first = std::min(first, one);
    }
  }
#pragma omp critical(splat_adam_refused)
  a.refused[0] += refused, a.refused[1] = std::min(a.refused[1], first);
}

// All tables in one go: threads meet once a step, and who is done with a table goes on with the next.
template <class T>
void adam(const splat::AdamRows* tables, int64_t count, int64_t threads) {
#pragma omp parallel num_threads(threads)
  for (int64_t i = 0; i < count; ++i) {
#pragma omp for schedule(static) nowait
    for (int64_t row = 0; row < tables[i].rows; row += rows_of_block(tables[i].width)) step_block<T>(tables[i], row);
  }
}

}  // namespace SPLAT_VARIANT
