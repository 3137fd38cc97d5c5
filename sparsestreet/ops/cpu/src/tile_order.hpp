// The order of a tile's list: each is sorted on its own, where its pixels are worked on, so that sorting shares the
// threads, and meets no barrier, that the pixels need anyway.
#pragma once
#include <utility>

#include "workspace.hpp"

namespace SPLAT_VARIANT {

// How a list's keys are cut into digits.
struct Digits {
  int passes, bits;
  explicit Digits(uint64_t different) {
    const int key_bits = different ? 64 - __builtin_clzll(different) : 0;
    passes = (key_bits + 8) / 9, bits = passes ? (key_bits + passes - 1) / passes : 0;
  }
  int of(uint64_t key, int pass) const { return int(key >> (pass * bits)) & ((1 << bits) - 1); }
};

// Puts the list of a tile in order, nearest first, ties by row: radix sort by those bits of the keys that differ.
template <class T>
void sort_tile(Workspace<T>& ws, int64_t tile) {
  const int64_t begin = ws.tile_begin[tile], count = ws.tile_begin[tile + 1] - begin;
  Pair<T> *from = &ws.pairs[begin], *to = &ws.other_pairs[begin];
  uint64_t different = 0;
  for (int64_t k = 1; k < count; ++k) different |= from[k].depth_key ^ from[0].depth_key;
  const Digits digits(different);
  int32_t next[8][512];  // by pass and digit: how many, then where the next one goes
  for (int pass = 0; pass < digits.passes; ++pass) std::memset(next[pass], 0, sizeof(int32_t) << digits.bits);
  for (int64_t k = 0; k < count; ++k)
    for (int pass = 0; pass < digits.passes; ++pass) ++next[pass][digits.of(from[k].depth_key, pass)];
  for (int pass = 0; pass < digits.passes; ++pass) {
    int32_t total = 0;
    for (int digit = 0; digit < 1 << digits.bits; ++digit) total += std::exchange(next[pass][digit], total);
    for (int64_t k = 0; k < count; ++k) to[next[pass][digits.of(from[k].depth_key, pass)]++] = from[k];
    std::swap(from, to);
  }
  if (digits.passes % 2) std::memcpy(static_cast<void*>(to), from, count * sizeof(Pair<T>));
}

}  // namespace SPLAT_VARIANT
