// exp and the logistic function of a register, to the last digit or two over the whole range.
#pragma once
#include "lanes.hpp"

namespace SPLAT_VARIANT {

// e^x = 2^n e^r with |r| <= ln 2 / 2, where the Taylor series to degree 7 is off by 5e-9. The two halves of 2^n reach
// subnormals and infinity as they should.
inline Lanes<float> exponential(const Lanes<float>& given) {
  const Lanes<float> x = larger(smaller(given, same(89.0f)), same(-104.0f));
  const Lanes<float> turns = x * 1.44269504f;
  const Integers<float> n = __builtin_convertvector(turns + (turns < 0 ? same(-0.5f) : same(0.5f)), Integers<float>);
  const Lanes<float> whole = __builtin_convertvector(n, Lanes<float>);
  // ln 2 in two parts, the first with so few digits that its products with n are exact.
  const Lanes<float> r = (x - whole * 0.693115234375f) - whole * 3.19461833e-05f;
  Lanes<float> p = same(1.0f / 5040);
  for (const float k : {1.0f / 720, 1.0f / 120, 1.0f / 24, 1.0f / 6, 0.5f, 1.0f, 1.0f}) p = p * r + k;
  const Integers<float> half = n >> 1;
  const Lanes<float> value = p * as_lanes<float>((half + 127) << 23) * as_lanes<float>((n - half + 127) << 23);
  return given == given ? value : given;
}
inline Lanes<double> exponential(const Lanes<double>& x) {
  Lanes<double> p;
  for (int i = 0; i < LANES<double>; ++i) p[i] = std::exp(x[i]);
  return p;
}

// out[i] = f(in[i]), a register at a time; f(0) must be harmless.
template <class T, class F>
inline void map_lanes(const T* in, T* out, int64_t count, F f) {
  int64_t i = 0;
  for (; i + LANES<T> <= count; i += LANES<T>) store(out + i, Lanes<T>(f(load(in + i))));
  if (i == count) return;
  T last[LANES<T>] = {};
  for (int64_t k = i; k < count; ++k) last[k - i] = in[k];
  store(last, Lanes<T>(f(load(last))));
  for (int64_t k = i; k < count; ++k) out[k] = last[k - i];
}

}  // namespace SPLAT_VARIANT
