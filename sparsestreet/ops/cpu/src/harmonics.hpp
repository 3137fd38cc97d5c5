// Real spherical harmonics to degree 3 (ops/spherical_harmonics.py has the same in torch) and their derivative.
#pragma once
#include "small_matrix.hpp"
#include "values.hpp"

namespace SPLAT_VARIANT {

// sqrt(1/pi)/2; sqrt(3/(4 pi)); sqrt(15/pi)/2, sqrt(5/pi)/4, sqrt(15/pi)/4;
// sqrt(35/(2 pi))/4, sqrt(105/pi)/2, sqrt(21/(2 pi))/4, sqrt(7/pi)/4, sqrt(105/pi)/4.
constexpr double Y0 = 0.28209479177387814;
constexpr double Y1 = 0.48860251190291992;
constexpr double Y2_MIXED = 1.0925484305920792, Y2_ZONAL = 0.31539156525252001, Y2_PLANAR = 0.54627421529603959;
constexpr double Y3_OUTER = 0.59004358992664352, Y3_CORNER = 2.8906114426405538, Y3_MIDDLE = 0.45704579946446572;
constexpr double Y3_ZONAL = 0.37317633259011546, Y3_PLANAR = 1.4453057213202769;

// The first `terms` functions at the unit direction d.
template <class V>
inline void basis(const Vector<V>& d, int64_t terms, V* out) {
  using T = Scalar<V>;
  const V x = d.x, y = d.y, z = d.z;
  out[0] = V{} + T(Y0);
  if (terms > 1) {
    out[1] = -T(Y1) * y, out[2] = T(Y1) * z, out[3] = -T(Y1) * x;
  }
  if (terms > 4) {
    out[4] = T(Y2_MIXED) * x * y;
    out[5] = -T(Y2_MIXED) * y * z;
    out[6] = T(Y2_ZONAL) * (2 * z * z - x * x - y * y);
    out[7] = -T(Y2_MIXED) * x * z;
    out[8] = T(Y2_PLANAR) * (x * x - y * y);
  }
  if (terms > 9) {
    out[9] = -T(Y3_OUTER) * y * (3 * x * x - y * y);
    out[10] = T(Y3_CORNER) * x * y * z;
    out[11] = -T(Y3_MIDDLE) * y * (4 * z * z - x * x - y * y);
    out[12] = T(Y3_ZONAL) * z * (2 * z * z - 3 * x * x - 3 * y * y);
    out[13] = -T(Y3_MIDDLE) * x * (4 * z * z - x * x - y * y);
    out[14] = T(Y3_PLANAR) * z * (x * x - y * y);
    out[15] = -T(Y3_OUTER) * x * (x * x - 3 * y * y);
  }
}

// sum_i v[i] d(basis_i)/d(direction).
template <class V>
inline Vector<V> basis_backward(const Vector<V>& d, int64_t terms, const V* v) {
  using T = Scalar<V>;
  const V x = d.x, y = d.y, z = d.z;
  Vector<V> g{};
  if (terms > 1) {
    g.x -= T(Y1) * v[3], g.y -= T(Y1) * v[1], g.z += T(Y1) * v[2];
  }
  if (terms > 4) {
    const V xy = T(Y2_MIXED) * v[4], yz = T(Y2_MIXED) * v[5], xz = T(Y2_MIXED) * v[7];
    const V zonal = 2 * T(Y2_ZONAL) * v[6], planar = 2 * T(Y2_PLANAR) * v[8];
    g.x += xy * y - xz * z + (planar - zonal) * x;
    g.y += xy * x - yz * z - (planar + zonal) * y;
    g.z += 2 * zonal * z - yz * y - xz * x;
  }
  if (terms > 9) {
    const V o1 = T(Y3_OUTER) * v[9], corner = T(Y3_CORNER) * v[10], m1 = T(Y3_MIDDLE) * v[11];
    const V zonal = T(Y3_ZONAL) * v[12], m2 = T(Y3_MIDDLE) * v[13], planar = T(Y3_PLANAR) * v[14];
    const V o2 = T(Y3_OUTER) * v[15];
    const V xx = x * x, yy = y * y, zz = z * z;
    g.x += -6 * o1 * x * y + corner * y * z + 2 * m1 * x * y - 6 * zonal * x * z - m2 * (4 * zz - 3 * xx - yy) +
           2 * planar * x * z - 3 * o2 * (xx - yy);
    g.y += -3 * o1 * (xx - yy) + corner * x * z - m1 * (4 * zz - xx - 3 * yy) - 6 * zonal * y * z + 2 * m2 * x * y -
           2 * planar * y * z + 6 * o2 * x * y;
    g.z += corner * x * y - 8 * m1 * y * z + 3 * zonal * (2 * zz - xx - yy) - 8 * m2 * x * z + planar * (xx - yy);
  }
  return g;
}

}  // namespace SPLAT_VARIANT
