// Tables of spherical harmonics as scene nodes keep them, and of their gradients.
#pragma once
#include <algorithm>

#include "columns.hpp"
#include "stream.hpp"
#include "workspace.hpp"

namespace SPLAT_VARIANT {

// The coefficients of the rows `begin` to `end` among all.
template <class T>
struct HarmonicTable {
  int64_t begin, end, terms;

  HarmonicTable(const Harmonics& h, int64_t begin)
      : begin(begin), end(begin + h.rows), terms(h.terms), stored_rest(h.stored_rest), first_stride(h.first_stride),
        rest_stride(h.rest_stride), first(static_cast<const T*>(h.first)), rest(static_cast<const T*>(h.rest)),
        v_first(static_cast<T*>(h.v_first)), v_rest(static_cast<T*>(h.v_rest)) {}

  Range within(const Range& rows) const { return {std::max(rows.begin, begin), std::min(rows.end, end)}; }

  // sh[3 k + channel] of the rows row(0), row(1), ... among all.
  template <class RowAt>
  void load(RowAt row, Lanes<T>* sh) const {
    const auto begins = [&](int lane) { return first + first_stride * (row(lane) - begin); };
    if (rest == first + 3) return load_columns<T>(begins, int(3 * terms), sh);
    load_columns<T>(begins, 3, sh);
    load_columns<T>([&](int lane) { return rest + rest_stride * (row(lane) - begin); }, int(3 * terms - 3), sh + 3);
  }

  // Gradients of the same rows.
  template <class RowAt>
  void store_gradients(const Lanes<T>* v_sh, RowAt row) const {
    const auto begins = [&](int lane) { return v_first + first_stride * (row(lane) - begin); };
    const auto follows = [&](int lane) { return v_rest + rest_stride * (row(lane) - begin); };
    if (v_rest == v_first + 3) return store_columns<T>(v_sh, int(3 * terms), begins);
    store_columns<T>(v_sh, 3, begins);
    if (!v_rest) return;
    const int used = int(3 * terms - 3), unused = int(3 * stored_rest) - used;
    store_columns<T>(v_sh + 3, used, follows);
    for (int lane = 0; unused > 0 && lane < LANES<T>; ++lane) std::fill_n(follows(lane) + used, unused, T(0));
  }

  // Gradients 0 for rows of this table; past the caches.
  void zero_gradients(int64_t from, int64_t to) const {
    const auto zero = [&](T* values, int64_t stride) {
      stream<T>(values + stride * (from - begin), nullptr, stride * (to - from));
    };
    zero(v_first, first_stride);
    if (v_rest && v_rest != v_first + 3) zero(v_rest, rest_stride);
  }

 private:
  int64_t stored_rest, first_stride, rest_stride;
  const T *first, *rest;
  T *v_first, *v_rest;
};

}  // namespace SPLAT_VARIANT
