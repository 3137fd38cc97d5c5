// The lists of (splat, tile) pairs, in row order: the loops over tiles sort them by depth (tile_order.hpp). Nothing
// depends on the number of threads.
#pragma once
#include "tiles.hpp"

namespace SPLAT_VARIANT {

// Below this many rows one thread fills the lists in a millisecond, and a meeting of threads at a barrier can cost more
// than that on a machine that has other work as well.
constexpr int64_t ROWS_WORTH_THREADS = 1 << 17;

// A part's rows; it ends with a whole register of them, but for the last.
template <class T>
inline Range blocks_of_part(int64_t rows, int64_t part, int64_t parts) {
  const Range blocks((rows + LANES<T> - 1) / LANES<T>, part, parts);
  const int64_t end = blocks.end * LANES<T>;
  return {blocks.begin * LANES<T>, end < rows ? end : rows};
}

// Turns ws.histogram, in which projecting left how many pairs each part of the rows has in each tile, into the places
// where the part's pairs begin; fills ws.tile_begin, ws.part_slots and ws.pair_count. Numbers of pairs may pass 2^31.
template <class T>
void begin_tiles(Workspace<T>& ws, int64_t tiles, int64_t parts) {
  ws.tile_begin.reserve(tiles + 1), ws.tile_end.reserve(tiles), ws.part_slots.reserve(parts);
  int64_t total = 0;
  for (int64_t part = 0; part < parts; ++part) {
    ws.part_slots[part] = total;
    for (int64_t tile = 0; tile < tiles; ++tile) total += ws.histogram[part * tiles + tile];
  }
  ws.pair_count = total, total = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    ws.tile_begin[tile] = total;
    for (int64_t part = 0; part < parts; ++part) {
      const int64_t here = ws.histogram[part * tiles + tile];
      ws.histogram[part * tiles + tile] = total;
      total += here;
    }
  }
  ws.tile_begin[tiles] = total;
}

// Gives each row its slots and fills the lists in row order.
template <class T>
void fill_tiles(Workspace<T>& ws, const Grid<T>& grid, int64_t rows, int64_t parts) {
  const int64_t tiles = grid.tiles_x * grid.tiles_y, threads = rows < ROWS_WORTH_THREADS ? 1 : parts;
  ws.pairs.reserve(ws.pair_count), ws.other_pairs.reserve(ws.pair_count), ws.masks.reserve(ws.pair_count);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t part = 0; part < parts; ++part) {
    int64_t *next = &ws.histogram[part * tiles], slot = ws.part_slots[part];
    const Range range = blocks_of_part<T>(rows, part, parts);
    for (int64_t i = range.begin; i < range.end; ++i) {
      TileSet<T>& set = ws.tiles[i];
      set.first_slot = slot;
      for_each_tile(set, ws.splats[i], grid, [&](int64_t tile) {
        ws.pairs[next[tile]++] = {set.depth_key, int32_t(i), int32_t(slot++)};
      });
    }
  }
}

}  // namespace SPLAT_VARIANT
