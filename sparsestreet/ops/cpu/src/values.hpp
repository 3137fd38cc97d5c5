// The few functions that formulas need beyond arithmetic, for a number and for a register of them alike: V is T or
// Lanes<T>. Comparisons of registers are masks, so `condition ? a : b` selects lane by lane, and NaN compares false.
#pragma once
#include <type_traits>

#include "lanes.hpp"

namespace SPLAT_VARIANT {

template <class V>
struct ScalarOf {
  using Type = V;
};
template <>
struct ScalarOf<Lanes<float>> {
  using Type = float;
};
template <>
struct ScalarOf<Lanes<double>> {
  using Type = double;
};
template <class V>
using Scalar = typename ScalarOf<V>::Type;

// Integers beside V: one, or one per lane.
template <class V>
struct IndexOf {
  using Type = std::conditional_t<sizeof(V) == 4, int32_t, int64_t>;
};
template <>
struct IndexOf<Lanes<float>> {
  using Type = Integers<float>;
};
template <>
struct IndexOf<Lanes<double>> {
  using Type = Integers<double>;
};
template <class V>
using Index = typename IndexOf<V>::Type;

inline float root(float v) { return std::sqrt(v); }
inline double root(double v) { return std::sqrt(v); }
inline Lanes<float> root(const Lanes<float>& v) {
  Lanes<float> r;
  for (int i = 0; i < LANES<float>; ++i) r[i] = std::sqrt(v[i]);
  return r;
}
inline Lanes<double> root(const Lanes<double>& v) {
  Lanes<double> r;
  for (int i = 0; i < LANES<double>; ++i) r[i] = std::sqrt(v[i]);
  return r;
}

template <class V, class Low, class High>
inline V limited(const V& value, const Low& low, const High& high) {
  const V lowest = V{} + low, highest = V{} + high;
  return value < lowest ? lowest : (value > highest ? highest : value);
}

template <class V>
inline V positive_part(const V& v) { return v > V{} ? v : V{}; }

// Towards zero.
inline int32_t truncated(float v) { return int32_t(v); }
inline int64_t truncated(double v) { return int64_t(v); }
inline Integers<float> truncated(const Lanes<float>& v) { return __builtin_convertvector(v, Integers<float>); }
inline Integers<double> truncated(const Lanes<double>& v) { return __builtin_convertvector(v, Integers<double>); }
inline float as_value(int32_t v) { return float(v); }
inline double as_value(int64_t v) { return double(v); }
inline Lanes<float> as_value(const Integers<float>& v) { return __builtin_convertvector(v, Lanes<float>); }
inline Lanes<double> as_value(const Integers<double>& v) { return __builtin_convertvector(v, Lanes<double>); }

template <class V>
inline Index<V> ceiling(const V& v) {
  const Index<V> whole = truncated(v);
  return as_value(whole) < v ? whole + 1 : whole;
}
template <class V>
inline Index<V> floored(const V& v) {
  const Index<V> whole = truncated(v);
  return as_value(whole) > v ? whole - 1 : whole;
}

// log2 of positive normal numbers: v = 2^e m with m in [sqrt(1/2), sqrt(2)), and ln m = 2 artanh((m - 1) / (m + 1)) as
// its series, cut where the terms fall below the rounding. Exact at powers of two.
template <class T>
inline Lanes<T> log2_positive(const Lanes<T>& v) {
  constexpr int mantissa = sizeof(T) == 4 ? 23 : 52, terms = sizeof(T) == 4 ? 4 : 10;
  constexpr T root_half = T(0.70710678118654752);
  const Integers<T> bits = as_integers<T>(v), exponent = (bits - as_integers<T>(same(root_half))) >> mantissa;
  const Lanes<T> m = as_lanes<T>(bits - (exponent << mantissa)), s = (m - 1) / (m + 1), square = s * s;
  Lanes<T> series = same(T(1) / T(2 * terms + 1));
  for (int k = terms - 1; k >= 0; --k) series = series * square + T(1) / T(2 * k + 1);
  return T(2.8853900817779268) * s * series + as_value(exponent);  // 2 / ln 2
}

// Numbers rounded to float32.
inline Lanes<float> in_single(const Lanes<float>& v) { return v; }
inline Lanes<double> in_single(const Lanes<double>& v) {
  typedef float Singles __attribute__((vector_size(LANES<double> * sizeof(float))));
  return __builtin_convertvector(__builtin_convertvector(v, Singles), Lanes<double>);
}

// The nearest float16 of numbers >= 0, at most its largest finite one; through float32, as torch goes.
template <class T>
inline Lanes<T> rounded_to_half(const Lanes<T>& given) {
  constexpr int dropped = (sizeof(T) == 4 ? 23 : 52) - 10;
  constexpr T largest = 65504, least_normal = T(6.103515625e-5);  // 2^-14
  constexpr T subnormal_sum = T(int64_t(1) << (dropped + 10)) / (1 << 24);
  const Lanes<T> single = in_single(given), v = single < largest ? single : same(largest);
  const Integers<T> one = Integers<T>{} + 1, bits = as_integers<T>(v);
  const Integers<T> to_even = bits + ((one << (dropped - 1)) - 1) + ((bits >> dropped) & 1);
  // Added, the last digit of the sum is that of the subnormals, 2^-24.
  return v < least_normal ? (v + subnormal_sum) - subnormal_sum : as_lanes<T>((to_even >> dropped) << dropped);
}

template <class T>
inline bool any(const Integers<T>& mask) {
  Index<T> together = 0;
  for (int i = 0; i < LANES<T>; ++i) together |= mask[i];
  return together != 0;
}

}  // namespace SPLAT_VARIANT
