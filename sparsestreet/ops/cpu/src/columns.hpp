// Rows in memory to registers that hold one column each, and back: squares of LANES x LANES are transposed in
// registers.
#pragma once
#include <utility>

#include "lanes.hpp"

namespace SPLAT_VARIANT {

// The lanes `i` of a and b put together, those of b counted on from LANES<T>.
#if __has_builtin(__builtin_shufflevector)
template <class T, int... i>
inline Lanes<T> picked(const Lanes<T>& a, const Lanes<T>& b) { return __builtin_shufflevector(a, b, i...); }
#else  // gcc before 12
template <class T, int... i>
inline Lanes<T> picked(const Lanes<T>& a, const Lanes<T>& b) { return __builtin_shuffle(a, b, Integers<T>{i...}); }
#endif

// One step of the butterfly: exchanges the off-diagonal halves of blocks of 2 * half rows and columns.
template <class T, int half, int... i>
inline void exchange(Lanes<T>* square, std::integer_sequence<int, i...>) {
  for (int r = 0; r < LANES<T>; ++r) {
    if (r & half) continue;
    const Lanes<T> a = square[r], b = square[r + half];
    square[r] = picked<T, (i & half ? LANES<T> + i - half : i)...>(a, b);
    square[r + half] = picked<T, (i & half ? LANES<T> + i : i + half)...>(a, b);
  }
}

template <class T, int half = LANES<T> / 2>
inline void transpose(Lanes<T>* square) {
  exchange<T, half>(square, std::make_integer_sequence<int, LANES<T>>{});
  if constexpr (half > 1) transpose<T, half / 2>(square);
}

// One step of the sums: of each 2 * half lanes of a row, one half is added to the other; there the row `half` below
// puts its own.
template <class T, int half, int... i>
inline void add_halves(Lanes<T>* square, std::integer_sequence<int, i...>) {
  for (int r = 0; r < half; ++r) {
    const Lanes<T> a = square[r], b = square[r + half];
    square[r] = picked<T, (i & half ? LANES<T> + i : i)...>(a, b) +
                picked<T, (i & half ? LANES<T> + i - half : i + half)...>(a, b);
  }
}

// Lane i: the sum of the lanes of square[i]. Spoils the square.
template <class T, int half = LANES<T> / 2>
inline Lanes<T> row_sums(Lanes<T>* square) {
  add_halves<T, half>(square, std::make_integer_sequence<int, LANES<T>>{});
  if constexpr (half > 1) return row_sums<T, half / 2>(square);
  return square[0];
}

// out[c] lane r = row(r)[c]; row(r) must be readable for every lane. A last square that is not full begins earlier.
template <class T, class RowAt>
inline void load_columns(RowAt row, int columns, Lanes<T>* out) {
  int c = 0;
  for (; c + LANES<T> <= columns; c += LANES<T>) {
    for (int r = 0; r < LANES<T>; ++r) out[c + r] = load<T>(row(r) + c);
    transpose<T>(out + c);
  }
  if (c < columns && columns > LANES<T>) {
    Lanes<T> square[LANES<T>];
    const int from = columns - LANES<T>;
    for (int r = 0; r < LANES<T>; ++r) square[r] = load<T>(row(r) + from);
    transpose<T>(square);
    for (; c < columns; ++c) out[c] = square[c - from];
  }
  for (; c < columns; ++c)
    for (int r = 0; r < LANES<T>; ++r) out[c][r] = row(r)[c];
}

// row(r)[c] = in[c] lane r. Lanes may share a row if they agree.
template <class T, class RowAt>
inline void store_columns(const Lanes<T>* in, int columns, RowAt row) {
  int c = 0;
  const auto store_square = [&](int from) {
    Lanes<T> square[LANES<T>];
    for (int r = 0; r < LANES<T>; ++r) square[r] = in[from + r];
    transpose<T>(square);
    for (int r = 0; r < LANES<T>; ++r) store<T>(row(r) + from, square[r]);
  };
  for (; c + LANES<T> <= columns; c += LANES<T>) store_square(c);
  if (c < columns && columns > LANES<T>) store_square(columns - LANES<T>), c = columns;
  for (; c < columns; ++c)
    for (int r = 0; r < LANES<T>; ++r) row(r)[c] = in[c][r];
}

}  // namespace SPLAT_VARIANT
