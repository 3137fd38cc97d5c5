// 3-vectors and 3x3 matrices, as little of them as the projection needs.
#pragma once
#include <cmath>

namespace SPLAT_VARIANT {

template <class T>
struct Vector {
  T x, y, z;
};
template <class T>
inline Vector<T> operator+(Vector<T> a, Vector<T> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class T>
inline Vector<T> operator*(T k, Vector<T> a) { return {k * a.x, k * a.y, k * a.z}; }
template <class T>
inline T dot(Vector<T> a, Vector<T> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class T>
inline Vector<T> cross(Vector<T> a, Vector<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

template <class T>
struct Matrix {
  Vector<T> rows[3];
};
template <class T>
inline Vector<T> operator*(const Matrix<T>& m, Vector<T> v) {
  return {dot(m.rows[0], v), dot(m.rows[1], v), dot(m.rows[2], v)};
}
// m^T v, also the row vector v^T m.
template <class T>
inline Vector<T> transposed(const Matrix<T>& m, Vector<T> v) {
  return v.x * m.rows[0] + v.y * m.rows[1] + v.z * m.rows[2];
}
template <class T>
inline Matrix<T> operator*(const Matrix<T>& a, const Matrix<T>& b) {
  return {{transposed(b, a.rows[0]), transposed(b, a.rows[1]), transposed(b, a.rows[2])}};
}

}  // namespace SPLAT_VARIANT
