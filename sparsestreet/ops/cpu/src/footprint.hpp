// Where a Gaussian lands on the screen, and back: its mean, and a factor F of its covariance F F^T (px^2). Two models
// with one interface: the pinhole, linear at the mean, and the distorted lens, by the unscented transform.
#pragma once
#include "lens.hpp"
#include "placement.hpp"

namespace SPLAT_VARIANT {

// Mean and the rows of the factor; or their gradients.
template <class V, int K>
struct Footprint {
  V x, y, factor_x[K], factor_y[K];
};

// F = J axes, EWA splatting (Zwicker et al. 2001).
template <class V>
struct Pinhole {
  static constexpr int COLUMNS = 3;
  using T = Scalar<V>;
  V slope[2];          // x / z and y / z, limited for J
  Index<V> inside[2];  // the slope was not limited

  Footprint<V, 3> forward(const Camera<T>& camera, const Placement<V>& p) {
    const V slopes[2] = {p.mean.x * p.inverse_z, p.mean.y * p.inverse_z};
    for (int axis = 0; axis < 2; ++axis) {
      slope[axis] = limited(slopes[axis], camera.slope_min[axis], camera.slope_max[axis]);
      inside[axis] = slope[axis] == slopes[axis];
    }
    const Vector<V> x = (camera.fx * p.inverse_z) * (p.axes.rows[0] + -slope[0] * p.axes.rows[2]);
    const Vector<V> y = (camera.fy * p.inverse_z) * (p.axes.rows[1] + -slope[1] * p.axes.rows[2]);
    return {camera.fx * p.mean.x * p.inverse_z + camera.cx, camera.fy * p.mean.y * p.inverse_z + camera.cy,
            {x.x, x.y, x.z}, {y.x, y.y, y.z}};
  }
  Index<V> sees(const Camera<T>&, const Placement<V>&) const { return Index<V>{} - 1; }

  PlacementGradient<V> backward(const Camera<T>& camera, const Placement<V>& p, const Footprint<V, 3>& g) const {
    const Vector<V> gx{g.factor_x[0], g.factor_x[1], g.factor_x[2]}, gy{g.factor_y[0], g.factor_y[1], g.factor_y[2]};
    const V iz = p.inverse_z, jx = camera.fx * iz, jy = camera.fy * iz;
    const V v_jxx = dot(gx, p.axes.rows[0]), v_jxz = dot(gx, p.axes.rows[2]);
    const V v_jyy = dot(gy, p.axes.rows[1]), v_jyz = dot(gy, p.axes.rows[2]);
    const V x = inside[0] ? -jx * v_jxz * iz : V{}, y = inside[1] ? -jy * v_jyz * iz : V{};
    const V z = -iz * (jx * v_jxx + jy * v_jyy - jx * slope[0] * v_jxz - jy * slope[1] * v_jyz) - x * slope[0] -
                y * slope[1] - (g.x * jx * p.mean.x + g.y * jy * p.mean.y) * iz;
    return {{x + g.x * jx, y + g.y * jy, z},
            {{jx * gx, jy * gy, (-jx * slope[0]) * gx + (-jy * slope[1]) * gy}}};
  }
};

// Seven sigma points mu, mu +- sqrt(3) a_k are sent through projection and lens (Julier and Uhlmann 1997, alpha = 1,
// beta = 2, kappa = 0; for splats 3DGUT, Wu et al. 2025): mu weighs 0 in the mean and 2 in the covariance, the others
// 1/6 in both. Columns of F: sqrt(weight) (pixel - mean).
template <class V>
struct Distorted {
  static constexpr int COLUMNS = 7;
  using T = Scalar<V>;
  LensPoint<V> points[7];  // normalized
  V inverse_z[7];
  Index<V> in_front[7];  // depth was not limited to the near plane

  static T weight_root(int i) { return i == 0 ? T(1.4142135623730951) : T(0.40824829046386302); }
  static Vector<V> column(const Matrix<V>& m, int k) {
    const auto at = [k](const Vector<V>& r) { return k == 0 ? r.x : k == 1 ? r.y : r.z; };
    return {at(m.rows[0]), at(m.rows[1]), at(m.rows[2])};
  }

  Footprint<V, 7> forward(const Camera<T>& camera, const Placement<V>& p) {
    Footprint<V, 7> f;
    const T step = T(1.7320508075688772);
    f.x = f.y = V{};
    for (int i = 0; i < 7; ++i) {
      const T sign = i == 0 ? T(0) : i <= 3 ? step : -step;
      const Vector<V> point = p.mean + sign * column(p.axes, (i + 2) % 3);
      in_front[i] = point.z > camera.near_plane;
      inverse_z[i] = 1 / (in_front[i] ? point.z : V{} + camera.near_plane);
      points[i] = LensPoint<V>(camera, point.x * inverse_z[i], point.y * inverse_z[i]);
      // Without the principal point, whose digits the differences would lose.
      f.factor_x[i] = camera.fx * points[i].x_out, f.factor_y[i] = camera.fy * points[i].y_out;
      if (i > 0) f.x += T(1) / 6 * f.factor_x[i], f.y += T(1) / 6 * f.factor_y[i];
    }
    for (int i = 0; i < 7; ++i) {
      f.factor_x[i] = weight_root(i) * (f.factor_x[i] - f.x);
      f.factor_y[i] = weight_root(i) * (f.factor_y[i] - f.y);
    }
    f.x += camera.cx, f.y += camera.cy;
    return f;
  }
  // The lens does not see what lies past the fold of its polynomial.
  Index<V> sees(const Camera<T>& camera, const Placement<V>& p) const {
    const V x = p.mean.x * p.inverse_z, y = p.mean.y * p.inverse_z;
    return x * x + y * y <= camera.fold;
  }

  PlacementGradient<V> backward(const Camera<T>& camera, const Placement<V>&, const Footprint<V, 7>& g) const {
    V mean_x = g.x, mean_y = g.y;
    for (int i = 0; i < 7; ++i) mean_x -= weight_root(i) * g.factor_x[i], mean_y -= weight_root(i) * g.factor_y[i];
    PlacementGradient<V> out{};
    for (int i = 0; i < 7; ++i) {
      const T share = i == 0 ? T(0) : T(1) / 6, step = T(1.7320508075688772);
      V x, y;
      points[i].backward(camera, camera.fx * (weight_root(i) * g.factor_x[i] + share * mean_x),
                         camera.fy * (weight_root(i) * g.factor_y[i] + share * mean_y), x, y);
      const V z = in_front[i] ? -(x * points[i].x + y * points[i].y) * inverse_z[i] : V{};
      const Vector<V> v{x * inverse_z[i], y * inverse_z[i], z};
      out.mean = out.mean + v;
      if (i > 0) add_column(out.axes, (i + 2) % 3, (i <= 3 ? step : -step) * v);
    }
    return out;
  }
  static void add_column(Matrix<V>& m, int k, const Vector<V>& v) {
    const auto add = [k](Vector<V>& r, const V& value) { (k == 0 ? r.x : k == 1 ? r.y : r.z) += value; };
    add(m.rows[0], v.x), add(m.rows[1], v.y), add(m.rows[2], v.z);
  }
};

}  // namespace SPLAT_VARIANT
