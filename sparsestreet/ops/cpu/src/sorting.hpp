// Visible rows by depth, and their tiles' lists in that order, by stable counting sorts. Nothing depends on the number
// of threads.
#pragma once
#include "tiles.hpp"

namespace SPLAT_VARIANT {

// Bits of a positive float order as the float does.
template <class T, class Key>
inline Key depth_key(T depth) {
  Key key;
  static_assert(sizeof(key) == sizeof(depth), "the key takes all digits of the depth");
  std::memcpy(&key, &depth, sizeof(key));
  return key;
}

// Below this many rows sorting takes one thread a few milliseconds, and each meeting of threads at a barrier can cost
// more than that on a machine that has other work as well.
constexpr int64_t ROWS_WORTH_THREADS = 1 << 17;

// Gives each row its slots, contiguous and in row order, and lists the rows that have any, with their depth keys;
// answers how many bits of the keys differ. The number of pairs is an int64: it may pass 2^31.
template <class T>
int list_visible(Workspace<T>& ws, int64_t rows) {
  using Key = typename Workspace<T>::Key;
  int64_t visible = 0, pairs = 0;
  Key different = 0;
  ws.keys.reserve(rows), ws.order.reserve(rows);
  for (int64_t i = 0; i < rows; ++i) {
    ws.tiles[i].first_slot = pairs;
    if (ws.tiles[i].count == 0) continue;
    pairs += ws.tiles[i].count;
    ws.keys[visible] = depth_key<T, Key>(ws.splats[i].depth);
    different |= ws.keys[visible] ^ ws.keys[0];
    ws.order[visible++] = int32_t(i);
  }
  ws.visible = visible, ws.pair_count = pairs;
  return different ? 64 - __builtin_clzll(different) : 0;
}

// One stable pass over `bits` bits of the key from `shift` on.
template <class Key>
void sort_by_digit(const Key* keys, const int32_t* values, Key* keys_out, int32_t* values_out, int64_t count, int shift,
                   int bits, int64_t* histogram, int64_t threads) {
  const int64_t digits = int64_t(1) << bits;
  const Key mask = Key(digits - 1);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t part = 0; part < threads; ++part) {
    int64_t* mine = histogram + part * digits;
    std::memset(mine, 0, digits * sizeof(int64_t));
    const Range range(count, part, threads);
    for (int64_t i = range.begin; i < range.end; ++i) ++mine[(keys[i] >> shift) & mask];
  }
  int64_t total = 0;
  for (int64_t digit = 0; digit < digits; ++digit) {
    for (int64_t part = 0; part < threads; ++part) {
      const int64_t here = histogram[part * digits + digit];
      histogram[part * digits + digit] = total;
      total += here;
    }
  }
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t part = 0; part < threads; ++part) {
    int64_t* mine = histogram + part * digits;
    const Range range(count, part, threads);
    for (int64_t i = range.begin; i < range.end; ++i) {
      const int64_t at = mine[(keys[i] >> shift) & mask]++;
      keys_out[at] = keys[i];
      values_out[at] = values[i];
    }
  }
}

// Radix sort by the lowest `key_bits` of the keys, from the lowest digit; leaves the result in ws.order. Ties keep the
// row order.
template <class T>
void sort_by_depth(Workspace<T>& ws, int key_bits, int64_t threads) {
  if (ws.visible < ROWS_WORTH_THREADS) threads = 1;
  ws.other_keys.reserve(ws.visible), ws.other_order.reserve(ws.visible);
  const int passes = (key_bits + 10) / 11, bits = passes > 0 ? (key_bits + passes - 1) / passes : 0;
  int64_t* histogram = ws.histogram.reserve(threads << bits);
  auto *keys = ws.keys.data(), *other_keys = ws.other_keys.data();
  auto *order = ws.order.data(), *other_order = ws.other_order.data();
  for (int pass = 0; pass < passes; ++pass) {
    sort_by_digit(keys, order, other_keys, other_order, ws.visible, pass * bits, bits, histogram, threads);
    auto* keys_before = keys;
    keys = other_keys, other_keys = keys_before;
    auto* order_before = order;
    order = other_order, other_order = order_before;
  }
  if (order != ws.order.data()) std::memcpy(ws.order.data(), order, ws.visible * sizeof(int32_t));
}

// Turns the counts of each part per tile, which projecting left in ws.histogram, into ws.tile_begin.
template <class T>
void begin_tiles(Workspace<T>& ws, int64_t tiles, int64_t parts) {
  ws.tile_begin.reserve(tiles + 1), ws.tile_end.reserve(tiles);
  int64_t total = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    ws.tile_begin[tile] = total;
    for (int64_t part = 0; part < parts; ++part) total += ws.histogram[part * tiles + tile];
  }
  ws.tile_begin[tiles] = total;
}

// Fills ws.pairs tile by tile, nearest first. Each thread walks all rows and lists the tiles of its own band. The rows
// lie scattered in memory, so their tiles are fetched ahead.
template <class T>
void fill_tiles(Workspace<T>& ws, const Grid<T>& grid, int64_t threads) {
  if (ws.visible < ROWS_WORTH_THREADS) threads = 1;
  constexpr int64_t ahead = 16;
  const int64_t tiles = grid.tiles_x * grid.tiles_y;
  int64_t* end = ws.tile_end.data();
  ws.pairs.reserve(ws.pair_count);
  std::memcpy(end, ws.tile_begin.data(), tiles * sizeof(int64_t));
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t part = 0; part < threads; ++part) {
    const Range band(tiles, part, threads);
    for (int64_t k = 0; k < ws.visible; ++k) {
      if (k + ahead < ws.visible) __builtin_prefetch(&ws.tiles[ws.order[k + ahead]]);
      const int32_t row = ws.order[k];
      int64_t slot = ws.tiles[row].first_slot;
      for_each_tile(ws.tiles[row], ws.splats[row], grid, [&](int64_t tile) {
        if (band.begin <= tile && tile < band.end) ws.pairs[end[tile]++] = {row, int32_t(slot)};
        ++slot;
      });
    }
  }
}

}  // namespace SPLAT_VARIANT
