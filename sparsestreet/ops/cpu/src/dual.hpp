// Numbers that carry their derivatives along: for short formulas with few inputs, whose gradient then needs no formula
// of its own.
#pragma once
#include <cmath>

namespace SPLAT_VARIANT {

template <int N>
struct Dual {
  double value = 0, d[N] = {};
  Dual() = default;
  Dual(double v) : value(v) {}
  // The result of a function of `a` with this value and this derivative.
  static Dual chain(const Dual& a, double value, double slope) {
    Dual r(value);
    for (int k = 0; k < N; ++k) r.d[k] = slope * a.d[k];
    return r;
  }
};

template <int N>
inline Dual<N> operator+(const Dual<N>& a, const Dual<N>& b) {
  Dual<N> r(a.value + b.value);
  for (int k = 0; k < N; ++k) r.d[k] = a.d[k] + b.d[k];
  return r;
}
template <int N>
inline Dual<N> operator*(const Dual<N>& a, const Dual<N>& b) {
  Dual<N> r(a.value * b.value);
  for (int k = 0; k < N; ++k) r.d[k] = a.value * b.d[k] + b.value * a.d[k];
  return r;
}
template <int N>
inline Dual<N> operator*(double a, const Dual<N>& b) { return Dual<N>::chain(b, a * b.value, a); }
template <int N>
inline Dual<N> operator-(const Dual<N>& a) { return -1.0 * a; }
template <int N>
inline Dual<N> operator-(const Dual<N>& a, const Dual<N>& b) { return a + -b; }
template <int N>
inline Dual<N> inverse(const Dual<N>& a) { return Dual<N>::chain(a, 1 / a.value, -1 / (a.value * a.value)); }
template <int N>
inline Dual<N> operator/(const Dual<N>& a, const Dual<N>& b) { return a * inverse(b); }
template <int N>
inline Dual<N> square_root(const Dual<N>& a) {
  const double root = std::sqrt(a.value);
  return Dual<N>::chain(a, root, 0.5 / root);
}
template <int N>
inline Dual<N> sine(const Dual<N>& a) { return Dual<N>::chain(a, std::sin(a.value), std::cos(a.value)); }
template <int N>
inline Dual<N> cosine(const Dual<N>& a) { return Dual<N>::chain(a, std::cos(a.value), -std::sin(a.value)); }
template <int N>
inline Dual<N> arc_cosine(const Dual<N>& a) {
  return Dual<N>::chain(a, std::acos(a.value), -1 / std::sqrt(1 - a.value * a.value));
}

}  // namespace SPLAT_VARIANT
