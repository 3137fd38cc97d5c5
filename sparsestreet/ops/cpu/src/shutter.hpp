// A rolling shutter, and back. Read from its top, image row y is read at tau = y / H - 1/2 of the readout, and the
// splat's mean is then at m + tau u. As tau is linear in y, the moving splat is again one 2D Gaussian: A m' = m - u / 2
// and F' = A^-1 F with A = [[1, -u_x / H], [0, 1 - u_y / H]]. Read from its bottom, tau changes its sign, which is the
// same as a motion -u. Columns are rows of the image with x and y exchanged.
#pragma once
#include "footprint.hpp"

namespace SPLAT_VARIANT {

constexpr double SLOWEST_READOUT = 0.1;  // least 1 - u_y / H: at 0 the splat moves as the readout does

// A row that moves while the image is read out.
template <class V>
struct MovingRow : RowValues<V> {
  Vector<V> displacement;
};

// u, pixels per readout: the motion of the mean in the camera frame times the exact derivative of its pixel, reversed if
// the readout runs towards smaller coordinates.
template <class V, bool LENS, bool COLUMNS>
struct Motion {
  using T = Scalar<V>;
  V slope_x, slope_y, motion_z;
  V velocity_x, velocity_y;  // of the normalized mean
  V x, y;                    // u

  Motion() = default;
  Motion(const Camera<T>& c, const Placement<V>& p, const Vector<V>& displacement) {
    const Vector<V> moved = c.rotation * displacement;
    const Vector<T>&t = c.shutter_translation, &w = c.shutter_rotation;
    const V motion_x = moved.x - t.x - (w.y * p.mean.z - w.z * p.mean.y);
    const V motion_y = moved.y - t.y - (w.z * p.mean.x - w.x * p.mean.z);
    motion_z = moved.z - t.z - (w.x * p.mean.y - w.y * p.mean.x);
    slope_x = p.mean.x * p.inverse_z, slope_y = p.mean.y * p.inverse_z;
    velocity_x = (motion_x - slope_x * motion_z) * p.inverse_z;
    velocity_y = (motion_y - slope_y * motion_z) * p.inverse_z;
    V bent_x = velocity_x, bent_y = velocity_y;
    if constexpr (LENS) {
      const LensJacobian<V> j(c, slope_x, slope_y);
      bent_x = j.xx * velocity_x + j.xy * velocity_y, bent_y = j.xy * velocity_x + j.yy * velocity_y;
    }
    x = c.motion_fx * bent_x, y = c.motion_fy * bent_y;
  }

  // Gradient of the mean in the camera frame.
  Vector<V> backward(const Camera<T>& c, const Placement<V>& p, const V& v_u_x, const V& v_u_y) const {
    V v_x = c.motion_fx * v_u_x, v_y = c.motion_fy * v_u_y, slopes_x{}, slopes_y{};
    if constexpr (LENS) {
      const LensJacobian<V> j(c, slope_x, slope_y);
      LensJacobian<V>::backward(c, slope_x, slope_y, v_x * velocity_x, v_x * velocity_y + v_y * velocity_x,
                                v_y * velocity_y, slopes_x, slopes_y);
      const V bent_x = v_x;
      v_x = j.xx * bent_x + j.xy * v_y, v_y = j.xy * bent_x + j.yy * v_y;
    }
    const V iz = p.inverse_z, v_depth = -iz * (v_x * velocity_x + v_y * velocity_y);
    slopes_x -= motion_z * iz * v_x, slopes_y -= motion_z * iz * v_y;
    const Vector<V> motion{v_x * iz, v_y * iz, -(slope_x * v_x + slope_y * v_y) * iz};
    const Vector<T>& w = c.shutter_rotation;
    const Vector<V> turned{w.y * motion.z - w.z * motion.y, w.z * motion.x - w.x * motion.z,
                           w.x * motion.y - w.y * motion.x};
    return turned + Vector<V>{slopes_x * iz, slopes_y * iz,
                              v_depth - (slope_x * slopes_x + slope_y * slopes_y) * iz};
  }
};

// The footprint as the readout records it; answers a = 1 - u_along / length, along the readout: 1 - u_y / H for rows.
template <class V, bool LENS, bool COLUMNS, int K>
inline V read_out(const Camera<Scalar<V>>& c, const Motion<V, LENS, COLUMNS>& u, Footprint<V, K>& f) {
  const auto length = COLUMNS ? c.width : c.height;
  const V &u_along = COLUMNS ? u.x : u.y, &u_across = COLUMNS ? u.y : u.x;
  V &along = COLUMNS ? f.x : f.y, &across = COLUMNS ? f.y : f.x;
  auto &factor_along = COLUMNS ? f.factor_x : f.factor_y, &factor_across = COLUMNS ? f.factor_y : f.factor_x;
  const V a = 1 - u_along / length, shear = u_across / length;
  along = (along - u_along / 2) / a;
  across += u_across * (along / length - Scalar<V>(0.5));
  for (int i = 0; i < K; ++i) factor_along[i] = factor_along[i] / a, factor_across[i] += shear * factor_along[i];
  return a;
}

// Turns the gradient of the recorded footprint `f` into that of the footprint before, and answers that of u.
template <class V, bool LENS, bool COLUMNS, int K>
inline void read_out_backward(const Camera<Scalar<V>>& c, const Motion<V, LENS, COLUMNS>& u, const Footprint<V, K>& f,
                              Footprint<V, K>& g, V& v_u_x, V& v_u_y) {
  const auto length = COLUMNS ? c.width : c.height;
  const V &u_along = COLUMNS ? u.x : u.y, &u_across = COLUMNS ? u.y : u.x;
  const V& along = COLUMNS ? f.x : f.y;
  const auto& factor_along = COLUMNS ? f.factor_x : f.factor_y;
  V &g_along = COLUMNS ? g.x : g.y, &g_across = COLUMNS ? g.y : g.x;
  auto &g_factor_along = COLUMNS ? g.factor_x : g.factor_y, &g_factor_across = COLUMNS ? g.factor_y : g.factor_x;
  const V a = 1 - u_along / length, shear = u_across / length;
  V v_shear{}, stretch{};
  for (int i = 0; i < K; ++i) {
    v_shear += g_factor_across[i] * factor_along[i];
    g_factor_along[i] += shear * g_factor_across[i];
    stretch += g_factor_along[i] * factor_along[i];
    g_factor_along[i] = g_factor_along[i] / a;
  }
  const V v_along = g_along + shear * g_across;
  (COLUMNS ? v_u_y : v_u_x) = g_across * (along / length - Scalar<V>(0.5)) + v_shear / length;
  (COLUMNS ? v_u_x : v_u_y) = (v_along * along + stretch) / (a * length) - v_along / (2 * a);
  g_along = v_along / a;
}

}  // namespace SPLAT_VARIANT
