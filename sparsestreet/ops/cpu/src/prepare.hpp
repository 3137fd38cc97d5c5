// The first half of every call: check the values, project the rows, sort them, list them by tile.
#pragma once
#include <omp.h>

#include <vector>

#include "columns.hpp"
#include "pairs.hpp"
#include "tables.hpp"

namespace SPLAT_VARIANT {

// Typed views of the input rows.
template <class T>
struct Inputs {
  int64_t count;
  std::vector<HarmonicTable<T>> harmonics;
  const T *means, *quaternions, *scales, *opacities, *displacements, *gates;
  explicit Inputs(const Rows& r)
      : count(r.count), means(static_cast<const T*>(r.means)), quaternions(static_cast<const T*>(r.quaternions)),
        scales(static_cast<const T*>(r.scales)), opacities(static_cast<const T*>(r.opacities)),
        displacements(static_cast<const T*>(r.displacements)), gates(static_cast<const T*>(r.gates)) {
    int64_t begin = 0;
    for (const Harmonics* h = r.harmonics; h != r.harmonics + r.tables; begin += h->rows, ++h)
      harmonics.emplace_back(*h, begin);
  }
};

// Whether all values are finite: no exponent is all ones. In integers, which the compiler vectorizes.
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

// Of everything but the harmonics, which only rows that are drawn are asked for.
template <class T>
inline bool sound_rows(const Inputs<T>& in, int64_t first, int64_t count) {
  bool inside = true;
  for (int64_t i = first; i < first + count; ++i) inside &= in.opacities[i] >= 0 && in.opacities[i] <= 1;
  for (int64_t i = 3 * first; i < 3 * (first + count); ++i) inside &= in.scales[i] >= 0;
  return inside && finite(in.means + 3 * first, 3 * count) && finite(in.quaternions + 4 * first, 4 * count) &&
         finite(in.scales + 3 * first, 3 * count) &&
         (!in.displacements || finite(in.displacements + 3 * first, 3 * count));
}

// Rows of opacity 0 may hold anything: they are culled, whatever their lane computes.
template <class T>
inline bool valid_rows(const Inputs<T>& in, int64_t first, int64_t count) {
  if (sound_rows(in, first, count)) return true;
  for (int64_t i = first; i < first + count; ++i)
    if (in.opacities[i] != 0 && !sound_rows(in, i, 1)) return false;
  return true;
}

// Rows row(0), row(1), ... of the input, one per lane.
template <class E, class T, class RowAt>
inline typename E::template Row<Lanes<T>> load_rows(const Inputs<T>& in, RowAt row) {
  typename E::template Row<Lanes<T>> v;
  load_columns<T>([&](int lane) { return in.means + 3 * row(lane); }, 3, &v.mean.x);
  load_columns<T>([&](int lane) { return in.scales + 3 * row(lane); }, 3, &v.scales.x);
  load_columns<T>([&](int lane) { return in.quaternions + 4 * row(lane); }, 4, v.quaternion);
  load_columns<T>([&](int lane) { return in.opacities + row(lane); }, 1, &v.opacity);
  if constexpr (E::SHUTTER) {
    v.displacement = Vector<Lanes<T>>{};
    if (in.displacements)
      load_columns<T>([&](int lane) { return in.displacements + 3 * row(lane); }, 3, &v.displacement.x);
  }
  return v;
}

// The color of the rows of a register in the direction in which the camera sees them; answers whose coefficients are
// finite.
template <class T, class RowAt>
inline Integers<T> color_rows(const Camera<T>& camera, const HarmonicTable<T>& table, RowAt row,
                              const Vector<Lanes<T>>& in_camera, Splat<Lanes<T>>& s) {
  Lanes<T> sh[3 * 16];
  table.load(row, sh);
  Integers<T> finite = ~Integers<T>{};
  for (int c = 0; c < 3 * table.terms; ++c) finite &= sh[c] - sh[c] == T(0);
  const Vector<Lanes<T>> color = view_color(camera, in_camera, sh, table.terms).raw;
  s.color[0] = positive_part(color.x), s.color[1] = positive_part(color.y), s.color[2] = positive_part(color.z);
  if (camera.clamp_colors)
    for (auto& channel : s.color) channel = channel < T(1) ? channel : same(T(1));
  if (camera.half_colors)
    for (auto& channel : s.color) channel = rounded_to_half<T>(channel);
  return finite;
}

// Rows `first` to `first + count` (at most LANES of them, of one table): fills their splats, tiles and radii, counts
// pairs per tile; false if a row that is drawn has a bad coefficient.
template <class E, class T>
bool project_block(Workspace<T>& ws, const Camera<T>& camera, const Grid<T>& grid, const Inputs<T>& in, int64_t first,
                   int count, const HarmonicTable<T>& table, T* radii, int64_t* counts) {
  // The lanes of a last, partial block repeat its last row.
  const auto row = [&](int lane) { return first + (lane < count ? lane : count - 1); };
  const auto values = load_rows<E>(in, row);
  const Projection<E, Lanes<T>> p(camera, values);
  Splat<Lanes<T>> s{};
  const Integers<T> seen = project(camera, values, p, s);
  const Lanes<T> radius = seen ? (s.half_x > s.half_y ? s.half_x : s.half_y) : Lanes<T>{};
  if (radii)
    for (int r = 0; r < count; ++r) radii[first + r] = radius[r];
  if (!any<T>(seen)) {
    for (int r = 0; r < count; ++r) ws.tiles[first + r].count = 0, ws.tiles[first + r].mask = 0;
    return true;
  }
  const Integers<T> sound = color_rows(camera, table, row, p.placement.mean, s);
  if (in.gates) load_columns<T>([&](int lane) { return in.gates + row(lane); }, 1, &s.gate);
  Splat<T>* splats = &ws.splats[first];
  store_columns<T>(&s.x, SPLAT_COLUMNS<T>, [&](int r) { return reinterpret_cast<T*>(&ws.splats[row(r)]); });
  tile_sets(s, grid, seen, splats, count, &ws.tiles[first]);
  for (int r = 0; r < count; ++r) {
    ws.tiles[first + r].depth_key = depth_key(splats[r].depth, camera.depth_bits);
    for_each_tile(ws.tiles[first + r], splats[r], grid, [&](int64_t tile) { ++counts[tile]; });
  }
  return !any<T>(seen & ~sound);
}

// Fills ws.splats, ws.tiles, `radii` and each thread's counts of pairs per tile; false if a row holds a bad value.
template <class E, class T>
bool project_rows(Workspace<T>& ws, const View& view, const Inputs<T>& in, T* radii) {
  const Camera<T> camera(view);
  const Grid<T> grid(camera);
  const int64_t tiles = grid.tiles_x * grid.tiles_y;
  ws.splats.reserve(in.count), ws.tiles.reserve(in.count), ws.histogram.reserve(view.threads * tiles);
  int bad = 0;
#pragma omp parallel for num_threads(view.threads) schedule(static) reduction(| : bad)
  for (int64_t part = 0; part < view.threads; ++part) {
    int64_t* counts = &ws.histogram[part * tiles];
    std::memset(counts, 0, tiles * sizeof(int64_t));
    const Range whole = blocks_of_part<T>(in.count, part, view.threads);
    for (const HarmonicTable<T>& table : in.harmonics) {
      const Range range = table.within(whole);
      for (int64_t first = range.begin; first < range.end; first += LANES<T>) {
        const int count = int(range.end - first < LANES<T> ? range.end - first : LANES<T>);
        bad |= !valid_rows(in, first, count);
        bad |= !project_block<E>(ws, camera, grid, in, first, count, table, radii, counts);
      }
    }
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

template <bool LENS, class Call>
inline auto with_shutter(const View& view, Call call) {
  if (!view.has_shutter) return call(Effects<LENS, false>{});
  return view.shutter_columns ? call(Effects<LENS, true, true>{}) : call(Effects<LENS, true>{});
}

// Calls call(Effects<...>{}) with those that the view has.
template <class Call>
inline auto with_effects(const View& view, Call call) {
  return view.has_lens ? with_shutter<true>(view, call) : with_shutter<false>(view, call);
}

template <class T>
Status prepare(Workspace<T>& ws, const View& view, const Rows& rows, void* radii, Report& report) {
  const Inputs<T> in(rows);
  const double start = omp_get_wtime();
  const bool valid = with_effects(view, [&](auto effects) {
    return project_rows<decltype(effects)>(ws, view, in, static_cast<T*>(radii));
  });
  if (!valid) return BAD_VALUE;
  const double projected = omp_get_wtime();
  const Grid<T> grid{Camera<T>(view)};
  ws.tiles_x = grid.tiles_x, ws.tiles_y = grid.tiles_y, ws.bounded = grid.bounded;
  begin_tiles(ws, grid.tiles_x * grid.tiles_y, view.threads);
  report.pairs = ws.pair_count;
  if (ws.pair_count > view.pair_limit) {
    report_worst(ws, in.count, report);
    return TOO_MANY_PAIRS;
  }
  fill_tiles(ws, grid, in.count, view.threads);
  ws.seconds[PROJECT] = projected - start, ws.seconds[BIN] = omp_get_wtime() - projected;
  return OK;
}

}  // namespace SPLAT_VARIANT
