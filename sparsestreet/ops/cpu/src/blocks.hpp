// A tile's pixels in blocks, and which blocks a splat reaches. While a tile is worked on, its pixels lie block by
// block, so that a register holds pixels near each other: in a line of 16, three of four would be outside the splat.
#pragma once
#include "workspace.hpp"

namespace SPLAT_VARIANT {

// Column and line, in the tile, of the pixel that lies at a place of the tile's arrays.
inline int column_of(int at) { return at / BLOCK_PIXELS % BLOCKS_ACROSS * BLOCK_WIDTH + at % BLOCK_WIDTH; }
inline int line_of(int at) {
  return at / BLOCK_PIXELS / BLOCKS_ACROSS * BLOCK_HEIGHT + at % BLOCK_PIXELS / BLOCK_WIDTH;
}

// Calls visit(at, pixel) for each pixel of a tile that is in the image; pixel: its index there.
template <class Visit>
inline void for_each_pixel(const View& view, int64_t x0, int64_t y0, Visit visit) {
  for (int at = 0; at < PIXELS; ++at) {
    const int64_t x = x0 + column_of(at), y = y0 + line_of(at);
    if (x < view.width && y < view.height) visit(at, y * view.width + x);
  }
}

// The centers of a tile's pixels in the image, and of the first pixels of its blocks.
template <class T>
struct TilePixels {
  static constexpr int WHOLE_REGISTERS = BLOCKS < LANES<T> ? LANES<T> : BLOCKS;
  alignas(64) T x[PIXELS], y[PIXELS];
  alignas(64) T left[WHOLE_REGISTERS] = {}, top[WHOLE_REGISTERS] = {};

  TilePixels(int64_t x0, int64_t y0) {
    for (int at = 0; at < PIXELS; ++at)
      x[at] = T(x0) + (T(column_of(at)) + T(0.5)), y[at] = T(y0) + (T(line_of(at)) + T(0.5));
    for (int block = 0; block < BLOCKS; ++block)
      left[block] = x[block * BLOCK_PIXELS], top[block] = y[block * BLOCK_PIXELS];
  }
};

// Bit i: the ellipse |L d|^2 <= reach meets the rectangle of the pixel centers of block i, made wider by a margin. The
// least |L d|^2 in a rectangle is on one of its sides that face the mean, or it is 0.
template <class T>
inline BlockMask reached_blocks(const Splat<T>& s, const TilePixels<T>& pixels) {
  const T reach = s.log2_opacity - s.least_exponent, ratio = s.half_x > 0 ? s.half_y / s.half_x : T(0);
  const T tilt_x = -s.l21 / s.l11, tilt_y = tilt_x * ratio * ratio;  // of the lines of least |L d|^2 in x and in y
  const T margin_x = T(BOX_MARGIN) + T(1e-5) * s.half_x, margin_y = T(BOX_MARGIN) + T(1e-5) * s.half_y;
  BlockMask mask = 0;
  for (int i = 0; i < BLOCKS; i += LANES<T>) {
    const Lanes<T> left = load(pixels.left + i) - (s.x + margin_x), right = left + (BLOCK_WIDTH - 1 + 2 * margin_x);
    const Lanes<T> top = load(pixels.top + i) - (s.y + margin_y), bottom = top + (BLOCK_HEIGHT - 1 + 2 * margin_y);
    const Lanes<T> dx = larger(left, smaller(right, Lanes<T>{})), dy = larger(top, smaller(bottom, Lanes<T>{}));
    const Lanes<T> x = larger(left, smaller(right, tilt_x * dy)), y = larger(top, smaller(bottom, tilt_y * dx));
    const Lanes<T> a = s.l11 * dx + s.l21 * y, b = s.l22 * y, c = s.l11 * x + s.l21 * dy, d = s.l22 * dy;
    mask |= BlockMask(bits<T>(smaller(a * a + b * b, c * c + d * d) <= reach)) << i;
  }
  return mask & ALL_BLOCKS;
}

// Calls visit(at) for each register of pixels of the blocks in the mask; at: its place in the tile's arrays.
template <class T, class Visit>
inline void for_each_register(BlockMask mask, Visit visit) {
  for (; mask != 0; mask &= mask - 1) {
    const int first = __builtin_ctzll(mask) * BLOCK_PIXELS;
    for (int at = first; at < first + BLOCK_PIXELS; at += LANES<T>) visit(at);
  }
}

// The blocks that have a pixel whose state is above `least`.
template <class T>
inline BlockMask open_blocks(const T* state, T least) {
  BlockMask open = 0;
  for (int block = 0; block < BLOCKS; ++block) {
    Integers<T> some{};
    for (int i = 0; i < BLOCK_PIXELS; i += LANES<T>) some |= load(state + block * BLOCK_PIXELS + i) > least;
    open |= BlockMask(bits<T>(some) != 0) << block;
  }
  return open;
}

// Pairs between two looks at which blocks are finished; their masks are made together, since a loop over the bits of a
// mask that is not known yet stalls.
constexpr int64_t LOOK = 16;
// Splats ahead whose record is fetched.
constexpr int64_t PREFETCH = 8;

// Calls visit(k, splat) for each pair of a tile, nearest first, until all pixels are finished, and answers the index
// after the last one. ws.masks[k]: the blocks that the splat reaches and that have a pixel of `state` above `least`.
template <class T, class Visit>
inline int64_t for_each_pair(Workspace<T>& ws, int64_t tile, const TilePixels<T>& pixels, const T* state, T least,
                             Visit visit) {
  const int64_t begin = ws.tile_begin[tile], end = ws.tile_begin[tile + 1];
  for (int64_t first = begin; first < end; first += LOOK) {
    const int64_t last = first + LOOK < end ? first + LOOK : end;
    const BlockMask open = open_blocks(state, least);
    if (open == 0) return first;
    for (int64_t k = first; k < last; ++k) {
      if (k + PREFETCH < end) __builtin_prefetch(&ws.splats[ws.pairs[k + PREFETCH].row]);
      ws.masks[k] = ws.bounded ? reached_blocks(ws.splats[ws.pairs[k].row], pixels) & open : open;
    }
    for (int64_t k = first; k < last; ++k) visit(k, ws.splats[ws.pairs[k].row]);
  }
  return end;
}

}  // namespace SPLAT_VARIANT
