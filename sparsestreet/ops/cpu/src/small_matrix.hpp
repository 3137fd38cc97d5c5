// 3-vectors and 3x3 matrices, as little of them as the projection needs; of numbers or of registers, also mixed.
#pragma once
#include <cmath>

namespace SPLAT_VARIANT {

template <class V>
struct Vector {
  V x, y, z;
};
template <class V>
inline Vector<V> operator+(const Vector<V>& a, const Vector<V>& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class A, class B>
inline auto operator*(const A& k, const Vector<B>& a) { return Vector<decltype(k * a.x)>{k * a.x, k * a.y, k * a.z}; }
template <class A, class B>
inline auto dot(const Vector<A>& a, const Vector<B>& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

template <class V>
struct Matrix {
  Vector<V> rows[3];
};
template <class A, class B>
inline auto operator*(const Matrix<A>& m, const Vector<B>& v) {
  return Vector<decltype(v.x * m.rows[0].x)>{dot(m.rows[0], v), dot(m.rows[1], v), dot(m.rows[2], v)};
}
// m^T v, also the row vector v^T m.
template <class A, class B>
inline auto transposed(const Matrix<A>& m, const Vector<B>& v) {
  return v.x * m.rows[0] + v.y * m.rows[1] + v.z * m.rows[2];
}
template <class A, class B>
inline auto operator*(const Matrix<A>& a, const Matrix<B>& b) {
  return Matrix<B>{{transposed(b, a.rows[0]), transposed(b, a.rows[1]), transposed(b, a.rows[2])}};
}

}  // namespace SPLAT_VARIANT
