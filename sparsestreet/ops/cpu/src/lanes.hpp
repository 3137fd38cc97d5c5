// Registers of the instruction set at hand: pixels of a tile, and rows of Gaussians, are worked on a register at a
// time, so that the sums over a splat's pixels stay in registers. (Left to the compiler alone they go to memory every
// time; vectors wider than a register are split badly.)
#pragma once
#if defined(__AVX2__)
#include <immintrin.h>
#endif
#include <cmath>
#include <cstdint>

#include "interface.h"

namespace SPLAT_VARIANT {

#if defined(__AVX512F__)
constexpr int REGISTER_BYTES = 64;
#elif defined(__AVX2__)
constexpr int REGISTER_BYTES = 32;
#else
constexpr int REGISTER_BYTES = 16;
#endif

template <class T>
constexpr int LANES = REGISTER_BYTES / int(sizeof(T));

template <class T>
struct LanesOf;
template <>
struct LanesOf<float> {
  typedef float Values __attribute__((vector_size(LANES<float> * sizeof(float))));
  typedef int32_t Integers __attribute__((vector_size(LANES<float> * sizeof(float))));
};
template <>
struct LanesOf<double> {
  typedef double Values __attribute__((vector_size(LANES<double> * sizeof(double))));
  typedef int64_t Integers __attribute__((vector_size(LANES<double> * sizeof(double))));
};
template <class T>
using Lanes = typename LanesOf<T>::Values;
// An integer per lane, as wide as T; comparisons of lanes have this type, -1 for true.
template <class T>
using Integers = typename LanesOf<T>::Integers;

template <class T>
inline Lanes<T> load(const T* from) {
  Lanes<T> v;
  __builtin_memcpy(&v, from, sizeof(v));
  return v;
}
template <class T>
inline void store(T* to, const Lanes<T>& v) { __builtin_memcpy(to, &v, sizeof(v)); }
template <class T>
inline Lanes<T> same(T value) { return Lanes<T>{} + value; }
template <class V>
inline V larger(const V& a, const V& b) { return a > b ? a : b; }
template <class V>
inline V smaller(const V& a, const V& b) { return a < b ? a : b; }
template <class V>
inline V magnitude(const V& a) { return a < V{} ? -a : a; }

// The same bits as another type.
template <class T>
inline Lanes<T> as_lanes(const Integers<T>& bits) {
  Lanes<T> v;
  __builtin_memcpy(&v, &bits, sizeof(v));
  return v;
}
template <class T>
inline Integers<T> as_integers(const Lanes<T>& v) {
  Integers<T> bits;
  __builtin_memcpy(&bits, &v, sizeof(v));
  return bits;
}

// Bit i: lane i of a comparison.
template <class T>
inline uint32_t bits(const Integers<T>& comparison) {
#if defined(__AVX512DQ__)
  if constexpr (sizeof(T) == 4) return _mm512_movepi32_mask(reinterpret_cast<const __m512i&>(comparison));
  else return _mm512_movepi64_mask(reinterpret_cast<const __m512i&>(comparison));
#elif defined(__AVX2__)
  if constexpr (sizeof(T) == 4) return _mm256_movemask_ps(reinterpret_cast<const __m256&>(comparison));
  else return _mm256_movemask_pd(reinterpret_cast<const __m256d&>(comparison));
#else
  uint32_t all = 0;
  for (int i = 0; i < LANES<T>; ++i) all |= uint32_t(comparison[i] != 0) << i;
  return all;
#endif
}

// 2^x for x in [-126, 0]: rounding and a minimax polynomial of degree 5 on [-1/2, 1/2] (relative error 1.2e-7).
inline Lanes<float> exp2_nonpositive(const Lanes<float>& x) {
  const Integers<float> n = __builtin_convertvector(x - 0.5f, Integers<float>);
  const Lanes<float> f = x - __builtin_convertvector(n, Lanes<float>);
  Lanes<float> p = 1.3276472454890609e-03f * f + 9.6755409613251686e-03f;
  p = p * f + 5.5507130920886993e-02f;
  p = p * f + 2.4022120237350464e-01f;
  p = p * f + 6.9314694404602051e-01f;
  p = p * f + 1.0f;
  return p * as_lanes<float>((n + 127) << 23);
}
inline Lanes<double> exp2_nonpositive(const Lanes<double>& x) {
  Lanes<double> p;
  for (int i = 0; i < LANES<double>; ++i) p[i] = std::exp2(x[i]);
  return p;
}

}  // namespace SPLAT_VARIANT
