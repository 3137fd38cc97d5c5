// From the sums over pixels back to the parameters, one row at a time: slots of a row are summed in a fixed order.
#pragma once
#include <omp.h>

#include "prepare.hpp"

namespace SPLAT_VARIANT {

// Gradients of one splat on the screen, in natural units (exponent -|L d|^2 / 2).
template <class T>
struct ScreenGradient {
  T x, y, abs_x, abs_y, l11, l21, l22;
  T opacity;  // of the effective opacity
  Vector<T> color;
  T depth;
};

template <class T>
inline Slot<T> sum_slots(const Workspace<T>& ws, int64_t row) {
  Slot<T> sum{};
  const Slot<T>* slots = ws.slots.data() + ws.first_slot[row];
  for (int32_t k = 0; k < ws.tiles[row].count; ++k) {
    const Slot<T>& o = slots[k];
    sum.s += o.s, sum.sa += o.sa, sum.sb += o.sb, sum.sa_dx += o.sa_dx;
    sum.sa_dy += o.sa_dy, sum.sb_dy += o.sb_dy;
    sum.abs_x += o.abs_x, sum.abs_y += o.abs_y, sum.depth += o.depth;
    for (int c = 0; c < 3; ++c) sum.color[c] += o.color[c];
  }
  return sum;
}

// ln alpha = ln o - ln 2 |L d|^2 with the record's L, which is the Cholesky factor times k = LOG2_SCALE.
template <class T>
inline ScreenGradient<T> screen_gradient(const Slot<T>& sum, const Splat<T>& s) {
  const T two_ln2 = T(TWO_LN2);
  ScreenGradient<T> g;
  g.x = two_ln2 * s.l11 * sum.sa;
  g.y = two_ln2 * (s.l21 * sum.sa + s.l22 * sum.sb);
  g.abs_x = two_ln2 * s.l11 * sum.abs_x, g.abs_y = two_ln2 * sum.abs_y;
  g.l11 = -two_ln2 * T(LOG2_SCALE) * sum.sa_dx;
  g.l21 = -two_ln2 * T(LOG2_SCALE) * sum.sa_dy;
  g.l22 = -two_ln2 * T(LOG2_SCALE) * sum.sb_dy;
  g.opacity = sum.s * std::exp2(-s.log2_opacity);
  g.color = {sum.color[0], sum.color[1], sum.color[2]};
  g.depth = sum.depth;
  return g;
}

// Gradients of the rows of V.
template <class T>
struct FactorGradient {
  Vector<T> x, y;
};

// Through l11 = sqrt(C / det), l21 = -B / sqrt(C det), l22 = 1 / sqrt(C) with C = |Vy|^2 + blur, B = Vx . Vy and
// det = |Vx x Vy|^2 + blur |V|^2 + blur^2, and through the antialias compensation sqrt(|Vx x Vy|^2 / det).
template <class T>
inline FactorGradient<T> factor_backward(const Camera<T>& camera, const Projection<T>& p, const ScreenGradient<T>& g,
                                         T opacity) {
  const T root = std::sqrt(p.variance_y) * std::sqrt(p.determinant);
  const T l11 = std::sqrt(p.variance_y / p.determinant), l21 = -p.covariance / root;
  const T l22 = 1 / std::sqrt(p.variance_y);
  const T v_variance = (g.l11 * l11 - g.l21 * l21 - g.l22 * l22) / (2 * p.variance_y);
  const T v_covariance = -g.l21 / root;
  T v_cross = -(g.l11 * l11 + g.l21 * l21) / (2 * p.determinant);  // of |Vx x Vy|^2
  T v_square = v_cross * camera.blur;                               // of |V|^2
  const T ratio = p.bare_determinant / p.determinant;
  if (camera.antialias && ratio > T(COMPENSATION_FLOOR)) {
    const T v_ratio = g.opacity * opacity / (2 * std::sqrt(ratio));
    v_cross += v_ratio * (1 - ratio) / p.determinant;  // d ratio = ((1 - ratio) d|Vx x Vy|^2 - ratio blur d|V|^2) / det
    v_square -= v_ratio * ratio * camera.blur / p.determinant;
  }
  const Vector<T> c = cross(p.factor_x, p.factor_y);
  return {(2 * v_cross) * cross(p.factor_y, c) + (2 * v_square) * p.factor_x + v_covariance * p.factor_y,
          (2 * v_cross) * cross(c, p.factor_x) + (2 * (v_square + v_variance)) * p.factor_y +
              v_covariance * p.factor_x};
}

template <class T>
inline void quaternion_backward(const Projection<T>& p, const Matrix<T>& v, T* out) {
  if (p.length == 0) {
    out[0] = out[1] = out[2] = out[3] = 0;
    return;
  }
  const T w = p.quaternion[0], x = p.quaternion[1], y = p.quaternion[2], z = p.quaternion[3];
  const Vector<T>&a = v.rows[0], &b = v.rows[1], &c = v.rows[2];
  const T g[4] = {2 * (x * (c.y - b.z) + y * (a.z - c.x) + z * (b.x - a.y)),
                  2 * (w * (c.y - b.z) + y * (a.y + b.x) + z * (a.z + c.x)) - 4 * x * (b.y + c.z),
                  2 * (w * (a.z - c.x) + x * (a.y + b.x) + z * (b.z + c.y)) - 4 * y * (a.x + c.z),
                  2 * (w * (b.x - a.y) + x * (a.z + c.x) + y * (b.z + c.y)) - 4 * z * (a.x + b.y)};
  const T along = g[0] * w + g[1] * x + g[2] * y + g[3] * z;
  for (int i = 0; i < 4; ++i) out[i] = (g[i] - along * p.quaternion[i]) / p.length;
}

// Gradients of the shape: writes quaternion and scales, answers that of the mean in the camera through J.
template <class T>
inline Vector<T> shape_backward(const Camera<T>& camera, const Projection<T>& p, const FactorGradient<T>& g,
                                const T* scales, T* quaternion_out, T* scales_out) {
  const Matrix<T>& m = p.camera_from_gaussian;
  const T jx = camera.fx * p.inverse_z, jy = camera.fy * p.inverse_z;
  const Matrix<T> v_m{{jx * g.x, jy * g.y,
                       (-jx * p.slope[0]) * g.x + (-jy * p.slope[1]) * g.y}};
  Matrix<T> v_axes;  // R^T v_m
  v_axes.rows[0] = camera.rotation.rows[0].x * v_m.rows[0] + camera.rotation.rows[1].x * v_m.rows[1] +
                   camera.rotation.rows[2].x * v_m.rows[2];
  v_axes.rows[1] = camera.rotation.rows[0].y * v_m.rows[0] + camera.rotation.rows[1].y * v_m.rows[1] +
                   camera.rotation.rows[2].y * v_m.rows[2];
  v_axes.rows[2] = camera.rotation.rows[0].z * v_m.rows[0] + camera.rotation.rows[1].z * v_m.rows[1] +
                   camera.rotation.rows[2].z * v_m.rows[2];
  const Matrix<T>& r = p.world_from_gaussian;
  scales_out[0] = scales_out[1] = scales_out[2] = 0;
  for (int i = 0; i < 3; ++i) {
    scales_out[0] += v_axes.rows[i].x * r.rows[i].x;
    scales_out[1] += v_axes.rows[i].y * r.rows[i].y;
    scales_out[2] += v_axes.rows[i].z * r.rows[i].z;
    v_axes.rows[i] = {v_axes.rows[i].x * scales[0], v_axes.rows[i].y * scales[1], v_axes.rows[i].z * scales[2]};
  }
  quaternion_backward(p, v_axes, quaternion_out);

  const T v_jxx = dot(g.x, m.rows[0]), v_jxz = dot(g.x, m.rows[2]);
  const T v_jyy = dot(g.y, m.rows[1]), v_jyz = dot(g.y, m.rows[2]);
  const T iz = p.inverse_z;
  Vector<T> v{0, 0, 0};
  v.z = -iz * (jx * v_jxx + jy * v_jyy - jx * p.slope[0] * v_jxz - jy * p.slope[1] * v_jyz);
  if (p.inside[0]) v.x = -jx * v_jxz * iz, v.z += jx * v_jxz * p.slope[0] * iz;
  if (p.inside[1]) v.y = -jy * v_jyz * iz, v.z += jy * v_jyz * p.slope[1] * iz;
  return v;
}

// Writes the gradient of the coefficients; answers that of the mean in the camera through the direction.
template <class T>
inline Vector<T> color_backward(const Camera<T>& camera, const Vector<T>& in_camera, Vector<T> v, const T* sh,
                                int64_t terms, T* sh_out) {
  const ViewColor<T> c = view_color(camera, in_camera, sh, terms);
  v = {c.raw.x > 0 ? v.x : T(0), c.raw.y > 0 ? v.y : T(0), c.raw.z > 0 ? v.z : T(0)};
  T v_values[16];
  for (int64_t k = 0; k < terms; ++k) {
    sh_out[3 * k] = c.values[k] * v.x, sh_out[3 * k + 1] = c.values[k] * v.y, sh_out[3 * k + 2] = c.values[k] * v.z;
    v_values[k] = sh[3 * k] * v.x + sh[3 * k + 1] * v.y + sh[3 * k + 2] * v.z;
  }
  const Vector<T> v_direction = basis_backward(c.direction, terms, v_values);
  const T along = dot(v_direction, c.direction);
  return camera.rotation * ((1 / c.distance) * (v_direction + -along * c.direction));
}

template <class T>
inline void zero(T* values, int64_t count) {
  std::memset(static_cast<void*>(values), 0, count * sizeof(T));
}

template <class T>
void row_backward(const Workspace<T>& ws, const Camera<T>& camera, const Inputs<T>& in, const RowGradients& out,
                  int64_t i) {
  T *means = static_cast<T*>(out.means) + 3 * i, *quaternions = static_cast<T*>(out.quaternions) + 4 * i;
  T *scales = static_cast<T*>(out.scales) + 3 * i, *opacity = static_cast<T*>(out.opacities) + i;
  T *sh = static_cast<T*>(out.sh) + 3 * in.terms * i, *screen = static_cast<T*>(out.screen) + 2 * i;
  if (ws.tiles[i].count == 0) {
    zero(means, 3), zero(quaternions, 4), zero(scales, 3), zero(opacity, 1), zero(sh, 3 * in.terms), zero(screen, 2);
    return;
  }
  const T* mean = in.means + 3 * i;
  Projection<T> p;
  p.in_camera = camera.rotation * Vector<T>{mean[0], mean[1], mean[2]} + camera.translation;
  project_shape(camera, in.quaternions + 4 * i, in.scales + 3 * i, p);
  const ScreenGradient<T> g = screen_gradient(sum_slots(ws, i), ws.splats[i]);
  screen[0] = g.abs_x, screen[1] = g.abs_y;
  *opacity = g.opacity * compensation(camera, p);
  Vector<T> v = shape_backward(camera, p, factor_backward(camera, p, g, in.opacities[i]), in.scales + 3 * i, quaternions, scales);
  const T jx = camera.fx * p.inverse_z, jy = camera.fy * p.inverse_z;
  v.x += g.x * jx, v.y += g.y * jy;
  v.z += g.depth - (g.x * jx * p.in_camera.x + g.y * jy * p.in_camera.y) * p.inverse_z;
  v = v + color_backward(camera, p.in_camera, g.color, in.sh + 3 * in.terms * i, in.terms, sh);
  const Vector<T> world = transposed(camera.rotation, v);
  means[0] = world.x, means[1] = world.y, means[2] = world.z;
}

template <class T>
void project_backward(Workspace<T>& ws, const View& view, const Rows& rows, const RowGradients& out) {
  const double start = omp_get_wtime();
  const Inputs<T> in(rows);
  const Camera<T> camera(view);
#pragma omp parallel for num_threads(view.threads) schedule(static)
  for (int64_t i = 0; i < in.count; ++i) row_backward(ws, camera, in, out, i);
  ws.seconds[PROJECT_BACKWARD] = omp_get_wtime() - start;
}

}  // namespace SPLAT_VARIANT
