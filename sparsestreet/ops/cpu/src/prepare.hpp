// The first half of every call: check the values, project the rows, sort them, list them by tile.
#pragma once
#include <omp.h>

#include "sorting.hpp"

namespace SPLAT_VARIANT {

// Typed views of the input rows.
template <class T>
struct Inputs {
  int64_t count, terms;
  const T *means, *quaternions, *scales, *opacities, *sh;
  explicit Inputs(const Rows& r)
      : count(r.count), terms(r.terms), means(static_cast<const T*>(r.means)),
        quaternions(static_cast<const T*>(r.quaternions)), scales(static_cast<const T*>(r.scales)),
        opacities(static_cast<const T*>(r.opacities)), sh(static_cast<const T*>(r.sh)) {}
};

// Whether all values are finite: no exponent is all ones. In integers, which the compiler vectorises.
template <class T>
inline bool finite(const T* values, int64_t count) {
  using Bits = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;
  constexpr Bits magnitude = ~Bits(0) >> 1, infinity = sizeof(T) == 4 ? Bits(0x7f800000) : Bits(0x7ff0000000000000);
  Bits most = 0;
  for (int64_t i = 0; i < count; ++i) {
    Bits bits;
    std::memcpy(&bits, values + i, sizeof(bits));
    bits &= magnitude;
    most = bits > most ? bits : most;
  }
  return most < infinity;
}

template <class T>
inline bool valid_row(const Inputs<T>& in, int64_t i) {
  const T *s = in.scales + 3 * i, opacity = in.opacities[i];
  return finite(in.means + 3 * i, 3) && finite(in.quaternions + 4 * i, 4) && finite(s, 3) && s[0] >= 0 && s[1] >= 0 &&
         s[2] >= 0 && opacity >= 0 && opacity <= 1 && finite(in.sh + 3 * in.terms * i, 3 * in.terms);
}

// Fills ws.splats, ws.tiles and `radii`; false if a row holds a bad value.
template <class T>
bool project_rows(Workspace<T>& ws, const View& view, const Inputs<T>& in, T* radii) {
  const Camera<T> camera(view);
  const Grid<T> grid(view);
  ws.splats.reserve(in.count), ws.tiles.reserve(in.count);
  int bad = 0;
#pragma omp parallel for num_threads(view.threads) schedule(static) reduction(| : bad)
  for (int64_t i = 0; i < in.count; ++i) {
    bad |= !valid_row(in, i);
    Splat<T>& splat = ws.splats[i];
    const bool seen = project_row(camera, in.means + 3 * i, in.quaternions + 4 * i, in.scales + 3 * i, in.opacities[i],
                                  in.sh + 3 * in.terms * i, in.terms, splat);
    ws.tiles[i] = seen ? tile_set(splat, grid) : TileSet{0, 0, 0};
    if (radii) radii[i] = !seen ? T(0) : (splat.half_x > splat.half_y ? splat.half_x : splat.half_y);
  }
  return !bad;
}

// The three rows with most pairs, most first.
template <class T>
void report_worst(const Workspace<T>& ws, int64_t rows, Report& report) {
  for (int k = 0; k < 3; ++k) report.worst_rows[k] = -1, report.worst_pairs[k] = 0;
  for (int64_t i = 0; i < rows; ++i) {
    int64_t row = i, pairs = ws.tiles[i].count;
    for (int k = 0; k < 3; ++k) {
      if (pairs <= report.worst_pairs[k]) continue;
      const int64_t other_row = report.worst_rows[k], other_pairs = report.worst_pairs[k];
      report.worst_rows[k] = row, report.worst_pairs[k] = pairs;
      row = other_row, pairs = other_pairs;
    }
  }
}

template <class T>
Status prepare(Workspace<T>& ws, const View& view, const Rows& rows, void* radii, Report& report) {
  const Inputs<T> in(rows);
  const double start = omp_get_wtime();
  if (!project_rows(ws, view, in, static_cast<T*>(radii))) return BAD_VALUE;
  const double projected = omp_get_wtime();
  list_visible(ws, in.count);
  report.pairs = ws.pair_count;
  if (ws.pair_count > view.pair_limit) {
    report_worst(ws, in.count, report);
    return TOO_MANY_PAIRS;
  }
  const Grid<T> grid(view);
  ws.tiles_x = grid.tiles_x, ws.tiles_y = grid.tiles_y;
  sort_by_depth(ws, view.threads);
  fill_tiles(ws, grid, view.threads);
  ws.seconds[PROJECT] = projected - start, ws.seconds[BIN] = omp_get_wtime() - projected;
  return OK;
}

}  // namespace SPLAT_VARIANT
