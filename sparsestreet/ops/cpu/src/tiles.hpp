// Which 16x16 tiles a splat can touch: per row of tiles, the columns its ellipse alpha >= alpha_min reaches.
#pragma once
#include "projection.hpp"

namespace SPLAT_VARIANT {

template <class T>
struct Grid {
  T width, height, log2_alpha_min;
  bool bounded;  // alpha_min > 0
  int64_t tiles_x, tiles_y;

  explicit Grid(const View& v)
      : width(v.width), height(v.height), log2_alpha_min(v.alpha_min > 0 ? std::log2(v.alpha_min) : 0),
        bounded(v.alpha_min > 0), tiles_x((v.width + TILE - 1) / TILE), tiles_y((v.height + TILE - 1) / TILE) {}
};

// The ellipse |L d|^2 <= reach as x(dy) = slope dy -+ half_width sqrt(1 - (dy / half_y)^2); its right-most point lies
// at dy = peak, its left-most at -peak.
template <class T>
struct Ellipse {
  T slope, half_width, half_y, peak, margin_x, margin_y;

  Ellipse(const Splat<T>& s, T log2_alpha_min) {
    const T reach = s.log2_opacity - log2_alpha_min;
    slope = -s.l21 / s.l11;
    half_width = std::sqrt(reach > 0 ? reach : T(0)) / s.l11;
    half_y = s.half_y;
    peak = s.half_x > 0 ? slope * half_y * half_y / s.half_x : T(0);
    // The pixel loop's rounding grows with the distances it squares.
    margin_x = T(BOX_MARGIN) + T(1e-5) * s.half_x, margin_y = T(BOX_MARGIN) + T(1e-5) * s.half_y;
  }
  T half_chord(T dy) const {
    const T ratio = half_y > 0 ? dy / half_y : T(0);
    const T rest = 1 - ratio * ratio;
    return half_width * std::sqrt(rest > 0 ? rest : T(0));
  }
  // Extent in x, relative to the centre, over dy in [low, high].
  void extent(T low, T high, T& left, T& right) const {
    low = limited(low - margin_y, -half_y, half_y), high = limited(high + margin_y, -half_y, half_y);
    const T at_right = limited(peak, low, high), at_left = limited(-peak, low, high);
    right = slope * at_right + half_chord(at_right) + margin_x;
    left = slope * at_left - half_chord(at_left) - margin_x;
  }
};

// Calls visit(column, row) for each tile of a visible splat, row by row.
template <class T, class Visit>
inline void find_tiles(const Splat<T>& s, const Grid<T>& grid, Visit visit) {
  if (s.first_row > s.last_row) return;
  const Ellipse<T> ellipse(s, grid.log2_alpha_min);
  for (int64_t ty = s.first_row / TILE; ty <= s.last_row / TILE; ++ty) {
    int32_t first = 0, last = int32_t(grid.width) - 1;
    if (grid.bounded) {
      T left, right;
      const T top = T(ty * TILE) + T(0.5) - s.y;
      ellipse.extent(top, top + T(TILE - 1), left, right);
      pixel_span(s.x + (left + right) / 2, (right - left) / 2, grid.width, first, last);
    }
    if (first > last) continue;
    for (int64_t tx = first / TILE; tx <= last / TILE; ++tx) visit(tx, ty);
  }
}

template <class T>
inline TileSet tile_set(const Splat<T>& s, const Grid<T>& grid) {
  int32_t first, last;
  pixel_span(s.x, s.half_x + T(BOX_MARGIN) * 2 + T(1e-4) * s.half_x, grid.width, first, last);
  if (first > last || s.first_row > s.last_row) return {0, 0, 0};
  const int64_t left = first / TILE, top = s.first_row / TILE;
  const int64_t columns = last / TILE - left + 1, rows = s.last_row / TILE - top + 1;
  TileSet set{0, int32_t(top * grid.tiles_x + left), 0};
  if (columns == 1 && rows == 1) return {1, set.first, 1};
  if (columns <= 8 && rows <= 8) {
    find_tiles(s, grid, [&](int64_t x, int64_t y) {
      ++set.count, set.mask |= uint64_t(1) << (8 * (y - top) + x - left);
    });
  } else {
    find_tiles(s, grid, [&](int64_t, int64_t) { ++set.count; });
  }
  return set;
}

// Calls visit(tile) for each tile of a splat, always in the same order.
template <class T, class Visit>
inline void for_each_tile(const TileSet& set, const Splat<T>& s, const Grid<T>& grid, Visit visit) {
  if (set.mask == 0) {
    find_tiles(s, grid, [&](int64_t x, int64_t y) { visit(y * grid.tiles_x + x); });
    return;
  }
  for (uint64_t mask = set.mask; mask != 0; mask &= mask - 1) {
    const int bit = __builtin_ctzll(mask);
    visit(set.first + (bit >> 3) * grid.tiles_x + (bit & 7));
  }
}

}  // namespace SPLAT_VARIANT
