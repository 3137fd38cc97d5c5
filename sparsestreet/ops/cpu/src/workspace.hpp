// What one rendering keeps from forward to backward, and the records the stages hand to each other.
#pragma once
#include "buffer.hpp"
#include "interface.h"
#include "values.hpp"

namespace SPLAT_VARIANT {

using namespace splat;

// A thread's share of `count` things.
struct Range {
  int64_t begin, end;
  Range(int64_t begin, int64_t end) : begin(begin), end(end) {}
  Range(int64_t count, int64_t part, int64_t parts) : begin(count * part / parts), end(count * (part + 1) / parts) {}
};

constexpr int PIXELS = TILE * TILE;
// The floats of a block are one register of AVX-512 (4x4 pixels) or of AVX2 (4x2), two of SSE (4x2). The most blocks
// that a mask can hold are 64.
constexpr int BLOCK_WIDTH = 4, BLOCK_HEIGHT = LANES<float> == 16 || TILE > 16 ? 4 : 2;
constexpr int BLOCK_PIXELS = BLOCK_WIDTH * BLOCK_HEIGHT;
constexpr int BLOCKS_ACROSS = TILE / BLOCK_WIDTH, BLOCKS = PIXELS / BLOCK_PIXELS;
// Bit i: block i of a tile.
using BlockMask = std::conditional_t<BLOCKS <= 16, uint16_t, std::conditional_t<BLOCKS <= 32, uint32_t, uint64_t>>;
constexpr BlockMask ALL_BLOCKS = BlockMask(~uint64_t(0) >> (64 - BLOCKS));

constexpr double BOX_MARGIN = 0.01;  // pixels; rounding must never cull a touched pixel

// One splat on the screen, 64 bytes as float, one cache line; or as many as a register has lanes.
template <class V>
struct alignas(16 * sizeof(Scalar<V>)) Splat {
  V x, y;           // mean, pixels
  V l11, l21, l22;  // Cholesky factor of the conic times sqrt(log2(e) / 2): alpha = 2^(log2_opacity - |L d|^2)
  V log2_opacity;
  V least_exponent;  // log2 of the least alpha that is drawn
  V color[3];
  V depth;
  V half_x, half_y;              // half sides of the box, pixels
  Index<V> first_row, last_row;  // image rows the box reaches, inclusive
  V gate;  // factor of alpha, of rows that have gates
};
template <class V>
constexpr int SPLAT_COLUMNS = sizeof(Splat<V>) / sizeof(V);
static_assert(SPLAT_COLUMNS<float> == 16 && SPLAT_COLUMNS<double> == 16, "records are moved as squares of registers");

// Bits of a positive depth order as the depth does.
template <class T>
using DepthKey = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;

// The tiles of a row, found once: bit 8 y + x stands for the tile x right of and y below the first one (of the box).
// A splat that reaches further than 8x8 tiles has mask 0, and its tiles are found anew each time.
template <class T>
struct TileSet {
  uint64_t mask;
  int64_t first_slot;  // of the row's pairs, contiguous and in the order of its tiles
  int32_t first, count;
  DepthKey<T> depth_key;
};

// One (splat, tile) pair in a tile's list.
template <class T>
struct Pair {
  DepthKey<T> depth_key;
  int32_t row;   // of the input
  int32_t slot;  // where the pair's gradient goes: slots of a row are contiguous
};

// Sums over the pixels of one pair. s = dLoss/d(ln alpha), d = (dx, dy), (a, b) = L d, w = blend weight.
template <class V>
struct Slot {
  V s, sa, sb;
  V sa_dx, sa_dy, sb_dy;  // towards l11, l21, l22
  V abs_x, abs_y;         // |s a|, |s (l21 a + l22 b)|
  V color[3], depth;      // w times the cotangents
};
template <class V>
constexpr int SLOT_COLUMNS = sizeof(Slot<V>) / sizeof(V);

template <class T>
struct Workspace {
  Buffer<Splat<T>> splats;   // by input row; only visible rows are written
  Buffer<TileSet<T>> tiles;     // by input row; count 0: culled
  Buffer<int64_t> histogram;   // parts x tiles: pairs of a part of the rows in a tile, then where they begin
  Buffer<int64_t> part_slots;  // by part: its first slot
  Buffer<int64_t> tile_begin;  // tiles + 1
  Buffer<int64_t> tile_end;    // after the last pair that the forward loop looked at
  Buffer<T> last_pairs;        // by tile and place: the last pair that was blended, counted from tile_begin; -1: none
  Buffer<BlockMask> masks;     // by pair: the blocks in which the forward loop blended it
  Buffer<Pair<T>> pairs, other_pairs;  // by tile; other_pairs: room for sorting
  Buffer<Slot<T>> slots;
  Buffer<T> gate_slots;  // dLoss/d gate of each pair, of rows that have gates
  struct Count {
    double weight;
    int64_t pixels, dominant;
  };
  Buffer<Count> count_slots;
  struct Change {
    T largest, weight, squared[COUNTINGS];
  };
  Buffer<Change> change_slots;
  int64_t pair_count = 0, tiles_x = 0, tiles_y = 0;
  bool bounded = false;  // lists of tiles and masks of blocks end where splats do
  int64_t samples = 0;  // (splat, pixel) pairs that the forward loops evaluated
  double seconds[STAGES] = {};

  void poison() {
    splats.poison(), tiles.poison(), histogram.poison(), part_slots.poison(), tile_begin.poison(), tile_end.poison();
    masks.poison(), pairs.poison(), other_pairs.poison(), last_pairs.poison(), slots.poison();
    gate_slots.poison(), count_slots.poison(), change_slots.poison();
  }
};

}  // namespace SPLAT_VARIANT
