// Structural similarity of two images (Wang et al. 2004) and its gradient to the first. In s = x + y and d = x - y,
// with their window means m_s, m_d and variances V_s, V_d, it is luminance x contrast,
//   luminance = (m_s^2 - m_d^2 + 2 C1) / (m_s^2 + m_d^2 + 2 C1), contrast = (V_s - V_d + 2 C2) / (V_s + V_d + 2 C2).
// Four window means do the work of five, and where the images are alike their small difference keeps its digits.
//
// A block of lines and columns is one task. Each of its lines is filtered down the window, into memory that stays in
// the nearest cache, and there across. Channels are interleaved: a tap across is three numbers away, and a column is
// one number of a line.
#pragma once
#include <algorithm>

#include "buffer.hpp"
#include "interface.h"

namespace SPLAT_VARIANT::ssim {

using splat::ImagePair;

constexpr int CHANNELS = 3, PAD = splat::SSIM_WINDOW - 1, HALO = PAD * CHANNELS;
constexpr int BLOCK_LINES = 16, BLOCK_COLUMNS = 480;

template <class T>
using Taps = T[PAD + 1];
// A line of a block, and the columns that its windows reach beyond it.
template <class T>
struct Line {
  alignas(64) T at[BLOCK_COLUMNS + HALO];
};

// Blocks of lines x columns, the last ones smaller.
struct Blocks {
  int64_t lines, columns, across, count;
  Blocks(int64_t lines, int64_t columns)
      : lines(lines), columns(columns), across((columns + BLOCK_COLUMNS - 1) / BLOCK_COLUMNS),
        count(across * ((lines + BLOCK_LINES - 1) / BLOCK_LINES)) {}
};
struct Block {
  int64_t first, last, column;
  int columns;
  Block(const Blocks& all, int64_t index)
      : first(index / all.across * BLOCK_LINES), last(std::min(first + BLOCK_LINES, all.lines)),
        column(index % all.across * BLOCK_COLUMNS),
        columns(int(std::min<int64_t>(BLOCK_COLUMNS, all.columns - column))) {}
};

template <class T>
struct Images {
  const T *x, *y;
  int64_t lines, columns;
  Taps<T> taps;
  T c1, c2;  // twice the constants
  explicit Images(const ImagePair& p)
      : x(static_cast<const T*>(p.image)), y(static_cast<const T*>(p.truth)), lines(p.height),
        columns(p.width * CHANNELS), c1(T(2 * p.c1)), c2(T(2 * p.c2)) {
    std::copy(p.taps, p.taps + PAD + 1, taps);
  }
  // Of the map of similarities: pixels whose window lies inside.
  Blocks map() const { return {lines - PAD, columns - HALO}; }
};

// Replaces a line by its means across the window, which is symmetric.
template <class T>
inline void across(Line<T>& line, const Taps<T>& taps, int columns) {
  for (int i = 0; i < columns; ++i) {
    const T* from = line.at + i;
    T sum = taps[PAD / 2] * from[HALO / 2];
    for (int k = 0; k < PAD / 2; ++k) sum += taps[k] * (from[k * CHANNELS] + from[HALO - k * CHANNELS]);
    line.at[i] = sum;
  }
}

template <class T>
struct Moments {
  Line<T> s, d, ss, dd;
};

// Means down the window of s - level, d and their squares. Variances are taken about a color of the block: about zero,
// bright flat skies would leave them few digits.
template <class T>
inline void down(const Images<T>& images, int64_t line, int64_t column, int columns, const Line<T>& level,
                 Moments<T>& means) {
  const int64_t stride = images.columns;
  const T *x = images.x + line * stride + column, *y = images.y + line * stride + column;
  for (int i = 0; i < columns; ++i) {
    T sum_s = 0, sum_d = 0, sum_ss = 0, sum_dd = 0;
    for (int k = 0; k <= PAD; ++k) {
      const T a = x[k * stride + i], b = y[k * stride + i], s = (a + b) - level.at[i], d = a - b;
      const T weighted_s = images.taps[k] * s, weighted_d = images.taps[k] * d;
      sum_s += weighted_s, sum_d += weighted_d, sum_ss += weighted_s * s, sum_dd += weighted_d * d;
    }
    means.s.at[i] = sum_s, means.d.at[i] = sum_d, means.ss.at[i] = sum_ss, means.dd.at[i] = sum_dd;
  }
}

// Derivatives of a similarity by the mean of x, and by the means of s^2 and d^2.
template <class T>
struct Partials {
  T *mean, *ss, *dd;
  Partials(T* all, const Blocks& map)
      : mean(all), ss(all + map.lines * map.columns), dd(all + 2 * map.lines * map.columns) {}
};

// Sum of the similarities of a line of a block. 1 - luminance is 2 m_d^2 over its denominator and 1 - contrast is 2 V_d
// over its own: put in, they leave no derivative that is a difference of nearly equal numbers.
template <class T, bool GRADIENT>
inline double similarities(const Images<T>& images, const Moments<T>& means, const Line<T>& level, int columns,
                           const Partials<T>& out, int64_t at) {
  T *of_mean = out.mean + at, *of_ss = out.ss + at, *of_dd = out.dd + at;
  double total = 0;
  for (int i = 0; i < columns; ++i) {
    const T low = means.s.at[i], d = means.d.at[i], s = low + level.at[i];
    const T var_s = means.ss.at[i] - low * low, var_d = means.dd.at[i] - d * d;
    const T by_luminance = 1 / (s * s + d * d + images.c1), by_contrast = 1 / (var_s + var_d + images.c2);
    const T luminance = (s * s - d * d + images.c1) * by_luminance;
    const T contrast = (var_s - var_d + images.c2) * by_contrast;
    total += luminance * contrast;
    if constexpr (GRADIENT) {
      const T v_ss = 2 * luminance * var_d * by_contrast * by_contrast;
      const T v_dd = -luminance * (1 + contrast) * by_contrast;
      const T v_s = 4 * contrast * s * d * d * by_luminance * by_luminance;
      const T v_d = -2 * contrast * (1 + luminance) * d * by_luminance;
      of_mean[i] = v_s + v_d - 2 * (s * v_ss + d * v_dd);
      of_ss[i] = v_ss, of_dd[i] = v_dd;
    }
  }
  return total;
}

template <class T, bool GRADIENT>
double similarity_block(const Images<T>& images, const Block& block, const Partials<T>& out) {
  Moments<T> means;
  Line<T> level;
  const int64_t corner = block.first * images.columns + block.column;
  const int wide = block.columns + HALO;
  for (int i = 0; i < wide; ++i) level.at[i] = images.x[corner + i % CHANNELS] + images.y[corner + i % CHANNELS];
  double total = 0;
  for (int64_t line = block.first; line < block.last; ++line) {
    down(images, line, block.column, wide, level, means);
    for (Line<T>* each : {&means.s, &means.d, &means.ss, &means.dd}) across(*each, images.taps, block.columns);
    const int64_t at = line * (images.columns - HALO) + block.column;
    total += similarities<T, GRADIENT>(images, means, level, block.columns, out, at);
  }
  return total;
}

// Mean of the similarities, and where `partials` is not null their derivatives [3,h-10,w-10,3]. Blocks do not depend on
// the number of threads, and their sums are added in order.
template <class T>
void similarity(const ImagePair& pair, T* partials, T* mean) {
  const Images<T> images(pair);
  const Blocks map = images.map();
  const Partials<T> out(partials, map);
  Buffer<double> sums;
  sums.reserve(map.count);
#pragma omp parallel for num_threads(pair.threads) schedule(dynamic, 1)
  for (int64_t i = 0; i < map.count; ++i)
    sums[i] = partials ? similarity_block<T, true>(images, Block(map, i), out)
                       : similarity_block<T, false>(images, Block(map, i), out);
  double total = 0;
  for (int64_t i = 0; i < map.count; ++i) total += sums[i];
  *mean = T(total / double(map.lines * map.columns));
}

// Mean of one derivative over the windows that reach `line`, for those that end at `column` and after it; the map is 0
// outside.
template <class T>
inline void down_map(const T* map, const Blocks& size, int64_t line, int64_t column, int columns, const Taps<T>& taps,
                     Line<T>& out) {
  static const Line<T> zeros{};
  const int begin = int(std::max<int64_t>(0, HALO - column));
  const int end = int(std::min<int64_t>(columns + HALO, size.columns + HALO - column));
  const T* from[PAD + 1];
  for (int k = 0; k <= PAD; ++k) {
    const int64_t above = line - PAD + k;
    from[k] = above >= 0 && above < size.lines ? map + above * size.columns + (column - HALO + begin) : zeros.at;
  }
  std::fill(out.at, out.at + begin, T(0)), std::fill(out.at + end, out.at + columns + HALO, T(0));
  for (int i = 0; i < end - begin; ++i) {
    T sum = 0;
    for (int k = 0; k <= PAD; ++k) sum += taps[k] * from[k][i];
    out.at[begin + i] = sum;
  }
}

template <class T>
void similarity_backward_block(const Images<T>& images, const Block& block, const Partials<T>& partials, T scale,
                               T* v_image) {
  const Blocks map = images.map();
  Line<T> of_mean, of_ss, of_dd;
  for (int64_t line = block.first; line < block.last; ++line) {
    down_map(partials.mean, map, line, block.column, block.columns, images.taps, of_mean);
    down_map(partials.ss, map, line, block.column, block.columns, images.taps, of_ss);
    down_map(partials.dd, map, line, block.column, block.columns, images.taps, of_dd);
    for (Line<T>* each : {&of_mean, &of_ss, &of_dd}) across(*each, images.taps, block.columns);
    const int64_t at = line * images.columns + block.column;
    const T *x = images.x + at, *y = images.y + at;
    for (int i = 0; i < block.columns; ++i) {
      const T by_square = (x[i] + y[i]) * of_ss.at[i] + (x[i] - y[i]) * of_dd.at[i];
      v_image[at + i] = scale * (of_mean.at[i] + 2 * by_square);
    }
  }
}

template <class T>
void similarity_backward(const ImagePair& pair, T* partials, T v_mean, T* v_image) {
  const Images<T> images(pair);
  const Blocks map = images.map(), all(images.lines, images.columns);
  const T scale = T(double(v_mean) / double(map.lines * map.columns));
  const Partials<T> derivatives(partials, map);
#pragma omp parallel for num_threads(pair.threads) schedule(dynamic, 1)
  for (int64_t i = 0; i < all.count; ++i)
    similarity_backward_block(images, Block(all, i), derivatives, scale, v_image);
}

}  // namespace SPLAT_VARIANT::ssim
