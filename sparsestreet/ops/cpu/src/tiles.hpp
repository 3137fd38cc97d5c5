// Which tiles a splat can touch: per row of tiles, the columns its ellipse alpha >= alpha_min reaches.
#pragma once
#include "projection.hpp"

namespace SPLAT_VARIANT {

template <class T>
struct Grid {
  T width, height;
  bool bounded;  // lists end where splats do
  int64_t tiles_x, tiles_y;

  explicit Grid(const Camera<T>& c)
      : width(c.width), height(c.height), bounded(c.bounded()), tiles_x((int64_t(c.width) + TILE - 1) / TILE),
        tiles_y((int64_t(c.height) + TILE - 1) / TILE) {}
};

// The ellipse |L d|^2 <= reach as x(dy) = slope dy -+ half_width sqrt(1 - (dy / half_y)^2); its right-most point lies
// at dy = peak, its left-most at -peak. V: a number or a register of splats.
template <class V>
struct Ellipse {
  using T = Scalar<V>;
  V slope, half_width, half_y, peak, margin_x, margin_y;

  explicit Ellipse(const Splat<V>& s) {
    slope = -s.l21 / s.l11;
    half_width = root(positive_part(s.log2_opacity - s.least_exponent)) / s.l11;
    half_y = s.half_y;
    peak = s.half_x > V{} ? slope * half_y * half_y / s.half_x : V{};
    // The pixel loop's rounding grows with the distances it squares.
    margin_x = T(BOX_MARGIN) + T(1e-5) * s.half_x, margin_y = T(BOX_MARGIN) + T(1e-5) * s.half_y;
  }
  V half_chord(const V& dy) const {
    const V ratio = half_y > V{} ? dy / half_y : V{};
    return half_width * root(positive_part(1 - ratio * ratio));
  }
  // Extent in x, relative to the center, over dy in [from, to].
  void extent(const V& from, const V& to, V& left, V& right) const {
    const V low = limited(from - margin_y, -half_y, half_y), high = limited(to + margin_y, -half_y, half_y);
    const V at_right = limited(peak, low, high), at_left = limited(-peak, low, high);
    right = slope * at_right + half_chord(at_right) + margin_x;
    left = slope * at_left - half_chord(at_left) - margin_x;
  }
  // First and last pixel column in the row of tiles that starts at image row `top`.
  void columns(const Splat<V>& s, const V& top, T width, Index<V>& first, Index<V>& last) const {
    V left, right;
    const V dy = top + T(0.5) - s.y;
    extent(dy, dy + T(TILE - 1), left, right);
    pixel_span(s.x + (left + right) / 2, (right - left) / 2, width, first, last);
  }
};

// Calls visit(column, row) for each tile of a visible splat, row by row.
template <class T, class Visit>
inline void find_tiles(const Splat<T>& s, const Grid<T>& grid, Visit visit) {
  if (s.first_row > s.last_row) return;
  const Ellipse<T> ellipse(s);
  for (int64_t ty = s.first_row / TILE; ty <= s.last_row / TILE; ++ty) {
    Index<T> first = 0, last = Index<T>(grid.width) - 1;
    if (grid.bounded) ellipse.columns(s, T(ty * TILE), grid.width, first, last);
    if (first > last) continue;
    for (int64_t tx = first / TILE; tx <= last / TILE; ++tx) visit(tx, ty);
  }
}

// The box of tiles around the box of pixels; `small` where it is at most 8x8.
template <class T>
struct TileBoxes {
  Integers<T> left, top, columns, rows, small;

  TileBoxes(const Splat<Lanes<T>>& s, const Grid<T>& grid, const Integers<T>& seen) {
    Integers<T> first, last;
    pixel_span(s.x, s.half_x + T(BOX_MARGIN) * 2 + T(1e-4) * s.half_x, grid.width, first, last);
    const Integers<T> some = seen && first <= last && s.first_row <= s.last_row, none{};
    left = first / TILE, top = s.first_row / TILE;
    columns = some ? last / TILE - left + 1 : none, rows = some ? s.last_row / TILE - top + 1 : none;
    small = columns <= 8 && rows <= 8;
  }
};

// Bits of the tiles of small splats: rows 0 to 3 of their box in `masks[0]`, 4 to 7 in `masks[1]`.
template <class T>
inline void small_masks(const Splat<Lanes<T>>& s, const TileBoxes<T>& box, const Grid<T>& grid, Integers<T>* masks) {
  const Integers<T> none{}, one = none + 1;
  masks[0] = masks[1] = none;
  const Ellipse<Lanes<T>> ellipse(s);
  for (int row = 0; row < 8; ++row) {
    const Integers<T> here = box.small && box.rows > row;
    if (!any<T>(here)) break;
    Integers<T> first = box.left * TILE, last = first + (box.columns - 1) * TILE;
    if (grid.bounded) ellipse.columns(s, as_value((box.top + row) * TILE), grid.width, first, last);
    // A splat in one tile has no corner to spare, so nothing is asked of its ellipse.
    const Integers<T> lone = box.columns == 1 && box.rows == 1;
    const Integers<T> low = lone ? none : first / TILE - box.left, high = lone ? none : last / TILE - box.left;
    const Integers<T> bits = (one << (high + 1)) - (one << low);
    masks[row / 4] |= here && (lone || first <= last) ? bits << (8 * (row % 4)) : none;
  }
}

// What orders splats by depth: the upper `bits` of the depth as float32, or all digits of T.
template <class T>
inline DepthKey<T> depth_key(T depth, int bits) {
  if (sizeof(T) == 4 || bits < 32) {
    const float single = float(depth);
    uint32_t key;
    std::memcpy(&key, &single, sizeof(key));
    return key & (~uint32_t(0) << (32 - bits));
  }
  DepthKey<T> key;
  std::memcpy(&key, &depth, sizeof(key));
  return key;
}

// The tiles of each row of a register; count 0 where it was not seen.
template <class T>
inline void tile_sets(const Splat<Lanes<T>>& s, const Grid<T>& grid, const Integers<T>& seen, const Splat<T>* splats,
                      int rows, TileSet<T>* sets) {
  const TileBoxes<T> box(s, grid, seen);
  Integers<T> masks[2];
  small_masks(s, box, grid, masks);
  for (int r = 0; r < rows; ++r) {
    const uint64_t mask = uint64_t(uint32_t(masks[1][r])) << 32 | uint32_t(masks[0][r]);
    sets[r].mask = mask, sets[r].count = __builtin_popcountll(mask);
    sets[r].first = int32_t(box.top[r] * grid.tiles_x + box.left[r]);
    if (!box.small[r]) find_tiles(splats[r], grid, [&](int64_t, int64_t) { ++sets[r].count; });
  }
}

// Calls visit(tile) for each tile of a row, always in the same order; for none if it is culled.
template <class T, class Visit>
inline void for_each_tile(const TileSet<T>& set, const Splat<T>& s, const Grid<T>& grid, Visit visit) {
  if (set.mask == 0) {
    if (set.count == 0) return;
    find_tiles(s, grid, [&](int64_t x, int64_t y) { visit(y * grid.tiles_x + x); });
    return;
  }
  for (uint64_t mask = set.mask; mask != 0; mask &= mask - 1) {
    const int bit = __builtin_ctzll(mask);
    visit(set.first + (bit >> 3) * grid.tiles_x + (bit & 7));
  }
}

}  // namespace SPLAT_VARIANT
