// Brown-Conrady distortion ("Close-range camera calibration", 1971) of normalized points and its derivatives, in the
// form of geometry/lenses.py: past the fold of the radial polynomial it is continued in proportion to the radius.
#pragma once
#include "camera.hpp"

namespace SPLAT_VARIANT {

// d(out) / d(in), symmetric, at a point before the fold.
template <class V>
struct LensJacobian {
  using T = Scalar<V>;
  V xx, xy, yy;

  LensJacobian(const Camera<T>& c, const V& x, const V& y) {
    const V r2 = x * x + y * y, radial = 1 + r2 * (c.k1 + r2 * (c.k2 + r2 * c.k3)), twice_slope = slope(c, r2);
    xx = radial + twice_slope * x * x + 2 * c.p1 * y + 6 * c.p2 * x;
    xy = twice_slope * x * y + 2 * (c.p1 * x + c.p2 * y);
    yy = radial + twice_slope * y * y + 6 * c.p1 * y + 2 * c.p2 * x;
  }
  // Twice the derivative of the radial factor by r^2.
  static V slope(const Camera<T>& c, const V& r2) { return 2 * (c.k1 + r2 * (2 * c.k2 + r2 * (3 * c.k3))); }

  // Gradient of a xx + b xy + d yy by the point.
  static void backward(const Camera<T>& c, const V& x, const V& y, const V& a, const V& b, const V& d, V& v_x, V& v_y) {
    const V r2 = x * x + y * y, twice_slope = slope(c, r2), bend = 2 * (4 * c.k2 + (12 * c.k3) * r2);
    const V square = bend * (a * x * x + b * x * y + d * y * y);
    v_x = (3 * a + d) * twice_slope * x + b * twice_slope * y + x * square + 6 * c.p2 * a + 2 * c.p1 * b + 2 * c.p2 * d;
    v_y = (a + 3 * d) * twice_slope * y + b * twice_slope * x + y * square + 2 * c.p1 * a + 2 * c.p2 * b + 6 * c.p1 * d;
  }
};

// A normalized point and where the lens images it.
template <class V>
struct LensPoint {
  using T = Scalar<V>;
  V x, y, x_out, y_out;
  V shrink;  // to the fold; 1 before it

  LensPoint() = default;
  LensPoint(const Camera<T>& c, const V& x, const V& y) : x(x), y(y) {
    const V r2 = x * x + y * y;
    shrink = r2 > c.fold ? root(c.fold / r2) : V{} + T(1);
    const V u = shrink * x, v = shrink * y, s2 = u * u + v * v;
    const V radial = 1 + s2 * (c.k1 + s2 * (c.k2 + s2 * c.k3));
    x_out = (u * radial + 2 * c.p1 * u * v + c.p2 * (s2 + 2 * u * u)) / shrink;
    y_out = (v * radial + c.p1 * (s2 + 2 * v * v) + 2 * c.p2 * u * v) / shrink;
  }

  // J^T v. Past the fold, with n = x / |x| and R the fold's radius, J = J(R n) (I - n n^T) + D(R n) n^T / R.
  void backward(const Camera<T>& c, const V& v_x_out, const V& v_y_out, V& v_x, V& v_y) const {
    const V u = shrink * x, v = shrink * y;
    const LensJacobian<V> j(c, u, v);
    v_x = j.xx * v_x_out + j.xy * v_y_out, v_y = j.xy * v_x_out + j.yy * v_y_out;
    const V radial = (shrink * (x_out * v_x_out + y_out * v_y_out) - u * v_x - v * v_y) / c.fold;
    const auto past = shrink < V{} + T(1);
    v_x += past ? radial * u : V{}, v_y += past ? radial * v : V{};
  }
};

}  // namespace SPLAT_VARIANT
